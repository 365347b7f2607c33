"""Starting points of the optimisation: Gaussians on the surface given by depth or sparse points."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from extrags.cameras import pixel_rays
from extrags.errors import CaptureError
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.sequence import EndoscopicSequence

__all__ = ["depth_from_points", "median_depth", "starting_gaussians", "surface_normals", "thin_out"]

NORMAL_NEIGHBOURS = 12
"""Points beside a point whose plane gives its normal."""

MIN_POINTS_PER_VIEW = 20
"""A view with fewer visible sparse points gives no interpolated depth."""


def median_depth(sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"]) -> float:
    """Median distance from lens to surface over frames, in world units: the scene's length scale.

    Raises:
        CaptureError: when neither depth nor points are known.
    """
    if sequence.depth_mm is not None:
        depth = sequence.depth_mm[frames]
        valid = (depth > 0) & sequence.mask[frames]
        if valid.any():
            return float(np.median(depth[valid]))
    if sequence.points is not None and len(sequence.points):
        _, z = sequence.cameras[frames].project(sequence.points)
        if (z > 0).any():
            return float(np.median(z[z > 0]))
    raise CaptureError(
        f"{sequence.name}: neither depth nor sparse points are known, so there is nothing to start "
        "the reconstruction from; provide depth, or let the poses stage triangulate points"
    )


def starting_gaussians(
    sequence: EndoscopicSequence,
    frames: Int[np.ndarray, "m"],
    max_points: int,
    *,
    light: NearFieldLight | None = None,
    sh_degree: int = 0,
    thickness: float = 1.0,
    seed: int = 0,
) -> Gaussians:
    """Gaussians from back-projected depth, or from sparse points where there is no depth.

    Each point carries the mean albedo of its pixels: the colour with light and response divided out.
    Radii follow the distance to the three nearest neighbours.

    Args:
        sequence: posed frames.
        frames: the frames that may be used.
        max_points: upper bound of the number of Gaussians.
        light: the light the optimisation starts with; None keeps colours as they are.
        sh_degree: degree of the (zero) higher harmonics.
        thickness: along the surface's normal, as a share of the radius; 1 makes round Gaussians.
        seed: chooses among equivalent pixels.

    Raises:
        CaptureError: when neither depth nor points are known.
    """
    depth = sequence.depth_mm
    if depth is None:
        depth = depth_from_points(sequence, frames)
    cameras = sequence.cameras[frames]
    valid = (depth[frames] > 0) & sequence.mask[frames]
    count = int(valid.sum())
    if count == 0:
        raise CaptureError(f"{sequence.name}: no valid depth in any training frame")
    # A point per pixel of all frames would be millions; a tenfold surplus is enough for thinning.
    generator = np.random.default_rng(seed)
    chosen = np.flatnonzero(valid)
    if count > 10 * max_points:
        chosen = np.sort(generator.choice(chosen, 10 * max_points, replace=False))
    rays = pixel_rays(cameras).reshape(-1, 3)[chosen]
    z = depth[frames].reshape(-1)[chosen].astype(np.float64)
    view = chosen // (sequence.width * sequence.height)
    points = cameras.centers[view] + z[:, None] * rays
    rgb = sequence.rgb[frames].reshape(-1, 3)[chosen].astype(np.float64) / 255
    if light is not None:
        local = np.einsum("nji,nj->ni", cameras.world_from_camera[view, :3, :3], z[:, None] * rays)
        rgb = light.albedo(torch.from_numpy(rgb), torch.from_numpy(local)).detach().numpy()
    points, rgb = thin_out(points, rgb, max_points)
    neighbours = min(4, len(points))
    distance, _ = cKDTree(points).query(points, k=neighbours)
    distance = np.atleast_2d(distance.reshape(len(points), -1))
    radius = np.sqrt(np.mean(distance[:, 1:] ** 2, axis=1)) if neighbours > 1 else distance[:, 0]
    floor = 1e-3 * float(np.median(z))
    return Gaussians.from_points(
        points,
        np.clip(rgb, 0, None),
        np.maximum(radius, floor),
        opacity=0.5,
        sh_degree=sh_degree,
        normals=surface_normals(points) if thickness != 1 else None,
        thickness=thickness,
    )


def surface_normals(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Unit normals, of either sign, of the planes through each point's neighbours."""
    neighbours = min(NORMAL_NEIGHBOURS + 1, len(points))
    _, index = cKDTree(points).query(points, k=neighbours)
    around = points[index.reshape(len(points), -1)]
    around = around - around.mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    return np.asarray(axes[:, :, 0])


def thin_out(
    points: Float[np.ndarray, "n 3"], values: Float[np.ndarray, "n c"], max_points: int
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m c"]]:
    """Average points and values in cubic voxels, as small as `max_points` allows.

    The voxel size is found by bisection: on a surface the number of voxels falls with its square.
    """
    if len(points) <= max_points:
        return points, values
    low, high = 0.0, float(np.ptp(points, axis=0).max())
    origin = points.min(axis=0)
    for _ in range(24):
        middle = (low + high) / 2
        cells = np.floor((points - origin) / middle).astype(np.int64)
        if len(np.unique(_cell_keys(cells))) > max_points:
            low = middle
        else:
            high = middle
        if high - low < 0.01 * high:
            break
    _, owner = np.unique(_cell_keys(np.floor((points - origin) / high).astype(np.int64)), return_inverse=True)
    weight = np.bincount(owner).astype(np.float64)

    def averaged(array: np.ndarray) -> np.ndarray:
        columns = [np.bincount(owner, weights=array[:, k]) for k in range(array.shape[1])]
        return np.asarray(np.stack(columns, axis=1) / weight[:, None])

    return averaged(points), averaged(values)


def _cell_keys(cells: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    span = cells.max(axis=0) + 1
    return np.asarray((cells[:, 0] * span[1] + cells[:, 1]) * span[2] + cells[:, 2])


def depth_from_points(
    sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"]
) -> Float[np.ndarray, "f h w"]:
    """Rough depth maps interpolated between the projections of sparse points.

    For initialisation only: linear inside the convex hull of the points in view, nearest outside it, nothing
    outside the mask. Frames other than `frames` stay empty.

    Raises:
        CaptureError: when no frame sees enough points.
    """
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

    points = sequence.points
    if points is None or len(points) < MIN_POINTS_PER_VIEW:
        raise CaptureError(
            f"{sequence.name}: no depth and {0 if points is None else len(points)} sparse points; "
            f"at least {MIN_POINTS_PER_VIEW} are needed to start the reconstruction"
        )
    depth = np.zeros(sequence.rgb.shape[:3], np.float32)
    cameras = sequence.cameras
    u, v = np.meshgrid(np.arange(sequence.width) + 0.5, np.arange(sequence.height) + 0.5)
    used = 0
    for frame in frames:
        (pixels,), (z,) = cameras[int(frame)].project(points)
        inside = cameras.contains(pixels)
        column, row = pixels[inside].astype(np.int64).T
        inside[inside] = sequence.mask[frame][row, column]
        if inside.sum() < MIN_POINTS_PER_VIEW:
            continue
        used += 1
        # Inverse depth is linear across a plane in the image; depth is not.
        linear = LinearNDInterpolator(pixels[inside], 1 / z[inside])(u, v)
        nearest = NearestNDInterpolator(pixels[inside], 1 / z[inside])(u, v)
        inverse = np.where(np.isfinite(linear), linear, nearest)
        depth[frame] = np.where(sequence.mask[frame], 1 / inverse, 0)
    if used == 0:
        raise CaptureError(
            f"{sequence.name}: no training frame sees {MIN_POINTS_PER_VIEW} of the "
            f"{len(points)} sparse points; are poses and points in the same frame and scale?"
        )
    return depth
