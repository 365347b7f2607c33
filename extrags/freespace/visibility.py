"""What training views see of points and voxels: transmittance, and a coarse-to-fine decision with it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8, UInt64

from extrags.cameras import Cameras
from extrags.config import FreespaceConfig
from extrags.events import Progress, emit
from extrags.freespace.grid import rotated
from extrags.radial_lens import WIDE_FIELD_DEG
from extrags.scene import NEAR, Scene
from extrags.shown_pixels import shown_pixels

__all__ = ["ViewDepths", "seen_through", "voxel_visibility"]

VIEWS_PER_BATCH = 8
"""Views rendered in one call; limits the memory, does not affect the result."""
MEDIAN = 0.5
"""Transmittance behind the median depth is at most this, before it more."""
REACH_PX = 32
"""Blocks whose image may be farther from its centre's are split without a test."""


@dataclass(frozen=True)
class ViewDepths:
    """Up to which z-depth each pixel of the views sees.

    Args:
        cameras: the views at the size rendered.
        depth: median depth, infinite where the transmittance stays above one half, -1 where the ray ends on
            no surface and where the view shows no tissue, float32, [C, H, W].
        near: points nearer than this z-depth are not observed: the near plane of the rendering.
    """

    cameras: Cameras
    depth: Float[np.ndarray, "c h w"]
    near: float = NEAR

    @classmethod
    def rendered(
        cls,
        scene: Scene,
        cameras: Cameras,
        config: FreespaceConfig,
        masks: Sequence[Bool[np.ndarray, "h w"]] | None = None,
    ) -> ViewDepths:
        """Render views at `render_width`, at most; of frames with a lens their wide pinholes.

        Args:
            scene: the reconstructed scene.
            cameras: the views.
            config: `render_width`, `min_alpha`.
            masks: pixels of each view that show tissue, at the size of `cameras`; None: all.
        """
        views = cameras.as_pinholes(WIDE_FIELD_DEG).at_most_width(config.render_width)
        shown = shown_pixels(masks, cameras, views)
        parts = []
        with torch.no_grad():
            for start in range(0, len(views), VIEWS_PER_BATCH):
                part = slice(start, start + VIEWS_PER_BATCH)
                batch = scene.render(views[part], sh_degree=0, median_depth=True)
                median = cast("torch.Tensor", batch.median_depth).numpy()
                depth = np.where(median > 0, median, np.float32(np.inf))
                observed = (batch.alpha.numpy() >= config.min_alpha) & shown[part]
                parts.append(np.where(observed, depth, np.float32(-1)))
                emit(Progress("freespace", min(start + VIEWS_PER_BATCH, len(views)), len(views)))
        return cls(views, np.concatenate(parts).astype(np.float32), scene.near)

    @property
    def unit_mm(self) -> float:
        """Median depth of all pixels that see a surface, 0 without any."""
        seen = self.depth[(self.depth > 0) & np.isfinite(self.depth)]
        return float(np.median(seen)) if seen.size else 0.0


@dataclass
class _Blocks:
    """Cubic blocks of voxels, and what is decided about each.

    Args:
        index: position in units of blocks, [N, 3].
        open: one bit per view that has not decided, [N].
        seeing: views that see all of the block, [N].
        doubted: whether some view may observe a part of it without seeing through to it, [N].
    """

    index: Int[np.ndarray, "n 3"]
    open: UInt64[np.ndarray, "n"]
    seeing: UInt8[np.ndarray, "n"]
    doubted: Bool[np.ndarray, "n"]

    def chosen(self, keep: Bool[np.ndarray, "n"]) -> _Blocks:
        return _Blocks(self.index[keep], self.open[keep], self.seeing[keep], self.doubted[keep])

    def split(self) -> _Blocks:
        """Eight of half the size for each."""
        eighth = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
        index = (2 * self.index[:, None] + eighth).reshape(-1, 3)
        rest = (np.repeat(part, 8) for part in (self.open, self.seeing, self.doubted))
        return _Blocks(index, *rest)


def seen_through(
    scene: Scene,
    views: ViewDepths,
    origin_mm: Float[np.ndarray, "3"],
    axes: Float[np.ndarray, "3 3"],
    voxel_mm: float,
    within: Bool[np.ndarray, "s s s"],
    config: FreespaceConfig,
) -> Bool[np.ndarray, "s s s"]:
    """Voxels whose visibility is `occupied_below` or more: as `voxel_visibility` at all centres says.

    Blocks of voxels are decided at once where the bounds of the median depth over the block's image allow:
    before the least a view sees through to all of it, behind the largest to none. Others are split. What
    views disagree on, down to single voxels, takes its transmittances from the rasteriser.

    Args:
        scene: the reconstructed scene.
        views: their depths; 64 views at most.
        origin_mm: corner of the grid.
        axes: of the grid.
        voxel_mm: edge of a voxel.
        within: voxels to decide; others come out false.
        config: `top_views`, `occupied_below`, `render_width`, `min_alpha`.
    """
    size = len(within)
    result = np.zeros(within.shape, dtype=bool)
    undecided = np.zeros(within.shape, dtype=bool)
    edge = 16 if size >= 128 else 8
    start = np.argwhere(_any_within(within, edge))
    n, bits = len(start), np.uint64((1 << len(views.cameras)) - 1)
    blocks = _Blocks(start, np.full(n, bits), np.zeros(n, np.uint8), np.zeros(n, bool))
    while True:
        _look(blocks, views, origin_mm, axes, voxel_mm, edge, config.top_views)
        enough = blocks.seeing >= config.top_views
        agreed = enough | ((blocks.open == 0) & (blocks.seeing > 0) & ~blocks.doubted)
        blind = (blocks.open == 0) & (blocks.seeing == 0)
        settled = enough | (blocks.open == 0)
        # One half decides for any threshold on one side of it alone.
        free = agreed if config.occupied_below <= MEDIAN else np.zeros_like(agreed)
        hidden = blind if config.occupied_below >= MEDIAN else blind & ~blocks.doubted
        _fill(result, blocks.index[free], edge)
        _fill(undecided, blocks.index[settled & ~free & ~hidden], edge)
        blocks = blocks.chosen(~settled)
        if edge == 1 or not len(blocks.index):
            break
        edge //= 2
        blocks = blocks.split()
        blocks = blocks.chosen(_any_within(within, edge)[_clipped(blocks.index, size, edge)])
    undecided &= within
    if undecided.any():
        points = origin_mm + rotated((np.argwhere(undecided) + 0.5) * voxel_mm, axes.T)
        visibility = voxel_visibility(scene, views.cameras, points, config, observing=views.depth >= 0)
        result[undecided] = visibility >= config.occupied_below
    return np.asarray(result & within)


def _any_within(within: Bool[np.ndarray, "s s s"], edge: int) -> Bool[np.ndarray, "b b b"]:
    """Whether a block holds any voxel to decide."""
    if edge == 1:
        return within
    padded = np.pad(within, (0, -len(within) % edge))
    n = len(padded) // edge
    return np.asarray(padded.reshape(n, edge, n, edge, n, edge).any(axis=(1, 3, 5)))


def _clipped(index: Int[np.ndarray, "n 3"], size: int, edge: int) -> tuple[Int[np.ndarray, "n"], ...]:
    # Halves of a block that reaches beyond the grid lie wholly beyond it: they repeat the last one.
    return tuple(np.minimum(index, -(-size // edge) - 1).T)


def _fill(marked: Bool[np.ndarray, "s s s"], index: Int[np.ndarray, "n 3"], edge: int) -> None:
    within = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    voxels = (index[:, None] * edge + within).reshape(-1, 3)
    voxels = voxels[(voxels < len(marked)).all(axis=1)]
    marked[tuple(voxels.T)] = True


def _look(
    blocks: _Blocks,
    views: ViewDepths,
    origin_mm: Float[np.ndarray, "3"],
    axes: Float[np.ndarray, "3 3"],
    voxel_mm: float,
    edge: int,
    top_views: int,
) -> None:
    """Let each view decide what it can of the blocks, given `edge` voxels wide."""
    centers = origin_mm + rotated((blocks.index + 0.5) * (edge * voxel_mm), axes.T)
    # Only the voxels' centres count, and they fill a cube that is one voxel smaller.
    radius = 0.5 * np.sqrt(3) * (edge - 1) * voxel_mm
    viewmats = views.cameras.viewmats
    for view in range(len(views.cameras)):
        bit = np.uint64(1 << view)
        asked = np.flatnonzero((blocks.open & bit != 0) & (blocks.seeing < top_views))
        x, y, z = (rotated(centers[asked], viewmats[view, :3, :3]) + viewmats[view, :3, 3]).T
        nearest, farthest = z - radius, z + radius
        tested = (nearest > views.near) if edge > 1 else (z >= views.near)
        with np.errstate(divide="ignore", invalid="ignore"):
            K = views.cameras.K[view]
            u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
            slant = np.sqrt(1 + np.maximum((x / z) ** 2, (y / z) ** 2))
            reach = max(K[0, 0], K[1, 1]) * radius * slant / nearest
        tested &= reach <= REACH_PX
        behind = farthest < views.near
        least, largest = np.full(len(asked), -1, np.float32), np.full(len(asked), -1, np.float32)
        for window, (low, high) in _bounds(views.depth[view], reach[tested].max(initial=0)):
            fits = tested & (reach <= window) & ((reach > window // 2) | (window == 0))
            column = np.clip(np.floor(u[fits]), -REACH_PX - 1, views.cameras.width + REACH_PX)
            row = np.clip(np.floor(v[fits]), -REACH_PX - 1, views.cameras.height + REACH_PX)
            at = (row.astype(np.int64) + REACH_PX + 1, column.astype(np.int64) + REACH_PX + 1)
            least[fits], largest[fits] = low[at], high[at]
        sees = tested & (farthest.astype(np.float32) <= least)
        misses = behind | (tested & (nearest.astype(np.float32) > largest))
        blocks.seeing[asked[sees]] += 1
        blocks.doubted[asked[misses & (largest >= 0)]] = True
        blocks.open[asked[sees | misses]] &= ~bit


def _bounds(
    depth: Float[np.ndarray, "h w"], reach: float
) -> Iterator[tuple[int, tuple[Float[np.ndarray, "p q"], Float[np.ndarray, "p q"]]]]:
    """Least and largest depth within 0, 1, 2, 4, ... pixels, with a margin of pixels that see nothing."""
    low = high = np.pad(depth, REACH_PX + 1, constant_values=-1)
    yield 0, (low, high)
    window, step = 1, 1
    while window // 2 < reach and window <= REACH_PX:
        for axis in (0, 1):
            low, high = _spread(low, step, axis, np.minimum), _spread(high, step, axis, np.maximum)
        yield window, (low, high)
        step, window = window, 2 * window


def _spread(
    image: Float[np.ndarray, "p q"], step: int, axis: int, least: np.ufunc
) -> Float[np.ndarray, "p q"]:
    image = np.moveaxis(image, axis, 0)
    spread = image.copy()
    least(spread[step:], image[:-step], out=spread[step:])
    least(spread[:-step], image[step:], out=spread[:-step])
    return np.moveaxis(spread, 0, axis)


def voxel_visibility(
    scene: Scene,
    cameras: Cameras,
    points: Float[np.ndarray, "q 3"],
    config: FreespaceConfig,
    *,
    observing: Bool[np.ndarray, "c h w"] | None = None,
) -> Float[np.ndarray, "q"]:
    """Mean of the `top_views` largest transmittances between each point and the views.

    Args:
        scene: the reconstructed scene.
        cameras: the views.
        points: world positions.
        config: `top_views`, `min_alpha`, `render_width`.
        observing: pixels, at `render_width`, whose rays end on a surface that the view shows; None: those
            with `min_alpha`.

    Returns:
        A value in [0, 1]; NaN where no view observes the point. With fewer than `top_views` such views the
        mean is over those there are, so that the ends of a recording do not count as occupied.
    """
    cameras = cameras.at_most_width(config.render_width)
    # Running top-k over the views; -1 marks ranks that no view fills.
    best = np.full((config.top_views, len(points)), -1.0, dtype=np.float32)
    with torch.no_grad():
        for index in range(len(cameras)):
            view = cameras[index]
            (pixels,), _ = view.project(points)
            inside = view.contains(pixels)
            column, row = pixels[inside].astype(np.int64).T
            queries = torch.from_numpy(points[inside].astype(np.float32))
            rendering = scene.render(view, sh_degree=0, query_points=queries)
            transmittance = cast("torch.Tensor", rendering.transmittance)[0].numpy()
            seen = rendering.alpha[0].numpy() >= config.min_alpha if observing is None else observing[index]
            ends = seen[row, column]
            value = np.full(len(points), -1.0, dtype=np.float32)
            value[inside] = np.where(np.isfinite(transmittance) & ends, transmittance, -1.0)
            for rank in range(config.top_views):
                smaller = np.minimum(best[rank], value)
                best[rank] = np.maximum(best[rank], value)
                value = smaller
    count = (best >= 0).sum(axis=0)
    total = np.where(best >= 0, best, 0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
