"""Calibration files of endoscopes (OpenCV, Kalibr, Scaramuzza), which take the place of a source's own lens.

* OpenCV: YAML, XML or JSON of `cv::FileStorage` with `camera_matrix` and `distortion_coefficients` (0, 4, 5,
  8 or more numbers; with 4 and `fisheye_model: 1`, or a `distortion_model`, `camera_model`,
  `calibration_model`, `lens_model` or `projection_model` that says so, the Kannala-Brandt fisheye), and
  `image_width` and `image_height`, or `image_size` with both, without which the calibration holds for the
  images as they are. Numbers are a matrix of OpenCV's, a plain list, or what ROS writes (`rows`, `cols`,
  `data`). A mirror's parameter `xi` is refused, unless it is 0.
* Kalibr: the `camchain.yaml` with the camera `cam0`, of a stereo endoscope's right camera `cam1` where there
  is one: pinhole with radtan, equidistant, fov or no distortion.
* Scaramuzza: `calib_results.txt` of OCamCalib, a polynomial of fourth degree.

In all three the centre of the first pixel is (0, 0); here it is (0.5, 0.5).

Source: https://docs.opencv.org (calib3d, FileStorage); Kalibr's wiki, "Supported models" and "Yaml formats";
Scaramuzza et al., "A toolbox for easily calibrating omnidirectional cameras", IROS 2006.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_catalog.c3vd.pinhole import PinholeResampling, own_pixels
from data_catalog.c3vd.scaramuzza import ScaramuzzaCamera, camera_from_json
from data_catalog.file_storage import read_file_storage
from data_catalog.lens_entries import SIZE_NAMES, check_without_mirror, lens_kind, tells_distortion
from data_catalog.posed_frames import SourceFrames
from data_catalog.sampling import CameraModel, LensSampling, Sampling
from extrags.config import IngestConfig
from extrags.errors import ConfigError, SourceError, SourceNotFoundError, reason_of
from extrags.lens import Lens
from extrags.provenance import StereoCamera
from extrags.yaml_text import read_yaml

__all__ = ["CALIBRATION_VERSION", "LENS_OF_POSES", "read_calibration", "with_calibration_file"]

logger = logging.getLogger(__name__)

LENS_OF_POSES = (
    "Its poses were solved together with that lens, and with another one they would not fit the images: "
    "solve them again with yours, or give the images alone a folder of their own, and poses are estimated "
    "with it"
)
"""Why the lens of a source stays whose poses are of structure from motion."""

CALIBRATION_VERSION = 6
"""Raised by hand whenever the same file gives another camera."""

_PROPORTION_TOLERANCE = 0.005
_COMPARED = 33
"""Rows and columns of the grid over an image on which two lenses are compared."""
_OPENCV_NAMES = {
    "K": ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K"),
    "D": (
        *("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "dist_coeff"),
        *("distortion_coeffs", "distortion", "dist", "D"),
    ),
    **SIZE_NAMES,
}
_MODEL = "distortion_model"
_OPENCV_COUNTS = (0, 4, 5, 8, 12, 14)
_KALIBR_CAMERA = re.compile(r"""^[\s{"']*cam0["']?\s*:""", re.MULTILINE)
_KALIBR_NAME = re.compile(r"cam(\d{1,3})")
_KALIBR_MODELS = {
    "none": ("PINHOLE", 0),
    "radtan": ("OPENCV", 4),
    "equidistant": ("OPENCV_FISHEYE", 4),
    "fov": ("FOV", 1),
}


def read_calibration(
    file: Path, width: int, height: int, *, camera: StereoCamera | None = None
) -> Lens | ScaramuzzaCamera:
    """The camera that a calibration file describes, for images of a size.

    Args:
        file: told apart by its content.
        width: of the images, in pixels.
        height: of the images, in pixels.
        camera: of a stereo endoscope, whose images they are: of a file of Kalibr's with several cameras the
            second is that of the right one. None takes the first.

    Returns:
        A lens of COLMAP's names (pixel centres at +0.5), or Scaramuzza's camera (centres at integers).

    Raises:
        SourceNotFoundError: no such file.
        SourceError: damaged, of an unknown kind, or for images of another proportion; names file and field.
    """
    return _camera(_text(file), file, width, height, camera)


def _camera(
    text: str, file: Path, width: int, height: int, camera: StereoCamera | None
) -> Lens | ScaramuzzaCamera:
    """What `read_calibration` gives, of the content of a file."""
    if "#polynomial coefficients" in text:
        return _ocamcalib(text, file).scaled(width, height, file=file)
    if _is_kalibr(text):
        return _scaled(_kalibr(text, file, camera), width, height, file)
    if any(name in text for name in _OPENCV_NAMES["K"][:3]):
        return _scaled(_opencv(text, width, height, file), width, height, file)
    raise SourceError(
        "no calibration recognised; expected OpenCV's camera_matrix, Kalibr's cam0 with distortion_model, or "
        "OCamCalib's polynomial coefficients",
        file=file,
        field="calibration",
    )


def _text(file: Path) -> str:
    if not file.is_file():
        raise SourceNotFoundError("no such calibration file", file=file, field="ingest.calibration")
    try:
        # Editors on Windows put a mark at the beginning.
        text = file.read_text(encoding="utf-8-sig")
    except (UnicodeDecodeError, OSError) as error:
        raise SourceError(
            f"cannot be read as text: {reason_of(error)}", file=file, field="calibration"
        ) from error
    return text


def with_calibration_file(source: SourceFrames, file: Path) -> SourceFrames:
    """A source with the lens of a calibration file in place of its guess, or of what it states.

    By how much the two differ is said where the source states its own.

    Raises:
        ConfigError: the source's own lens has to stay, as the one its poses were solved with.
        SourceError: from `read_calibration`.
    """
    if source.lens_stays is not None:
        raise ConfigError(
            f"ingest.calibration is {file.name}, but the source {source.pose_file.name} states its "
            f"intrinsics itself. {source.lens_stays}"
        )
    # Once, so that all that is said and done is of the same content.
    text = _text(file)
    lenses = {
        lens: _camera(text, file, lens.width, lens.height, source.stereo_camera)
        for lens in dict.fromkeys(frame.lens for frame in source.frames)
    }
    _tell_of_cameras(text, file, source.stereo_camera)
    if source.intrinsics != "guessed":
        stated, calibrated = next(iter(lenses.items()))
        logger.warning(
            "%s: ingest.calibration, %s, takes the place of the intrinsics stated there: %s",
            source.pose_file,
            file.name,
            _difference(stated, calibrated),
            extra={"topic": "calibration", "field": "K"},
        )
    return replace(
        source,
        frames=[replace(frame, lens=lenses[frame.lens]) for frame in source.frames],
        intrinsics="given",
        intrinsics_file=file,
        sampling=_sampling,
    )


def _difference(stated: CameraModel, calibrated: Lens | ScaramuzzaCamera) -> str:
    """How far apart two lenses show the same directions, in words."""
    focal_px = calibrated.K[0, 0] if isinstance(calibrated, Lens) else calibrated.a0
    if not isinstance(stated, Lens):
        return f"focal length {focal_px:.1f} px in the file"
    focal = f"focal length {stated.K[0, 0]:.1f} px there and {focal_px:.1f} px in the file"
    if not stated.is_pinhole:
        return focal
    side = np.linspace(0, 1, _COMPARED)
    pixels = np.stack(np.meshgrid(side * stated.width, side * stated.height), axis=-1).reshape(-1, 2)
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(stated.K).T
    if isinstance(calibrated, Lens):
        there = np.stack(calibrated.project(rays[:, 0], rays[:, 1]), axis=1)
    else:
        there = calibrated.project(rays) + 0.5
    apart = np.linalg.norm(there - pixels, axis=1)
    return (
        f"{focal}; the same directions lie {float(np.median(apart)):.1f} px apart in the median over the "
        f"image, at most {float(apart.max()):.1f} px"
    )


def _sampling(camera: Any, config: IngestConfig, first: Sampling | None) -> Sampling:
    """As for any other lens: the source's size and central resolution unless the settings say otherwise."""
    if not isinstance(camera, ScaramuzzaCamera):
        return LensSampling.planned(camera, config, first)
    usual: dict[str, Any] = {}
    if config.width is None and config.downscale is None:
        usual["downscale"] = 1
    if config.lens == "native":
        return own_pixels(camera, config.model_copy(update=usual), first)
    if config.field_of_view_deg is None:
        usual["field_of_view_deg"] = float(np.degrees(2 * np.arctan(camera.width / 2 / camera.a0)))
    return PinholeResampling.planned(camera, config.model_copy(update=usual))


@dataclass(frozen=True)
class _Described:
    """What a file says of a camera, pixel centres at integers."""

    model: str
    K: np.ndarray
    distortion: tuple[float, ...]
    width: int
    height: int


def _scaled(found: _Described, width: int, height: int, file: Path) -> Lens:
    ratio = width / found.width
    if abs(height - ratio * found.height) > max(1.0, _PROPORTION_TOLERANCE * height):
        raise SourceError(
            f"the calibration is for {found.width} x {found.height} pixels; an image of {width} x {height} "
            f"has another proportion, expected {width} x {round(ratio * found.height)}",
            file=file,
            field="calibration",
        )
    fx, fy = found.K[0, 0] * ratio, found.K[1, 1] * ratio
    cx, cy = (found.K[0, 2] + 0.5) * ratio, (found.K[1, 2] + 0.5) * ratio
    parameters = (*(float(value) for value in (fx, fy, cx, cy)), *found.distortion)
    try:
        return Lens(found.model, parameters, width, height)
    except SourceError as error:
        raise SourceError(error.problem, file=file, field=error.field) from error


def _opencv(text: str, width: int, height: int, file: Path) -> _Described:
    storage = read_file_storage(text, file, (*_OPENCV_NAMES["K"], *_OPENCV_NAMES["D"]))
    K, D = (_matrix(storage, name, file) for name in ("K", "D"))
    width, height = _size(storage, file) or (width, height)
    check_without_mirror(storage, file=file)
    fisheye = _is_fisheye(storage, file)
    if K is None or K.size != 9:
        raise SourceError("expected a matrix of 3 x 3 numbers", file=file, field="camera_matrix")
    K = K.reshape(3, 3)
    unread = [name for name in storage if tells_distortion(name, storage[name])]
    if D is None and unread:
        raise SourceError(
            f"expected this name for the distortion; {unread[0]!r} is not known here",
            file=file,
            field="distortion_coefficients",
        )
    terms = () if D is None else tuple(float(value) for value in D.reshape(-1))
    if len(terms) not in _OPENCV_COUNTS or (fisheye and len(terms) != 4):
        expected = "4" if fisheye else ", ".join(map(str, _OPENCV_COUNTS))
        raise SourceError(
            f"{len(terms)} numbers; expected {expected}", file=file, field="distortion_coefficients"
        )
    if any(terms[8:]):
        raise SourceError(
            "thin-prism and tilt terms are not known here; expected them to be 0",
            file=file,
            field="distortion_coefficients",
        )
    terms = terms[:8]
    if any(terms) and lens_kind(_MODEL, storage.get(_MODEL), file) == "pinhole":
        raise SourceError(
            f"found {storage[_MODEL]!r}, but distortion coefficients that are not 0", file=file, field=_MODEL
        )
    if abs(K[0, 1]) > 1e-6 * abs(K[0, 0]):
        raise SourceError(f"a skew of {K[0, 1]:g}; expected 0", file=file, field="camera_matrix")
    if fisheye:
        model = "OPENCV_FISHEYE"
    elif not any(terms):
        model, terms = "PINHOLE", ()
    elif len(terms) == 4:
        model = "OPENCV"
    else:
        model, terms = "FULL_OPENCV", (*terms, 0.0, 0.0, 0.0)[:8]
    return _Described(model, K, terms, width, height)


def _is_fisheye(storage: Mapping[str, Any], file: Path) -> bool:
    """Whether the entries that name a lens say that it is a fisheye; without any it is none.

    Raises:
        SourceError: a lens that is not known here, or entries that contradict each other.
    """
    told = {name: lens_kind(name, value, file) for name, value in storage.items()}
    fisheye, others = (
        [name for name, kind in told.items() if kind == wanted] for wanted in ("fisheye", "polynomial")
    )
    if fisheye and others:
        name, other = fisheye[0], others[0]
        raise SourceError(
            f"found {storage[name]!r}, a fisheye, but {other} is {storage[other]!r}", file=file, field=name
        )
    return bool(fisheye)


def _size(storage: Mapping[str, Any], file: Path) -> tuple[int, int] | None:
    """Width and height of the images that were calibrated with; None where the file does not say.

    Raises:
        SourceError: it says one of the two, or no numbers.
    """
    name = next((name for name in _OPENCV_NAMES["size"] if name in storage), None)
    found = storage[name] if name is not None else [_node(storage, key) for key in ("width", "height")]
    listed = found.split() if isinstance(found, str) else found
    if name is None and listed == [None, None]:
        return None
    width, height = _numbers(listed, 2, file, name or "image_width, image_height")
    if width < 1 or height < 1:
        # Programs that do not know it write 0.
        return None
    return int(width), int(height)


def _node(storage: Mapping[str, Any], key: str) -> Any:
    return next((storage[name] for name in _OPENCV_NAMES[key] if name in storage), None)


def _matrix(storage: Mapping[str, Any], key: str, file: Path) -> np.ndarray | None:
    """Numbers of an entry: a matrix, a list of them or of rows, or what ROS writes; None without the entry.

    Raises:
        SourceError: there is an entry that is none of these.
    """
    name = next((name for name in _OPENCV_NAMES[key] if name in storage), None)
    if name is None or isinstance(storage[name], np.ndarray):
        return None if name is None else storage[name]
    found, shape = storage[name], None
    try:
        if isinstance(found, Mapping):
            shape, found = (int(found["rows"]), int(found["cols"])), found["data"]
        # A list of numbers in XML.
        listed = found.split() if isinstance(found, str) else found
        numbers = np.array(listed, dtype=np.float64)
        if not np.isfinite(numbers).all():
            raise ValueError("not all of them are finite")
        return numbers if shape is None else numbers.reshape(shape)
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        raise SourceError(f"expected numbers: {error}", file=file, field=name) from error


def _is_kalibr(text: str) -> bool:
    return "distortion_model" in text and _KALIBR_CAMERA.search(text) is not None


def _kalibr_cameras(text: str, file: Path) -> dict[str, Any]:
    """Entries of the cameras of Kalibr's file, in their order.

    Raises:
        SourceError: no YAML.
    """
    try:
        content = read_yaml(text)
    except ValueError as error:
        raise SourceError(f"no YAML: {error}", file=file, field="calibration") from error
    named = content.keys() if isinstance(content, Mapping) else ()
    numbers = {int(found[1]): name for name in named if (found := _KALIBR_NAME.fullmatch(str(name)))}
    return {str(numbers[number]): content[numbers[number]] for number in sorted(numbers)}


def _kalibr_name(cameras: Mapping[str, Any], camera: StereoCamera | None) -> str:
    """Which of Kalibr's cameras is meant; of one alone, that one."""
    return "cam1" if camera == "right" and "cam1" in cameras else "cam0"


def _tell_of_cameras(text: str, file: Path, camera: StereoCamera | None) -> None:
    """Say which camera of a file with several was taken."""
    cameras = _kalibr_cameras(text, file) if _is_kalibr(text) else {}
    if len(cameras) < 2:
        return
    taken = _kalibr_name(cameras, camera)
    if camera is not None:
        logger.info("%s: %s is taken, as that of the %s camera", file, taken, camera)
        return
    logger.warning(
        "%s: of %s, %s is taken; to take another, give it as cam0 of a file of its own",
        file,
        ", ".join(cameras),
        taken,
        extra={"topic": "calibration", "field": taken},
    )


def _kalibr(text: str, file: Path, which: StereoCamera | None) -> _Described:
    cameras = _kalibr_cameras(text, file)
    name = _kalibr_name(cameras, which)
    camera = cameras.get(name)
    if not isinstance(camera, Mapping):
        raise SourceError("expected the entries of a camera", file=file, field=name)
    if camera.get("camera_model") != "pinhole":
        raise SourceError(
            f"found {camera.get('camera_model')!r}; expected pinhole", file=file, field="camera_model"
        )
    kind = camera.get("distortion_model")
    if kind not in _KALIBR_MODELS:
        raise SourceError(
            f"found {kind!r}; expected {', '.join(_KALIBR_MODELS)}", file=file, field="distortion_model"
        )
    model, count = _KALIBR_MODELS[kind]
    fx, fy, cx, cy = _numbers(camera.get("intrinsics"), 4, file, "intrinsics")
    terms = _numbers(camera.get("distortion_coeffs"), count, file, "distortion_coeffs") if count else ()
    width, height = (int(size) for size in _numbers(camera.get("resolution"), 2, file, "resolution"))
    if width < 1 or height < 1:
        raise SourceError(f"{width} x {height} pixels; expected positive", file=file, field="resolution")
    return _Described(model, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), terms, width, height)


def _ocamcalib(text: str, file: Path) -> ScaramuzzaCamera:
    """Axes of the toolbox are rows, columns and backwards; here columns, rows and forwards."""
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if len(rows) < 5:
        raise SourceError(
            f"{len(rows)} lines with numbers; expected 5: polynomial, inverse, centre, affine, size",
            file=file,
            field="calibration",
        )
    count, *terms = _numbers(rows[0], len(rows[0]), file, "polynomial coefficients")
    if count != len(terms) or len(terms) != 5:
        raise SourceError(
            f"{len(terms)} coefficients; expected 5, a polynomial of fourth degree",
            file=file,
            field="polynomial coefficients",
        )
    row, column = _numbers(rows[2], 2, file, "center")
    c, d, e = _numbers(rows[3], 3, file, "affine parameters")
    height, width = _numbers(rows[4], 2, file, "image size")
    if abs(c) < 0.1:
        raise SourceError(f"c = {c:g}; expected nearly 1", file=file, field="affine parameters")
    # The stretch lies on the rows there and on the columns here: all lengths are counted in rows.
    content = {
        "width": width,
        "height": height,
        "cx": column,
        "cy": row,
        "a0": -c * terms[0],
        "a1": -terms[1],
        "a2": -terms[2] / c,
        "a3": -terms[3] / c**2,
        "a4": -terms[4] / c**3,
        "c": 1 / c,
        "d": d / c,
        "e": e / c,
    }
    return camera_from_json(content, file=file)


def _numbers(values: Any, count: int, file: Path, field: str) -> tuple[float, ...]:
    """So many finite numbers.

    Raises:
        SourceError: others.
    """
    listed = list(values) if isinstance(values, Sequence) and not isinstance(values, str) else None
    try:
        found = None if listed is None else tuple(float(value) for value in listed)
    except (TypeError, ValueError):
        found = None
    if found is None or len(found) != count or not np.isfinite(found).all():
        raise SourceError(f"found {values!r}; expected {count} finite numbers", file=file, field=field)
    return found
