"""Which pixels of training views show tissue, at other sizes and through a lens."""

from __future__ import annotations

import numpy as np
import pytest

from extrags.cameras import Cameras, pixel_rays, project_points
from extrags.errors import ShapeError
from extrags.radial_lens import RadialLens
from extrags.shown_pixels import chosen_masks, shown_pixels

WIDTH, HEIGHT = 64, 48


def cameras(count: int = 2, lens: RadialLens | None = None) -> Cameras:
    K = np.array([[40.0, 0, WIDTH / 2], [0, 40.0, HEIGHT / 2], [0, 0, 1]])
    poses = np.tile(np.eye(4), (count, 1, 1))
    return Cameras(np.tile(K, (count, 1, 1)), poses, WIDTH, HEIGHT, lens)


def disc(radius_px: float) -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return np.asarray(np.hypot(y - HEIGHT / 2, x - WIDTH / 2) < radius_px)


def test_at_their_own_size_they_are_the_masks() -> None:
    masks = [disc(20), disc(15)]
    np.testing.assert_array_equal(shown_pixels(masks, cameras(), cameras()), masks)
    assert shown_pixels(None, cameras(), cameras()).all()


def test_a_smaller_pixel_is_shown_where_all_of_its_area_is() -> None:
    mask = disc(20)
    found = shown_pixels([mask, mask], cameras(), cameras().resized(WIDTH // 4, HEIGHT // 4))
    blocks = mask.reshape(HEIGHT // 4, 4, WIDTH // 4, 4).all(axis=(1, 3))
    np.testing.assert_array_equal(found[0], blocks)
    # In a speckled mask no such pixel is left: then those with some.
    speckled = np.indices((HEIGHT, WIDTH)).sum(axis=0) % 2 == 0
    assert shown_pixels([speckled], cameras(1), cameras(1).resized(16, 12)).all()


def test_pinholes_in_place_of_a_lens_show_what_the_lens_does() -> None:
    lens = RadialLens((-0.05, 0.0, 0.0, 0.0), float(np.radians(70)))
    given = cameras(1, lens)
    views = given.as_pinholes(100.0)
    mask = disc(18) & given.field[0]
    (found,) = shown_pixels([mask], given, views)
    pixels = project_points(pixel_rays(views)[0], given.K[0], lens)
    # The disc round the optical axis stays one: its edge lies where the lens puts its radius.
    radius = np.hypot(pixels[..., 0] - WIDTH / 2, pixels[..., 1] - HEIGHT / 2)
    assert found[radius < 17].all()
    assert not found[radius > 19].any()
    assert 0 < found.mean() < 1
    # Without a mask, what lies beyond the image of the lens is not shown either.
    inside = given.contains(pixels)
    np.testing.assert_array_equal(shown_pixels(None, given, views)[0], inside)


def test_a_lens_ends_where_its_field_does() -> None:
    lens = RadialLens((-0.05, 0.0, 0.0, 0.0), float(np.radians(25)))
    given = cameras(1, lens)
    assert not given.field.all()
    np.testing.assert_array_equal(shown_pixels(None, given, given), given.field)
    np.testing.assert_array_equal(shown_pixels([disc(30)], given, given)[0], given.field[0] & disc(30))


@pytest.mark.usefixtures("unchecked")
def test_masks_of_other_views_are_refused() -> None:
    with pytest.raises(ShapeError, match="1 masks for 2 cameras"):
        shown_pixels([disc(20)], cameras(), cameras())
    with pytest.raises(ShapeError, match="1 views for 2 cameras"):
        shown_pixels(None, cameras(), cameras(1))
    with pytest.raises(ShapeError, match="mask 1 is 32x48, its camera 64x48"):
        shown_pixels([disc(20), disc(20)[:, ::2]], cameras(), cameras())


def test_the_masks_of_some() -> None:
    masks = [disc(20), disc(15), disc(10)]
    chosen = chosen_masks(masks, cameras(3), np.array([2, 0]))
    assert chosen is not None
    assert [mask is masks[index] for mask, index in zip(chosen, (2, 0), strict=True)] == [True, True]
    assert chosen_masks(None, cameras(), [0, 1]) is None
    with pytest.raises(ShapeError, match="3 masks for 2 cameras"):
        chosen_masks(masks, cameras(), [0])
