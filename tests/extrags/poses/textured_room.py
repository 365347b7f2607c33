"""A small room with textured walls, seen from inside: exact depth and poses in a few lines."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from extrags.cameras import Cameras, look_at, pixel_rays
from extrags.sequence import EndoscopicSequence, Split

HALF_SIZE_MM = np.array([14.0, 11.0, 16.0])
TEXELS = 420


def room_sequence(
    n_frames: int, *, width: int = 240, height: int = 180, holdout_every: int = 4
) -> EndoscopicSequence:
    """Frames on an arc inside the room; every n-th is held out."""
    t = np.linspace(-1, 1, n_frames)
    centers = np.stack([6 * np.sin(1.2 * t), 2.0 * np.cos(2.3 * t), -9 + 2.5 * t], axis=1)
    targets = np.stack([2 * t, 1.5 * np.sin(3 * t), np.full(n_frames, 12.0)], axis=1)
    up = np.array([0.0, -1.0, 0.1])
    poses = np.stack([look_at(c, x, up) for c, x in zip(centers, targets, strict=True)])
    K = np.tile(
        np.array([[0.7 * width, 0, width / 2], [0, 0.7 * width, height / 2], [0, 0, 1]]), (n_frames, 1, 1)
    )
    cameras = Cameras(K, poses, width, height)
    rgb, depth = render_room(cameras)
    frames = np.arange(n_frames)
    held_out = frames % holdout_every == holdout_every - 1
    return EndoscopicSequence(
        name="room/arc",
        rgb=rgb,
        K=K,
        mask=np.ones(depth.shape, dtype=bool),
        split=Split("every", frames[~held_out], frames[held_out]),
        world_from_camera=poses,
        depth_mm=depth.astype(np.float32),
        frame_names=tuple(f"arc-{frame}" for frame in frames),
    )


def turning_room(n_frames: int) -> EndoscopicSequence:
    """All from one place, held out none: good matches, no parallax."""
    room = room_sequence(n_frames, width=200, height=150)
    turn = np.linspace(-0.35, 0.35, n_frames)
    center = np.array([1.0, -1.0, -6.0])
    poses = np.stack(
        [
            look_at(
                center, center + np.array([np.sin(a), 0.3 * np.sin(2 * a), np.cos(a)]), np.array([0, -1.0, 0])
            )
            for a in turn
        ]
    )
    rgb, depth = render_room(Cameras(room.K, poses, room.width, room.height))
    split = Split("all", np.arange(n_frames), np.arange(0))
    return replace(room, rgb=rgb, depth_mm=depth.astype(np.float32), world_from_camera=poses, split=split)


def render_room(cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """uint8 colours and z-depth in mm."""
    rays = pixel_rays(cameras)
    centers = cameras.centers[:, None, None]
    with np.errstate(divide="ignore"):
        exits = (np.sign(rays) * HALF_SIZE_MM - centers) / rays
    exits = np.where(rays == 0, np.inf, exits)
    wall = exits.argmin(-1)
    depth = np.take_along_axis(exits, wall[..., None], -1)[..., 0]
    points = centers + depth[..., None] * rays
    colors = np.zeros(points.shape)
    for axis in range(3):
        for side in (-1, 1):
            here = (wall == axis) & (np.sign(points[..., axis]) == side)
            across = [k for k in range(3) if k != axis]
            uv = (points[here][:, across] / HALF_SIZE_MM[across] + 1) / 2 * (TEXELS - 1)
            texture = wall_texture(2 * axis + (side > 0))
            colors[here] = np.stack(
                [map_coordinates(texture[..., c], uv.T, order=1, mode="nearest") for c in range(3)], axis=-1
            )
    return (colors * 255).round().astype(np.uint8), depth


@functools.cache
def wall_texture(seed: int) -> np.ndarray:
    """Made once a process: each rendering takes six, and they are most of what it costs."""
    rng = np.random.default_rng(seed)
    texture = np.zeros((TEXELS, TEXELS, 3))
    for sigma, weight in ((2.0, 0.5), (5.0, 0.7), (14.0, 1.0)):
        noise = gaussian_filter(rng.normal(size=(TEXELS, TEXELS, 3)), (sigma, sigma, 0))
        texture += weight * noise / noise.std()
    texture = np.clip(0.5 + 0.16 * texture, 0, 1)
    texture.flags.writeable = False
    return texture
