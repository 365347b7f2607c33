"""A textured slanted plane seen exactly by several cameras."""

from __future__ import annotations

import numpy as np

from extrags.cameras import Cameras, compose, pixel_rays, rotation_about
from extrags.sequence import EndoscopicSequence, Split

WIDTH, HEIGHT = 48, 40
NORMAL = np.array([0.35, -0.2, -1.0]) / np.linalg.norm([0.35, -0.2, -1.0])
DISTANCE = 20.0


def cameras(shifts: np.ndarray) -> Cameras:
    """Cameras at shifts from the origin, each turned a little, looking along z."""
    K = np.array([[40.0, 0, WIDTH / 2], [0, 40.0, HEIGHT / 2], [0, 0, 1]])
    poses = [
        compose(rotation_about(np.array([0.3, 1.0, 0.2]), 0.02 * i), shift) for i, shift in enumerate(shifts)
    ]
    return Cameras(np.repeat(K[None], len(poses), 0), np.stack(poses), WIDTH, HEIGHT)


def texture(points: np.ndarray) -> np.ndarray:
    """Colours in [0, 1] that do not repeat within the images."""
    x, y = points[..., 0], points[..., 1]
    waves = [
        np.sin(0.9 * x + 0.4 * y) * np.cos(0.7 * y - 0.3 * x),
        np.sin(1.3 * y + 0.2 * x + 1) * np.cos(0.5 * x),
        np.sin(0.6 * x - 1.1 * y + 2),
    ]
    return 0.5 + 0.4 * np.stack(waves, axis=-1)


def seen(views: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Colours [C, H, W, 3] and z-depths [C, H, W]."""
    rays = pixel_rays(views)
    origin = views.centers[:, None, None]
    z = (-DISTANCE - (origin * NORMAL).sum(-1)) / (rays * NORMAL).sum(-1)
    return texture(origin + z[..., None] * rays), z


def slanted_plane(frames: int = 7, held_out: int = 2) -> EndoscopicSequence:
    """A sequence whose last frames are held out."""
    shifts = np.stack([np.linspace(-3, 3, frames), np.linspace(-1, 1, frames) ** 2, np.zeros(frames)], axis=1)
    views = cameras(shifts)
    rgb, z = seen(views)
    places = np.arange(frames)
    test = places[1 :: frames // held_out][:held_out]
    return EndoscopicSequence(
        name="slanted/0",
        rgb=(rgb * 255).round().astype(np.uint8),
        K=views.K,
        mask=np.ones(z.shape, bool),
        split=Split("test", np.setdiff1d(places, test), test),
        world_from_camera=views.world_from_camera,
        depth_mm=z.astype(np.float32),
    )
