from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from extrags.errors import ShapeError
from extrags.metrics.detail import BANDS_PX, band_energies, detail_ratios


def wave(period_px: float, amplitude: float = 0.2) -> Tensor:
    x = torch.arange(96, dtype=torch.float64)
    row = 0.5 + amplitude * torch.sin(2 * math.pi * x / period_px)
    return row.expand(1, 96, 96)[..., None].expand(-1, -1, -1, 3)


INNER = torch.zeros(1, 96, 96, dtype=torch.bool)
INNER[:, 24:72, 24:72] = True


class TestBandEnergies:
    @pytest.mark.parametrize(("period_px", "band"), [(2.5, 0), (8, 1), (16, 2)])
    def test_a_wave_lies_in_the_band_of_its_length(self, period_px: float, band: int) -> None:
        energies = band_energies(wave(period_px), INNER)
        assert energies is not None
        assert len(energies) == len(BANDS_PX)
        assert max(range(len(energies)), key=energies.__getitem__) == band

    def test_the_finest_wave_has_the_energy_of_a_sine(self) -> None:
        energies = band_energies(wave(2.5), INNER)
        assert energies is not None
        # What a Gaussian of one pixel leaves of it: exp(-(2 pi / 2.5)^2 / 2).
        left = 1 - math.exp(-((2 * math.pi / 2.5) ** 2) / 2)
        assert energies[0] == pytest.approx(left**2 * 0.2**2 / 2, rel=0.05)

    def test_an_empty_region_has_none(self) -> None:
        assert band_energies(wave(4), torch.zeros_like(INNER)) is None

    def test_sizes_are_checked(self) -> None:
        with pytest.raises(ShapeError, match="do not fit"):
            band_energies(wave(4), INNER[:, :50])


class TestDetailRatios:
    def test_half_the_amplitude_is_a_quarter_of_the_energy(self) -> None:
        found = detail_ratios(wave(3, 0.1), wave(3, 0.2), INNER)
        assert found is not None
        assert found[0] == pytest.approx(0.25, rel=1e-3)
