"""Starting points of the optimisation: on the surface given by depth or sparse points, else at random."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from extrags.cameras import Cameras, rays_of_pixels
from extrags.errors import CaptureError
from extrags.frame_quantiles import median_of_frames
from extrags.frame_stacks import empty_stack, frames_of, stacked
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.known_depth import FARTHEST, is_background
from extrags.sequence import EndoscopicSequence
from extrags.sparse_depth import MIN_POINTS_PER_VIEW, interpolated_depth, pixel_lattice
from extrags.training.random_start import depth_range, random_depth
from extrags.training.surest_depth import agreed_depth, surest_points

__all__ = [
    "LEAST_COLOR",
    "depth_from_points",
    "median_depth",
    "starting_gaussians",
    "starts_at_random",
    "surface_normals",
    "thin_out",
    "valid_pixels",
]

_log = logging.getLogger(__name__)

NORMAL_NEIGHBOURS = 12
"""Points beside a point whose plane gives its normal."""

MEASURED_FRAMES = 40
"""Frames at most whose interpolated depth gives the length scale of a scene of sparse points."""

BESIDE_RELIABLE_PX = 3
"""Unsure depth starts no Gaussian so near to sure depth: it is the edge of a fold, between two surfaces. A
wide area of unsure depth is all there is, and is kept."""

LEAST_COLOR = 0.01
"""Albedo of a new Gaussian at least: a colour of zero has no gradient, and would stay black for good."""

SURFACE_OPACITY, RANDOM_OPACITY = 0.5, 0.1
"""Opacity at the start: on a known surface, and at random points, which must not hide each other."""


def median_depth(sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"]) -> float:
    """Median distance from lens to surface over frames, in world units: the scene's length scale.

    From depth, else interpolated between sparse points, else from where the cameras stand and look
    (`extrags.training.random_start.depth_range`).

    Raises:
        CaptureError: when neither depth nor points are known, and all cameras stand in one place.
    """
    depth_mm = sequence.depth_mm
    if depth_mm is not None:
        known = median_of_frames(lambda: (depth_mm[k][_has_depth(sequence, k)] for k in frames.tolist()))
        if known is not None:
            return known
    if sequence.points is not None and len(sequence.points) >= MIN_POINTS_PER_VIEW:
        found = []
        chosen = np.linspace(0, len(frames) - 1, min(len(frames), MEASURED_FRAMES)).round().astype(np.int64)
        for frame in frames[chosen]:
            pixels, z, inside = _seen(sequence, int(frame))
            if inside.sum() >= MIN_POINTS_PER_VIEW:
                # Not of the points themselves: they lie where features are, and mostly far down a tube.
                lattice = pixel_lattice(sequence.mask[frame])
                found.append(interpolated_depth(pixels[inside], z[inside], lattice))
        if found:
            return float(np.median(np.concatenate(found)))
    return depth_range(sequence.cameras[frames], sequence.name).typical


def valid_pixels(sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"]) -> int:
    """How many pixels of frames are valid, all together."""
    return sum(int(np.count_nonzero(sequence.mask[frame])) for frame in frames)


def starts_at_random(sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"]) -> bool:
    """Whether `starting_gaussians` knows neither depth nor enough points in any of the frames.

    Points that no frame sees at all are no sparse start but another world: they are refused as before.
    """
    if _depth_known(sequence, frames):
        return False
    if sequence.points is None or len(sequence.points) < MIN_POINTS_PER_VIEW:
        return True
    most = max(int(_seen(sequence, int(frame))[2].sum()) for frame in frames)
    return 0 < most < MIN_POINTS_PER_VIEW


def starting_gaussians(
    sequence: EndoscopicSequence,
    frames: Int[np.ndarray, "m"],
    max_points: int,
    *,
    light: NearFieldLight | None = None,
    sh_degree: int = 0,
    thickness: float = 1.0,
    seed: int = 0,
    where: Bool[np.ndarray, "m h w"] | None = None,
    exposures: Float[np.ndarray, "m"] | None = None,
) -> Gaussians:
    """Gaussians from back-projected depth, from sparse points without depth, or at random without either.

    Unsure pixels of estimated depth beside sure ones start none: where depth jumps, an estimate lies between
    both surfaces, and Gaussians there would hang in front of what was never seen. Nor do estimates of what
    another frame knows much better; the others start where all frames together have the surface
    (`extrags.training.surest_depth`). Nor do backgrounds (`extrags.known_depth`), which a warning counts.

    Each point carries the mean albedo of its pixels: the colour with light and response divided out.
    Radii follow the distance to the three nearest neighbours. Random points lie in the cameras' frusta; they
    are round and faint, and a warning says so.

    Args:
        sequence: posed frames.
        frames: the frames that may be used.
        max_points: upper bound of the number of Gaussians.
        light: the light the optimisation starts with; None keeps colours as they are.
        sh_degree: degree of the (zero) higher harmonics.
        thickness: along the surface's normal, as a share of the radius; 1 makes round Gaussians.
        seed: chooses among equivalent pixels, and random points.
        where: pixels of the frames that may start Gaussians; None: all valid ones.
        exposures: gain of each of the frames, where it is known already; counts with `light`. None: all 1.

    Raises:
        CaptureError: when neither depth nor points are known and all cameras stand in one place; when no
            frame sees any of the points; when masks, or `where`, leave no pixel.
    """
    cameras = sequence.cameras[frames]
    at_random = starts_at_random(sequence, frames)
    depth = _random_depth(sequence, cameras, seed) if at_random else _starting_depth(sequence, frames)
    chosen, z = _starting_pixels(sequence, frames, depth, where, max_points, seed)
    rays = rays_of_pixels(cameras, chosen)
    view = chosen // (sequence.width * sequence.height)
    points = cameras.centers[view] + z[:, None] * rays
    if sequence.depth_error is not None and _depth_known(sequence, frames):
        error = _of_frames(sequence.depth_error, frames).reshape(-1)[chosen] * z
        surest = surest_points(points, error, sequence, frames)
        chosen, z, rays, view, error = (part[surest] for part in (chosen, z, rays, view, error))
        z = agreed_depth(cameras.centers[view], rays, z, error, sequence, frames, depth)
        points = cameras.centers[view] + z[:, None] * rays
    rgb = _of_frames(sequence.rgb, frames).reshape(-1, 3)[chosen].astype(np.float64) / 255
    if light is not None:
        local = np.einsum("nji,nj->ni", cameras.world_from_camera[view, :3, :3], z[:, None] * rays)
        rgb = light.albedo(torch.from_numpy(rgb), torch.from_numpy(local)).detach().numpy()
        if exposures is not None:
            rgb = rgb / exposures[view, None]
    points, rgb = thin_out(points, rgb, max_points)
    floor = 1e-3 * float(np.median(z))
    return Gaussians.from_points(
        points,
        np.clip(rgb, LEAST_COLOR, None),
        np.maximum(_spacing(points), floor),
        opacity=RANDOM_OPACITY if at_random else SURFACE_OPACITY,
        sh_degree=sh_degree,
        normals=None if at_random or thickness == 1 else surface_normals(points),
        thickness=1.0 if at_random else thickness,
    )


def _random_depth(sequence: EndoscopicSequence, cameras: Cameras, seed: int) -> Float[np.ndarray, "m h w"]:
    """Random depth where nothing tells it, with a warning."""
    within = depth_range(cameras, sequence.name)
    _log.warning(
        "%s: neither depth nor enough sparse points are known; the reconstruction starts from random "
        "points, %.3g to %.3g units from the cameras, %s",
        sequence.name,
        within.near,
        within.far,
        "round the point they look at" if within.meeting is not None else "along their path",
    )
    return random_depth(cameras, within, seed=seed)


def _starting_pixels(
    sequence: EndoscopicSequence,
    frames: Int[np.ndarray, "m"],
    depth: Float[np.ndarray, "m h w"],
    where: Bool[np.ndarray, "m h w"] | None,
    max_points: int,
    seed: int,
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Flat positions of the pixels that start Gaussians, before they are thinned out, and their depth."""

    def startable() -> Iterator[Bool[np.ndarray, "h w"]]:
        for position, frame in enumerate(frames):
            inside = (depth[position] > 0) & sequence.mask[frame]
            yield inside if where is None else inside & where[position]

    valid = stacked(startable(), len(frames))
    count = sum(int(np.count_nonzero(frame)) for frame in valid)
    if count == 0:
        raise CaptureError(f"{sequence.name}: no valid depth in any training frame")
    # A point per pixel of all frames would be millions; a tenfold surplus is enough for thinning.
    drawn = None
    if count > 10 * max_points:
        drawn = np.sort(np.random.default_rng(seed).choice(count, 10 * max_points, replace=False))
    chosen = _positions(valid, drawn)
    z = depth.reshape(-1)[chosen].astype(np.float64)
    if (background := is_background(z)).any():
        _log.warning(
            "%s: %d of %d pixels are over %g times as far away as what is near, and start no Gaussian",
            sequence.name,
            int(background.sum()),
            len(z),
            FARTHEST,
        )
        chosen, z = chosen[~background], z[~background]
    return chosen, z


def _spacing(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Root mean square of each point's distances to its three nearest neighbours; 0 for a point alone."""
    neighbours = min(4, len(points))
    distance, _ = cKDTree(points).query(points, k=neighbours)
    distance = np.atleast_2d(distance.reshape(len(points), -1))
    return np.asarray(np.sqrt(np.mean(distance[:, 1:] ** 2, axis=1)) if neighbours > 1 else distance[:, 0])


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
    points = sequence.points
    if points is None or len(points) < MIN_POINTS_PER_VIEW:
        raise CaptureError(
            f"{sequence.name}: no depth and {0 if points is None else len(points)} sparse points; "
            f"at least {MIN_POINTS_PER_VIEW} are needed to start the reconstruction"
        )
    depth = empty_stack(sequence.rgb.shape[:3], np.float32)
    everywhere = np.stack(
        np.meshgrid(np.arange(sequence.width) + 0.5, np.arange(sequence.height) + 0.5), axis=-1
    )
    used = 0
    for frame in frames:
        pixels, z, inside = _seen(sequence, int(frame))
        if inside.sum() < MIN_POINTS_PER_VIEW:
            continue
        used += 1
        found = interpolated_depth(pixels[inside], z[inside], everywhere)
        depth[frame] = np.where(sequence.mask[frame], found, 0)
    if used == 0:
        raise CaptureError(
            f"{sequence.name}: no training frame sees {MIN_POINTS_PER_VIEW} of the "
            f"{len(points)} sparse points; are poses and points in the same frame and scale?"
        )
    return depth


def _positions(valid: Bool[np.ndarray, "m h w"], ranks: Int[np.ndarray, "n"] | None) -> Int[np.ndarray, "n"]:
    """Flat positions of true pixels, ascending, by their ranks among them; None: of all.

    Frame by frame: positions of all pixels would be eight times as large as the masks.
    """
    if ranks is None:
        return np.flatnonzero(valid)
    bounds = np.concatenate([[0], np.cumsum([np.count_nonzero(frame) for frame in valid])])
    edges = np.searchsorted(ranks, bounds)
    parts = [
        position * frame.size + np.flatnonzero(frame)[ranks[first:last] - bounds[position]]
        for position, (frame, first, last) in enumerate(zip(valid, edges[:-1], edges[1:], strict=True))
    ]
    return np.concatenate(parts)


def _of_frames(stack: np.ndarray, frames: Int[np.ndarray, "m"]) -> np.ndarray:
    """Images of some frames; the stack itself, not a copy, where these are all of them in order."""
    whole = len(frames) == len(stack) and np.array_equal(frames, np.arange(len(stack)))
    return stack if whole else frames_of(stack, frames)


def _has_depth(sequence: EndoscopicSequence, frame: int) -> Bool[np.ndarray, "h w"]:
    """Valid pixels of a frame whose depth is known, in a sequence that has depth."""
    assert sequence.depth_mm is not None
    return np.asarray((sequence.depth_mm[frame] > 0) & sequence.mask[frame])


def _depth_known(sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"]) -> bool:
    """Whether any valid pixel of the frames has depth."""
    return sequence.depth_mm is not None and any(
        bool(_has_depth(sequence, frame).any()) for frame in frames.tolist()
    )


def _starting_depth(sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"]) -> Float[np.ndarray, "m h w"]:
    """Depth of the frames that may start Gaussians: known, else interpolated between sparse points."""
    if sequence.depth_mm is None or not _depth_known(sequence, frames):
        return _of_frames(depth_from_points(sequence, frames), frames)
    if sequence.depth_error is None:
        return _of_frames(sequence.depth_mm, frames)
    depth_mm = sequence.depth_mm
    without_edges = (np.where(_edges_of_estimate(sequence, k), 0, depth_mm[k]) for k in frames.tolist())
    return stacked(without_edges, len(frames))


def _edges_of_estimate(sequence: EndoscopicSequence, frame: int) -> Bool[np.ndarray, "h w"]:
    """Unsure pixels of an estimated depth beside sure ones."""
    reliable = sequence.reliable_depth_mm(frame)
    assert reliable is not None
    sure = reliable > 0
    return np.asarray(binary_dilation(sure, iterations=BESIDE_RELIABLE_PX) & ~sure)


def _seen(
    sequence: EndoscopicSequence, frame: int
) -> tuple[Float[np.ndarray, "p 2"], Float[np.ndarray, "p"], Bool[np.ndarray, "p"]]:
    """Pixels and z-depths of the sparse points, and which of them fall into a frame's mask."""
    points = np.zeros((0, 3)) if sequence.points is None else sequence.points
    (pixels,), (z,) = sequence.cameras[frame].project(points)
    inside = sequence.cameras.contains(pixels)
    column, row = pixels[inside].astype(np.int64).T
    inside[inside] = sequence.mask[frame][row, column]
    return pixels, z, inside
