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
from extrags.sequence import EndoscopicSequence, Split

__all__ = [
    "FARTHEST_OFFSET_MM",
    "GAINS",
    "IMAGES",
    "PLANE_UNIT_MM",
    "SCALES",
    "TURN",
    "UPRIGHT",
    "LitScene",
    "depth_of_plane",
    "image",
    "lit_tube",
    "painted",
    "plane_recording",
    "plane_views",
    "random_lit_scene",
    "slow",
]

SCALES = (1e-3, 1e-2, 1.0, 1e2, 1e4)
"""Of a scene whose typical depth is one."""
FARTHEST_OFFSET_MM = 1e5
GAINS = (1 / 16, 1.0, 16.0)
"""Of the exposure."""
UPRIGHT = np.eye(3)
TURN = rotation_about(np.array([2.0, -5.5, 3.5]) / np.linalg.norm([2.0, -5.5, 3.5]), 1.36)
"""Of a world by no right angle about any axis."""
PLANE_UNIT_MM = 20.0
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
        light: a row of `CameraLight.packed`, [17]; None without light.
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
    light = torch.tensor(
        [1.3, 1.1, 0.9, 0.05, 1.0, 1.5, 0.8, 0.05, -0.04, 0.02, 0.6, 0.2, 0.15, 0.1, 0.05, 0.07, 2.0]
    )
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
    target = uniform(0.0, 1.0, height, width, 3)
    light = torch.cat([light[:-1], log_uniform(1e-3, 0.5, 3), light[-1:]])
    return LitScene(parameters, viewmat, K, target, truth, light)


def plane_views(
    frames: int,
    width: int,
    height: int,
    *,
    unit: float = 1.0,
    offset_mm: float = 0.0,
    turn: Float[np.ndarray, "3 3"] = UPRIGHT,
) -> tuple[Cameras, Float[np.ndarray, "f h w"], Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Views of a slanted plane.

    Args:
        frames: views, on a closed way.
        width: of an image, in pixels.
        height: in pixels.
        unit: half the distance of the plane, in world units; the way grows with it.
        offset_mm: of everything from the origin, along each axis.
        turn: of everything about that place.

    Returns:
        The cameras; exact z-depth, [F, H, W]; the plane's unit normal, and a point of it.
    """
    slant = turn @ rotation_about(np.array([0.3, 1.0, 0.2]) / np.linalg.norm([0.3, 1.0, 0.2]), 0.7)
    middle = np.full(3, offset_mm)
    poses = []
    for index in range(frames):
        phase = 2 * math.pi * index / max(frames, 1)
        sway = np.array([0.15 * math.sin(phase), 0.1 * math.cos(phase), 0.05 * math.sin(2 * phase)]) * unit
        poses.append(compose(slant, middle + turn @ sway))
    K = np.array([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1.0]])
    cameras = Cameras(np.tile(K, (frames, 1, 1)), np.stack(poses), width, height)
    normal = slant @ np.array([0.25, -0.15, 1.0]) / np.linalg.norm([0.25, -0.15, 1.0])
    point = middle + slant @ np.array([0.0, 0.0, 2.0 * unit])
    return cameras, depth_of_plane(cameras, normal, point).astype(np.float32), normal, point


def depth_of_plane(
    cameras: Cameras, normal: Float[np.ndarray, "3"], point: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "f h w"]:
    """Exact z-depth of a plane in any views; negative where it lies behind them."""
    ahead = ((point - cameras.centers) @ normal)[:, None, None] / (pixel_rays(cameras) @ normal)
    return np.asarray(ahead)


def painted(
    cameras: Cameras,
    depth: Float[np.ndarray, "f h w"],
    point: Float[np.ndarray, "3"],
    *,
    unit: float,
    turn: Float[np.ndarray, "3 3"] = UPRIGHT,
) -> Float[np.ndarray, "f h w 3"]:
    """Colours of a plane's painting in [0.1, 0.7], as views see it; the painting moves and turns with it.

    Args:
        cameras: the views.
        depth: of the plane in them.
        point: of the plane, where the painting begins.
        unit: of length in the painting.
        turn: of the world.
    """
    K = cameras.K[0]
    columns, rows = np.meshgrid(np.arange(cameras.width) + 0.5, np.arange(cameras.height) + 0.5)
    local = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones_like(rows)], -1)
    world = np.einsum("fij,hwj->fhwi", cameras.world_from_camera[:, :3, :3], local) * depth[..., None]
    on_plane = (world + (cameras.centers - point)[:, None, None]) @ turn / unit
    return np.asarray(0.4 + 0.3 * np.sin(4 * on_plane + np.array([0.0, 1.0, 2.0])))


def plane_recording(
    frames: int,
    *,
    unit: float = PLANE_UNIT_MM,
    offset_mm: float = 0.0,
    turn: Float[np.ndarray, "3 3"] = UPRIGHT,
    size: tuple[int, int] = (32, 24),
    kind: str = "",
    gains: Float[np.ndarray, "f"] | None = None,
    grain: float = 1.0,
) -> EndoscopicSequence:
    """A recording of a painted plane, or of images of one kind with the depth of a plane.

    Args:
        frames: all of them for training.
        unit: as `plane_views`.
        offset_mm: as `plane_views`.
        turn: as `plane_views`.
        size: width and height of a frame, in pixels.
        kind: of the images (`image`); empty for the painting.
        gains: exposure of each frame; None is 1.
        grain: how coarse the painting is.
    """
    width, height = size
    cameras, depth, _, point = plane_views(frames, width, height, unit=unit, offset_mm=offset_mm, turn=turn)
    if kind:
        rgb = image(kind, frames, height, width, 3).numpy()
    else:
        rgb = painted(cameras, depth, point, unit=grain * unit, turn=turn)
    if gains is not None:
        rgb = (gains[:, None, None, None] * rgb).clip(0, 1)
    return EndoscopicSequence(
        name="stress/plane",
        rgb=np.rint(255 * rgb).astype(np.uint8),
        K=cameras.K,
        mask=np.ones(depth.shape, dtype=bool),
        split=Split("stress", np.arange(frames), np.arange(0)),
        world_from_camera=cameras.world_from_camera,
        depth_mm=depth,
    )


def slow(values: Iterator[int], upper: int) -> Iterator[int]:
    """Those up to a bound: what a short run leaves out."""
    return (value for value in values if value <= upper)
