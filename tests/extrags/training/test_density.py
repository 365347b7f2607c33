from __future__ import annotations

import torch
from scipy.spatial.transform import Rotation

from extrags.config import DensifyConfig
from extrags.training.density import DensityControl, quaternion_matrix
from tests.extrags.training.conftest import tube_gaussians


def control(n: int, **changes: object) -> DensityControl:
    return DensityControl(DensifyConfig(**changes), extent=20.0, n_gaussians=n, seed=0)  # type: ignore[arg-type]


def observed(density: DensityControl, n: int, strong: list[int]) -> None:
    gradient = torch.zeros(n, 2)
    gradient[strong, 0] = 1.0
    density.observe(gradient, torch.ones(n, dtype=torch.bool), 48, 36)


class TestDensityControl:
    def test_small_strong_gaussians_are_cloned(self) -> None:
        parameters = tube_gaussians(10).parameters()
        parameters["scales"] = torch.full((10, 3), 0.05).log()
        density = control(10)
        observed(density, 10, [2, 7])
        decision = density.decide(parameters)
        assert bool(decision.keep.all())
        assert torch.equal(decision.born["means"], parameters["means"][[2, 7]])

    def test_large_strong_gaussians_are_split(self) -> None:
        parameters = tube_gaussians(10).parameters()
        density = control(10)
        observed(density, 10, [4])
        decision = density.decide(parameters)
        assert decision.keep.tolist() == [i != 4 for i in range(10)]
        assert len(decision.born["means"]) == 2
        torch.testing.assert_close(
            decision.born["scales"].exp(), (parameters["scales"][4].exp() / 1.6).expand(2, 3)
        )
        moved = (decision.born["means"] - parameters["means"][4]).norm(dim=1)
        assert bool((moved > 0).all())
        assert bool((moved < 5 * 1.2).all())

    def test_faint_and_huge_gaussians_go(self) -> None:
        parameters = tube_gaussians(10).parameters()
        parameters["opacities"][1] = -8.0
        parameters["scales"][3] = 3.0
        decision = control(10).decide(parameters)
        assert [i for i in range(10) if not decision.keep[i]] == [1, 3]
        assert len(decision.born["means"]) == 0

    def test_the_cap_takes_the_strongest(self) -> None:
        parameters = tube_gaussians(10).parameters()
        parameters["scales"] = torch.full((10, 3), 0.05).log()
        density = DensityControl(DensifyConfig(max_gaussians=100), extent=20.0, n_gaussians=10, seed=0)
        density._config = DensifyConfig(max_gaussians=100).model_copy(update={"max_gaussians": 11})
        gradient = torch.arange(10.0)[:, None].expand(10, 2)
        density.observe(gradient, torch.ones(10, dtype=torch.bool), 48, 36)
        decision = density.decide(parameters)
        assert torch.equal(decision.born["means"], parameters["means"][[9]])

    def test_mean_gradient_counts_visible_views_only(self) -> None:
        density = control(3, gradient_threshold=5.0)
        gradient = torch.ones(3, 2)
        visible = torch.tensor([True, True, False])
        density.observe(gradient, visible, 2, 2)
        density.observe(gradient * 0, torch.tensor([True, False, False]), 2, 2)
        mean = density._gradient / density._count.clamp_min(1)
        torch.testing.assert_close(mean, torch.tensor([2**0.5 / 2, 2**0.5, 0.0]))


def test_quaternion_matrix_agrees_with_scipy() -> None:
    quats = torch.randn(20, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = Rotation.from_quat(quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    torch.testing.assert_close(quaternion_matrix(quats), torch.from_numpy(expected))
