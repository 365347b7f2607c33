from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from extrags.cameras import rotation_angle_deg
from extrags.config import CoarseConfig
from extrags.errors import ShapeError
from extrags.restoration.training_data.degradation import ITERATIONS, Degradation
from extrags.sequence import EndoscopicSequence
from tests.extrags.lit_tube import Tube, tube_recording

NONE = Degradation(1000, 1.0, True, 0.0, 0.0, "exact", 0.0, 0.0)


def spoilt(tube: Tube, **changes: object) -> EndoscopicSequence:
    return replace(NONE, **changes).applied(tube.sequence, np.random.default_rng(0))


def ratio(tube: Tube, sequence: EndoscopicSequence) -> np.ndarray:
    assert sequence.depth_mm is not None
    assert tube.sequence.depth_mm is not None
    return sequence.depth_mm / tube.sequence.depth_mm


def test_draws_cover_what_is_promised() -> None:
    drawn = [Degradation.random(np.random.default_rng(seed)) for seed in range(300)]
    iterations = np.array([one.iterations for one in drawn])
    assert iterations.min() >= ITERATIONS[0]
    assert iterations.max() <= ITERATIONS[1]
    assert np.median(iterations) == pytest.approx(np.sqrt(ITERATIONS[0] * ITERATIONS[1]), rel=0.2)
    assert {one.depth for one in drawn} == {"exact", "noisy", "waves", "missing"}
    assert 0.15 < np.mean([not one.light for one in drawn]) < 0.35
    poses = np.array([one.pose_mm for one in drawn])
    assert 0.4 < (poses == 0).mean() < 0.6
    assert poses.max() <= 0.5
    assert max(one.depth_error for one in drawn) <= 0.15
    assert drawn[3] == Degradation.random(np.random.default_rng(3))


def test_a_share_is_exact_beyond_chance() -> None:
    drawn = [Degradation.random(np.random.default_rng(seed), exact_share=0.5) for seed in range(300)]
    exact = [one.depth == "exact" and one.pose_mm == 0 and one.light for one in drawn]
    by_chance = 0.3 * 0.5 * 0.75
    assert np.mean(exact) == pytest.approx(0.5 + 0.5 * by_chance, abs=0.09)
    for seed, (one, is_exact) in enumerate(zip(drawn, exact, strict=True)):
        plain = Degradation.random(np.random.default_rng(seed))
        assert (one.iterations, one.gaussians_share) == (plain.iterations, plain.gaussians_share)
        assert is_exact or one == plain


def test_without_flaws_nothing_changes(tube: Tube) -> None:
    same = spoilt(tube)
    assert same.depth_mm is tube.sequence.depth_mm
    assert same.world_from_camera is tube.sequence.world_from_camera


def test_poses_of_training_frames_move_within_bounds(tube: Tube) -> None:
    moved = spoilt(tube, pose_mm=0.5, pose_deg=0.4)
    before, after = tube.sequence.cameras, moved.cameras
    shift = np.linalg.norm(after.centers - before.centers, axis=1)
    turn = rotation_angle_deg(after.world_from_camera[:, :3, :3], before.world_from_camera[:, :3, :3])
    train, test = tube.sequence.train, tube.sequence.test
    assert 0 < shift[train].max() <= 0.5
    assert 0 < turn[train].max() <= 0.4 + 1e-6
    assert (shift[test] == 0).all()
    assert turn[test].max() < 1e-5


def test_waves_are_smooth_and_bounded(tube: Tube) -> None:
    factor = ratio(tube, spoilt(tube, depth="waves", depth_error=0.15))
    train, test = tube.sequence.train, tube.sequence.test
    assert 0.05 < np.abs(np.log(factor[train])).max() <= 0.15 + 1e-6
    assert np.abs(np.diff(np.log(factor[train]), axis=2)).max() < 0.03
    np.testing.assert_allclose(factor[test], 1)


def test_some_frames_lose_their_depth_but_two(tube: Tube) -> None:
    train = tube.sequence.train
    for share, left in ((0.5, len(train) - round(0.5 * len(train))), (1.0, 2)):
        depth = spoilt(tube, depth="missing", depth_error=0.01, missing_share=share).depth_mm
        assert depth is not None
        assert (depth[train] > 0).all(axis=(1, 2)).sum() == left
        assert (depth[tube.sequence.test] > 0).all()


def test_settings_follow_the_draw() -> None:
    coarse = CoarseConfig(max_points=1000)
    settings = replace(NONE, iterations=400, gaussians_share=0.5, light=False).settings(coarse, 7)
    assert (settings.iterations, settings.max_points, settings.seed) == (400, 500, 7)
    assert not settings.light.enabled
    assert settings.densify.max_gaussians == coarse.densify.max_gaussians // 2


@pytest.mark.usefixtures("unchecked")
def test_a_clip_number_for_each_view(tube: Tube) -> None:
    with pytest.raises(ShapeError, match="1 clip numbers for 2 views"):
        replace(tube_recording(tube), clip=np.zeros(1, dtype=np.int64))
