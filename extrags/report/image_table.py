"""Tables of images: rows that share their colour scales, and renders compared with the recorded frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, UInt8

from extrags.observed_surface import never_observed
from extrags.report.encode import (
    OUTSIDE_RGB,
    UNSEEN_RGB,
    DataImage,
    color_bar,
    color_mapped,
    fitted_image,
    outlined,
)
from extrags.sequence import EndoscopicSequence

__all__ = [
    "ColorScale",
    "ImageCell",
    "ImageRow",
    "ImageTable",
    "Judged",
    "error_scale",
    "evenly_spaced",
    "image_cell",
    "judged_table",
    "scale_end",
]

ERROR_COLORMAP = "magma"
SCALE_QUANTILE = 0.98
"""The colour scale ends here, so that holes and highlights do not flatten everything else."""
FINAL_MIN_SCALE = 0.05


@dataclass(frozen=True, slots=True)
class ImageCell:
    """One image of a row."""

    image: DataImage
    label: str
    alt: str


@dataclass(frozen=True, slots=True)
class ImageRow:
    """Images of one view, side by side."""

    title: str
    note: str
    cells: tuple[ImageCell, ...]


@dataclass(frozen=True, slots=True)
class ColorScale:
    """Value range and label of a colour map."""

    bar: DataImage
    low: str
    high: str
    label: str


@dataclass(frozen=True, slots=True)
class ImageTable:
    """Rows of images that share their colour scales."""

    rows: tuple[ImageRow, ...]
    scales: tuple[ColorScale, ...]
    shown: int
    total: int
    outlined: bool = False
    """Whether unseen surface is outlined somewhere."""
    masked: bool = False
    """Whether pixels outside a mask, or without depth, are greyed out somewhere."""


@dataclass(frozen=True, slots=True)
class Judged:
    """Renders of the views of a table.

    Args:
        name: what they are renders of, as in `the coarse render`.
        label: the same as a heading.
        images: one per row.
    """

    name: str
    label: str
    images: UInt8[np.ndarray, "n h w 3"]


def judged_table(
    sequence: EndoscopicSequence,
    frames: Int[np.ndarray, "n"],
    judged: Sequence[Judged],
    notes: Sequence[str],
    total: int,
    largest_bytes: int,
) -> ImageTable:
    """Renders, the truth, and the errors of all renders on one colour scale.

    Args:
        sequence: holds the truth.
        frames: the rows.
        judged: one column of images and one of errors each.
        notes: one per row.
        total: views there are.
        largest_bytes: bound per image.
    """
    truth, masks = sequence.rgb[frames], sequence.mask[frames]
    unseen = never_observed(sequence, frames)
    errors = [np.abs(item.images.astype(np.float64) - truth).mean(-1) / 255 for item in judged]
    high = scale_end([error[masks] for error in errors])
    rows = []
    for place, frame in enumerate(map(int, frames)):
        name, mask = sequence.frame_name(frame), masks[place]
        cells = [
            image_cell(
                item.images[place], mask, item.label, f"Frame {name}, {item.name} render", largest_bytes
            )
            for item in judged
        ]
        cells.append(
            image_cell(truth[place], mask, "Truth", f"Frame {name}, truth as recorded", largest_bytes)
        )
        for item, error in zip(judged, errors, strict=True):
            shown = color_mapped(error[place], 0, high, colormap=ERROR_COLORMAP, valid=mask)
            shown = outlined(shown, unseen[place], UNSEEN_RGB)
            mean = float(error[place][mask].mean()) if mask.any() else 0.0
            alt = f"Frame {name}, error of the {item.name} render, mean {mean:.3f}"
            cells.append(ImageCell(fitted_image(shown, largest_bytes), f"Error, {item.name}", alt))
        rows.append(ImageRow(f"Frame {name}", notes[place], tuple(cells)))
    return ImageTable(
        tuple(rows),
        (error_scale(high, "mean absolute difference of red, green, blue in [0, 1]"),),
        len(rows),
        total,
        outlined=bool(unseen.any()),
        masked=not bool(masks.all()),
    )


def error_scale(high: float, label: str) -> ColorScale:
    """The scale of error maps that end at `high`."""
    return ColorScale(color_bar(ERROR_COLORMAP), "0", f"≥ {high:.2f}", label)


def scale_end(parts: Sequence[np.ndarray]) -> float:
    """Where a colour scale ends: a high quantile of all maps that share it, rounded up."""
    values = np.concatenate([part.ravel() for part in parts]) if parts else np.zeros(0)
    if not values.size:
        return FINAL_MIN_SCALE
    end = max(FINAL_MIN_SCALE, float(np.quantile(values, SCALE_QUANTILE)))
    return float(np.ceil(end * 20 - 1e-9) / 20)


def image_cell(
    image: UInt8[np.ndarray, "h w 3"],
    mask: np.ndarray | None,
    label: str,
    alt: str,
    largest_bytes: int,
) -> ImageCell:
    """An image with a label; pixels outside the mask are greyed out."""
    if mask is not None and not mask.all():
        image = np.where(mask[..., None], image, np.array(OUTSIDE_RGB, dtype=np.uint8))
    return ImageCell(fitted_image(image, largest_bytes), label, alt)


def evenly_spaced(total: int, wanted: int) -> Int[np.ndarray, "w"]:
    """The middles of equal parts of a list: never picked by how good they look."""
    wanted = min(wanted, total)
    return np.floor((np.arange(wanted) + 0.5) * total / max(1, wanted)).astype(np.int64)
