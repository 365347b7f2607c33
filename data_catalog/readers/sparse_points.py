"""Sparse points of sources: those that are finite, and PLY files with them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from extrags.array_files import load_ply_vertices
from extrags.errors import SourceError, reason_of

__all__ = ["finite_points", "read_ply_points", "write_ply_points"]

logger = logging.getLogger(__name__)

_COLORS = ("red", "green", "blue")
_LARGEST = 255
_STEPS_OF_16_BITS = 257
"""65535 / 255."""


def finite_points(
    points: Float[np.ndarray, "p 3"], points_rgb: UInt8[np.ndarray, "p 3"] | None, file: Path
) -> tuple[Float[np.ndarray, "n 3"] | None, UInt8[np.ndarray, "n 3"] | None]:
    """Points without those that are NaN or infinite, of which a warning tells.

    Args:
        points: as the file has them.
        points_rgb: their colours.
        file: named in the warning.

    Returns:
        Points and colours; None for both where no point is left.
    """
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        logger.warning(
            "%s: %d of %d points are not finite and left out", file, int((~finite).sum()), len(points)
        )
    if not finite.any():
        return None, None
    return points[finite], None if points_rgb is None else points_rgb[finite]


def read_ply_points(
    file: Path, *, field: str
) -> tuple[Float[np.ndarray, "p 3"] | None, UInt8[np.ndarray, "p 3"] | None]:
    """Finite points of a PLY file and their colours; None for what there is not.

    Colours are 0 to 255; those of other programs are brought to that: floats of which none is above 1, and
    16 bits of which one is above 255.

    Args:
        file: with vertices.
        field: that names the file, for errors.

    Raises:
        SourceError: no such points, or colours that are no numbers.
    """
    try:
        vertices = load_ply_vertices(file)
        located = np.stack([np.asarray(vertices[axis], dtype=np.float64) for axis in "xyz"], axis=1)
    except (OSError, TypeError, ValueError) as error:
        raise SourceError(f"no PLY with vertices: {reason_of(error)}", file=file, field=field) from error
    colored = [vertices[name] for name in _COLORS if name in (vertices.dtype.names or ())]
    if len(colored) < len(_COLORS):
        return finite_points(located, None, file)
    if any(values.dtype.kind not in "fiu" for values in colored):
        raise SourceError("colours are not numbers", file=file, field=field)
    return finite_points(located, _eight_bit(colored), file)


def write_ply_points(
    file: Path, points: Float[np.ndarray, "p 3"], points_rgb: UInt8[np.ndarray, "p 3"] | None
) -> None:
    """Write points as a PLY file, in double precision, with colours of 8 bits where there are some."""
    from plyfile import PlyData, PlyElement

    kinds = [(axis, "f8") for axis in "xyz"]
    if points_rgb is not None:
        kinds += [(name, "u1") for name in _COLORS]
    rows = np.zeros(len(points), dtype=kinds)
    for index, axis in enumerate("xyz"):
        rows[axis] = points[:, index]
    if points_rgb is not None:
        for index, color in enumerate(_COLORS):
            rows[color] = points_rgb[:, index]
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(file))


def _eight_bit(colored: Sequence[np.ndarray]) -> UInt8[np.ndarray, "p 3"]:
    """Colours of 8 bits from channels of any kind of numbers."""
    shades = np.nan_to_num(np.stack(colored, axis=1).astype(np.float64))
    largest = shades.max(initial=0.0)
    if all(values.dtype.kind == "f" for values in colored) and largest <= 1:
        shades *= _LARGEST
    elif all(values.dtype == np.uint16 for values in colored) and largest > _LARGEST:
        shades /= _STEPS_OF_16_BITS
    return np.rint(shades).clip(0, _LARGEST).astype(np.uint8)
