"""Coverage map: from which directions each Gaussian was seen, packed into one word per Gaussian."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt32

from extrags.cameras import Cameras
from extrags.config import Visibility
from extrags.errors import ConfigError
from extrags.raster import Rendering
from extrags.scene import Scene

__all__ = [
    "count_pairs",
    "coverage_gain",
    "direction_bin",
    "direction_counts",
    "rendered_pairs",
    "training_coverage",
    "view_pairs",
]

MAX_DIRECTIONS = 32
VIEWS_PER_BATCH = 16
"""Views rendered in one call; bounds the memory, has no influence on the result."""


def direction_bin(unit: Float[np.ndarray, "*b 3"], n_directions: int) -> Int[np.ndarray, "*b"]:
    """Index of the equal-area cell of the sphere that holds each direction.

    The sphere is cut into two polar caps and collars of equal cells between them, all of exactly the
    same area, so that no direction is worth more than another.

    Args:
        unit: unit vectors.
        n_directions: D, the number of cells, 2 to 32.

    Returns:
        Indices in [0, D).

    Raises:
        ConfigError: when D is out of range.

    Source: Leopardi 2006, "A partition of the unit sphere into regions of equal area and small diameter".
    """
    z_edges, cells, first = _collars(n_directions)
    # z falls from collar to collar, searchsorted wants rising values.
    collar = np.searchsorted(-z_edges, -unit[..., 2], side="right")
    turn = np.arctan2(unit[..., 1], unit[..., 0]) / (2 * np.pi) % 1.0
    within = np.minimum((turn * cells[collar]).astype(np.int64), cells[collar] - 1)
    return np.asarray(first[collar] + within)


@lru_cache(maxsize=MAX_DIRECTIONS)
def _collars(n: int) -> tuple[Float[np.ndarray, "e"], Int[np.ndarray, "c"], Int[np.ndarray, "c"]]:
    """Heights z between collars from north to south, cells per collar, and index of their first cell."""
    if not 2 <= n <= MAX_DIRECTIONS:
        raise ConfigError(f"explore.directions must be 2 to {MAX_DIRECTIONS}, found {n}")
    cap = np.arccos(1 - 2 / n)
    n_collars = max(1, round((np.pi - 2 * cap) / np.sqrt(4 * np.pi / n))) if n > 2 else 0
    edges = cap + (np.pi - 2 * cap) * np.arange(n_collars + 1) / max(1, n_collars)
    # The ideal number of cells of a collar is not whole: what rounding leaves goes to the next one.
    ideal = n * (np.cos(edges[:-1]) - np.cos(edges[1:])) / 2
    total = np.round(np.cumsum(ideal)).astype(np.int64)
    cells = np.concatenate([[1], np.diff(total, prepend=0), [1]])
    below = np.cumsum(cells)
    z_edges = 1 - 2 * below[:-1] / n
    return z_edges, cells, below - cells


def view_pairs(
    scene: Scene,
    center: Float[np.ndarray, "3"],
    seen: Int[np.ndarray, "m"],
    n_directions: int,
) -> UInt32[np.ndarray, "m"]:
    """(Gaussian, direction) pairs that a view covers: a word with one bit for each Gaussian it sees.

    Args:
        scene: its Gaussians' centres give the directions.
        center: of the camera, in world units.
        seen: indices of the Gaussians the view sees.
        n_directions: D.

    Returns:
        Bit k of a word is set when the direction from its Gaussian to the camera lies in bin k.
    """
    means = scene.gaussians.means.detach().numpy()[seen].astype(np.float64)
    toward = center - means
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-12)
    return np.asarray(np.uint32(1) << direction_bin(toward, n_directions).astype(np.uint32))


def rendered_pairs(
    scene: Scene,
    cameras: Cameras,
    *,
    visible_weight: float,
    n_directions: int,
    visibility: Visibility = "blending",
    mask: Bool[np.ndarray, "c h w"] | None = None,
) -> tuple[Rendering, UInt32[np.ndarray, "c n"]]:
    """Render views in one batch; the images, and the pairs each view covers.

    Args:
        scene: the reconstructed scene.
        cameras: the views.
        visible_weight: of `blending`: the largest T * alpha above which a Gaussian is seen.
        n_directions: D.
        visibility: `blending`: a Gaussian counts as seen by its largest blending weight T * alpha, so that
            what lies behind a fold stays unseen although it is inside the frustum; `frustum`: by its
            footprint in the image, occluded or not, as the published code of [ExtraGS] and [Kim2025].
        mask: of `blending`: pixels that show what is seen; None is all.
    """
    # The diffuse colour is all the search looks at, and saves the harmonics of every Gaussian and view.
    blending = visibility == "blending"
    counted = torch.from_numpy(mask) if blending and mask is not None else None
    rendering = scene.render(cameras, visibility=blending, visibility_mask=counted, sh_degree=0)
    weight = rendering.visibility_max
    seen = rendering.visible if weight is None else weight > visible_weight
    pairs = np.zeros(tuple(seen.shape), dtype=np.uint32)
    for index, center in enumerate(cameras.centers):
        rows = np.flatnonzero(seen[index].numpy())
        pairs[index, rows] = view_pairs(scene, center, rows, n_directions)
    return rendering, pairs


def training_coverage(
    scene: Scene,
    cameras: Cameras,
    *,
    visible_weight: float,
    n_directions: int,
    visibility: Visibility = "blending",
    mask: Bool[np.ndarray, "c h w"] | None = None,
) -> UInt32[np.ndarray, "n"]:
    """Coverage by a set of views: M packed to one word per Gaussian.

    Args:
        scene: the reconstructed scene.
        cameras: the views, at the size they shall be rendered.
        visible_weight: the largest T * alpha above which a Gaussian is seen.
        n_directions: D.
        visibility: as `rendered_pairs`.
        mask: as `rendered_pairs`.
    """
    covered = np.zeros(len(scene.gaussians), dtype=np.uint32)
    with torch.no_grad():
        for start in range(0, len(cameras), VIEWS_PER_BATCH):
            batch = slice(start, start + VIEWS_PER_BATCH)
            _, pairs = rendered_pairs(
                scene,
                cameras[batch],
                visible_weight=visible_weight,
                n_directions=n_directions,
                visibility=visibility,
                mask=None if mask is None else mask[batch],
            )
            covered |= np.bitwise_or.reduce(pairs, axis=0)
    return covered


def count_pairs(pairs: UInt32[np.ndarray, "*b n"]) -> Int[np.ndarray, "*b"]:
    """Number of set bits, over the last axis."""
    return np.asarray(np.bitwise_count(pairs).sum(axis=-1, dtype=np.int64))


def coverage_gain(
    covered: UInt32[np.ndarray, "n"], pairs: UInt32[np.ndarray, "*b n"]
) -> Int[np.ndarray, "*b"]:
    r"""Newly covered pairs, :math:`IG_c = \sum_{j,k} \Delta M[j,k]` [ExtraGS, eq. 11]."""
    return count_pairs(pairs & ~covered)


def direction_counts(covered: UInt32[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """From how many direction bins each Gaussian was seen."""
    return np.asarray(np.bitwise_count(covered), dtype=np.int64)
