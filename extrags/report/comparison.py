"""Held-out views of two methods beside the truth, with their errors on one scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from extrags.errors import ShapeError
from extrags.report.encode import as_uint8
from extrags.report.image_table import ImageTable, Judged, evenly_spaced, judged_table
from extrags.report.wording import metric_of, number
from extrags.sequence import EndoscopicSequence

__all__ = ["RenderedMethod", "compared_rows"]


@dataclass(frozen=True)
class RenderedMethod:
    """Renders of the held-out views of a sequence by one method.

    Args:
        name: of the method.
        rgb: its renders, float in [0, 1] or uint8, [T, H, W, 3].
        per_view: `EvaluationResult.per_view`.
    """

    name: str
    rgb: np.ndarray
    per_view: Sequence[Mapping[str, Any]]


def compared_rows(
    sequence: EndoscopicSequence,
    methods: tuple[RenderedMethod, RenderedMethod],
    views: int,
    largest_bytes: int,
) -> ImageTable:
    """Both renders, the truth and both error maps of evenly spaced held-out views.

    Views are picked by their place in the recording, never by how good they look. The error of every
    picture of the table has one colour scale.

    Args:
        sequence: holds the truth.
        methods: the two, the one they are compared with first.
        views: rows at most.
        largest_bytes: bound per image.

    Raises:
        ShapeError: when renders and held-out frames do not fit each other.
    """
    expected = (len(sequence.test), sequence.height, sequence.width, 3)
    for method in methods:
        if method.rgb.shape != expected:
            raise ShapeError(
                f"{sequence.name}: renders of {method.name} have shape {method.rgb.shape}, "
                f"expected {expected}"
            )
    chosen = evenly_spaced(len(sequence.test), views)
    frames = sequence.test[chosen]
    judged = [Judged(method.name, method.name, as_uint8(method.rgb[chosen])) for method in methods]
    notes = [_note(methods, int(place)) for place in chosen]
    return judged_table(sequence, frames, judged, notes, len(sequence.test), largest_bytes)


def _note(methods: tuple[RenderedMethod, RenderedMethod], index: int) -> str:
    """PSNR of the view, plain and exposure-aligned, both methods."""
    first, second = (method.per_view[index] for method in methods)
    said = []
    for label, path in (("PSNR", ("psnr",)), ("aligned", ("aligned", "psnr"))):
        values = [metric_of(view, *path) for view in (first, second)]
        if None not in values:
            said.append(f"{label} {number(values[0], 2)} → {number(values[1], 2)} dB")
    share = metric_of(first, "unobserved", "pixel_share")
    if share is not None:
        said.append(f"{100 * share:.1f} % never observed")
    return " · ".join(said)
