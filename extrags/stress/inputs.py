"""What the rows are given: lit scenes, images without content, surfaces of known shape."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.cameras import Cameras, compose, pixel_rays, rotation_about
from extrags.raster.bench import BenchSize, bench_scene

__all__ = [
    "FARTHEST_OFFSET_MM",
    "GAINS",
    "IMAGES",
    "SCALES",
    "LitScene",
    "image",
    "lit_tube",
    "plane_views",
    "random_lit_scene",
    "slow",
]

SCALES = (1e-3, 1e-2, 1.0, 1e2, 1e4)
"""Of a scene whose typical depth is one."""
FARTHEST_OFFSET_MM = 1e5
GAINS = (1 / 16, 1.0, 16.0)
"""Of the exposure."""
IMAGES = ("constant", "black", "saturated", "noise", "one bright pixel")


def image(kind: str, *shape: int, seed: int = 0) -> Tensor:
    """An image with nothing, or nothing but noise, in it; values in [0, 1]."""
    if kind == "noise":
        return torch.rand(shape, generator=torch.Generator().manual_seed(seed))
    made = torch.full(shape, {"constant": 0.4, "saturated": 1.0}.get(kind, 0.0))
    if kind == "one bright pixel":
        made.view(-1)[made.numel() // 2] = 1.0
    return made


@dataclass(frozen=True)
class LitScene:
    """Gaussians as they are trained, one view of them, and its light.

    Args:
        parameters: means, quats, logarithms of scales, logits of opacities, sh.
        viewmat: camera from world, [4, 4].
        K: [3, 3].
        target: [H, W, 3].
        depth: [H, W].
        light: a row of `CameraLight.packed`, [14]; None without light.
    """

    parameters: dict[str, Tensor]
    viewmat: Tensor
    K: Tensor
    target: Tensor
    depth: Tensor
    light: Tensor | None

    def with_parameters(self, **values: Tensor) -> LitScene:
        """With other parameters."""
        return replace(self, parameters={**self.parameters, **values})

    def scaled(self, factor: float) -> LitScene:
        """The same scene in another unit of length."""
        light = None if self.light is None else self.light.clone()
        if light is not None:
            light[-1] *= factor
        viewmat = self.viewmat.clone()
        viewmat[:3, 3] *= factor
        means = self.parameters["means"] * factor
        scales = self.parameters["scales"] + math.log(factor)
        moved = self.with_parameters(means=means, scales=scales)
        return replace(moved, viewmat=viewmat, depth=self.depth * factor, light=light)

    def moved(self, shift: Tensor) -> LitScene:
        """The same scene elsewhere."""
        viewmat = self.viewmat.double()
        viewmat[:3, 3] -= viewmat[:3, :3] @ shift.double()
        means = (self.parameters["means"].double() + shift).to(self.parameters["means"].dtype)
        return replace(self.with_parameters(means=means), viewmat=viewmat.to(self.viewmat.dtype))


def lit_tube(n: int = 200, width: int = 40, height: int = 32, *, seed: int = 3, lit: bool = True) -> LitScene:
    """The standard scene of the kernels' benchmark, with light and measured depth.

    Args:
        n: Gaussians.
        width: of the image, in pixels.
        height: in pixels.
        seed: of everything that is drawn.
        lit: whether there is a light.
    """
    base = bench_scene(BenchSize(width, height, n), seed=seed)
    generator = torch.Generator().manual_seed(seed)
    depth = 1.0 + 5 * torch.rand(height, width, generator=generator)
    depth[torch.rand(height, width, generator=generator) < 0.2] = 0
    light = torch.tensor([1.3, 1.1, 0.9, 0.05, 1.0, 1.5, 0.8, 0.05, -0.04, 0.02, 0.6, 0.2, 0.15, 2.0])
    parameters = {
        "means": base["means"],
        "quats": base["quats"],
        "scales": base["scales"].log(),
        "opacities": torch.logit(base["opacities"]),
        "sh": base["sh"],
    }
    return LitScene(
        parameters, base["viewmats"][0], base["Ks"][0], base["target"][0], depth, light if lit else None
    )


def random_lit_scene(seed: int, *, wild: bool = False) -> LitScene:
    """A scene of random size, lens, pose, scale, light and shapes.

    Args:
        seed: of everything.
        wild: every parameter far beyond its plausible range.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=generator)

    def log_uniform(low: float, high: float, *shape: int) -> Tensor:
        return uniform(math.log(low), math.log(high), *shape).exp()

    n = int(uniform(1.0, 40.0))
    width, height = int(uniform(1.0, 24.0)), int(uniform(1.0, 20.0))
    unit = float(log_uniform(1e-3, 1e4))
    focal = log_uniform(1.0, 1e3) if wild else width * log_uniform(0.4, 2.0)
    K = torch.eye(3)
    K[0, 0] = K[1, 1] = focal
    K[0, 2], K[1, 2] = width * uniform(0.3, 0.7), height * uniform(0.3, 0.7)
    turn = torch.randn(3, 3, generator=generator)
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.linalg.matrix_exp(turn - turn.T)
    viewmat[:3, 3] = 0.3 * unit * torch.randn(3, generator=generator)
    # In front of the camera, within what it sees and somewhat beyond.
    depth = log_uniform(0.2, 6.0, n)
    across = uniform(-0.8, 0.8, n, 2) * torch.tensor([width, height]) / focal
    local = unit * torch.cat([across * depth[:, None], depth[:, None]], dim=1)
    means = (local - viewmat[:3, 3]) @ viewmat[:3, :3]
    shape = log_uniform(1e-8, 1e5, n, 3) if wild else unit * log_uniform(0.02, 0.5, n, 3)
    scales = shape.log()
    light = torch.cat(
        [
            log_uniform(1 / 16, 16.0, 1) * uniform(0.7, 1.3, 3),
            log_uniform(1e-4, 2.0, 1),
            uniform(0.2, 2.2, 1),
            uniform(0.0, 3.0, 1),
            uniform(0.0, 2.0, 1),
            uniform(-0.1, 0.1, 3),
            uniform(0.0, 4.0, 1),
            uniform(0.0, 1.0, 1),
            log_uniform(0.01, 1.0, 1),
            torch.tensor([unit]) * log_uniform(0.3, 3.0, 1),
        ]
    )
    logits = uniform(-120.0, 120.0, n) if wild else uniform(-4.0, 6.0, n)
    truth = uniform(0.2, 6.0, height, width) * unit
    truth[uniform(0.0, 1.0, height, width) < 0.3] = 0
    sh = 0.3 * torch.randn(n, 4, 3, generator=generator)
    sh[:, 0] += 0.5
    quats = torch.randn(n, 4, generator=generator)
    parameters = {
        "means": means,
        "quats": quats * log_uniform(1e-15, 1e15, n, 1) if wild else quats,
        "scales": scales,
        "opacities": logits,
        "sh": sh * float(log_uniform(1e-3, 1e3)) if wild else sh,
    }
    return LitScene(parameters, viewmat, K, uniform(0.0, 1.0, height, width, 3), truth, light)


def plane_views(
    frames: int, width: int, height: int, *, unit: float = 1.0, offset_mm: float = 0.0
) -> tuple[Cameras, Float[np.ndarray, "f h w"], Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Views of a slanted plane.

    Args:
        frames: views, on a closed way.
        width: of an image, in pixels.
        height: in pixels.
        unit: half the distance of the plane, in world units; the way grows with it.
        offset_mm: of everything from the origin, along each axis.

    Returns:
        The cameras; exact z-depth, [F, H, W]; the plane's unit normal, and a point of it.
    """
    turn = rotation_about(np.array([0.3, 1.0, 0.2]) / np.linalg.norm([0.3, 1.0, 0.2]), 0.7)
    middle = np.full(3, offset_mm)
    poses = []
    for index in range(frames):
        phase = 2 * math.pi * index / max(frames, 1)
        sway = np.array([0.15 * math.sin(phase), 0.1 * math.cos(phase), 0.05 * math.sin(2 * phase)]) * unit
        poses.append(compose(turn, middle + sway))
    K = np.array([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1.0]])
    cameras = Cameras(np.tile(K, (frames, 1, 1)), np.stack(poses), width, height)
    normal = turn @ np.array([0.25, -0.15, 1.0]) / np.linalg.norm([0.25, -0.15, 1.0])
    point = middle + turn @ np.array([0.0, 0.0, 2.0 * unit])
    rays = pixel_rays(cameras)
    ahead = ((point - cameras.centers) @ normal)[:, None, None] / (rays @ normal)
    return cameras, ahead.astype(np.float32), normal, point


def slow(values: Iterator[int], upper: int) -> Iterator[int]:
    """Those up to a bound: what a short run leaves out."""
    return (value for value in values if value <= upper)
