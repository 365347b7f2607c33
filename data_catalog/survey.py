"""The first pass over footage: how far the picture moves, how sharp it is, where it is cut; and the choice.

All frames are looked at once, one after another, at a small size; of each, a few numbers are kept. What the
choice rests on is measured along the longest shot: how far the picture has moved (median of a dense optical
flow from a reference frame, as a share of the image width; the reference follows only when the move is plain,
so that noise and trembling do not add up) and how sharp each frame is. The path is cut into steps of equal
motion, and of each step the sharpest frame is taken; where the scope stands still nothing is taken twice.
Steps are 3 % of the width; they grow where there would be more frames than asked for and shrink where there
would be fewer than 24, down to what the flow can tell.

Which shot is the longest is counted in seconds, by the timestamps of the frames, not by their number: where
the frame rate varies, the two differ. A shot ends one usual step after its last frame: a pause of the
recorder that follows belongs to no shot.

Source: sharpness as the mean absolute Laplacian over the mean brightness, after Pertuz et al., "Analysis of
focus measure operators for shape-from-focus", Pattern Recognition 2013; flow: `extrags.dense_flow`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from data_catalog.footage import FootageFrame
from data_catalog.interlacing import is_combed, is_interlaced
from data_catalog.shots import ShotFinder
from extrags.dense_flow import DenseFlow
from extrags.errors import SourceError
from extrags.events import Progress, emit

__all__ = ["NOTHING_DECODED", "Shot", "Survey", "choose_frames", "survey"]

NOTHING_DECODED = "not a single frame can be decoded; is it a video, and whole?"
STEP_SHARE = 0.03
"""Usual motion between two chosen frames, as a share of the image width."""
_SMALLEST_STEP = 0.0015
_MIN_MOTION = 0.01
_FEW_FRAMES = 24
_PLAIN_MOVE = 0.01
"""From here on the flow's reference follows."""
_SURVEY_WIDTH = 192
_PROGRESS_EVERY = 20
_COMB_EVERY = 4
"""So many frames apart it is looked whether a picture is woven from two."""


@dataclass(frozen=True)
class Shot:
    """Frames that belong together, by position in the survey.

    Args:
        first: position of the first.
        last: position of the last.
        duration_s: by timestamps, up to the end of the last frame.
        motion: share of the width that the picture moves, in all.
        interlaced: whether its pictures are woven from two moments.
    """

    first: int
    last: int
    duration_s: float
    motion: float
    interlaced: bool


@dataclass(frozen=True)
class Survey:
    """What the first pass finds; F frames were looked at.

    Args:
        width: of a frame, in pixels.
        height: of a frame, in pixels.
        numbers: of the frames in the file, [F].
        times_s: timestamps, never falling, [F].
        path: share of the width that the picture has moved since the first frame, never falling, [F].
        sharpness: comparable between neighbouring frames, [F]; zero where a glitch interrupts a shot.
        shots: index of each frame's shot, never falling, [F].
        combed: whether a frame shows two moments; false where it was not looked at, [F].
        comb_looked: whether it was looked at, [F].
    """

    width: int
    height: int
    numbers: Int[np.ndarray, "f"]
    times_s: Float[np.ndarray, "f"]
    path: Float[np.ndarray, "f"]
    sharpness: Float[np.ndarray, "f"]
    shots: Int[np.ndarray, "f"]
    combed: Bool[np.ndarray, "f"]
    comb_looked: Bool[np.ndarray, "f"]

    def __len__(self) -> int:
        return len(self.numbers)

    def all_shots(self) -> list[Shot]:
        """The shots in order."""
        starts = [0, *(np.flatnonzero(np.diff(self.shots)) + 1).tolist(), len(self)]
        return [self._shot(first, end - 1) for first, end in pairwise(starts)]

    def longest_shot(self) -> Shot:
        """The longest shot that moves; where none does, the one that moves most.

        A title or a frozen picture may be shown for long.
        """
        shots = self.all_shots()
        moving = [shot for shot in shots if shot.motion >= _MIN_MOTION]
        if moving:
            return max(moving, key=lambda shot: shot.duration_s)
        return max(shots, key=lambda shot: shot.motion)

    def _shot(self, first: int, last: int) -> Shot:
        here = slice(first, last + 1)
        # Of a single frame the usual step of all.
        steps = np.diff(self.times_s[here] if last > first else self.times_s)
        end_s = self.times_s[last] + (float(np.median(steps)) if len(steps) else 0.0)
        if last + 1 < len(self):
            end_s = min(end_s, self.times_s[last + 1])
        return Shot(
            first=first,
            last=last,
            duration_s=float(end_s - self.times_s[first]),
            motion=float(self.path[last] - self.path[first]),
            interlaced=is_interlaced(self.combed[here][self.comb_looked[here]].tolist()),
        )


def survey(frames: Iterable[FootageFrame], *, file: Path, announced: int = 0) -> Survey:
    """Look at all frames at a small size and measure motion, sharpness, cuts and combs.

    Args:
        frames: one after another; none is kept.
        file: named in errors.
        announced: about how many there are, for progress; 0 where unknown.

    Raises:
        SourceError: there is no frame, or frames of different sizes.
    """
    flow = DenseFlow()
    shots = ShotFinder()
    numbers: list[int] = []
    times_s: list[float] = []
    path: list[float] = []
    sharpness: list[float] = []
    combed: list[bool] = []
    reference: UInt8[np.ndarray, "h w"] | None = None
    behind = 0.0
    width = height = 0
    for frame in frames:
        if numbers and frame.rgb.shape[:2] != (height, width):
            found = f"{frame.rgb.shape[1]} x {frame.rgb.shape[0]} pixels"
            raise SourceError(
                f"{found}, but {width} x {height} before; expected one size", file=file, frame=frame.number
            )
        height, width = frame.rgb.shape[:2]
        index = len(numbers)
        grey = _small(frame.rgb)
        numbers.append(frame.number)
        times_s.append(max(frame.time_s, times_s[-1] if times_s else frame.time_s))
        sharpness.append(_sharpness(grey))
        combed.append(index % _COMB_EVERY == 0 and is_combed(frame.rgb))
        if not shots.see(grey) or reference is None:
            # Nothing can be measured across a cut: the path goes on from here.
            reference, behind = grey, path[-1] if path else 0.0
        moved = _moved(flow.between(reference, grey), reference, grey)
        path.append(max(behind + moved, path[-1] if path else 0.0))
        if moved >= _PLAIN_MOVE:
            reference, behind = grey, path[-1]
        if index % _PROGRESS_EVERY == 0 and announced > 0:
            emit(Progress("ingest", min(index, announced), 2 * announced))
    if not numbers:
        raise SourceError(NOTHING_DECODED, file=file)
    usable = np.array(sharpness)
    usable[shots.glitches] = 0.0
    return Survey(
        width=width,
        height=height,
        numbers=np.array(numbers, dtype=np.int64),
        times_s=np.array(times_s, dtype=np.float64),
        path=np.array(path),
        sharpness=usable,
        shots=np.array(shots.shots, dtype=np.int64),
        combed=np.array(combed),
        comb_looked=np.arange(len(numbers)) % _COMB_EVERY == 0,
    )


def choose_frames(
    path: Float[np.ndarray, "f"],
    sharpness: Float[np.ndarray, "f"],
    at_most: int,
    *,
    file: object = None,
) -> Int[np.ndarray, "n"]:
    """The sharpest frame of each step of equal motion.

    Args:
        path: share of the width moved since the first frame, never falling.
        sharpness: larger is sharper.
        at_most: the steps grow until there are no more than so many.
        file: named in errors.

    Returns:
        Indices of frames, ascending.

    Raises:
        SourceError: the picture hardly moves, or there is a single one.
    """
    if len(path) == 1:
        raise SourceError(
            "one frame alone, in the file or in the part of it that is read (ingest.start_s, ingest.end_s, "
            "cuts); a reconstruction needs the scope to move",
            file=file,
            field="frames",
        )
    path = path - path[0]
    total = float(path[-1])
    if total < _MIN_MOTION:
        raise SourceError(
            f"the picture moves by {total:.1%} of its width in {len(path)} frames; expected at least "
            f"{_MIN_MOTION:.0%} in all: nothing can be reconstructed from a scope that stands still",
            file=file,
            field="motion",
        )
    step = float(np.clip(total / _FEW_FRAMES, _SMALLEST_STEP, STEP_SHARE))
    step = max(step, total / at_most * (1 + 1e-9))
    window = np.minimum((path / step).astype(np.int64), at_most - 1)
    return np.array(
        [
            members[int(np.argmax(sharpness[members]))]
            for members in (np.flatnonzero(window == number) for number in np.unique(window))
        ],
        dtype=np.int64,
    )


def _small(rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2"]:
    import cv2

    height, width = rgb.shape[:2]
    size = (_SURVEY_WIDTH, max(16, round(_SURVEY_WIDTH * height / width)))
    # Of one moment where lines abound: combs of an interlaced picture are not detail.
    lines = rgb[::2] if height >= 2 * size[1] else rgb
    return np.asarray(cv2.cvtColor(cv2.resize(lines, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY))


def _sharpness(grey: UInt8[np.ndarray, "h w"]) -> float:
    import cv2

    # Smoothed first, so that compression noise is not taken for detail.
    calm = cv2.GaussianBlur(grey, (0, 0), 0.8)
    return float(np.abs(cv2.Laplacian(calm, cv2.CV_32F)).mean() / (float(grey.mean()) + 1))


def _moved(
    flow: Float[np.ndarray, "h w 2"], before: UInt8[np.ndarray, "h w"], after: UInt8[np.ndarray, "h w"]
) -> float:
    """Median length of the flow over lit pixels, as a share of the width."""
    lit = (before > 14) & (after > 14)
    if lit.sum() < 0.02 * lit.size:
        return 0.0
    return float(np.median(np.linalg.norm(flow[lit], axis=1)) / before.shape[1])
