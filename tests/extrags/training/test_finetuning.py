"""Fine-tuning against a plain float64 version of its loss, written here and sharing nothing with the library.

Only the rasteriser is the library's: its reference, in float64, has tests of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from torch import Tensor

from extrags.config import CoarseConfig, DensifyConfig, FinetuneConfig
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.pseudo_views import PseudoViews
from extrags.raster import native, rasterize
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training import finetuning
from extrags.training.density import DensityStrategy
from extrags.training.finetuning import finetune, hole_gaussians, virtual_steps, virtual_views
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


@pytest.fixture(scope="module")
def scene() -> Scene:
    return coarse_scene()


@pytest.fixture(scope="module")
def pseudo(scene: Scene) -> PseudoViews:
    return pseudo_views(scene)


@pytest.fixture(scope="module")
def sequence(tube_sequence: EndoscopicSequence) -> EndoscopicSequence:
    """The tube's frames with a mask, a highlight and pixels without depth."""
    mask, depth = tube_sequence.mask.copy(), np.array(tube_sequence.depth_mm)
    mask[:, :, -6:] = False
    rgb = tube_sequence.rgb.copy()
    rgb[:, 10:13, 10:20] = 255
    depth[:, -5:] = 0
    return replace(tube_sequence, rgb=rgb, mask=mask, depth_mm=depth)


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
        rgb = double(sequence.rgb[frame] / np.float32(255))
        valid = double(sequence.mask[frame] & (sequence.rgb[frame] < 250).all(-1))
        lam = coarse.dssim_weight if config.dssim_weight is None else config.dssim_weight
        loss = config.photometric_weight * self.photometric(
            images.rgb, rgb, valid, valid, float(valid.sum()), lam
        )
        depth = double(np.where(sequence.mask[frame], sequence.depth_mm[frame], 0))
        weight = plain_depth_weight(config, coarse, iteration)
        loss = loss + weight * self.inverse_depth(images.depth, images.alpha, depth, schedule.depth_scale)
        return loss + coarse.light.exposure_prior * light.log_exposure.square().mean()


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


class TestLoss:
    @pytest.mark.parametrize("make_step", STEPS)
    @pytest.mark.parametrize("virtual", [True, False])
    @pytest.mark.parametrize(
        "config",
        [*(config_of(form) for form in FORMS), config_of("paper", dssim_weight=0.6, depth_weight=0.1), PAPER],
        ids=[*FORMS, "own weights", "as published"],
    )
    def test_equals_the_plain_version(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews, config: FinetuneConfig,
        virtual: bool, make_step: MakeStep,
    ) -> None:  # fmt: skip
        run = prepared(scene, sequence, pseudo, config, COARSE)
        view, iteration = drawn(run, config, virtual=virtual)
        expected = Expected(run.start, view, 1)
        found = stepped(make_step, run, view, iteration)
        plain = plain_loss(Plain(), view, iteration, run, expected, sequence, pseudo, config)
        loss, gradient = found.error(plain)
        assert loss < LOSS_TOLERANCE
        assert gradient < GRADIENT_TOLERANCE

    def test_the_papers_equations_by_their_terms(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews
    ) -> None:
        """[ExtraGS, eq. 24 and 25] with the published code's D-SSIM = 1 - SSIM, as they stand there."""
        run = prepared(scene, sequence, pseudo, PAPER, COARSE)
        view, iteration = drawn(run, PAPER, virtual=True)
        index = virtual_index(view, pseudo)
        images, u_pixel = Expected(run.start, view, 1).detached, double(pseudo.pixel_confidence[index])
        restored = double(pseudo.restored[index])
        l1 = ((restored - images.rgb).abs() * u_pixel[..., None]).mean()
        dssim = (1 - plain_ssim(restored, images.rgb)).mean()
        eq25 = float(pseudo.image_confidence[index]) * (l1 + dssim)
        assert stepped(AutogradStep, run, view, iteration).loss == pytest.approx(
            float(eq25), rel=LOSS_TOLERANCE
        )
        view, iteration = drawn(run, PAPER, virtual=False)
        expected = Expected(run.start, view, 1)
        assert view.frame is not None
        frame = int(sequence.train[view.frame])
        truth = double(sequence.rgb[frame] / 255)
        valid = torch.from_numpy(sequence.mask[frame] & (sequence.rgb[frame] < 250).all(-1))
        l1 = (truth - expected.detached.rgb).abs()[valid].mean()
        eq24 = l1 + (1 - plain_ssim(truth, expected.detached.rgb))[valid].mean()
        prior = COARSE.light.exposure_prior * expected.light.log_exposure.square().mean()
        loss = stepped(AutogradStep, run, view, iteration).loss
        assert loss == pytest.approx(float(eq24 + prior), rel=LOSS_TOLERANCE)

    def test_the_plain_gradient_is_that_of_finite_differences(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews
    ) -> None:
        config = config_of("paper")
        run = prepared(scene, sequence, pseudo, config, COARSE)
        view, iteration = drawn(run, config, virtual=True)
        images, index = Expected(run.start, view, 1).detached, virtual_index(view, pseudo)

        def loss(rgb: Tensor, depth: Tensor) -> Tensor:
            shown = Images(rgb, images.alpha, depth)
            return Plain().virtual(shown, pseudo, index, config, COARSE, run.schedule, iteration)

        generator = torch.Generator().manual_seed(1)
        at = images.rgb, images.depth
        directions = [torch.randn(x.shape, generator=generator, dtype=torch.float64) for x in at]
        step = torch.finfo(torch.float64).eps ** (1 / 3)
        for which, direction in enumerate(directions):
            leaves = [x.clone().requires_grad_() for x in at]
            loss(*leaves).backward()
            gradient = leaves[which].grad
            assert gradient is not None
            moved = [
                [x + sign * step * direction if i == which else x for i, x in enumerate(at)]
                for sign in (1, -1)
            ]
            slope = float(loss(*moved[0]) - loss(*moved[1])) / (2 * step)
            assert slope == pytest.approx(float((gradient * direction).sum()), rel=1e-6)


VIRTUAL_MUTATIONS = {
    "l1 sign": Plain(l1=-1),
    "l1 dropped": Plain(l1=0),
    "D-SSIM sign": Plain(dssim=-1),
    "D-SSIM dropped": Plain(dssim=0),
    "1 - SSIM without the half": Plain(dssim=2),
    "lambda on the wrong term": Plain(swap_lambda=True),
    "depth sign": Plain(depth=-1),
    "depth dropped": Plain(depth=0),
    "depth instead of its inverse": Plain(inverse=False),
    "depth everywhere": Plain(unknown_above=-1.0),
    "U_img squared": Plain(image_confidence=lambda u: u * u),
    "U_img dropped": Plain(image_confidence=lambda u: 1.0),
    "1 - U_img": Plain(image_confidence=lambda u: 1 - u),
    "U_pixel dropped": Plain(pixel_confidence=torch.ones_like),
    "1 - U_pixel": Plain(pixel_confidence=lambda u: (1 - u).abs()),
    "U_pixel squared": Plain(pixel_confidence=lambda u: u * u),
    "U_pixel clipped at one": Plain(pixel_confidence=lambda u: u.clamp_max(1)),
    "per pixel, not per value": Plain(normalisation=lambda z: z / 3),
}
OF_ONE_FORM = {
    "weighted_mean": {
        "SSIM unweighted": Plain(ssim_confidence=torch.ones_like),
        "over all pixels": Plain(normalisation=lambda z: HEIGHT * WIDTH),
    },
    "weighted_sum": {
        "SSIM unweighted": Plain(ssim_confidence=torch.ones_like),
        "U_pixel doubled": Plain(pixel_confidence=lambda u: 2 * u),
        "over fewer pixels": Plain(normalisation=lambda z: z / 2),
    },
    "paper": {
        "SSIM weighted": Plain(ssim_confidence=lambda s: s / 2),
        "U_pixel doubled": Plain(pixel_confidence=lambda u: 2 * u),
        "over fewer pixels": Plain(normalisation=lambda z: z / 2),
    },
}
REAL_MUTATIONS = {
    name: VIRTUAL_MUTATIONS[name]
    for name in (
        "l1 sign", "l1 dropped", "D-SSIM sign", "D-SSIM dropped", "1 - SSIM without the half",
        "lambda on the wrong term", "depth sign", "depth dropped", "depth instead of its inverse",
        "per pixel, not per value",
    )
}  # fmt: skip


class TestMutations:
    """Each sign and term turned wrong: a comparison that does not notice would be worth nothing."""

    def _caught(
        self, mutations: dict[str, Plain], scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews,
        form: str, *, virtual: bool,
    ) -> None:  # fmt: skip
        config = config_of(form)
        run = prepared(scene, sequence, pseudo, config, COARSE)
        view, iteration = drawn(run, config, virtual=virtual)
        expected = Expected(run.start, view, 1)
        found = stepped(AutogradStep, run, view, iteration)

        def equal(plain: Plain) -> bool:
            return found.equals(plain_loss(plain, view, iteration, run, expected, sequence, pseudo, config))

        assert equal(Plain())
        missed = [name for name, wrong in mutations.items() if equal(wrong)]
        assert missed == []

    @pytest.mark.parametrize("form", FORMS)
    def test_virtual(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews, form: str
    ) -> None:
        mutations = VIRTUAL_MUTATIONS | OF_ONE_FORM[form]
        self._caught(mutations, scene, sequence, pseudo, form, virtual=True)

    def test_real(self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews) -> None:
        self._caught(REAL_MUTATIONS, scene, sequence, pseudo, "paper", virtual=False)


class TestConfidences:
    def _gradients(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews, config: FinetuneConfig
    ) -> Found:
        run = prepared(scene, sequence, pseudo, config, COARSE)
        view, iteration = drawn(run, config, virtual=True)
        return stepped(AutogradStep, run, view, iteration)

    @pytest.mark.parametrize("form", FORMS)
    def test_twice_the_image_confidence_is_twice_the_gradient(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews, form: str
    ) -> None:
        doubled = replace(pseudo, image_confidence=2 * pseudo.image_confidence)
        one, two = (self._gradients(scene, sequence, p, config_of(form)) for p in (pseudo, doubled))
        assert two.loss == pytest.approx(2 * one.loss, rel=LOSS_TOLERANCE)
        for name in PARAMETERS:
            torch.testing.assert_close(two.gradients[name], 2 * one.gradients[name])

    @pytest.mark.parametrize(("form", "ratio"), [("weighted_mean", 1), ("weighted_sum", 2)])
    def test_what_twice_the_pixel_confidence_is(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews, form: str, ratio: int
    ) -> None:
        config = config_of(form, confidence_floor=0, pseudo_depth=False)
        doubled = replace(pseudo, pixel_confidence=2 * pseudo.pixel_confidence)
        one, two = (self._gradients(scene, sequence, p, config) for p in (pseudo, doubled))
        assert two.loss == pytest.approx(ratio * one.loss, rel=LOSS_TOLERANCE)
        for name in PARAMETERS:
            torch.testing.assert_close(two.gradients[name], ratio * one.gradients[name])

    def test_in_the_papers_form_it_doubles_l1_alone(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews
    ) -> None:
        def found(factor: float, dssim_weight: float) -> Found:
            config = PAPER.model_copy(update={"dssim_weight": dssim_weight})
            scaled = replace(pseudo, pixel_confidence=factor * pseudo.pixel_confidence)
            return self._gradients(scene, sequence, scaled, config)

        l1, l1_doubled, dssim, dssim_doubled = found(1, 0.0), found(2, 0.0), found(1, 1.0), found(2, 1.0)
        assert l1_doubled.loss == pytest.approx(2 * l1.loss, rel=LOSS_TOLERANCE)
        assert dssim_doubled.loss == dssim.loss
        for name in PARAMETERS:
            torch.testing.assert_close(l1_doubled.gradients[name], 2 * l1.gradients[name])
            assert torch.equal(dssim_doubled.gradients[name], dssim.gradients[name])

    @pytest.mark.parametrize("form", FORMS)
    def test_views_without_weight_are_left_out(self, pseudo: PseudoViews, form: str) -> None:
        views = virtual_views(pseudo, config_of(form))
        assert [virtual_index(view, pseudo) for view in views] == [0, 2]
        none = replace(pseudo, image_confidence=np.zeros(3, dtype=np.float32))
        assert virtual_views(none, config_of(form)) == []

    def test_the_floor_may_be_zero(self, pseudo: PseudoViews) -> None:
        floors = [0.0, 0.1]
        found = [virtual_views(pseudo, config_of("paper", confidence_floor=f))[0].weight for f in floors]
        assert [float(weight.min()) for weight in found] == pytest.approx(floors)

    def test_restored_depth_supervises_unknown_pixels_alone(self, pseudo: PseudoViews) -> None:
        for view, index in zip(virtual_views(pseudo, config_of("paper")), (0, 2), strict=True):
            assert view.depth_mm is not None
            unknown = pseudo.uncertainty[index] > 0.5
            assert not view.depth_mm.numpy()[~unknown].any()
            assert np.array_equal(view.depth_mm.numpy()[unknown], pseudo.depth_mm[index][unknown])
        alone = virtual_views(pseudo, config_of("paper", pseudo_depth=False))
        assert all(view.depth_mm is None for view in alone)

    def test_targets(self, pseudo: PseudoViews) -> None:
        for keep_known, images in ((True, pseudo.target), (False, pseudo.restored)):
            view = virtual_views(pseudo, config_of("paper", keep_known=keep_known))[1]
            assert np.array_equal(view.rgb.numpy(), images[2])


class TestSteps:
    @given(
        iterations=st.integers(1, 400),
        first=st.floats(0, 0.99),
        last=st.floats(0, 0.99),
    )
    def test_pattern(self, iterations: int, first: float, last: float) -> None:
        config = FinetuneConfig(iterations=iterations, pseudo_share=first, pseudo_share_final=last)
        pattern = virtual_steps(config)
        assert pattern.shape == (iterations,)
        wanted = [
            first + (last - first) * (i / (iterations - 1) if iterations > 1 else 0)
            for i in range(iterations)
        ]
        # Evenly spread: after every step as many virtual ones as their shares add up to, rounded down.
        behind = np.cumsum(wanted) - np.cumsum(pattern)
        rounding = 1e-9
        assert behind.min() >= -rounding
        assert behind.max() < 1 + rounding

    def test_the_share_falls(self) -> None:
        config = FinetuneConfig(iterations=1000, pseudo_share=0.8, pseudo_share_final=0.1)
        quarters = virtual_steps(config).reshape(4, 250).sum(1)
        assert quarters.tolist() == pytest.approx([178, 134, 91, 47], abs=1)

    def test_none_without_virtual_views(self) -> None:
        assert not virtual_steps(FinetuneConfig(iterations=50), any_virtual=False).any()

    def test_every_view_is_drawn_in_turn(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews
    ) -> None:
        config = config_of("paper", pseudo_share=0.5, pseudo_share_final=0.5)
        run = prepared(scene, sequence, pseudo, config, COARSE)
        views = [run.draw(iteration) for iteration in range(config.iterations)]
        assert [view.frame is None for view in views] == virtual_steps(config).tolist()
        virtual = [virtual_index(view, pseudo) for view in views if view.frame is None]
        assert [virtual.count(index) for index in range(3)] == [10, 0, 10]
        real = [view.frame for view in views if view.frame is not None]
        assert [real.count(position) for position in range(4)] == [5, 5, 5, 5]


class TestGrowth:
    def test_a_scene_at_the_coarse_cap_can_grow(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews
    ) -> None:
        densify = DensifyConfig(every=10, gradient_threshold=1e-6, max_gaussians=N_GAUSSIANS)
        coarse = COARSE.model_copy(update={"densify": densify})
        for growth in (1.0, 1.2, 2.0):
            config = config_of("paper", growth=growth, densify_share=1.0)
            grown = len(finetune(scene, sequence, pseudo, config, coarse).scene.gaussians)
            assert grown <= growth * N_GAUSSIANS
            assert (grown > N_GAUSSIANS) == (growth > 1)

    def test_seeds_and_densification_share_one_limit(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews
    ) -> None:
        densify = DensifyConfig(every=10, gradient_threshold=1e-6, max_gaussians=N_GAUSSIANS)
        coarse = COARSE.model_copy(update={"densify": densify})
        holes = replace(pseudo, alpha=np.zeros_like(pseudo.alpha))
        config = config_of("paper", growth=1.3, densify_share=1.0, seed_holes=True)
        seeded = len(prepared(scene, sequence, holes, config, coarse).start.gaussians)
        assert N_GAUSSIANS < seeded <= round(1.3 * N_GAUSSIANS)
        assert len(finetune(scene, sequence, holes, config, coarse).scene.gaussians) <= round(
            1.3 * N_GAUSSIANS
        )

    def test_the_coarse_scene_is_left_alone(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews
    ) -> None:
        before = scene.detached()
        result = finetune(scene, sequence, pseudo, config_of("paper"), COARSE)
        for name, value in before.gaussians.parameters().items():
            assert torch.equal(scene.gaussians.parameters()[name], value), name
        assert not torch.equal(result.scene.gaussians.means[:N_GAUSSIANS], scene.gaussians.means)


def wall_scene(light: NearFieldLight | None) -> Scene:
    """Gaussians so close together that no two hole points share a cell of their spacing."""
    points = np.random.default_rng(1).normal(0, 1e-3, (50, 3)) - 50.0
    return Scene(Gaussians.from_points(points, np.full((50, 3), 0.5), np.full(50, 1e-3)), light)


def wall_views(pseudo: PseudoViews, depth_mm: np.ndarray, holes: np.ndarray) -> PseudoViews:
    return replace(
        pseudo,
        depth_mm=depth_mm.astype(np.float32),
        alpha=np.where(holes, 0.1, 0.9).astype(np.float32),
    )


@pytest.fixture
def holes() -> np.ndarray:
    found = np.zeros((3, HEIGHT, WIDTH), dtype=bool)
    found[0, 3:30, 5:41] = True
    found[2, 10:20, 20:30] = True
    return found


def projected(points: np.ndarray, camera: Any, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates and z-depth, with the pinhole model written out."""
    pose = camera.world_from_camera[index]
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    K = camera.K[index]
    z = local[:, 2]
    pixels = np.stack([K[0, 0] * local[:, 0] / z + K[0, 2], K[1, 1] * local[:, 1] / z + K[1, 2]], axis=1)
    return pixels, z


@pytest.fixture
def real_views_carve_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the rule on virtual views, which has a test of its own."""
    monkeypatch.setattr(
        finetuning, "_in_front_of_virtual_surface", lambda points, _: np.zeros(len(points), dtype=bool)
    )


class TestHoleGaussians:
    ROOM = 10_000

    @pytest.mark.usefixtures("real_views_carve_alone")
    def test_lie_at_the_restored_depth_along_their_rays(
        self, sequence: EndoscopicSequence, pseudo: PseudoViews, holes: np.ndarray
    ) -> None:
        # Nothing real was seen: nothing carves.
        blind = replace(sequence, mask=np.zeros_like(sequence.mask))
        depth = np.random.default_rng(0).uniform(5, 40, holes.shape)
        depth[0, 4:8] = 0
        views = wall_views(pseudo, depth, holes)
        new = hole_gaussians(wall_scene(None), blind, views, self.ROOM)
        assert new is not None
        means = new.means.double().numpy()
        on_grid = np.zeros_like(holes)
        on_grid[:, ::2, ::2] = True
        wanted = {tuple(x) for x in np.argwhere(holes & on_grid & (depth > 0)).tolist()}
        got = set()
        for index in range(3):
            pixels, z = projected(means, views.cameras, index)
            column, row = np.floor(pixels).astype(int).T
            inside = (z > 0) & (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
            for i in np.flatnonzero(inside):
                centred = np.abs(pixels[i] - np.floor(pixels[i]) - 0.5).max() < 1e-3
                if centred and abs(z[i] / views.depth_mm[index, row[i], column[i]] - 1) < 1e-5:
                    got.add((index, row[i], column[i]))
        assert got == wanted
        assert len(new) == len(wanted)

    @pytest.mark.usefixtures("real_views_carve_alone")
    def test_none_in_front_of_a_real_surface(
        self, sequence: EndoscopicSequence, pseudo: PseudoViews, holes: np.ndarray
    ) -> None:
        depth = np.random.default_rng(0).uniform(2, 60, holes.shape)
        views = wall_views(pseudo, depth, holes)
        new = hole_gaussians(wall_scene(None), sequence, views, self.ROOM)
        blind = replace(sequence, mask=np.zeros_like(sequence.mask))
        every = hole_gaussians(wall_scene(None), blind, views, self.ROOM)
        assert new is not None
        assert every is not None
        assert sequence.depth_mm is not None

        def hiding(points: np.ndarray) -> np.ndarray:
            found = np.zeros(len(points), dtype=bool)
            for frame in sequence.train:
                pixels, z = projected(points, sequence.cameras, frame)
                for i, (u, v) in enumerate(pixels):
                    if z[i] > 0 and 0 <= u < WIDTH and 0 <= v < HEIGHT:
                        row, column = int(v), int(u)
                        seen = sequence.depth_mm[frame, row, column] * sequence.mask[frame, row, column]
                        found[i] |= seen > 0 and z[i] < 0.95 * seen
            return found

        assert not hiding(new.means.double().numpy()).any()
        hides = hiding(every.means.double().numpy())
        assert 20 < hides.sum() < len(every) - 20
        assert len(new) == len(every) - hides.sum()

    @pytest.mark.usefixtures("real_views_carve_alone")
    def test_albedo_times_light_is_the_target(
        self, sequence: EndoscopicSequence, pseudo: PseudoViews, holes: np.ndarray
    ) -> None:
        holes[2] = False
        blind = replace(sequence, mask=np.zeros_like(sequence.mask))
        light = replace(
            tube_light(), spread=torch.tensor(0.4), cosine=torch.tensor(0.7), log_shoulder=torch.tensor(-0.3)
        )
        # A slanted plane n x = d before the first camera: normals and depths are known.
        n, d = np.array([0.3, -0.2, 0.9]) / math.sqrt(0.94), 14.0
        K = pseudo.cameras.K[0]
        v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
        rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
        depth = np.repeat((d / (rays @ n))[None], 3, axis=0)
        new = hole_gaussians(
            wall_scene(light), blind, wall_views(pseudo, depth, holes), self.ROOM, thickness=0.1
        )
        assert new is not None
        means = new.means.double().numpy()
        pixels, z = projected(means, pseudo.cameras, 0)
        column, row = np.floor(pixels).astype(int).T
        albedo = 0.28209479177387814 * new.sh0[:, 0].double().numpy() + 0.5
        # The light's formula, in float64, at points in the camera frame
        points = rays[row, column] * z[:, None] / 15.0
        square = (points**2).sum(1)
        c, e, shoulder = math.exp(-2.0), 0.9, math.exp(-0.3)
        facing = ((points @ n) ** 2 / square + 0.04) / 1.04
        axis = np.maximum(points[:, 2] / np.sqrt(square), 0.1)
        gain = ((1 + c) / (square + c)) ** e * axis**0.4 * facing**0.35
        assert gain.min() > finetuning.MIN_GAIN
        signal = albedo * gain[:, None]
        image = (1 + shoulder) * signal / (1 + shoulder * signal)
        tolerance = 100 * np.finfo(np.float32).eps
        np.testing.assert_allclose(image, pseudo.target[0][row, column], rtol=tolerance, atol=tolerance)

    @pytest.mark.usefixtures("real_views_carve_alone")
    @pytest.mark.parametrize("room", [-3, 0, 5, 50, 99, 100, 101, 173, 300])
    def test_at_most_room(self, sequence: EndoscopicSequence, pseudo: PseudoViews, room: int) -> None:
        blind = replace(sequence, mask=np.zeros_like(sequence.mask))
        everywhere = np.ones((3, HEIGHT, WIDTH), dtype=bool)
        views = wall_views(pseudo, np.full((3, HEIGHT, WIDTH), 20.0), everywhere)
        new = hole_gaussians(wall_scene(None), blind, views, room)
        if room <= 0:
            assert new is None
        elif room >= 100:
            assert new is not None
            assert room / 2 < len(new) <= room
        else:
            assert new is None or len(new) <= room

    def test_none_in_front_of_surface_that_a_virtual_view_shows(
        self,
        sequence: EndoscopicSequence,
        pseudo: PseudoViews,
        holes: np.ndarray,
    ) -> None:
        """A guess must hide neither known surface nor what another virtual view completes far behind it."""
        blind = replace(sequence, mask=np.zeros_like(sequence.mask))
        holes[1:] = False
        near = np.full(holes.shape, 6.0)
        every = hole_gaussians(wall_scene(None), blind, wall_views(pseudo, near, holes), self.ROOM)
        assert every is not None
        means = every.means.double().numpy()
        (pixels,), (z,) = pseudo.cameras[1].project(means)
        seen = pseudo.cameras[1].contains(pixels)
        assert 0 < seen.sum() < len(seen)
        nearest, farthest = z[seen].min(), z[seen].max()
        for alpha, uncertainty, shown_mm, hidden in (
            (1.0, 0.0, 1.2 * farthest, True),  # known surface behind the guesses
            (1.0, 1.0, 1.2 * farthest, False),  # solid, but nothing is known of it
            (0.0, 1.0, 1.5 * farthest, True),  # completed far behind
            (0.0, 1.0, 1.2 * nearest, False),  # completed a little behind: they may be the same surface
        ):
            views = wall_views(pseudo, near, holes)
            second = np.full(holes.shape[1:], shown_mm)
            views = replace(views, uncertainty=pseudo.uncertainty.copy())
            views.depth_mm[1], views.alpha[1], views.uncertainty[1] = second, alpha, uncertainty
            found = hole_gaussians(wall_scene(None), blind, views, self.ROOM)
            # The second view may bring points of its own.
            apart = np.inf if found is None else cKDTree(found.means.numpy()).query(every.means.numpy())[0]
            kept = bool(np.all(apart < 1e-3))
            assert kept != hidden, (alpha, uncertainty, shown_mm)

    @pytest.mark.usefixtures("real_views_carve_alone")
    def test_none_far_from_all_known_surface(
        self, sequence: EndoscopicSequence, pseudo: PseudoViews, holes: np.ndarray
    ) -> None:
        blind = replace(sequence, mask=np.zeros_like(sequence.mask))
        scene = Scene(tube_gaussians(N_GAUSSIANS), None)
        depth = np.random.default_rng(0).uniform(2, 300, holes.shape)
        views = wall_views(pseudo, depth, holes)
        every = hole_gaussians(scene, blind, views, self.ROOM)
        new = hole_gaussians(scene, blind, views, self.ROOM, max_distance=6.0)
        assert every is not None
        assert new is not None
        assert 0 < len(new) < len(every)
        apart = torch.cdist(new.means, scene.gaussians.means).min(dim=1).values
        # Points of a cell are averaged, which may move them by its edge.
        assert apart.max() <= 6.0 + finetuning._typical_spacing(scene.gaussians)

    def test_nothing_to_fill(self, sequence: EndoscopicSequence, pseudo: PseudoViews) -> None:
        none = wall_views(pseudo, np.full((3, HEIGHT, WIDTH), 20.0), np.zeros((3, HEIGHT, WIDTH), dtype=bool))
        assert hole_gaussians(wall_scene(None), sequence, none, self.ROOM) is None
