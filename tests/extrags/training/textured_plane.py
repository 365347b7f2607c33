"""A tilted plane with texture of all directions, and what spoils a frame of it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from extrags.sequence import EndoscopicSequence, Split

WIDTH, HEIGHT, FOCAL_PX, FRAMES = 96, 80, 90.0, 8
DISTANCE_MM = 40.0


def textured_plane(seed: int = 0) -> EndoscopicSequence:
    """A tilted plane with texture of all directions, seen by a camera that moves along it and turns."""
    generator = np.random.default_rng(seed)
    K = np.array([[FOCAL_PX, 0, WIDTH / 2], [0, FOCAL_PX, HEIGHT / 2], [0, 0, 1]])
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack(
        [(columns - WIDTH / 2) / FOCAL_PX, (rows - HEIGHT / 2) / FOCAL_PX, np.ones_like(rows)], -1
    )
    normal = np.array([0.2, -0.1, 1.0])
    wavelength_mm = generator.uniform(5.0, 16.0, 40) * DISTANCE_MM / FOCAL_PX
    angle, phase = generator.uniform(0, 2 * np.pi, (2, 40))
    waves = np.stack([np.cos(angle), np.sin(angle)]) * 2 * np.pi / wavelength_mm
    rgb, depth, poses = [], [], []
    for frame in range(FRAMES):
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(np.array([0.01 * frame, -0.02 * (frame - 4), 0.03 * frame]))[0]
        pose[:3, 3] = [1.2 * (frame - 4), 0.8 * (frame % 3), 0.5 * (frame % 2)]
        directions = rays @ pose[:3, :3].T
        z = (DISTANCE_MM - pose[:3, 3] @ normal) / (directions @ normal)
        points = pose[:3, 3] + directions * z[..., None]
        texture = np.sin(points[..., :2] @ waves + phase).mean(axis=-1)
        # Each frame has an exposure of its own.
        brightness = (0.9 + 0.03 * frame) * (0.5 + texture)
        rgb.append(brightness[..., None] * np.array([1.0, 0.7, 0.6]) * 255)
        depth.append(z)
        poses.append(pose)
    return EndoscopicSequence(
        name="made/plane",
        rgb=np.stack(rgb).clip(0, 255).astype(np.uint8),
        K=np.repeat(K[None], FRAMES, axis=0),
        mask=np.ones((FRAMES, HEIGHT, WIDTH), dtype=bool),
        split=Split("all", np.arange(FRAMES), np.arange(0)),
        world_from_camera=np.stack(poses),
        depth_mm=np.stack(depth).astype(np.float32),
        frame_names=tuple(f"{frame:03d}.png" for frame in range(FRAMES)),
    )


def changed(sequence: EndoscopicSequence, frame: int, image: np.ndarray) -> EndoscopicSequence:
    rgb = sequence.rgb.copy()
    rgb[frame] = image
    return replace(sequence, rgb=rgb)


def blurred_along_rows(image: np.ndarray, length_px: int) -> np.ndarray:
    return np.asarray(cv2.blur(image, (length_px, 1)))
