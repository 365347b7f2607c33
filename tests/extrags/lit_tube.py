"""A tube ray-cast exactly under a light that rides on the camera, and Gaussians on its wall."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from extrags.cameras import Cameras, look_at, pixel_rays
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.raster.light import shortest_axes
from extrags.restoration.training_data.recordings import PretrainingRecording
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, Split
from extrags.view_synthesis.gather import gather_references
from extrags.view_synthesis.references import LightTransfer, ReferenceViews

WIDTH, HEIGHT = 64, 48
RADIUS_MM = 12.0


def tube_light(frames: int) -> NearFieldLight:
    return NearFieldLight(torch.tensor(-2.0), torch.tensor(0.8).log(), torch.zeros(frames), 20.0)


def albedo(points: np.ndarray) -> np.ndarray:
    angle, along = np.arctan2(points[..., 1], points[..., 0]), points[..., 2]
    veins = 0.5 + 0.25 * np.sin(3 * angle + 0.15 * along) + 0.2 * np.sin(0.5 * along) * np.cos(2 * angle)
    return 0.5 * np.stack([0.35 + 0.5 * veins, 0.2 + 0.35 * veins, 0.2 + 0.25 * veins], axis=-1)


def cast_tube(cameras: Cameras, light: NearFieldLight | None) -> tuple[np.ndarray, np.ndarray]:
    """Colour [C, H, W, 3] and z-depth [C, H, W] of an endless tube round the z axis, seen from inside."""
    rays = pixel_rays(cameras)
    origin = np.broadcast_to(cameras.centers[:, None, None], rays.shape)
    a = (rays[..., :2] ** 2).sum(-1)
    b = (rays[..., :2] * origin[..., :2]).sum(-1)
    c = (origin[..., :2] ** 2).sum(-1) - RADIUS_MM**2
    depth = (-b + np.sqrt(b * b - a * c)) / np.maximum(a, 1e-12)
    depth = np.minimum(depth, 80.0)
    points = origin + depth[..., None] * rays
    rgb = albedo(points)
    if light is not None:
        distance = np.linalg.norm(points - origin, axis=-1)
        rgb = rgb * light.falloff(torch.from_numpy(distance)).numpy()[..., None]
    return rgb.clip(0, 1), depth


def tube_depth_mm(camera: Cameras) -> np.ndarray:
    """True z-depth of one view."""
    return np.asarray(cast_tube(camera, None)[1][0])


def tube_picture(camera: Cameras) -> np.ndarray:
    """8-bit image of one view, lit as the frames are."""
    return np.rint(cast_tube(camera, tube_light(1))[0][0] * 255).astype(np.uint8)


def tube_recording(tube: Tube) -> PretrainingRecording:
    """The tube as if made for pretraining; its held-out frames are one clip."""
    clip = np.zeros(len(tube.sequence.test), np.int64)
    return PretrainingRecording(tube.sequence, clip, "tube", tube_depth_mm, tube_picture)


def tube_cameras(
    n: int, *, offset_mm: float = 2.0, start_mm: float = 0.0, turn: float = 0.0, enlarged: int = 1
) -> Cameras:
    poses = []
    for i in range(n):
        z = start_mm + 2.5 * i
        center = np.array([offset_mm * np.sin(0.8 * i), offset_mm * np.cos(0.8 * i), z])
        target = center + np.array([14 * np.sin(0.3 * i + turn), 6 * np.cos(0.5 * i), 18.0])
        poses.append(look_at(center, target, np.array([0.0, -1.0, 0.0])))
    width, height = enlarged * WIDTH, enlarged * HEIGHT
    K = np.array([[34.0 * enlarged, 0, width / 2], [0, 34.0 * enlarged, height / 2], [0, 0, 1]])
    return Cameras(np.tile(K, (n, 1, 1)), np.stack(poses), width, height)


def exact_references(cameras: Cameras, light: NearFieldLight | None) -> ReferenceViews:
    """References that know colour and depth exactly, without any scene behind them."""
    rgb, depth = cast_tube(cameras, light)
    packed = np.concatenate(
        [rgb, np.ones_like(rgb[..., :1]), 1 / depth[..., None], np.ones_like(rgb[..., :1])], axis=-1
    )
    return ReferenceViews(
        np.arange(len(cameras)),
        cameras,
        torch.from_numpy(packed.astype(np.float32)).permute(0, 3, 1, 2).contiguous(),
        torch.ones(len(cameras)),
        torch.zeros(len(cameras), 0, dtype=torch.bool),
        LightTransfer(light, 0.0, 20.0),
    )


@dataclass(frozen=True)
class Tube:
    scene: Scene
    sequence: EndoscopicSequence
    references: ReferenceViews


def build_tube(*, enlarged: int = 1) -> Tube:
    """Twelve exact frames of a tube, and a scene of 5000 flat Gaussians with a gap in its wall."""
    frames = 12
    light = tube_light(frames)
    cameras = tube_cameras(frames, enlarged=enlarged)
    rgb, depth = cast_tube(cameras, light)
    generator = np.random.default_rng(5)
    angle, along = generator.uniform(-np.pi, np.pi, 5000), generator.uniform(-2, 75, 5000)
    points = np.stack([RADIUS_MM * np.cos(angle), RADIUS_MM * np.sin(angle), along], axis=1)
    gap = (np.abs(angle) < 0.7) & (along > 25) & (along < 40)
    points, angle = points[~gap], angle[~gap]
    gaussians = Gaussians.from_points(points, albedo(points), np.full(len(points), 0.7), opacity=0.95)
    # Turned so that the first axis points outwards, and thin along it.
    quats = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=1)
    gaussians.quats.copy_(torch.from_numpy(quats.astype(np.float32)))
    gaussians.scales[:, 0] = np.log(0.05)
    sequence = EndoscopicSequence(
        name="test/tube",
        rgb=np.rint(rgb * 255).astype(np.uint8),
        K=cameras.K,
        mask=np.ones(depth.shape, dtype=bool),
        split=Split("test", np.arange(frames - 2), np.arange(frames - 2, frames)),
        world_from_camera=cameras.world_from_camera,
        depth_mm=depth.astype(np.float32),
    )
    scene = Scene(gaussians, tube_light(frames - 2))
    return Tube(scene, sequence, gather_references(scene, sequence, sequence.train))


def seen_from_inside(scene: Scene) -> Scene:
    """The same scene, which knows that its Gaussians were seen from the axis."""
    gaussians = scene.gaussians
    inward = -gaussians.means * torch.tensor([1.0, 1.0, 0.0])
    cosines = (shortest_axes(gaussians.quats, gaussians.scales) * inward).sum(dim=1)
    return replace(scene, facing=cosines.sign().to(torch.int8))


def from_outside() -> Cameras:
    """A camera beside the tube that looks at its axis."""
    camera = tube_cameras(1)
    pose = look_at(
        np.array([-2.5 * RADIUS_MM, 0.0, 10.0]), np.array([0.0, 0.0, 20.0]), up=np.array([0.0, -1.0, 0.0])
    )
    return replace(camera, world_from_camera=pose[None])
