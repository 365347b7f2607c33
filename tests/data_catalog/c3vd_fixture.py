"""Small videos in exactly the layouts of C3VD and C3VDv2, ray-cast from a bumpy tube.

The fisheye's rays are written out here again from the published formula, so that the readers are not tested
against themselves.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d
from PIL import Image
from scipy.spatial.transform import Rotation

from extrags.cameras import invert_poses
from extrags.sequence import EndoscopicSequence

PUBLISHED = {
    "c3vd": {
        "cx": 678.544839263292,
        "cy": 542.975887548343,
        "a0": 769.243600037458,
        "a2": -8.12770624150226e-4,
        "a3": 6.25674244578925e-7,
        "a4": -1.19662182144280e-9,
        "c": 0.999986882249990,
        "d": 0.00288273829525059,
        "e": -0.00296316513429569,
    },
    "c3vdv2": {
        "cx": 677.739464094188,
        "cy": 543.057997844875,
        "a0": 767.733695862103,
        "a2": -5.92506426558248e-4,
        "a3": -2.69440266600040e-7,
        "a4": -2.16380341010063e-10,
        "c": 0.9999,
        "d": 1.10e-4,
        "e": -1.83e-4,
    },
}
"""For 1350 x 1080 pixels, pixel centres at integers."""


def scaled_lens(name: str, width: int) -> dict[str, float]:
    """A published lens for images of another width."""
    lens, s = dict(PUBLISHED[name]), width / 1350
    lens["cx"], lens["cy"] = (lens["cx"] + 0.5) * s - 0.5, (lens["cy"] + 0.5) * s - 0.5
    for power, key in ((1, "a0"), (-1, "a2"), (-2, "a3"), (-3, "a4")):
        lens[key] *= s**power
    return lens


def lens_rays(lens: dict[str, float], width: int, height: int) -> np.ndarray:
    """Rays (not of unit length) of all pixels, [H, W, 3]."""
    x, y = np.meshgrid(np.arange(width) - lens["cx"], np.arange(height) - lens["cy"])
    determinant = lens["c"] - lens["d"] * lens["e"]
    u = (x - lens["e"] * y) / determinant
    v = (lens["c"] * y - lens["d"] * x) / determinant
    rho = np.hypot(u, v)
    return np.stack([u, v, lens["a0"] + lens["a2"] * rho**2 + lens["a3"] * rho**3 + lens["a4"] * rho**4], -1)


def tube(rings: int = 60, spokes: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """A bumpy tube along x, 70 mm long, closed at its far end."""
    x, angle = np.meshgrid(np.linspace(-5, 65, rings), np.arange(spokes) * 2 * np.pi / spokes, indexing="ij")
    radius = 11 + 2.2 * np.cos(0.55 * x) ** 8 + 1.2 * np.sin(3 * angle + 0.1 * x)
    radius[-1] = 0.01
    vertices = np.stack([x, radius * np.cos(angle), radius * np.sin(angle)], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(spokes), indexing="ij")
    a, b = i * spokes + j, i * spokes + (j + 1) % spokes
    triangles = np.concatenate([np.stack([a, b, a + spokes], -1), np.stack([b, b + spokes, a + spokes], -1)])
    return np.round(vertices, 3), triangles.reshape(-1, 3)


def camera_path(frames: int, phase: float) -> np.ndarray:
    """Camera-to-world along the tube; the phase tells one video from another."""
    poses = np.repeat(np.eye(4)[None], frames, 0)
    share = np.linspace(0, 1, frames)
    forward_x = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    for k, s in enumerate(share):
        turn = Rotation.from_euler(
            "yx", [22 * np.sin(3 * s + phase), 12 * np.cos(2 * s + phase)], degrees=True
        )
        poses[k, :3, :3] = forward_x @ turn.as_matrix()
        poses[k, :3, 3] = 4 + 12 * s, 3 * np.cos(phase + s), 3 * np.sin(phase + s)
    return poses


@dataclass(frozen=True)
class Written:
    """What a video was written from."""

    folder: Path
    poses: np.ndarray
    """Camera-to-world in the video's own world."""
    own_from_common: np.ndarray
    observed: np.ndarray
    """Flags of the faces."""


def write_video(
    folder: Path,
    *,
    layout: str = "c3vdv2",
    frames: int = 5,
    first: int = 0,
    width: int = 135,
    phase: float = 0.0,
    seed: int | None = None,
    padded: bool = True,
    row_major: bool = False,
    mesh: bool = True,
) -> Written:
    """Write a video in one of the published layouts; `seed` turns its world."""
    height = round(width * 0.8)
    lens = scaled_lens(layout, width)
    rays = lens_rays(lens, width, height)
    vertices, triangles = tube()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(vertices.astype(np.float32), triangles.astype(np.uint32))
    own = np.eye(4)
    if seed is not None:
        rng = np.random.default_rng(seed)
        own[:3, :3] = Rotation.random(random_state=seed).as_matrix()
        own[:3, 3] = rng.uniform(-60, 60, 3)
    rgb, depth = (folder, folder) if layout == "c3vd" else (folder / "rgb", folder / "depth")
    for place in (folder, rgb, depth):
        place.mkdir(parents=True, exist_ok=True)
    common = camera_path(frames, phase)
    observed = np.zeros(len(triangles), bool)
    lines = []
    for k, pose in enumerate(common):
        toward = rays / rays[..., 2:] @ pose[:3, :3].T
        toward[rays[..., 2] <= 0] = 0
        packed = np.concatenate([np.broadcast_to(pose[:3, 3], toward.shape), toward], -1).astype(np.float32)
        found = scene.cast_rays(packed)
        z, face = found["t_hit"].numpy(), found["primitive_ids"].numpy()
        hit = np.isfinite(z)
        observed[face[hit]] = True
        code = np.where(hit, np.minimum(np.round(np.where(hit, z, 0) / 100 * 65535), 65535), 0)
        point = pose[:3, 3] + toward * np.where(hit, z, 0)[..., None]
        wave = np.stack(
            [np.sin(point @ w) for w in ([0.7, 0.3, 0.2], [0.2, 0.8, -0.3], [0.4, -0.5, 0.6])], -1
        )
        image = np.where(hit[..., None], 130 + 60 * wave, 40).astype(np.uint8)
        number = first + k
        text = f"{number:04d}" if padded else str(number)
        name = f"{text}_color.png" if layout == "c3vd" else f"{text}.png"
        Image.fromarray(image).save(rgb / name)
        Image.fromarray(code.astype(np.uint16)).save(depth / f"{number:04d}_depth.tiff")
        matrix = own @ pose
        lines.append(",".join(f"{value:.9g}" for value in (matrix if row_major else matrix.T).ravel()))
    (folder / "pose.txt").write_text("\n".join(lines) + "\n")
    if mesh:
        write_mesh(folder / "coverage_mesh.obj", vertices @ own[:3, :3].T + own[:3, 3], triangles, observed)
    return Written(folder, own @ common, own, observed)


def write_mesh(file: Path, vertices: np.ndarray, triangles: np.ndarray, observed: np.ndarray) -> None:
    """As published: one texture coordinate for observed faces, one for the others."""
    lines = [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in vertices]
    lines += ["vt 0.25 0.5", "vt 0.75 0.5"]
    for face, seen in zip(triangles + 1, observed, strict=True):
        lines.append("f " + " ".join(f"{vertex}/{1 if seen else 2}" for vertex in face))
    file.write_text("\n".join(lines) + "\n")


def write_calibration(file: Path, width: int, height: int, **changes: object) -> None:
    """A `calibration.json` of the second lens."""
    content = {"width": width, "height": height, "a1": 0.0, **scaled_lens("c3vdv2", width), **changes}
    file.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))


def reprojection_mm(sequence: EndoscopicSequence, first: int, second: int) -> tuple[float, float]:
    """Depth of one frame carried into another: median difference where they agree, share that agrees."""
    K, z = sequence.K[first], sequence.depth_mm[first].astype(float)
    row, column = np.nonzero(z > 0)
    rays = np.stack(
        [(column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1], np.ones(len(row))], 1
    )
    relative = invert_poses(sequence.world_from_camera[second][None])[0] @ sequence.world_from_camera[first]
    carried = (rays * z[row, column][:, None]) @ relative[:3, :3].T + relative[:3, 3]
    carried = carried[carried[:, 2] > 0.1]
    K = sequence.K[second]
    x = K[0, 0] * carried[:, 0] / carried[:, 2] + K[0, 2] - 0.5
    y = K[1, 1] * carried[:, 1] / carried[:, 2] + K[1, 2] - 0.5
    j, i = np.floor(x).astype(int), np.floor(y).astype(int)
    inside = (j >= 0) & (i >= 0) & (j < sequence.width - 1) & (i < sequence.height - 1)
    x, y, j, i, carried = x[inside], y[inside], j[inside], i[inside], carried[inside]
    depth = sequence.depth_mm[second].astype(float)
    corners = np.stack([depth[i, j], depth[i, j + 1], depth[i + 1, j], depth[i + 1, j + 1]])
    b, a = x - j, y - i
    weights = np.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b])
    smooth = (corners.min(0) > 0) & (corners.max(0) < 1.05 * corners.min(0))
    found = 1 / (weights / np.where(corners > 0, corners, 1)).sum(0)
    error = np.abs(found - carried[:, 2])[smooth]
    agrees = error < np.maximum(1, 0.05 * carried[smooth, 2])
    assert agrees.sum() > 100
    return float(np.median(error[agrees])), float(agrees.mean())


def rewrite_line(folder: Path, index: int, change: Callable[[str], str]) -> None:
    lines = (folder / "pose.txt").read_text().splitlines()
    lines[index] = change(lines[index])
    (folder / "pose.txt").write_text("\n".join(lines))


def rewrite_pose(folder: Path, index: int, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Change a pose, given as the camera-to-world matrix."""

    def of_line(line: str) -> str:
        matrix = np.array([float(value) for value in line.split(",")]).reshape(4, 4).T
        return ",".join(f"{value:.9g}" for value in change(matrix).T.ravel())

    rewrite_line(folder, index, of_line)
