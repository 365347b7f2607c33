"""A monocular network's depth: aligned with stereo, weighed with other cues, of use where stereo is poor."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from extrags.config import DepthConfig
from extrags.depth.estimate import DepthEstimate, estimate_depth
from extrags.depth.monocular import aligned, fit_monocular, predictions
from extrags.depth.prior import DepthPrior
from extrags.sequence import EndoscopicSequence
from tests.extrags.depth.planes import inside_sphere
from tests.extrags.depth.tiny_monocular import KnownDepth
from tests.extrags.depth.withheld import true_training_depth, with_points, withheld_phantom

SCALE = torch.tensor([0.5, 3.0, 1.0, 7.0, 2.0])[:, None, None]
SHIFT = torch.tensor([0.0, -1.0, 4.0, 0.3, 2.0])[:, None, None]
ONE = torch.zeros(5, dtype=torch.long)


class TestAlignment:
    def test_scale_and_shift_of_each_frame_are_found(self) -> None:
        _, depth = inside_sphere()
        sure = torch.rand(depth.shape, generator=torch.Generator().manual_seed(0)) < 0.3
        (fit,) = fit_monocular((1 / depth - SHIFT) / SCALE, depth.log(), sure, ONE)
        assert torch.allclose(fit.scale, SCALE.flatten(), rtol=1e-4)
        assert torch.allclose(fit.shift, SHIFT.flatten(), atol=1e-3)
        assert fit.own.all()
        assert fit.scatter.max() == pytest.approx(0.02)
        assert fit.n_pixels == int(sure.sum())

    def test_wrong_depths_hardly_move_it(self) -> None:
        _, depth = inside_sphere()
        generator = torch.Generator().manual_seed(1)
        wrong = torch.rand(depth.shape, generator=generator) < 0.2
        noisy = depth.log() + 0.7 * wrong * torch.sign(torch.randn(depth.shape, generator=generator))
        noisy = noisy + 0.05 * torch.randn(depth.shape, generator=generator)
        predicted = (1 / depth - SHIFT) / SCALE
        fits = fit_monocular(predicted, noisy, torch.ones_like(wrong), ONE)
        found, scatter = aligned(fits, predicted, ONE)
        assert (found - depth.log()).abs().max() < 0.03
        assert 0.04 < scatter.max() < 0.09

    def test_a_frame_without_sure_pixels_borrows_and_says_so(self) -> None:
        _, depth = inside_sphere()
        sure = torch.ones(depth.shape, dtype=torch.bool)
        sure[2] = False
        gain = torch.tensor([0.8, 0.9, 1.1, 1.3, 1.0])[:, None, None]
        (fit,) = fit_monocular(gain / depth, depth.log(), sure, ONE)
        assert fit.own.tolist() == [True, True, False, True, True]
        assert fit.scale[2] == fit.scale[fit.own].median()
        assert fit.scatter[2] > 0.1 > fit.scatter[0]

    def test_what_does_not_rise_with_inverse_depth_is_no_fit(self) -> None:
        _, depth = inside_sphere()
        sure = torch.ones(depth.shape, dtype=torch.bool)
        for predicted in (depth, torch.ones_like(depth)):
            (fit,) = fit_monocular(predicted, depth.log(), sure, ONE)
            assert not fit.own.any()
            assert torch.isinf(fit.scatter).all()

    def test_depth_stays_finite_where_the_line_crosses_zero(self) -> None:
        _, depth = inside_sphere()
        predicted = 1 / depth
        predicted[:, :5] = -3.0
        sure = torch.ones(depth.shape, dtype=torch.bool)
        sure[:, :5] = False
        (fit,) = fit_monocular(predicted, depth.log(), sure, ONE)
        found = fit.log_depth(predicted)[:, :5]
        assert torch.isfinite(found).all()
        assert (found <= torch.log(2.1 * depth.amax(dim=(1, 2)))[:, None, None]).all()

    def test_recordings_scatter_on_their_own(self) -> None:
        _, depth = inside_sphere()
        noise = 0.2 * torch.randn(depth.shape, generator=torch.Generator().manual_seed(2))
        noise[2:] = 0
        recording = torch.tensor([0, 0, 1, 1, 1])
        sure = torch.ones(depth.shape, dtype=torch.bool)
        predicted = torch.exp(noise) / depth
        _, scatter = aligned(fit_monocular(predicted, depth.log(), sure, recording), predicted, recording)
        assert scatter[0] == scatter[1] > 0.06
        assert (scatter[2:] < 0.03).all()


class TestPrior:
    def test_inverse_variances_weigh(self) -> None:
        one = DepthPrior(torch.zeros(2, 3, 4), torch.tensor([0.1, float("inf")]))
        other = DepthPrior(torch.ones(2, 3, 4), torch.tensor([0.2, 0.2]))
        both = one & other
        assert torch.allclose(both.log_depth[:, 0, 0], torch.tensor([0.2, 1.0]))
        assert torch.allclose(both.scatter, torch.tensor([0.05**0.5 * 0.4, 0.2]))
        assert torch.isinf((one & one).scatter[1])

    def test_leaving_it_costs_no_more_than_its_bound(self) -> None:
        prior = DepthPrior(torch.zeros(1, 1, 1), torch.tensor([0.1]))
        offsets = torch.tensor([[-2.0, 0.0, 0.2, 5.0]])
        cost = prior.cost(torch.tensor([0]), torch.zeros(1), offsets, weight=0.2, scatters=4.0)
        assert torch.allclose(cost.flatten(), torch.tensor([0.3, 0.0, 0.1, 0.3]))
        nothing = DepthPrior(prior.log_depth, torch.tensor([float("inf")]))
        assert not nothing.cost(torch.tensor([0]), torch.zeros(1), offsets, weight=0.2, scatters=4.0).any()


@pytest.fixture(scope="module")
def poor() -> EndoscopicSequence:
    """So few and small frames that stereo finds little."""
    return with_points(withheld_phantom(4, width=64, height=48))


def absrel(sequence: EndoscopicSequence, estimate: DepthEstimate) -> float:
    truth = true_training_depth(sequence)
    known = (truth > 0) & sequence.mask[sequence.train]
    return float((np.abs(estimate.depth - truth)[known] / truth[known]).mean())


class TestStage:
    @pytest.mark.parametrize("completion", ["bundled", "none"])
    def test_depth_is_better_with_it(self, poor: EndoscopicSequence, completion: str) -> None:
        part, settings = poor.training_part(), DepthConfig(hypotheses=32, sources=3, completion=completion)
        plain = estimate_depth(part, settings)
        network = KnownDepth(true_training_depth(poor), 0.1)
        found = estimate_depth(part, settings, monocular=network)
        assert network.frame == len(part)
        assert absrel(poor, plain) > 0.15
        assert absrel(poor, found) < 0.8 * absrel(poor, plain)
        assert plain.report["monocular"] == []
        (fit,) = found.report["monocular"]
        assert fit["frames_aligned"] == len(part)
        assert 0.02 < fit["scatter"] < 0.3

    def test_one_that_knows_nothing_does_little_harm(self, poor: EndoscopicSequence) -> None:
        part, settings = poor.training_part(), DepthConfig(hypotheses=32, sources=3)
        shape = true_training_depth(poor).shape
        noise = np.random.default_rng(3).uniform(1, 4, shape).astype(np.float32)
        plain, found = (
            estimate_depth(part, settings, monocular=network) for network in (None, KnownDepth(noise, 0.0))
        )
        assert absrel(poor, found) < 1.1 * absrel(poor, plain)

    def test_predictions_come_at_the_size_of_stereo(self) -> None:
        depth = np.linspace(1, 2, 40 * 60, dtype=np.float32).reshape(1, 40, 60)
        found = predictions(KnownDepth(depth, 0.0), [torch.zeros(3, 40, 60)], (20, 30))
        assert found.shape == (1, 20, 30)
        assert found[0, 0, 0] > found[0, 10, 15] > found[0, -1, -1]
