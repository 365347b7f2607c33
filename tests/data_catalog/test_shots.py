"""Cuts: what ends a shot, and what does not."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest
from PIL import Image

from data_catalog.shots import ShotFinder, followed_share
from tests.data_catalog.test_content import in_a_circle, moving_scene, rim

SIZE = (192, 108)


def grey(scene: np.ndarray) -> list[np.ndarray]:
    return [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in scene]


def found(frames: list[np.ndarray]) -> ShotFinder:
    finder = ShotFinder()
    for frame in frames:
        finder.see(frame)
    return finder


@pytest.fixture(scope="module")
def first() -> list[np.ndarray]:
    return grey(moving_scene(12, *SIZE, speed=3))


@pytest.fixture(scope="module")
def second() -> list[np.ndarray]:
    return grey(255 - moving_scene(12, *SIZE, speed=3)[:, ::-1])


class TestShotFinder:
    def test_a_cut(self, first, second) -> None:
        assert found(first + second).shots == [0] * 12 + [1] * 12

    def test_a_cut_inside_the_same_round_picture(self) -> None:
        """The dark frame is the same on both sides."""
        circle = rim(96, 54, 50)
        scenes = [moving_scene(6, *SIZE, speed=3), 255 - moving_scene(6, *SIZE, speed=3)[:, ::-1]]
        frames = [frame for scene in scenes for frame in grey(in_a_circle(scene, circle))]
        assert found(frames).shots == [0] * 6 + [1] * 6

    @pytest.mark.parametrize("level", [0, 250])
    def test_a_flash_or_a_gap_ends_nothing(self, first, level) -> None:
        finder = found([*first[:5], *([np.full_like(first[0], level)] * 3), *first[8:]])
        assert finder.shots == [0] * 12
        assert finder.glitches == [5, 6, 7]

    def test_two_cuts_within_a_glitch_s_length(self, first, second) -> None:
        assert found([*first[:6], *second[:3], *first[8:]]).shots == [0] * 13
        black = [np.zeros_like(first[0])] * 3
        assert found([*first[:6], *black, *second]).shots == [0] * 6 + [1] * 3 + [2] * 12

    def test_dimming_ends_nothing(self, first) -> None:
        frames = [(frame * (1 - 0.06 * k)).astype(np.uint8) for k, frame in enumerate(first)]
        assert found(frames).shots == [0] * 12

    @pytest.mark.parametrize("speed", [0, 10, 20])
    def test_a_move_ends_nothing(self, speed) -> None:
        assert found(grey(moving_scene(6, *SIZE, speed=speed))).shots == [0] * 6


def test_flat_pictures() -> None:
    """Of 640 x 32 pixels the survey sees 192 x 16, of which OpenCV's flow ends the process."""
    frames = grey(moving_scene(6, 192, 18, speed=3))
    assert set(found([frame[:16].copy() for frame in frames]).shots) == {0}


def test_real_pictures(shared_data) -> None:
    """Neighbouring frames of a sinus, and frames of different operations."""
    folders = ("sinus_hopkins", "laparoscopy_frames_40")
    files = [sorted((shared_data / folder).rglob("*.jpg")) for folder in folders]
    small = [
        [np.array(Image.open(file).convert("L").resize(SIZE, Image.Resampling.BOX)) for file in listed]
        for listed in (files[0][:6], files[1][::6])
    ]
    together, apart = ([followed_share(one, other) for one, other in pairwise(s)] for s in small)
    assert min(together) > 0.8
    assert max(apart) < 0.2
