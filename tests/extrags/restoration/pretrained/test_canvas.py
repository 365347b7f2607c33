from __future__ import annotations

import numpy as np
import pytest

from extrags.restoration.pretrained.canvas import Canvas
from tests.extrags.restoration.pretrained.tiny_pipelines import moving_tube


@pytest.mark.parametrize(("multiple", "short_side_px"), [(8, 96), (16, 100), (32, 64), (64, 128)])
def test_sides_are_multiples_and_nothing_moves(multiple: int, short_side_px: int) -> None:
    images = moving_tube(2, 45, 64)
    canvas = Canvas.fitted(64, 45, short_side_px=short_side_px, multiple=multiple)
    placed = canvas.placed(images)
    assert placed.shape[1] % multiple == placed.shape[2] % multiple == 0
    assert placed.shape[1] >= short_side_px
    assert placed.min() >= 0
    assert placed.max() <= 1
    back = canvas.cut(placed)
    assert back.shape == images.shape
    assert np.abs(back - images).max() < 0.02


def test_aspect_is_kept_up_to_a_pixel() -> None:
    canvas = Canvas.fitted(225, 180, short_side_px=480, multiple=16)
    assert (canvas.inner_width, canvas.inner_height) == (600, 480)
    assert (canvas.outer_width, canvas.outer_height) == (608, 480)


def test_the_same_size_changes_nothing() -> None:
    images = moving_tube(1, 48, 64)
    canvas = Canvas.fitted(64, 48, short_side_px=48, multiple=16)
    assert np.array_equal(canvas.cut(canvas.placed(images)), images)


def test_a_mask_never_shrinks() -> None:
    mask = np.zeros((1, 45, 64), bool)
    mask[0, 20, 30] = True
    canvas = Canvas.fitted(64, 45, short_side_px=90, multiple=32)
    placed = canvas.placed_mask(mask)
    assert placed.sum() >= 4
    assert canvas.cut(placed[..., None].astype(np.float32))[0, 20, 30, 0] > 0.9


def test_stretched_fills_the_whole_size() -> None:
    canvas = Canvas.stretched(225, 180, 512, 320)
    assert canvas.placed(moving_tube(1, 180, 225)).shape == (1, 320, 512, 3)
