"""The surface of a colon and the line through its middle, as the GCA models have them on disk.

* `Surfaces/large_intestine_100k.vtk`: legacy ASCII VTK, POLYDATA of triangles, in mm.
* `Paths/large_intestine_path.jsn`: JSON with `points`, about 1 mm apart, from the rectum to the caecum.

Source: Burger et al., "Towards a clinically-based common coordinate framework for the human gut cell atlas:
the gut models", BMC Medical Informatics and Decision Making 23, 2023.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from extrags.errors import SourceError, reason_of

__all__ = ["FOLDER", "PATH_FILE", "SURFACE_FILE", "ColonModel"]

FOLDER = "colon_ct_gca/EdinGCA_3D_00090"
SURFACE_FILE = "Surfaces/large_intestine_{triangles}.vtk"
PATH_FILE = "Paths/large_intestine_path.jsn"


@dataclass(frozen=True)
class ColonModel:
    """A closed wall and the line through its middle.

    Args:
        vertices: in mm.
        triangles: indices of vertices.
        centre_line_mm: points, about one millimetre apart, [K, 3].
    """

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]
    centre_line_mm: Float[np.ndarray, "k 3"]

    @classmethod
    def read(cls, folder: Path, triangles: str = "100k") -> ColonModel:
        """Read surface and line.

        Args:
            folder: that holds `Surfaces` and `Paths`.
            triangles: `20k` or `100k`.

        Raises:
            SourceError: a file is missing or is not what it should be.
        """
        vertices, faces = _polydata(folder / SURFACE_FILE.format(triangles=triangles))
        return cls(vertices, faces, _centre_line(folder / PATH_FILE))

    @property
    def along_mm(self) -> Float[np.ndarray, "k"]:
        """How far along the line its points are."""
        steps = np.linalg.norm(np.diff(self.centre_line_mm, axis=0), axis=1)
        return np.concatenate([[0.0], steps.cumsum()])

    def at(self, place_mm: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 3"]:
        """Points of the line so far along it; its ends beyond them."""
        along = self.along_mm
        return np.stack([np.interp(place_mm, along, axis) for axis in self.centre_line_mm.T], axis=-1)


def _polydata(file: Path) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]]:
    words = _text(file).split()
    vertices = _numbers(words, "POINTS", 3, 3, file).reshape(-1, 3)
    faces = _numbers(words, "POLYGONS", 3, 4, file).reshape(-1, 4)
    triangles = faces[:, 1:].astype(np.int64)
    if (faces[:, 0] != 3).any() or triangles.min() < 0 or triangles.max() >= len(vertices):
        raise SourceError("expected triangles of the points above", file=file, field="POLYGONS")
    return vertices.astype(np.float32), triangles


def _numbers(words: list[str], key: str, skipped: int, width: int, file: Path) -> Float[np.ndarray, "n"]:
    """The numbers after a key, its count and one word more."""
    try:
        at = words.index(key)
        begin, count = at + skipped, width * int(words[at + 1])
        found = np.array(words[begin : begin + count], dtype=np.float64)
    except (ValueError, IndexError) as error:
        raise SourceError(f"not readable as legacy VTK in ASCII: {error}", file=file, field=key) from error
    if count <= 0 or len(found) != count or not np.isfinite(found).all():
        raise SourceError(f"expected {count} finite numbers, found {len(found)}", file=file, field=key)
    return found


def _centre_line(file: Path) -> Float[np.ndarray, "k 3"]:
    try:
        points = np.array(json.loads(_text(file))["points"], dtype=np.float64)
    except (ValueError, KeyError, TypeError) as error:
        raise SourceError(
            f"expected JSON with a list of points: {error!r}", file=file, field="points"
        ) from error
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2 or not np.isfinite(points).all():
        raise SourceError(
            f"expected at least 2 finite points, [K, 3]; found {list(points.shape)}",
            file=file,
            field="points",
        )
    return points


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"cannot be read: {reason_of(error)}", file=file) from error
