"""A guess of intrinsics follows the round picture inside the frame."""

from __future__ import annotations

import numpy as np
import pytest

from data_catalog.guessed_intrinsics import fitted_to_picture, intrinsics_of_field_of_view

WIDTH, HEIGHT = 200, 150


def disc(x: float, y: float, radius: float) -> np.ndarray:
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return np.tile(np.hypot(u - x, v - y) < radius, (3, 1, 1))


def lit(mask: np.ndarray) -> np.ndarray:
    """Frames that are bright where a mask is true, and black elsewhere."""
    return np.repeat(mask[..., None] * np.uint8(150), 3, axis=-1)


def fitted(K: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return fitted_to_picture(K, mask, lit(mask))


@pytest.fixture
def guess() -> np.ndarray:
    return np.tile(intrinsics_of_field_of_view(90.0, WIDTH, HEIGHT), (3, 1, 1))


def test_a_round_picture_has_its_own_centre_and_field_of_view(guess) -> None:
    found = fitted(guess, disc(112, 70, 60))
    np.testing.assert_allclose(found[:, :2, 2], np.tile([112.0, 70.0], (3, 1)), atol=1.0)
    # 90 degrees over the circle.
    np.testing.assert_allclose(found[:, 0, 0], 60, atol=1.0)
    np.testing.assert_array_equal(found[:, 0, 0], found[:, 1, 1])


def test_pixels_need_not_be_square(guess) -> None:
    # Twice as wide as high: the rim is an ellipse in pixels.
    guess[:, 1, 1] *= 2
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    seen = np.tile(np.hypot(u - 104, (v - 80) / 2) < 32, (3, 1, 1))
    found = fitted(guess, seen)
    np.testing.assert_allclose(found[:, :2, 2], np.tile([104.0, 80.0], (3, 1)), atol=1.5)
    np.testing.assert_allclose(found[:, 0, 0], 32, atol=1.0)
    np.testing.assert_allclose(found[:, 1, 1], 2 * found[:, 0, 0])


def test_a_whole_image_stays_as_it_is(guess) -> None:
    np.testing.assert_array_equal(fitted(guess, np.ones((3, HEIGHT, WIDTH), bool)), guess)


def test_a_circle_far_off_is_no_lens(guess) -> None:
    np.testing.assert_array_equal(fitted(guess, disc(40, 75, 70)), guess)


def test_a_wider_circle_moves_the_centre_alone(guess) -> None:
    found = fitted(guess, disc(96, 78, 105))
    assert found[0, 0, 0] == guess[0, 0, 0]
    np.testing.assert_allclose(found[0, :2, 2], [96, 78], atol=1.5)


def box(columns: slice, rows: slice) -> np.ndarray:
    mask = np.zeros((3, HEIGHT, WIDTH), bool)
    mask[:, rows, columns] = True
    return mask


def octagon(left: int, top: int, size: int, cut: int) -> np.ndarray:
    v, u = np.mgrid[:HEIGHT, :WIDTH] - np.array([top, left])[:, None, None]
    mirrored_u, mirrored_v = np.minimum(u, size - 1 - u), np.minimum(v, size - 1 - v)
    return np.tile((mirrored_u >= 0) & (mirrored_v >= 0) & (mirrored_u + mirrored_v >= cut), (3, 1, 1))


class TestBesideAPanel:
    """Recorders put the picture at one side of the frame."""

    @pytest.mark.parametrize(
        ("mask", "center", "width"),
        [
            (box(slice(90, 190), slice(20, 100)), (140, 60), 100),
            (octagon(92, 20, 100, 24), (142, 70), 100),
            (box(slice(80, WIDTH), slice(0, HEIGHT)), (140, 75), 120),
            (disc(148, 75, 46), (148, 75), 92),
            # Cut off above and below, at the right border of the frame.
            (disc(145, 75, 54) & box(slice(0, WIDTH), slice(25, 125)), (145, 75), 108),
            # Cut off by the frame, above more than below.
            (disc(145, 45, 50), (145, 45), 100),
        ],
        ids=[
            "rectangle",
            "octagon",
            "to the border",
            "circle",
            "cut circle",
            "cut above",
        ],
    )
    def test_the_picture_is_the_lens(self, guess, mask, center, width) -> None:
        found = fitted(guess, mask)
        np.testing.assert_allclose(found[0, :2, 2], center, atol=1.5)
        np.testing.assert_allclose(found[:, 0, 0], width / 2, atol=1.0)
        np.testing.assert_array_equal(found[:, 0, 0], found[:, 1, 1])

    def test_text_in_the_picture_does_not_matter(self, guess) -> None:
        mask = box(slice(90, 190), slice(20, 100))
        mask[:, 88:94, 100:130] = False
        np.testing.assert_array_equal(fitted(guess, mask)[0, :2, 2], [140, 60])

    @pytest.mark.parametrize(
        "mask",
        [
            octagon(0, -25, 200, 80),
            # An instrument, or lumen that no frame has lit.
            np.ones((3, HEIGHT, WIDTH), bool) & ~disc(0, 75, 60),
            np.triu(np.ones((3, HEIGHT, WIDTH), bool), 60),
        ],
        ids=["dark corners", "dark bite", "dark half"],
    )
    def test_a_dark_part_of_the_picture_is_no_surround(self, guess, mask) -> None:
        np.testing.assert_array_equal(fitted(guess, mask), guess)

    def test_a_mask_drawn_on_a_lit_picture_is_no_surround(self, guess) -> None:
        rgb = np.full((3, HEIGHT, WIDTH, 3), 150, np.uint8)
        mask = box(slice(90, 190), slice(20, 100))
        np.testing.assert_array_equal(fitted_to_picture(guess, mask, rgb), guess)

    def test_light_that_fades_has_no_rim(self, guess) -> None:
        # All that is 14 or brighter, as masks of videos are found.
        bright = 200 * np.exp(-(((np.arange(WIDTH) - 140) / 40) ** 2))
        rgb = np.broadcast_to(bright.astype(np.uint8)[None, None, :, None], (3, HEIGHT, WIDTH, 3))
        mask = rgb.max(axis=-1) >= 14
        np.testing.assert_array_equal(fitted_to_picture(guess, mask, np.ascontiguousarray(rgb)), guess)
