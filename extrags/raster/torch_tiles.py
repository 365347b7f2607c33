"""A fast tile-based rasteriser in plain torch: the baseline that the native kernels are compared with.

It is used by the benchmarks only, as the peer `torch`. Each tile of 8 x 8 pixels has a list of the Gaussians
whose ellipse overlaps it, nearest first. The lists of all tiles are composited together, one layer of entries
at a time, so that the work consists of a few large tensor operations, differentiated by autograd; tiles whose
pixels are all opaque are dropped. Two formulations make it fast: the exponents of all pixels of a tile are a
matrix product with the six monomials of the pixel position, and the transmittance is the exponential of a
cumulative sum of logarithms, a product with a triangular matrix.

In float64 it is an independent second implementation of the specification, in bounded memory:
`tile_gradients` composites and differentiates some tiles at a time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import threshold

from extrags.raster.loss import SSIM_C1, SSIM_C2, window_means
from extrags.raster.rendering import (
    ALPHA_EPS,
    ALPHA_MAX,
    ALPHA_MIN,
    COVARIANCE_MAX_PX2,
    DILATION_PX2,
    FIELD_OF_VIEW_MARGIN,
    TRANSMITTANCE_MIN,
)
from extrags.raster.rotations import rotation_matrices
from extrags.raster.spherical_harmonics import sh_basis

__all__ = ["TileImages", "l1_ssim_loss_torch", "rasterize_tiles", "tile_gradients"]

TILE_PX = 8
PIXELS = TILE_PX * TILE_PX

ENTRIES_PER_LAYER = 64
"""Entries of each tile's list composited at once."""

ELEMENTS_PER_BATCH = 1 << 17
"""Pixel-Gaussian pairs composited at once: as many as fit into the L2 cache with their gradients."""

TILES_PER_PART = 128
"""Tiles that `tile_gradients` differentiates at once."""

DSSIM_WEIGHT = 0.2

RECORD_SIZE = 10
"""Numbers per Gaussian and tile: centre 2, conic 3, log opacity, colour 3, depth."""

LOG_ZERO = -1e4
"""Stands for the logarithm of zero: opacity of padding entries, transmittance of finished pixels."""

MIN_LOG_ALPHA = -20.0
"""Lower bound of log alpha; well below the threshold at which contributions are dropped."""

LOG_TRANSMITTANCE_MIN = math.log(TRANSMITTANCE_MIN)


@dataclass(frozen=True)
class TileImages:
    """Images of one camera.

    Args:
        rgb: colour on black, [H, W, 3].
        alpha: opacity, [H, W].
        depth: expected z-depth, [H, W].
    """

    rgb: Float[Tensor, "h w 3"]
    alpha: Float[Tensor, "h w"]
    depth: Float[Tensor, "h w"]


@dataclass(frozen=True)
class _Lists:
    """The Gaussians of each tile, nearest first.

    Args:
        ids: rows of the records, tile after tile, [E]; the last entry stands for padding.
        starts: where each tile's list begins, [T].
        lengths: of the lists, [T].
    """

    ids: Int[Tensor, "e"]
    starts: Int[Tensor, "t"]
    lengths: Int[Tensor, "t"]


def rasterize_tiles(
    scene: Mapping[str, Tensor], width: int, height: int, *, near: float = 0.01
) -> TileImages:
    """Render one camera; differentiable by autograd in everything but `K`.

    Args:
        scene: `means` [N, 3], `quats` [N, 4], `scales` [N, 3], `opacities` [N], `sh` [N, K, 3], `viewmats`
            [1, 4, 4] and `Ks` [1, 3, 3] as `rasterize` takes them, any floating dtype.
        width: in pixels.
        height: in pixels.
        near: Gaussians nearer than this z-depth are culled.
    """
    records, extent = _records(scene, width, height, near)
    lists = _lists(records.detach(), extent, width, height)
    return _images(_blended(records, lists, torch.arange(len(lists.lengths)), width), width, height)


def tile_gradients(
    scene: Mapping[str, Tensor],
    width: int,
    height: int,
    cotangents: TileImages,
    *,
    near: float = 0.01,
) -> tuple[TileImages, dict[str, Tensor]]:
    """Images, and the gradients of sum(images * cotangents), a batch of tiles at a time.

    The graph of a batch is freed before the next is composited, so that the memory does not grow with the
    image; the result is that of `rasterize_tiles` and `backward`.

    Args:
        scene: as `rasterize_tiles` takes it.
        width: in pixels.
        height: in pixels.
        cotangents: weight of every number of the images.
        near: as for `rasterize_tiles`.

    Returns:
        The images, and the gradients of means, quats, scales, opacities and sh by name.
    """
    names = ("means", "quats", "scales", "opacities", "sh")
    leaves = {name: scene[name].detach().clone().requires_grad_() for name in names}
    records, extent = _records({**scene, **leaves}, width, height, near)
    lists = _lists(records.detach(), extent, width, height)
    leaf = records.detach().requires_grad_()
    gradient = torch.zeros_like(leaf)
    weights = _tiled(cotangents, width, height)
    blended = []
    for tiles in torch.arange(len(lists.lengths)).split(TILES_PER_PART):
        found = _blended(leaf, lists, tiles, width)
        (part,) = torch.autograd.grad((_expected_depth(found) * weights[tiles]).sum(), leaf)
        gradient += part
        blended.append(found.detach())
    records.backward(gradient)
    images = _images(torch.cat(blended), width, height)
    return images, {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


def _records(
    scene: Mapping[str, Tensor], width: int, height: int, near: float
) -> tuple[Float[Tensor, "n 10"], Float[Tensor, "n 2"]]:
    """EWA projection and colours of all Gaussians, and half sizes of their boxes; 0 where culled."""
    rotation, translation = scene["viewmats"][0, :3, :3], scene["viewmats"][0, :3, 3]
    K = scene["Ks"][0]
    (fx, cx), (fy, cy) = (K[0, 0], K[0, 2]), (K[1, 1], K[1, 2])
    x, y, z_all = (scene["means"] @ rotation.T + translation).unbind(-1)
    opacities = scene["opacities"]
    ahead = (z_all >= near) & (opacities >= ALPHA_MIN)
    z = torch.where(ahead, z_all, torch.ones_like(z_all))
    margin_x, margin_y = FIELD_OF_VIEW_MARGIN * 0.5 * width / fx, FIELD_OF_VIEW_MARGIN * 0.5 * height / fy
    slope_x = torch.clamp(x / z, -(cx / fx + margin_x), (width - cx) / fx + margin_x)
    slope_y = torch.clamp(y / z, -(cy / fy + margin_y), (height - cy) / fy + margin_y)
    over_z = 1 / z[:, None]
    across = torch.stack(
        [
            fx * over_z * (rotation[0] - slope_x[:, None] * rotation[2]),
            fy * over_z * (rotation[1] - slope_y[:, None] * rotation[2]),
        ],
        1,
    )
    axes = rotation_matrices(scene["quats"]) * scene["scales"][:, None, :]
    half_x, half_y = (across @ axes).unbind(1)
    xx = half_x.square().sum(-1) + DILATION_PX2
    yy = half_y.square().sum(-1) + DILATION_PX2
    xy = (half_x * half_y).sum(-1)
    determinant = xx * yy - xy * xy
    safe = torch.where(determinant > 0, determinant, torch.ones_like(determinant))
    u, v = fx * x / z + cx, fy * y / z + cy
    columns = [u, v, yy / safe, -xy / safe, xx / safe, opacities.clamp_min(ALPHA_MIN).log()]
    offset = scene["means"] + rotation.T @ translation
    directions = offset / (offset.square().sum(-1, keepdim=True) + 1e-20).sqrt()
    basis = sh_basis(directions, math.isqrt(scene["sh"].shape[1]) - 1)
    colors = (torch.einsum("nk,nkc->nc", basis, scene["sh"]) + 0.5).clamp_min(0)
    records = torch.cat([torch.stack(columns, -1), colors, z[:, None]], 1)
    with torch.no_grad():
        reach = 2 * torch.log(opacities / ALPHA_MIN).clamp_min(0)
        extent = torch.sqrt(reach[:, None] * torch.stack([xx, yy], -1))
        # Slightly larger, so that rounding never drops a pixel with alpha of at least 1/255.
        kept = ahead & (determinant > 0) & (xx <= COVARIANCE_MAX_PX2) & (yy <= COVARIANCE_MAX_PX2)
        extent = (extent * (1 + 1e-4) + 1e-3) * kept[:, None]
    return records, extent


def _lists(records: Tensor, extent: Tensor, width: int, height: int) -> _Lists:
    """Sort by depth, spread over the tiles of each box, drop tiles the ellipse misses, sort by tile."""
    columns, rows = -(-width // TILE_PX), -(-height // TILE_PX)
    low = ((records[:, :2] - extent) / TILE_PX).floor()
    high = ((records[:, :2] + extent) / TILE_PX).floor() + 1
    edges = records.new_tensor([columns, rows])
    low = torch.minimum(low.clamp_min(0), edges).long()
    high = torch.minimum(high.clamp_min(0), edges).long()
    span = (high - low).clamp_min(0) * (extent > 0)
    order = torch.sort(records[:, 9], stable=True).indices
    counts = (span[:, 0] * span[:, 1])[order]
    ids = torch.repeat_interleave(order, counts)
    place = torch.arange(len(ids)) - torch.repeat_interleave(counts.cumsum(0) - counts, counts)
    wide = span[ids, 0]
    tile_x, tile_y = low[ids, 0] + place % wide.clamp_min(1), low[ids, 1] + place // wide.clamp_min(1)
    reached = _ellipse_meets_tile(records[ids], tile_x, tile_y)
    ids, tile = ids[reached], (tile_y * columns + tile_x)[reached]
    ids = ids[torch.sort(tile.to(torch.int32), stable=True).indices]
    lengths = torch.bincount(tile, minlength=columns * rows)
    padding = ids.new_tensor([len(records)])
    return _Lists(torch.cat([ids, padding]), lengths.cumsum(0) - lengths, lengths)


def _ellipse_meets_tile(records: Tensor, tile_x: Tensor, tile_y: Tensor) -> Tensor:
    """Whether the ellipse with alpha of at least 1/255 overlaps the rectangle of a tile's pixel centres."""
    left, top = tile_x * TILE_PX + 0.5, tile_y * TILE_PX + 0.5
    u, v, a, b, c, log_opacity = records[:, :6].unbind(-1)
    right, bottom = left + (TILE_PX - 1), top + (TILE_PX - 1)
    near_x, near_y = u.clamp(left, right), v.clamp(top, bottom)
    # A convex quadratic has its minimum over a rectangle on the sides facing its centre, or at the centre.
    on_x = (v - b / c * (near_x - u)).clamp(top, bottom)
    on_y = (u - b / a * (near_y - v)).clamp(left, right)

    def power(x: Tensor, y: Tensor) -> Tensor:
        dx, dy = x - u, y - v
        return 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy

    least = torch.minimum(power(near_x, on_x), power(on_y, near_y))
    return least <= (log_opacity - math.log(ALPHA_MIN)) * (1 + 1e-4) + 1e-3


def _blended(
    records: Float[Tensor, "n 10"], lists: _Lists, tiles: Int[Tensor, "t"], width: int
) -> Float[Tensor, "t 64 5"]:
    """Colour, depth sum and alpha of all pixels of some tiles."""
    padding = records.new_zeros(1, RECORD_SIZE)
    padding[0, 5] = LOG_ZERO
    records = torch.cat([records, padding])
    result = records.new_zeros(len(tiles), PIXELS, 5) + 0 * records[:1, :1]
    passed = records.new_zeros(len(tiles), PIXELS)
    for first in range(0, int(lists.lengths[tiles].max()), ENTRIES_PER_LAYER):
        left = (lists.lengths[tiles] - first).clamp_max(ENTRIES_PER_LAYER)
        left = left * (passed.detach().amax(1) > LOG_TRANSMITTANCE_MIN)
        active = torch.sort(left, stable=True).indices[int((left <= 0).sum()) :]
        if len(active) == 0:
            break
        batches = list(_batches(active, left[active]))
        entries = [_entries(lists, tiles[chosen], first, longest) for chosen, longest in batches]
        # One gather for all batches: its gradient is one scatter, not many over all Gaussians.
        gathered = records.index_select(0, torch.cat([rows.reshape(-1) for rows in entries]))
        parts = gathered.split([rows.numel() for rows in entries])
        found = [
            _composite(part.reshape(*rows.shape, RECORD_SIZE), tiles[chosen], passed[chosen], width)
            for part, rows, (chosen, _) in zip(parts, entries, batches, strict=True)
        ]
        result = result.index_add(0, active, torch.cat([colors for colors, _ in found]))
        passed = passed.index_copy(0, active, torch.cat([behind for _, behind in found]))
    return result


def _batches(active: Tensor, left: Tensor) -> Iterator[tuple[Tensor, int]]:
    """Tiles of similar numbers of entries, as many as `ELEMENTS_PER_BATCH` allows, and the largest number."""
    lengths, start = left.tolist(), 0
    while start < len(active):
        end = min(len(active), start + max(1, ELEMENTS_PER_BATCH // (PIXELS * lengths[start])))
        while end > start + 1 and (end - start) * PIXELS * lengths[end - 1] > ELEMENTS_PER_BATCH:
            end = start + max(1, ELEMENTS_PER_BATCH // (PIXELS * lengths[end - 1]))
        yield active[start:end], lengths[end - 1]
        start = end


def _entries(lists: _Lists, tiles: Tensor, first: int, longest: int) -> Int[Tensor, "b k"]:
    """Rows of the records of a layer of some tiles' lists, padded."""
    place = first + torch.arange(longest)
    index = lists.starts[tiles, None] + place
    inside = place < lists.lengths[tiles, None]
    return lists.ids[torch.where(inside, index, torch.full_like(index, len(lists.ids) - 1))]


def _composite(
    entries: Float[Tensor, "b k 10"], tiles: Int[Tensor, "b"], passed: Float[Tensor, "b 64"], width: int
) -> tuple[Float[Tensor, "b 64 5"], Float[Tensor, "b 64"]]:
    """Contribution of a layer to colour, depth sum and alpha, and the log transmittance behind it."""
    columns = -(-width // TILE_PX)
    centre = torch.stack([tiles % columns, tiles // columns], -1).to(entries.dtype) * TILE_PX + TILE_PX / 2
    dx, dy = (entries[..., :2] - centre[:, None]).unbind(-1)
    a, b, c, log_opacity = entries[..., 2:6].unbind(-1)
    coefficients = torch.stack(
        [
            log_opacity - 0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy,
            a * dx + b * dy,
            b * dx + c * dy,
            -0.5 * a,
            -b,
            -0.5 * c,
        ],
        -1,
    )
    # Also bounded below: smaller exponentials are denormal, and slow.
    log_alpha = (coefficients @ _monomials(entries)).clamp(MIN_LOG_ALPHA, math.log(ALPHA_MAX))
    alpha = threshold(log_alpha.exp(), ALPHA_MIN, 0.0)
    log_pass = torch.log1p(-alpha)
    triangle = alpha.new_ones(alpha.shape[1], alpha.shape[1]).tril()
    behind = torch.baddbmm(passed[:, None].expand_as(alpha), triangle.expand(len(alpha), -1, -1), log_pass)
    weights = torch.exp(threshold(behind, LOG_TRANSMITTANCE_MIN, LOG_ZERO) - log_pass) * alpha
    features = torch.cat([entries[..., 6:], torch.ones_like(entries[..., :1])], -1)
    return weights.transpose(1, 2) @ features, behind[:, -1]


def _monomials(like: Tensor) -> Float[Tensor, "6 64"]:
    """1, x, y, x^2, xy, y^2 of the pixel centres relative to the centre of a tile."""
    line = torch.arange(TILE_PX, dtype=like.dtype) + 0.5 - TILE_PX / 2
    y, x = (axis.reshape(-1) for axis in torch.meshgrid(line, line, indexing="ij"))
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])


def _expected_depth(blended: Tensor) -> Tensor:
    """Colour, alpha, expected depth from colour, depth sum, alpha."""
    rgb, depth, alpha = blended.split((3, 1, 1), -1)
    return torch.cat([rgb, alpha, depth / alpha.clamp_min(ALPHA_EPS)], -1)


def _images(blended: Tensor, width: int, height: int) -> TileImages:
    columns, rows = -(-width // TILE_PX), -(-height // TILE_PX)
    image = _expected_depth(blended).reshape(rows, columns, TILE_PX, TILE_PX, 5)
    image = image.transpose(1, 2).reshape(rows * TILE_PX, columns * TILE_PX, 5)[:height, :width]
    return TileImages(image[..., :3], image[..., 3], image[..., 4])


def _tiled(images: TileImages, width: int, height: int) -> Float[Tensor, "t 64 5"]:
    """Inverse of `_images`, for images that may end inside a tile; padded with zeros."""
    columns, rows = -(-width // TILE_PX), -(-height // TILE_PX)
    stacked = torch.cat([images.rgb, images.alpha[..., None], images.depth[..., None]], -1)
    whole = stacked.new_zeros(rows * TILE_PX, columns * TILE_PX, 5)
    whole[:height, :width] = stacked
    return whole.reshape(rows, TILE_PX, columns, TILE_PX, 5).transpose(1, 2).reshape(-1, PIXELS, 5)


def l1_ssim_loss_torch(image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """0.8 L1 + 0.1 (1 - SSIM), equal to `l1_ssim_loss`, with as few passes over the images as possible."""
    x, y = image.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None]
    mean_x, mean_y, square_x, square_y, product = window_means(x, y)
    both, each = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    ssim = (2 * both + SSIM_C1) / (each + SSIM_C1)
    ssim = ssim * (2 * (product - both) + SSIM_C2) / (square_x + square_y - each + SSIM_C2)
    loss: Tensor = (1 - DSSIM_WEIGHT) * (x - y).abs().mean() + DSSIM_WEIGHT * (1 - ssim).mean() / 2
    return loss
