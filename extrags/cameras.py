"""Cameras and rigid motions.

A camera is a pinhole unless it has a radial lens: virtual views and resampled frames are pinholes, frames in
their original pixels have the lens they were taken with.

Axes are OpenCV's: x right, y down, z forward. Pixel centres lie at +0.5. Poses are kept as
`world_from_camera` in float64; the rasteriser gets `viewmats` (camera from world) in float32.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from extrags.array_shapes import check_instance, check_whole
from extrags.errors import PoseError, ShapeError
from extrags.radial_lens import VIRTUAL_FIELD_DEG, RadialLens

__all__ = [
    "Cameras",
    "as_rotation",
    "compose",
    "field_mask",
    "invert_poses",
    "look_at",
    "pixel_rays",
    "project_points",
    "rays_of_pixels",
    "rotation_about",
    "rotation_angle_deg",
    "transform_points",
    "unproject_pixels",
]

# Quaternions printed with six digits give rotations that are off by about 1e-6; a larger deviation than
# this is not rounding, but a matrix that is no rotation.
ROTATION_TOLERANCE = 1e-2

_ROUNDED_TOLERANCE = {1: 0.15, 2: 0.015}
"""How far (Frobenius) a rotation may be from SO(3) whose entries have so many digits after the point: each of
nine is off by half of the last one. With one digit cameras are turned by up to 4 degrees, with two by less
than half a degree."""


@dataclass(frozen=True, slots=True)
class Cameras:
    """A batch of cameras that share one image size, and one lens if they have one.

    Args:
        K: intrinsics in pixels, [C, 3, 3], float64.
        world_from_camera: rigid camera-to-world motions, [C, 4, 4], float64.
        width: image width in pixels.
        height: image height in pixels.
        lens: how rays are bent before `K`; None for pinholes.

    Raises:
        ShapeError: when the arrays do not fit each other, or the size is no size.
    """

    K: Float[np.ndarray, "c 3 3"]
    world_from_camera: Float[np.ndarray, "c 4 4"]
    width: int
    height: int
    lens: RadialLens | None = None

    def __post_init__(self) -> None:
        check_instance(self.K, "Cameras: K", np.ndarray)
        check_instance(self.world_from_camera, "Cameras: world_from_camera", np.ndarray)
        check_whole("Cameras: width", self.width)
        check_whole("Cameras: height", self.height)
        if self.width < 1 or self.height < 1:
            raise ShapeError(f"Cameras of {self.width} x {self.height} px, expected at least 1 x 1")
        n = len(self.world_from_camera)
        if self.world_from_camera.shape != (n, 4, 4) or self.K.shape != (n, 3, 3):
            raise ShapeError(
                f"Cameras need K [C, 3, 3] and world_from_camera [C, 4, 4], "
                f"found {self.K.shape} and {self.world_from_camera.shape}"
            )

    def __len__(self) -> int:
        return int(self.world_from_camera.shape[0])

    def check_finite(self) -> None:
        """Refuse poses or intrinsics that hold NaN or infinity.

        Raises:
            PoseError: names the first such view by its position.
        """
        for name in ("world_from_camera", "K"):
            finite = np.isfinite(getattr(self, name)).all(axis=(1, 2))
            if not finite.all():
                raise PoseError(
                    f"view {int(np.flatnonzero(~finite)[0])} of {len(self)} holds NaN or infinity", field=name
                )

    def __repr__(self) -> str:
        lens = "pinholes" if self.lens is None else "radial lens"
        return f"Cameras({len(self)} views of {self.width} x {self.height} px, {lens})"

    def __getitem__(self, index: int | slice | Sequence[int] | np.ndarray) -> Cameras:
        """Select cameras; an integer keeps the batch axis."""
        chosen = np.arange(len(self))[index]
        chosen = np.atleast_1d(chosen)
        return Cameras(self.K[chosen], self.world_from_camera[chosen], self.width, self.height, self.lens)

    @property
    def viewmats(self) -> Float[np.ndarray, "c 4 4"]:
        """Camera from world, [C, 4, 4], float64."""
        return invert_poses(self.world_from_camera)

    @property
    def centers(self) -> Float[np.ndarray, "c 3"]:
        """Camera centres in world coordinates."""
        return self.world_from_camera[:, :3, 3]

    @property
    def forward(self) -> Float[np.ndarray, "c 3"]:
        """Unit optical axes in world coordinates."""
        return self.world_from_camera[:, :3, 2]

    def interpolated(self, steps: int) -> Cameras:
        """A camera path through these cameras, e.g. for a fly-through.

        Centres and intrinsics are interpolated linearly, orientations along the shortest rotation (slerp).

        Args:
            steps: number of steps from each camera to the next; 1 returns the cameras themselves.

        Returns:
            `(C - 1) * steps + 1` cameras.
        """
        from scipy.spatial.transform import Rotation, Slerp

        if len(self) < 2:
            return self
        known = np.arange(len(self))
        at = np.arange((len(self) - 1) * steps + 1) / steps
        poses = np.tile(np.eye(4), (len(at), 1, 1))
        poses[:, :3, :3] = Slerp(known, Rotation.from_matrix(self.world_from_camera[:, :3, :3]))(
            at
        ).as_matrix()
        before = np.minimum(at.astype(np.int64), len(self) - 2)
        share = (at - before)[:, None]
        poses[:, :3, 3] = (1 - share) * self.centers[before] + share * self.centers[before + 1]
        share = share[..., None]
        K = (1 - share) * self.K[before] + share * self.K[before + 1]
        return Cameras(K, poses, self.width, self.height, self.lens)

    def resized(self, width: int, height: int) -> Cameras:
        """The same views at another resolution, in pixels; intrinsics are scaled, image borders stay."""
        K = self.K.copy()
        K[:, 0] *= width / self.width
        K[:, 1] *= height / self.height
        return Cameras(K, self.world_from_camera, width, height, self.lens)

    def at_most_width(self, width: int) -> Cameras:
        """The same views, downscaled to this width in pixels if they are wider; the aspect ratio is kept."""
        if self.width <= width:
            return self
        return self.resized(width, max(1, round(self.height * width / self.width)))

    def as_pinholes(self, field_of_view_deg: float = VIRTUAL_FIELD_DEG) -> Cameras:
        """Pinholes of the same poses and image size; pinholes are returned as they are.

        Args:
            field_of_view_deg: horizontal, at most; less where the lens's images show less.
        """
        if self.lens is None:
            return self
        K = [self.lens.pinhole(K, self.width, self.height, field_of_view_deg) for K in self.K]
        return Cameras(np.reshape(K, (-1, 3, 3)), self.world_from_camera, self.width, self.height)

    @property
    def field(self) -> Bool[np.ndarray, "c h w"]:
        """Pixels inside the field of view of the lens; all of a pinhole's."""
        if self.lens is None:
            return np.ones((len(self), self.height, self.width), dtype=bool)
        return np.stack([field_mask(K, self.lens, self.width, self.height) for K in self.K])

    def project(
        self, points: Float[np.ndarray, "*p 3"]
    ) -> tuple[Float[np.ndarray, "c *p 2"], Float[np.ndarray, "c *p"]]:
        """Project world points into every camera; occlusion is not considered.

        Args:
            points: in world coordinates.

        Returns:
            Pixels (u, v), NaN for points that are not in front of the camera or outside the field of its
            lens, and z-depths in world units. Both float64.
        """
        local = np.stack([transform_points(viewmat, points) for viewmat in self.viewmats])
        pixels = np.stack([project_points(part, K, self.lens) for part, K in zip(local, self.K, strict=True)])
        return pixels, local[..., 2]

    def contains(self, pixels: Float[np.ndarray, "*p 2"]) -> Bool[np.ndarray, "*p"]:
        """Whether pixel positions (u, v) lie inside the image; false for NaN."""
        u, v = pixels[..., 0], pixels[..., 1]
        return np.asarray((u >= 0) & (u < self.width) & (v >= 0) & (v < self.height))

    @staticmethod
    def concatenated(parts: Sequence[Cameras]) -> Cameras:
        """Concatenate batches along the camera axis.

        Raises:
            ShapeError: when the image sizes or the lenses differ.
        """
        sizes = {(part.width, part.height) for part in parts}
        if len(sizes) != 1:
            raise ShapeError(f"cameras of different image sizes cannot be joined: {sorted(sizes)}")
        if len({part.lens for part in parts}) != 1:
            raise ShapeError("cameras of different lenses cannot be joined")
        return Cameras(
            np.concatenate([part.K for part in parts]),
            np.concatenate([part.world_from_camera for part in parts]),
            parts[0].width,
            parts[0].height,
            parts[0].lens,
        )


def as_rotation(
    matrix: Float[np.ndarray, "3 3"], *, frame: object = None, file: object = None
) -> Float[np.ndarray, "3 3"]:
    """The rotation nearest to a matrix (polar decomposition), if the matrix is a rotation up to rounding.

    Args:
        matrix: rotation matrix as read from a file.
        frame: name of the frame, for the error message.
        file: name of the file, for the error message.

    Raises:
        PoseError: for non-finite entries, a mirrored matrix (det < 0), or one further than
            `ROTATION_TOLERANCE` from SO(3), unless two digits after the point explain it.
    """
    if not np.isfinite(matrix).all():
        raise PoseError(
            "the rotation holds NaN or infinity", file=file, frame=frame, field="world_from_camera"
        )
    u, singular, vt = np.linalg.svd(matrix)
    determinant = float(np.linalg.det(u @ vt))
    if determinant < 0:
        raise PoseError(
            f"the rotation is mirrored (det = {np.linalg.det(matrix):.3f}); expected det = +1. "
            "Axes are probably swapped or one of them is negated",
            file=file,
            frame=frame,
            field="world_from_camera",
        )
    digits = _digits(matrix)
    is_rounded = float(np.linalg.norm(singular - 1)) <= _ROUNDED_TOLERANCE.get(digits, 0.0)
    if float(np.abs(singular - 1).max()) > ROTATION_TOLERANCE and not (is_rounded and digits > 1):
        perhaps = "Is the matrix scaled, sheared or transposed?"
        if is_rounded:
            perhaps = (
                "Its entries have one digit after the point, which turns a camera by degrees: write six. If "
                "they are not rounded, the matrix is scaled or sheared"
            )
        raise PoseError(
            f"not a rotation: singular values {np.round(singular, 4).tolist()}, expected 1, 1, 1. {perhaps}",
            file=file,
            frame=frame,
            field="world_from_camera",
        )
    return np.asarray(u @ vt, dtype=np.float64)


def _digits(matrix: Float[np.ndarray, "3 3"]) -> int:
    """How many digits after the point the entries have; 3 stands for more, and for no rotation's entries."""
    if np.abs(matrix).max() > 1:
        return 3
    return next((n for n in (1, 2) if np.allclose(matrix, np.round(matrix, n), rtol=0, atol=1e-9)), 3)


def invert_poses(poses: Float[np.ndarray, "*b 4 4"]) -> Float[np.ndarray, "*b 4 4"]:
    """Inverses of rigid motions, from the transposed rotation; exact for orthonormal rotations."""
    inverse = np.zeros_like(poses)
    rotation = np.swapaxes(poses[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, poses[..., :3, 3])
    inverse[..., 3, 3] = 1
    return inverse


def compose(rotation: Float[np.ndarray, "3 3"], center: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """`world_from_camera` from a rotation and the camera centre."""
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = center
    return pose


def rotation_about(axis: Float[np.ndarray, "3"], angle_rad: float) -> Float[np.ndarray, "3 3"]:
    """Rotation by an angle about an axis (Rodrigues)."""
    x, y, z = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle_rad) * cross + (1 - np.cos(angle_rad)) * (cross @ cross))


def rotation_angle_deg(
    first: Float[np.ndarray, "*b 3 3"], second: Float[np.ndarray, "*b 3 3"]
) -> Float[np.ndarray, "*b"]:
    """Angle of the rotation between two orientations, in degrees."""
    trace = np.einsum("...ij,...ij->...", first, second)
    return np.asarray(np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1))))


def pose_distances(first: Cameras, second: Cameras, length_unit_mm: float) -> Float[np.ndarray, "a b"]:
    """How far each view of one batch is from each of another: centres apart plus radians turned.

    Centres count in `length_unit_mm`, best a typical depth: a turn by one radian moves what is seen as much
    as a step of one depth.

    Args:
        first: A views.
        second: B views.
        length_unit_mm: in world units.
    """
    apart = np.linalg.norm(first.centers[:, None] - second.centers[None], axis=-1) / length_unit_mm
    rotations = np.broadcast_arrays(
        first.world_from_camera[:, None, :3, :3], second.world_from_camera[None, :, :3, :3]
    )
    return np.asarray(apart + np.radians(rotation_angle_deg(*rotations)))


def look_at(
    center: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """A camera at `center` that looks at `target`, its image-up nearest to `up`.

    Raises:
        PoseError: when target and centre coincide.
    """
    forward = np.asarray(target, dtype=np.float64) - center
    length = np.linalg.norm(forward)
    if length < 1e-12:
        raise PoseError("look_at needs a target different from the centre", field="target")
    forward = forward / length
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:
        # Viewing direction parallel to `up`: any perpendicular axis is valid; take a fixed one.
        right = np.cross(forward, np.eye(3)[int(np.argmin(np.abs(forward)))])
    right = right / np.linalg.norm(right)
    down = np.cross(forward, right)
    return compose(np.stack([right, down, forward], axis=1), np.asarray(center, dtype=np.float64))


def transform_points(
    motion: Float[np.ndarray, "*m 4 4"], points: Float[np.ndarray, "*p 3"]
) -> Float[np.ndarray, "*p 3"]:
    """Apply a rigid motion to points: one to all, or to each its own.

    Computed without BLAS, whose rounding depends on the number of threads and of points.
    """
    x, y, z = np.moveaxis(points, -1, 0)
    rows = np.moveaxis(motion[..., :3, :], (-2, -1), (0, 1))
    return np.stack([a * x + b * y + c * z + shift for a, b, c, shift in rows], axis=-1)


def project_points(
    points: Float[np.ndarray, "*p 3"], K: Float[np.ndarray, "*k 3 3"], lens: RadialLens | None = None
) -> Float[np.ndarray, "*p 2"]:
    """Pixels (u, v) of points in a camera's own frame; NaN where z is not positive or the lens sees nothing.

    Args:
        points: x right, y down, z forward.
        K: intrinsics in pixels, of all or of each.
        lens: None for a pinhole; else points outside its field of view have no pixel.
    """
    z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
    if lens is not None:
        x, y = points[..., 0] / z, points[..., 1] / z
        seen = np.hypot(x, y) <= np.tan(lens.max_angle_rad)
        x, y = lens.distorted(x, y)
        return np.stack(
            [
                np.where(seen, K[..., 0, 0] * x + K[..., 0, 2], np.nan),
                np.where(seen, K[..., 1, 1] * y + K[..., 1, 2], np.nan),
            ],
            axis=-1,
        )
    u = K[..., 0, 0] * points[..., 0] / z + K[..., 0, 2]
    v = K[..., 1, 1] * points[..., 1] / z + K[..., 1, 2]
    return np.stack([u, v], axis=-1)


def unproject_pixels(
    pixels: Float[np.ndarray, "*p 2"], K: Float[np.ndarray, "*k 3 3"], lens: RadialLens | None = None
) -> Float[np.ndarray, "*p 3"]:
    """Rays through pixels (u, v) in a camera's own frame, with unit z: the inverse of `project_points`.

    Args:
        pixels: centres at +0.5.
        K: intrinsics in pixels, of all or of each.
        lens: None for a pinhole. Pixels beyond a lens's field of view get rays at most 88 degrees from its
            axis; `field_mask` tells them apart.
    """
    x = (pixels[..., 0] - K[..., 0, 2]) / K[..., 0, 0]
    y = (pixels[..., 1] - K[..., 1, 2]) / K[..., 1, 1]
    if lens is not None:
        x, y = lens.undistorted(np.asarray(x), np.asarray(y))
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def pixel_rays(cameras: Cameras) -> Float[np.ndarray, "c h w 3"]:
    """World-space rays through pixel centres with unit z in the camera frame.

    `center + z * ray` is the point at z-depth `z`.
    """
    u = np.arange(cameras.width) + 0.5
    v = np.arange(cameras.height) + 0.5
    K = cameras.K
    x = (u[None, None, :] - K[:, 0, 2, None, None]) / K[:, 0, 0, None, None]
    y = (v[None, :, None] - K[:, 1, 2, None, None]) / K[:, 1, 1, None, None]
    x, y = np.broadcast_arrays(x, y)
    if cameras.lens is not None:
        x, y = _undistorted(cameras, x, y)
    local = np.stack([x, y, np.ones_like(x)], axis=-1)
    return np.asarray(np.einsum("cij,chwj->chwi", cameras.world_from_camera[:, :3, :3], local))


def rays_of_pixels(cameras: Cameras, pixels: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
    """The rays of `pixel_rays` through some pixels alone, one camera in memory at a time.

    Args:
        cameras: C cameras of H x W pixels.
        pixels: positions among all C * H * W, ascending.
    """
    size = cameras.width * cameras.height
    bounds = np.searchsorted(pixels, size * np.arange(len(cameras) + 1))
    parts = [
        pixel_rays(cameras[view]).reshape(-1, 3)[pixels[first:last] - view * size]
        for view, (first, last) in enumerate(itertools.pairwise(bounds.tolist()))
        if last > first
    ]
    return np.concatenate(parts) if parts else np.zeros((0, 3))


def _undistorted(
    cameras: Cameras, x: Float[np.ndarray, "c h w"], y: Float[np.ndarray, "c h w"]
) -> tuple[Float[np.ndarray, "c h w"], Float[np.ndarray, "c h w"]]:
    """Rays (X / Z, Y / Z) of image positions; cameras of the same intrinsics share the work."""
    if cameras.lens is None:
        return x, y
    _, first, which = np.unique(
        cameras.K.reshape(len(cameras), 9), axis=0, return_index=True, return_inverse=True
    )
    found_x, found_y = cameras.lens.undistorted(x[first], y[first])
    which = which.reshape(-1)
    return found_x[which], found_y[which]


def field_mask(
    K: Float[np.ndarray, "3 3"], lens: RadialLens, width: int, height: int
) -> Bool[np.ndarray, "h w"]:
    """Pixels of which all four corners lie inside the field of view of a lens.

    Args:
        K: intrinsics in pixels.
        lens: of the images.
        width: of the images, in pixels.
        height: of the images, in pixels.
    """
    x = (np.arange(width + 1) - K[0, 2]) / K[0, 0]
    y = (np.arange(height + 1) - K[1, 2]) / K[1, 1]
    seen = np.hypot(*np.meshgrid(x, y)) <= lens.max_radius
    return np.asarray(seen[:-1, :-1] & seen[:-1, 1:] & seen[1:, :-1] & seen[1:, 1:])
