"""Held-out views of two methods beside the truth, with their errors on one scale."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as AbstractSequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8

from extrags.errors import ShapeError
from extrags.report.encode import (
    OUTSIDE_RGB,
    as_uint8,
    color_bar,
    color_mapped,
    fitted_image,
    outlined,
)
from extrags.report.views import (
    ERROR_COLORMAP,
    SCALE_QUANTILE,
    UNSEEN_RGB,
    ColorScale,
    ImageCell,
    ImageRow,
    ImageTable,
    evenly_spaced,
)
from extrags.report.wording import metric_of, number
from extrags.sequence import Sequence

__all__ = ["RenderedMethod", "compared_rows"]

LEAST_SCALE_END = 0.05


@dataclass(frozen=True)
class RenderedMethod:
    """What one method makes of the held-out views of a sequence.

    Args:
        name: of the method.
        rgb: its renders, float in [0, 1] or uint8, [T, H, W, 3].
        per_view: `EvaluationResult.per_view`.
    """

    name: str
    rgb: np.ndarray
    per_view: AbstractSequence[Mapping[str, Any]]


def compared_rows(
    sequence: Sequence, methods: tuple[RenderedMethod, RenderedMethod], views: int, largest_bytes: int
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
    truth, masks = sequence.rgb[frames], sequence.mask[frames]
    unseen = np.zeros_like(masks) if sequence.observed is None else ~sequence.observed[frames] & masks
    images = [as_uint8(method.rgb[chosen]) for method in methods]
    errors = [np.abs(image.astype(np.float64) - truth).mean(-1) / 255 for image in images]
    counted = np.concatenate([error[masks] for error in errors])
    high = LEAST_SCALE_END
    if counted.size:
        high = max(high, float(np.ceil(np.quantile(counted, SCALE_QUANTILE) * 20 - 1e-9) / 20))

    rows = []
    for place, frame in enumerate(map(int, frames)):
        name, mask = sequence.frame_name(frame), masks[place]
        shown = [(method.name, image[place], "render") for method, image in zip(methods, images, strict=True)]
        cells = [
            ImageCell(
                fitted_image(_inside(image, mask), largest_bytes), label, f"Frame {name}, {label} {kind}"
            )
            for label, image, kind in [*shown, ("Truth", truth[place], "as recorded")]
        ]
        for method, error in zip(methods, errors, strict=True):
            colored = color_mapped(error[place], 0, high, colormap=ERROR_COLORMAP, valid=mask)
            mean = float(error[place][mask].mean()) if mask.any() else 0.0
            cells.append(
                ImageCell(
                    fitted_image(outlined(colored, unseen[place], UNSEEN_RGB), largest_bytes),
                    f"Error, {method.name}",
                    f"Frame {name}, error of {method.name}, mean {mean:.3f}",
                )
            )
        rows.append(ImageRow(f"Frame {name}", _note(methods, int(chosen[place])), tuple(cells)))
    scale = ColorScale(
        color_bar(ERROR_COLORMAP),
        "0",
        f"≥ {high:.2f}",
        "mean absolute difference of red, green, blue in [0, 1]",
    )
    return ImageTable(
        tuple(rows),
        (scale,),
        len(rows),
        len(sequence.test),
        outlined=bool(unseen.any()),
        masked=not bool(masks.all()),
    )


def _inside(image: UInt8[np.ndarray, "h w 3"], mask: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    return np.where(mask[..., None], image, np.array(OUTSIDE_RGB, dtype=np.uint8))


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
