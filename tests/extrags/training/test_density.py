from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from extrags.config import DensifyConfig, PipelineConfig
from extrags.errors import ConfigError
from extrags.raster import Rendering, SelectiveAdam
from extrags.training.density import DefaultStrategy, DensityStrategy, Window
from extrags.training.relocation import MCMCStrategy
from extrags.training.strategies import density_strategy
from tests.extrags.training.conftest import tube_gaussians

EXTENT = 20.0


def strategy(n: int, *, cap: int | None = None, **changes: object) -> DefaultStrategy:
    config = DensifyConfig(**changes)
    if cap is not None:  # smaller than a configuration allows
        config = config.model_copy(update={"max_gaussians": cap})
    return DefaultStrategy(config, EXTENT, 1000, n, seed=0)


def seen(
    gradient: Tensor,
    visible: Tensor | None = None,
    *,
    width: int = 48,
    height: int = 36,
    radius_px: Tensor | None = None,
    absolute: Tensor | None = None,
) -> Rendering:
    """A rendering after its backward pass: gradients [C, N, 2], visibility [C, N]."""
    c, n = gradient.shape[:2]
    means2d = torch.zeros(c, n, 2)
    means2d.grad = gradient
    if absolute is not None:
        means2d.absgrad = absolute  # type: ignore[attr-defined]
    if radius_px is None:
        radius_px = torch.ones(c, n) if visible is None else visible.float()
    return Rendering(
        rgb=torch.zeros(c, height, width, 3),
        alpha=torch.zeros(c, height, width),
        depth=torch.zeros(c, height, width),
        means2d=means2d,
        radius_px=radius_px,
    )


def strong(n: int, which: list[int]) -> Rendering:
    gradient = torch.zeros(1, n, 2)
    gradient[0, which, 0] = 1.0
    return seen(gradient)


def small_ones(n: int) -> dict[str, Tensor]:
    parameters = tube_gaussians(n).parameters()
    parameters["scales"] = torch.full((n, 3), 0.05).log()
    return parameters


class TestResets:
    @pytest.mark.parametrize("threshold", [0.0, 0.5, 0.6])
    def test_a_threshold_that_no_reset_can_double_is_refused(self, threshold: float) -> None:
        with pytest.raises(ValueError, match=r"expected a prune_opacity above 0 and below 0\.5"):
            DensifyConfig(reset_every=50, prune_opacity=threshold)
        settings = {"coarse.densify.reset_every": 50, "coarse.densify.prune_opacity": threshold}
        with pytest.raises(ConfigError, match=rf"^coarse\.densify: prune_opacity is {threshold} and"):
            PipelineConfig().with_overrides(settings)

    def test_where_nothing_is_reset_any_threshold_does(self) -> None:
        for settings in ({}, {"reset_every": 50, "strategy": "mcmc"}, {"reset_every": 50, "enabled": False}):
            assert DensifyConfig(prune_opacity=0.6, **settings).prune_opacity == 0.6


class TestDefaultStrategy:
    def test_settings_that_leave_no_gaussian_are_named(self) -> None:
        parameters = {name: value.requires_grad_() for name, value in tube_gaussians(10).parameters().items()}
        adam = SelectiveAdam(parameters, dict.fromkeys(parameters, 0.0))
        density = strategy(10, every=1, start_share=0.0, prune_opacity=0.95)
        with pytest.raises(ConfigError, match=r"all 10 Gaussians.*prune_opacity 0\.95.*prune_scale_share 0"):
            density.step(adam, strong(10, [2]), 0)
        assert len(adam.steps) == 10

    def test_small_strong_gaussians_are_cloned(self) -> None:
        parameters = small_ones(10)
        density = strategy(10)
        density.observe(strong(10, [2, 7]))
        decision = density.decide(parameters, 100)
        assert bool(decision.keep.all())
        assert torch.equal(decision.new_gaussians["means"], parameters["means"][[2, 7]])

    def test_large_strong_gaussians_are_split(self) -> None:
        parameters = tube_gaussians(10).parameters()
        density = strategy(10)
        density.observe(strong(10, [4]))
        decision = density.decide(parameters, 100)
        assert decision.keep.tolist() == [i != 4 for i in range(10)]
        assert len(decision.new_gaussians["means"]) == 2
        torch.testing.assert_close(
            decision.new_gaussians["scales"].exp(), (parameters["scales"][4].exp() / 1.6).expand(2, 3)
        )
        moved = (decision.new_gaussians["means"] - parameters["means"][4]).norm(dim=1)
        assert bool((moved > 0).all())
        assert bool((moved < 5 * 1.2).all())

    def test_faint_and_huge_gaussians_go(self) -> None:
        parameters = tube_gaussians(10).parameters()
        parameters["opacities"][1] = -8.0
        parameters["scales"][3] = 3.0
        decision = strategy(10).decide(parameters, 100)
        assert [i for i in range(10) if not decision.keep[i]] == [1, 3]
        assert len(decision.new_gaussians["means"]) == 0

    def test_huge_gaussians_wait_for_the_first_reset(self) -> None:
        parameters = tube_gaussians(10).parameters()
        parameters["scales"][3] = 3.0
        density = strategy(10, reset_every=300)
        assert bool(density.decide(parameters, 300).keep.all())
        assert not bool(density.decide(parameters, 301).keep[3])

    def test_a_huge_gaussian_whose_children_fit_is_split(self) -> None:
        parameters = tube_gaussians(10).parameters()
        parameters["scales"][3] = math.log(0.3 * EXTENT)
        density = strategy(10)
        density.observe(strong(10, [3]))
        decision = density.decide(parameters, 100)
        assert not bool(decision.keep[3])
        assert len(decision.new_gaussians["means"]) == 2

    @pytest.mark.parametrize(("cap", "kept"), [(11, [9]), (12, [8, 9]), (10, [])])
    def test_the_cap_takes_the_strongest(self, cap: int, kept: list[int]) -> None:
        parameters = small_ones(10)
        density = strategy(10, cap=cap)
        density.observe(seen(torch.arange(10.0)[None, :, None].expand(1, 10, 2)))
        decision = density.decide(parameters, 100)
        assert torch.equal(decision.new_gaussians["means"], parameters["means"][kept])

    def test_the_cap_holds_for_sizes_in_the_image_too(self) -> None:
        parameters = small_ones(10)
        density = strategy(10, refine_scale2d_stop_share=1.0, prune_scale2d=10.0, cap=12)
        density.observe(seen(torch.zeros(1, 10, 2), radius_px=torch.arange(10.0)[None]))
        decision = density.decide(parameters, 100)
        # Three reach beyond a twentieth of 48 pixels and more; there is room for two.
        assert [i for i in range(10) if not decision.keep[i]] == [8, 9]
        assert len(decision.new_gaussians["means"]) == 4

    def test_what_grows_takes_the_room_of_what_is_large_in_the_image(self) -> None:
        parameters = small_ones(10)
        density = strategy(10, refine_scale2d_stop_share=1.0, prune_scale2d=10.0, cap=12)
        gradient = torch.zeros(1, 10, 2)
        gradient[0, 1, 0] = 1.0
        density.observe(seen(gradient, radius_px=torch.arange(10.0)[None]))
        decision = density.decide(parameters, 100)
        # One is cloned, which leaves room for the split of one.
        assert [i for i in range(10) if not decision.keep[i]] == [9]
        assert int(decision.keep.sum()) + len(decision.new_gaussians["means"]) == 12

    def test_mean_gradient_counts_visible_views_only(self) -> None:
        parameters = small_ones(3)
        visible = torch.tensor([[True, True, False]])
        rounds = {}
        for threshold in (1.0, 1.2, 1.5):
            density = strategy(3, gradient_threshold=threshold)
            density.observe(seen(torch.ones(1, 3, 2), visible, width=2, height=2))
            density.observe(seen(torch.zeros(1, 3, 2), torch.tensor([[True, False, False]])))
            rounds[threshold] = len(density.decide(parameters, 100).new_gaussians["means"])
        # Half of sqrt 2, sqrt 2 and nothing
        assert rounds == {1.0: 1, 1.2: 1, 1.5: 0}

    def test_absolute_gradients_are_used_when_asked_for(self) -> None:
        parameters = small_ones(2)
        rendering = seen(torch.zeros(1, 2, 2), absolute=torch.tensor([[[1.0, 0], [0, 0]]]))
        for absgrad in (False, True):
            density = strategy(2, absgrad=absgrad)
            assert density.needs_absgrad is absgrad
            density.observe(rendering)
            assert len(density.decide(parameters, 100).new_gaussians["means"]) == int(absgrad)

    def test_steps_follow_the_window(self) -> None:
        """Rounds every 10 iterations, from 100 to 600 of 1000; the optimiser keeps up."""
        parameters = {k: v.requires_grad_() for k, v in small_ones(4).items()}
        adam = SelectiveAdam(parameters, dict.fromkeys(parameters, 1e-3))
        density = strategy(4, every=10)
        sizes = []
        for iteration in (98, 99, 100, 108, 109, 598, 599, 600, 609):
            density.step(adam, strong(len(adam.steps), [0]), iteration)
            sizes.append(len(adam.parameters["means"]))
        assert sizes == [4, 4, 4, 4, 5, 5, 6, 6, 6]
        assert len(adam.first_moments["quats"]) == len(adam.steps) == sizes[-1]

    @pytest.mark.parametrize("cloned", [[], [3]])
    def test_a_step_takes_faint_gaussians_out_of_the_optimiser(self, cloned: list[int]) -> None:
        """Whether others are new or not; those that stay keep parameters and moments."""
        values = small_ones(5)
        values["opacities"][[0, 2]] = -8.0
        parameters = {name: value.clone().requires_grad_() for name, value in values.items()}
        adam = SelectiveAdam(parameters, dict.fromkeys(parameters, 1e-3))
        adam.first_moments["means"] += torch.arange(5.0)[:, None]
        density = strategy(5, every=1, start_share=0.0)
        density.step(adam, strong(5, cloned), 0)
        rows = [1, 3, 4]
        for name, value in adam.parameters.items():
            assert torch.equal(value.detach(), values[name][rows + cloned])
        moments = adam.first_moments["means"][:, 0].tolist()
        assert moments == [1.0, 3.0, 4.0, *(0.0 for _ in cloned)]
        assert len(adam.steps) == 3 + len(cloned)

    def test_reset_caps_opacities_and_pauses(self) -> None:
        parameters = {k: v.requires_grad_() for k, v in small_ones(4).items()}
        adam = SelectiveAdam(parameters, dict.fromkeys(parameters, 1e-3))
        adam.first_moments["opacities"] += 1
        adam.first_moments["means"] += 1
        density = strategy(4, every=10, start_share=0.0, reset_every=100, reset_pause=20, prune_opacity=0.01)
        density.step(adam, strong(4, []), 99)
        assert float(adam.parameters["opacities"].detach().sigmoid().max()) == pytest.approx(0.02, rel=1e-5)
        assert float(adam.first_moments["opacities"].abs().max()) == 0
        assert float(adam.first_moments["means"].min()) == 1
        density.step(adam, strong(4, [0]), 109)
        assert len(adam.steps) == 4
        density.step(adam, strong(4, [0]), 119)
        assert len(adam.steps) == 5


class TestWindow:
    def test_of_shares(self) -> None:
        window = Window.of(DensifyConfig(start_share=0.25, stop_share=0.5, every=10), 200)
        assert [i for i in range(200) if window.round_after(i)] == [59, 69, 79, 89, 99]
        assert window.open(99)
        assert not window.open(100)


class TestChoice:
    @pytest.mark.parametrize(
        ("config", "kind"),
        [
            (DensifyConfig(), DefaultStrategy),
            (DensifyConfig(strategy="mcmc"), MCMCStrategy),
            (DensifyConfig(strategy="mcmc", enabled=False), DensityStrategy),
        ],
    )
    def test_the_configuration_decides(self, config: DensifyConfig, kind: type) -> None:
        assert type(density_strategy(config, 1.0, 100, 5, seed=0)) is kind

    def test_none_does_nothing(self) -> None:
        parameters = small_ones(4)
        adam = SelectiveAdam(parameters, dict.fromkeys(parameters, 1e-3))
        idle = DensityStrategy()
        idle.step(adam, strong(4, [0]), 499)
        assert idle.penalty(parameters) is None
        assert adam.parameters["means"] is parameters["means"]


def test_children_of_a_pancake_without_thickness_in_float32() -> None:
    gaussians = small_ones(3)
    gaussians["scales"] = torch.tensor([[0.0, 0.0, -110.0]]).repeat(3, 1)
    children = strategy(3).children(gaussians, torch.ones(3, dtype=torch.bool))
    assert bool(children["scales"].isfinite().all())
    torch.testing.assert_close(children["scales"][:, :2], torch.full((6, 2), -math.log(1.6)))
