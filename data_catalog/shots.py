"""Cuts in a recording: from where on it shows another place.

Two neighbouring frames belong together when enough of the picture can be followed from one into the other: a
dense optical flow forth and one back agree, and what was followed looks alike. A quick move passes this test,
a cut does not. What interrupts a shot for a few frames (a flash, a drop, damaged data) does not end it:
frames that come after are compared with the last one before.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from extrags.dense_flow import DenseFlow

__all__ = ["ShotFinder", "followed_share", "show_the_same"]

_SURELY_ALIKE = 0.9
"""Neighbours that correlate so well, unmoved, need no flow to tell that they belong together; across cuts
between operations 0.74 was the most."""
_FOLLOWED = 0.25
"""Of frames of different operations 0.2 was the most that could be followed (630 pairs); every tenth frame of
a colonoscope that is drawn back stays above 0.37, so neighbouring frames of a video are far from either."""
_LIKENESS = 0.4
_FLAT_GREY = 4.0
_LONGEST_GLITCH = 5
_RETURN_PX = 1.5
_ALIKE_GREY = 20.0
_LIT = 14


class ShotFinder:
    """Numbers the shots of a recording, frame by frame. It keeps two small frames and no more."""

    def __init__(self) -> None:
        self._flow = DenseFlow()
        self._before: UInt8[np.ndarray, "h w"] | None = None
        self._anchor: UInt8[np.ndarray, "h w"] | None = None
        self._cut_at = 0
        self.shots: list[int] = []
        """Number of the shot of each frame, [F]."""
        self.glitches: list[int] = []
        """Frames that interrupt a shot."""

    def see(self, grey: UInt8[np.ndarray, "h w"]) -> bool:
        """Take in the next frame, small and grey.

        Returns:
            Whether it continues what the frame before showed; if not, motion cannot be measured.
        """
        index = len(self.shots)
        before, self._before = self._before, grey
        if before is None:
            self.shots.append(0)
            return False
        if self._anchor is not None and index - self._cut_at > _LONGEST_GLITCH:
            self._anchor = None
        if show_the_same(before, grey, self._flow):
            self.shots.append(self.shots[-1])
            return True
        if self._anchor is not None and show_the_same(self._anchor, grey, self._flow):
            # Back in the shot that was left: what lay between was no shot.
            shot = self.shots[self._cut_at - 1]
            self.shots[self._cut_at :] = [shot] * (index - self._cut_at)
            self.glitches.extend(range(self._cut_at, index))
            self.shots.append(shot)
            self._anchor = None
            return False
        if self._anchor is None:
            self._anchor, self._cut_at = before, index
        self.shots.append(self.shots[-1] + 1)
        return False


def show_the_same(before: UInt8[np.ndarray, "h w"], after: UInt8[np.ndarray, "h w"], flow: DenseFlow) -> bool:
    """Whether two pictures show the same place, from where the camera may have moved.

    Args:
        before: small and grey, about 200 pixels wide.
        after: the same size.
        flow: kept between calls.
    """
    if _correlation(before, after) > _SURELY_ALIKE:
        return True
    if followed_share(before, after, flow) >= _FOLLOWED:
        return True
    # The flow loses a move of an eighth of the width or more; a swing as a whole is found first.
    return followed_share(_swung(before, after), after, flow) >= _FOLLOWED


def followed_share(
    before: UInt8[np.ndarray, "h w"],
    after: UInt8[np.ndarray, "h w"],
    flow: DenseFlow | None = None,
) -> float:
    """Share of the lit pixels that can be followed from one frame into the next.

    Args:
        before: small and grey, about 200 pixels wide.
        after: the same size.
        flow: kept between calls; None makes one.
    """
    import cv2

    flow = flow or DenseFlow()
    lit = after > _LIT
    if not lit.any():
        # Into the dark and out of it nothing can be followed.
        return 1.0 if not (before > _LIT).any() else 0.0
    back, forth = flow.between(after, before), flow.between(before, after)
    x, y = np.meshgrid(
        np.arange(after.shape[1], dtype=np.float32), np.arange(after.shape[0], dtype=np.float32)
    )
    at_x, at_y = x + back[..., 0], y + back[..., 1]
    inside = (at_x >= 0) & (at_y >= 0) & (at_x <= after.shape[1] - 1) & (at_y <= after.shape[0] - 1)
    moved = cv2.remap(before, at_x, at_y, cv2.INTER_LINEAR).astype(np.float32)
    returned = back + cv2.remap(forth, at_x, at_y, cv2.INTER_LINEAR)
    # Exposure may follow the move: the common change of brightness is no difference.
    change = after.astype(np.float32) - moved
    known = lit & inside
    if not known.any() or not _alike(moved[known], after[known]):
        return 0.0
    change -= np.median(change[known])
    followed = known & (np.linalg.norm(returned, axis=2) < _RETURN_PX) & (np.abs(change) < _ALIKE_GREY)
    return float(followed.sum() / lit.sum())


def _swung(before: UInt8[np.ndarray, "h w"], after: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """The first picture, moved as a whole to where it fits the second best (phase correlation)."""
    import cv2

    height, width = after.shape
    window = cv2.createHanningWindow((width, height), cv2.CV_32F)
    (x, y), _ = cv2.phaseCorrelate(before.astype(np.float32), after.astype(np.float32), window)
    return np.asarray(cv2.warpAffine(before, np.array([[1, 0, x], [0, 1, y]], np.float32), (width, height)))


def _alike(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether two pictures show the same; two flat ones, as of a lens at the wall, do."""
    if first.std() < _FLAT_GREY and second.std() < _FLAT_GREY:
        return True
    return _correlation(first, second) > _LIKENESS


def _correlation(first: np.ndarray, second: np.ndarray) -> float:
    # The dark frame round a picture is the same on both sides of a cut.
    lit = (first > _LIT) | (second > _LIT)
    if not lit.any():
        return 1.0
    one, other = (image[lit] - float(image[lit].mean()) for image in (first, second))
    length = float(np.sqrt((one * one).sum() * (other * other).sum()))
    return float((one * other).sum()) / length if length > 0 else 0.0
