"""The lens that the keys of a `transforms.json` state, for all frames or for one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_catalog.images import image_size
from data_catalog.lens_entries import check_without_mirror
from extrags.errors import SourceError
from extrags.lens import LENS_PARAMETERS, Lens

__all__ = ["DISTORTION_KEYS", "FOCAL_KEYS", "StatedLens", "stated_values"]

DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_FOCAL_KEYS_OF_AXES = (("fl_x", "x_fov", "camera_angle_x"), ("fl_y", "y_fov", "camera_angle_y"))
"""In pixels, in degrees and in radians; the first that is stated counts."""
FOCAL_KEYS = tuple(key for keys in _FOCAL_KEYS_OF_AXES for key in keys)
_FTHETA_KEYS = tuple(f"ftheta_p{number}" for number in range(5))
_OTHER_PROJECTIONS = ("latlong", "equirectangular", "orthographic")
_FISHEYE = "OPENCV_FISHEYE"
_MODELS = ("PINHOLE", "OPENCV", "FULL_OPENCV", _FISHEYE)
"""To which `_colmap_model` leads, of those that these files can state."""
_NERFSTUDIO_HAS_NOT = ("k4", "k5", "k6")
"""Its OPENCV is a polynomial of k1 to k4. COLMAP's has two terms, and the full one, which k3 needs, divides
by k4 to k6."""


def stated_values(content: Mapping[str, Any], entry: Mapping[str, Any]) -> dict[str, Any]:
    """What holds for a frame: its own values before those of all frames.

    A focal length of the frame takes the place of that of all frames on the same axis, whichever of the keys
    the two are stated by.

    Args:
        content: of all frames.
        entry: of the frame.
    """
    replaced = {key for keys in _FOCAL_KEYS_OF_AXES if any(key in entry for key in keys) for key in keys}
    return {**{key: value for key, value in content.items() if key not in replaced}, **entry}


@dataclass(frozen=True)
class StatedLens:
    """What is stated of the camera of a frame.

    Args:
        values: by key; those of the frame itself have gone before those of all frames.
        file: that states them, named in errors.
        frame: named in errors.
    """

    values: Mapping[str, Any]
    file: Path
    frame: str

    def lens(self, image: Path) -> Lens:
        """The lens, as one of COLMAP's models.

        Args:
            image: of the frame; its size is taken where none is stated.

        Raises:
            SourceError: a key is missing, is no number, or does not belong to the model that is stated.
        """
        self._check_projection()
        width, height = self._size(image)
        fx, fy = self._focal_lengths(width, height)
        named = {
            "fx": fx,
            "fy": fy,
            "cx": self._number("cx", width / 2),
            "cy": self._number("cy", height / 2),
            **{key: self._number(key, 0.0) for key in DISTORTION_KEYS},
        }
        stated = str(self.values.get("camera_model", _FISHEYE if self.values.get("is_fisheye") else "OPENCV"))
        if self.values.get("is_fisheye") and stated != _FISHEYE:
            # instant-ngp goes by the one and nerfstudio by the other.
            raise self._error(
                f"camera_model {stated!r} beside is_fisheye; expected {_FISHEYE}, or no is_fisheye",
                "camera_model",
            )
        if stated == _FISHEYE and "camera_model" not in self.values:
            self._check_fisheye_has_terms(named)
        model = _colmap_model(stated, named)
        parameters = LENS_PARAMETERS.get(model)
        if parameters is None or model not in _MODELS:
            raise self._error(
                f"camera_model {model!r} is not understood; expected PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, "
                "RADIAL, OPENCV, FULL_OPENCV or OPENCV_FISHEYE",
                "camera_model",
            )
        self._check_terms(stated, named, parameters)
        try:
            return Lens(model, tuple(float(named[key]) for key in parameters), width, height)
        except SourceError as error:
            raise self._error(error.problem, error.field) from error

    def _check_fisheye_has_terms(self, named: Mapping[str, float]) -> None:
        """Refuse `is_fisheye` alone.

        instant-ngp's `read_lens` (https://github.com/NVlabs/instant-ngp, src/nerf_loader.cu) reads a pinhole
        where all terms are 0, whatever `is_fisheye` says; nerfstudio's reader of its files
        (https://github.com/nerfstudio-project/nerfstudio/pull/1385) an equidistant fisheye.
        """
        if not any(named[key] for key in DISTORTION_KEYS):
            raise self._error(
                "is_fisheye without k1 to k4 is a pinhole for instant-ngp and an equidistant fisheye for "
                f"nerfstudio; expected camera_model {_FISHEYE} or PINHOLE, or the terms of the lens",
                "is_fisheye",
            )

    def _size(self, image: Path) -> tuple[int, int]:
        """Width and height in pixels."""
        if not ("w" in self.values and "h" in self.values):
            return image_size(image, frame=self.frame)
        if not (np.isfinite(self._number("w")) and np.isfinite(self._number("h"))):
            raise self._error("no image size; expected w and h in pixels", "w")
        return int(self._number("w")), int(self._number("h"))

    def _check_projection(self) -> None:
        """Refuse what instant-ngp reads as another camera, whatever else is stated."""
        check_without_mirror(self.values, file=self.file, frame=self.frame)
        known = "expected a pinhole, or one of COLMAP's lenses (camera_model)"
        for key in _FTHETA_KEYS:
            if key in self.values:
                raise self._error(f"an f-theta camera ({key}) is not known here; {known}", key)
        for key in _OTHER_PROJECTIONS:
            if self.values.get(key):
                raise self._error(f"a camera with {key} projection is not known here; {known}", key)

    def _focal_lengths(self, width: int, height: int) -> tuple[float, float]:
        """In pixels; where that of one axis is stated, it is that of both."""
        of_axes = zip(_FOCAL_KEYS_OF_AXES, (width, height), strict=True)
        fx, fy = (self._focal_length(keys, size) for keys, size in of_axes)
        focal = fx if fx is not None else fy
        if focal is None:
            raise self._error(
                "no focal length; expected fl_x (pixels), camera_angle_x (radians) or x_fov (degrees), for "
                "all frames or in each",
                "fl_x",
            )
        return focal, fy if fy is not None else focal

    def _focal_length(self, keys: tuple[str, str, str], size: int) -> float | None:
        """In pixels, of one axis; None where nothing is stated of it.

        Args:
            keys: of the focal length in pixels, and of the field of view in degrees and in radians.
            size: of the image along this axis, in pixels.
        """
        in_px, in_deg, in_rad = keys
        if in_px in self.values:
            return self._number(in_px)
        key = next((key for key in (in_deg, in_rad) if key in self.values), None)
        if key is None:
            return None
        angle_rad = self._number(key) if key == in_rad else float(np.radians(self._number(key)))
        if not 0 < angle_rad < np.pi:
            raise self._error(
                f"{key} = {self._number(key):g}; expected an angle between 0 and 180 degrees", key
            )
        return float(size / 2 / np.tan(angle_rad / 2))

    def _check_terms(self, stated: str, named: Mapping[str, float], parameters: tuple[str, ...]) -> None:
        """Refuse a term of distortion that the model has not, unless it is 0."""
        has_not = _NERFSTUDIO_HAS_NOT if stated == "OPENCV" else ()
        for key in DISTORTION_KEYS:
            if named[key] and (key not in parameters or key in has_not):
                raise self._error(
                    f"{key} = {named[key]:g} with camera_model {stated}, which has no such term; expected "
                    f"the model that the camera was calibrated with, or {key} = 0",
                    key,
                )

    def _number(self, key: str, otherwise: float | None = None) -> float:
        """A value; `otherwise` where it is not stated."""
        if key not in self.values and otherwise is not None:
            return otherwise
        try:
            return float(self.values[key])
        except (KeyError, OverflowError, TypeError, ValueError) as error:
            raise self._error(f"{key} = {self.values.get(key)!r}; expected a number", key) from error

    def _error(self, problem: str, field: str | None) -> SourceError:
        return SourceError(problem, file=self.file, frame=self.frame, field=field)


def _colmap_model(stated: str, named: Mapping[str, float]) -> str:
    """COLMAP's model for a `camera_model`: of OPENCV the smallest that has all terms that are not 0."""
    if stated in ("PINHOLE", "SIMPLE_PINHOLE"):
        return "PINHOLE"
    if stated in ("SIMPLE_RADIAL", "RADIAL"):
        return "OPENCV"
    if stated != "OPENCV":
        return stated
    if named["k3"] or named["k4"]:
        return "FULL_OPENCV"
    return "OPENCV" if any(named[key] for key in ("k1", "k2", "p1", "p2")) else "PINHOLE"
