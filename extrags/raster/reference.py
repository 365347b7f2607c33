"""Reference implementation and specification of the rasteriser, in plain torch.

Supports any floating-point dtype and device, and is differentiable by autograd. It favours readability over
speed: every pixel evaluates every Gaussian whose bounding box overlaps its tile. Tests compare the other
backends with it in float64.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from extrags.errors import ShapeError
from extrags.raster.lens_projection import project_through_lens, within_lens
from extrags.raster.light import lit_colors, shortest_axes
from extrags.raster.rendering import (
    ALPHA_EPS,
    ALPHA_MAX,
    ALPHA_MIN,
    COVARIANCE_MAX_PX2,
    DILATION_PX2,
    FIELD_OF_VIEW_MARGIN,
    TRANSMITTANCE_MIN,
    RasterInputs,
    RasterOptions,
    Rendering,
)
from extrags.raster.rotations import rotation_matrices
from extrags.raster.spherical_harmonics import sh_basis

__all__ = ["camera_colors", "rasterize_reference"]

TILE_PX = 16
ELEMENTS_PER_CHUNK = 1 << 22
"""Pixel-Gaussian pairs evaluated at once; limits the memory."""


@dataclass(frozen=True)
class _Projected:
    """The Gaussians one camera can see, nearest first.

    Args:
        ids: their rows in the inputs, [M].
        means2d: centres in pixels, [M, 2].
        conics: upper triangle (xx, xy, yy) of the inverse 2D covariance, [M, 3].
        depths: z in the camera frame, [M].
        opacities: [M].
        colors: [M, 3].
        extent_px: half width and half height of the box outside which alpha is below 1/255, [M, 2].
    """

    ids: Tensor
    means2d: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor
    colors: Tensor
    extent_px: Tensor


def rasterize_reference(inputs: RasterInputs, options: RasterOptions) -> Rendering:
    """Render all cameras, one after the other."""
    views = [_render_view(inputs, options, camera) for camera in range(len(inputs.viewmats))]
    if not views:
        views = [_empty_view(inputs, options)]
        stacked = {key: torch.stack([v[key] for v in views])[:0] for key in views[0]}
        return Rendering(**_without_missing(stacked, inputs, options))
    stacked = {key: torch.stack([v[key] for v in views]) for key in views[0] if key != "hooks"}
    means2d = stacked.pop("means2d").detach()
    for camera, view in enumerate(views):
        _fill_gradients_on_backward(means2d, camera, *view["hooks"])
    return Rendering(means2d=means2d, **_without_missing(stacked, inputs, options))


def _without_missing(
    stacked: dict[str, Tensor], inputs: RasterInputs, options: RasterOptions
) -> dict[str, Any]:
    result: dict[str, Any] = dict(stacked)
    if not options.median_depth:
        result.pop("median_depth")
    if not options.visibility:
        result.pop("visibility_max")
        result.pop("visibility_sum")
    if inputs.query_points is None:
        result.pop("transmittance")
    return result


def _empty_view(inputs: RasterInputs, options: RasterOptions) -> dict[str, Tensor]:
    height, width, n = options.height, options.width, len(inputs.means)
    q = 0 if inputs.query_points is None else len(inputs.query_points)
    shapes: dict[str, tuple[int, ...]] = {
        "rgb": (height, width, 3),
        "alpha": (height, width),
        "depth": (height, width),
        "median_depth": (height, width),
        "means2d": (n, 2),
        "radius_px": (n,),
        "visibility_max": (n,),
        "visibility_sum": (n,),
        "transmittance": (q,),
    }
    return {name: inputs.means.new_zeros(shape) for name, shape in shapes.items()}


def _render_view(inputs: RasterInputs, options: RasterOptions, camera: int) -> dict[str, Any]:
    seen = _project(inputs, options, camera)
    height, width, n = options.height, options.width, len(inputs.means)
    absolute = inputs.means.new_zeros(n, 2)
    visibility_max, visibility_sum = inputs.means.new_zeros(2, n).unbind()
    rows = []
    for y0 in range(0, height, TILE_PX):
        tiles = []
        for x0 in range(0, width, TILE_PX):
            size = (min(TILE_PX, height - y0), min(TILE_PX, width - x0))
            touching = _touching(seen, x0, y0, size)
            pixels = _pixel_centres(x0, y0, size, inputs.means)
            step = max(1, ELEMENTS_PER_CHUNK // max(1, len(touching)))
            chunks = []
            for chunk in pixels.split(step):
                weights, final, front = _blend(seen, touching, chunk, absolute, options)
                chunks.append(_composite(seen, touching, weights, final, front))
                if options.visibility and len(touching):
                    ids = seen.ids[touching]
                    part = weights.detach()
                    if inputs.visibility_mask is not None:
                        column, row = chunk.detach().floor().long().unbind(-1)
                        part = part * inputs.visibility_mask[camera, row, column][:, None]
                    visibility_sum.index_add_(0, ids, part.sum(0))
                    best = torch.maximum(visibility_max[ids], part.amax(0))
                    visibility_max[ids] = best
            tiles.append(torch.cat(chunks).reshape(*size, 6))
        rows.append(torch.cat(tiles, 1))
    image = torch.cat(rows, 0)
    rgb, alpha = image[..., :3], image[..., 3]
    if inputs.background is not None:
        rgb = rgb + (1 - alpha)[..., None] * inputs.background[camera]
    means2d = inputs.means.new_zeros(n, 2).index_copy(0, seen.ids, seen.means2d)
    radius = seen.extent_px.detach().amax(1) if len(seen.ids) else seen.depths.detach()
    return {
        "rgb": rgb,
        "alpha": alpha,
        "depth": image[..., 4] / alpha.clamp_min(ALPHA_EPS),
        "median_depth": image[..., 5].detach(),
        "means2d": means2d,
        "radius_px": inputs.means.new_zeros(n).index_copy(0, seen.ids, radius),
        "visibility_max": visibility_max,
        "visibility_sum": visibility_sum,
        "transmittance": _query(inputs, options, camera, seen),
        "hooks": (seen.ids, seen.means2d, absolute if options.absgrad else None),
    }


def _project(inputs: RasterInputs, options: RasterOptions, camera: int) -> _Projected:
    """EWA projection, culling and depth sort."""
    rotation, translation = inputs.viewmats[camera, :3, :3], inputs.viewmats[camera, :3, 3]
    fx, fy = inputs.Ks[camera, 0, 0], inputs.Ks[camera, 1, 1]
    cx, cy = inputs.Ks[camera, 0, 2], inputs.Ks[camera, 1, 2]
    width, height, lens = options.width, options.height, options.lens
    z_all = (inputs.means @ rotation[2] + translation[2]).detach()
    ids = torch.nonzero((z_all >= options.near) & (inputs.opacities.detach() >= ALPHA_MIN))[:, 0]

    x, y, z = (inputs.means[ids] @ rotation.T + translation).unbind(-1)
    if lens is not None:
        seen = torch.nonzero(within_lens(x, y, z, lens))[:, 0]
        ids, x, y, z = ids[seen], x[seen], y[seen], z[seen]
        means2d, jacobian = project_through_lens(x, y, z, inputs.Ks[camera], lens)
    else:
        margin_x, margin_y = (
            FIELD_OF_VIEW_MARGIN * 0.5 * width / fx,
            FIELD_OF_VIEW_MARGIN * 0.5 * height / fy,
        )
        slope_x = torch.clamp(x / z, -(cx / fx + margin_x), (width - cx) / fx + margin_x)
        slope_y = torch.clamp(y / z, -(cy / fy + margin_y), (height - cy) / fy + margin_y)
        zero = torch.zeros_like(z)
        jacobian = torch.stack(
            [fx / z, zero, -fx * slope_x / z, zero, fy / z, -fy * slope_y / z], -1
        ).reshape(-1, 2, 3)
        means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    axes = rotation_matrices(inputs.quats[ids]) * inputs.scales[ids][:, None, :]
    half = jacobian @ rotation @ axes
    covariance = half @ half.transpose(1, 2)
    xx = covariance[:, 0, 0] + DILATION_PX2
    xy = covariance[:, 0, 1]
    yy = covariance[:, 1, 1] + DILATION_PX2
    determinant = xx * yy - xy * xy
    opacities = inputs.opacities[ids]

    reach = 2 * torch.log(opacities.detach() / ALPHA_MIN).clamp_min(0)
    extent = torch.sqrt(reach[:, None] * torch.stack([xx, yy], -1).detach())
    u, v = means2d.detach().unbind(-1)
    inside = (determinant.detach() > 0) & torch.isfinite(determinant.detach())
    inside &= (xx.detach() <= COVARIANCE_MAX_PX2) & (yy.detach() <= COVARIANCE_MAX_PX2)
    inside &= (u + extent[:, 0] > 0) & (u - extent[:, 0] < width)
    inside &= (v + extent[:, 1] > 0) & (v - extent[:, 1] < height)
    keep = torch.nonzero(inside)[:, 0]
    keep = keep[torch.sort(z.detach()[keep], stable=True).indices]

    conics = (torch.stack([yy, -xy, xx], -1) / determinant[:, None])[keep]
    return _Projected(
        ids=ids[keep],
        means2d=means2d[keep],
        conics=conics,
        depths=z[keep],
        opacities=opacities[keep],
        colors=camera_colors(inputs, options.sh_degree, camera, ids[keep]),
        extent_px=extent[keep],
    )


def camera_colors(inputs: RasterInputs, sh_degree: int, camera: int, ids: Tensor) -> Tensor:
    """Colours [M, 3] of the Gaussians `ids` in one camera, from `colors` or `sh`, and its light if any."""
    albedo = _albedo(inputs, sh_degree, camera, ids)
    if inputs.light is None:
        return albedo
    rotation, translation = inputs.viewmats[camera, :3, :3], inputs.viewmats[camera, :3, 3]
    points = inputs.means[ids] @ rotation.T + translation
    normals = shortest_axes(inputs.quats[ids], inputs.scales[ids]) @ rotation.T
    return lit_colors(albedo, points, normals, inputs.light[camera])


def _albedo(inputs: RasterInputs, sh_degree: int, camera: int, ids: Tensor) -> Tensor:
    if inputs.colors is not None:
        colors = inputs.colors if inputs.colors.ndim == 2 else inputs.colors[camera]
        return colors[ids]
    if inputs.sh is None:
        raise ShapeError("exactly one of sh and colors must be given")
    rotation, translation = inputs.viewmats[camera, :3, :3], inputs.viewmats[camera, :3, 3]
    # Inverse of a rigid motion; the gradient of the pose is that of this expression, also off SO(3).
    offset = inputs.means[ids] + rotation.T @ translation
    directions = offset / (offset.square().sum(-1, keepdim=True) + 1e-20).sqrt()
    basis = sh_basis(directions, sh_degree)
    return (torch.einsum("mk,mkc->mc", basis, inputs.sh[ids, : basis.shape[1]]) + 0.5).clamp_min(0)


def _pixel_centres(x0: int, y0: int, size: tuple[int, int], like: Tensor) -> Tensor:
    ys = torch.arange(size[0], dtype=like.dtype, device=like.device) + (y0 + 0.5)
    xs = torch.arange(size[1], dtype=like.dtype, device=like.device) + (x0 + 0.5)
    return torch.stack(torch.meshgrid(xs, ys, indexing="xy"), -1).reshape(-1, 2)


def _touching(seen: _Projected, x0: int, y0: int, size: tuple[int, int]) -> Tensor:
    """Indices (nearest first) of the Gaussians whose box reaches a tile."""
    u, v = seen.means2d.detach().unbind(-1)
    # Slightly larger than the box, so that rounding never drops a pixel with alpha of at least 1/255.
    ex, ey = (seen.extent_px * (1 + 1e-4) + 1e-3).unbind(-1)
    hit = (u + ex >= x0) & (u - ex <= x0 + size[1]) & (v + ey >= y0) & (v - ey <= y0 + size[0])
    return torch.nonzero(hit)[:, 0]


def _alphas(seen: _Projected, index: Tensor, pixels: Tensor, absolute: Tensor | None) -> Tensor:
    """Opacity of each Gaussian at each pixel after clip and cut, [P, M]."""
    centres = seen.means2d[index].expand(len(pixels), -1, 2)
    if absolute is not None and centres.requires_grad:
        ids = seen.ids[index]

        def add_absolute(gradient: Tensor | None) -> None:
            if gradient is None:
                return
            absolute.index_add_(0, ids, gradient.abs().sum(0))

        centres.register_hook(add_absolute)
    dx, dy = (centres - pixels[:, None, :]).unbind(-1)
    a, b, c = seen.conics[index].unbind(-1)
    power = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = (seen.opacities[index] * torch.exp(-power)).clamp_max(ALPHA_MAX)
    return torch.where((alpha >= ALPHA_MIN) & (power >= 0), alpha, torch.zeros_like(alpha))


def _blend(
    seen: _Projected, index: Tensor, pixels: Tensor, absolute: Tensor, options: RasterOptions
) -> tuple[Tensor, Tensor, Tensor]:
    """Blending weights [P, M], final transmittance [P], transmittance behind each Gaussian [P, M]."""
    alpha = _alphas(seen, index, pixels, absolute if options.absgrad else None)
    behind = torch.cumprod(1 - alpha, 1)
    # Transmittance is non-increasing, so this mask is a prefix of each pixel's list.
    alpha = torch.where(behind > TRANSMITTANCE_MIN, alpha, torch.zeros_like(alpha))
    behind = torch.cumprod(1 - alpha, 1)
    ones = torch.ones_like(behind[:, :1]) if behind.shape[1] else alpha.new_ones(len(pixels), 1)
    before = torch.cat([ones, behind], 1)
    return before[:, :-1] * alpha, before[:, -1], behind.detach()


def _composite(seen: _Projected, index: Tensor, weights: Tensor, final: Tensor, behind: Tensor) -> Tensor:
    """Colour, alpha, depth sum and median depth of the pixels, [P, 6]."""
    depths = seen.depths[index]
    median = torch.zeros_like(final)
    if len(index):
        half = behind <= 0.5
        first = half.to(torch.uint8).argmax(1)
        median = torch.where(half.any(1), depths.detach()[first], median)
    return torch.cat(
        [
            weights @ seen.colors[index],
            (1 - final)[:, None],
            (weights @ depths)[:, None],
            median[:, None],
        ],
        1,
    )


@torch.no_grad()
def _query(inputs: RasterInputs, options: RasterOptions, camera: int, seen: _Projected) -> Tensor:
    """Transmittance in front of the query points."""
    points = inputs.query_points
    if points is None:
        return inputs.means.new_zeros(0)
    viewmat, K = inputs.viewmats[camera], inputs.Ks[camera]
    x, y, z = (points @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(-1)
    ahead = z >= options.near
    safe = torch.where(ahead, z, torch.ones_like(z))
    if options.lens is None:
        column = torch.floor(K[0, 0] * x / safe + K[0, 2])
        row = torch.floor(K[1, 1] * y / safe + K[1, 2])
    else:
        ahead &= within_lens(x, y, safe, options.lens)
        here = torch.where(ahead, x, torch.zeros_like(x)), torch.where(ahead, y, torch.zeros_like(y))
        centres, _ = project_through_lens(*here, safe, K, options.lens)
        column, row = torch.floor(centres).unbind(-1)
    inside = ahead & (column >= 0) & (column < options.width)
    inside &= (row >= 0) & (row < options.height)
    result = torch.full_like(z, torch.nan)
    wanted = torch.nonzero(inside)[:, 0]
    pixels = torch.stack([column, row], -1)[wanted] + 0.5
    everything = torch.arange(len(seen.ids), device=z.device)
    step = max(1, ELEMENTS_PER_CHUNK // max(1, len(everything)))
    for part, centres in zip(wanted.split(step), pixels.split(step), strict=True):
        alpha = _alphas(seen, everything, centres, None)
        alpha = torch.where(seen.depths < z[part, None], alpha, torch.zeros_like(alpha))
        behind = torch.cumprod(1 - alpha, 1)
        alpha = torch.where(behind > TRANSMITTANCE_MIN, alpha, torch.zeros_like(alpha))
        result[part] = (1 - alpha).prod(1)
    return result


def _fill_gradients_on_backward(
    means2d: Tensor, camera: int, ids: Tensor, projected: Tensor, absolute: Tensor | None
) -> None:
    """Copy the gradients of one camera's centres to the tensor the user holds."""
    if not projected.requires_grad:
        return

    def fill(gradient: Tensor | None) -> None:
        # The hook gets None where the output does not depend on the tensor.
        if gradient is None:
            return
        if means2d.grad is None:
            means2d.grad = torch.zeros_like(means2d)
        means2d.grad[camera].index_add_(0, ids, gradient)
        if absolute is not None:
            if getattr(means2d, "absgrad", None) is None:
                means2d.absgrad = torch.zeros_like(means2d)  # type: ignore[attr-defined]
            means2d.absgrad[camera] = absolute  # type: ignore[attr-defined]

    projected.register_hook(fill)
