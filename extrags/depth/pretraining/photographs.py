"""Photographs of procedural cavities: ray marching, mucosa, lamps on the camera, sensor."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from extrags.depth.frames import PosedFrames
from extrags.depth.pretraining.cavities import Cavities, Waves
from extrags.depth.pretraining.sensor import Sensor

__all__ = ["Clips", "photograph"]

MARCH_STEPS = 110
STEPS_BETWEEN_SORTINGS = 10
BISECTIONS = 7
FARTHEST = 14.0
NEAREST_WALL = 0.12
"""Clips whose lens comes nearer to a wall are discarded."""

WET_SHARE = 0.3
"""Of the clips, those with strong gloss."""


@dataclass(frozen=True)
class Clips:
    """Short clips, one per scene, with their truth.

    Args:
        frames: all frames of all clips, clip by clip.
        depth: true z-depth, 0 where a ray meets nothing, [C V, H, W].
        clip: which clip a frame belongs to, [C V].
        views: V, frames per clip.
    """

    frames: PosedFrames
    depth: Float[Tensor, "f h w"]
    clip: Tensor
    views: int


class _Mucosa:
    """Colour of the wall: a tint, its slow changes, vessels of three sizes, mottling."""

    def __init__(self, scene: Cavities, generator: torch.Generator) -> None:
        c, uniform = scene.scenes, scene.uniform
        red = uniform(0.45, 0.95, c, 1)
        self.base = torch.cat([red, red * uniform(0.25, 0.95, c, 1), red * uniform(0.2, 0.9, c, 1)], dim=1)
        self.slow = [Waves.random(generator, c, 0.6, 2.5, waves=10) for _ in range(3)]
        self.slow_strength = uniform(0.0, 0.22, c, 1)
        sizes = ((2.5, 5.0), (5.0, 11.0), (11.0, 26.0))
        self.vessels = [Waves.random(generator, c, low, high, slope=0.6, waves=20) for low, high in sizes]
        self.vessel_width = [uniform(0.05, 0.22, c, 1) for _ in sizes]
        self.vessel_strength = [uniform(0.0, 0.6, c, 1) * uniform(0.0, 1.0, c, 1) for _ in sizes]
        self.mottle = [
            Waves.random(generator, c, low, high, slope=0.3, waves=32)
            for low, high in ((8.0, 30.0), (25.0, 90.0))
        ]
        self.mottle_strength = [uniform(0.0, 0.12, c, 1) * uniform(0.0, 1.0, c, 1) for _ in range(2)]
        self.relief = Waves.random(generator, c, 15.0, 60.0, slope=0.8, waves=24)
        self.relief_strength = uniform(0.0, 0.35, c, 1)
        self.rod_color = uniform(0.2, 0.6, c, 1).expand(c, 3)

    def albedo(self, points: Tensor) -> Tensor:
        color = self.base[:, None] * torch.ones_like(points)
        slow = torch.stack([wave(points) for wave in self.slow], dim=2)
        color = color * torch.exp(self.slow_strength[:, :, None] * (slow[:, :, :1] + 0.4 * slow))
        absorbed = torch.tensor([0.35, 1.0, 0.8], device=points.device)
        for wave, width, strength in zip(self.vessels, self.vessel_width, self.vessel_strength, strict=True):
            line = torch.exp(-(wave(points) / width).square())
            density = torch.sigmoid(3 * slow[:, :, 1])
            color = color * (1 - (strength * line * density)[:, :, None] * absorbed)
        for wave, strength in zip(self.mottle, self.mottle_strength, strict=True):
            color = color * torch.exp((strength * wave(points))[:, :, None] * (0.5 + 0.5 * absorbed))
        return color.clamp(0.01, 1.5)


def photograph(scene: Cavities, generator: torch.Generator, size: tuple[int, int], views: int) -> Clips:
    """Make one clip in each scene; clips whose camera touches a wall or looks into nothing are left out.

    Args:
        scene: the scenes.
        generator: source of randomness, on the scenes' device.
        size: height and width in pixels.
        views: frames per clip.
    """
    height, width = size
    c, device, uniform = scene.scenes, scene.device, scene.uniform
    poses = scene.camera_paths(views)
    clear = scene.clearance(poses[:, :, :3, 3]).min(dim=1).values > NEAREST_WALL
    focal = 0.5 * width / torch.tan(0.5 * torch.deg2rad(uniform(55.0, 125.0, c)))
    K = torch.zeros(c, 3, 3, device=device)
    K[:, 0, 0] = K[:, 1, 1] = focal
    K[:, 0, 2] = width / 2 + uniform(-0.03, 0.03, c) * width
    K[:, 1, 2] = height / 2 + uniform(-0.03, 0.03, c) * height
    K[:, 2, 2] = 1
    # Two rays per pixel and axis.
    rows, columns = torch.meshgrid(
        (torch.arange(2 * height, device=device) + 0.5) / 2,
        (torch.arange(2 * width, device=device) + 0.5) / 2,
        indexing="ij",
    )
    x = (columns.flatten() - K[:, 0, 2, None]) / K[:, 0, 0, None]
    y = (rows.flatten() - K[:, 1, 2, None]) / K[:, 1, 1, None]
    local = torch.stack([x, y, torch.ones_like(x)], dim=2)
    mucosa, lamps = _Mucosa(scene, generator), _Lamps(scene)
    sensor = Sensor(scene, views)
    images, depths, hits = [], [], []
    for view in range(views):
        scene.moment = float(view)
        rotation, center = poses[:, view, :3, :3], poses[:, view, :3, 3]
        directions = local @ rotation.transpose(1, 2)
        z, hit = _march(scene, center, directions)
        points = center[:, None] + z[:, :, None] * directions
        radiance = lamps.radiance(scene, mucosa, points, rotation, center)
        radiance = torch.where(hit[:, :, None], radiance, 0.0)
        images.append(radiance.unflatten(1, (2 * height, 2 * width)).permute(0, 3, 1, 2))
        depths.append(torch.where(hit, z, 0.0).unflatten(1, (2 * height, 2 * width)))
        hits.append(hit.unflatten(1, (2 * height, 2 * width)))
    radiance, depth, hit = torch.stack(images, 1), torch.stack(depths, 1), torch.stack(hits, 1)
    rgb = sensor.develop(functional.avg_pool2d(radiance.flatten(0, 1), 2).unflatten(0, (c, views)), generator)
    depth, valid = _pixel_depth(depth.flatten(0, 1), hit.flatten(0, 1))
    depth, valid = depth.unflatten(0, (c, views)), valid.unflatten(0, (c, views))
    mask = valid & _field_of_view(scene, height, width)[:, None]
    usable = clear & (valid.float().mean(dim=(1, 2, 3)) > 0.7)
    kept = usable.nonzero()[:, 0]
    frames = PosedFrames(
        rgb=rgb[kept].flatten(0, 1),
        mask=mask[kept].flatten(0, 1),
        K=K[kept].repeat_interleave(views, 0),
        world_from_camera=poses[kept].flatten(0, 1),
    )
    clip = torch.arange(len(kept), device=device).repeat_interleave(views)
    return Clips(frames, depth[kept].flatten(0, 1), clip, views)


def _march(scene: Cavities, center: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """z-depth where rays with z = 1 meet the wall, and whether they do."""
    length = directions.norm(dim=2)
    z = torch.full(directions.shape[:2], 0.02, device=center.device)
    before = z.clone()
    hit = torch.zeros_like(z, dtype=torch.bool)
    for _ in range(0, MARCH_STEPS, STEPS_BETWEEN_SORTINGS):
        # Most rays meet a wall early: only those on their way, as many as the scene with most has, go on.
        going = ~hit & (z <= FARTHEST)
        n = int(going.sum(dim=1).max())
        if n == 0:
            break
        chosen = going.byte().argsort(dim=1, descending=True, stable=True)[:, :n]
        ahead = directions.gather(1, chosen[:, :, None].expand(-1, -1, 3))
        part = tuple(values.gather(1, chosen) for values in (z, before, hit, length))
        for values, found in zip((z, before, hit), _steps(scene, center, ahead, *part), strict=True):
            values.scatter_(1, chosen, found)
    low, high = before, z
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        inside = scene.clearance(center[:, None] + middle[:, :, None] * directions) > 0
        low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
    return 0.5 * (low + high), hit & (z <= FARTHEST)


def _steps(
    scene: Cavities,
    center: Tensor,
    directions: Tensor,
    z: Tensor,
    before: Tensor,
    hit: Tensor,
    length: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """z, that of the step before, and whether the wall is met, some steps further."""
    for _ in range(STEPS_BETWEEN_SORTINGS):
        inside = scene.clearance(center[:, None] + z[:, :, None] * directions)
        hit = hit | (inside <= 0)
        # Steep folds are steeper than a distance: only part of the clearance is gone ahead.
        step = (0.45 * inside).clamp(0.012, 0.35) / length
        before = torch.where(hit, before, z)
        z = torch.where(hit, z, z + step)
    return z, before, hit


def _pixel_depth(depth: Tensor, hit: Tensor) -> tuple[Tensor, Tensor]:
    """Depth of a pixel from its four rays: their mean in logarithm, or the nearest where an edge passes."""
    blocks = functional.pixel_unshuffle(depth[:, None], 2)
    logs = torch.log(blocks.clamp_min(1e-6))
    smooth = logs.max(dim=1).values - logs.min(dim=1).values < 0.05
    value = torch.where(smooth, logs.mean(dim=1).exp(), blocks.min(dim=1).values)
    return value, functional.pixel_unshuffle(hit[:, None].float(), 2).min(dim=1).values > 0.5


def _field_of_view(scene: Cavities, height: int, width: int) -> Bool[Tensor, "c h w"]:
    rows, columns = torch.meshgrid(
        torch.arange(height, device=scene.device) + 0.5,
        torch.arange(width, device=scene.device) + 0.5,
        indexing="ij",
    )
    radius = scene.uniform(0.42, 1.4, scene.scenes, 1, 1) * width
    return (columns - width / 2).square() + (rows - height / 2).square() < radius.square()


class _Lamps:
    """One to three lamps beside the lens; in some scenes a part of the light does not ride on the camera."""

    def __init__(self, scene: Cavities) -> None:
        c, uniform = scene.scenes, scene.uniform
        self.offset = uniform(-0.2, 0.2, c, 3, 3) * torch.tensor([1.0, 1.0, 0.15], device=scene.device)
        self.power = torch.cat(
            [torch.ones(c, 1, device=scene.device), uniform(-1.0, 1.0, c, 2).clamp_min(0)], dim=1
        )
        self.spread = uniform(0.0, 2.5, c, 1)
        self.around = uniform(0.0, 0.3, c, 1)
        self.shine = uniform(0.0, 0.6, c, 1) * uniform(0.0, 1.0, c, 1)
        self.sharpness = uniform(20.0, 200.0, c, 1)
        # A wet coat mirrors the lamp in small spots far brighter than the tissue.
        wet = uniform(0.0, 1.0, c, 1) < WET_SHARE
        self.shine = torch.where(wet, uniform(0.5, 3.0, c, 1), self.shine)
        self.sharpness = torch.where(wet, uniform(40.0, 500.0, c, 1), self.sharpness)
        self.fixed = (uniform(0.0, 1.0, c, 1) < 0.08).float() * uniform(0.5, 1.0, c, 1)
        self.sun = uniform(-1.0, 1.0, c, 3)

    def radiance(
        self, scene: Cavities, mucosa: _Mucosa, points: Tensor, rotation: Tensor, center: Tensor
    ) -> Tensor:
        normal, at_rest = _normal(scene, points), scene.at_rest(points)
        albedo = mucosa.albedo(at_rest)
        if scene.kind == "field":
            on_rod = scene.on_instruments(points)
            albedo = torch.where(on_rod[:, :, None], mucosa.rod_color[:, None], albedo)
        to_eye = center[:, None] - points
        distance = to_eye.norm(dim=2, keepdim=True).clamp_min(1e-6)
        to_eye = to_eye / distance
        bent = normal + mucosa.relief_strength[:, :, None] * torch.stack(
            [mucosa.relief(at_rest + shift) for shift in (0.0, 7.3, 17.9)], dim=2
        )
        bent = bent / bent.norm(dim=2, keepdim=True)
        axis = rotation[:, None, :, 2]
        total = torch.zeros_like(points)
        for lamp in range(self.power.shape[1]):
            position = center + torch.einsum("cij,cj->ci", rotation, self.offset[:, lamp])
            to_lamp = position[:, None] - points
            squared = to_lamp.square().sum(2).clamp_min(1e-3)
            to_lamp = to_lamp / squared.sqrt()[:, :, None]
            beam = (-(to_lamp * axis).sum(2)).clamp_min(0.02) ** self.spread
            incident = self.power[:, lamp, None] * beam / squared
            cosine = (normal * to_lamp).sum(2).clamp_min(0)
            total = total + (incident * (cosine + self.around))[:, :, None] * albedo
            half = to_lamp + to_eye
            half = half / half.norm(dim=2, keepdim=True).clamp_min(1e-6)
            lobe = (bent * half).sum(2).clamp_min(0) ** self.sharpness
            total = total + (incident * self.shine * lobe * (cosine > 0))[:, :, None]
        sun = self.sun / self.sun.norm(dim=1, keepdim=True)
        steady = (0.6 + 0.4 * (normal * sun[:, None]).sum(2))[:, :, None] * albedo
        mixed: Tensor = total * (1 - self.fixed[:, :, None]) + self.fixed[:, :, None] * steady
        return mixed


def _normal(scene: Cavities, points: Tensor) -> Tensor:
    step = 0.004
    corners = torch.tensor([[1.0, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], device=points.device)
    gradient = sum(
        (corner * scene.clearance(points + step * corner)[:, :, None] for corner in corners),
        start=torch.zeros_like(points),
    )
    unit: Tensor = gradient / gradient.norm(dim=2, keepdim=True).clamp_min(1e-9)
    return unit
