"""A capture of an object as the field's NeRF scenes are: images round it and `transforms.json`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image

from extrags.cameras import Cameras, look_at, pixel_rays

SIZE = (64, 48)
FOCAL_PX = 70.0
BACKGROUND = (235, 235, 230)
RADIUS = 4.0


def object_cameras(views: int) -> Cameras:
    """On a spiral over the upper hemisphere, all looking at the object."""
    height = np.linspace(0.25, 0.85, views)
    turn = np.arange(views) * 2.4
    across = np.sqrt(1 - height**2)
    centres = RADIUS * np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)
    poses = np.stack(
        [look_at(centre, np.array([0, 0, 0.3]), np.array([0.0, 0.0, 1.0])) for centre in centres]
    )
    K = np.array([[FOCAL_PX, 0, SIZE[0] / 2], [0, FOCAL_PX, SIZE[1] / 2], [0, 0, 1]])
    return Cameras(np.tile(K, (views, 1, 1)), poses, *SIZE)


def write_object_capture(folder: Path, views: int = 12) -> None:
    """Coloured bricks, a ball and a ring on a plain background, rendered, written for instant-ngp."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    colors = {}
    for color, shape, place in _parts(o3d):
        shape.translate(place)
        colors[scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(shape))] = color
    cameras = object_cameras(views)
    rays = pixel_rays(cameras).astype(np.float32)
    (folder / "images").mkdir(parents=True)
    frames = []
    for index in range(views):
        flat = rays[index].reshape(-1, 3)
        from_lens = np.concatenate([np.broadcast_to(cameras.centers[index], flat.shape), flat], axis=1)
        hit = scene.cast_rays(o3d.core.Tensor(from_lens.astype(np.float32)))
        part, normal = hit["geometry_ids"].numpy(), hit["primitive_normals"].numpy()
        light = 0.55 + 0.45 * np.abs(normal @ np.array([0.4, 0.3, 0.86]))
        image = np.tile(np.array(BACKGROUND, dtype=np.float64), (len(flat), 1))
        for number, color in colors.items():
            image[part == number] = np.array(color) * light[part == number, None]
        name = f"images/r_{index:02d}.png"
        Image.fromarray(image.reshape(SIZE[1], SIZE[0], 3).clip(0, 255).astype(np.uint8)).save(folder / name)
        pose = cameras.world_from_camera[index] @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    angle = 2 * float(np.arctan(SIZE[0] / 2 / FOCAL_PX))
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))


def _parts(o3d):  # type: ignore[no-untyped-def]
    shapes = o3d.geometry.TriangleMesh
    yield (200, 160, 40), shapes.create_box(1.6, 1.0, 0.3), (-0.8, -0.5, 0.0)
    yield (60, 90, 190), shapes.create_box(0.5, 0.5, 0.6), (-0.6, -0.25, 0.3)
    yield (190, 50, 40), shapes.create_sphere(0.3, 12), (0.4, 0.1, 0.6)
    yield (50, 140, 70), shapes.create_torus(0.35, 0.1, 16, 8), (0.4, -0.1, 0.35)
