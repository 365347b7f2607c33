"""Which pixels of training views show tissue, at the size and through the lens that they are rendered with.

Most endoscopes show a round picture inside black. A scene can be rendered beyond its edge, but no frame has
seen anything there: what a rendering has there is held by other frames, or by nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool
from torch.nn import functional

from extrags.cameras import Cameras, pixel_rays, project_points
from extrags.errors import ShapeError

__all__ = ["chosen_masks", "shown_pixels"]

WHOLE = 0.999
"""Share of a small pixel's area from which it counts as wholly inside a mask; the rest is rounding."""


def shown_pixels(
    masks: Sequence[Bool[np.ndarray, "h w"]] | None, cameras: Cameras, views: Cameras
) -> Bool[np.ndarray, "c y x"]:
    """Pixels of views all of whose area shows tissue.

    Of a frame without such a pixel (a speckled mask, a small field) those that show some. Pinholes in place
    of a lens are looked up at the centres of their pixels.

    Args:
        masks: of the frames, at their size; None where all of their pixels show tissue.
        cameras: of the frames.
        views: the same views at another size, or as pinholes.

    Raises:
        ShapeError: when the numbers of masks, cameras and views, or the sizes of masks and cameras, differ.
    """
    if len(views) != len(cameras):
        raise ShapeError(f"{len(views)} views for {len(cameras)} cameras")
    if masks is not None:
        _check_count(len(masks), cameras)
    found = np.empty((len(views), views.height, views.width), dtype=bool)
    for index in range(len(views)):
        mask = None if masks is None else masks[index]
        if mask is not None and mask.shape != (cameras.height, cameras.width):
            raise ShapeError(
                f"mask {index} is {mask.shape[1]}x{mask.shape[0]}, "
                f"its camera {cameras.width}x{cameras.height}"
            )
        if views.lens == cameras.lens:
            found[index] = views[index].field[0] if mask is None else _wholly_inside(mask, views[index])
        else:
            found[index] = _at_centres(mask, cameras[index], views[index])
    return found


def chosen_masks(
    masks: Sequence[Bool[np.ndarray, "h w"]] | None, cameras: Cameras, index: Sequence[int] | np.ndarray
) -> list[Bool[np.ndarray, "h w"]] | None:
    """The masks of some of the views; None where all pixels of all views show tissue.

    Args:
        masks: of all views.
        cameras: all views.
        index: which of them.

    Raises:
        ShapeError: when there are not as many masks as cameras.
    """
    if masks is None:
        return None
    _check_count(len(masks), cameras)
    return [masks[int(view)] for view in index]


def _check_count(masks: int, cameras: Cameras) -> None:
    if masks != len(cameras):
        raise ShapeError(f"{masks} masks for {len(cameras)} cameras")


def _wholly_inside(mask: Bool[np.ndarray, "h w"], view: Cameras) -> Bool[np.ndarray, "y x"]:
    area = torch.from_numpy(mask).float()[None, None]
    share = functional.interpolate(area, (view.height, view.width), mode="area")[0, 0].numpy()
    whole = share > WHOLE
    return np.asarray((whole if whole.any() else share > 0) & view.field[0])


def _at_centres(
    mask: Bool[np.ndarray, "h w"] | None, camera: Cameras, view: Cameras
) -> Bool[np.ndarray, "y x"]:
    """Whether the centre of each pixel lies in the mask, seen through the other camera at the same place."""
    pixels = project_points(pixel_rays(view)[0], camera.K[0], camera.lens)
    inside = camera.contains(pixels)
    if mask is not None:
        column, row = pixels[inside].astype(np.int64).T
        inside[inside] = mask[row, column]
    return inside
