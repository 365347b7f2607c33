"""What readers of listed frames share: the JSON file that lists them, matrices in it, splits by name."""

from __future__ import annotations

import json
from collections.abc import Collection
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from data_catalog.images import natural_key
from extrags.errors import SourceError

__all__ = ["load_frame_list", "matrix_of", "split_by_name"]


def load_frame_list(file: Path, key: str) -> dict[str, Any]:
    """An object with a list `frames`, each frame of which names its own file.

    Args:
        file: JSON.
        key: of a frame's file.

    Raises:
        SourceError: no JSON, no such list, an empty one, a frame without file, or one listed twice.
    """
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise SourceError(f"not readable as JSON: {error}", file=file) from error
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise SourceError("expected an object with a list `frames`", file=file, field="frames")
    if not content["frames"]:
        raise SourceError("the list of frames is empty", file=file, field="frames")
    seen: set[str] = set()
    for index, entry in enumerate(content["frames"]):
        if not isinstance(entry, dict) or not isinstance(entry.get(key), str):
            raise SourceError(f"expected an object with `{key}`", file=file, frame=index, field=key)
        if entry[key] in seen:
            raise SourceError("the frame is listed twice", file=file, frame=entry[key], field=key)
        seen.add(entry[key])
    return content


def matrix_of(
    owner: dict[str, Any],
    field: str,
    size: int,
    *,
    file: Path,
    frame: str,
    error: type[SourceError] = SourceError,
) -> Float[np.ndarray, "n n"]:
    """A square matrix of an entry.

    Args:
        owner: a frame, or the whole file.
        field: key of the matrix.
        size: its number of rows.
        file: named in errors.
        frame: named in errors.
        error: kind of what is raised.

    Raises:
        SourceError: missing, no numbers, or of another shape.
    """
    if field not in owner:
        raise error(f"no {field}; expected {size} x {size} numbers", file=file, frame=frame, field=field)
    try:
        matrix = np.asarray(owner[field], dtype=np.float64)
    except (TypeError, ValueError) as cause:
        raise error(f"not a matrix of numbers: {cause}", file=file, frame=frame, field=field) from cause
    if matrix.shape != (size, size):
        raise error(
            f"found shape {matrix.shape}; expected {size} rows of {size} numbers",
            file=file,
            frame=frame,
            field=field,
        )
    return matrix


def split_by_name(
    training: Collection[str], held_out: Collection[str], *, file: Path
) -> dict[str, Literal["train", "test"]]:
    """The part of each frame that a split names.

    Raises:
        SourceError: a frame stands in both parts.
    """
    both = sorted(set(held_out) & set(training), key=natural_key)
    if both:
        raise SourceError(
            f"{len(both)} frames both train and evaluate, this one is the first",
            file=file,
            frame=both[0],
            field="split",
        )
    parts: dict[str, Literal["train", "test"]] = dict.fromkeys(held_out, "test")
    return parts | dict.fromkeys(training, "train")
