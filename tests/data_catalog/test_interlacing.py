"""Pictures woven from two moments: found, and taken apart."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from data_catalog.interlacing import deinterlaced, is_combed, is_interlaced
from tests.data_catalog.footage_fixture import interlaced
from tests.data_catalog.test_content import moving_scene


class TestFound:
    @pytest.mark.parametrize("speed", [3, 8])
    def test_woven_pictures(self, speed) -> None:
        scene = moving_scene(8, 320, 240, speed=speed)
        assert all(is_combed(image) for image in interlaced(scene))
        assert not any(is_combed(image) for image in scene)

    def test_noise_and_stripes_are_no_combs(self) -> None:
        rng = np.random.default_rng(0)
        noisy = moving_scene(1, 320, 240)[0] + rng.normal(0, 15, (240, 320, 3))
        assert not is_combed(np.clip(noisy, 0, 255).astype(np.uint8))
        stripes = np.repeat((128 + 100 * np.sin(np.arange(240)))[:, None, None], 320, axis=1)
        assert not is_combed(np.repeat(stripes, 3, axis=2).astype(np.uint8))

    def test_what_was_shrunk_is_not_woven(self) -> None:
        assert not is_combed(interlaced(moving_scene(2, 320, 180, speed=8))[0])

    def test_real_pictures(self, shared_data) -> None:
        files = sorted((shared_data / "laparoscopy_frames_40").glob("*.jpg"))[::10]
        for file in files:
            image = np.array(Image.open(file))
            assert not is_combed(image), file.name
            woven = image.copy()
            woven[1::2] = np.roll(image, 6, axis=1)[1::2]
            assert is_combed(woven), file.name

    def test_of_a_recording(self) -> None:
        assert is_interlaced([False] * 9 + [True])
        assert not is_interlaced([False] * 20 + [True])
        assert not is_interlaced([])


class TestTakenApart:
    @pytest.mark.parametrize("height", [240, 241])
    def test_one_moment_is_left(self, height) -> None:
        scene = moving_scene(2, 320, height, speed=8)
        found = deinterlaced(interlaced(scene)[0])
        assert found.shape == scene[0].shape
        np.testing.assert_array_equal(found[::2], scene[0][::2])
        assert np.abs(found.astype(int) - scene[0]).mean() < 3
        assert not is_combed(found)

    def test_no_line_moves(self) -> None:
        """A slope stays the slope it was, but for its last lines."""
        slope = np.repeat(np.arange(0, 240, dtype=np.uint8)[:, None, None], 16, axis=1).repeat(3, axis=2)
        np.testing.assert_array_equal(deinterlaced(slope)[2:-4], slope[2:-4])
