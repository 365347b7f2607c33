"""What all frames have in common, off by a known amount and found again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_catalog.phantom.config import PhantomConfig
from data_catalog.phantom.recording import Phantom
from extrags.cameras import pixel_rays, project_points
from extrags.carried_depth import CarriedDepth, Correction, relative_error
from extrags.errors import SourceError
from extrags.lens import Lens
from extrags.rig_calibration import with_calibration_corrected as corrected
from extrags.sequence import EndoscopicSequence, Split
from tests.benchmarks.wrong_recordings import distorted
from tests.extrags.depth.withheld import recorded
from tests.extrags.test_measured_depth import displaced, smoothly_wrong, with_depth


def with_calibration_corrected(sequence: EndoscopicSequence) -> EndoscopicSequence:
    return corrected(sequence, CarriedDepth.of(sequence))


@pytest.fixture(scope="module")
def exact() -> EndoscopicSequence:
    return recorded(10, 96, 72)


def with_lens(focal: tuple[float, float], shift_px: tuple[float, float]) -> Callable[..., EndoscopicSequence]:
    def changed(sequence: EndoscopicSequence) -> EndoscopicSequence:
        K = sequence.K.copy()
        K[:, [0, 1], [0, 1]] *= focal
        K[:, :2, 2] += shift_px
        return replace(sequence, K=K)

    return changed


def with_hand_eye(turn_deg: float, shift_mm: float) -> Callable[..., EndoscopicSequence]:
    def changed(sequence: EndoscopicSequence) -> EndoscopicSequence:
        further = np.eye(4)
        further[:3, :3] = Rotation.from_rotvec(np.radians(turn_deg) * np.array([0.6, 0.8, 0])).as_matrix()
        further[:3, 3] = shift_mm * np.array([0.8, -0.6, 0])
        return replace(sequence, world_from_camera=sequence.cameras.world_from_camera @ further)

    return changed


def motions(sequence: EndoscopicSequence) -> np.ndarray:
    """From each camera to the next: what poses are, whatever their world."""
    poses = sequence.cameras.world_from_camera
    return np.asarray(np.linalg.inv(poses[1:]) @ poses[:-1])


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (lambda s: with_depth(s, lambda _, depth: 1.1 * depth), "depth is multiplied by 0.909"),
        (lambda s: with_depth(s, lambda _, depth: depth + 2), "-2 is added"),
        (with_lens((1.05, 1.05), (0, 0)), "focal lengths are multiplied by 0.95"),
        (with_lens((1, 1.06), (0, 0)), "focal lengths are multiplied by 1.000 and 0.94"),
        (with_lens((1, 1), (1.2, -0.9)), "the principal point is moved by (-1.2"),
        (with_hand_eye(0, 2), "and moved by 2"),
    ],
    ids=["unit", "offset", "focal length", "aspect", "principal point", "hand-eye"],
)
def test_what_is_off_is_found_again(
    exact: EndoscopicSequence,
    changed: Callable[[EndoscopicSequence], EndoscopicSequence],
    said: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    found = with_calibration_corrected(changed(exact))
    assert said in caplog.text
    np.testing.assert_allclose(found.depth_mm, exact.depth_mm, rtol=3e-3)
    np.testing.assert_allclose(found.K, exact.K, atol=0.1)
    np.testing.assert_allclose(motions(found), motions(exact), atol=0.02)


@pytest.mark.parametrize(
    "coefficients", [(-0.05, 0.0), (-0.3, 0.08), (0.1, 0.0)], ids=["barrel", "strong barrel", "pincushion"]
)
def test_a_lens_that_is_no_pinhole_is_found(
    exact: EndoscopicSequence, coefficients: tuple[float, float], caplog: pytest.LogCaptureFixture
) -> None:
    found = with_calibration_corrected(distorted(exact, coefficients))
    assert "it distorts radially" in caplog.text
    K = exact.K[0]
    rays = np.stack(np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.6, 0.6, 7), [1.0]), axis=-1)
    expected, _ = cv2.projectPoints(
        rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, np.array([*coefficients, 0, 0])
    )
    pixels = project_points(rays.reshape(-1, 3), found.K[0], found.lens)
    assert np.abs(pixels - expected[:, 0]).max() < 0.4


def test_what_is_no_pinhole_already_keeps_its_lens(exact: EndoscopicSequence) -> None:
    lens = Lens.pinhole(exact.K[0], exact.width, exact.height).radial().lens
    given = replace(distorted(exact, (-0.05, 0.0)), lens=lens)
    assert with_calibration_corrected(given).lens is lens


def test_a_lens_that_folds_back_inside_the_image_is_no_correction(exact: EndoscopicSequence) -> None:
    with pytest.raises(SourceError):
        Correction(distortion=3.0).of_lens(exact.K, None, exact.width, exact.height)


@pytest.mark.parametrize("frames", [1.0, -1.0])
def test_poses_of_another_moment_are_moved_back(
    exact: EndoscopicSequence, frames: float, caplog: pytest.LogCaptureFixture
) -> None:
    poses = exact.cameras.world_from_camera
    found = with_calibration_corrected(
        replace(exact, world_from_camera=Correction(time=frames).of_poses(poses))
    )
    assert f"1.00 frames {'before' if frames > 0 else 'after'} it" in caplog.text
    # Where the path ends the pose of a frame before or after is not known.
    inner = slice(1, -1)
    np.testing.assert_allclose(found.cameras.world_from_camera[inner], poses[inner], atol=0.02)


def test_paths_of_recordings_are_apart_and_one_pose_stays(exact: EndoscopicSequence) -> None:
    poses = exact.cameras.world_from_camera[:7]
    half = Correction(time=0.5)
    both = half.of_poses(poses, np.array([0, 0, 0, 0, 1, 1, 1]))
    np.testing.assert_array_equal(both[:4], half.of_poses(poses[:4]))
    np.testing.assert_array_equal(both[4:], half.of_poses(poses[4:]))
    between = both[:3, :3, 3] - (poses[:3, :3, 3] + poses[1:4, :3, 3]) / 2
    assert np.linalg.norm(between, axis=1).max() < 0.3
    np.testing.assert_array_equal(half.of_poses(poses[:1]), poses[:1])


def test_depth_along_the_ray_is_converted(
    exact: EndoscopicSequence, caplog: pytest.LogCaptureFixture
) -> None:
    lengths = np.linalg.norm(pixel_rays(exact.cameras), axis=-1)
    found = with_calibration_corrected(with_depth(exact, lambda frame, depth: depth * lengths[frame]))
    np.testing.assert_allclose(found.depth_mm, exact.depth_mm, rtol=1e-5)
    assert "it is converted to z-depth" in caplog.text


@pytest.mark.parametrize(
    "changed",
    [
        lambda s: s,
        lambda s: displaced(s, 1.0, 0.6),
        lambda s: with_depth(s, smoothly_wrong(0.05)),
        lambda s: s.without_training_depth(),
        lambda s: replace(s, world_from_camera=None),
    ],
    ids=["nothing", "poses", "depth", "no depth", "no poses"],
)
def test_nothing_is_corrected_that_is_not_common_to_all(
    exact: EndoscopicSequence,
    changed: Callable[[EndoscopicSequence], EndoscopicSequence],
    caplog: pytest.LogCaptureFixture,
) -> None:
    given = changed(exact)
    assert with_calibration_corrected(given) is given
    assert not caplog.messages


def test_with_points_of_the_source_neither_lens_nor_poses_change(exact: EndoscopicSequence) -> None:
    given = replace(with_lens((1.05, 1.05), (0, 0))(exact), points=np.ones((30, 3)))
    found = with_calibration_corrected(given)
    np.testing.assert_array_equal(found.K, given.K)
    np.testing.assert_array_equal(found.world_from_camera, given.world_from_camera)


def test_unit_and_hand_eye_are_found_together(exact: EndoscopicSequence) -> None:
    given = with_depth(with_hand_eye(0, 2)(exact), lambda _, depth: 1.1 * depth)
    found = with_calibration_corrected(given)
    before, after = (
        relative_error(carried.log_ratios(carried.pairs))
        for carried in (CarriedDepth(given), CarriedDepth(found))
    )
    assert after < 0.05 * before


def test_larger_maps_are_looked_up_at_every_other_pixel(exact: EndoscopicSequence) -> None:
    # Depth alone: photographs of this size take ten times as long, and nothing looks at them.
    cameras = exact.cameras[:4].resized(400, 300)
    phantom = Phantom(PhantomConfig(scene=0))
    depth = np.stack([phantom.z_depth(cameras[k]) for k in range(4)])
    large = EndoscopicSequence(
        name="large maps",
        rgb=np.zeros((*depth.shape, 3), np.uint8),
        K=cameras.K,
        mask=np.isfinite(depth),
        split=Split("stretch", np.arange(3), np.array([3])),
        world_from_camera=cameras.world_from_camera,
        depth_mm=np.where(np.isfinite(depth), depth, 0).astype(np.float32),
    )
    carried = CarriedDepth(large)
    assert carried.cameras.width == 200
    assert relative_error(carried.log_ratios(carried.pairs)) < 1e-3


def test_corrections_keep_what_is_unknown_and_undo_each_other(exact: EndoscopicSequence) -> None:
    depth = np.array([0.0, 1.0, 30.0])
    assert Correction(offset=-2.0).of_depth(depth).tolist() == [0, 0, 28]
    there = Correction(log_focal=(0.1, 0.2), shift=(0.01, 0.02)).of_intrinsics(exact.K, 96.0)
    back = Correction(log_focal=(-0.1, -0.2), shift=(-0.01, -0.02)).of_intrinsics(there, 96.0)
    np.testing.assert_allclose(back, exact.K, rtol=1e-12)
    poses = exact.cameras.world_from_camera
    turned = Correction(turn=(0.1, 0, 0)).of_poses(Correction(turn=(-0.1, 0, 0)).of_poses(poses))
    np.testing.assert_allclose(turned, poses, atol=1e-12)
