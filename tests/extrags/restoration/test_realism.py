from __future__ import annotations

import pytest
import torch

from extrags.metrics.lpips import Lpips
from extrags.restoration.benchmark.realism import Realism, rims


def left_half(views: int, side: int) -> torch.Tensor:
    return (torch.arange(side) < side // 2).expand(views, side, side).clone()


class TestRims:
    def test_width(self) -> None:
        hole = torch.zeros(1, 40, 320, dtype=torch.bool)
        hole[:, :, :100] = True
        mask = torch.ones_like(hole)
        mask[:, :5] = False
        found = rims(mask, hole)
        # Six pixels of 160 are twelve of 320.
        assert bool(found[:, 5:, 100:112].all())
        assert int(found.sum()) == 35 * 12

    def test_without_a_hole(self) -> None:
        mask = torch.ones(1, 8, 8, dtype=torch.bool)
        assert not bool(rims(mask, ~mask).any())


class TestRealism:
    def test_smooth_regions_lack_detail(self) -> None:
        generator = torch.Generator().manual_seed(3)
        photographs = torch.rand(2, 32, 32, 3, generator=generator)
        region = left_half(2, 32)
        realism = Realism(photographs, {"hole": region, "well": ~region}, None, torch.ones_like(region))
        smoothed = photographs.clone()
        smoothed[:, :, :16] = 0.5
        found = realism.figures(smoothed)
        assert found["frechet"] == {"hole": None, "well": None}
        assert found["detail"]["hole"][0] < 0.1
        assert found["detail"]["well"][0] == pytest.approx(1, abs=0.2)

    def test_the_same_textures_elsewhere_are_as_near(self, shared_data) -> None:
        lpips = Lpips.load(shared_data / "lpips_weights")
        generator = torch.Generator().manual_seed(4)
        photographs = torch.rand(6, 64, 64, 3, generator=generator)
        everywhere = torch.ones(6, 64, 64, dtype=torch.bool)
        realism = Realism(photographs, {"all": everywhere}, lpips, everywhere)
        moved, flat = photographs.roll(17, dims=1), torch.full_like(photographs, 0.5)
        near, far = (realism.figures(images)["frechet"]["all"] for images in (moved, flat))
        assert realism.figures(photographs)["frechet"]["all"] == pytest.approx(0, abs=1e-6 * far)
        assert near < 0.2 * far

    def test_what_lies_outside_the_mask_counts_nowhere(self, shared_data) -> None:
        lpips = Lpips.load(shared_data / "lpips_weights")
        generator = torch.Generator().manual_seed(5)
        valid = ~left_half(6, 64)
        # As an endoscope's round picture: black outside.
        photographs = torch.rand(6, 64, 64, 3, generator=generator) * valid[..., None]
        regions = {"valid": valid, "rim": valid & (torch.arange(64) < 40)}
        realism = Realism(photographs, regions, lpips, valid)
        filled = torch.where(valid[..., None], photographs, torch.full_like(photographs, 0.6))
        found = realism.figures(filled)
        assert found["detail"] == {name: pytest.approx([1, 1, 1], abs=1e-9) for name in regions}
        far = realism.figures(torch.full_like(photographs, 0.5))["frechet"]["valid"]
        assert found["frechet"]["valid"] == pytest.approx(0, abs=1e-5 * far)
        # And the edge is no detail: half of the energy inside is half, at the rim too.
        weaker = realism.figures((photographs - 0.5) * 0.5**0.5 + 0.5)
        assert weaker["detail"]["rim"] == pytest.approx([0.5, 0.5, 0.5], rel=0.02)
