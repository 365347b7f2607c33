"""What `cv::FileStorage` writes (YAML, XML, JSON), read without OpenCV.

OpenCV's own parser corrupts memory on damaged files.

Read are numbers, text and matrices at the top of the file; everything below them is passed over. Matrices
with several numbers in an entry, as the points that OpenCV's own calibration writes beside the camera, are
not understood, and need not be.

Source: https://docs.opencv.org, "File Input and Output using XML / YAML / JSON files".
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from extrags.errors import SourceError
from extrags.yaml_text import read_yaml

__all__ = ["read_file_storage"]

_MATRIX = "opencv-matrix"
_LARGEST = 10_000
"""Numbers of a matrix; calibrations have a few."""


def read_file_storage(text: str, file: Path, matrices: Collection[str]) -> dict[str, Any]:
    """The entries at the top of a file.

    Args:
        text: its content.
        file: named in errors.
        matrices: names of entries whose matrices become float64 arrays; those of others stay mappings.

    Raises:
        SourceError: the text is none of the three, or such a matrix is not what its size says.
    """
    start = text.lstrip()[:1]
    try:
        entries = _xml(text) if start == "<" else _json(text) if start == "{" else _yaml(text)
    except SourceError:
        raise
    except (ElementTree.ParseError, RecursionError, ValueError, TypeError, AttributeError) as error:
        raise _refused(error, file) from error
    if not isinstance(entries, Mapping):
        raise _refused("there are no entries", file)
    return {
        str(name): _value(value, file, str(name)) if name in matrices else value
        for name, value in entries.items()
    }


def _refused(problem: object, file: Path) -> SourceError:
    return SourceError(
        f"cannot be read; expected what OpenCV's cv::FileStorage writes: {problem}",
        file=file,
        field="calibration",
    )


def _yaml(text: str) -> Any:
    import yaml

    class Loader(yaml.SafeLoader):
        """Takes OpenCV's tag as a plain mapping."""

    def matrix(loader: Any, node: Any) -> Any:
        return {"type_id": _MATRIX, **loader.construct_mapping(node, deep=True)}

    Loader.add_constructor(f"tag:yaml.org,2002:{_MATRIX}", matrix)
    # OpenCV's first line is no YAML directive.
    text = re.sub(r"\A\s*%YAML:1\.0\s*\n", "", text)
    return read_yaml(text, Loader)


def _json(text: str) -> Any:
    return json.loads(text)


def _xml(text: str) -> Any:
    if "<!" in text.replace("<!--", ""):
        raise ValueError("it declares entities or a document type")
    root = ElementTree.fromstring(text.encode())
    return {item.tag: _element(item) for item in root}


def _element(item: ElementTree.Element) -> Any:
    if item.get("type_id") == _MATRIX:
        parts = {part.tag: (part.text or "").strip() for part in item}
        return {**parts, "type_id": _MATRIX, "data": parts.get("data", "").split()}
    return (item.text or "").strip()


def _value(value: Any, file: Path, name: str) -> Any:
    if not isinstance(value, Mapping) or value.get("type_id") != _MATRIX:
        return value
    try:
        rows, columns, data = int(value["rows"]), int(value["cols"]), value["data"]
        if not isinstance(data, Sequence) or isinstance(data, str) or len(data) > _LARGEST:
            raise ValueError("data is no list of numbers")
        numbers = np.array([float(number) for number in data], dtype=np.float64)
        if rows < 0 or columns < 0 or rows * columns != len(numbers):
            raise ValueError(f"{len(numbers)} numbers for {rows} x {columns}")
        return numbers.reshape(rows, columns)
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        raise SourceError(f"no matrix: {error}", file=file, field=name) from error
