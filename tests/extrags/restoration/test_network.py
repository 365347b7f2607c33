"""The network of the embedded restorer, and its training."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from extrags.errors import DivergedError
from extrags.restoration.diffusion.network import build_network
from extrags.restoration.diffusion.network_training import (
    TrainingSettings,
    restoration_loss,
    train_network,
)
from extrags.restoration.diffusion.rectified_flow import Predicted, sample
from extrags.restoration.training_data.augmentation import Batch
from extrags.view_synthesis.conditioning import CONDITION_CHANNELS, Conditioning

WIDTHS = (16, 24, 32)
PLAIN = TrainingSettings(1, 1e-3, False)


def _conditioning(n: int, height: int, width: int, seed: int = 0) -> Conditioning:
    generator = torch.Generator().manual_seed(seed)
    channels = torch.randn(n, CONDITION_CHANNELS, height, width, generator=generator)
    depth = 10 + 20 * torch.rand(n, 1, height, width, generator=generator)
    return Conditioning(channels, torch.rand(n, 3, height, width, generator=generator), depth)


class TestNetwork:
    def test_untrained_it_returns_the_base(self) -> None:
        network = build_network(CONDITION_CHANNELS, WIDTHS, torch.Generator().manual_seed(1))
        conditioning = _conditioning(2, 40, 24)
        noise = torch.randn(2, 3, 40, 24, generator=torch.Generator().manual_seed(2))
        restored = sample(network, conditioning, noise, steps=1, half_precision=False)
        torch.testing.assert_close(restored.rgb, conditioning.base, atol=1e-5, rtol=0)
        torch.testing.assert_close(restored.depth_mm, conditioning.depth_mm, atol=0, rtol=1e-5)

    def test_narrow_views_are_restored_in_half_precision(self) -> None:
        """Eight pixels are one where the network is coarsest."""
        network = build_network(CONDITION_CHANNELS, (48, 96, 160), torch.Generator().manual_seed(1))
        generator = torch.Generator().manual_seed(4)
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.add_(0.02 * torch.randn(parameter.shape, generator=generator))
        noise = torch.randn(1, 3, 320, 7, generator=generator)
        exact, half = (
            sample(network, _conditioning(1, 320, 7), noise, steps=1, half_precision=half_precision)
            for half_precision in (False, True)
        )
        assert float((half.rgb - exact.rgb).abs().max()) < 0.05
        assert float((half.depth_mm / exact.depth_mm).log().abs().max()) < 0.05

    @pytest.mark.parametrize(("height", "width"), [(32, 32), (33, 47)])
    def test_any_size(self, height: int, width: int) -> None:
        network = build_network(CONDITION_CHANNELS, WIDTHS, torch.Generator().manual_seed(1))
        torch.nn.init.normal_(network.exit.weight, std=0.1, generator=torch.Generator().manual_seed(3))
        noise = torch.zeros(1, 3, height, width)
        restored = sample(network, _conditioning(1, height, width), noise, steps=2, half_precision=False)
        assert restored.rgb.shape == (1, 3, height, width)
        assert restored.rgb.min() >= 0
        assert restored.rgb.max() <= 1
        assert restored.depth_mm.shape == restored.error.shape == (1, 1, height, width)

    def test_weights_come_from_the_generator_alone(self) -> None:
        torch.manual_seed(11)
        before = torch.random.get_rng_state()
        first = build_network(CONDITION_CHANNELS, WIDTHS, torch.Generator().manual_seed(7))
        assert torch.equal(before, torch.random.get_rng_state())
        second = build_network(CONDITION_CHANNELS, WIDTHS, torch.Generator().manual_seed(7))
        for one, two in zip(first.state_dict().values(), second.state_dict().values(), strict=True):
            assert torch.equal(one, two)


class TestTraining:
    def test_overfits_three_pairs(self) -> None:
        conditioning = _conditioning(3, 32, 32)
        clean = torch.rand(3, 3, 4, 4, generator=torch.Generator().manual_seed(5))
        clean = torch.nn.functional.interpolate(clean, size=(32, 32), mode="bilinear")
        far = torch.full((3, 1, 32, 32), 30.0)
        batch = Batch(conditioning, clean, torch.ones(3, 1, 32, 32), far, torch.zeros(3, 1, 32, 32))
        network = build_network(CONDITION_CHANNELS, WIDTHS, torch.Generator().manual_seed(1))
        noise = torch.randn(3, 3, 32, 32, generator=torch.Generator().manual_seed(9))

        def errors() -> tuple[float, float, float]:
            restored = sample(network, conditioning, noise, steps=1, half_precision=False)
            color = (restored.rgb - clean).abs().mean()
            depth = (restored.depth_mm.log() - far.log()).abs().mean()
            return float(color), float(depth), float((restored.error.mean() / color).log().abs())

        before = errors()
        generator = torch.Generator().manual_seed(2)
        train_network(network, lambda: batch, TrainingSettings(150, 4e-3, False), generator)
        color, depth, predicted_error = errors()
        assert color < 0.4 * before[0]
        assert depth < 0.85 * before[1]
        # The expected error follows the true one down.
        assert predicted_error < 0.7 < before[2]

    def test_a_diverging_loss_is_named(self) -> None:
        conditioning = _conditioning(1, 32, 32)
        broken = Conditioning(conditioning.channels, conditioning.base * torch.nan, conditioning.depth_mm)
        weight = torch.ones(1, 1, 32, 32)
        batch = Batch(broken, conditioning.base, weight, conditioning.depth_mm, torch.zeros_like(weight))
        network = build_network(CONDITION_CHANNELS, WIDTHS, torch.Generator().manual_seed(1))
        with pytest.raises(DivergedError, match="iteration 0"):
            train_network(network, lambda: batch, TrainingSettings(3, 1e-3, False), torch.Generator())

    def test_pixels_without_weight_do_not_count(self) -> None:
        clean = torch.full((1, 3, 16, 16), 0.5)
        wrong = clean.clone()
        wrong[..., :4] = 1
        weight = torch.ones(1, 1, 16, 16)
        weight[..., :10] = 0
        depth = torch.full((1, 1, 16, 16), 20.0)
        batch = Batch(_conditioning(1, 16, 16), clean, weight, depth, torch.zeros_like(weight))
        predicted = Predicted(wrong, depth.log(), torch.zeros(1, 1, 16, 16))
        assert restoration_loss(predicted, batch, PLAIN) < 1e-2

    def test_unknown_depth_does_not_count(self) -> None:
        clean = torch.full((1, 3, 16, 16), 0.5)
        depth = torch.full((1, 1, 16, 16), 20.0)
        depth[..., :8] = 0
        wrong = torch.full((1, 1, 16, 16), 20.0)
        wrong[..., :8] = 1e3
        batch = Batch(
            _conditioning(1, 16, 16), clean, torch.ones(1, 1, 16, 16), depth, torch.zeros(1, 1, 16, 16)
        )
        predicted_error = torch.zeros(1, 1, 16, 16)
        assert restoration_loss(Predicted(clean, wrong.log(), predicted_error), batch, PLAIN) < 1e-2
        assert restoration_loss(Predicted(clean, wrong.log() + 0.5, predicted_error), batch, PLAIN) > 0.02

    def test_the_expected_error_is_cheapest_when_true(self) -> None:
        clean = torch.full((1, 3, 16, 16), 0.5)
        nothing = torch.zeros(1, 1, 16, 16)
        batch = Batch(_conditioning(1, 16, 16), clean, torch.ones(1, 1, 16, 16), nothing, nothing)
        costs = [
            float(
                restoration_loss(
                    Predicted(
                        clean + 0.1, torch.zeros(1, 1, 16, 16), torch.full((1, 1, 16, 16), expected).log()
                    ),
                    batch,
                    PLAIN,
                )
            )
            for expected in (0.05, 0.08, 0.1, 0.125, 0.2)
        ]
        assert int(np.argmin(costs)) == 2
