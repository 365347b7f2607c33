"""How much of a source's picture the pinhole of its lens leaves out, and what is said about it."""

from __future__ import annotations

import logging

import numpy as np
from jaxtyping import Bool, Float, UInt8

from data_catalog.content import content_circle, looked_at, view_mask
from data_catalog.sampling import OFF_CENTRE_SHARE, LensSampling
from extrags.lens import MUCH_LEFT_OUT, Lens, Undistortion, left_out_share

__all__ = ["LensUse", "left_out_share"]

logger = logging.getLogger(__name__)

_WIDTH = 320
"""Pictures are looked at in images that are no wider."""


class LensUse:
    """Looks at the frames of a sequence's first lens as they lie on disk, and tells when much of it is lost.

    What counts is the picture: where masks are true or, without any, what is not the dark frame round it.
    The corners of an endoscope's image are black, and no loss.

    Args:
        frames: number of frames that will be read.
    """

    def __init__(self, frames: int) -> None:
        self._looked_at = set(looked_at(frames).tolist())
        self._lens: Lens | None = None
        self._plan: Undistortion | None = None
        self._images: list[UInt8[np.ndarray, "h w 3"]] = []
        self._masks: list[Float[np.ndarray, "h w"]] = []

    def see(self, index: int, lens: object, sampling: object, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Take note of a frame.

        Args:
            index: of the frame, from 0; the first one tells which lens is looked at.
            lens: of the image.
            sampling: of the lens.
            image: as it lies on disk.
        """
        if index == 0 and isinstance(lens, Lens) and isinstance(sampling, LensSampling):
            self._lens, self._plan = lens, sampling.undistortion
        if self._counts(index, lens):
            self._images.append(np.asarray(_small(image)))

    def see_mask(self, index: int, lens: object, mask: Bool[np.ndarray, "h w"]) -> None:
        """Take note of a frame's mask, as it lies on disk."""
        if self._counts(index, lens):
            self._masks.append(np.asarray(_small(mask.astype(np.float32))))

    def tell(self) -> None:
        """Warn where the pinhole shows much less than the lens; `data check` makes a finding of it."""
        lens, plan = self._lens, self._plan
        if lens is None or plan is None:
            return
        pictures = self._masks or [_picture(np.stack(self._images)).astype(np.float32)]
        left_out = left_out_share(lens, plan, np.asarray(np.mean(pictures, axis=0)))
        if left_out <= MUCH_LEFT_OUT:
            return
        off_centre = np.abs(lens.K[:2, 2] / (lens.width, lens.height) - 0.5).max()
        reason = (
            "that is far from the centre: was the image cropped, or does the lens belong to another size?"
            if off_centre > OFF_CENTRE_SHARE
            else "the lens is wider than this; a larger ingest.field_of_view_deg shows more of it, and "
            "ingest.lens=native all"
        )
        logger.warning(
            "the pinhole leaves out %.0f %% of the picture in the source's images of %d x %d pixels, whose "
            "principal point is (%.1f, %.1f): %s",
            100 * left_out,
            lens.width,
            lens.height,
            lens.K[0, 2],
            lens.K[1, 2],
            reason,
            extra={"topic": "lens"},
        )

    def _counts(self, index: int, lens: object) -> bool:
        return self._plan is not None and index in self._looked_at and lens == self._lens


def _picture(rgb: UInt8[np.ndarray, "f h w 3"]) -> Bool[np.ndarray, "h w"]:
    """What is not the dark frame, where text does not matter."""
    circle = content_circle(rgb)
    return view_mask(rgb) if circle is None else circle.mask(rgb.shape[2], rgb.shape[1])


def _small(image: np.ndarray) -> np.ndarray:
    import cv2

    height, width = image.shape[:2]
    if width <= _WIDTH:
        return image
    size = (_WIDTH, max(1, round(_WIDTH * height / width)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
