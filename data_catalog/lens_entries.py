"""What entries of files that describe a camera tell of its lens, by their names and values.

Files of many programs are read, and hold much besides: distances, names of products, dates. An entry counts
only where its name says that it is about the lens.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from extrags.errors import SourceError

__all__ = [
    "SIZE_NAMES",
    "LensKind",
    "check_pinhole",
    "check_without_mirror",
    "is_about_lens",
    "lens_kind",
    "tells_distortion",
    "tells_mirror",
]

LensKind = Literal["pinhole", "polynomial", "fisheye"]
"""`pinhole`: undistorted, or nothing is said of distortion; `polynomial`: OpenCV's radial and tangential
terms, a pinhole where all are zero; `fisheye`: Kannala and Brandt's, no pinhole whatever its terms."""

SIZE_NAMES = {
    "width": ("image_width", "image_Width", "imageWidth"),
    "height": ("image_height", "image_Height", "imageHeight"),
    "size": ("image_size", "imageSize", "image_Size", "img_size"),
}
"""What programs call width and height of the images that were calibrated with, and both in one entry."""

_DISTORTION = re.compile(r"(?<!un)distort|dist_?coef|^(lens_?)?dist$", re.IGNORECASE)
_TERM = re.compile(r"[kp][1-6]")
_NAMES_OF_PRODUCTS_TOO = ("camera_model", "lens_model", "model")
"""Names of entries that may hold what an endoscope's maker calls it."""
_MODEL_NAMES = ("distortion_model", "calibration_model", "projection_model", *_NAMES_OF_PRODUCTS_TOO)
_MIRROR_NAMES = ("xi", "mirror_parameters")
"""The parameter of Mei's model as OpenCV's omnidir writes it, and the mapping in which camodocal does."""
_SWITCHES = ("fisheye_model", "fisheye", "is_fisheye")
_KINDS: dict[str, LensKind] = {
    **dict.fromkeys(("", "none", "no", "pinhole", "simple_pinhole", "perspective", "undistorted"), "pinhole"),
    **dict.fromkeys(
        ("plumb_bob", "rational", "rational_polynomial", "radtan", "radial_tangential"),
        "polynomial",
    ),
    **dict.fromkeys(("brown", "brown_conrady"), "polynomial"),
    **dict.fromkeys(("opencv", "full_opencv", "simple_radial", "radial", "polynomial"), "polynomial"),
    **dict.fromkeys(
        ("fisheye", "opencv_fisheye", "equidistant", "equi", "kannala_brandt", "kannala_brandt4", "kb4"),
        "fisheye",
    ),
}
_WORDS_OF_LENSES = re.compile(
    r"fish|omni|catadioptric|radial|division|sphere|spherical|equidist|equirect|equisolid|stereographic|"
    r"scaramuzza|ocam|kannala|unified|mirror|orthograph|pinhole|distort|opencv|prism|"
    r"^(fov|atan|mei|ucm|eucm|ds|kb\d*)$"
)
_EXAMPLES = "pinhole, plumb_bob, rational_polynomial, opencv, fisheye or equidistant"
_YES, _NO = ("1", "true", "yes", "on"), ("0", "false", "no", "off")
_EMPTY = ("", "none", "null")
_LONGEST_SHOWN = 60


def _is_named_distortion(name: str) -> bool:
    """Whether an entry holds distortion, by its name: `dist_coeffs`, `lens_distortion`, `D`, `k1`.

    Names of models and distances do not.
    """
    if name in _MODEL_NAMES:
        return False
    return name == "D" or _TERM.fullmatch(name) is not None or _DISTORTION.search(name) is not None


def is_about_lens(name: str) -> bool:
    """Whether an entry is one that `check_pinhole` looks at, by its name."""
    return _is_named_distortion(name) or name in (*_MODEL_NAMES, *_SWITCHES, *_MIRROR_NAMES)


def tells_distortion(name: str, value: Any) -> bool:
    """Whether an entry tells of distortion; terms that are zero, none at all and the word `none` do not."""
    return _is_named_distortion(name) and _is_more_than_nothing(value)


def tells_mirror(name: str, value: Any) -> bool:
    """Whether an entry is a parameter of the unified omnidirectional model that is not zero.

    With a parameter of zero this model is a pinhole with OpenCV's terms of distortion.
    """
    return name in _MIRROR_NAMES and _is_more_than_nothing(value)


def check_without_mirror(entries: Mapping[str, Any], *, file: Path, frame: object = None) -> None:
    """Refuse entries of the unified omnidirectional model, with which pixels lie elsewhere.

    Args:
        entries: by name.
        file: that holds them.
        frame: whose they are; None for all frames.

    Raises:
        SourceError: names the entry.
    """
    for name, value in entries.items():
        if tells_mirror(name, value):
            problem = (
                f"{_shown(value)}; this is the unified omnidirectional model (Mei; cv::omnidir), not known "
                "here; expected a calibration as a pinhole with distortion, a fisheye or OCamCalib's"
            )
            raise SourceError(problem, file=file, frame=frame, field=name)


def lens_kind(name: str, value: Any, file: Path) -> LensKind | None:
    """The kind of lens that an entry names; None where it is about something else.

    `camera_model`, `lens_model` and `model` may be what an endoscope's maker calls it, and count only where
    they name a lens. A mapping is looked through, and a lens of more terms counts before one of fewer.

    Raises:
        SourceError: a lens that is not known here, or no answer to whether it is a fisheye.
    """
    if value is None:
        return None
    if name in _SWITCHES:
        answer = _answer(name, value, file)
        return None if answer is None else "fisheye" if answer else "polynomial"
    if name not in _MODEL_NAMES:
        return None
    if name != "distortion_model" and isinstance(value, Mapping):
        return _kind_in_mapping(name, value, file)
    return _named_kind(name, value, file, may_be_product=name in _NAMES_OF_PRODUCTS_TOO)


def _named_kind(name: str, value: Any, file: Path, *, may_be_product: bool) -> LensKind | None:
    """The kind of lens that a text names; None for a text of which nothing is asked and that names none.

    Raises:
        SourceError: a lens that is not known here.
    """
    spelled = re.sub(r"[\s+/-]+", "_", str(value).strip().lower())
    # Projection and distortion in one, as Kalibr calls its models: pinhole-radtan.
    found = _KINDS.get(spelled, _KINDS.get(spelled.removeprefix("pinhole_")))
    if found is None and (not may_be_product or _WORDS_OF_LENSES.search(spelled) is not None):
        problem = f"found {value!r}; expected a lens model that is known here, such as {_EXAMPLES}"
        raise SourceError(problem, file=file, field=name)
    return found


def check_pinhole(entries: Mapping[str, Any], instead: str, *, file: Path, frame: object = None) -> None:
    """Refuse entries that describe a lens with distortion, where they would otherwise be passed over.

    Args:
        entries: by name.
        instead: how such a lens is given, as a sentence.
        file: that holds them.
        frame: whose they are; None for all frames.

    Raises:
        SourceError: names the entry.
    """
    check_without_mirror(entries, file=file, frame=frame)
    for name, value in entries.items():
        if tells_distortion(name, value) or _names_other_lens(name, value, file):
            problem = f"{_shown(value)}; expected a pinhole here. {instead}"
            raise SourceError(problem, file=file, frame=frame, field=name)


def _names_other_lens(name: str, value: Any, file: Path) -> bool:
    """Whether an entry names a lens that is no pinhole, or one that is not known."""
    try:
        kind = lens_kind(name, value, file)
    except SourceError:
        return True
    # A model of distortion is a pinhole's where its terms are zero, and these are looked at by themselves.
    is_projection = name in _MODEL_NAMES and name != "distortion_model"
    return kind == "fisheye" or (kind == "polynomial" and is_projection)


def _kind_in_mapping(name: str, entries: Mapping[str, Any], file: Path) -> LensKind | None:
    """The kind of lens that any entry of a mapping names.

    Raises:
        SourceError: a lens that is not known here, or distortion or a mirror, which are not looked for there.
    """
    check_without_mirror({str(entry): value for entry, value in entries.items()}, file=file)
    for entry, value in entries.items():
        if tells_distortion(str(entry), value):
            problem = f"{entry!r} is distortion; expected it beside this entry"
            raise SourceError(problem, file=file, field=name)
    kinds: set[LensKind | None] = set()
    for value in entries.values():
        if isinstance(value, Mapping):
            kinds.add(_kind_in_mapping(name, value, file))
        elif value is not None:
            kinds.add(_named_kind(name, value, file, may_be_product=True))
    return next((kind for kind in get_args(LensKind)[::-1] if kind in kinds), None)


def _answer(name: str, value: Any, file: Path) -> bool | None:
    """Whether a switch is on; None where it is left empty.

    Raises:
        SourceError: neither yes nor no.
    """
    spelled = str(value).strip().lower()
    # Programs write whole numbers as 1.0 or `1.`, too.
    spelled = re.sub(r"\.0*$", "", spelled)
    if spelled in _EMPTY:
        return None
    if spelled in _YES:
        return True
    if spelled in _NO:
        return False
    raise SourceError(f"found {value!r}; expected 1 or 0, true or false", file=file, field=name)


def _shown(value: Any) -> str:
    # Matrices of a calibration file are arrays by now.
    shown = json.dumps(value, default=str)
    return shown if len(shown) <= _LONGEST_SHOWN else f"{shown[:_LONGEST_SHOWN]} ..."


def _is_more_than_nothing(value: Any) -> bool:
    if isinstance(value, Mapping):
        # A matrix of OpenCV's or of ROS says how large it is, too.
        return _is_more_than_nothing(value.get("data", list(value.values())))
    if isinstance(value, list | tuple | np.ndarray):
        return any(_is_more_than_nothing(item) for item in value)
    if value is None or isinstance(value, str):
        return any(not _is_nothing(part) for part in (value or "").lower().split())
    return bool(value != 0)


def _is_nothing(word: str) -> bool:
    try:
        return float(word) == 0
    except ValueError:
        return word in ("none", "null", "false", "no")
