"""Tests of the bounds on the hue of restored images."""

from __future__ import annotations

import pytest
import torch

from extrags.view_synthesis import gamut
from extrags.view_synthesis.gamut import Gamut


class TestOfImages:
    @pytest.mark.parametrize("samples", [500, 300, 7])
    def test_the_last_frames_count_as_the_first_do(
        self, monkeypatch: pytest.MonkeyPatch, samples: int
    ) -> None:
        """Also where there are nearly twice as many pixels as are looked at."""
        monkeypatch.setattr(gamut, "MAX_SAMPLES", samples)
        frames = torch.full((4, 3, 9, 27), 0.8)
        frames[:3, 1], frames[:3, 2] = 0.3, 0.2
        frames[3, 1], frames[3, 2] = 0.6, 0.5
        found = Gamut.of_images(frames, torch.ones(4, 1, 9, 27))
        assert found.green_low == pytest.approx(0.3 / 0.8)
        assert found.blue_low == pytest.approx(0.2 / 0.8)
        assert found.green_high == pytest.approx(0.6 / 0.8, abs=0.02)
        assert found.blue_high == pytest.approx(0.5 / 0.8, abs=0.02)

    def test_every_pixel_of_a_few_counts(self) -> None:
        generator = torch.Generator().manual_seed(0)
        frames = torch.rand(3, 3, 8, 11, generator=generator) * 0.8 + 0.2
        weight = (torch.rand(3, 1, 8, 11, generator=generator) > 0.3).float()
        pixels = frames.permute(0, 2, 3, 1)[weight[:, 0] > 0]
        ends = torch.tensor([gamut.TAIL, 1 - gamut.TAIL])
        green, blue = (torch.quantile(pixels[:, i] / pixels[:, 0], ends) for i in (1, 2))
        expected = Gamut(*(float(value) for value in (*green, *blue)))
        assert Gamut.of_images(frames, weight) == expected

    def test_pixels_are_counted_through_all_frames(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Every third of all is looked at: the first of one frame, the second of the next."""
        monkeypatch.setattr(gamut, "MAX_SAMPLES", 2)
        frames = torch.full((3, 3, 1, 2), 0.5)
        frames[0, 1, 0, 0], frames[1, 1, 0, 1] = 0.2, 0.3
        found = Gamut.of_images(frames, torch.ones(3, 1, 1, 2))
        assert found.green_low == pytest.approx(0.4, abs=0.01)
        assert found.green_high == pytest.approx(0.6, abs=0.01)

    def test_small_frames_are_left_out_as_pixels_of_large_ones_are(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(gamut, "MAX_SAMPLES", 10)
        frames = torch.full((40, 3, 1, 1), 0.8)
        frames[:, 1] = torch.linspace(0.2, 0.6, 40)[:, None, None]
        weight = torch.ones(40, 1, 1, 1)
        assert Gamut.of_images(frames, weight) == Gamut.of_images(frames[::4], weight[::4])

    def test_frames_are_made_one_at_a_time(self) -> None:
        frames = torch.rand(3, 3, 8, 11, generator=torch.Generator().manual_seed(0))
        weight = torch.ones(3, 1, 8, 11)
        asked: list[int] = []

        def frame(index: int) -> gamut.Frame:
            asked.append(index)
            return frames[index], weight[index]

        assert Gamut.of_frames(frame, 3) == Gamut.of_images(frames, weight)
        assert asked == [0, 1, 2] * 2


class TestBounded:
    BOUNDS = Gamut(0.3, 0.5, 0.2, 0.4)

    def test_the_hue_is_within_bounds_and_brightness_never_rises(self) -> None:
        image = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(2))
        found = self.BOUNDS.bounded(image)
        assert float(found.min()) >= 0
        assert float(found.max()) <= 1
        lit = image.mean(dim=1) > 0.05
        for channel, low, high in ((1, 0.3, 0.5), (2, 0.2, 0.4)):
            ratio = (found[:, channel] / found[:, 0].clamp_min(1e-3))[lit]
            assert float(ratio.min()) > low - 0.03
            assert float(ratio.max()) < high + 0.03
        before, after = image.mean(dim=1), found.mean(dim=1)
        assert bool((after <= before + 1e-5).all())
        # What is darker than it was is as bright as its hue can be.
        torch.testing.assert_close(found.amax(dim=1)[after < before - 1e-3].min().item(), 1.0)

    def test_a_bright_pixel_is_darkened_as_a_whole(self) -> None:
        found = self.BOUNDS.bounded(torch.tensor([0.9, 0.9, 0.9]).reshape(1, 3, 1, 1)).flatten()
        torch.testing.assert_close(found, torch.tensor([1.0, 0.5, 0.4]))

    def test_what_is_within_bounds_stays_to_the_last_bit(self) -> None:
        shade = torch.rand(1, 1, 16, 16, generator=torch.Generator().manual_seed(4))
        image = shade * torch.tensor([1.0, 0.4, 0.3])[None, :, None, None]
        assert torch.equal(self.BOUNDS.bounded(image), image)
