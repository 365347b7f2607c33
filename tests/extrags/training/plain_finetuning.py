"""A plain float64 version of the loss of fine-tuning, and the scene it is tried on.

It shares nothing with the library but the rasteriser: its reference, in float64, has tests of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
import torch
from jaxtyping import UInt8
from torch import Tensor

from extrags.config import CoarseConfig, FinetuneConfig
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.pseudo_views import PseudoViews
from extrags.raster import native, rasterize
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training import finetuning
from extrags.training.density import DensityStrategy
from extrags.training.finetuning import finetune
from extrags.training.optimise import TrainingResult
from extrags.training.schedule import Schedule
from extrags.training.step import AutogradStep, NativeStep
from extrags.training.views import View
from tests.extrags.training.conftest import HEIGHT, WIDTH, tube_cameras, tube_gaussians, tube_light

N_GAUSSIANS = 250
PARAMETERS = ("means", "quats", "scales", "opacities", "sh0", "shN")
# The loss is a sum of ten thousand terms, gradients sums of hundreds of cancelling ones.
LOSS_TOLERANCE = 20 * torch.finfo(torch.float32).eps
GRADIENT_TOLERANCE = 400 * torch.finfo(torch.float32).eps
FORMS = ("weighted_mean", "weighted_sum", "paper")
PAPER = FinetuneConfig(
    iterations=40,
    loss="paper",
    dssim_weight=2 / 3,
    photometric_weight=3.0,
    depth_weight=0.0,
    pseudo_weight=1.0,
    confidence_floor=0.0,
    keep_known=False,
    pseudo_depth=False,
    seed_holes=False,
)


def coarse_scene() -> Scene:
    """The tube, shaken: no gradient is zero, no two colours are equal."""
    generator = torch.Generator().manual_seed(4)
    tube = tube_gaussians(N_GAUSSIANS)

    def noise(value: Tensor, size: float) -> Tensor:
        return value + size * torch.randn(value.shape, generator=generator)

    shaken = Gaussians(
        means=noise(tube.means, 0.1),
        quats=noise(tube.quats, 0.05),
        scales=noise(tube.scales + math.log(2), 0.1),
        opacities=noise(tube.opacities, 0.5),
        sh0=noise(tube.sh0, 0.05),
        shN=noise(torch.zeros(N_GAUSSIANS, 3, 3), 0.05),
    )
    exposure = 0.1 * torch.randn(4, generator=generator)
    light = replace(
        tube_light(),
        log_exposure=exposure,
        spread=torch.tensor(0.4),
        cosine=torch.tensor(0.6),
        log_shoulder=torch.tensor(-0.5),
    )
    return Scene(shaken, light)


def pseudo_views(scene: Scene) -> PseudoViews:
    """Three virtual views whose images, weights and depth are all different from each other."""
    generator = np.random.default_rng(7)
    cameras = tube_cameras(9)[np.array([6, 7, 8])]
    with torch.no_grad():
        rendering = scene.render(cameras)
    shape = (3, HEIGHT, WIDTH)
    rendered = rendering.rgb.clamp(0, 1).numpy()
    restored = (rendered + generator.normal(0, 0.15, rendered.shape)).clip(0, 1).astype(np.float32)
    uncertainty = generator.uniform(0, 1, shape).astype(np.float32)
    mixed = uncertainty[..., None] * restored + (1 - uncertainty[..., None]) * rendered
    depth = rendering.depth.numpy() * generator.uniform(0.8, 1.2, shape).astype(np.float32)
    depth[:, :4] = 0
    confidence = generator.uniform(0, 0.9, shape).astype(np.float32)
    confidence[:, :, :10] = 0
    confidence[:, 20:24] = 1.7
    return PseudoViews(
        cameras=cameras,
        rendered=rendered,
        restored=restored,
        target=mixed,
        alpha=rendering.alpha.numpy(),
        depth_mm=depth,
        uncertainty=uncertainty,
        pixel_confidence=confidence,
        image_confidence=np.array([0.3, 0.0, 0.8], dtype=np.float32),
        reference=np.zeros(3, dtype=np.int64),
        clip=np.zeros(3, dtype=np.int64),
    )


def masked(sequence: EndoscopicSequence) -> EndoscopicSequence:
    """The tube's frames with a mask, a highlight, red that is saturated, and pixels without depth."""
    mask, depth = sequence.mask.copy(), np.array(sequence.depth_mm)
    mask[:, :, -6:] = False
    rgb = sequence.rgb.copy()
    rgb[:, 10:13, 10:20] = 255
    rgb[:, 20:26, 12:30, 0] = 252
    depth[:, -5:] = 0
    return replace(sequence, rgb=rgb, mask=mask, depth_mm=depth)


@dataclass(frozen=True)
class Run:
    """What `finetune` hands to the optimisation."""

    start: Scene
    draw: Callable[[int], View]
    schedule: Schedule


def prepared(
    scene: Scene,
    sequence: EndoscopicSequence,
    pseudo: PseudoViews | None,
    config: FinetuneConfig,
    coarse: CoarseConfig,
) -> Run:
    """`finetune` up to its first step."""
    runs: list[Run] = []

    def taken(start: Scene, draw: Callable[[int], View], schedule: Schedule, **_: Any) -> TrainingResult:
        runs.append(Run(start, draw, schedule))
        return TrainingResult(start, [])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finetuning, "optimise", taken)
        finetune(scene, sequence, pseudo, config, coarse)
    return runs[0]


@dataclass(frozen=True)
class Plain:
    """The loss term by term, in plain float64; its fields are what mutations turn wrong."""

    l1: float = 1.0
    dssim: float = 1.0
    depth: float = 1.0
    image_confidence: Callable[[float], float] = field(default=lambda u: u)
    pixel_confidence: Callable[[Tensor], Tensor] = field(default=lambda u: u)
    ssim_confidence: Callable[[Tensor], Tensor] = field(default=lambda s: s)
    normalisation: Callable[[float], float] = field(default=lambda z: z)
    unknown_above: float = 0.5
    inverse: bool = True
    swap_lambda: bool = False
    beyond_mask: float = 0.0
    white: float = 1.0

    def photometric(
        self, image: Tensor, target: Tensor, weight: Tensor, ssim_weight: Tensor, z: float, lam: float
    ) -> Tensor:
        lam = 1 - lam if self.swap_lambda else lam
        l1 = (image - target).abs().sum(-1)
        dssim = ((1 - plain_ssim(image, target)) / 2).sum(-1)
        terms = self.l1 * (1 - lam) * weight * l1 + self.dssim * lam * ssim_weight * dssim
        return terms.sum() / (3 * self.normalisation(z))

    def inverse_depth(self, depth: Tensor, alpha: Tensor, target: Tensor, scale: float) -> Tensor:
        valid = (target > 0) & (alpha > 0.5) & (depth > 1e-3 * scale)
        if not bool(valid.any()):
            return torch.zeros((), dtype=torch.float64)
        found, known = depth[valid], target[valid]
        difference = scale / found - scale / known if self.inverse else (found - known) / scale
        return self.depth * difference.abs().mean()

    def virtual(
        self, images: Images, pseudo: PseudoViews, index: int, config: FinetuneConfig, coarse: CoarseConfig,
        schedule: Schedule, iteration: int,
    ) -> Tensor:  # fmt: skip
        target = double((pseudo.target if config.keep_known else pseudo.restored)[index])
        u_pixel = self.pixel_confidence(
            double(pseudo.pixel_confidence[index]).clamp_min(config.confidence_floor)
        )
        everywhere = torch.ones_like(u_pixel)
        s = self.ssim_confidence(everywhere if config.loss == "paper" else u_pixel)
        z = float(u_pixel.sum()) if config.loss == "weighted_mean" else float(HEIGHT * WIDTH)
        lam = coarse.dssim_weight if config.dssim_weight is None else config.dssim_weight
        loss = config.photometric_weight * self.photometric(images.rgb, target, u_pixel, s, z, lam)
        if config.pseudo_depth:
            unknown = double(pseudo.uncertainty[index]) > self.unknown_above
            depth = torch.where(unknown, double(pseudo.depth_mm[index]), torch.zeros(()).double())
            weight = plain_depth_weight(config, coarse, iteration)
            loss = loss + weight * self.inverse_depth(images.depth, images.alpha, depth, schedule.depth_scale)
        return config.pseudo_weight * self.image_confidence(float(pseudo.image_confidence[index])) * loss

    def real(
        self, images: Images, light: NearFieldLight, sequence: EndoscopicSequence, position: int,
        config: FinetuneConfig, coarse: CoarseConfig, schedule: Schedule, iteration: int,
    ) -> Tensor:  # fmt: skip
        frame = int(sequence.train[position])
        assert sequence.depth_mm is not None
        valid = double(sequence.mask[frame] & (sequence.rgb[frame] < 250).any(-1))
        shown, rgb = no_brighter_than_white(images.rgb, sequence.rgb[frame], self.white)
        lam = coarse.dssim_weight if config.dssim_weight is None else config.dssim_weight
        # Beyond the mask as beyond the edge of the image: black, in windows of SSIM too.
        seen = double(np.where(sequence.mask[frame], 1, self.beyond_mask))[..., None]
        loss = config.photometric_weight * self.photometric(
            seen * shown, seen * rgb, valid, valid, float(valid.sum()), lam
        )
        depth = double(np.where(sequence.mask[frame], sequence.depth_mm[frame], 0))
        weight = plain_depth_weight(config, coarse, iteration)
        loss = loss + weight * self.inverse_depth(images.depth, images.alpha, depth, schedule.depth_scale)
        return loss + coarse.light.exposure_prior * light.log_exposure.square().mean()


def no_brighter_than_white(
    rendered: Tensor, frame: UInt8[np.ndarray, "h w 3"], white: float = 1.0
) -> tuple[Tensor, Tensor]:
    """A rendering and a frame: a saturated channel is white, and so is what is rendered brighter."""
    saturated = torch.from_numpy(frame >= 250)
    shown = torch.where(saturated, rendered.clamp(max=white), rendered)
    return shown, torch.where(saturated, 1.0, double(frame / np.float32(255)))


@dataclass(frozen=True)
class Images:
    """One rendered view in float64."""

    rgb: Tensor
    alpha: Tensor
    depth: Tensor


def plain_depth_weight(config: FinetuneConfig, coarse: CoarseConfig, iteration: int) -> float:
    weight = coarse.depth_weight if config.depth_weight is None else config.depth_weight
    return weight * float(coarse.depth_weight_final_share ** (iteration / config.iterations))


def plain_ssim(x: Tensor, y: Tensor) -> Tensor:
    """SSIM per pixel and channel: the 121 pixels of the window one after the other."""
    tap = [math.exp(-(k * k) / (2 * 1.5**2)) for k in range(-5, 6)]
    total = sum(tap)

    def mean(z: Tensor) -> Tensor:
        found = torch.zeros_like(z)
        for i in range(-5, 6):
            for j in range(-5, 6):
                shifted = torch.zeros_like(z)
                to_rows, from_rows = slices(HEIGHT, i)
                to_columns, from_columns = slices(WIDTH, j)
                shifted[to_rows, to_columns] = z[from_rows, from_columns]
                found = found + tap[i + 5] * tap[j + 5] / total**2 * shifted
        return found

    mx, my = mean(x), mean(y)
    vx, vy, vxy = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return (2 * mx * my + c1) * (2 * vxy + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))


def slices(size: int, shift: int) -> tuple[slice, slice]:
    return slice(max(0, -shift), size - max(0, shift)), slice(max(0, shift), size + min(0, shift))


def double(values: Any) -> Tensor:
    return torch.from_numpy(np.asarray(values, dtype=np.float64))


class Expected:
    """The float64 scene of one step; of each (mutated) plain loss its value and gradients."""

    def __init__(self, scene: Scene, view: View, sh_degree: int) -> None:
        assert scene.light is not None
        values = scene.gaussians.parameters()
        self.leaves = {name: value.detach().double().requires_grad_() for name, value in values.items()}
        common = {name: value.detach().double() for name, value in scene.light.parameters().items()}
        self.light = NearFieldLight(**common, reference_distance=scene.light.reference_distance)
        self.exposure = torch.ones((), dtype=torch.float64)
        if view.frame is not None:
            self.exposure = (self.light.log_exposure[view.frame] - self.light.log_exposure.mean()).exp()
        self.camera, self.sh_degree = view.camera, sh_degree
        rendering = self.rendered(self.leaves)
        self.detached = replace(rendering, rgb=rendering.rgb.detach(), depth=rendering.depth.detach())
        self._rendering = rendering

    def rendered(self, leaves: dict[str, Tensor]) -> Images:
        found = rasterize(
            leaves["means"],
            leaves["quats"],
            leaves["scales"].exp(),
            leaves["opacities"].sigmoid(),
            torch.cat([leaves["sh0"], leaves["shN"]], dim=1),
            torch.from_numpy(self.camera.viewmats.astype(np.float32)).double(),
            torch.from_numpy(self.camera.K.astype(np.float32)).double(),
            WIDTH,
            HEIGHT,
            sh_degree=self.sh_degree,
            light=self.light.camera_light(self.exposure[None]),
            backend="reference",
        )
        return Images(found.rgb[0], found.alpha[0], found.depth[0])

    def of(self, loss: Callable[[Images], Tensor]) -> tuple[float, dict[str, Tensor]]:
        images = self._rendering
        value = loss(images)
        found = torch.autograd.grad(value, list(self.leaves.values()), retain_graph=True, allow_unused=True)
        gradients = {
            name: torch.zeros_like(leaf) if g is None else g
            for (name, leaf), g in zip(self.leaves.items(), found, strict=True)
        }
        return float(value.detach()), gradients


@dataclass(frozen=True)
class Found:
    """Value and gradients of the library's step."""

    loss: float
    gradients: dict[str, Tensor]

    def error(self, expected: tuple[float, dict[str, Tensor]]) -> tuple[float, float]:
        """Relative errors of the loss and of the worst gradient."""
        loss, gradients = expected
        worst = max(
            float((self.gradients[name].double() - g).norm() / g.norm().clamp_min(1e-30))
            for name, g in gradients.items()
        )
        return abs(self.loss - loss) / max(abs(loss), 1e-30), worst

    def equals(self, expected: tuple[float, dict[str, Tensor]]) -> bool:
        loss, gradient = self.error(expected)
        return loss < LOSS_TOLERANCE and gradient < GRADIENT_TOLERANCE


MakeStep = type[NativeStep] | type[AutogradStep]
STEPS = [
    pytest.param(
        NativeStep, marks=pytest.mark.skipif(native.native_isa() is None, reason="the kernels are not built")
    ),
    AutogradStep,
]


def stepped(make_step: MakeStep, run: Run, view: View, iteration: int) -> Found:
    step = make_step(run.start, run.schedule)
    loss = step.differentiate(view, iteration, DensityStrategy()).loss
    if isinstance(step, NativeStep):
        assert step.direct is not None
        gradients = {name: value.clone() for name, value in step.direct.gradients.items()}
        sh = gradients.pop("sh")
        return Found(loss, {**gradients, "sh0": sh[:, :1], "shN": sh[:, 1:]})
    own = {name: value.grad for name, value in step.adam.parameters.items()}
    return Found(loss, {name: value for name, value in own.items() if value is not None})


def virtual_index(view: View, pseudo: PseudoViews) -> int:
    """Which virtual view was drawn, by its pose."""
    poses = pseudo.cameras.world_from_camera
    (index,) = [i for i in range(len(pseudo)) if np.array_equal(view.camera.world_from_camera[0], poses[i])]
    return int(index)


def config_of(form: str, **changes: Any) -> FinetuneConfig:
    values: dict[str, Any] = {
        "iterations": 40, "loss": form, "photometric_weight": 1.3, "seed_holes": False, "seed": 2
    }  # fmt: skip
    return FinetuneConfig(**{**values, **changes})


COARSE = CoarseConfig(sh_degree=1, dssim_weight=0.3, depth_weight=0.25, depth_weight_final_share=0.2)


def drawn(run: Run, config: FinetuneConfig, *, virtual: bool) -> tuple[View, int]:
    """The last view of a kind that `finetune` draws, and its iteration."""
    views = [run.draw(iteration) for iteration in range(config.iterations)]
    kind = [iteration for iteration, view in enumerate(views) if (view.frame is None) == virtual]
    return views[kind[-1]], kind[-1]


def plain_loss(
    plain: Plain, view: View, iteration: int, run: Run, expected: Expected, sequence: EndoscopicSequence,
    pseudo: PseudoViews, config: FinetuneConfig, coarse: CoarseConfig = COARSE,
) -> tuple[float, dict[str, Tensor]]:  # fmt: skip
    if view.frame is None:
        index = virtual_index(view, pseudo)
        return expected.of(
            lambda images: plain.virtual(images, pseudo, index, config, coarse, run.schedule, iteration)
        )
    frame = view.frame
    return expected.of(
        lambda images: plain.real(
            images, expected.light, sequence, frame, config, coarse, run.schedule, iteration
        )
    )
