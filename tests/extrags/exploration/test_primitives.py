from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from extrags.cameras import look_at, rotation_angle_deg
from extrags.errors import ConfigError
from extrags.exploration.primitives import PRIMITIVES, apply_primitives, primitive_motions

POSE = look_at(np.array([3.0, -2.0, 5.0]), np.array([-4.0, 1.0, -6.0]), np.array([0.2, 1.0, 0.1]))


def moved(name: str, pose: np.ndarray = POSE, **sizes: float) -> np.ndarray:
    sizes = {"step_mm": 2.0, "rotation_deg": 10.0, "orbit_deg": 10.0, "look_at_mm": 8.0} | sizes
    return apply_primitives(pose, primitive_motions(**sizes))[PRIMITIVES.index(name)]


class TestPrimitives:
    def test_there_are_six_moves_four_turns_four_orbits(self):
        kinds = [name.split("_")[0] for name in PRIMITIVES]
        assert [kinds.count(kind) for kind in ("move", "turn", "orbit")] == [6, 4, 4]

    @settings(max_examples=20, deadline=None)
    @given(moves=st.lists(st.integers(0, 13), min_size=1, max_size=60), seed=st.integers(0, 99))
    def test_any_chain_of_moves_stays_a_rigid_motion(self, moves, seed):
        rng = np.random.default_rng(seed)
        pose = look_at(rng.normal(size=3), rng.normal(size=3) + 3, rng.normal(size=3))
        motions = primitive_motions(0.7, 10.0, 10.0, 3.0)
        for move in moves:
            pose = apply_primitives(pose, motions)[move]
        rotation = pose[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-12)

    @pytest.mark.parametrize("index", range(14))
    def test_the_other_of_a_pair_undoes_it(self, index):
        motions = primitive_motions(2.0, 10.0, 10.0, 8.0)
        there = apply_primitives(POSE, motions)[index]
        back = apply_primitives(there, motions)[index ^ 1]
        assert not np.allclose(there, POSE)
        np.testing.assert_allclose(back, POSE, atol=1e-12)

    @pytest.mark.parametrize(
        ("name", "axis", "sign"),
        [
            ("move_right", 0, 1),
            ("move_left", 0, -1),
            ("move_down", 1, 1),
            ("move_up", 1, -1),
            ("move_forward", 2, 1),
            ("move_back", 2, -1),
        ],
    )
    def test_translations_go_where_they_say(self, name, axis, sign):
        pose = moved(name)
        np.testing.assert_allclose(pose[:3, :3], POSE[:3, :3], atol=1e-12)
        np.testing.assert_allclose(pose[:3, 3] - POSE[:3, 3], sign * 2.0 * POSE[:3, axis], atol=1e-12)

    @pytest.mark.parametrize(
        ("name", "axis", "sign"), [("right", 0, 1), ("left", 0, -1), ("down", 1, 1), ("up", 1, -1)]
    )
    def test_turns_and_orbits_go_where_they_say(self, name, axis, sign):
        turned = moved(f"turn_{name}")
        np.testing.assert_allclose(turned[:3, 3], POSE[:3, 3], atol=1e-12)
        assert turned[:3, 2] @ POSE[:3, axis] == pytest.approx(sign * np.sin(np.radians(10)))
        orbited = moved(f"orbit_{name}")
        assert (orbited[:3, 3] - POSE[:3, 3]) @ POSE[:3, axis] == pytest.approx(
            sign * 8 * np.sin(np.radians(10))
        )

    @pytest.mark.parametrize("name", PRIMITIVES[10:])
    def test_orbits_keep_the_target_in_place(self, name):
        target = POSE[:3, 3] + 8.0 * POSE[:3, 2]
        local = np.linalg.inv(moved(name)) @ np.append(target, 1)
        np.testing.assert_allclose(local[:3], [0, 0, 8.0], atol=1e-12)

    @pytest.mark.parametrize("name", PRIMITIVES[6:])
    def test_turns_and_orbits_rotate_by_their_angle(self, name):
        pose = moved(name, rotation_deg=7.0, orbit_deg=7.0)
        assert rotation_angle_deg(POSE[:3, :3], pose[:3, :3]) == pytest.approx(7.0)

    @pytest.mark.parametrize("sizes", [{"step_mm": 0.0}, {"look_at_mm": -1.0}, {"look_at_mm": np.nan}])
    def test_sizes_that_are_none_are_refused(self, sizes):
        with pytest.raises(ConfigError, match="must be positive"):
            moved("move_right", **sizes)
