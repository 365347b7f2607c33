"""Exact views of a textured plane and of a textured sphere seen from inside, for stereo."""

from __future__ import annotations

import numpy as np
import torch

from extrags.depth.frames import PosedFrames

__all__ = ["inside_sphere", "on", "tilted_plane"]


def _texture(points: torch.Tensor) -> torch.Tensor:
    """Smooth random brightness of surface points, [..., 3] to [...]."""
    generator = torch.Generator().manual_seed(4)
    waves = torch.randn(3, 40, generator=generator) * 9
    phases = 6.3 * torch.rand(40, generator=generator)
    return 0.45 + 0.05 * torch.sin(points @ waves + phases).sum(-1).clamp(-7, 7)


def _frames(depth_of, views: int, height: int, width: int, pace: float) -> tuple[PosedFrames, torch.Tensor]:  # type: ignore[no-untyped-def]
    K = torch.tensor([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1.0]])
    poses = torch.eye(4).repeat(views, 1, 1)
    poses[:, 0, 3] = pace * (torch.arange(views) - views / 2)
    poses[:, 1, 3] = 0.4 * pace * torch.sin(torch.arange(views).float())
    frames = PosedFrames(
        rgb=torch.zeros(views, 3, height, width),
        mask=torch.ones(views, height, width, dtype=torch.bool),
        K=K.repeat(views, 1, 1),
        world_from_camera=poses,
    )
    rays = frames.rays
    centers = poses[:, :3, 3, None, None]
    depth = depth_of(centers, rays)
    points = (centers + depth[:, None] * rays).permute(0, 2, 3, 1)
    frames.rgb[:] = _texture(points)[:, None]
    return frames, depth


def tilted_plane(views: int = 5, height: int = 40, width: int = 52) -> tuple[PosedFrames, torch.Tensor]:
    """A plane 30 degrees off the image plane, about 2 units away; frames and true z-depth."""
    normal = torch.tensor([np.sin(np.pi / 6), 0.0, np.cos(np.pi / 6)], dtype=torch.float32)[
        None, :, None, None
    ]

    def depth_of(centers: torch.Tensor, rays: torch.Tensor) -> torch.Tensor:
        return (2.0 - (normal * centers).sum(1)) / (normal * rays).sum(1)

    return _frames(depth_of, views, height, width, 0.25)


def inside_sphere(views: int = 5, height: int = 40, width: int = 52) -> tuple[PosedFrames, torch.Tensor]:
    """A sphere of radius 2 around the cameras; frames and true z-depth."""

    def depth_of(centers: torch.Tensor, rays: torch.Tensor) -> torch.Tensor:
        a, b = (rays * rays).sum(1), (rays * centers).sum(1)
        return (-b + torch.sqrt(b * b - a * ((centers * centers).sum(1) - 4.0))) / a

    return _frames(depth_of, views, height, width, 0.25)


def on(frames: PosedFrames, device: str) -> PosedFrames:
    """The same frames on a device."""
    return PosedFrames(
        frames.rgb.to(device),
        frames.mask.to(device),
        frames.K.to(device),
        frames.world_from_camera.to(device),
    )
