"""The free space of the page."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from extrags.errors import SourceError
from extrags.freespace import FreeSpace
from extrags.report import ReportInputs
from extrags.report.viewer import viewer_content
from extrags.report.viewer.free_space import FREE_LEVELS, decoded_free_space, encoded_free_space


@pytest.fixture(scope="module")
def grid() -> FreeSpace:
    """A ball of free space with a wall round one half of it, in a turned grid."""
    place = np.stack(np.meshgrid(*[np.arange(20) + 0.5] * 3, indexing="ij"), -1)
    radius = np.linalg.norm(place - [9, 10, 11], axis=-1)
    occupancy = np.select([radius < 5, (radius < 7) & (place[..., 0] < 9)], [0, 1], 2).astype(np.uint8)
    axes = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    return FreeSpace(occupancy, np.array([3.0, -1, 2]), axes, 0.5, (0.5 * (5 - radius)).astype(np.float32))


def test_states_and_clearance_come_back(grid: FreeSpace) -> None:
    encoded = encoded_free_space(grid, "mm")
    occupancy, clearance = decoded_free_space(encoded)
    box = FreeSpace(
        np.pad(occupancy, [(0, max(occupancy.shape) - side) for side in occupancy.shape], constant_values=2),
        np.array(encoded["origin"]), np.array(encoded["axes"]), encoded["voxel"],
        np.zeros([max(occupancy.shape)] * 3, dtype=np.float32),
    )  # fmt: skip
    free = grid.occupancy == 0
    assert (occupancy == 0).sum() == free.sum()
    near = grid.voxel_centers()[np.isin(grid.occupancy, [0, 1]).ravel()]
    inside = ((box.to_grid(near) > 0) & (box.to_grid(near) < occupancy.shape)).all(1)
    assert (box.lookup(near[inside]) == grid.lookup(near[inside])).all()
    step = encoded["largest"] / (FREE_LEVELS - 1)
    assert np.abs(clearance[occupancy == 0] - grid.clearance[free]).max() <= step / 2 + 1e-6
    assert (clearance[occupancy != 0] == 0).all()


def test_a_run_pays_little_for_it(drawn: ReportInputs, grid: FreeSpace) -> None:
    data = json.loads(viewer_content(drawn, 10**7).data)
    assert data["free"]["unit"] == "mm"
    assert len(data["free"]["body"]) < 4000
    # A tube through 64 voxels a side.
    place = np.stack(np.meshgrid(*[np.arange(64.0)] * 3, indexing="ij"), -1)
    middle = 32 + 12 * np.sin(place[..., 0] / 9)
    radius = np.hypot(place[..., 1] - middle, place[..., 2] - 30 - 3 * np.cos(place[..., 0] / 4))
    occupancy = np.select([radius < 12, radius < 15], [0, 1], 2).astype(np.uint8)
    large = replace(grid, occupancy=occupancy, clearance=(12 - radius).astype(np.float32))
    assert len(encoded_free_space(large, "mm")["body"]) < 100_000


def test_without_free_space_nothing_is_offered(drawn: ReportInputs, grid: FreeSpace) -> None:
    full = replace(grid, occupancy=np.ones_like(grid.occupancy))
    assert encoded_free_space(full, "mm") is None
    assert not viewer_content(replace(drawn, grid=full), 10**7).has_free_space
    assert viewer_content(drawn, 10**7).has_free_space


def test_a_body_of_another_size_is_refused(grid: FreeSpace) -> None:
    with pytest.raises(SourceError, match="holds"):
        decoded_free_space(encoded_free_space(grid, "mm") | {"size": [3, 3, 3]})
