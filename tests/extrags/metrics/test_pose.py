"""Alignment and trajectory errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from extrags.cameras import compose, rotation_about
from extrags.errors import ConfigError, NonFiniteError, ShapeError
from extrags.metrics.pose import Similarity, absolute_trajectory_error, relative_pose_error, umeyama


def trajectory(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack(
        [compose(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * (3, 1, 0.3)) for _ in range(n)]
    )


def random_similarity(seed: int, scale: float) -> Similarity:
    rng = np.random.default_rng(seed)
    return Similarity(scale, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * 10)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), scale=st.floats(0.01, 100), n=st.integers(3, 20), flat=st.booleans())
def test_umeyama_recovers_a_similarity(seed: int, scale: float, n: int, flat: bool) -> None:
    source = np.random.default_rng(seed).normal(size=(n, 3))
    if flat:
        source[:, 2] = 0
    wanted = random_similarity(seed + 1, scale)
    found = umeyama(source, wanted.apply(source))
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    np.testing.assert_allclose(found.apply(source), wanted.apply(source), atol=1e-8 * max(scale, 1))
    assert found.scale == pytest.approx(scale, rel=1e-6)


def test_agrees_with_scikit_image_and_scipy() -> None:
    from skimage.transform import SimilarityTransform

    rng = np.random.default_rng(4)
    source = rng.normal(size=(15, 3)) * (3, 1, 0.3)
    target = random_similarity(7, 2.5).apply(source) + rng.normal(0, 0.2, (15, 3))
    theirs = SimilarityTransform.from_estimate(source, target)
    ours = umeyama(source, target)
    assert ours.scale == pytest.approx(theirs.scale, rel=1e-9)
    np.testing.assert_allclose(ours.apply(source), theirs(source), atol=1e-9)
    # Without scale it is the orthogonal Procrustes problem that scipy solves.
    rigid = umeyama(source, target, with_scale=False)
    turned, distance = Rotation.align_vectors(target - target.mean(0), source - source.mean(0))
    np.testing.assert_allclose(rigid.rotation, turned.as_matrix(), atol=1e-9)
    residual = np.linalg.norm(rigid.apply(source) - target)
    assert residual == pytest.approx(distance, rel=1e-9)


def test_umeyama_never_mirrors() -> None:
    source = np.random.default_rng(0).normal(size=(10, 3))
    found = umeyama(source, source * (1, 1, -1))
    assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_umeyama_has_the_best_scale_of_what_is_mirrored() -> None:
    source = np.random.default_rng(8).normal(size=(30, 3))
    target = 2 * source * [1, 1, -0.4]
    found = umeyama(source, target)

    def squares(scale: float) -> float:
        moved = scale * source @ found.rotation.T
        return float(np.square((target - target.mean(0)) - (moved - moved.mean(0))).sum())

    assert squares(found.scale) < min(squares(0.99 * found.scale), squares(1.01 * found.scale))


def test_points_on_a_line_still_fit() -> None:
    source = np.linspace(0, 1, 8)[:, None] * np.array([1.0, 2.0, 3.0])
    wanted = random_similarity(3, 2.0)
    np.testing.assert_allclose(
        umeyama(source, wanted.apply(source)).apply(source), wanted.apply(source), atol=1e-12
    )


def test_ate_is_blind_to_the_world_frame_and_counts_what_is_left() -> None:
    truth = trajectory(12)
    moved = random_similarity(5, 3.0).apply_to_poses(truth)
    errors = absolute_trajectory_error(moved, truth, "sim3")
    assert errors.rmse == pytest.approx(0, abs=1e-10)
    assert errors.rotation_mean_deg == pytest.approx(0, abs=1e-5)
    # The wrong scale can be mended by a similarity only.
    assert absolute_trajectory_error(moved, truth, "se3").rmse > 1
    assert absolute_trajectory_error(moved, truth, "none").rmse > 1


def test_ate_without_alignment_by_hand() -> None:
    truth = trajectory(4)
    off = truth.copy()
    off[:, :3, 3] += np.array([[3, 4, 0], [0, 0, 0], [0, 0, 1], [0, 2, 0]])
    off[:, :3, :3] = off[:, :3, :3] @ rotation_about(np.array([0.0, 1, 0]), np.radians(7))
    errors = absolute_trajectory_error(off, truth, "none")
    assert errors.rmse == pytest.approx(np.sqrt((25 + 1 + 4) / 4))
    assert errors.mean == pytest.approx(2)
    assert errors.median == pytest.approx(1.5)
    assert errors.max == pytest.approx(5)
    assert errors.rotation_mean_deg == pytest.approx(7)


def test_rpe_counts_drift_per_step() -> None:
    steps = 10
    truth = np.stack([compose(np.eye(3), np.array([float(i), 0, 0])) for i in range(steps)])
    drifting = np.stack(
        [
            compose(rotation_about(np.array([0.0, 0, 1]), np.radians(2 * i)), np.array([float(i), 0, 0]))
            for i in range(steps)
        ]
    )
    errors = relative_pose_error(drifting, truth, alignment="none")
    assert errors.rotation_rmse_deg == pytest.approx(2)
    assert errors.n_pairs == steps - 1
    assert relative_pose_error(drifting, truth, frames_apart=3, alignment="none").rotation_rmse_deg == (
        pytest.approx(6)
    )
    scaled = truth.copy()
    scaled[:, :3, 3] *= 1.1
    assert relative_pose_error(scaled, truth, alignment="none").translation_rmse == pytest.approx(0.1)
    assert relative_pose_error(scaled, truth, alignment="sim3").translation_rmse == pytest.approx(
        0, abs=1e-12
    )


@pytest.mark.parametrize("apart", [1, 3])
def test_rpe_is_measured_in_the_camera_that_moves(apart: int) -> None:
    """Of cameras that turn: where each of them is told the later one stands, and where it does stand."""
    truth, other = trajectory(9, seed=1), trajectory(9, seed=2)

    def told(poses: np.ndarray) -> np.ndarray:
        steps = poses[apart:, :3, 3] - poses[:-apart, :3, 3]
        return np.einsum("nji,nj->ni", poses[:-apart, :3, :3], steps)

    def turns(poses: np.ndarray) -> Rotation:
        before, after = (Rotation.from_matrix(part[:, :3, :3]) for part in (poses[:-apart], poses[apart:]))
        return before.inv() * after

    errors = relative_pose_error(other, truth, frames_apart=apart, alignment="none")
    missed = np.linalg.norm(told(other) - told(truth), axis=1)
    assert errors.translation_rmse == pytest.approx(np.sqrt(np.mean(missed**2)))
    angles = np.degrees((turns(truth).inv() * turns(other)).magnitude())
    assert errors.rotation_rmse_deg == pytest.approx(np.sqrt(np.mean(angles**2)))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_points_without_a_place_cannot_be_aligned(value: float) -> None:
    points = np.random.default_rng(0).normal(size=(5, 3))
    broken = points.copy()
    broken[3, 1] = value
    for name, pair in (("source", (broken, points)), ("target", (points, broken))):
        with pytest.raises(NonFiniteError, match=f"the {name} points"):
            umeyama(*pair)


def test_bad_input_is_named() -> None:
    truth = trajectory(4)
    broken = truth.copy()
    broken[2, 0, 3] = np.nan
    with pytest.raises(NonFiniteError, match="estimated poses"):
        absolute_trajectory_error(broken, truth)
    with pytest.raises(ShapeError, match="three or more"):
        absolute_trajectory_error(truth[:2], truth[:2])
    with pytest.raises(ShapeError, match="no pose to compare"):
        absolute_trajectory_error(truth[:0], truth[:0], "none")
    assert absolute_trajectory_error(truth[:1], truth[:1], "none").max == 0
    with pytest.raises(ShapeError, match="no two of 4 poses"):
        relative_pose_error(truth, truth, frames_apart=4)
    with pytest.raises(ConfigError, match="at least 1"):
        relative_pose_error(truth, truth, frames_apart=0)
