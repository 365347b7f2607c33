"""Charts of a page together with the numbers they draw, to be taken out of it as SVG and as CSV."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from extrags.report.encode import DataImage, data_uri

__all__ = ["Cell", "Chart", "csv_text", "csv_uri", "file_name"]

Cell = str | int | float | bool | None


@dataclass(frozen=True, slots=True)
class Chart(DataImage):
    """A drawn figure, and its numbers.

    Args:
        name: of the files it is saved as, without their ending.
        csv: `data:` URI of its numbers; empty where they stand in a table beside it.
    """

    name: str = ""
    csv: str = ""

    def with_numbers(self, name: str, header: Sequence[str], rows: Iterable[Sequence[Cell]]) -> Chart:
        """The same chart with a name and the numbers it draws."""
        return replace(self, name=name, csv=csv_uri(header, rows))


# Names of sequences, frames and runs are others' text. The apostrophe is what OWASP recommends against it:
# https://owasp.org/www-community/attacks/CSV_Injection
_FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r")


def csv_text(header: Sequence[str], rows: Iterable[Sequence[Cell]]) -> str:
    """Comma-separated values as in RFC 4180, with nine digits; empty where a number is missing.

    Text that a spreadsheet would take for a formula has an apostrophe before it.
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer)
    writer.writerow([_text(name) for name in header])
    writer.writerows([_text(cell) for cell in row] for row in rows)
    return buffer.getvalue()


def csv_uri(header: Sequence[str], rows: Iterable[Sequence[Cell]]) -> str:
    """The same as a `data:` URI."""
    return data_uri(csv_text(header, rows).encode("utf-8"), "text/csv;charset=utf-8")


def file_name(words: str) -> str:
    """Words as the name of a file: `PSNR (dB)` to `psnr_db`."""
    return re.sub(r"[^a-z0-9]+", "_", words.lower()).strip("_")


def _text(cell: Cell) -> str:
    if cell is None or (isinstance(cell, float) and not math.isfinite(cell)):
        return ""
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, str) and cell.startswith(_FORMULA_STARTS) and not _is_number(cell):
        return f"'{cell}"
    return f"{cell:.9g}" if isinstance(cell, float) else str(cell)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
