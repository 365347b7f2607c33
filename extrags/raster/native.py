"""The native CPU backend: autograd functions around the compiled kernels.

One kernel call per camera projects, bins, sorts and composites; another computes the gradients. A `Frame`
holds the intermediate results of a forward pass for its backward pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from extrags.cores import usable_cores
from extrags.errors import ConfigError, MissingDependencyError, ShapeError
from extrags.raster.light import ROW_LENGTH
from extrags.raster.rendering import RasterInputs, RasterOptions, Rendering, check_values, nonfinite_error

_kernels: ModuleType | None = None
_import_error: ImportError | None = None
try:
    import extrags.raster._native as _compiled
except ImportError as error:  # the reference rasteriser still works
    _import_error = error.with_traceback(None)
else:
    _kernels = _compiled
    # By themselves the kernels count the cores of this process, but not what a container may take of them.
    if usable_cores() < _compiled.num_threads():
        _compiled.set_num_threads(usable_cores())

__all__ = [
    "adam_step",
    "compiled_kernels",
    "l1_ssim_loss_native",
    "missing_kernels_error",
    "native_isa",
    "num_threads",
    "rasterize_native",
    "rendered_frame",
    "set_native_isa",
    "set_num_threads",
    "usable_isas",
]


def native_isa() -> str | None:
    """Instruction set the kernels use, `avx512`, `avx2` or `portable`; None when they are not built.

    The fastest one the processor supports is chosen at import; the environment variable EXTRAGS_ISA
    overrides it.

    Raises:
        ConfigError: when EXTRAGS_ISA names one that this processor cannot run.
    """
    try:
        return None if _kernels is None else str(_kernels.isa())
    except ValueError as error:
        raise ConfigError(str(error)) from error


def usable_isas() -> list[str]:
    """Instruction sets this processor can run, the fastest first."""
    return [] if _kernels is None else list(_kernels.usable_isas())


def set_native_isa(name: str) -> None:
    """Switch the kernels to another instruction set of `usable_isas()`.

    Raises:
        ConfigError: when this processor cannot run it.
    """
    try:
        compiled_kernels().set_isa(name)
    except ValueError as error:
        raise ConfigError(str(error)) from error


def set_num_threads(n: int) -> None:
    """Set the maximum number of threads of the kernels; results do not depend on it.

    The default is the number of cores this process may use (`extrags.cores`), at most 8.

    Raises:
        ConfigError: when n is not 1 to 64.
    """
    if not 1 <= n <= 64:
        raise ConfigError(f"the number of threads is {n}, expected 1 to 64")
    compiled_kernels().set_num_threads(n)


def num_threads() -> int:
    """Maximum number of threads of the kernels."""
    return int(compiled_kernels().num_threads())


def compiled_kernels() -> ModuleType:
    """The compiled module itself, for benchmarks.

    Raises:
        MissingDependencyError: when it is not built, or the system cannot load it.
    """
    if _kernels is None:
        raise missing_kernels_error()
    return _kernels


def missing_kernels_error() -> MissingDependencyError:
    """The error that says why there are no compiled kernels; its cause is that of the import."""
    if isinstance(_import_error, ModuleNotFoundError) and _import_error.name == "extrags.raster._native":
        why = (
            "the native kernels are not built: installing the package builds them where there is a C++17 "
            "compiler (GCC 12, Clang 14 or later)"
        )
    else:
        why = f"the native kernels are built but cannot be loaded: {_import_error}"
    error = MissingDependencyError(why)
    error.__cause__ = _import_error
    return error


def rendered_frame(gaussians: Any, camera: Any, images: Any, *, degree: int, check: bool = False) -> Any:
    """One camera's forward pass by the kernels.

    Args:
        gaussians: the kernels' struct of the scene.
        camera: that of the camera.
        images: that of the images, which are filled.
        degree: of the harmonics.
        check: look for NaN and infinities in the scene.

    Returns:
        The kernels' frame; None where the check found some.

    Raises:
        ShapeError: when the Gaussians cover too many tiles of the image for the kernels to number.
    """
    try:
        return compiled_kernels().render(gaussians, camera, images, degree=degree, check=check)
    except OverflowError as error:
        raise ShapeError(str(error)) from error


def rasterize_native(inputs: RasterInputs, options: RasterOptions) -> Rendering:
    """Render float32 CPU tensors with the native kernels; arguments as checked by `rasterize`."""
    _check_finite(inputs)
    check_values(inputs)
    call = _Call.prepared(inputs, options)
    rgb, alpha, depth = _Rasterize.apply(  # type: ignore[no-untyped-call]
        call,
        inputs.means,
        inputs.quats,
        inputs.scales,
        inputs.opacities,
        inputs.sh,
        inputs.colors,
        inputs.viewmats,
        inputs.background,
        inputs.light,
    )
    return Rendering(
        rgb=rgb,
        alpha=alpha,
        depth=depth,
        means2d=call.means2d,
        radius_px=call.radius_px,
        median_depth=call.median_depth,
        visibility_max=call.visibility_max,
        visibility_sum=call.visibility_sum,
        transmittance=call.transmittance,
    )


def _check_finite(inputs: RasterInputs) -> None:
    kernels = compiled_kernels()
    for name, value in vars(inputs).items():
        if value is None:
            continue
        plain = value.detach().contiguous()
        if plain.numel() and kernels.first_nonfinite(plain) >= 0:
            raise nonfinite_error(name, value)


@dataclass
class _Call:
    """One rasterisation: its options, and the outputs that autograd does not see."""

    options: RasterOptions
    query_points: Tensor | None
    visibility_mask: Tensor | None
    Ks: Tensor
    means2d: Tensor
    radius_px: Tensor
    median_depth: Tensor | None
    visibility_max: Tensor | None
    visibility_sum: Tensor | None
    transmittance: Tensor | None
    frames: list[Any] = field(default_factory=list)

    @classmethod
    def prepared(cls, inputs: RasterInputs, options: RasterOptions) -> _Call:
        c, n = len(inputs.viewmats), len(inputs.means)
        points, counted = inputs.query_points, inputs.visibility_mask
        return cls(
            options=options,
            query_points=None if points is None else points.detach().contiguous(),
            visibility_mask=None if counted is None else counted.detach().contiguous(),
            Ks=inputs.Ks.detach().contiguous(),
            means2d=torch.empty(c, n, 2),
            radius_px=torch.empty(c, n),
            median_depth=torch.empty(c, options.height, options.width) if options.median_depth else None,
            visibility_max=torch.empty(c, n) if options.visibility else None,
            visibility_sum=torch.empty(c, n) if options.visibility else None,
            transmittance=None if points is None else torch.empty(c, len(points)),
        )

    def take_gradients(self, gradients: Tensor, absolute: Tensor | None) -> None:
        """Accumulate the gradients of the 2D means into `means2d`, the tensor returned to the caller."""
        means2d = self.means2d
        means2d.grad = gradients if means2d.grad is None else means2d.grad + gradients
        if absolute is not None:
            before = getattr(means2d, "absgrad", None)
            means2d.absgrad = absolute if before is None else before + absolute  # type: ignore[attr-defined]


def _of_camera(values: Tensor | None, camera: int) -> Tensor | None:
    return None if values is None else values[camera]


class _Gaussians:
    """The kernels' struct of the Gaussians, one for all cameras unless each has colours of its own."""

    def __init__(self, *arrays: Tensor | None) -> None:
        names = ("means", "quats", "scales", "opacities", "sh", "colors")
        self._arrays = dict(zip(names, arrays, strict=True))
        colors = self._arrays["colors"]
        self._colors = colors if colors is not None and colors.ndim == 3 else None
        self._shared = None if self._colors is not None else compiled_kernels().Gaussians(**self._arrays)

    def of_camera(self, camera: int) -> Any:
        if self._colors is None:
            return self._shared
        return compiled_kernels().Gaussians(**{**self._arrays, "colors": self._colors[camera]})


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        call: _Call,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        sh: Tensor | None,
        colors: Tensor | None,
        viewmats: Tensor,
        background: Tensor | None,
        light: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        kernels, options = compiled_kernels(), call.options
        arrays = [
            None if value is None else value.detach().contiguous()
            for value in (means, quats, scales, opacities, sh, colors, viewmats, background, light)
        ]
        *scene, viewmats, background, light = arrays  # type: ignore[assignment]
        gaussians = _Gaussians(*scene)
        c = len(viewmats)
        rgb = torch.empty(c, options.height, options.width, 3)
        alpha = torch.empty(c, options.height, options.width)
        depth = torch.empty_like(alpha)
        differentiable = any(ctx.needs_input_grad)
        lens = None if options.lens is None else options.lens.packed()
        for index in range(c):
            camera = kernels.Camera(
                viewmat=viewmats[index],
                K=call.Ks[index],
                width=options.width,
                height=options.height,
                near=options.near,
                background=_of_camera(background, index),
                light=_of_camera(light, index),
                lens=lens,
            )
            images = kernels.Images(
                rgb=rgb[index],
                alpha=alpha[index],
                depth=depth[index],
                means2d=call.means2d[index],
                radius=call.radius_px[index],
                median_depth=_of_camera(call.median_depth, index),
                visibility_max=_of_camera(call.visibility_max, index),
                visibility_sum=_of_camera(call.visibility_sum, index),
                visibility_mask=_of_camera(call.visibility_mask, index),
            )
            frame = rendered_frame(gaussians.of_camera(index), camera, images, degree=options.sh_degree)
            if call.query_points is not None and call.transmittance is not None:
                frame.query(call.query_points, call.transmittance[index])
            if differentiable:
                call.frames.append(frame)
        ctx.call = call
        ctx.save_for_backward(*scene, viewmats, alpha, depth)
        return rgb, alpha, depth

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_rgb: Tensor, v_alpha: Tensor, v_depth: Tensor) -> tuple[Tensor | None, ...]:
        kernels = compiled_kernels()
        call: _Call = ctx.call
        *scene, viewmats, alpha, depth = ctx.saved_tensors
        gaussians = _Gaussians(*scene)
        needs = ctx.needs_input_grad[1:]
        v_rgb, v_alpha, v_depth = (value.contiguous() for value in (v_rgb, v_alpha, v_depth))
        c, n = len(viewmats), len(scene[0])
        names = ("means", "quats", "scales", "opacities", "sh")
        shared = {
            name: torch.empty_like(value) if needed else None
            for name, value, needed in zip(names, scene, needs, strict=False)
        }
        if c == 0:
            shared = {name: None if value is None else value.zero_() for name, value in shared.items()}
        g_colors = torch.empty(c, n, 3) if needs[5] else None
        g_viewmats = torch.empty(c, 4, 4) if needs[6] else None
        g_light = torch.empty(c, ROW_LENGTH) if needs[8] else None
        g_means2d = torch.empty(c, n, 2)
        g_absolute = torch.empty(c, n, 2) if call.options.absgrad else None
        for index in range(c):
            call.frames[index].backward(
                gaussians.of_camera(index),
                kernels.ImageGradients(
                    rgb=v_rgb[index], alpha=v_alpha[index], depth=v_depth[index], depth_image=depth[index]
                ),
                kernels.GaussianGradients(
                    **shared,
                    colors=_of_camera(g_colors, index),
                    means2d=g_means2d[index],
                    absolute2d=_of_camera(g_absolute, index),
                ),
                kernels.CameraGradients(
                    viewmat=_of_camera(g_viewmats, index), light=_of_camera(g_light, index)
                ),
                add=index > 0,
            )
        call.take_gradients(g_means2d, g_absolute)
        if g_colors is not None and scene[5].ndim == 2:
            g_colors = g_colors[0] if c == 1 else g_colors.sum(0)
        g_background = None
        if needs[7]:
            g_background = (v_rgb * (1 - alpha)[..., None]).sum((1, 2))
        return (None, *shared.values(), g_colors, g_viewmats, g_background, g_light)


def l1_ssim_loss_native(
    image: Tensor,
    target: Tensor,
    dssim_weight: float,
    mask: Tensor | None,
    ssim_mask: Tensor | None,
    normalisation: float | None,
) -> Tensor:
    """`l1_ssim_loss` of float32 CPU tensors; arguments as checked there."""
    loss: Tensor = _L1Ssim.apply(image, target, dssim_weight, mask, ssim_mask, normalisation)  # type: ignore[no-untyped-call]
    return loss


class _L1Ssim(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        image: Tensor,
        target: Tensor,
        dssim_weight: float,
        mask: Tensor | None,
        ssim_mask: Tensor | None,
        normalisation: float | None,
    ) -> Tensor:
        kernels = compiled_kernels()
        height, width = image.shape[-3:-1]
        x = image.detach().reshape(-1, height, width, 3).contiguous()
        y = target.detach().reshape(-1, height, width, 3).contiguous()
        m, s = (
            None if weights is None else weights.detach().reshape(-1, height, width).contiguous()
            for weights in (mask, ssim_mask)
        )
        if normalisation is None:
            normalisation = float(x[..., 0].numel()) if m is None else float(m.sum(dtype=torch.float64))
        scale = 1 / (3 * normalisation) if normalisation != 0 else 0.0
        gradient = torch.empty_like(x)
        loss = 0.0
        for index in range(len(x)):
            loss += kernels.l1_ssim(
                x[index],
                y[index],
                _of_camera(m, index),
                gradient[index],
                dssim_weight,
                scale,
                ssim_mask=_of_camera(s, index),
            )
        ctx.save_for_backward(gradient.reshape(image.shape))
        return image.new_tensor(loss)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_loss: Tensor) -> tuple[Tensor, None, None, None, None, None]:
        (gradient,) = ctx.saved_tensors
        # Nearly always one: not worth another pass over the image.
        scaled = gradient if float(v_loss) == 1 else gradient * v_loss
        return scaled, None, None, None, None, None


def adam_step(
    parameters: Sequence[tuple[Tensor, Tensor, Tensor, Tensor, float | list[float]]],
    steps: Tensor,
    visible: Tensor | None,
    bias: tuple[Tensor, Tensor],
    betas: tuple[float, float],
    eps: float,
) -> None:
    """Step parameters in place; see `SelectiveAdam`.

    Args:
        parameters: of each its values, gradients, first and second moments, all [N, ...], float32 and (but
            for the gradients) contiguous, and its learning rate, or one per column of a flattened row.
        steps: how often each row has been stepped, this step included, [N] int32.
        visible: rows to step, [N] bool; None is all.
        bias: 1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t) for every t up to the largest of `steps`.
        betas: decay of the moments.
        eps: added to the root of the second moment.
    """
    # Binding numpy arrays takes the kernels a tenth of the time of binding torch tensors.
    compiled_kernels().adam(
        [
            (
                values.detach().numpy(),
                gradients.detach().contiguous().numpy(),
                first.numpy(),
                second.numpy(),
                rate,
            )
            for values, gradients, first, second, rate in parameters
        ],
        steps.numpy(),
        *(table.numpy() for table in bias),
        None if visible is None else visible.contiguous().view(torch.uint8).numpy(),
        *betas,
        eps,
    )
