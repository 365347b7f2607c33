"""What a surface from estimated depth may be off, and what clearance makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from extrags.config import FreespaceConfig
from extrags.freespace import FREE, carve
from extrags.surface import fuse_surface
from extrags.surface_error import surface_error_mm
from tests.extrags.lit_tube import Tube

SMALL = FreespaceConfig(grid_size=24, render_width=32)


def test_measured_depth_has_no_error(tube: Tube) -> None:
    mesh = fuse_surface(tube.scene, tube.sequence.training_cameras)
    assert surface_error_mm(mesh, tube.sequence) is None
    assert surface_error_mm(mesh, replace(tube.sequence, depth_mm=None)) is None


def test_the_surest_view_vouches_and_disagreement_counts(tube: Tube) -> None:
    sequence = tube.sequence
    assert sequence.depth_mm is not None
    mesh = fuse_surface(tube.scene, sequence.training_cameras)
    error = np.full_like(sequence.depth_mm, 0.2)
    all_unsure = surface_error_mm(mesh, replace(sequence, depth_error=error))
    error[sequence.train[0]] = 0.02
    one_sure = surface_error_mm(mesh, replace(sequence, depth_error=error))
    elsewhere = surface_error_mm(mesh, replace(sequence, depth_mm=2 * sequence.depth_mm, depth_error=error))
    assert all_unsure is not None
    assert one_sure is not None
    assert elsewhere is not None
    assert all_unsure.shape == (len(mesh.vertices),)
    assert np.median(one_sure) < np.median(all_unsure)
    assert (one_sure <= all_unsure).mean() > 0.99
    # Behind all that was seen: nobody vouches for it, and it counts as no measured surface.
    nearer = replace(sequence, depth_mm=0.01 * sequence.depth_mm, depth_error=error)
    unseen = surface_error_mm(mesh, nearer)
    assert unseen is not None
    assert np.isinf(unseen).all()
    # Estimates twice as far as the mesh vouch for nothing nearer than their distance from it.
    assert np.median(elsewhere) > 3 * np.median(all_unsure)


def test_clearance_is_less_where_the_surface_is_unsure(tube: Tube) -> None:
    cameras = tube.sequence.training_cameras
    mesh = fuse_surface(tube.scene, cameras)
    sure = carve(tube.scene, mesh, cameras, SMALL)
    unsure = carve(tube.scene, mesh, cameras, SMALL, surface_error_mm=np.full(len(mesh.vertices), 1.5))
    np.testing.assert_array_equal(sure.occupancy, unsure.occupancy)
    free = sure.occupancy == FREE
    np.testing.assert_allclose(
        unsure.clearance[free],
        np.maximum(sure.clearance[free] - 1.5, 0),
        atol=1e-5 * float(sure.clearance.max()),
    )
    half = np.where(mesh.vertices[:, 0] > np.median(mesh.vertices[:, 0]), 1.5, 0.0)
    one_side = carve(tube.scene, mesh, cameras, SMALL, surface_error_mm=half)
    lost = (sure.clearance - one_side.clearance)[free]
    assert lost.max() == pytest.approx(1.5, abs=1e-4)
    assert (lost == 0).mean() > 0.2
