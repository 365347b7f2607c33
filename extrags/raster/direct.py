"""Loss and gradients of one view computed directly by the native kernels, without autograd.

The result equals `rasterize`, `l1_ssim_loss`, `inverse_depth_loss` and a backward pass through them. There is
no autograd graph: buffers are reused as long as the number of Gaussians stays the same, and the chain rule
through the activations (exponential, sigmoid) is explicit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.errors import NonFiniteError, ShapeError
from extrags.radial_lens import RadialLens
from extrags.raster import native
from extrags.raster.light import ROW_LENGTH
from extrags.raster.loss import check_normalisation, huber_depth_gradient
from extrags.raster.rendering import Rendering, check_near, check_size, nonfinite_error

__all__ = ["DirectStep", "Target"]


class Target:
    """Ground truth of one camera, in the layout that the kernels read.

    Args:
        viewmat: camera from world, [4, 4].
        K: intrinsics in pixels, [3, 3].
        lens: of the camera; None for a pinhole.
        rgb: ground-truth colours, [H, W, 3].
        weight: weight of the colour loss per pixel, [H, W]; None weights all pixels equally.
        ssim_weight: weight of its SSIM term where that is another, [H, W]; None takes `weight`.
        normalisation: pixels that the weighted sums are divided by; None is the sum of `weight`.
        depth: z-depth in world units, 0 where there is none, [H, W].
        depth_confidence: weight of the depth term per pixel, in [0, 1], [H, W]; None weights all equally.
        shown: pixels that belong to the picture, [H, W]; elsewhere the colour terms take rendering and target
            for black, as beyond the edge of the image. None: all.
        saturated: channels of pixels that the colour terms take for white, in the target and where the
            rendering is brighter still, [H, W, 3]; what is brighter has no gradient. None: none.

    Raises:
        ShapeError: when sizes do not fit together, or that of the image is out of range.
        ConfigError: when the normalisation is not positive.
        NonFiniteError: when the camera holds a NaN or an infinity.
    """

    def __init__(
        self,
        viewmat: Float[np.ndarray, "4 4"],
        K: Float[np.ndarray, "3 3"],
        rgb: Float[Tensor, "h w 3"],
        *,
        lens: RadialLens | None = None,
        weight: Float[Tensor, "h w"] | None = None,
        ssim_weight: Float[Tensor, "h w"] | None = None,
        normalisation: float | None = None,
        depth: Float[Tensor, "h w"] | None = None,
        depth_confidence: Float[Tensor, "h w"] | None = None,
        shown: Bool[Tensor, "h w"] | None = None,
        saturated: Bool[Tensor, "h w 3"] | None = None,
    ) -> None:
        if rgb.ndim != 3 or rgb.shape[2] != 3:
            raise ShapeError(f"rgb has shape {tuple(rgb.shape)}, expected (H, W, 3)")
        self.height, self.width = int(rgb.shape[0]), int(rgb.shape[1])
        check_size(self.width, self.height)
        check_normalisation(normalisation)
        self.rgb = _contiguous_array(rgb)
        self.weight = None if weight is None else _contiguous_array(weight)
        self.ssim_weight = None if ssim_weight is None else _contiguous_array(ssim_weight)
        self.depth = None if depth is None else _contiguous_array(depth)
        self.depth_confidence = None if depth_confidence is None else _contiguous_array(depth_confidence)
        images = {
            "weight": self.weight,
            "ssim_weight": self.ssim_weight,
            "depth": self.depth,
            "depth_confidence": self.depth_confidence,
        }
        for name, image in images.items():
            if image is not None and image.shape != (self.height, self.width):
                raise ShapeError(f"{name} has shape {image.shape}, expected {(self.height, self.width)}")
        self.hidden = None if shown is None else _flat("shown", ~shown, self.rgb.shape[:2])
        self.saturated = None if saturated is None else _flat("saturated", saturated, self.rgb.shape)
        if self.hidden is not None or self.saturated is not None:
            # The view's own colours may be in this memory.
            self.rgb = self.rgb.copy()
        if self.saturated is not None:
            self.rgb.reshape(-1)[self.saturated] = 1
        if self.hidden is not None:
            self.rgb.reshape(-1, 3)[self.hidden] = 0
        self.viewmat = np.ascontiguousarray(viewmat, dtype=np.float32)
        self.K = np.ascontiguousarray(K, dtype=np.float32)
        self.lens = None if lens is None else lens.packed()
        for name, matrix, side in (("viewmats", self.viewmat, 4), ("Ks", self.K, 3)):
            if matrix.shape != (side, side):
                raise ShapeError(f"{name} has shape {matrix.shape}, expected {(side, side)}")
            if not np.isfinite(matrix).all():
                raise nonfinite_error(name, torch.from_numpy(matrix)[None])
        if normalisation is None:
            pixels = self.height * self.width
            normalisation = pixels if self.weight is None else float(self.weight.sum(dtype=np.float64))
        self.scale = 1 / (3 * normalisation) if normalisation != 0 else 0.0


def _contiguous_array(values: Tensor) -> np.ndarray:
    return values.detach().to(torch.float32).contiguous().numpy()


def _flat(name: str, chosen: Tensor, size: tuple[int, ...]) -> np.ndarray:
    """Flat indices of what is chosen of an image."""
    if chosen.shape != size:
        raise ShapeError(f"{name} has shape {tuple(chosen.shape)}, expected {size}")
    return np.flatnonzero(chosen.numpy())


@dataclass(frozen=True)
class _Images:
    """Buffers for rendered images and their gradients, as tensors and as arrays that share memory."""

    tensors: dict[str, Tensor]
    arrays: dict[str, np.ndarray]
    filled: Any
    """The kernels' struct of the images and of the projected centres."""

    @classmethod
    def empty(cls, width: int, height: int, means2d: np.ndarray, radius_px: np.ndarray) -> _Images:
        shapes = {"rgb": 3, "v_rgb": 3, "alpha": 0, "depth": 0, "v_depth": 0}
        tensors = {
            name: torch.empty(1, height, width, *([channels] if channels else []))
            for name, channels in shapes.items()
        }
        arrays = {name: value[0].numpy() for name, value in tensors.items()}
        outputs = {name: arrays[name] for name in ("rgb", "alpha", "depth")}
        filled = native.compiled_kernels().Images(**outputs, means2d=means2d, radius=radius_px)
        return cls(tensors, arrays, filled)

    def loss_and_gradients(
        self,
        target: Target,
        *,
        dssim_weight: float,
        rgb_weight: float,
        depth_weight: float,
        depth_scale: float,
        depth_huber_delta: float | None,
    ) -> tuple[float, Any]:
        """The loss, and the kernels' struct of its gradients with respect to the images."""
        kernels, image = native.compiled_kernels(), self.arrays
        with self._no_brighter_than_white(target.saturated), self._blank(target.hidden):
            loss: float = kernels.l1_ssim(
                image["rgb"],
                target.rgb,
                target.weight,
                image["v_rgb"],
                dssim_weight,
                rgb_weight,
                ssim_mask=target.ssim_weight,
            )
        gradients = {"rgb": image["v_rgb"]}
        if target.depth is not None and depth_weight > 0:
            images = image["depth"], image["alpha"], target.depth, image["v_depth"]
            if depth_huber_delta is None:
                depth_loss, compared = kernels.inverse_depth(
                    *images, depth_scale, depth_weight, confidence=target.depth_confidence
                )
            else:
                depth_loss, compared = huber_depth_gradient(
                    *images,
                    scale=depth_scale,
                    delta=depth_huber_delta,
                    weight=depth_weight,
                    confidence=target.depth_confidence,
                )
            loss += depth_loss
            if compared:
                gradients |= {"depth": image["v_depth"], "depth_image": image["depth"]}
        return loss, kernels.ImageGradients(**gradients)

    @contextmanager
    def _no_brighter_than_white(self, saturated: np.ndarray | None) -> Iterator[None]:
        """Saturated channels, as the loss sees them, and without a gradient where they are brighter."""
        if saturated is None:
            yield
            return
        colors = self.arrays["rgb"].reshape(-1)
        brighter = saturated[colors[saturated] > 1]
        rendered = colors[brighter]
        colors[brighter] = 1
        yield
        colors[brighter] = rendered
        self.arrays["v_rgb"].reshape(-1)[brighter] = 0

    @contextmanager
    def _blank(self, hidden: np.ndarray | None) -> Iterator[None]:
        """Pixels black, as the loss sees them, and without a gradient; the rendering keeps its colours."""
        if hidden is None:
            yield
            return
        colors = self.arrays["rgb"].reshape(-1, 3)
        rendered = colors[hidden]
        colors[hidden] = 0
        yield
        colors[hidden] = rendered
        self.arrays["v_rgb"].reshape(-1, 3)[hidden] = 0


class DirectStep:
    """Forward pass, loss and backward pass of one view at a time, in reused buffers.

    `gradients` holds the last view's gradients with respect to the parameters before activation, by name.
    It and the renderings are overwritten by the next `run` and replaced by the next `bind`.

    Args:
        absgrad: fill `means2d.absgrad`.
        lit: the scene has a near-field light.
    """

    def __init__(self, *, absgrad: bool = False, lit: bool = False) -> None:
        self.gradients: dict[str, Tensor] = {}
        self.visible = torch.empty(0, dtype=torch.bool)
        self.light_gradient = np.zeros(ROW_LENGTH, dtype=np.float32)
        self.viewmat_gradient = np.zeros((4, 4), dtype=np.float32)
        self._absgrad, self._lit = absgrad, lit
        self._images: dict[tuple[int, int], _Images] = {}
        self._renderings: dict[tuple[int, int], Rendering] = {}
        self._values: dict[str, Tensor] = {}
        self._linear: dict[str, Tensor] = {}
        self._checked: tuple[tuple[str, Tensor, np.ndarray], ...] = ()
        self._gaussians: Any = None
        self._gaussian_gradients: Any = None
        self._means2d = self._radius_px = torch.empty(0)

    def bind(self, parameters: Mapping[str, Tensor]) -> None:
        """Set the parameters to differentiate; they may be updated in place between calls of `run`.

        Args:
            parameters: float32 on the CPU and contiguous: `means` [N, 3], `quats` [N, 4], `scales` (their
                logarithms) [N, 3], `opacities` (logits) [N], `sh` [N, K, 3].
        """
        values = self._values = {name: value.detach() for name, value in parameters.items()}
        n = len(values["means"])
        self._linear = {name: torch.empty_like(values[name]) for name in ("scales", "opacities")}
        rendered = {**values, **self._linear}
        names = ("means", "quats", "scales", "opacities", "sh")
        arrays = {name: rendered[name].numpy() for name in names}
        self._checked = tuple((name, rendered[name], arrays[name]) for name in names)
        self.gradients = {name: torch.empty_like(values[name]) for name in names}
        self.visible = torch.empty(n, dtype=torch.bool)
        self._means2d, self._radius_px = torch.empty(1, n, 2), torch.empty(1, n)
        self._means2d.grad = torch.empty(1, n, 2)
        absolute = torch.empty(1, n, 2) if self._absgrad else None
        if absolute is not None:
            self._means2d.absgrad = absolute  # type: ignore[attr-defined]
        kernels = native.compiled_kernels()
        self._gaussians = kernels.Gaussians(**arrays)
        self._gaussian_gradients = kernels.GaussianGradients(
            **{name: value.numpy() for name, value in self.gradients.items()},
            means2d=self._means2d.grad[0].numpy(),
            absolute2d=None if absolute is None else absolute[0].numpy(),
        )
        self._images, self._renderings = {}, {}

    def run(
        self,
        target: Target,
        *,
        sh_degree: int,
        light: Float[np.ndarray, "17"] | None = None,
        dssim_weight: float = 0.2,
        photometric_weight: float = 1.0,
        loss_weight: float = 1.0,
        depth_weight: float = 0.0,
        depth_scale: float = 1.0,
        depth_huber_delta: float | None = None,
        near: float = 0.01,
        pose: bool = False,
    ) -> float:
        """Loss of one view; fills `gradients`, `visible`, `light_gradient` and the rendering.

        Args:
            target: ground truth of the view, and its camera.
            sh_degree: use the harmonics up to this degree.
            light: a row of `CameraLight.packed`; given exactly if the step was made `lit`.
            dssim_weight: as in `l1_ssim_loss`.
            photometric_weight: of `l1_ssim_loss`.
            loss_weight: of the whole view.
            depth_weight: of `depth_loss`; without effect where the target has no depth.
            depth_scale: as in `depth_loss`.
            depth_huber_delta: as in `depth_loss`.
            near: as in `rasterize`.
            pose: fill `viewmat_gradient` too.

        Raises:
            NonFiniteError: when a parameter, activated, the light or the pose holds a NaN or an infinity.
            ShapeError: when `near` is not finite and positive, or as `rendered_frame`.
        """
        kernels = native.compiled_kernels()
        torch.exp(self._values["scales"], out=self._linear["scales"])
        torch.sigmoid(self._values["opacities"], out=self._linear["opacities"])
        check_near(near)
        # Poses that are refined are written into the target after it was made.
        for name, values in (("viewmats", target.viewmat), ("light", light)):
            if values is not None and kernels.first_nonfinite(values) >= 0:
                raise nonfinite_error(name, torch.from_numpy(values)[None])
        images = self._images_of(target)
        camera = kernels.Camera(
            viewmat=target.viewmat,
            K=target.K,
            width=target.width,
            height=target.height,
            near=near,
            light=light,
            lens=target.lens,
        )
        frame = native.rendered_frame(self._gaussians, camera, images.filled, degree=sh_degree, check=True)
        if frame is None:
            raise self._nonfinite_error(kernels)
        loss, image_gradients = images.loss_and_gradients(
            target,
            dssim_weight=dssim_weight,
            rgb_weight=loss_weight * photometric_weight * target.scale,
            depth_weight=loss_weight * depth_weight,
            depth_scale=depth_scale,
            depth_huber_delta=depth_huber_delta,
        )
        frame.backward(
            self._gaussians,
            image_gradients,
            self._gaussian_gradients,
            kernels.CameraGradients(
                viewmat=self.viewmat_gradient if pose else None,
                light=self.light_gradient if self._lit else None,
            ),
        )
        self._backward_activations()
        torch.gt(self._radius_px[0], 0, out=self.visible)
        return loss

    def rendering(self, target: Target) -> Rendering:
        """The images of the last `run`, which must have had this target; the next `run` overwrites them."""
        size = target.width, target.height
        if size not in self._renderings:
            images = self._images_of(target).tensors
            self._renderings[size] = Rendering(
                rgb=images["rgb"],
                alpha=images["alpha"],
                depth=images["depth"],
                means2d=self._means2d,
                radius_px=self._radius_px,
            )
        return self._renderings[size]

    def _images_of(self, target: Target) -> _Images:
        size = target.width, target.height
        if size not in self._images:
            means2d, radius_px = self._means2d[0].numpy(), self._radius_px[0].numpy()
            self._images[size] = _Images.empty(*size, means2d, radius_px)
        return self._images[size]

    def _backward_activations(self) -> None:
        """Chain rule through the activations: from scales and opacities to their logarithms and logits."""
        g_scales, g_opacities = self.gradients["scales"], self.gradients["opacities"]
        torch.mul(g_scales, self._linear["scales"], out=g_scales)
        torch.ops.aten.sigmoid_backward.grad_input(
            g_opacities, self._linear["opacities"], grad_input=g_opacities
        )

    def _nonfinite_error(self, kernels: Any) -> NonFiniteError:
        """That of the first array with a NaN or an infinity, of which there is one."""
        found = (
            (name, tensor)
            for name, tensor, array in self._checked
            if array.size and kernels.first_nonfinite(array) >= 0
        )
        return nonfinite_error(*next(found))
