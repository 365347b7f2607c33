from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import label

from extrags.freespace import walls
from extrags.freespace.walls import voxels_of_triangles


def sampled(corners: np.ndarray, size: int, n: int = 400) -> np.ndarray:
    i, j = (part.ravel() for part in np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij"))
    i, j = i[i + j <= n], j[i + j <= n]
    weights = np.stack([i, j, n - i - j], axis=1) / n
    index = np.floor(np.einsum("wc,tcx->twx", weights, corners)).astype(int).reshape(-1, 3)
    marked = np.zeros((size,) * 3, bool)
    index = index[((index >= 0) & (index < size)).all(axis=1)]
    marked[tuple(index.T)] = True
    return marked


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_holds_all_that_dense_samples_touch_and_little_more(seed: int) -> None:
    corners = np.random.default_rng(seed).uniform(-2, 14, (2, 3, 3))
    found, dense = voxels_of_triangles(corners, 12), sampled(corners, 12)
    assert not (dense & ~found).any()
    # Samples miss corners that a triangle cuts by less than their distance.
    extra = np.argwhere(found & ~dense)
    assert len(extra) <= 0.15 * dense.sum() + 4


def test_batches_and_cuts_do_not_change_it(monkeypatch) -> None:
    corners = np.random.default_rng(0).uniform(0, 20, (30, 3, 3))
    whole = voxels_of_triangles(corners, 20)
    monkeypatch.setattr(walls, "CANDIDATES_PER_BATCH", 50)
    monkeypatch.setattr(walls, "LONGEST_EDGE", 3.0)
    np.testing.assert_array_equal(voxels_of_triangles(corners, 20), whole)


def test_a_slanting_sheet_has_no_gap_for_a_path_from_face_to_face() -> None:
    rng = np.random.default_rng(1)
    for _ in range(10):
        slope = rng.uniform(-0.6, 0.6, 2)
        x, y = np.array([-5.0, 25, 25, -5]), np.array([-5.0, -5, 25, 25])
        sheet = np.stack([x, y, 10.0 + slope[0] * (x - 10) + slope[1] * (y - 10)], axis=1)
        marked = voxels_of_triangles(sheet[[[0, 1, 2], [0, 2, 3]]], 20)
        _, parts = label(~marked)
        assert parts == 2
