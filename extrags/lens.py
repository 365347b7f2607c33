"""Lens models of COLMAP and OpenCV, and images resampled from them to a pinhole.

Names and parameters are COLMAP's; pixel centres lie at +0.5. A distorted image is resampled once, straight
from its true model: for each pixel of the pinhole, where the lens put that ray. The pinhole keeps size and
central resolution of the source (or gets the field of view asked for), with square pixels and a centred
principal point; what the lens did not
see, or saw beyond the radius where its polynomial folds back, is left out of the validity mask.

Source: COLMAP's camera models (https://colmap.github.io/cameras.html); Kannala and Brandt, "A generic camera
model and calibration method for conventional, wide-angle and fish-eye lenses", PAMI 2006 (fisheye);
Khomutenko, Garcia and Martinet, "An enhanced unified camera model", RA-L 2016 (EUCM); Fitzgibbon,
"Simultaneous linear estimation of multiple view geometry and lens distortion", CVPR 2001 (division).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from extrags.config import IngestConfig
from extrags.errors import SourceError
from extrags.radial_lens import LARGEST_ANGLE_RAD, LensFit, RadialLens, fitted_lens

__all__ = [
    "LENS_PARAMETERS",
    "MUCH_LEFT_OUT",
    "Lens",
    "Undistortion",
    "distortion_of_pinhole",
    "keeps_central_resolution",
    "left_out_share",
    "pinhole_size",
    "resized_depth",
    "sample_depth",
    "size_for_focal",
    "source_areas",
]

LENS_PARAMETERS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "FOV": ("fx", "fy", "cx", "cy", "omega"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "THIN_PRISM_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        *("fx", "fy", "cx", "cy"),
        *("k0", "k1", "k2", "k3", "k4", "k5"),
        *("p0", "p1", "s0", "s1", "s2", "s3"),
    ),
    "SIMPLE_DIVISION": ("f", "cx", "cy", "k"),
    "DIVISION": ("fx", "fy", "cx", "cy", "k"),
    "SIMPLE_FISHEYE": ("f", "cx", "cy"),
    "FISHEYE": ("fx", "fy", "cx", "cy"),
    "EUCM": ("fx", "fy", "cx", "cy", "alpha", "beta"),
}
"""Every model understood here, with the names of its parameters; both are in COLMAP's order."""

_INTRINSIC_NAMES = frozenset({"f", "fx", "fy", "cx", "cy"})
# A field of view of COLMAP's FOV below which the model is a pinhole.
_LEAST_OMEGA_RAD = 1e-9
# Directions and radii in which a polynomial is searched for its fold.
_FOLD_DIRECTIONS = 16
_FOLD_STEPS = 2000
# Neighbouring depths that differ by more than this share lie on different surfaces.
_FOLD_STEP = 0.05


LARGEST_PX = 65_535
"""Longest side of an image; what announces more is damaged."""

MUCH_LEFT_OUT = 0.2
"""Share of a source's picture that the pinhole may leave out without a warning."""


@dataclass(frozen=True)
class Lens:
    """How one camera maps rays to pixels.

    Args:
        model: a key of `LENS_PARAMETERS`.
        parameters: its parameters, in that order.
        width: image width in pixels.
        height: image height in pixels.

    Raises:
        SourceError: an unknown model, a wrong number of parameters, or one that is not finite.
    """

    model: str
    parameters: tuple[float, ...]
    width: int
    height: int

    def __post_init__(self) -> None:
        names = LENS_PARAMETERS.get(self.model)
        if names is None:
            raise SourceError(
                f"the camera model {self.model} is not known here; known: {', '.join(LENS_PARAMETERS)}",
                field="camera_model",
            )
        if len(self.parameters) != len(names):
            raise SourceError(
                f"{len(self.parameters)} parameters for the model {self.model}; expected {len(names)}: "
                f"{', '.join(names)}",
                field="camera parameters",
            )
        if not (1 <= self.width <= LARGEST_PX and 1 <= self.height <= LARGEST_PX):
            raise SourceError(
                f"an image of {self.width} x {self.height} pixels; expected 1 to {LARGEST_PX} each",
                field="image size",
            )
        for name, value in zip(names, self.parameters, strict=True):
            if not np.isfinite(value):
                raise SourceError(f"{name} = {value}; expected a finite number", field="camera parameters")

    @classmethod
    def pinhole(cls, K: Float[np.ndarray, "3 3"], width: int, height: int) -> Lens:
        """The lens of an undistorted image.

        Args:
            K: without skew.
            width: image width in pixels.
            height: image height in pixels.
        """
        parameters = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
        return cls("PINHOLE", parameters, width, height)

    def scaled(self, width: int, height: int) -> Lens:
        """The same lens in images of another size.

        Args:
            width: image width in pixels.
            height: image height in pixels; of nearly the same proportion where there is one focal length.
        """
        across, down = width / self.width, height / self.height
        factors = {"f": across, "fx": across, "cx": across, "fy": down, "cy": down}
        named = zip(LENS_PARAMETERS[self.model], self.parameters, strict=True)
        return Lens(self.model, tuple(value * factors.get(name, 1.0) for name, value in named), width, height)

    @classmethod
    def fisheye(cls, K: Float[np.ndarray, "3 3"], radial: RadialLens, width: int, height: int) -> Lens:
        """OpenCV's fisheye of a radial lens.

        Args:
            K: without skew.
            radial: how rays are bent.
            width: image width in pixels.
            height: image height in pixels.
        """
        linear = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
        return cls("OPENCV_FISHEYE", (*linear, *radial.coefficients), width, height)

    def radial(self) -> LensFit:
        """The radial lens nearest to this one, up to where the model folds back.

        Raises:
            SourceError: when no direction falls into the image, or the fit folds back.
        """
        end = np.arctan(self.fold_radius(float(np.tan(LARGEST_ANGLE_RAD))))
        return fitted_lens(self.project, self.K, self.width, self.height, float(end))

    def value(self, name: str) -> float:
        """One parameter by name; 0 where the model has none of that name."""
        names = LENS_PARAMETERS[self.model]
        return float(self.parameters[names.index(name)]) if name in names else 0.0

    @property
    def K(self) -> Float[np.ndarray, "3 3"]:
        """The linear part: focal lengths and principal point."""
        one = self.value("f")
        fx, fy = (one, one) if one else (self.value("fx"), self.value("fy"))
        return np.array([[fx, 0, self.value("cx")], [0, fy, self.value("cy")], [0, 0, 1.0]])

    @property
    def central_focal_px(self) -> float:
        """Focal length of the pinhole of square pixels that keeps the resolution at the centre, in pixels.

        It is that of the linear part, but for FOV, whose distortion magnifies the centre.
        """
        focal = float(np.sqrt(self.K[0, 0] * self.K[1, 1]))
        omega = self.value("omega")
        if abs(omega) < _LEAST_OMEGA_RAD:
            return focal
        return focal * float(2 * np.tan(omega / 2) / omega)

    @property
    def is_pinhole(self) -> bool:
        """Whether the linear part is all there is."""
        if self.model == "FOV" or self.model.endswith("FISHEYE"):
            return False
        if self.model == "EUCM":
            return self.value("alpha") == 0
        names = LENS_PARAMETERS[self.model]
        return all(
            value == 0
            for name, value in zip(names, self.parameters, strict=True)
            if name not in _INTRINSIC_NAMES
        )

    def distorted(
        self, x: Float[np.ndarray, "*s"], y: Float[np.ndarray, "*s"]
    ) -> tuple[Float[np.ndarray, "*s"], Float[np.ndarray, "*s"]]:
        """Normalised coordinates after the lens; not a number where the model has none.

        Args:
            x: ray direction X / Z.
            y: ray direction Y / Z.
        """
        k1, k2, k3, k4 = (self.value(name) for name in ("k1", "k2", "k3", "k4"))
        p1, p2 = self.value("p1"), self.value("p2")
        r = np.hypot(x, y)
        safe = np.maximum(r, 1e-12)
        if self.model == "FOV":
            omega = self.value("omega")
            if abs(omega) < _LEAST_OMEGA_RAD:
                return x, y
            scale = np.where(r > 1e-9, np.arctan(2 * r * np.tan(omega / 2)) / (omega * safe), 1.0)
            return x * scale, y * scale
        if self.model.endswith("DIVISION"):
            # r = d / (1 + k d^2), solved for d; the other root lies beyond the fold.
            with np.errstate(invalid="ignore"):
                scale = 2 / (1 + np.sqrt(1 - 4 * self.value("k") * r * r))
            return x * scale, y * scale
        if self.model == "EUCM":
            alpha = self.value("alpha")
            with np.errstate(invalid="ignore", divide="ignore"):
                scale = 1 / (alpha * np.sqrt(1 + self.value("beta") * r * r) + 1 - alpha)
            # The projection needs a positive distance from the second centre.
            scale = np.where(scale > 0, scale, np.nan)
            return x * scale, y * scale
        if self.model.endswith("FISHEYE"):
            angle = np.arctan(r)
            turned = np.where(r > 1e-9, angle / safe, 1.0)
            x, y = x * turned, y * turned
        square = x * x + y * y
        if self.model == "RAD_TAN_THIN_PRISM_FISHEYE":
            return self._with_thin_prism(x, y, square)
        radial = 1 + square * (k1 + square * (k2 + square * (k3 + square * k4)))
        if self.model == "FULL_OPENCV":
            k5, k6 = self.value("k5"), self.value("k6")
            radial = (1 + square * (k1 + square * (k2 + square * k3))) / (
                1 + square * (k4 + square * (k5 + square * k6))
            )
        return (
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x) + self.value("sx1") * square,
            y * radial + 2 * p2 * x * y + p1 * (square + 2 * y * y) + self.value("sy1") * square,
        )

    def _with_thin_prism(
        self, x: Float[np.ndarray, "*s"], y: Float[np.ndarray, "*s"], square: Float[np.ndarray, "*s"]
    ) -> tuple[Float[np.ndarray, "*s"], Float[np.ndarray, "*s"]]:
        """Six radial terms, then tangential and prism ones of what these give."""
        radial: Any = 0.0
        for name in ("k5", "k4", "k3", "k2", "k1", "k0"):
            radial = (radial + self.value(name)) * square
        x, y = x * (1 + radial), y * (1 + radial)
        square = x * x + y * y
        p0, p1, s0, s1, s2, s3 = (self.value(name) for name in ("p0", "p1", "s0", "s1", "s2", "s3"))
        both = 2 * (p0 * x + p1 * y)
        return (
            x + x * both + p0 * square + square * (s0 + s1 * square),
            y + y * both + p1 * square + square * (s2 + s3 * square),
        )

    def project(
        self, x: Float[np.ndarray, "*s"], y: Float[np.ndarray, "*s"]
    ) -> tuple[Float[np.ndarray, "*s"], Float[np.ndarray, "*s"]]:
        """Pixel coordinates of rays (X / Z, Y / Z), centres at +0.5; not a number where there is none."""
        K = self.K
        moved_x, moved_y = self.distorted(x, y)
        return K[0, 0] * moved_x + K[0, 2], K[1, 1] * moved_y + K[1, 2]

    def fold_radius(self, up_to: float) -> float:
        """Normalised radius X / Z from which the model maps outward rays inward; at most `up_to`."""
        radius = np.linspace(0, up_to, _FOLD_STEPS)
        limit = up_to
        for turn in np.arange(_FOLD_DIRECTIONS) * (2 * np.pi / _FOLD_DIRECTIONS):
            x, y = self.distorted(radius * np.cos(turn), radius * np.sin(turn))
            falling = np.flatnonzero(np.diff(x * np.cos(turn) + y * np.sin(turn)) <= 0)
            if falling.size:
                limit = min(limit, float(radius[falling[0]]))
        return limit


@dataclass(frozen=True)
class Undistortion:
    """A plan to resample images of one lens to a pinhole.

    Args:
        K: of the pinhole.
        u: column in the source of each pixel's ray, centres at +0.5; not a number where the lens has none.
        v: row in the source, the same way.
        valid: whether the lens saw that ray.
    """

    K: Float[np.ndarray, "3 3"]
    u: Float[np.ndarray, "h w"]
    v: Float[np.ndarray, "h w"]
    valid: Bool[np.ndarray, "h w"]

    @classmethod
    def planned(
        cls,
        lens: Lens,
        field_of_view_deg: float | None = None,
        *,
        size: tuple[int, int] | None = None,
    ) -> Undistortion:
        """The pinhole for a lens: square pixels, centred.

        Args:
            lens: what the images were taken with.
            field_of_view_deg: horizontal, of the pinhole; None keeps the lens's own central resolution, which
                cuts off the outermost part of what a fisheye sees.
            size: width and height of the pinhole's image, in pixels; None keeps the source's.
        """
        width, height = (lens.width, lens.height) if size is None else size
        focal = lens.central_focal_px
        if field_of_view_deg is not None:
            focal = float(width / 2 / np.tan(np.radians(field_of_view_deg) / 2))
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
        x, y = np.meshgrid(
            (np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal
        )
        u, v = lens.project(x, y)
        radius = np.hypot(x, y)
        # Half a pixel inside, so that no sample reaches over the border.
        valid = (u >= 0.5) & (u <= lens.width - 0.5) & (v >= 0.5) & (v <= lens.height - 0.5)
        valid &= radius < lens.fold_radius(float(radius.max()) * 1.01)
        return cls(K, u, v, valid)

    @classmethod
    def of_radial(
        cls,
        K: Float[np.ndarray, "3 3"],
        radial: RadialLens,
        width: int,
        height: int,
        field_of_view_deg: float,
    ) -> Undistortion:
        """The plan from images of a radial lens to its pinhole of the same size (`RadialLens.pinhole`).

        Args:
            K: of the images.
            radial: of the images.
            width: of the images, in pixels.
            height: of the images, in pixels.
            field_of_view_deg: horizontal, at most.
        """
        pinhole = radial.pinhole(K, width, height, field_of_view_deg)
        x, y = np.meshgrid(
            (np.arange(width) + 0.5 - pinhole[0, 2]) / pinhole[0, 0],
            (np.arange(height) + 0.5 - pinhole[1, 2]) / pinhole[1, 1],
        )
        inside = np.hypot(x, y) <= np.tan(radial.max_angle_rad)
        bent_x, bent_y = radial.distorted(np.where(inside, x, 0), np.where(inside, y, 0))
        u, v = K[0, 0] * bent_x + K[0, 2], K[1, 1] * bent_y + K[1, 2]
        inside &= (u >= 0.5) & (u <= width - 0.5) & (v >= 0.5) & (v <= height - 0.5)
        return cls(pinhole, u, v, inside)

    def image(self, image: Float[np.ndarray, "h w *c"]) -> Float[np.ndarray, "h2 w2 *c"]:
        """Values of any number of channels, float32, bilinear; zero where nothing was seen."""
        import cv2

        moved = cv2.remap(
            image.astype(np.float32), *self._maps(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        moved[~self.valid] = 0
        return np.asarray(moved)

    def color(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
        """Colours, bilinear; black where nothing was seen."""
        import cv2

        moved = cv2.remap(image, *self._maps(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        moved[~self.valid] = 0
        return np.asarray(moved)

    def mask(self, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h2 w2"]:
        """True where all source pixels that a sample touches are true, and the lens saw it."""
        import cv2

        moved = cv2.remap(
            mask.astype(np.float32), *self._maps(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray((moved > 0.999) & self.valid)

    def depth(self, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h2 w2"]:
        """z-depth, never mixed across a fold; 0 where unknown."""
        u, v = np.where(self.valid, self.u, 0.0), np.where(self.valid, self.v, 0.0)
        return np.where(self.valid, sample_depth(depth, u, v), 0).astype(np.float32)

    def _maps(self) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
        # OpenCV counts from pixel centres, and nowhere is no place for it.
        return np.nan_to_num(self.u - 0.5).astype(np.float32), np.nan_to_num(self.v - 0.5).astype(np.float32)


def distortion_of_pinhole(
    K: Float[np.ndarray, "3 3"],
    radial: RadialLens,
    pinhole: Float[np.ndarray, "3 3"],
    width: int,
    height: int,
) -> Undistortion:
    """The way back: from images of a pinhole to those of a radial lens with the same axes and size.

    Args:
        K: of the radial lens's images, which come out.
        radial: the lens.
        pinhole: intrinsics of the images that go in.
        width: of both, in pixels.
        height: of both, in pixels.
    """
    x, y = np.meshgrid(
        (np.arange(width) + 0.5 - K[0, 2]) / K[0, 0], (np.arange(height) + 0.5 - K[1, 2]) / K[1, 1]
    )
    inside = np.hypot(x, y) <= radial.max_radius
    x, y = radial.undistorted(x, y)
    u, v = pinhole[0, 0] * x + pinhole[0, 2], pinhole[1, 1] * y + pinhole[1, 2]
    inside &= (u >= 0.5) & (u <= width - 0.5) & (v >= 0.5) & (v <= height - 0.5)
    return Undistortion(K, u, v, inside)


def size_for_focal(width: int, height: int, angle_rad: float, focal_px: float) -> tuple[int, int]:
    """Width and height in pixels at which a pinhole of a field of view has a focal length.

    Args:
        width: of the source; the result is never smaller.
        height: of the source; the proportion is kept.
        angle_rad: horizontal field of view, below pi.
        focal_px: focal length that is to be reached.
    """
    wide = max(width, int(np.ceil(2 * focal_px * np.tan(angle_rad / 2) - 1e-6)))
    return wide, round(height * wide / width)


def sample_depth(
    depth: Float[np.ndarray, "h w"], u: Float[np.ndarray, "*s"], v: Float[np.ndarray, "*s"]
) -> Float[np.ndarray, "*s"]:
    """Depth at pixel coordinates (centres at +0.5).

    Where the four neighbours are known and close, their inverse depth is interpolated (exact on a plane
    seen by a pinhole); elsewhere the nearest value is taken. Coordinates outside take the border's value.
    """
    height, width = depth.shape
    x = np.clip(u - 0.5, 0, width - 1)
    y = np.clip(v - 0.5, 0, height - 1)
    j = np.clip(np.floor(x).astype(int), 0, max(width - 2, 0))
    i = np.clip(np.floor(y).astype(int), 0, max(height - 2, 0))
    a, b = y - i, x - j
    right, down = np.minimum(j + 1, width - 1), np.minimum(i + 1, height - 1)
    corners = np.stack([depth[i, j], depth[i, right], depth[down, j], depth[down, right]]).astype(np.float64)
    weights = np.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b])
    nearest = np.take_along_axis(corners, weights.argmax(axis=0)[None], axis=0)[0]
    low, high = corners.min(axis=0), corners.max(axis=0)
    one_surface = (low > 0) & (high <= low * (1 + _FOLD_STEP))
    inverse = (weights / np.where(corners > 0, corners, 1)).sum(axis=0)
    return np.asarray(np.where(one_surface, 1 / np.where(one_surface, inverse, 1), nearest))


def resized_depth(depth: Float[np.ndarray, "h w"], width: int, height: int) -> Float[np.ndarray, "h2 w2"]:
    """A depth map at the pixel centres of an image of another size, as `sample_depth` gives it.

    OpenCV's nearest pixel is the one at the upper left, up to half a new pixel away from the centre.

    Args:
        depth: 0 where unknown.
        width: of the result, in pixels.
        height: of the result, in pixels.
    """
    u = (np.arange(width) + 0.5) * depth.shape[1] / width
    v = (np.arange(height) + 0.5) * depth.shape[0] / height
    return sample_depth(depth, *np.meshgrid(u, v)).astype(depth.dtype)


def keeps_central_resolution(config: IngestConfig) -> bool:
    """Whether a pinhole wider than the source's centre allows grows instead of losing resolution."""
    return config.size == "central" and config.width is None and config.downscale is None


def pinhole_size(lens: Lens, config: IngestConfig) -> tuple[int, int] | None:
    """Width and height in pixels at which a pinhole keeps the resolution at the centre of a lens's picture.

    Args:
        lens: of the source.
        config: with the field of view of the pinhole in degrees.

    Returns:
        None where the settings name no field of view or another size: the lens's own holds.
    """
    if config.field_of_view_deg is None or not keeps_central_resolution(config):
        return None
    focal = lens.central_focal_px
    return size_for_focal(lens.width, lens.height, float(np.radians(config.field_of_view_deg)), focal)


def left_out_share(lens: Lens, plan: Undistortion, picture: Float[np.ndarray, "h w"]) -> float:
    """Share of a source's picture that its pinhole does not show.

    Args:
        lens: of the source.
        plan: to the pinhole.
        picture: how much each pixel belongs to the picture, from 0 to 1, at any size of the source's
            proportion.

    Returns:
        0 where there is no picture.
    """
    import cv2

    height, width = picture.shape
    pixel = lens.width * lens.height / picture.size
    total = float(picture.sum()) * pixel
    if not total:
        return 0.0
    # OpenCV counts from pixel centres.
    columns, rows = plan.u * width / lens.width - 0.5, plan.v * height / lens.height - 0.5
    found = cv2.remap(
        picture.astype(np.float32),
        columns.astype(np.float32),
        rows.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    # Where a lens shows nothing of a direction, its map may be NaN, and so is what is found there.
    shown = np.where(plan.valid, source_areas(plan.u, plan.v) * found, 0)
    return 1 - float(shown.sum()) / total


def source_areas(u: Float[np.ndarray, "h w"], v: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Area in source pixels of each pixel of a picture that is looked up in another.

    Args:
        u: column in the source, in pixels, [H, W]; not a number where there is none.
        v: row in the source, the same way.

    Returns:
        0 where it is unknown, [H, W].
    """
    (u_down, u_right), (v_down, v_right) = np.gradient(u), np.gradient(v)
    return np.asarray(np.nan_to_num(np.abs(u_right * v_down - u_down * v_right)))
