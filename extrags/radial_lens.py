r"""Radial lenses that images are rendered through as they were taken, without resampling to a pinhole.

A ray at the angle :math:`\theta` from the optical axis meets the image at

.. math::
    r(\theta) = \theta \, (1 + k_1 \theta^2 + k_2 \theta^4 + k_3 \theta^6 + k_4 \theta^8), \qquad
    u = f_x \, r \cos\varphi + c_x, \quad v = f_y \, r \sin\varphi + c_y

with the azimuth :math:`\varphi`; focal lengths and principal point stand in the usual `K`. Beyond the field
that was calibrated r grows linearly, so that a Gaussian at the rim still has a footprint.

Source: Kannala and Brandt, "A generic camera model and calibration method for conventional, wide-angle and
fish-eye lenses", PAMI 2006; the parameters are those of OpenCV's fisheye model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from extrags.errors import SourceError

__all__ = [
    "LARGEST_ANGLE_RAD",
    "VIRTUAL_FIELD_DEG",
    "WIDE_FIELD_DEG",
    "LensFit",
    "RadialLens",
    "fitted_lens",
]

LARGEST_ANGLE_RAD = float(np.radians(85))
"""Largest field angle that is kept: z-depth vanishes at 90 degrees, and all that is measured by it."""

VIRTUAL_FIELD_DEG = 100.0
"""Horizontal field of view of virtual cameras, where the frames' lens shows that much."""

WIDE_FIELD_DEG = 130.0
"""The same of the pinholes that frames are taken for where as much of the lens as possible has to be covered:
corners are stretched, and what a still wider lens sees is left out."""

MARGIN_RAD = 0.15
"""Points so far outside the field of view are still projected; what lies beyond is culled."""

LARGEST_PROJECTED_RAD = float(np.radians(88))

SERIES_TERMS = 14
SERIES_SQUARE = 0.18
"""Up to this squared slope, tan^2 of the angle, the lens is its power series: see `RadialLens.series`."""

_TABLE_SIZE = 2048
_NEWTON_STEPS = 4
_POWERS = (1, 3, 5, 7, 9)
_FIT_ANGLES = 400
_FIT_DIRECTIONS = 32
_LEAST_ROLL_RAD = 1e-5


@dataclass(frozen=True)
class RadialLens:
    """A rotationally symmetric lens.

    Args:
        coefficients: k1 to k4.
        max_angle_rad: half the field of view that the polynomial holds for.

    Raises:
        SourceError: when a number is not finite, the field is empty or wider than `LARGEST_ANGLE_RAD`, or
            the polynomial folds back inside it or, beyond it, where points are still projected by it.
    """

    coefficients: tuple[float, float, float, float]
    max_angle_rad: float

    def __post_init__(self) -> None:
        if not np.isfinite([*self.coefficients, self.max_angle_rad]).all():
            raise SourceError(
                f"k1 to k4 are {self.coefficients} up to {self.max_angle_rad} rad; expected finite numbers",
                field="lens",
            )
        if not 0 < self.max_angle_rad <= LARGEST_ANGLE_RAD + 1e-9:
            raise SourceError(
                f"the lens reaches {np.degrees(self.max_angle_rad):.1f} degrees from its axis; expected more "
                f"than 0 and at most {np.degrees(LARGEST_ANGLE_RAD):.0f}",
                field="lens",
            )
        fold = self.folding_angle(self.coefficients, self.max_angle_rad)
        if fold is not None:
            field_end = np.degrees(self.max_angle_rad)
            where = (
                f"inside its field of {field_end:.1f} degrees"
                if fold <= self.max_angle_rad
                else f"beyond its field of {field_end:.1f} degrees, but before the "
                f"{np.degrees(self.linear_from_rad):.1f} degrees up to which points are projected by k1 to k4"
            )
            raise SourceError(
                f"the lens with k1 to k4 {self.coefficients} folds back {np.degrees(fold):.1f} degrees from "
                f"its axis, {where}",
                field="lens",
            )

    @property
    def linear_from_rad(self) -> float:
        """Angle from which r grows linearly: the end of the field, or of the series if that is later.

        Of a narrow field it is the angle of culling, where that comes before the end of the series.
        """
        return self._linear_from(self.max_angle_rad)

    @property
    def projected_up_to_rad(self) -> float:
        """Angle from which points are culled."""
        return self._projected_up_to(self.max_angle_rad)

    @classmethod
    def folding_angle(
        cls, coefficients: tuple[float, float, float, float], max_angle_rad: float
    ) -> float | None:
        """Angle in radians from which a polynomial does not rise any more where points are projected by it.

        Args:
            coefficients: k1 to k4.
            max_angle_rad: half the field of view.

        Returns:
            None where it rises up to the end.
        """
        angle = np.linspace(0, cls._linear_from(max_angle_rad), 512)
        falling = np.flatnonzero(cls._slope(coefficients, angle) <= 1e-3)
        return float(angle[falling[0]]) if falling.size else None

    @classmethod
    def _linear_from(cls, max_angle_rad: float) -> float:
        end_of_series = float(np.arctan(np.sqrt(SERIES_SQUARE))) + 0.01
        return max(max_angle_rad, min(end_of_series, cls._projected_up_to(max_angle_rad)))

    @staticmethod
    def _projected_up_to(max_angle_rad: float) -> float:
        return min(max_angle_rad + MARGIN_RAD, LARGEST_PROJECTED_RAD)

    @staticmethod
    def _slope(coefficients: tuple[float, float, float, float], angle: Any) -> Any:
        """Derivative of r, by the polynomial alone."""
        k1, k2, k3, k4 = coefficients
        square = np.square(angle)
        return 1 + square * (3 * k1 + square * (5 * k2 + square * (7 * k3 + square * 9 * k4)))

    def _polynomial(self, angle: Any) -> tuple[Any, Any]:
        """R and its derivative, by the polynomial alone."""
        k1, k2, k3, k4 = self.coefficients
        square = np.square(angle)
        radius = angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
        return radius, self._slope(self.coefficients, angle)

    def radius(self, angle: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
        """r(theta), in focal lengths."""
        held = np.minimum(angle, self.linear_from_rad)
        radius, slope = self._polynomial(held)
        return np.asarray(radius + slope * (angle - held))

    @cached_property
    def max_radius(self) -> float:
        """R at the end of the field of view."""
        return float(self.radius(np.array(self.max_angle_rad)))

    def angle(self, radius: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
        """Theta of r: the inverse of `radius`, by Newton's method from a table; at most 88 degrees."""
        angle_table = np.linspace(0, LARGEST_PROJECTED_RAD, _TABLE_SIZE)
        radius_table = self.radius(angle_table)
        angle = np.interp(radius, radius_table, angle_table)
        for _ in range(_NEWTON_STEPS):
            held = np.minimum(angle, self.linear_from_rad)
            found, slope = self._polynomial(held)
            angle = angle - (found + slope * (angle - held) - radius) / slope
        return np.asarray(np.clip(angle, 0, LARGEST_PROJECTED_RAD))

    def distorted(
        self, x: Float[np.ndarray, "*s"], y: Float[np.ndarray, "*s"]
    ) -> tuple[Float[np.ndarray, "*s"], Float[np.ndarray, "*s"]]:
        """Image position, in focal lengths from the principal point, of rays (X / Z, Y / Z).

        Returns:
            NaN beyond the angle up to which points are projected.
        """
        slope = np.hypot(x, y)
        angle = np.arctan(slope)
        gain = np.where(slope > 1e-12, self.radius(angle) / np.maximum(slope, 1e-12), 1.0)
        gain = np.where(angle <= self.projected_up_to_rad, gain, np.nan)
        return x * gain, y * gain

    def undistorted(
        self, x: Float[np.ndarray, "*s"], y: Float[np.ndarray, "*s"]
    ) -> tuple[Float[np.ndarray, "*s"], Float[np.ndarray, "*s"]]:
        """Rays (X / Z, Y / Z) of image positions: the inverse of `distorted`, held at 88 degrees."""
        radius = np.hypot(x, y)
        stretch = np.where(radius > 1e-12, np.tan(self.angle(radius)) / np.maximum(radius, 1e-12), 1.0)
        return x * stretch, y * stretch

    @cached_property
    def series(self) -> Float[np.ndarray, "14"]:
        """Power series of r / tan(theta) in tan^2(theta), for the neighbourhood of the axis.

        There the direct formula for its derivatives would be a difference of nearly equal numbers.
        """
        n = np.arange(SERIES_TERMS)
        arctangent = np.where(n % 2 == 0, 1.0, -1.0) / (2 * n + 1)  # theta / tan(theta)

        def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
            return np.convolve(a, b)[:SERIES_TERMS]

        square = np.concatenate([[0.0], product(arctangent, arctangent)])[:SERIES_TERMS]
        power, total = np.eye(1, SERIES_TERMS)[0], np.eye(1, SERIES_TERMS)[0]
        for k in self.coefficients:
            power = product(power, square)
            total = total + k * power
        return product(arctangent, total)

    def packed(self) -> Float[np.ndarray, "20"]:
        """What the kernels read, float32.

        k1 to k4, the series, the angle from which r is linear, and tan^2 of the angle of culling.
        """
        culled = np.tan(self.projected_up_to_rad) ** 2
        values = [*self.coefficients, *self.series, self.linear_from_rad, culled]
        return np.array(values, dtype=np.float32)

    def pinhole(
        self, K: Float[np.ndarray, "3 3"], width: int, height: int, field_of_view_deg: float
    ) -> Float[np.ndarray, "3 3"]:
        """Intrinsics of a centred pinhole of square pixels, for an image of the same size.

        Args:
            K: of the images taken through this lens.
            width: of the images, in pixels.
            height: of the images, in pixels.
            field_of_view_deg: horizontal, at most; less where the image shows less, on the side where it
                shows the least.
        """
        edge = np.array(min(K[0, 2], width - K[0, 2]) / K[0, 0])
        shown = 2 * min(float(self.angle(edge)), self.max_angle_rad)
        focal = width / 2 / np.tan(min(np.radians(field_of_view_deg), shown) / 2)
        return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])

    def to_json(self) -> dict[str, Any]:
        """For attributes of artefacts; see `from_json`."""
        return {"coefficients": list(self.coefficients), "max_angle_rad": self.max_angle_rad}

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> RadialLens:
        """From what `to_json` gave."""
        k1, k2, k3, k4 = (float(value) for value in content["coefficients"])
        return cls((k1, k2, k3, k4), float(content["max_angle_rad"]))


@dataclass(frozen=True)
class LensFit:
    """A radial lens fitted to a calibrated one.

    Args:
        lens: the fit.
        K: its focal lengths and principal point.
        error_px: largest distance of its pixels from the true ones, inside the image and the field of view.
        rms_px: root mean square of the same.
        roll_rad: turn of the image about the axis, from right to down, that a model with shear has and a
            radial one has not: the camera that is fitted stands turned by it.
    """

    lens: RadialLens
    K: Float[np.ndarray, "3 3"]
    error_px: float
    rms_px: float
    roll_rad: float = 0.0


def fitted_lens(
    project: Callable[
        [Float[np.ndarray, "*s"], Float[np.ndarray, "*s"]],
        tuple[Float[np.ndarray, "*s"], Float[np.ndarray, "*s"]],
    ],
    K: Float[np.ndarray, "3 3"],
    width: int,
    height: int,
    max_angle_rad: float,
) -> LensFit:
    """The radial lens nearest to a calibrated one, by linear least squares over the image.

    A narrow field says little about the higher ones of k1 to k4, and points beyond it are projected by them:
    where the polynomial folds back there, it is fitted anew without the last, then without the last two or
    three.

    Args:
        project: rays (X / Z, Y / Z) to pixels, centres at +0.5; NaN where the lens has none.
        K: principal point, kept, and focal lengths, of which the ratio is kept.
        width: of the image, in pixels.
        height: of the image, in pixels.
        max_angle_rad: largest angle that `project` holds for; the field ends at the corners if that is less.

    Raises:
        SourceError: when no direction falls into the image, the fit folds back inside the field, or every
            fit does beyond it.
    """
    end = min(max_angle_rad, LARGEST_ANGLE_RAD)
    angle = end * (np.arange(_FIT_ANGLES) + 1) / _FIT_ANGLES
    turn = np.arange(_FIT_DIRECTIONS) * (2 * np.pi / _FIT_DIRECTIONS)
    # The corners lie on diagonals that need not be among the even turns.
    to_corners = np.array([[x - K[0, 2], y - K[1, 2]] for x in (0.0, width) for y in (0.0, height)])
    turn = np.concatenate([turn, np.arctan2(to_corners[:, 1] / K[1, 1], to_corners[:, 0] / K[0, 0])])
    slope = np.tan(angle)[:, None]
    x, y = slope * np.cos(turn), slope * np.sin(turn)
    u, v = project(x, y)
    inside = (u >= 0) & (u <= width) & (v >= 0) & (v <= height)
    if not inside.any():
        raise SourceError("no direction in front of the lens falls into the image", field="lens")
    end = float(angle[np.flatnonzero(inside.any(axis=1))[-1]])
    with np.errstate(invalid="ignore"):
        seen_turn = np.arctan2((v - K[1, 2]) / K[1, 1], (u - K[0, 2]) / K[0, 0])
    roll = float(np.mean((seen_turn - turn + np.pi)[inside] % (2 * np.pi) - np.pi))
    # Tangential terms have no mean turn but for rounding, and for where the image ends.
    roll = roll if abs(roll) > _LEAST_ROLL_RAD else 0.0
    turn = turn + roll
    powers = angle[:, None] ** np.array(_POWERS)
    across, along = K[0, 0] * np.cos(turn), K[1, 1] * np.sin(turn)
    rows = np.concatenate(
        [(powers[:, None] * across[:, None])[inside], (powers[:, None] * along[:, None])[inside]]
    )
    sought = np.concatenate([(u - K[0, 2])[inside], (v - K[1, 2])[inside]])
    found, lens = _fitted_polynomial(rows, sought, end)
    fitted = K.astype(np.float64).copy()
    fitted[0, 0] *= found[0]
    fitted[1, 1] *= found[0]
    off = (rows @ found - sought).reshape(2, -1)
    distance = np.hypot(off[0], off[1])
    return LensFit(lens, fitted, float(distance.max()), float(np.sqrt(np.mean(distance**2))), roll)


def _fitted_polynomial(
    rows: Float[np.ndarray, "m 5"], sought: Float[np.ndarray, "m"], end: float
) -> tuple[Float[np.ndarray, "5"], RadialLens]:
    """The polynomial of most terms that does not fold back beyond the field, and its lens.

    Args:
        rows: what each coefficient, of the first power to the ninth, adds to each pixel coordinate.
        sought: the pixel coordinates, from the principal point.
        end: of the field, in radians.

    Returns:
        Coefficients of the powers, in pixels, and the lens.

    Raises:
        SourceError: when the polynomial folds back inside the field, or with any number of terms.
    """
    for terms in range(len(_POWERS), 1, -1):
        found = np.zeros(len(_POWERS))
        found[:terms] = np.linalg.lstsq(rows[:, :terms], sought, rcond=None)[0]
        k1, k2, k3, k4 = (float(value) for value in found[1:] / found[0])
        fold = RadialLens.folding_angle((k1, k2, k3, k4), end)
        if fold is None or fold <= end:
            break
    return found, RadialLens((k1, k2, k3, k4), end)
