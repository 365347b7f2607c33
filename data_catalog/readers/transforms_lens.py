"""The lens that the keys of a `transforms.json` state, for all frames or for one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_catalog.images import image_size
from extrags.errors import SourceError
from extrags.lens import LENS_PARAMETERS, Lens

__all__ = ["DISTORTION_KEYS", "StatedLens"]

DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_NERFSTUDIO_HAS_NOT = ("k4", "k5", "k6")
"""Its OPENCV is a polynomial of k1 to k4. COLMAP's has two terms, and the full one, which k3 needs, divides
by k4 to k6."""


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
        width, height = self._size(image)
        fx, fy = self._focal_lengths(width, height)
        named = {
            "fx": fx,
            "fy": fy,
            "cx": self._number("cx", width / 2),
            "cy": self._number("cy", height / 2),
            **{key: self._number(key, 0.0) for key in DISTORTION_KEYS},
        }
        fallback = "OPENCV_FISHEYE" if self.values.get("is_fisheye") else "OPENCV"
        stated = str(self.values.get("camera_model", fallback))
        model = _colmap_model(stated, named)
        parameters = LENS_PARAMETERS.get(model)
        if parameters is None or not set(parameters) <= set(named):
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

    def _size(self, image: Path) -> tuple[int, int]:
        """Width and height in pixels."""
        if not ("w" in self.values and "h" in self.values):
            return image_size(image, frame=self.frame)
        if not (np.isfinite(self._number("w")) and np.isfinite(self._number("h"))):
            raise self._error("no image size; expected w and h in pixels", "w")
        return int(self._number("w")), int(self._number("h"))

    def _focal_lengths(self, width: int, height: int) -> tuple[float, float]:
        """In pixels; where one of the two is stated, it is that of both axes."""
        if "fl_x" in self.values or "fl_y" in self.values:
            fx = self._number("fl_x" if "fl_x" in self.values else "fl_y")
            return fx, self._number("fl_y", fx)
        if "camera_angle_x" in self.values:
            fx = width / 2 / np.tan(self._number("camera_angle_x") / 2)
            if "camera_angle_y" in self.values:
                return fx, height / 2 / np.tan(self._number("camera_angle_y") / 2)
            return fx, fx
        raise self._error(
            "no focal length; expected fl_x (pixels) or camera_angle_x (radians), for all frames or in each",
            "fl_x",
        )

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
