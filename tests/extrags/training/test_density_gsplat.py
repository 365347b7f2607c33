"""Our densification beside gsplat's own code, on the same parameters, gradients and random numbers."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from extrags.config import DensifyConfig
from extrags.raster import SelectiveAdam
from extrags.training.density import DefaultStrategy
from extrags.training.relocation import MCMCStrategy, compute_relocation
from tests.extrags.training.test_density import seen

pytest.importorskip("gsplat", reason="gsplat is not installed: pip install --no-deps gsplat")

EXTENT, WIDTH, HEIGHT = 2.0, 64, 48
EVERY = 10


def scattered(n: int, seed: int) -> dict[str, Tensor]:
    """Gaussians on both sides of every threshold."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    return {
        "means": normal(n, 3),
        "quats": normal(n, 4),
        "scales": normal(n, 3) + math.log(0.02 * EXTENT),
        "opacities": 3 * normal(n) - 1,
        "sh0": normal(n, 1, 3),
        "shN": normal(n, 3, 3),
    }


class Theirs:
    """Parameters with one torch optimiser each, as gsplat's strategies want them."""

    def __init__(self, parameters: dict[str, Tensor]) -> None:
        self.parameters = {k: torch.nn.Parameter(v.clone()) for k, v in parameters.items()}
        self.optimisers = {
            name: torch.optim.Adam([{"params": [value], "lr": 1e-3}])
            for name, value in self.parameters.items()
        }
        for name, value in self.parameters.items():
            moments = {"exp_avg": torch.ones_like(value), "exp_avg_sq": torch.ones_like(value)}
            self.optimisers[name].state[value] = {"step": torch.tensor(1.0), **moments}

    def first_moment(self, name: str) -> Tensor:
        found: Tensor = self.optimisers[name].state[self.parameters[name]]["exp_avg"]
        return found


def ours_like(parameters: dict[str, Tensor]) -> SelectiveAdam:
    leaves = {k: v.clone().requires_grad_() for k, v in parameters.items()}
    adam = SelectiveAdam(leaves, dict.fromkeys(leaves, 1e-3))
    for moments in (adam.first_moments, adam.second_moments):
        for value in moments.values():
            value += 1
    return adam


def assert_same(adam: SelectiveAdam, theirs: Theirs, *, but: frozenset[str] = frozenset()) -> None:
    for name, value in theirs.parameters.items():
        if name not in but:
            torch.testing.assert_close(adam.parameters[name].detach(), value.detach(), rtol=1e-5, atol=1e-6)
            assert torch.equal(adam.first_moments[name], theirs.first_moment(name)), name


class TestDefault:
    @pytest.mark.parametrize(
        ("ours", "gsplats"),
        [
            ({}, {}),
            ({"absgrad": True, "gradient_threshold": 8e-4}, {"absgrad": True, "grow_grad2d": 8e-4}),
            (
                {"refine_scale2d_stop_share": 1.0, "grow_scale2d": 0.3, "prune_scale2d": 0.6},
                {"refine_scale2d_stop_iter": 100, "grow_scale2d": 0.3, "prune_scale2d": 0.6},
            ),
            (
                {"refine_scale2d_stop_share": 0.25, "grow_scale2d": 0.1, "prune_scale2d": 0.2},
                {"refine_scale2d_stop_iter": 25, "grow_scale2d": 0.1, "prune_scale2d": 0.2},
            ),
            ({"prune_scale_share": 0.05}, {"prune_scale3d": 0.05}),
            ({"reset_every": 20}, {"reset_every": 20}),
        ],
        ids=["plain", "absgrad", "scale2d", "scale2d until", "prune scale", "prune after reset"],
    )
    def test_rounds_decide_alike(
        self, ours: dict[str, Any], gsplats: dict[str, Any], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        from gsplat import DefaultStrategy as GsplatStrategy

        start = scattered(400, seed=3)
        # Far apart in the two are only the defaults of two thresholds and the schedule.
        settings = {"reset_every": 1, "prune_scale3d": 0.1} | gsplats
        judge = GsplatStrategy(refine_start_iter=0, refine_every=EVERY, refine_stop_iter=100, **settings)
        state = judge.initialize_state(EXTENT)
        config = DensifyConfig(
            **{"start_share": 0.0, "stop_share": 1.0, "every": EVERY, "prune_scale_share": 0.1} | ours
        )
        density = DefaultStrategy(config, EXTENT, 100, 400, seed=0)
        # gsplat 1.5.3 never resets; ours is compared with its function below.
        monkeypatch.setattr(density, "reset_opacities", lambda adam: None)
        theirs, adam = Theirs(start), ours_like(start)
        generator = torch.Generator().manual_seed(5)
        sizes = []
        for iteration in range(45):
            n = len(adam.steps)
            gradient = 3e-5 * torch.randn(1, n, 2, generator=generator).exp()
            absolute = gradient * (1 + 3 * torch.rand(1, n, 2, generator=generator))
            radius = 3 * torch.randn(1, n, generator=generator).exp()
            visible = torch.rand(1, n, generator=generator) < 0.7
            radius = (radius * visible).ceil()
            density.step(
                adam,
                seen(gradient, width=WIDTH, height=HEIGHT, radius_px=radius, absolute=absolute),
                iteration,
            )
            means2d = torch.zeros(1, n, 2)
            means2d.grad, means2d.absgrad = gradient.clone(), absolute.clone()  # type: ignore[attr-defined]
            info = {
                "width": WIDTH,
                "height": HEIGHT,
                "n_cameras": 1,
                "radii": radius[..., None].expand(1, n, 2),
                "gaussian_ids": None,
                "means2d": means2d,
            }
            judge.step_post_backward(theirs.parameters, theirs.optimisers, state, iteration + 1, info)
            sizes.append(len(adam.steps))
            # Where split children land is chance, and drawn differently.
            assert_same(adam, theirs, but=frozenset({"means"}))
        assert len(set(sizes)) >= 4
        standing = (adam.parameters["means"] == theirs.parameters["means"]).all(1)
        assert 0 < int(standing.sum()) < len(standing)

    def test_clones_and_splits_keep_or_shake_positions(self) -> None:
        """With the same random numbers even the children land in the same places."""
        from gsplat.strategy import ops

        start = scattered(50, seed=4)
        mask = torch.arange(50) % 3 == 0
        theirs = Theirs(start)
        torch.manual_seed(11)
        ops.split(theirs.parameters, theirs.optimisers, {}, mask)
        density = DefaultStrategy(DensifyConfig(), EXTENT, 100, 50, seed=11)
        children = density.children(start, mask)
        for name, value in children.items():
            torch.testing.assert_close(value, theirs.parameters[name].detach()[-2 * int(mask.sum()) :])

    def test_reset(self) -> None:
        from gsplat.strategy import ops

        start = scattered(50, seed=4)
        theirs, adam = Theirs(start), ours_like(start)
        ops.reset_opa(theirs.parameters, theirs.optimisers, {}, value=2 * 0.005)
        DefaultStrategy(DensifyConfig(prune_opacity=0.005), EXTENT, 100, 50, seed=0).reset_opacities(adam)
        assert_same(adam, theirs)


@pytest.fixture
def without_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    """gsplat's MCMC operations with its CUDA kernels replaced, and the samples of both told."""
    from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci
    from gsplat.strategy import ops

    def relocation(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor) -> Any:
        return compute_relocation(opacities, scales, ratios)

    def sample(weights: Tensor, n: int, replacement: bool = True) -> Tensor:
        return told(weights, n)

    monkeypatch.setattr(ops, "compute_relocation", relocation)
    monkeypatch.setattr(ops, "quat_scale_to_covar_preci", _quat_scale_to_covar_preci)
    monkeypatch.setattr(ops, "_multinomial_sample", sample)
    monkeypatch.setattr(MCMCStrategy, "_sampled", lambda self, weights, n: told(weights, n))


def told(weights: Tensor, n: int) -> Tensor:
    return torch.multinomial(weights, n, replacement=True, generator=torch.Generator().manual_seed(n))


@pytest.mark.usefixtures("without_cuda")
class TestMCMC:
    CONFIG = DensifyConfig(strategy="mcmc", prune_opacity=0.05, max_gaussians=205)

    def test_relocation(self) -> None:
        from gsplat.strategy import ops

        start = scattered(200, seed=6)
        theirs, adam = Theirs(start), ours_like(start)
        dead = start["opacities"].sigmoid() <= 0.05
        assert 5 < int(dead.sum()) < 100
        ops.relocate(theirs.parameters, theirs.optimisers, {}, dead, torch.zeros(51, 51), 0.05)
        MCMCStrategy(self.CONFIG, EXTENT, 100, seed=0).relocate(adam.parameters).apply(adam)
        for name, value in theirs.parameters.items():
            torch.testing.assert_close(adam.parameters[name].detach(), value.detach(), rtol=1e-5, atol=1e-6)
            # gsplat leaves a relocated Gaussian the moments of its old place; ours start anew.
            moment = theirs.first_moment(name).clone()
            moment[dead] = 0
            assert torch.equal(adam.first_moments[name], moment)
        assert len(adam.steps) == 200

    @pytest.mark.parametrize(("cap", "size"), [(1000, 210), (205, 205), (200, 200), (150, 200)])
    def test_growth(self, cap: int, size: int) -> None:
        from gsplat import MCMCStrategy as GsplatStrategy

        start = scattered(200, seed=6)
        theirs, adam = Theirs(start), ours_like(start)
        judge = GsplatStrategy(cap_max=cap, min_opacity=0.05)
        judge._add_new_gs(theirs.parameters, theirs.optimisers, torch.zeros(51, 51))
        config = self.CONFIG.model_copy(update={"max_gaussians": cap})
        MCMCStrategy(config, EXTENT, 100, seed=0).grow(adam.parameters).apply(adam)
        assert len(adam.steps) == size
        assert_same(adam, theirs)

    def test_noise(self) -> None:
        from gsplat.strategy import ops

        start = scattered(200, seed=6)
        theirs, adam = Theirs(start), ours_like(start)
        torch.manual_seed(12)
        ops.inject_noise_to_position(theirs.parameters, theirs.optimisers, {}, scaler=1.6e-4 * 5e5)
        MCMCStrategy(self.CONFIG, 1.0, 100, seed=12).shake(adam.parameters, 1.6e-4)
        assert float((adam.parameters["means"].detach() - start["means"]).abs().max()) > 0.01
        torch.testing.assert_close(
            adam.parameters["means"].detach(), theirs.parameters["means"].detach(), rtol=1e-4, atol=1e-6
        )
