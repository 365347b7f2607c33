"""The omnidirectional camera model of C3VD's endoscope.

A pixel p (centres at integers, as published) belongs to the ray (u_x, u_y, f(rho)) with
u = [[c, e], [d, 1]]^-1 (p - centre), rho = |u| and f(rho) = a0 + a2 rho^2 + a3 rho^3 + a4 rho^4. Camera axes
are OpenCV's. Pixels of this module have their centres at integers; the rest of extrags has them at +0.5, and
`data_catalog.c3vd.pinhole` is where the half pixel is added.

Source: Scaramuzza et al., "A flexible technique for accurate omnidirectional camera calibration and structure
from motion", ICVS 2006; calibrations as published with C3VD and C3VDv2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from extrags.errors import SourceError
from extrags.radial_lens import LARGEST_ANGLE_RAD, LensFit, fitted_lens

__all__ = ["CALIBRATIONS", "CalibrationName", "ScaramuzzaCamera", "camera_from_json"]

CalibrationName = Literal["c3vd", "c3vdv2"]

_TABLE_SIZE = 4096
_NEWTON_STEPS = 4
# Beyond the image's corner by this factor, pixels still have rays: bicubic filters look a little outside.
_BEYOND_CORNER = 1.02
_PROPORTION_TOLERANCE = 0.005


@dataclass(frozen=True)
class ScaramuzzaCamera:
    """A calibrated fisheye.

    Args:
        width: image width in pixels.
        height: image height in pixels.
        cx: column of the distortion centre, pixel centres at integers.
        cy: row of the distortion centre.
        a0: polynomial, in pixels.
        a2: polynomial, per pixel.
        a3: polynomial, per pixel squared.
        a4: polynomial, per pixel cubed.
        c: stretch of the columns.
        d: shear of the rows.
        e: shear of the columns.
    """

    width: int
    height: int
    cx: float
    cy: float
    a0: float
    a2: float
    a3: float
    a4: float
    c: float = 1.0
    d: float = 0.0
    e: float = 0.0

    def scaled(self, width: int, height: int, *, file: object = None) -> ScaramuzzaCamera:
        """The same lens for images of another size; pixel edges stay where they are.

        Raises:
            SourceError: another proportion, so that no scale fits both axes.
        """
        if (width, height) == (self.width, self.height):
            return self
        s = width / self.width
        if abs(height - s * self.height) > max(1.0, _PROPORTION_TOLERANCE * height):
            raise SourceError(
                f"the calibration is for {self.width} x {self.height} pixels; an image of {width} x {height} "
                f"has another proportion, expected {width} x {round(s * self.height)}",
                file=file,
                field="calibration",
            )
        return replace(
            self,
            width=width,
            height=height,
            cx=(self.cx + 0.5) * s - 0.5,
            cy=(self.cy + 0.5) * s - 0.5,
            a0=self.a0 * s,
            a2=self.a2 / s,
            a3=self.a3 / s**2,
            a4=self.a4 / s**3,
        )

    def axial(self, radius_px: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
        """f(rho): the ray's z where its (x, y) is rho pixels long."""
        return np.asarray(self.a0 + radius_px**2 * (self.a2 + radius_px * (self.a3 + radius_px * self.a4)))

    def rays(self, pixels: Float[np.ndarray, "*s 2"]) -> Float[np.ndarray, "*s 3"]:
        """Unit rays of pixels (column, row; centres at integers), in camera axes."""
        u = (pixels - np.array([self.cx, self.cy])) @ np.linalg.inv(self._stretch).T
        z = self.axial(np.hypot(u[..., 0], u[..., 1]))
        ray = np.concatenate([u, z[..., None]], axis=-1)
        return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))

    def project(self, rays: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s 2"]:
        """Pixels (column, row; centres at integers) of rays of any length.

        The smallest positive root of r f(rho) = rho z, by Newton's method from a table; the result meets
        `rays` to about 1e-11 px.

        Returns:
            NaN where a ray leaves the part of the lens the model holds for.
        """
        r = np.hypot(rays[..., 0], rays[..., 1])
        length = np.maximum(np.hypot(r, rays[..., 2]), 1e-300)
        r, z = r / length, rays[..., 2] / length
        radius_table, angle_table = self._table
        angle = np.arctan2(r, z)
        rho = np.interp(angle, angle_table, radius_table)
        for _ in range(_NEWTON_STEPS):
            slope = rho * (2 * self.a2 + rho * (3 * self.a3 + rho * 4 * self.a4))
            rho = rho - (r * self.axial(rho) - z * rho) / (r * slope - z)
        share = np.where(r > 1e-12, rho / np.maximum(r, 1e-12), self.a0)
        u = rays[..., :2] / length[..., None] * share[..., None]
        pixels = u @ self._stretch.T + np.array([self.cx, self.cy])
        return np.where((angle <= angle_table[-1])[..., None], pixels, np.nan)

    def radial(self) -> LensFit:
        """The radial lens nearest to this one, in extrags' pixels (centres at +0.5).

        Raises:
            SourceError: when the fit folds back.
        """
        K = np.array([[self.c * self.a0, 0, self.cx + 0.5], [0, self.a0, self.cy + 0.5], [0, 0, 1.0]])

        def project(
            x: Float[np.ndarray, "*s"], y: Float[np.ndarray, "*s"]
        ) -> tuple[Float[np.ndarray, "*s"], Float[np.ndarray, "*s"]]:
            pixels = self.project(np.stack([x, y, np.ones_like(x)], axis=-1)) + 0.5
            return pixels[..., 0], pixels[..., 1]

        return fitted_lens(project, K, self.width, self.height, LARGEST_ANGLE_RAD)

    @property
    def _stretch(self) -> Float[np.ndarray, "2 2"]:
        return np.array([[self.c, self.e], [self.d, 1.0]])

    @cached_property
    def _table(self) -> tuple[Float[np.ndarray, "t"], Float[np.ndarray, "t"]]:
        """Radii and the angles from the axis they belong to, as far as the angle grows with the radius."""
        corner = np.hypot(max(self.cx, self.width - self.cx), max(self.cy, self.height - self.cy))
        radius = np.linspace(0, _BEYOND_CORNER * corner, _TABLE_SIZE)
        angle = np.arctan2(radius, self.axial(radius))
        falling = np.flatnonzero(np.diff(angle) <= 0)
        end = int(falling[0]) + 1 if falling.size else _TABLE_SIZE
        return radius[:end], angle[:end]


CALIBRATIONS: dict[CalibrationName, ScaramuzzaCamera] = {
    "c3vd": ScaramuzzaCamera(
        width=1350,
        height=1080,
        cx=678.544839263292,
        cy=542.975887548343,
        a0=769.243600037458,
        a2=-8.12770624150226e-4,
        a3=6.25674244578925e-7,
        a4=-1.19662182144280e-9,
        c=0.999986882249990,
        d=0.00288273829525059,
        e=-0.00296316513429569,
    ),
    "c3vdv2": ScaramuzzaCamera(
        width=1350,
        height=1080,
        cx=677.739464094188,
        cy=543.057997844875,
        a0=767.733695862103,
        a2=-5.92506426558248e-4,
        a3=-2.69440266600040e-7,
        a4=-2.16380341010063e-10,
        c=0.9999,
        d=1.10e-4,
        e=-1.83e-4,
    ),
}
"""As published, for frames of 1350 x 1080 pixels. Some third-party copies of the first have cx and cy + 1."""


def camera_from_json(content: Any, *, file: object = None) -> ScaramuzzaCamera:
    """The camera of a `calibration.json`.

    Args:
        content: parsed JSON with width, height, cx, cy, a0, a2, a3, a4, and optionally c, d, e, and a1
            (which must be 0).
        file: named in errors.

    Raises:
        SourceError: an entry is missing, no number, or makes no lens; names it.
    """
    if not isinstance(content, dict):
        raise SourceError("expected an object with the entries of the camera", file=file, field="calibration")

    def number(name: str, default: float | None = None) -> float:
        value = content.get(name, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise SourceError(f"found {value!r}, expected a finite number", file=file, field=name)
        return float(value)

    width, height = number("width"), number("height")
    for name, size in (("width", width), ("height", height)):
        if size < 16 or size != int(size):
            raise SourceError(f"{size:g} pixels; expected a whole number from 16 on", file=file, field=name)
    if number("a1", 0.0) != 0:
        raise SourceError(
            f"found {content['a1']}; the model has no linear term, expected 0", file=file, field="a1"
        )
    camera = ScaramuzzaCamera(
        int(width),
        int(height),
        *(number(name) for name in ("cx", "cy", "a0", "a2", "a3", "a4")),
        *(number(name, default) for name, default in (("c", 1.0), ("d", 0.0), ("e", 0.0))),
    )
    if not 0.05 * width < camera.a0 < 20 * width:
        raise SourceError(
            f"a0 = {camera.a0:g} px makes no lens for images {width:g} pixels wide; expected it to be "
            "positive, near the focal length (z grows forward)",
            file=file,
            field="a0",
        )
    for name, centre, size in (("cx", camera.cx, width), ("cy", camera.cy, height)):
        if not 0 < centre < size:
            raise SourceError(
                f"{centre:g} px lies outside an image of {width:g} x {height:g} pixels", file=file, field=name
            )
    if abs(camera.c - 1) > 0.1 or abs(camera.d) > 0.1 or abs(camera.e) > 0.1:
        raise SourceError(
            f"[[c, e], [d, 1]] = [[{camera.c:g}, {camera.e:g}], [{camera.d:g}, 1]]; expected nearly "
            "the identity",
            file=file,
            field="c",
        )
    return camera
