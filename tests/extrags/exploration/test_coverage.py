from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from extrags.cameras import Cameras, look_at
from extrags.errors import ConfigError
from extrags.exploration.coverage import (
    coverage_gain,
    direction_bin,
    direction_counts,
    rendered_pairs,
    training_coverage,
    view_pairs,
)

from .tube import SEEN, scene_of_points, small_tube, square_camera

WORDS = arrays(np.uint32, 12, elements=st.integers(0, 2**32 - 1))


def as_bits(words: np.ndarray) -> np.ndarray:
    return np.array([[(int(word) >> k) & 1 for k in range(32)] for word in words], dtype=bool)


def cell_means(n: int) -> tuple[np.ndarray, np.ndarray]:
    """The mean direction of every cell, and the directions it was taken from."""
    unit = np.random.default_rng(0).normal(size=(20_000, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    index = direction_bin(unit, n)
    means = np.stack([unit[index == cell].mean(axis=0) for cell in range(n)])
    return means / np.linalg.norm(means, axis=1, keepdims=True), unit


class TestDirectionBins:
    @pytest.mark.parametrize("n", [2, 3, 4, 7, 12, 20, 31, 32])
    def test_all_cells_have_the_same_area(self, n):
        # Stratified points of exactly equal area: rings of equal height, evenly spread.
        z = (np.arange(600) + 0.5) / 300 - 1
        turn = (np.arange(600) + 0.5) / 600 * 2 * np.pi
        z, turn = (a.ravel() for a in np.meshgrid(z, turn, indexing="ij"))
        ring = np.sqrt(1 - z**2)
        index = direction_bin(np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1), n)
        share = np.bincount(index, minlength=n) / len(index)
        assert len(share) == n
        np.testing.assert_allclose(share, 1 / n, rtol=0.02)

    @pytest.mark.parametrize("n", [4, 17, 32])
    def test_cells_are_compact(self, n):
        centers, _ = cell_means(n)
        np.testing.assert_array_equal(direction_bin(centers, n), np.arange(n))

    def test_no_direction_is_far_from_its_cell(self):
        centers, unit = cell_means(32)
        angle = np.degrees(np.arccos(np.clip((unit * centers[direction_bin(unit, 32)]).sum(axis=1), -1, 1)))
        assert angle.max() < 35
        assert angle.mean() < 17

    def test_axes_and_seams_have_a_cell(self):
        edges = np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [1, -0.0, 0], [0, -1, 0]], float)
        index = direction_bin(edges, 32)
        assert ((index >= 0) & (index < 32)).all()

    @pytest.mark.parametrize(
        ("n", "collars"),
        [(2, [1, 1]), (3, [1, 1, 1]), (4, [1, 2, 1]), (10, [1, 4, 4, 1]), (32, [1, 6, 9, 9, 6, 1])],
    )
    def test_cells_per_collar_are_those_of_the_recursive_partition(self, n: int, collars: list[int]) -> None:
        """As the program of its author has them: `eq_caps(2, 10)` is printed in its documentation."""
        turn = np.linspace(0, 2 * np.pi, 720, endpoint=False)
        # North to south, in the middle of each collar by area; cells are counted in the same order.
        below = np.cumsum(collars)
        first = below - collars
        for k in range(len(collars)):
            z = 1 - (first[k] + below[k]) / n
            ring = np.sqrt(1 - z**2)
            unit = np.stack([ring * np.cos(turn), ring * np.sin(turn), np.full_like(turn, z)], axis=1)
            cells, count = np.unique(direction_bin(unit, n), return_counts=True)
            np.testing.assert_array_equal(cells, np.arange(first[k], below[k]))
            np.testing.assert_allclose(count, 720 / collars[k], atol=1)

    @pytest.mark.parametrize("n", [1, 33])
    def test_more_bins_than_bits_are_refused(self, n):
        with pytest.raises(ConfigError, match="2 to 32"):
            direction_bin(np.array([[0.0, 0.0, 1.0]]), n)


class TestGain:
    @settings(max_examples=60, deadline=None)
    @given(covered=WORDS, pairs=WORDS)
    def test_is_the_number_of_new_pairs(self, covered, pairs):
        brute = int((as_bits(pairs) & ~as_bits(covered)).sum())
        assert coverage_gain(covered, pairs) == brute >= 0

    @settings(max_examples=60, deadline=None)
    @given(small=WORDS, more=WORDS, pairs=WORDS)
    def test_is_submodular(self, small, more, pairs):
        assert coverage_gain(small | more, pairs) <= coverage_gain(small, pairs)

    @settings(max_examples=30, deadline=None)
    @given(covered=WORDS, pairs=WORDS)
    def test_is_nothing_the_second_time(self, covered, pairs):
        assert coverage_gain(covered | pairs, pairs) == 0

    def test_works_on_a_batch(self):
        words = np.random.default_rng(0).integers(0, 2**32, (5, 40), dtype=np.uint32)
        covered = words[0] & words[1]
        np.testing.assert_array_equal(
            coverage_gain(covered, words), [coverage_gain(covered, row) for row in words]
        )


class TestViewPairs:
    def test_a_hidden_gaussian_is_not_seen(self):
        x, y = (a.ravel() for a in np.meshgrid(np.linspace(-4, 4, 15), np.linspace(-4, 4, 15)))
        wall = np.stack([x, y, np.full_like(x, 5.0)], axis=1)
        points = np.concatenate([wall, [[0.0, 0.0, 9.0]]])
        scene = scene_of_points(points)
        front = square_camera()
        back = square_camera(look_at(np.array([0, 0, 14.0]), np.zeros(3), np.array([0, -1.0, 0])))
        rendering, seen = rendered_pairs(scene, front, **SEEN)
        assert rendering.visible[0, -1], "inside the frustum"
        assert seen[0, -1] == 0, "but behind the wall"
        assert np.bitwise_count(seen).max() == 1
        _, from_behind = rendered_pairs(scene, back, **SEEN)
        assert from_behind[0, -1] != 0

    def test_by_the_frustum_a_hidden_gaussian_counts_as_well(self):
        x, y = (a.ravel() for a in np.meshgrid(np.linspace(-4, 4, 15), np.linspace(-4, 4, 15)))
        wall = np.stack([x, y, np.full_like(x, 5.0)], axis=1)
        # Behind the wall, behind the camera, beside the image.
        scene = scene_of_points(np.concatenate([wall, [[0.0, 0, 9], [0, 0, -5], [30, 0, 5]]]))
        _, hidden = rendered_pairs(scene, square_camera(), **SEEN)
        _, found = rendered_pairs(scene, square_camera(), **SEEN, visibility="frustum")
        assert (hidden[0, -3:] > 0).tolist() == [False, False, False]
        assert (found[0, -3:] > 0).tolist() == [True, False, False]
        np.testing.assert_array_equal(found[0, :-3], hidden[0, :-3])
        np.testing.assert_array_equal(
            training_coverage(scene, square_camera(), **SEEN, visibility="frustum"), found[0]
        )

    def test_the_direction_points_from_the_gaussian_to_the_camera(self):
        scene = scene_of_points(np.array([[0.0, 0.0, 5.0]]))
        _, seen = rendered_pairs(scene, square_camera(), **SEEN)
        expected = direction_bin(np.array([[0.0, 0.0, -1.0]]), 32)[0]
        assert seen[0, 0] == np.uint32(1) << np.uint32(expected)

    def test_the_direction_does_not_depend_on_the_distance(self) -> None:
        generator = np.random.default_rng(2)
        scene = scene_of_points(generator.normal(size=(40, 3)))
        center = np.array([0.2, -0.1, 0.3])
        seen = np.arange(3, 40, 2)
        points = scene.gaussians.means.numpy().astype(np.float64)[seen]
        expected = [direction_bin(d / np.sqrt(d @ d), 20) for d in center - points]
        words = view_pairs(scene, center, seen, 20)
        np.testing.assert_array_equal(words, [1 << int(k) for k in expected])
        # The same directions from a hundred times as far.
        far = scene_of_points(100 * scene.gaussians.means.numpy())
        np.testing.assert_array_equal(view_pairs(far, 100 * center, seen, 20), words)

    @pytest.mark.parametrize("per_batch", [1, 2, 16])
    def test_each_view_covers_what_its_own_mask_leaves(self, per_batch, monkeypatch):
        """A wall before three cameras in one place, of which each shows another third of its columns."""
        monkeypatch.setattr("extrags.exploration.coverage.VIEWS_PER_BATCH", per_batch)
        x, y = (a.ravel() for a in np.meshgrid(np.linspace(-4, 4, 15), np.linspace(-4, 4, 15)))
        scene = scene_of_points(np.stack([x, y, np.full_like(x, 5.0)], axis=1))
        camera = square_camera()
        cameras = Cameras.concatenated([camera] * 3)
        column = np.arange(camera.width) * 3 // camera.width
        mask = np.stack([np.tile(column == third, (camera.height, 1)) for third in range(3)])

        def covered(views, masks) -> np.ndarray:
            return training_coverage(scene, cameras[views], **SEEN, mask=masks) > 0

        whole = covered([0], None)
        parts = [covered([0], mask[[third]]) for third in range(3)]
        # Looking along z, x points to the right of the image.
        assert x[parts[0]].max() < 0 < x[parts[2]].min()
        np.testing.assert_array_equal(parts[0] | parts[1] | parts[2], whole)
        np.testing.assert_array_equal(covered([0, 1, 2], mask), whole)
        np.testing.assert_array_equal(covered([0, 1, 2], mask[[0, 0, 2]]), parts[0] | parts[2])
        assert not covered([0, 1, 2], np.zeros_like(mask)).any()

    def test_training_coverage_is_the_union_of_its_views(self):
        tube = small_tube()
        options = {"visible_weight": 0.02, "n_directions": 16}
        whole = training_coverage(tube.scene, tube.cameras, **options)
        parts = [training_coverage(tube.scene, tube.cameras[i], **options) for i in range(len(tube.cameras))]
        np.testing.assert_array_equal(whole, np.bitwise_or.reduce(parts))
        assert whole.max() < 2**16
        assert 1 <= direction_counts(whole).max() <= len(tube.cameras)
