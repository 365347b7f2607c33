"""`restorer.json`: the description every saved restorer carries, written and read in one place."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from extrags.errors import WeightsError, reason_of
from extrags.output_files import write_file

__all__ = [
    "DESCRIPTION",
    "check_format",
    "description_fields",
    "read_description",
    "text_field",
    "write_description",
]

DESCRIPTION = "restorer.json"


def write_description(folder: Path, description: Mapping[str, Any]) -> None:
    """Write `restorer.json` into a folder, which is made if needed; it is there whole, or as it was before.

    Args:
        folder: of the saved restorer.
        description: ready for JSON; its entry `backend` names the backend that reads the folder again.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_file(folder / DESCRIPTION, json.dumps(description, indent=2, allow_nan=False) + "\n")


def read_description(file: Path) -> dict[str, Any]:
    """Content of a `restorer.json`.

    Raises:
        WeightsError: when the file is missing or holds no JSON object.
    """
    if not file.is_file():
        raise WeightsError(f"{file}: no such file; train the restorer first (stage enhance)")
    try:
        return dict(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, RecursionError, TypeError, ValueError) as error:
        raise WeightsError(f"{file}: not readable as a JSON object ({reason_of(error)})") from error


def check_format(file: Path, description: Mapping[str, Any], expected: int) -> None:
    """Refuse a restorer of another format.

    Raises:
        WeightsError: when the formats differ.
    """
    if description.get("format") != expected:
        raise WeightsError(
            f"{file}: format {description.get('format')}, this version reads {expected}; "
            "prepare the restorer again"
        )


def text_field(description: Mapping[str, Any], name: str) -> str:
    """A text of a description.

    Raises:
        KeyError: when it is missing.
        TypeError: when it is no text.
    """
    value = description[name]
    if not isinstance(value, str):
        raise TypeError(f"{name} is {value!r}, expected a text")
    return value


@contextmanager
def description_fields(file: Path) -> Iterator[None]:
    """Name the file when a field read inside the block is missing or has a wrong value.

    Raises:
        WeightsError: in place of the KeyError, TypeError, ValueError, AttributeError or RuntimeError.
    """
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise WeightsError(f"{file}: not the description of a restorer ({error!r})") from error
