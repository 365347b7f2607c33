"""Corrections of poses: gradients, gauge, and poses that were knocked out of place."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from extrags.cameras import rotation_about
from extrags.config import CoarseConfig, DensifyConfig, PoseRefinementConfig
from extrags.errors import ShapeError
from extrags.metrics.pose import absolute_trajectory_error
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training import TrainingResult, reconstruct
from extrags.training.density import DensityStrategy
from extrags.training.pose_refinement import PoseRefinement, _gauge, with_refined_poses
from extrags.training.reconstruction import coarse_schedule, refines_poses
from extrags.training.step import AutogradStep, NativeStep, TrainingStep
from extrags.training.strategies import density_strategy
from extrags.training.views import View, real_views
from tests.extrags.poses.textured_room import room_sequence
from tests.extrags.training.conftest import tube_cameras, tube_gaussians, tube_light

DEPTH_MM = 20.0
QUIET = DensifyConfig(enabled=False)
CONFIG = CoarseConfig(iterations=10)


def knocked(poses: np.ndarray, seed: int, *, shift_mm: float, turn_deg: float) -> np.ndarray:
    """Each pose shifted and turned by about so much, in directions of its own, the whole staying in place."""
    off = np.random.default_rng(seed).normal(size=(len(poses), 6)) / np.sqrt(3)
    off *= np.repeat([np.radians(turn_deg), shift_mm / DEPTH_MM], 3)
    if len(poses) > 1:
        whole = _gauge(poses[:, :3, 3] / DEPTH_MM)
        off -= (whole @ (whole.T @ off.reshape(-1))).reshape(-1, 6)
    result = poses.copy()
    result[:, :3, :3] = Rotation.from_rotvec(off[:, :3]).as_matrix() @ poses[:, :3, :3]
    result[:, :3, 3] += DEPTH_MM * off[:, 3:]
    return result


def refinement(n: int = 6, **settings: float) -> PoseRefinement:
    return PoseRefinement(
        tube_cameras(n), PoseRefinementConfig(start_share=0.0, **settings), DEPTH_MM, iterations=100
    )


def density() -> DensityStrategy:
    return density_strategy(QUIET, 20.0, 10, 900, seed=0)


def loss_from(step: TrainingStep, view: View, pose: np.ndarray) -> tuple[float, np.ndarray]:
    observation = step.differentiate(view, 0, density(), np.linalg.inv(pose))
    assert observation.viewmat_gradient is not None
    return observation.loss, observation.viewmat_gradient.copy()


@pytest.fixture
def step_and_view(tube_sequence: EndoscopicSequence) -> tuple[Scene, View]:
    """The true scene, seen in training frame 1."""
    light = tube_light()
    scene = Scene(tube_gaussians(), replace(light, log_exposure=torch.zeros(4)))
    return scene, real_views(tube_sequence, tube_sequence.train)[1]


@pytest.mark.parametrize("kind", [AutogradStep, NativeStep])
def test_gradient_of_turn_and_shift_against_differences(
    step_and_view: tuple[Scene, View],
    tube_sequence: EndoscopicSequence,
    kind: type[AutogradStep | NativeStep],
) -> None:
    scene, view = step_and_view
    step = kind(scene, coarse_schedule(CONFIG, 20.0, DEPTH_MM, "coarse"))
    cameras = tube_sequence.cameras[tube_sequence.train]
    poses = PoseRefinement(cameras, PoseRefinementConfig(), DEPTH_MM, 100)
    # Away from zero, where the order of turns matters.
    start = np.array([0.02, -0.03, 0.01, 0.01, 0.02, -0.015])
    poses.corrections[1] = start
    _, gradient = loss_from(step, view, np.linalg.inv(poses.viewmat(1)))
    analytic = poses.gradient(1, gradient)
    numeric = np.zeros(6)
    for axis in range(6):
        sides = []
        for sign in (1, -1):
            poses.corrections[1] = start + sign * 2e-3 * np.eye(6)[axis]
            sides.append(loss_from(step, view, np.linalg.inv(poses.viewmat(1)))[0])
        numeric[axis] = (sides[0] - sides[1]) / 4e-3
    # The image is made of edges: differences over a finite step are rough.
    np.testing.assert_allclose(analytic, numeric, atol=0.12 * np.abs(numeric).max())
    assert np.corrcoef(analytic, numeric)[0, 1] > 0.98


def test_gradient_of_a_large_turn_is_exact() -> None:
    """Of a loss that is linear in the view matrix."""
    poses = refinement()
    weights = np.random.default_rng(0).normal(size=(4, 4))
    weights[3] = 0
    start = np.array([0.8, -0.5, 0.3, 0.01, 0.02, -0.015])
    poses.corrections[1] = start
    analytic = poses.gradient(1, weights)
    numeric = np.zeros(6)
    for axis in range(6):
        sides = []
        for sign in (1, -1):
            poses.corrections[1] = start + sign * 1e-5 * np.eye(6)[axis]
            sides.append(float((weights * poses.viewmat(1)).sum()))
        numeric[axis] = (sides[0] - sides[1]) / 2e-5
    np.testing.assert_allclose(analytic, numeric, rtol=1e-6, atol=1e-6)


def test_both_steps_give_the_same_gradient(step_and_view: tuple[Scene, View]) -> None:
    scene, view = step_and_view
    schedule = coarse_schedule(CONFIG, 20.0, DEPTH_MM, "coarse")
    pose = knocked(view.camera.world_from_camera, 0, shift_mm=0.3, turn_deg=0.5)[0]
    found = [loss_from(kind(scene, schedule), view, pose)[1] for kind in (AutogradStep, NativeStep)]
    np.testing.assert_allclose(found[0], found[1], rtol=1e-3, atol=1e-4 * np.abs(found[0]).max())


def shift_gradient(poses: PoseRefinement, frame: int, push: float) -> np.ndarray:
    """Of a loss that grows with the world x of a camera's centre, whatever its axes, and with no turn."""
    camera_from_world = poses.viewmat(frame)
    centre = np.linalg.inv(camera_from_world)[:3, 3]
    pushed = np.array([-push, 0.0, 0.0])
    x, y, z = np.cross(centre, pushed) / 2
    gradient = np.zeros((4, 4))
    gradient[:3, :3] = camera_from_world[:3, :3] @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    gradient[:3, 3] = camera_from_world[:3, :3] @ pushed
    return gradient


def test_a_shift_is_no_turn() -> None:
    poses = refinement()
    np.testing.assert_allclose(
        poses.gradient(2, shift_gradient(poses, 2, 0.5)), [0, 0, 0, 0.5 * DEPTH_MM, 0, 0], atol=1e-12
    )


def test_the_path_as_a_whole_stays() -> None:
    """A gradient that pushes every frame alike moves none."""
    poses = refinement(prior=0.0)
    for _ in range(30):
        for frame in range(6):
            poses.step(frame, shift_gradient(poses, frame, 1.0), 0)
    alike = poses.refined()
    free = refinement(prior=0.0)
    for _ in range(30):
        for frame in range(6):
            free.step(frame, shift_gradient(free, frame, 1.0 if frame % 2 else -1.0), 0)
    assert free.refined().mean_shift > 0.2
    assert alike.mean_shift < 0.1 * free.refined().mean_shift
    # No shift, turn or scale of the whole is left in either.
    shifts = free.refined().world_from_camera[:, :3, 3] - tube_cameras().centers
    np.testing.assert_allclose(shifts.mean(0), 0, atol=1e-9)
    arm = tube_cameras().centers - tube_cameras().centers.mean(0)
    assert abs(float((shifts * arm).sum())) < 1e-9


def test_the_prior_draws_back() -> None:
    poses = refinement(prior=1.0, learning_rate=4e-3)
    poses.corrections[:, 3] = np.array([0.05, -0.05, 0.05, -0.05, 0.05, -0.05])
    before = poses.refined().mean_shift
    for iteration in range(60):
        poses.step(iteration % 6, np.zeros((4, 4)), iteration)
    assert poses.refined().mean_shift < 0.8 * before


def test_the_first_step_has_the_first_rate_and_the_last_the_last() -> None:
    """Whenever poses begin to move: Adam's first step is as long as its rate."""
    for start_share, iteration, expected in (
        (0.4, 40, 4e-3),
        (0.4, 70, 2e-3),
        (0.0, 50, 2e-3),
        (0.0, 100, 1e-3),
    ):
        config = PoseRefinementConfig(
            prior=0.0,
            start_share=start_share,
            learning_rate=4e-3,
            learning_rate_final=1e-3,
        )
        poses = PoseRefinement(tube_cameras(), config, DEPTH_MM, 100)
        assert poses._rate(iteration) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("turn_deg", "least_px", "kept"), [(0.4, 0.1, False), (0.5, 0.2, True), (0.5, 0.22, False)]
)
def test_corrections_that_stay_small_are_taken_back(turn_deg: float, least_px: float, kept: bool) -> None:
    """In degrees or in pixels, of which half a degree is 0.21 here."""
    config = PoseRefinementConfig(start_share=0.1, trial_share=0.4, kept_from_deg=0.45, kept_from_px=least_px)
    tried = PoseRefinement(tube_cameras(), config, DEPTH_MM, 100, tried=True)
    always = PoseRefinement(tube_cameras(), config, DEPTH_MM, 100)
    for poses in (tried, always):
        # Turn and shift count together.
        poses.corrections[:, 1] = 0.6 * np.radians(turn_deg)
        poses.corrections[:, 3] = 0.8 * np.radians(turn_deg)
        assert poses.mean_correction_deg == pytest.approx(turn_deg)
        assert [poses.active(iteration) for iteration in (9, 10, 39)] == [False, True, True]
    assert [tried.active(iteration) for iteration in (40, 41, 99)] == [kept] * 3
    assert tried.kept is kept
    assert (tried.mean_correction_deg > 0) is kept
    assert kept or np.allclose(tried.viewmat(2), tube_cameras().viewmats[2])
    assert always.active(40)
    assert always.mean_correction_deg > 0


@pytest.fixture(scope="module")
def exact() -> EndoscopicSequence:
    return room_sequence(8, width=100, height=76)


@pytest.fixture(scope="module")
def knocked_room(exact: EndoscopicSequence) -> EndoscopicSequence:
    """Training frames 0.6 mm and 1 degree off; the held-out ones are exact."""
    assert exact.world_from_camera is not None
    poses = exact.world_from_camera.copy()
    poses[exact.train] = knocked(poses[exact.train], 1, shift_mm=0.6, turn_deg=1.0)
    return replace(exact, world_from_camera=poses, pose_source="estimated")


def reconstruction(
    sequence: EndoscopicSequence, *, refine: bool | Literal["auto"], iterations: int = 700
) -> TrainingResult:
    settings = PoseRefinementConfig(learning_rate=2e-3, prior=0.0)
    return reconstruct(
        sequence,
        CoarseConfig(
            iterations=iterations,
            max_points=1500,
            densify=QUIET,
            refine_poses=refine,
            pose_refinement=settings,
        ),
    )


@pytest.fixture(scope="module")
def refined(knocked_room: EndoscopicSequence) -> TrainingResult:
    return reconstruction(knocked_room, refine=True)


def test_knocked_poses_come_back(
    exact: EndoscopicSequence, knocked_room: EndoscopicSequence, refined: TrainingResult
) -> None:
    assert exact.world_from_camera is not None
    assert knocked_room.world_from_camera is not None
    assert refined.refined is not None
    train = exact.train
    truth = exact.world_from_camera[train]
    # Without any alignment: the whole was not moved, and must not have been.
    before = absolute_trajectory_error(knocked_room.world_from_camera[train], truth, "none")
    after = absolute_trajectory_error(refined.refined.world_from_camera, truth, "none")
    assert after.rmse < 0.5 * before.rmse
    assert after.rotation_mean_deg < 0.5 * before.rotation_mean_deg
    assert 0.2 < refined.refined.mean_shift < 0.8


def test_held_out_views_gain(
    exact: EndoscopicSequence, knocked_room: EndoscopicSequence, refined: TrainingResult
) -> None:
    plain = reconstruction(knocked_room, refine=False)
    assert plain.refined is None

    def psnr(result: TrainingResult) -> float:
        with torch.no_grad():
            rgb = result.scene.render(exact.cameras[exact.test]).rgb
        target = torch.from_numpy(exact.rgb[exact.test].astype(np.float32) / 255)
        return float(-10 * (rgb - target).square().mean().log10())

    assert psnr(refined) > psnr(plain) + 0.3
    assert refined.history[-1]["psnr"] > plain.history[-1]["psnr"] + 0.5


def test_poses_are_corrected_where_that_is_called_for(
    exact: EndoscopicSequence, knocked_room: EndoscopicSequence, caplog: pytest.LogCaptureFixture
) -> None:
    given = replace(knocked_room, pose_source="given")
    found = reconstruction(given, refine="auto", iterations=300)
    assert found.refined is not None
    assert found.refined.mean_turn_deg > 0.3
    assert "do not agree with their images" in caplog.text
    assert given.metric
    assert " mm on average" in caplog.text
    caplog.clear()
    left = reconstruction(exact, refine="auto", iterations=300)
    assert left.refined is None
    assert "do not agree" not in caplog.text


def test_same_input_same_bits(knocked_room: EndoscopicSequence) -> None:
    config = CoarseConfig(iterations=40, max_points=300, refine_poses=True)
    first, second = (reconstruct(knocked_room, config).refined for _ in range(2))
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.world_from_camera, second.world_from_camera)
    assert first.mean_turn_deg > 0


def test_too_many_frames_for_a_trial_are_told(
    tube_sequence: EndoscopicSequence, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "extrags.training.reconstruction"):
        reconstruct(tube_sequence, CoarseConfig(iterations=5, max_points=100))
    assert "4 frames are too many for 5 iterations" in caplog.text
    caplog.clear()
    with caplog.at_level(logging.INFO, "extrags.training.reconstruction"):
        reconstruct(tube_sequence, CoarseConfig(iterations=5, max_points=100, refine_poses=False))
    assert "too many" not in caplog.text


def test_which_poses_are_refined(tube_sequence: EndoscopicSequence) -> None:
    estimated = replace(tube_sequence, pose_source="estimated")
    assert tube_sequence.depth_mm is not None
    guessed = replace(tube_sequence, depth_error=np.full_like(tube_sequence.depth_mm, 0.1))
    done = replace(tube_sequence, pose_source="refined")
    on, off = CoarseConfig(refine_poses=True), CoarseConfig(refine_poses=False)
    auto = CoarseConfig(refine_poses="auto")
    assert auto == CoarseConfig()
    assert refines_poses(tube_sequence, auto)
    assert refines_poses(estimated, auto)
    assert not refines_poses(done, auto)
    assert not refines_poses(guessed, auto)
    assert not refines_poses(replace(tube_sequence, depth_mm=None), auto)
    assert not refines_poses(tube_sequence, CoarseConfig(train_on="all"))
    # Four frames, each of which is to be moved ten times in .35 of the iterations.
    assert [refines_poses(tube_sequence, CoarseConfig(iterations=n)) for n in (114, 115)] == [False, True]
    assert refines_poses(guessed, on)
    assert refines_poses(tube_sequence, on)
    assert not refines_poses(estimated, off)
    assert not refines_poses(done, on)


def test_held_out_frames_go_along(exact: EndoscopicSequence) -> None:
    """A bend of the path: what stands beside a training frame moves as it does."""
    assert exact.world_from_camera is not None
    train, poses = exact.train, exact.world_from_camera
    bend = np.linspace(0, 1, len(exact))[:, None] ** 2 * np.array([0.0, 0.4, 0.0])
    refined = poses[train].copy()
    refined[:, :3, 3] += bend[train]
    bent = with_refined_poses(replace(exact, pose_source="estimated"), refined)
    assert bent.pose_source == "refined"
    assert bent.world_from_camera is not None
    np.testing.assert_array_equal(bent.world_from_camera[train], refined)
    moved = (bent.world_from_camera - poses)[exact.test, :3, 3]
    # Between training frames, and beyond the last of them.
    np.testing.assert_allclose(moved[0], bend[exact.test[0]], atol=0.04)
    assert bend[exact.train].max() > moved[1, 1] > 0.15
    np.testing.assert_allclose(bent.world_from_camera[:, :3, :3], poses[:, :3, :3], atol=1e-12)
    # Held-out poses that the source gave are those of the evaluation.
    given = with_refined_poses(exact, refined).world_from_camera
    assert given is not None
    np.testing.assert_array_equal(given[train], refined)
    np.testing.assert_array_equal(given[exact.test], poses[exact.test])
    with pytest.raises(ShapeError, match="3 refined poses for 6 training frames"):
        with_refined_poses(exact, refined[:3])


def test_held_out_frames_go_along_with_what_looks_as_they_do(exact: EndoscopicSequence) -> None:
    """All stand in one place; one training frame looks where the held-out ones do, and it alone has moved."""
    assert exact.world_from_camera is not None
    poses = np.repeat(exact.world_from_camera[:1], len(exact), axis=0)
    poses[exact.train[1:], :3, :3] = poses[0, :3, :3] @ rotation_about(np.array([0.0, 1.0, 0.0]), np.pi / 2)
    still = replace(exact, world_from_camera=poses, pose_source="estimated")
    refined = poses[exact.train].copy()
    refined[0, :3, 3] += [0.0, 0.4, 0.0]
    found = with_refined_poses(still, refined).world_from_camera
    assert found is not None
    moved = (found - poses)[exact.test, :3, 3]
    np.testing.assert_allclose(moved, np.broadcast_to([0.0, 0.4, 0.0], moved.shape), atol=1e-3)
