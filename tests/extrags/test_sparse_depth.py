"""Depth interpolated between known pixels."""

from __future__ import annotations

import numpy as np

from extrags.sparse_depth import interpolated_depth, pixel_lattice


def test_a_slanted_plane_is_met_between_its_points() -> None:
    pixels = np.random.default_rng(0).uniform(0, 100, (60, 2))
    z = 1 / (0.01 + 1e-4 * pixels[:, 0])
    at = np.array([[[40.0, 50.0], [60.0, 45.0]]])
    found = interpolated_depth(pixels, z, at)
    assert found.shape == (1, 2)
    np.testing.assert_allclose(found, 1 / (0.01 + 1e-4 * at[..., 0]), rtol=1e-9)
    # Outside the hull it is that of the nearest.
    far = np.array([[-50.0, 50.0]])
    nearest = np.linalg.norm(pixels - far, axis=1).argmin()
    np.testing.assert_allclose(interpolated_depth(pixels, z, far), z[nearest])


def test_a_lattice_stays_inside_the_mask() -> None:
    mask = np.zeros((100, 160), dtype=bool)
    mask[20:80, 40:] = True
    lattice = pixel_lattice(mask)
    assert 200 < len(lattice) < 32 * 20
    column, row = np.floor(lattice).astype(int).T
    assert mask[row, column].all()
    assert len(pixel_lattice(np.ones((4, 6), dtype=bool))) == 24
