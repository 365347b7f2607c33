"""Whether views agree on what was invented, compared along the true surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from extrags.cameras import Cameras, pixel_rays
from extrags.metrics.filters import filter_separable, gaussian_weights

__all__ = ["Motion", "carried", "invented_inconsistency", "motion", "view_pairs"]

SAME_SURFACE = 0.03
"""Two frames show the same point where their true depths agree to this share."""
MAX_PAIRS_ACROSS = 400
"""Pairs of views of different clips that are compared, spread evenly over all."""
SMALLEST_SHARE = 0.005
"""Pairs that share less of the image than this are left out."""
LIGHT_SIGMA_PX, LIGHT_RADIUS_PX = 2.0, 6
"""The brightness of photographs is smoothed so much: noise and sensor highlights are not the light's."""
LIGHT_FLOOR = 0.02
"""Added to brightness before two of them are divided: in the dark the ratio would be noise."""
LARGEST_RATIO = 4.0


@dataclass(frozen=True)
class Motion:
    """Where the pixels of one view lie in another.

    Args:
        other: index of the other view.
        view: index of the view.
        grid: positions as `grid_sample` takes them, [1, H, W, 2].
        common: pixels that both views see, [H, W].
    """

    other: int
    view: int
    grid: Float[Tensor, "1 h w 2"]
    common: Bool[Tensor, "h w"]


def motion(
    cameras: Cameras,
    depth_mm: Float[np.ndarray, "v h w"],
    mask: Bool[np.ndarray, "v h w"],
    view: int,
    other: int,
) -> Motion:
    """The pixels of a view in another, by true depth.

    Args:
        cameras: of all views.
        depth_mm: true z-depth, 0 where unknown.
        mask: which pixels count.
        view: index of the view.
        other: index of the other view.
    """
    here, there = cameras[view], cameras[other]
    points = here.centers[0] + pixel_rays(here)[0] * depth_mm[view][..., None].astype(np.float64)
    (pixels,), (z,) = there.project(points)
    pixels = np.where(z[..., None] > 0, pixels, -1)
    u, v = pixels[..., 0], pixels[..., 1]
    width, height = cameras.width, cameras.height
    # Half a pixel inside the border: nothing is sampled from beyond it.
    inside = (u >= 0.5) & (u <= width - 0.5) & (v >= 0.5) & (v <= height - 0.5)
    row = np.clip(v, 0, height - 1).astype(np.int64)
    column = np.clip(u, 0, width - 1).astype(np.int64)
    seen = depth_mm[other][row, column]
    same = (seen > 0) & (depth_mm[view] > 0) & (np.abs(z - seen) < SAME_SURFACE * np.maximum(seen, 1e-9))
    common = inside & same & mask[view] & _all_four(mask[other], u, v)
    grid = np.stack([2 * u / width - 1, 2 * v / height - 1], axis=-1).clip(-4, 4).astype(np.float32)
    return Motion(other, view, torch.from_numpy(grid)[None], torch.from_numpy(common))


def _all_four(
    mask: Bool[np.ndarray, "h w"], u: Float[np.ndarray, "h w"], v: Float[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Whether all pixels count that an image is interpolated between, at positions with centres at +0.5."""
    height, width = mask.shape
    rows, columns = (
        [np.clip(np.floor(position - 0.5).astype(np.int64) + step, 0, size - 1) for step in (0, 1)]
        for position, size in ((v, height), (u, width))
    )
    return np.asarray(np.logical_and.reduce([mask[row, column] for row in rows for column in columns]))


def carried(image: Float[Tensor, "h w c"], grid: Float[Tensor, "1 h w 2"]) -> Float[Tensor, "h w c"]:
    """An image of the other view of a `Motion`, as seen from the view itself."""
    stack = image.permute(2, 0, 1)[None]
    return functional.grid_sample(stack, grid, padding_mode="border", align_corners=False)[0].permute(1, 2, 0)


def view_pairs(clip: Int[np.ndarray, "v"]) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Pairs of views within a clip, all of them, and across clips, at most so many.

    Args:
        clip: clip of each view.
    """
    count = len(clip)
    every = [(first, second) for first in range(count) for second in range(first + 1, count)]
    within = [pair for pair in every if clip[pair[0]] == clip[pair[1]]]
    across = [pair for pair in every if clip[pair[0]] != clip[pair[1]]]
    kept = np.unique(np.linspace(0, len(across) - 1, min(len(across), MAX_PAIRS_ACROSS)).round().astype(int))
    return within, [across[index] for index in kept]


def invented_inconsistency(
    images: Float[Tensor, "v h w 3"],
    photographs: Float[Tensor, "v h w 3"],
    motions: list[Motion],
) -> float | None:
    r"""Mean absolute difference of two views' colours at the same points of the true surface.

    A surface is brighter in the nearer view, and rightly so. What the other view shows is therefore
    multiplied by the ratio of the photographs' brightness at that point,

    .. math:: \bigl| r_j - W r_i \, \frac{\bar p_j + \epsilon}{W \bar p_i + \epsilon} \bigr|,

    with the smoothed brightness :math:`\bar p` and the warp W by true depth: no model of the light is needed,
    and images that are true but for one factor are consistent. Blurred images are, too: the figure says
    nothing of how good they are.

    Args:
        images: restored views.
        photographs: the true views.
        motions: pairs of views; `common` marks the pixels that count.

    Returns:
        The mean over all common pixels; None where there are none.
    """
    window = gaussian_weights(LIGHT_SIGMA_PX, LIGHT_RADIUS_PX)
    gray = filter_separable(photographs.mean(dim=-1)[:, None], window, window)
    brightness = gray.permute(0, 2, 3, 1).clamp_min(0) + LIGHT_FLOOR
    total, count = 0.0, 0
    for pair in motions:
        ratio = brightness[pair.view] / carried(brightness[pair.other], pair.grid)
        ratio = ratio.clamp(1 / LARGEST_RATIO, LARGEST_RATIO)
        difference = images[pair.view] - carried(images[pair.other], pair.grid) * ratio
        total += float(difference.abs()[pair.common].double().mean(dim=-1).sum())
        count += int(pair.common.sum())
    return total / count if count else None
