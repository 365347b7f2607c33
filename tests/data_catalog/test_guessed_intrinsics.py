"""A guess of intrinsics follows the round picture inside the frame."""

from __future__ import annotations

import numpy as np
import pytest

from data_catalog.guessed_intrinsics import fitted_to_picture, intrinsics_of_field_of_view

WIDTH, HEIGHT = 200, 150


def disc(x: float, y: float, radius: float) -> np.ndarray:
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return np.tile(np.hypot(u - x, v - y) < radius, (3, 1, 1))


@pytest.fixture
def guess() -> np.ndarray:
    return np.tile(intrinsics_of_field_of_view(90.0, WIDTH, HEIGHT), (3, 1, 1))


def test_a_round_picture_has_its_own_centre_and_field_of_view(guess) -> None:
    found = fitted_to_picture(guess, disc(112, 70, 60))
    np.testing.assert_allclose(found[:, :2, 2], np.tile([112.0, 70.0], (3, 1)), atol=1.0)
    # 90 degrees over the circle.
    np.testing.assert_allclose(found[:, 0, 0], 60, atol=1.0)
    np.testing.assert_array_equal(found[:, 0, 0], found[:, 1, 1])


def test_pixels_need_not_be_square(guess) -> None:
    # Twice as wide as high: the rim is an ellipse in pixels.
    guess[:, 1, 1] *= 2
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    seen = np.tile(np.hypot(u - 104, (v - 80) / 2) < 32, (3, 1, 1))
    found = fitted_to_picture(guess, seen)
    np.testing.assert_allclose(found[:, :2, 2], np.tile([104.0, 80.0], (3, 1)), atol=1.5)
    np.testing.assert_allclose(found[:, 0, 0], 32, atol=1.0)
    np.testing.assert_allclose(found[:, 1, 1], 2 * found[:, 0, 0])


def test_a_whole_image_stays_as_it_is(guess) -> None:
    np.testing.assert_array_equal(fitted_to_picture(guess, np.ones((3, HEIGHT, WIDTH), bool)), guess)


def test_a_circle_far_off_is_no_lens(guess) -> None:
    np.testing.assert_array_equal(fitted_to_picture(guess, disc(40, 75, 70)), guess)


def test_a_wider_circle_moves_the_centre_alone(guess) -> None:
    found = fitted_to_picture(guess, disc(96, 78, 105))
    assert found[0, 0, 0] == guess[0, 0, 0]
    np.testing.assert_allclose(found[0, :2, 2], [96, 78], atol=1.5)
