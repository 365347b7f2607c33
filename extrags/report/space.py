"""The scene seen from outside: surface, cameras and virtual trajectories, and slices of the occupancy.

Orthographic views along the principal axes of the scene. Only surface that faces its nearest camera is
drawn, so that a tube is seen cut open, from whichever side one looks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from extrags.cameras import Cameras, rotation_about
from extrags.report.charts import INK, QUIET, drawing_style
from extrags.report.encode import DataImage, png_image
from extrags.report.inputs import GridLike, MeshLike
from extrags.unique_rows import unique_rows

__all__ = ["SceneFigure", "clustered", "occupancy_slices", "scene_views", "trajectory_colors"]

MAX_FACES = 20_000
"""Finer meshes are clustered: at this size of picture more would not be seen."""
MIN_ASPECT, MAX_ASPECT = 0.45, 1.1
"""Bounds on height to width of the pictures, whatever the shape of the scene."""
FRUSTUM_SHARE = 0.022
"""Drawn size of a camera, as a share of the picture's width."""
SLICE_SCALE_PX = 6
"""Screen pixels per voxel of a slice."""

FREE_RGB = (255, 255, 255)
OCCUPIED_RGB = (178, 134, 120)
UNKNOWN_RGB = (226, 230, 235)
HELD_OUT_COLOR = "#3f7fbf"


@dataclass(frozen=True, slots=True)
class SceneFigure:
    """A picture with its caption."""

    image: DataImage
    title: str
    alt: str


@dataclass(frozen=True, slots=True)
class _Faces:
    """Polygons of equal number of corners, with normals that point to where the cameras are."""

    corners: Float[np.ndarray, "f k 3"]
    normals: Float[np.ndarray, "f 3"]


def trajectory_colors(count: int) -> list[str]:
    """One colour per trajectory, from dark violet to orange, in the order of acceptance."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return [to_hex(color) for color in colormaps["plasma"](np.linspace(0.02, 0.82, max(count, 1)))[:count]]


def scene_views(
    train: Cameras,
    held_out: Cameras,
    trajectories: Sequence[Float[np.ndarray, "_ 4 4"]],
    mesh: MeshLike | None,
    grid: GridLike | None,
    *,
    unit: str,
) -> list[SceneFigure]:
    """Three views of the scene: a large one at an angle, one from the side and one from above.

    Args:
        train: training cameras.
        held_out: held-out cameras.
        trajectories: camera-to-world poses of each virtual trajectory.
        mesh: the surface; without one the occupied voxels stand for it.
        grid: occupancy, used when there is no mesh.
        unit: what one unit of length is called on the scale bar.
    """
    faces = _faces_of(mesh, grid, train)
    centers = [train.centers, held_out.centers, *(poses[:, :3, 3] for poses in trajectories)]
    corners = np.concatenate(centers) if faces is None else faces.corners.reshape(-1, 3)
    frame = _principal_frame(np.concatenate([corners, *centers]))
    tilt = rotation_about(np.array([1.0, 0, 0]), np.radians(-32)) @ rotation_about(
        np.array([0, 1.0, 0]), np.radians(38)
    )
    turn_up = rotation_about(np.array([1.0, 0, 0]), np.radians(-90))
    what = f"{len(train)} training and {len(held_out)} held-out cameras, {len(trajectories)} trajectories"
    turns = {
        "At an angle": tilt @ frame,
        "From the side": frame,
        "From above": turn_up @ frame,
    }
    windows = {title: _window(corners, np.concatenate(centers), turn) for title, turn in turns.items()}
    # One scale and one shape for all three, so that they stand in a row and can be compared.
    half = np.max([half for _, half in windows.values()], axis=0)
    half = np.where(half > 0, half, 1.0)  # a single camera has no extent
    half = np.maximum(half, [half[1] / MAX_ASPECT, MIN_ASPECT * half[0]])
    figures: list[SceneFigure] = []
    for title, turn in turns.items():
        window = (windows[title][0], half)
        width_in = 5.2 if figures else 8.4
        image = _scene_view(turn, faces, train, held_out, trajectories, window, unit, width_in)
        figures.append(SceneFigure(image, title, f"The scene {title.lower()}: {what}"))
    return figures


def occupancy_slices(
    grid: GridLike, train: Cameras, trajectories: Sequence[Float[np.ndarray, "_ 4 4"]]
) -> list[SceneFigure]:
    """The three slices of the grid through the median camera, with the cameras that lie in them.

    Free is white, occupied tissue-coloured, unknown grey; a camera is drawn in a slice when it is no more
    than two voxels away from it.
    """
    size = grid.occupancy.shape[0]
    colors = trajectory_colors(len(trajectories))
    groups = [(train.centers, INK)]
    groups += [(poses[:, :3, 3], color) for poses, color in zip(trajectories, colors, strict=True)]
    inside = [((center - grid.origin_mm) @ grid.axes.T / grid.voxel_mm, color) for center, color in groups]
    middle = np.median(np.concatenate([places for places, _ in inside]), axis=0)
    cut = np.clip(np.floor(middle), 0, size - 1).astype(int)
    table = np.array([FREE_RGB, OCCUPIED_RGB, UNKNOWN_RGB], dtype=np.uint8)
    figures = []
    for axis in range(3):
        plane = np.take(grid.occupancy, cut[axis], axis=axis)
        image = table[plane].repeat(SLICE_SCALE_PX, 0).repeat(SLICE_SCALE_PX, 1)
        across = [other for other in range(3) if other != axis]
        for places, color in inside:
            near = places[np.abs(places[:, axis] - cut[axis] - 0.5) <= 2]
            _dot(image, near[:, across] * SLICE_SCALE_PX, color)
        names = "xyz"
        title = f"{names[axis]} = {cut[axis]} of {size}"
        shares = [float((plane == label).mean()) for label in range(3)]
        alt = (
            f"Slice of the occupancy grid at {title}: {shares[0]:.0%} free, {shares[1]:.0%} occupied, "
            f"{shares[2]:.0%} unknown"
        )
        figures.append(SceneFigure(png_image(image), f"Grid {title}", alt))
    return figures


def _faces_of(mesh: MeshLike | None, grid: GridLike | None, train: Cameras) -> _Faces | None:
    if mesh is not None and len(mesh.triangles):
        corners = clustered(mesh.vertices.astype(np.float64), mesh.triangles)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normals, axis=1)
        corners, normals = corners[length > 0], normals[length > 0] / length[length > 0, None]
        towards = _nearest(train.centers, corners.mean(1)) - corners.mean(1)
        facing = np.sign((normals * towards).sum(1, keepdims=True))
        return _Faces(corners, normals * np.where(facing == 0, 1.0, facing))
    if grid is not None:
        return _voxel_faces(grid)
    return None


def clustered(vertices: np.ndarray, triangles: np.ndarray) -> Float[np.ndarray, "t 3 3"]:
    """Triangle corners of the mesh, its vertices merged on ever coarser grids until it is small enough."""
    diameter = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    cell = diameter / 400
    corners = vertices[triangles]
    while len(corners) > MAX_FACES:
        _, label = unique_rows(np.floor(vertices / cell).astype(np.int64))
        sums = np.stack([np.bincount(label, vertices[:, axis]) for axis in range(3)], axis=1)
        merged = sums / np.bincount(label)[:, None]
        faces = label[triangles]
        whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        faces = faces[whole]
        _, which = unique_rows(np.sort(faces, axis=1))
        _, first = np.unique(which, return_index=True)
        corners = merged[faces[np.sort(first)]]
        cell *= 1.25
    return np.asarray(corners)


def _voxel_faces(grid: GridLike) -> _Faces | None:
    """The squares between free and occupied voxels."""
    free, occupied = grid.occupancy == 0, grid.occupancy == 1
    corners, normals = [], []
    for axis in range(3):
        lower = [slice(None)] * 3
        upper = [slice(None)] * 3
        lower[axis], upper[axis] = slice(None, -1), slice(1, None)
        u, v = np.eye(3)[[other for other in range(3) if other != axis]]
        square = np.array([np.zeros(3), u, u + v, v])
        for towards, boundary in (
            (-1.0, free[tuple(lower)] & occupied[tuple(upper)]),
            (1.0, occupied[tuple(lower)] & free[tuple(upper)]),
        ):
            place = np.argwhere(boundary) + np.eye(3)[axis]
            corners.append(place[:, None] + square)
            normals.append(np.broadcast_to(towards * np.eye(3)[axis], place.shape))
    found = np.concatenate(corners)
    if not len(found):
        return None
    world = grid.origin_mm + found * grid.voxel_mm @ grid.axes
    return _Faces(world, np.concatenate(normals) @ grid.axes)


def _scene_view(
    rotation: np.ndarray,
    faces: _Faces | None,
    train: Cameras,
    held_out: Cameras,
    trajectories: Sequence[np.ndarray],
    window: tuple[np.ndarray, np.ndarray],
    unit: str,
    width_in: float,
) -> DataImage:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.figure import Figure

    center, half = window
    with drawing_style():
        figure = Figure(figsize=(width_in, width_in * half[1] / half[0]), dpi=150)
        canvas = FigureCanvasAgg(figure)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        axes.set_xlim(center[0] - half[0], center[0] + half[0])
        # Image rows grow downwards, as does the y of a camera.
        axes.set_ylim(center[1] + half[1], center[1] - half[1])
        if faces is not None:
            corners, normals = faces.corners @ rotation.T, faces.normals @ rotation.T
            order = np.argsort(-corners[..., 2].mean(1), kind="stable")
            order = order[normals[order, 2] < 0]
            shade = _shaded(normals[order], corners[order, :, 2].mean(1))
            axes.add_collection(
                PolyCollection(corners[order][..., :2], facecolors=shade, edgecolors=shade, linewidths=0.35)
            )
        for cameras, color, width in ((held_out, HELD_OUT_COLOR, 0.6), (train, INK, 0.75)):
            lines = _frusta(cameras, 2 * FRUSTUM_SHARE * half[0]) @ rotation.T
            axes.add_collection(
                LineCollection(list(lines[..., :2]), colors=color, linewidths=width, alpha=0.8)
            )
        for poses, color in zip(trajectories, trajectory_colors(len(trajectories)), strict=True):
            path = (poses[:, :3, 3] @ rotation.T)[:, :2]
            axes.plot(path[:, 0], path[:, 1], color="white", linewidth=3.4, solid_capstyle="round", alpha=0.8)
            axes.plot(path[:, 0], path[:, 1], color=color, linewidth=1.9, solid_capstyle="round")
            axes.plot(*path[-1], marker="o", markersize=4.2, color=color, markeredgecolor="white")
        _scale_bar(axes, center, half, unit)
        canvas.draw()  # type: ignore[no-untyped-call]
        pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    return png_image(pixels[..., :3])


def _window(
    surface: np.ndarray, centers: np.ndarray, rotation: np.ndarray
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Middle and half extent of what a view must show: all cameras, and the surface but for strays."""
    low, high = np.quantile(surface @ rotation.T, [0.002, 0.998], axis=0)
    cameras = centers @ rotation.T
    low, high = np.minimum(low, cameras.min(0))[:2], np.maximum(high, cameras.max(0))[:2]
    half = (high - low) / 2
    return (low + high) / 2, half + 0.06 * half.max()


def _shaded(normals: Float[np.ndarray, "f 3"], depth: Float[np.ndarray, "f"]) -> Float[np.ndarray, "f 3"]:
    """Pale tissue under a light from the upper left, paling further with distance."""
    light = np.array([-0.45, -0.55, -0.7])
    lambert = np.clip(normals @ (light / np.linalg.norm(light)), 0, 1)[:, None]
    near, far = (float(depth.min()), float(depth.max())) if depth.size else (0.0, 1.0)
    haze = (0.3 * (depth - near) / max(far - near, 1e-9))[:, None]
    tissue = np.array([0.64, 0.45, 0.40]) + lambert * np.array([0.30, 0.41, 0.43])
    return np.asarray(np.clip(tissue * (1 - haze) + haze, 0, 1))


def _frusta(cameras: Cameras, size: float) -> Float[np.ndarray, "l p 3"]:
    """Each camera as one stroke: its image rectangle and the four edges to the centre."""
    width, height = cameras.width, cameras.height
    pixel = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], dtype=np.float64)
    rays = np.einsum("cij,kj->cki", np.linalg.inv(cameras.K), pixel)
    rays *= size / np.linalg.norm(rays, axis=-1, keepdims=True)
    corner = np.einsum("cij,ckj->cki", cameras.world_from_camera[:, :3, :3], rays) + cameras.centers[:, None]
    center = cameras.centers
    stroke = [corner[:, 0], corner[:, 1], center, corner[:, 0], corner[:, 3], center]
    stroke += [corner[:, 2], corner[:, 3], corner[:, 2], corner[:, 1]]
    return np.stack(stroke, axis=1)


def _scale_bar(axes: Any, center: np.ndarray, half: np.ndarray, unit: str) -> None:
    length = _nice_length(half[0] * 0.5)
    x, y = center[0] - 0.96 * half[0], center[1] + half[1] - 0.04 * half[0]
    axes.plot([x, x + length], [y, y], color=QUIET, linewidth=2, solid_capstyle="butt")
    axes.text(x, y - 0.02 * half[0], f"{length:g} {unit}", color=QUIET, fontsize=10, va="bottom")


def _nice_length(longest: float) -> float:
    power = 10.0 ** np.floor(np.log10(max(longest, 1e-12)))
    return float(max(step * power for step in (1, 2, 5) if step * power <= longest * (1 + 1e-9)))


def _principal_frame(points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "3 3"]:
    """Rows: longest, middle and shortest axis, right-handed; signs fixed by the largest component."""
    offset = points - points.mean(0)
    _, vectors = np.linalg.eigh(offset.T @ offset)
    axes = vectors.T[::-1]
    largest = axes[np.arange(3), np.abs(axes).argmax(1)]
    axes = axes * np.sign(largest)[:, None]
    axes[2] = np.cross(axes[0], axes[1])
    return np.asarray(axes)


def _nearest(candidates: Float[np.ndarray, "c 3"], points: Float[np.ndarray, "p 3"]) -> np.ndarray:
    from scipy.spatial import cKDTree

    return np.asarray(candidates[cKDTree(candidates).query(points)[1]])


def _dot(image: np.ndarray, places: Float[np.ndarray, "n 2"], color: str) -> None:
    rgb = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)], dtype=np.uint8)
    height, width = image.shape[:2]
    row, column = np.ogrid[:height, :width]
    for y, x in places:
        distance = (row + 0.5 - y) ** 2 + (column + 0.5 - x) ** 2
        image[distance <= 5.0**2] = 255
        image[distance <= 3.8**2] = rgb
