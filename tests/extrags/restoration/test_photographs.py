"""Frames as views to restore, and other colours for crops."""

from __future__ import annotations

import colorsys

import numpy as np
import pytest
import torch

from extrags.restoration.training_data.augmentation import CropSampler
from extrags.restoration.training_data.pairs import Pairs
from extrags.restoration.training_data.photographs import degraded_photograph, photograph_layers
from extrags.restoration.training_data.recoloring import Recoloring, hue_rotation
from extrags.view_synthesis.conditioning import condition
from extrags.view_synthesis.references import LightTransfer
from tests.extrags.restoration.conftest import Tube

SIDE_PX = 48


def photograph(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    rgb = torch.rand(1, 3, SIDE_PX, SIDE_PX, generator=generator)
    tissue = torch.ones(1, 1, SIDE_PX, SIDE_PX)
    tissue[..., :8] = 0
    return rgb, tissue


def test_the_base_image_of_a_photograph_is_the_photograph() -> None:
    rgb, tissue = photograph(0)
    layers = photograph_layers(rgb, tissue, depth_mm=20.0)
    base = condition(layers, LightTransfer(None, 1.0, 20.0)).base
    assert torch.allclose(base[..., 8:], rgb[..., 8:], atol=1e-5)


class TestDegraded:
    @pytest.mark.parametrize("seed", range(6))
    def test_what_stays_sharp_is_unchanged_and_more_certain(self, seed: int) -> None:
        rgb, tissue = photograph(seed)
        part = torch.zeros_like(tissue)
        part[..., 24:] = 1
        layers = degraded_photograph(rgb, tissue, part, depth_mm=20.0, generator=np.random.default_rng(seed))
        sharp, blurred = (..., slice(24, None)), (..., slice(8, 24))
        assert torch.equal(layers.get("rendered")[sharp], rgb[sharp])
        assert torch.equal(layers.get("uncertainty")[..., :8], torch.ones(1, 1, SIDE_PX, 8))
        unsure = layers.get("uncertainty")
        assert float(unsure[sharp].max()) <= 0.2
        if not torch.equal(layers.get("rendered")[blurred], rgb[blurred]):
            assert float(unsure[blurred].min()) >= float(unsure[sharp].max())
            # Less detail, the same brightness.
            assert layers.get("rendered")[blurred].std() < 0.8 * rgb[blurred].std()
            assert float(layers.get("rendered")[blurred].mean()) == pytest.approx(
                float(rgb[blurred].mean()), abs=0.05
            )

    def test_some_are_blurred_and_some_are_not(self) -> None:
        rgb, tissue = photograph(1)
        kept = [
            torch.equal(
                degraded_photograph(
                    rgb,
                    tissue,
                    torch.zeros_like(tissue),
                    depth_mm=20.0,
                    generator=np.random.default_rng(seed),
                ).get("rendered"),
                rgb * tissue,
            )
            for seed in range(20)
        ]
        assert 0 < sum(kept) < 20

    def test_real_views_show_nothing_from_beside_the_tissue(self) -> None:
        rgb, tissue = photograph(2)
        for seed in range(8):
            layers = degraded_photograph(
                rgb, tissue, tissue, depth_mm=20.0, generator=np.random.default_rng(seed)
            )
            for name in ("nearest", "blend"):
                outside = layers.get(f"{name}_weight") == 0
                assert bool(outside[..., :8].all())
                assert float((layers.get(name) * outside).abs().max()) == 0


class TestRecoloring:
    def test_grey_stays_grey(self) -> None:
        exact = Recoloring(torch.ones(1, 3, 1, 1))
        color = torch.tensor([0.5, 0.3, 0.2])[None, :, None, None]
        assert torch.equal(exact.applied(color), color)
        for seed in range(10):
            drawn = Recoloring.drawn(np.random.default_rng(seed), 1.0)
            assert drawn.mixing is not None
            assert torch.allclose(drawn.mixing @ torch.ones(3), torch.ones(3), atol=1e-6)
            turned = drawn.mixing @ color.flatten()
            assert float(turned.sum()) == pytest.approx(1.0, abs=1e-5)

    def test_a_third_of_the_circle_exchanges_channels(self) -> None:
        """Against the hue of the standard library."""
        turned = hue_rotation(2 * np.pi / 3) @ np.array([0.5, 0.3, 0.2])
        assert turned == pytest.approx([0.2, 0.5, 0.3], abs=1e-12)
        before, after = colorsys.rgb_to_hsv(0.5, 0.3, 0.2)[0], colorsys.rgb_to_hsv(*turned)[0]
        assert (after - before) % 1 == pytest.approx(1 / 3, abs=1e-12)

    def test_without_variety_it_is_the_gain_alone(self) -> None:
        """Trainings without it see the crops they always saw."""
        first, second = np.random.default_rng(5), np.random.default_rng(5)
        gain = np.exp(second.normal(0, 0.3) + second.normal(0, 0.1, 3)).astype(np.float32)
        drawn = Recoloring.drawn(first)
        assert np.array_equal(drawn.gain.flatten().numpy(), gain)
        assert drawn.mixing is None
        assert drawn.exponent == 1
        assert first.random() == second.random()

    def test_colours_stay_colours(self) -> None:
        image = torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(0))
        for seed in range(30):
            recolored = Recoloring.drawn(np.random.default_rng(seed), 1.0).applied(image)
            assert float(recolored.min()) >= 0
            assert float(recolored.max()) <= 1


def test_crops_are_photographs_as_often_as_asked_for(tube: Tube, tube_pairs: Pairs) -> None:
    frames = torch.rand(3, 3, *tube_pairs.size, generator=torch.Generator().manual_seed(0))
    valid = torch.ones(3, *tube_pairs.size, dtype=torch.bool)
    sampler = CropSampler(
        tube_pairs,
        tube.references.transfer,
        batch=40,
        crop_px=32,
        side_multiple=8,
        seed=0,
        frames=(frames, valid),
        color_variety=0.5,
        photograph_share=0.5,
    )
    batch = sampler.draw()
    # Of a photograph no depth is known; pairs of this scene have it nearly everywhere.
    unknown = (batch.depth_mm == 0).flatten(1).all(dim=1)
    assert 10 <= int(unknown.sum()) <= 30
    assert torch.isfinite(batch.conditioning.channels).all()
    assert batch.patches is None
