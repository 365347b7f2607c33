from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from extrags.config import DensifyConfig
from extrags.errors import DivergedError, NonFiniteError
from extrags.gaussians import Gaussians
from extrags.raster import native, set_num_threads
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training.light_fit import COMMON
from extrags.training.optimise import optimise
from extrags.training.schedule import Schedule
from extrags.training.step import AutogradStep, NativeStep, TrainingStep, training_step
from extrags.training.strategies import density_strategy
from extrags.training.views import View, real_views
from tests.extrags.training.shaken_tube import relative_error, shaken_scene, step_schedule

pytestmark = pytest.mark.skipif(native.native_isa() is None, reason="the native kernels are not built")

MakeStep = Callable[[Scene, Schedule], TrainingStep]


@pytest.fixture
def threads() -> Iterator[None]:
    before = native.num_threads()
    yield
    native.set_num_threads(before)


def _virtual(view: View) -> View:
    return replace(view, depth_mm=None, frame=None, loss_weight=0.3)


def _weighted(view: View) -> View:
    weight = torch.rand(view.weight.shape, generator=torch.Generator().manual_seed(2))
    return replace(view, weight=weight)


def _masked(view: View) -> View:
    """The picture of a scope: round, with something beyond its edge that no loss may see."""
    rows, columns = torch.meshgrid(
        *(torch.linspace(-1, 1, side) for side in view.weight.shape), indexing="ij"
    )
    shown = rows**2 + columns**2 < 0.7
    return replace(view, weight=shown, shown=shown)


def _saturated(view: View) -> View:
    """Red is saturated in a part of the picture, round as well."""
    masked = _masked(view)
    rgb = masked.rgb.clone()
    rgb[4:20, 6:24, 0] = 251
    rgb[:, -9:, 1] = 255
    return replace(masked, rgb=rgb, saturating=True)


SETTINGS: dict[str, DensifyConfig] = {
    "none": DensifyConfig(enabled=False),
    "absgrad": DensifyConfig(absgrad=True),
    "mcmc": DensifyConfig(strategy="mcmc"),
}


class TestOneStep:
    @pytest.mark.parametrize("lit", [True, False])
    @pytest.mark.parametrize("change", [_weighted, _virtual, _masked, _saturated])
    @pytest.mark.parametrize("setting", SETTINGS)
    def test_loss_and_gradients_are_those_of_autograd(
        self, tube_sequence: EndoscopicSequence, setting: str, change: Callable[[View], View], lit: bool
    ) -> None:
        view = change(real_views(tube_sequence, tube_sequence.train)[1])
        schedule = step_schedule(densify=SETTINGS[setting], sh_every=5)
        scene = shaken_scene(lit=lit)
        native_step, expected = NativeStep(scene, schedule), AutogradStep(scene, schedule)
        density = density_strategy(schedule.densify, 20.0, 30, len(scene.gaussians), seed=0)
        iteration = 7
        own = native_step.differentiate(view, iteration, density)
        other = expected.differentiate(view, iteration, density)
        assert own.loss == pytest.approx(other.loss, rel=1e-6)
        assert native_step.direct is not None
        gradients = dict(native_step.direct.gradients)
        gradients |= {"sh0": gradients["sh"][:, :1], "shN": gradients["sh"][:, 1:]}
        for name, value in expected.adam.parameters.items():
            assert value.grad is not None
            assert relative_error(gradients[name], value.grad) < 1e-5, name
        assert torch.equal(own.visible, other.visible)
        assert torch.equal(own.rendering.radius_px, other.rendering.radius_px)
        assert relative_error(own.rendering.rgb, other.rendering.rgb.detach()) < 1e-6
        name = "absgrad" if setting == "absgrad" else "grad"
        moved, expected_moved = getattr(own.rendering.means2d, name), getattr(other.rendering.means2d, name)
        assert relative_error(moved, expected_moved) < 1e-5
        if lit:
            assert native_step.light_fit is not None
            assert expected.light is not None
            row = native_step.direct.light_gradient
            common = native_step.light_fit.common_gradient(row)
            flat = [expected.light.parameters()[name].grad for name in COMMON]
            joined = torch.cat([value.reshape(-1) for value in flat if value is not None])
            assert relative_error(torch.from_numpy(common), joined) < 1e-5
            if view.frame is not None:
                exposure = torch.from_numpy(native_step.light_fit.exposure_gradient(row))
                assert expected.light.log_exposure.grad is not None
                assert relative_error(exposure, expected.light.log_exposure.grad) < 1e-5

    @pytest.mark.parametrize("native_kernels", [True, False])
    def test_what_is_beyond_the_mask_has_no_say(
        self, tube_sequence: EndoscopicSequence, native_kernels: bool
    ) -> None:
        masked = _masked(real_views(tube_sequence, tube_sequence.train)[1])
        assert masked.shown is not None
        beyond = ~masked.shown
        others = masked.rgb.clone()
        others[beyond] = 255 - others[beyond]
        schedule = step_schedule()
        scene = shaken_scene(lit=True)
        density = density_strategy(schedule.densify, 20.0, 30, len(scene.gaussians), seed=0)
        found = []
        for view in (masked, replace(masked, rgb=others)):
            step = NativeStep(scene, schedule) if native_kernels else AutogradStep(scene, schedule)
            observation = step.differentiate(view, 7, density)
            if isinstance(step, NativeStep):
                assert step.direct is not None
                gradient = step.direct.gradients["means"].clone()
            else:
                means = step.adam.parameters["means"].grad
                assert means is not None
                gradient = means.clone()
            # The rendering is shown as it is, not as the loss saw it.
            assert float(observation.rendering.rgb[0][beyond].detach().max()) > 0
            found.append((observation.loss, gradient))
        assert found[0][0] == found[1][0]
        assert torch.equal(found[0][1], found[1][1])

    @pytest.mark.parametrize("native_kernels", [True, False])
    def test_what_is_brighter_than_a_saturated_channel_is_as_right(
        self, tube_sequence: EndoscopicSequence, native_kernels: bool
    ) -> None:
        """It has no gradient; what is darker is pulled up."""
        view = real_views(tube_sequence, tube_sequence.train)[1]
        assert view.frame is not None
        view = replace(view, rgb=torch.full_like(view.rgb, 255), saturating=True, depth_mm=None)
        scene = shaken_scene(lit=True)
        assert scene.light is not None
        schedule = step_schedule()
        density = density_strategy(schedule.densify, 20.0, 30, len(scene.gaussians), seed=0)
        found = {}
        for factor in (0.3, 60.0):
            exposure = torch.zeros_like(scene.light.log_exposure)
            exposure[view.frame] = 2 * np.log(factor)
            lit = replace(scene, light=replace(scene.light, log_exposure=exposure))
            step = (NativeStep if native_kernels else AutogradStep)(lit, schedule)
            observation = step.differentiate(view, 7, density)
            rendered = observation.rendering.rgb[0].detach()
            if isinstance(step, NativeStep):
                assert step.direct is not None
                gradient = step.direct.gradients["sh"][:, 0].clone()
            else:
                of_colors = step.adam.parameters["sh0"].grad
                assert of_colors is not None
                gradient = of_colors[:, 0].clone()
            found[factor] = (rendered, gradient)
        darker, brighter = found[0.3][1], found[60.0][1]
        # Descending along it brightens; holes alone are darker than white where all else is brighter.
        assert float(darker.sum()) < 0
        assert float((found[60.0][0] > 1).float().mean()) > 0.5
        assert float(brighter.abs().sum()) < 0.2 * float(darker.abs().sum())

    @pytest.mark.parametrize("iteration", [3, 4000])
    @pytest.mark.parametrize("degree", [0, 1, 3])
    def test_parameters_after_a_step_are_the_same(
        self, tube_sequence: EndoscopicSequence, degree: int, iteration: int
    ) -> None:
        view = real_views(tube_sequence, tube_sequence.train)[0]
        schedule = step_schedule(8000, sh_every=1)
        scene = shaken_scene(degree)
        density = density_strategy(schedule.densify, 20.0, 30, len(scene.gaussians), seed=0)
        steps = [NativeStep(scene, schedule), AutogradStep(scene, schedule)]
        for step in steps:
            step.adam.learning_rates = schedule.learning_rates(iteration)
            step.update(step.differentiate(view, iteration, density), iteration)
        own, other = (step.adam.parameters for step in steps)
        assert scene.light is not None
        start, start_light = scene.gaussians.parameters(), scene.light.parameters()
        for name, value in other.items():
            if value.numel():
                moved, expected = own[name].detach() - start[name], value.detach() - start[name]
                # A first Adam step is the sign of the gradient: a few that are nearly zero may differ.
                assert relative_error(moved, expected) < 0.02, name
                assert float(expected.abs().max()) > 0
        for name, value in steps[1].light.parameters().items():  # type: ignore[union-attr]
            rate = (
                schedule.light.exposure_learning_rate
                if name == "log_exposure"
                else schedule.light.learning_rate
            )
            first = start_light[name]
            longest = float((value.detach() - first).nan_to_num().abs().max())  # a softening of 0
            assert longest <= 1.001 * schedule.rate_share(iteration) * rate
            torch.testing.assert_close(
                steps[0].light.parameters()[name], value.detach(), rtol=1e-4, atol=1e-6
            )  # type: ignore[union-attr]

    def test_depth_weight_zero_leaves_depth_alone(self, tube_sequence: EndoscopicSequence) -> None:
        view = real_views(tube_sequence, tube_sequence.train)[0]
        schedule = step_schedule(depth_weight=0.0)
        density = density_strategy(schedule.densify, 20.0, 30, 900, seed=0)
        losses = [
            NativeStep(shaken_scene(), schedule).differentiate(v, 0, density).loss
            for v in (view, replace(view, depth_mm=None))
        ]
        assert losses[0] == losses[1]


@pytest.mark.parametrize("lit", [True, False])
def test_a_step_in_float64_is_that_in_float32(tube_sequence: EndoscopicSequence, lit: bool) -> None:
    scene = shaken_scene(lit=lit)
    wide_gaussians, wide_light = (
        None
        if part is None
        else replace(part, **{name: value.double() for name, value in part.parameters().items()})
        for part in (scene.gaussians, scene.light)
    )
    assert isinstance(wide_gaussians, Gaussians)
    wide = Scene(wide_gaussians, wide_light)
    ssim_weight = torch.ones(tube_sequence.mask.shape[1:])
    view = replace(
        _weighted(real_views(tube_sequence, tube_sequence.train)[1]),
        ssim_weight=ssim_weight,
        depth_confidence=0.5 * ssim_weight,
    )
    schedule = step_schedule()
    density = density_strategy(schedule.densify, 20.0, 30, len(scene.gaussians), seed=0)
    found = []
    for start in (scene, wide):
        step = AutogradStep(start, schedule)
        observation = step.differentiate(view, 3, density, view.camera.viewmats[0])
        assert observation.viewmat_gradient is not None
        found.append((observation.loss, observation.viewmat_gradient, step.adam.parameters["means"].grad))
    (loss, pose, means), (expected_loss, expected_pose, expected_means) = found
    assert expected_means.dtype == torch.float64
    assert loss == pytest.approx(expected_loss, rel=1e-5)
    # A few pixels end at another Gaussian.
    assert relative_error(torch.from_numpy(pose), torch.from_numpy(expected_pose)) < 1e-2
    assert relative_error(means, expected_means) < 1e-2


def _train(
    sequence: EndoscopicSequence, make_step: MakeStep, densify: DensifyConfig, iterations: int = 30
) -> tuple[Scene, list[dict[str, float]]]:
    views = real_views(sequence, sequence.train)
    mixed = [*views, _virtual(views[0])]
    schedule = step_schedule(iterations, densify=densify, sh_every=8)
    result = optimise(shaken_scene(), lambda i: mixed[i % len(mixed)], schedule, make_step=make_step)
    return result.scene, result.history


DENSIFYING = DensifyConfig(
    start_share=0.1, stop_share=1.0, every=10, gradient_threshold=1e-4, max_gaussians=1200
)


class TestManySteps:
    def test_stays_close_to_autograd_through_densification(self, tube_sequence: EndoscopicSequence) -> None:
        own, own_history = _train(tube_sequence, NativeStep, DENSIFYING)
        other, history = _train(tube_sequence, AutogradStep, DENSIFYING)
        assert history[-1]["n_gaussians"] > 900
        # Thresholds may fall differently for a Gaussian or two.
        assert own_history[-1]["n_gaussians"] == pytest.approx(history[-1]["n_gaussians"], abs=10)
        assert own_history[-1]["loss"] == pytest.approx(history[-1]["loss"], rel=1e-2)
        assert own_history[-1]["psnr"] == pytest.approx(history[-1]["psnr"], abs=0.1)
        for name, value in other.light.parameters().items():  # type: ignore[union-attr]
            torch.testing.assert_close(own.light.parameters()[name], value, rtol=1e-2, atol=1e-3)  # type: ignore[union-attr]

    def test_mcmc_stays_close_too(self, tube_sequence: EndoscopicSequence) -> None:
        densify = DENSIFYING.model_copy(update={"strategy": "mcmc"})
        _, own = _train(tube_sequence, NativeStep, densify)
        _, other = _train(tube_sequence, AutogradStep, densify)
        assert own[-1]["n_gaussians"] == other[-1]["n_gaussians"] > 900
        assert own[-1]["loss"] == pytest.approx(other[-1]["loss"], rel=1e-2)

    @pytest.mark.parametrize("strategy", ["default", "mcmc"])
    def test_same_bits_on_any_number_of_threads(
        self, tube_sequence: EndoscopicSequence, strategy: str, threads: None
    ) -> None:
        densify = DENSIFYING.model_copy(update={"strategy": strategy})
        results = []
        for count in (1, 2, 8):
            set_num_threads(count)
            results.append(_train(tube_sequence, NativeStep, densify)[0])
        for other in results[1:]:
            for name, value in results[0].gaussians.parameters().items():
                assert torch.equal(value, other.gaussians.parameters()[name]), name
            for name, value in results[0].light.parameters().items():  # type: ignore[union-attr]
                assert torch.equal(value, other.light.parameters()[name]), name  # type: ignore[union-attr]


class TestNativeStep:
    def test_the_scene_given_is_copied(self, tube_sequence: EndoscopicSequence) -> None:
        scene = shaken_scene()
        before = scene.detached()
        view = real_views(tube_sequence, tube_sequence.train)[0]
        optimise(scene, lambda _: view, step_schedule(3), make_step=NativeStep)
        for name, value in before.gaussians.parameters().items():
            assert torch.equal(scene.gaussians.parameters()[name], value), name
        for name, value in before.light.parameters().items():  # type: ignore[union-attr]
            assert torch.equal(scene.light.parameters()[name], value), name  # type: ignore[union-attr]

    def test_nonfinite_parameters_are_refused(self, tube_sequence: EndoscopicSequence) -> None:
        scene = shaken_scene()
        scene.gaussians.shN[5, 1, 2] = float("inf")
        view = real_views(tube_sequence, tube_sequence.train)[0]
        with pytest.raises(NonFiniteError, match=r"sh\[5, 2, 2\] is inf"):
            optimise(scene, lambda _: view, step_schedule(2), make_step=NativeStep)

    def test_chosen_where_it_can_work(self) -> None:
        scene = shaken_scene()
        wide = Gaussians(**{k: v.double() for k, v in scene.gaussians.parameters().items()})
        assert isinstance(training_step(scene, step_schedule()), NativeStep)
        assert isinstance(training_step(Scene(wide), step_schedule()), AutogradStep)


@pytest.mark.parametrize("make_step", [NativeStep, AutogradStep])
def test_torch_threads_are_put_back(tube_sequence: EndoscopicSequence, make_step: MakeStep) -> None:
    view = real_views(tube_sequence, tube_sequence.train)[0]
    poisoned = replace(view, rgb=torch.full_like(view.colors, np.nan))
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    seen: list[int] = []

    def draw(iteration: int) -> View:
        seen.append(torch.get_num_threads())
        return poisoned if iteration == 2 else view

    try:
        with pytest.raises(DivergedError, match="iteration 2"):
            optimise(shaken_scene(), draw, step_schedule(5), make_step=make_step)
        assert torch.get_num_threads() == 2
        assert seen == [1, 1, 1]
    finally:
        torch.set_num_threads(before)
