from __future__ import annotations

import math
from fractions import Fraction

import pytest
import torch

from extrags.config import CoarseConfig, DensifyConfig
from extrags.raster import SelectiveAdam
from extrags.sequence import EndoscopicSequence
from extrags.training import reconstruct
from extrags.training.relocation import MCMCStrategy, compute_relocation
from tests.extrags.training.conftest import tube_gaussians
from tests.extrags.training.test_density import small_ones, strong


def by_the_formula(opacity: float, copies: int) -> tuple[float, float]:
    """Equation 9 as it is written; the alternating sum in exact arithmetic."""
    new = 1 - (1 - opacity) ** (1 / copies)
    exact = Fraction(new)
    total = 0.0
    for k in range(copies):
        coefficient = sum(math.comb(i - 1, k) for i in range(k + 1, copies + 1))
        total += (-1) ** k / math.sqrt(k + 1) * float(coefficient * exact ** (k + 1))
    return new, opacity / total


class TestComputeRelocation:
    @pytest.mark.parametrize("opacity", [0.004, 0.05, 0.5, 0.9, 0.999])
    def test_equals_the_papers_formula(self, opacity: float) -> None:
        copies = torch.tensor([1, 2, 3, 7, 20, 51])
        opacities = torch.full((6,), opacity, dtype=torch.float64)
        scales = torch.rand(6, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        new_opacities, new_scales = compute_relocation(opacities, scales, copies)
        for index, count in enumerate(copies.tolist()):
            expected, shrink = by_the_formula(opacity, count)
            assert float(new_opacities[index]) == pytest.approx(expected, rel=1e-10)
            torch.testing.assert_close(new_scales[index], scales[index] * shrink, rtol=1e-9, atol=0)

    def test_one_copy_changes_nothing(self) -> None:
        opacities, scales = torch.tensor([0.3, 0.8]), torch.tensor([[1.0, 2, 3], [4, 5, 6]])
        new_opacities, new_scales = compute_relocation(opacities, scales, torch.tensor([1, 1]))
        torch.testing.assert_close(new_opacities, opacities)
        torch.testing.assert_close(new_scales, scales)

    def test_copies_together_are_as_opaque_as_the_one(self) -> None:
        new, _ = compute_relocation(torch.tensor([0.9]), torch.ones(1, 3), torch.tensor([5]))
        assert 1 - (1 - float(new)) ** 5 == pytest.approx(0.9, rel=1e-5)

    def test_more_copies_than_the_table_holds(self) -> None:
        opacities, scales = torch.tensor([0.9, 0.9]), torch.ones(2, 3)
        _, new_scales = compute_relocation(opacities, scales, torch.tensor([51, 400]))
        assert torch.equal(new_scales[0], new_scales[1])


def strategy(**changes: object) -> MCMCStrategy:
    config = DensifyConfig(strategy="mcmc", **changes)  # type: ignore[arg-type]
    return MCMCStrategy(config, 20.0, 1000, seed=0)


class TestMCMCStrategy:
    def test_the_dead_go_to_the_living(self) -> None:
        parameters = small_ones(40)
        parameters["opacities"][:10] = -9.0
        decision = strategy().relocate(parameters)
        moved = {
            int(row): value for row, value in zip(decision.rewritten, decision.values["means"], strict=True)
        }
        assert set(range(10)) <= set(moved)
        living = {tuple(mean.tolist()) for mean in parameters["means"][10:]}
        assert {tuple(value.tolist()) for value in moved.values()} <= living
        assert bool(decision.keep.all())
        assert len(decision.new_gaussians["means"]) == 0

    def test_all_dead_is_left_alone(self) -> None:
        parameters = small_ones(5)
        parameters["opacities"][:] = -9.0
        assert not strategy().relocate(parameters).changed

    def test_growth_stops_at_the_cap(self) -> None:
        assert len(strategy(max_gaussians=104).grow(small_ones(100)).new_gaussians["means"]) == 4
        assert not strategy(max_gaussians=100).grow(small_ones(100)).changed

    def test_opaque_gaussians_stand_still(self) -> None:
        parameters = small_ones(10)
        parameters["opacities"] = torch.tensor([5.0] * 5 + [-7.0] * 5)
        before = parameters["means"].clone()
        strategy().shake(parameters, 3.2e-3)
        moved = (parameters["means"] - before).norm(dim=1)
        assert float(moved[:5].max()) == 0
        assert float(moved[5:].min()) > 0

    def test_noise_scales_with_the_scene(self) -> None:
        """A scene ten times as large, in units and extent, is shaken ten times as far."""
        moved = []
        for size in (1.0, 10.0):
            parameters = {k: v.clone() for k, v in tube_gaussians(10).parameters().items()}
            parameters["opacities"][:] = -7.0
            parameters["scales"] += math.log(size)
            parameters["means"] = torch.zeros(10, 3)
            MCMCStrategy(DensifyConfig(), 20 * size, 100, seed=1).shake(parameters, 1.6e-4 * 20 * size)
            moved.append(parameters["means"])
        torch.testing.assert_close(moved[1], 10 * moved[0])

    def test_penalty_pulls_opacities_and_scales_down(self) -> None:
        parameters = {k: v.requires_grad_() for k, v in small_ones(4).items()}
        penalty = strategy().penalty(parameters)
        assert penalty is not None
        penalty.backward()
        for name in ("opacities", "scales"):
            gradient = parameters[name].grad
            assert gradient is not None
            assert bool((gradient > 0).all())

    def test_steps_follow_the_window_and_the_noise_does_not(self) -> None:
        parameters = {k: v.requires_grad_() for k, v in small_ones(100).items()}
        parameters["opacities"].data[:] = -7.0
        parameters["opacities"].data[0] = 3.0
        adam = SelectiveAdam(parameters, dict.fromkeys(parameters, 1e-3))
        adam.steps += 7
        density = strategy()
        density.step(adam, strong(100, []), 598)
        assert len(adam.steps) == 100
        density.step(adam, strong(100, []), 599)
        assert len(adam.steps) == 105
        # All ninety-nine dead ones are new Gaussians now, as is the one they came to.
        assert float(adam.steps.sum()) == 0
        before = adam.parameters["means"].detach().clone()
        adam.parameters["opacities"].data[:] = -7.0
        density.step(adam, strong(105, []), 699)
        assert len(adam.steps) == 105
        assert float((adam.parameters["means"].detach() - before).norm(dim=1).min()) > 0

    def test_a_scene_trains_with_it(self, tube_sequence: EndoscopicSequence) -> None:
        config = CoarseConfig(
            iterations=200,
            max_points=400,
            densify=DensifyConfig(strategy="mcmc", every=20, max_gaussians=500),
        )
        first, second = (reconstruct(tube_sequence, config) for _ in range(2))
        assert first.history[-1]["loss"] < 0.4 * first.history[0]["loss"]
        assert len(first.scene.gaussians) == 500
        for name, value in first.scene.gaussians.parameters().items():
            assert torch.equal(value, second.scene.gaussians.parameters()[name]), name


def test_sizes_and_opacities_that_float32_rounds_to_zero() -> None:
    gaussians = small_ones(4)
    gaussians["scales"][:, 2] = -110
    strategy().grow({**gaussians, "opacities": torch.full((4,), -120.0)})
    grown = strategy(max_gaussians=10**6)
    adam = SelectiveAdam(
        {**small_ones(40), "scales": gaussians["scales"][:1].repeat(40, 1)}, dict.fromkeys(gaussians, 1e-3)
    )
    grown.grow(adam.parameters).apply(adam)
    assert len(adam.steps) == 42
    assert bool(adam.parameters["scales"].isfinite().all())
