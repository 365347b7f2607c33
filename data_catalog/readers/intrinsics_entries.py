"""What an `intrinsics.json` says beside the numbers of its pinhole, or in their place; what is refused."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from data_catalog.guessed_intrinsics import intrinsics_of_field_of_view
from data_catalog.lens_entries import SIZE_NAMES, check_pinhole
from data_catalog.readers.unknown_keys import warn_of_unknown_keys
from extrags.errors import SourceError

__all__ = [
    "ANGLE",
    "EXPECTED",
    "PINHOLE_KEYS",
    "check_complete",
    "check_described",
    "check_is_degrees",
    "number_of",
    "of_angle",
]

ANGLE = "field_of_view_deg"
EXPECTED = "expected K, or fx, fy, cx, cy, or field_of_view_deg"

PINHOLE_KEYS = ("fx", "fy", "cx", "cy")
_SKEW = "skew"
_PAIRS = (
    *(("width", "height"), ("w", "h"), ("Width", "Height")),
    *zip(SIZE_NAMES["width"], SIZE_NAMES["height"], strict=True),
)
_BOTH = (*SIZE_NAMES["size"], "resolution")
_KNOWN = ("K", *PINHOLE_KEYS, ANGLE, _SKEW, *_BOTH, *(name for pair in _PAIRS for name in pair))
_NAMED_ANGLE = re.compile(r"fov|field_?of_?view|camera_?angle", re.IGNORECASE)
_INSTEAD = "Describe a lens with distortion in a calibration file (ingest.calibration)"


def check_described(
    content: Mapping[str, Any], width: int, height: int, file: Path, *, are_turned: bool
) -> None:
    """Refuse what would otherwise be passed over: a lens that is no pinhole, a skew, and another size.

    Of keys that are not known a warning tells.

    Args:
        content: of the file.
        width: of the images it belongs to, in pixels.
        height: of the images it belongs to, in pixels.
        file: named in messages.
        are_turned: whether width and height are those of images that lie otherwise in their files.

    Raises:
        SourceError: names the entry.
    """
    check_pinhole(content, _INSTEAD, file=file)
    if content.get(_SKEW) is not None and number_of(content, _SKEW, file) != 0:
        raise SourceError(f"{content[_SKEW]!r}; expected 0", file=file, field=_SKEW)
    for names, told in _sizes(content, file):
        differing = [
            name
            for name, size, found in zip(names, told, (width, height), strict=True)
            if size and size != found
        ]
        if differing:
            shown = " x ".join(f"{size:g}" if size else "?" for size in told)
            as_shown = " once they are turned upright (EXIF orientation)" if are_turned else ""
            raise SourceError(
                f"for images of {shown} pixels; found {width} x {height}{as_shown}",
                file=file,
                field=differing[0],
            )
    # A file without a list of frames; one that is called so is passed over.
    further = {name: value for name, value in content.items() if name != "frames"}
    warn_of_unknown_keys(further, known=_KNOWN, known_of_frames=(), frame_name="", file=file)


def number_of(content: Mapping[str, Any], key: str, file: Path) -> float:
    """The number of an entry that is there.

    Raises:
        SourceError: it is none.
    """
    try:
        return float(content[key])
    except (OverflowError, TypeError, ValueError) as error:
        raise SourceError(f"{json.dumps(content[key])}; expected a number", file=file, field=key) from error


def of_angle(
    content: Mapping[str, Any], width: int, height: int, pixel_aspect: float, file: Path
) -> Float[np.ndarray, "3 3"]:
    """K of the field of view that is stated.

    Args:
        content: of the file, with `field_of_view_deg`.
        width: of the images, in pixels.
        height: of the images, in pixels.
        pixel_aspect: width of a pixel over its height.
        file: named in messages.

    Raises:
        SourceError: it is none of a pinhole.
    """
    angle = number_of(content, ANGLE, file)
    if not 1 < angle < 179:
        raise SourceError(f"{angle:g} degrees; expected 1 to 179 for a pinhole", file=file, field=ANGLE)
    return intrinsics_of_field_of_view(angle, width, height, pixel_aspect=pixel_aspect)


def check_is_degrees(content: Mapping[str, Any], file: Path) -> None:
    """Refuse a field of view that is stated alone and as narrow as no endoscope's: it is in radians.

    Raises:
        SourceError: says how many degrees these are.
    """
    angle = number_of(content, ANGLE, file)
    if 0 < angle <= math.pi:
        raise SourceError(
            f"{angle:g} degrees is narrower than any endoscope sees; if these are radians, write "
            f"{math.degrees(angle):.4g}, and if not, fx, fy, cx and cy in its place",
            file=file,
            field=ANGLE,
        )


def check_complete(content: Mapping[str, Any], file: Path) -> None:
    """Refuse a pinhole of which something is not stated.

    Raises:
        SourceError: names what is missing, and the field of view that has another name.
    """
    absent = [key for key in PINHOLE_KEYS if key not in content]
    if not absent:
        return
    listed = ", ".join(absent)
    missing = f"no {listed}"
    if absent == [*PINHOLE_KEYS]:
        missing = f"no K, no {ANGLE} and no {listed}"
        named = next((key for key in content if _NAMED_ANGLE.search(key)), None)
        if named is not None:
            missing += f" ({named} is not read: write the horizontal field of view, in degrees, as {ANGLE})"
    raise SourceError(f"{missing}; {EXPECTED}", file=file, field="K")


def _sizes(
    content: Mapping[str, Any], file: Path
) -> Iterator[tuple[tuple[str, str], tuple[float | None, float | None]]]:
    """Sizes that are stated: the entries of width and height, and both; None where one is not there.

    Programs write 0 where they do not know it.

    Raises:
        SourceError: an entry that is no size.
    """
    for pair in _PAIRS:
        width, height = (
            None if content.get(name) is None else number_of(content, name, file) for name in pair
        )
        yield pair, (width, height)
    for name in _BOTH:
        if content.get(name) is not None:
            yield (name, name), _width_and_height(content[name], name, file)


def _width_and_height(value: Any, name: str, file: Path) -> tuple[float, float]:
    listed = re.split(r"[\s,x]+", value.strip()) if isinstance(value, str) else value
    try:
        width, height = (float(number) for number in listed)
    except (OverflowError, TypeError, ValueError) as error:
        raise SourceError(
            f"{json.dumps(value)}; expected width and height in pixels", file=file, field=name
        ) from error
    return width, height
