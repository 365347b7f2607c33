"""`rasterize`: the public function that dispatches to a backend."""

from __future__ import annotations

import logging
from functools import cache
from importlib.util import find_spec
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.array_shapes import check_instance
from extrags.errors import ConfigError, MissingDependencyError, installed_with
from extrags.radial_lens import RadialLens
from extrags.raster.light import CameraLight
from extrags.raster.native import missing_kernels_error, native_isa, rasterize_native
from extrags.raster.reference import rasterize_reference
from extrags.raster.rendering import (
    RasterInputs,
    RasterOptions,
    Rendering,
    check_finite,
    check_values,
    checked_inputs,
)

__all__ = ["Backend", "available_backends", "rasterize"]

logger = logging.getLogger(__name__)

Backend = Literal["auto", "native", "gsplat", "reference"]


def available_backends() -> tuple[str, ...]:
    """Backends available on this machine, in order of preference.

    Returns:
        Any of `gsplat` (CUDA device and the package gsplat), `native` (compiled kernels), `reference`.
    """
    found = []
    if torch.cuda.is_available() and find_spec("gsplat") is not None:
        found.append("gsplat")
    if native_isa() is not None:
        found.append("native")
    return (*found, "reference")


def rasterize(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, "n"],
    sh: Float[Tensor, "n k 3"] | None,
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
    *,
    colors: Float[Tensor, "n 3"] | Float[Tensor, "c n 3"] | None = None,
    sh_degree: int | None = None,
    background: Float[Tensor, "3"] | Float[Tensor, "c 3"] | None = None,
    near: float = 0.01,
    backend: Backend = "auto",
    median_depth: bool = False,
    visibility: bool = False,
    visibility_mask: Bool[Tensor, "c h w"] | None = None,
    query_points: Float[Tensor, "q 3"] | None = None,
    absgrad: bool = False,
    light: CameraLight | None = None,
    lens: RadialLens | None = None,
) -> Rendering:
    """Render Gaussians with differentiable splatting, as `gsplat.rasterization` does.

    Differentiable in means, quats, scales, opacities, sh or colors, background, light and viewmats; not
    in Ks, query_points and the thresholds. The conventions are gsplat's: EWA projection with 0.3 px^2
    added to the covariance, alpha clipped to 0.999, contributions under 1/255 dropped, a pixel finished
    before its transmittance would reach 1e-4, pixel centres at +0.5, camera axes right, down, forward.

    Args:
        means: centres in world units.
        quats: rotations (w, x, y, z) of any length; a null quaternion counts as the identity.
        scales: standard deviations in world units (not their logarithms).
        opacities: in [0, 1] (not logits).
        sh: spherical harmonics coefficients, 1, 4, 9 or 16 per colour; the colour of a Gaussian is
            max(SH(direction) + 0.5, 0). None when `colors` is given.
        viewmats: camera from world, rigid.
        Ks: intrinsics in pixels; skew is ignored.
        width: of the images in pixels.
        height: of the images in pixels.
        colors: final linear colours, one per Gaussian or per camera and Gaussian, instead of `sh`.
        sh_degree: use the harmonics up to this degree only.
        background: colour behind everything, black when None.
        near: Gaussians nearer than this z-depth are culled.
        backend: `native` (CPU kernels, float32), `gsplat` (CUDA), `reference` (torch, any dtype); `auto`
            takes gsplat for CUDA tensors, native for float32 CPU tensors, the reference for other dtypes.
        median_depth: fill `Rendering.median_depth`.
        visibility: fill `Rendering.visibility_max` and `visibility_sum`.
        visibility_mask: the pixels that count for these, for instance those that show tissue; None is all.
        query_points: world points at which `Rendering.transmittance` is wanted.
        absgrad: fill `means2d.absgrad` on backward.
        light: near-field light of the cameras; `sh` or `colors` are then albedo. Differentiable.
        lens: radial lens of all cameras, None for pinholes. Gaussians are projected with its own Jacobian;
            what lies outside its field of view by a margin, or behind the camera, is culled.

    Returns:
        The images and the optional outputs requested; see `Rendering` for shapes and meaning.

    Raises:
        ShapeError: when shapes, types or devices do not fit together, a size or an opacity is out of range,
            or a focal length is not positive.
        PoseError: when a view matrix is no rigid motion.
        NonFiniteError: when an input holds a NaN or an infinity; names the array and the entry.
        ConfigError: when the chosen backend cannot take these tensors, or a visibility mask is given where no
            visibility is asked for.
        MissingDependencyError: when the chosen backend is not installed.

    Source: Kerbl et al., 3D Gaussian Splatting, SIGGRAPH 2023; Ye et al., gsplat, JMLR 2025. Lens: Zwicker et
    al., "EWA volume splatting", 2001, with the Jacobian of Kannala and Brandt's model, PAMI 2006.
    """
    if visibility_mask is not None and not visibility:
        raise ConfigError("a visibility_mask is given, but no visibility is asked for")
    for name, value, kind in (
        ("means", means, Tensor),
        ("light", light, CameraLight),
        ("visibility_mask", visibility_mask, Tensor),
    ):
        if value is not None:
            check_instance(value, name, kind)
    packed = None if light is None else light.packed()
    counted = None if visibility_mask is None else visibility_mask.to(means.device, means.dtype)
    inputs = RasterInputs(
        means, quats, scales, opacities, sh, colors, viewmats, Ks, background, query_points, packed, counted
    )
    inputs, degree = checked_inputs(inputs, width, height, near, sh_degree)
    options = RasterOptions(width, height, degree, near, median_depth, visibility, absgrad, lens)
    chosen = _chosen(backend, means)
    if chosen == "native":
        return rasterize_native(inputs, options)
    check_finite(inputs)
    check_values(inputs)
    if chosen == "gsplat":
        from extrags.raster.gsplat import rasterize_gsplat

        return rasterize_gsplat(inputs, options)
    return rasterize_reference(inputs, options)


def _chosen(backend: Backend, means: Tensor) -> str:
    plain = means.device.type == "cpu" and means.dtype == torch.float32
    if backend == "auto":
        if means.is_cuda and means.dtype == torch.float32 and find_spec("gsplat") is not None:
            return "gsplat"
        if plain and native_isa() is None:
            _warn_once()
        return "native" if plain and native_isa() is not None else "reference"
    if backend not in ("native", "gsplat", "reference"):
        raise ConfigError(f"backend is {backend!r}, expected auto, native, gsplat or reference")
    if backend == "native":
        if native_isa() is None:
            raise missing_kernels_error()
        if not plain:
            raise ConfigError(
                f"backend native takes float32 CPU tensors, got {means.dtype} on {means.device}"
            )
    if backend == "gsplat":
        if find_spec("gsplat") is None:
            raise MissingDependencyError(f"gsplat is not installed: {installed_with('cuda')}")
        if not (means.is_cuda and means.dtype == torch.float32):
            raise ConfigError(
                f"backend gsplat takes float32 CUDA tensors, got {means.dtype} on {means.device}"
            )
    return backend


@cache
def _warn_once() -> None:
    logger.warning("using the slow reference rasteriser: %s", missing_kernels_error())
