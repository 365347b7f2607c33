"""The CUDA backend: gsplat's kernels behind the interface of `rasterize`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from extrags.errors import ConfigError
from extrags.raster.native import native_isa, rasterize_native
from extrags.raster.reference import camera_colors, rasterize_reference
from extrags.raster.rendering import DILATION_PX2, RasterInputs, RasterOptions, Rendering

__all__ = ["rasterize_gsplat"]


def rasterize_gsplat(inputs: RasterInputs, options: RasterOptions) -> Rendering:
    """Render float32 CUDA tensors with gsplat; arguments as checked by `rasterize`.

    gsplat has no median depth, no visibility and no transmittance at points. If requested, they are computed
    from the same Gaussians by the native kernels on the CPU (or by the reference if those are not built);
    they are not differentiable in any backend.

    Raises:
        ConfigError: for cameras with a radial lens.
    """
    if options.lens is not None:
        raise ConfigError(
            "the backend gsplat renders pinholes here, not the lens of the frames: take ingest.lens=pinhole, "
            "or render on the processor"
        )
    import gsplat

    images, alphas, meta = gsplat.rasterization(
        means=inputs.means,
        quats=inputs.quats,
        scales=inputs.scales,
        opacities=inputs.opacities,
        colors=_colors(inputs, options.sh_degree),
        viewmats=inputs.viewmats,
        Ks=inputs.Ks,
        width=options.width,
        height=options.height,
        near_plane=options.near,
        eps2d=DILATION_PX2,
        sh_degree=options.sh_degree if inputs.sh is not None and inputs.light is None else None,
        packed=False,
        backgrounds=inputs.background,
        render_mode="RGB+ED",
        absgrad=options.absgrad,
    )
    extra = _extras(inputs, options)
    return Rendering(
        rgb=images[..., :3],
        alpha=alphas[..., 0],
        depth=images[..., 3],
        means2d=_centres(meta["means2d"], options.absgrad),
        radius_px=_radius(meta["radii"]).to(inputs.means.dtype),
        median_depth=extra.get("median_depth"),
        visibility_max=extra.get("visibility_max"),
        visibility_sum=extra.get("visibility_sum"),
        transmittance=extra.get("transmittance"),
    )


def _colors(inputs: RasterInputs, sh_degree: int) -> Tensor | None:
    """Colours per camera; under a light they come from the reference, since gsplat has no light model."""
    if inputs.light is None:
        return inputs.sh if inputs.sh is not None else inputs.colors
    everything = torch.arange(len(inputs.means), device=inputs.means.device)
    cameras = range(len(inputs.viewmats))
    return torch.stack([camera_colors(inputs, sh_degree, camera, everything) for camera in cameras])


def _radius(radii: Tensor) -> Tensor:
    # gsplat 1.5 gives a radius per axis, earlier versions one.
    return radii.amax(-1) if radii.ndim == 3 else radii


def _centres(projected: Tensor, absgrad: bool) -> Tensor:
    """A tensor outside the graph whose `.grad` is filled with gsplat's gradients on backward."""
    means2d = projected.detach().clone()
    if projected.requires_grad:

        def fill(gradient: Tensor | None) -> None:
            if gradient is None:
                return
            means2d.grad = gradient if means2d.grad is None else means2d.grad + gradient
            if absgrad:
                absolute = projected.absgrad  # type: ignore[attr-defined]
                before = getattr(means2d, "absgrad", None)
                means2d.absgrad = absolute if before is None else before + absolute  # type: ignore[attr-defined]

        projected.register_hook(fill)
    return means2d


@torch.no_grad()
def _extras(inputs: RasterInputs, options: RasterOptions) -> dict[str, Any]:
    if not (options.median_depth or options.visibility or inputs.query_points is not None):
        return {}

    def moved(value: Any) -> Any:
        return None if value is None else value.detach().cpu()

    on_cpu = replace(inputs, **{name: moved(value) for name, value in vars(inputs).items()})
    plain = replace(options, absgrad=False)
    renderer = rasterize_reference if native_isa() is None else rasterize_native
    rendering = renderer(on_cpu, plain)
    names = ("median_depth", "visibility_max", "visibility_sum", "transmittance")
    found = {name: getattr(rendering, name) for name in names}
    return {k: None if v is None else v.to(inputs.means.device) for k, v in found.items()}
