"""Fine-tuning against a plain float64 version of its loss, term by term."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from itertools import accumulate

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from extrags.config import DensifyConfig, FinetuneConfig
from extrags.pseudo_views import PseudoViews
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training import TrainingResult
from extrags.training.finetuning import finetune
from extrags.training.schedule import Schedule
from extrags.training.step import AutogradStep
from extrags.training.virtual_views import virtual_steps, virtual_views
from tests.extrags.training.conftest import HEIGHT, WIDTH
from tests.extrags.training.plain_finetuning import (
    COARSE,
    FORMS,
    GRADIENT_TOLERANCE,
    LOSS_TOLERANCE,
    N_GAUSSIANS,
    PAPER,
    PARAMETERS,
    STEPS,
    Expected,
    Found,
    Images,
    MakeStep,
    Plain,
    config_of,
    double,
    drawn,
    no_brighter_than_white,
    plain_loss,
    plain_ssim,
    prepared,
    stepped,
    virtual_index,
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
        shown, truth = no_brighter_than_white(expected.detached.rgb, sequence.rgb[frame])
        valid = torch.from_numpy(sequence.mask[frame] & (sequence.rgb[frame] < 250).any(-1))
        l1 = (truth - shown).abs()[valid].mean()
        seen = double(sequence.mask[frame])[..., None]
        eq24 = l1 + (1 - plain_ssim(seen * truth, seen * shown))[valid].mean()
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
} | {
    "windows reach beyond the mask": Plain(beyond_mask=1.0),
    "what is brighter than grey is as right as white": Plain(white=0.3),
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

    def test_without_image_confidence_all_views_have_the_mean_weight(self, pseudo: PseudoViews) -> None:
        views = virtual_views(pseudo, config_of("weighted_mean", image_confidence=False, pseudo_weight=2.0))
        assert [virtual_index(view, pseudo) for view in views] == [0, 2]
        assert [view.loss_weight for view in views] == pytest.approx([2 * (0.3 + 0.8) / 2] * 2)
        each = virtual_views(pseudo, config_of("weighted_mean", pseudo_weight=2.0))
        assert [view.loss_weight for view in each] == pytest.approx([0.6, 1.6])

    def test_the_floor_may_be_zero(self, pseudo: PseudoViews) -> None:
        floors = [0.0, 0.1]
        found = [virtual_views(pseudo, config_of("paper", confidence_floor=f))[0].weights for f in floors]
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
            assert np.array_equal(view.colors.numpy(), images[2])


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

    @pytest.mark.parametrize(("iterations", "first", "last"), [(2000, 50, 0), (300, 30, 30), (100, 29, 29)])
    def test_rounding_loses_no_virtual_view(self, iterations: int, first: int, last: int) -> None:
        config = FinetuneConfig(
            iterations=iterations, pseudo_share=first / 100, pseudo_share_final=last / 100
        )
        step = Fraction(last - first, 100 * (iterations - 1))
        shares = [Fraction(first, 100) + i * step for i in range(iterations)]
        expected = np.array([math.floor(total) for total in accumulate(shares)])
        assert np.array_equal(np.cumsum(virtual_steps(config)), expected)

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


class TestKeptScene:
    """With `keep_scene` new Gaussians alone are learned."""

    def test_its_gaussians_and_its_light_stay(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews
    ) -> None:
        holes = replace(pseudo, alpha=np.zeros_like(pseudo.alpha))
        config = config_of("paper", growth=1.3, seed_holes=True, keep_scene=True)
        seeds = prepared(scene, sequence, holes, config, COARSE).start.gaussians
        result = finetune(scene, sequence, holes, config, COARSE)
        found = result.scene.gaussians
        assert len(found) == len(seeds) > N_GAUSSIANS
        for name, values in scene.detached().gaussians.parameters().items():
            assert torch.equal(found.parameters()[name][:N_GAUSSIANS], values), name
        moved = found.sh0[N_GAUSSIANS:] - seeds.sh0.detach()[N_GAUSSIANS:]
        assert moved.abs().max() > 1e-3
        assert result.scene.light is not None
        assert scene.light is not None
        for name, values in scene.light.detached().parameters().items():
            assert torch.equal(result.scene.light.parameters()[name], values), name

    def test_their_number_stays(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Gaussians of the scene are known by their places, which a density step would change."""
        asked: list[Schedule] = []

        def recorded(start: Scene, draw: object, schedule: Schedule, **_: object) -> TrainingResult:
            asked.append(schedule)
            return TrainingResult(start, [])

        monkeypatch.setattr("extrags.training.finetuning.optimise", recorded)
        holes = replace(pseudo, alpha=np.zeros_like(pseudo.alpha))
        dense = COARSE.model_copy(update={"densify": DensifyConfig(enabled=True)})
        for keep_scene in (False, True):
            config = config_of("paper", growth=1.3, seed_holes=True, keep_scene=keep_scene)
            finetune(scene, sequence, holes, config, dense)
        assert [schedule.densify.enabled for schedule in asked] == [True, False]

    @pytest.mark.parametrize("virtual", [True, False])
    def test_without_new_gaussians_nothing_is_done(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews, virtual: bool
    ) -> None:
        """Real views alone would fit what is there; a scene without holes has nothing to learn."""
        config = config_of("paper", seed_holes=False, keep_scene=True)
        result = finetune(scene, sequence, pseudo if virtual else None, config, COARSE)
        assert result.history == []
        for name, values in scene.detached().gaussians.parameters().items():
            assert torch.equal(result.scene.gaussians.parameters()[name], values), name


class TestLightCooldown:
    def test_on_real_views_alone_the_light_comes_to_rest(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        asked: list[float] = []

        def recorded(start: Scene, draw: object, schedule: Schedule, **_: object) -> TrainingResult:
            asked.append(schedule.light_cooldown_share)
            return TrainingResult(start, [])

        monkeypatch.setattr("extrags.training.finetuning.optimise", recorded)
        config = FinetuneConfig(light_cooldown_share=0.3)
        finetune(scene, sequence, None, config, COARSE)
        finetune(scene, sequence, pseudo, config, COARSE)
        assert asked == [0.3, 0.0]
