"""Long clips cut into windows that fit a model, and joined by cross-fading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from extrags.errors import ConfigError, ShapeError

__all__ = ["Span", "cross_faded", "padded_to", "plan_windows", "valid_frame_count"]


@dataclass(frozen=True)
class Span:
    """Frames `start` to `stop` (excluded) of a clip."""

    start: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.start


def plan_windows(count: int, length: int, overlap: int) -> list[Span]:
    """Windows of at most `length` frames that cover a clip.

    Neighbours share at least `overlap` frames; the last one ends with the clip and may share more.

    Args:
        count: frames of the clip.
        length: frames a window holds.
        overlap: frames two neighbours share.

    Raises:
        ConfigError: when the overlap leaves no progress.
        ShapeError: for an empty clip.
    """
    if count < 1:
        raise ShapeError("a clip without frames cannot be cut into windows")
    if count <= length:
        return [Span(0, count)]
    step = length - overlap
    if step < 1:
        raise ConfigError(
            f"windows of {length} new frames cannot overlap by {overlap}; lower `overlap` or raise `frames`"
        )
    starts = list(range(0, count - length, step))
    return [Span(start, start + length) for start in [*starts, count - length]]


def valid_frame_count(needed: int, step: int) -> int:
    """The smallest number of frames, at least `needed`, of the form k * step + 1.

    Args:
        needed: frames there are.
        step: frames per latent frame of the video's autoencoder; 1 takes any number.
    """
    return -(-(needed - 1) // step) * step + 1


def padded_to(frames: np.ndarray, count: int) -> np.ndarray:
    """Frames with the last one repeated until there are `count`."""
    missing = count - len(frames)
    if missing <= 0:
        return frames
    return np.concatenate([frames, np.repeat(frames[-1:], missing, axis=0)])


def cross_faded(
    spans: Sequence[Span],
    parts: Sequence[Float[np.ndarray, "_ h w 3"]],
    overlap: int,
) -> Float[np.ndarray, "t h w 3"]:
    """Windows joined into one clip, faded linearly where they overlap.

    Args:
        spans: where the windows lie; together they cover the clip.
        parts: their frames.
        overlap: length of the fade.

    Raises:
        ShapeError: when a part does not have the frames of its span.
    """
    for span, part in zip(spans, parts, strict=True):
        if len(part) != len(span):
            raise ShapeError(f"window {span.start} to {span.stop} came back with {len(part)} frames")
    count = max(span.stop for span in spans)
    total = np.zeros((count, *parts[0].shape[1:]), np.float64)
    weight = np.zeros((count, 1, 1, 1), np.float64)
    for span, part in zip(spans, parts, strict=True):
        ramp = _ramp(len(span), overlap)[:, None, None, None]
        total[span.start : span.stop] += ramp * part
        weight[span.start : span.stop] += ramp
    return np.asarray(total / weight, dtype=np.float32)


def _ramp(length: int, overlap: int) -> Float[np.ndarray, "n"]:
    """1 inside, falling towards both ends: two ramps that overlap by so much add up to 1."""
    position = np.arange(length, dtype=np.float64) + 1
    return np.minimum(1, np.minimum(position, position[::-1]) / (overlap + 1))
