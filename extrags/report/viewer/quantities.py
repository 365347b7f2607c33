r"""What a run knows of each Gaussian: which training views see it, from how many sides, and how sure it is.

Images are carried to Gaussians with the weights the rasteriser blends them with: the gradient of
:math:`\sum_p m_p I_p` with respect to the colour of Gaussian j is :math:`\sum_p w_{jp} m_p`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float

from extrags.cameras import Cameras
from extrags.report.image_table import evenly_spaced
from extrags.report.viewer.encoding import Quantity
from extrags.scene import Scene
from extrags.shown_pixels import chosen_masks, shown_pixels

__all__ = ["SEEN_WEIGHT", "carried_to_gaussians", "scene_quantities", "training_coverage"]

SEEN_WEIGHT = 0.05
"""A view sees a Gaussian when it makes up this share of at least one of its pixels."""
DIRECTION_APART_DEG = 10.0
MOST_DIRECTIONS = 8
MOST_VIEWS = 60
"""Views drawn for one quantity, evenly spaced over all: it must not cost more than the page."""
LEAST_WEIGHT = 0.05
"""Summed weight below which virtual views say nothing of a Gaussian."""
ERROR_QUANTILE = 0.98


def training_coverage(
    scene: Scene, train: Cameras, masks: Sequence[Bool[np.ndarray, "h w"]] | None = None
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """How many of the training views see each Gaussian, and from how many directions.

    Directions are counted that are at least 10 degrees apart, in the order of the views, up to eight.

    Args:
        scene: the Gaussians.
        train: the training cameras; of more than 60, 60 evenly spaced ones.
        masks: their pixels that show tissue; None: all.
    """
    means = scene.gaussians.means.detach().numpy()
    n = len(means)
    views, number = np.zeros(n), np.zeros(n, dtype=np.int64)
    kept = np.zeros((n, MOST_DIRECTIONS, 3), dtype=np.float32)
    limit = np.cos(np.radians(DIRECTION_APART_DEG))
    for index in evenly_spaced(len(train), MOST_VIEWS):
        view = train[int(index)]
        shown = torch.from_numpy(shown_pixels(chosen_masks(masks, train, [int(index)]), view, view))
        with torch.no_grad():
            weight = scene.render(view, visibility=True, visibility_mask=shown).visibility_max
        if weight is None:
            raise AssertionError("visibility was asked for")
        seen = np.flatnonzero(weight[0].numpy() >= SEEN_WEIGHT)
        views[seen] += 1
        ray = means[seen] - train.centers[int(index)]
        ray = (ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)).astype(np.float32)
        alike = np.einsum("nkc,nc->nk", kept[seen], ray)
        used = np.arange(MOST_DIRECTIONS) < number[seen, None]
        fresh = ~((alike > limit) & used).any(1) & (number[seen] < MOST_DIRECTIONS)
        at = seen[fresh]
        kept[at, number[at]] = ray[fresh]
        number[at] += 1
    return views, number.astype(np.float64)


def carried_to_gaussians(
    scene: Scene, cameras: Cameras, maps: Float[np.ndarray, "v h w k"]
) -> Float[np.ndarray, "n k"]:
    """Mean of image values over the pixels of each Gaussian, by blending weight; NaN where hardly any.

    Args:
        scene: the Gaussians.
        cameras: views of the images.
        maps: up to two values per pixel.
    """
    n, channels = len(scene.gaussians), maps.shape[-1]
    sums = np.zeros((n, channels + 1))
    for view in evenly_spaced(len(cameras), MOST_VIEWS):
        values = torch.zeros(n, channels + 1, requires_grad=True)
        rendered, _ = scene.render_attributes(cameras[int(view)], values)
        image = np.concatenate([maps[view], np.ones_like(maps[view][..., :1])], axis=-1)
        (rendered[0] * torch.from_numpy(image.astype(np.float32))).sum().backward()
        if values.grad is not None:
            sums += values.grad.numpy()
    weight = sums[:, -1:]
    return np.where(weight >= LEAST_WEIGHT, sums[:, :-1] / np.maximum(weight, LEAST_WEIGHT), np.nan)


def scene_quantities(
    scene: Scene,
    train: Cameras,
    virtual: Cameras | None = None,
    uncertainty: Float[np.ndarray, "v h w"] | None = None,
    expected_error: Float[np.ndarray, "v h w"] | None = None,
    *,
    masks: Sequence[Bool[np.ndarray, "h w"]] | None = None,
) -> dict[str, Quantity]:
    """The quantities of a scene, as far as its run has what they come from.

    Args:
        scene: the Gaussians.
        train: training cameras.
        virtual: cameras of the virtual views.
        uncertainty: of their pixels, 0 known, 1 unknown.
        expected_error: of their restored colours.
        masks: pixels of the training views that show tissue (`EndoscopicSequence.training_masks`); None: all.
    """
    views, directions = training_coverage(scene.detached(), train, masks)
    seen = (views > 0).astype(np.float64)
    found = {
        "observed": Quantity(seen, 0, 1, "Observed or invented", ("no training view sees it", "observed")),
        "directions": Quantity(
            directions,
            0,
            MOST_DIRECTIONS,
            "Directions seen from",
            ("none", f"{MOST_DIRECTIONS} or more, {DIRECTION_APART_DEG:g}° apart"),
        ),
    }
    if virtual is None or not len(virtual):
        return found
    maps = {"uncertainty": uncertainty, "expected_error": expected_error}
    known = {name: values for name, values in maps.items() if values is not None}
    if known:
        chosen = evenly_spaced(len(virtual), MOST_VIEWS)
        stacked = np.stack([np.asarray(values[chosen], np.float32) for values in known.values()], axis=-1)
        carried = dict(zip(known, carried_to_gaussians(scene, virtual[chosen], stacked).T, strict=True))
        if "uncertainty" in carried:
            found["uncertainty"] = Quantity(
                carried["uncertainty"], 0, 1, "Uncertainty of virtual views", ("0 known", "1 unknown")
            )
        if "expected_error" in carried:
            values = carried["expected_error"]
            finite = values[np.isfinite(values)]
            high = max(float(np.quantile(finite, ERROR_QUANTILE)), 1e-3) if finite.size else 1.0
            found["expected_error"] = Quantity(
                values, 0, high, "Expected error of restored colours", ("0", f"{high:.3f} or more")
            )
    return found
