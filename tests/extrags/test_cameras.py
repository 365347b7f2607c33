from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from extrags.cameras import (
    Cameras,
    as_rotation,
    compose,
    field_mask,
    invert_poses,
    look_at,
    pixel_rays,
    pose_distances,
    project_points,
    rays_of_pixels,
    rotation_about,
    rotation_angle_deg,
    transform_points,
    unproject_pixels,
)
from extrags.errors import PoseError, ShapeError
from extrags.radial_lens import RadialLens

LENS = RadialLens((-0.209, 0.0397, 0.00787, -0.00334), float(np.radians(80)))


def random_poses(count: int, seed: int = 0) -> np.ndarray:
    generator = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=generator).as_matrix()
    poses[:, :3, 3] = generator.normal(size=(count, 3)) * 20
    return poses


def cameras(count: int = 3) -> Cameras:
    K = np.array([[50.0, 0, 32], [0, 50.0, 24], [0, 0, 1]])
    return Cameras(np.tile(K, (count, 1, 1)), random_poses(count), 64, 48)


def test_unprojected_pixels_project_back() -> None:
    K = np.array([[50.0, 0, 30], [0, 45.0, 25], [0, 0, 1]])
    pixels = np.random.default_rng(0).uniform(-20, 90, size=(4, 5, 2))
    rays = unproject_pixels(pixels, K)
    np.testing.assert_array_equal(rays[..., 2], 1)
    np.testing.assert_allclose(project_points(3 * rays, K), pixels, atol=1e-12)


def test_transformed_points_are_those_of_the_matrix() -> None:
    (motion,) = random_poses(1)
    points = np.random.default_rng(0).normal(size=(6, 2, 3))
    expected = points @ motion[:3, :3].T + motion[:3, 3]
    np.testing.assert_allclose(transform_points(motion, points), expected, atol=1e-12)


class TestCameras:
    def test_viewmats_are_the_inverse(self) -> None:
        batch = cameras()
        product = batch.viewmats @ batch.world_from_camera
        np.testing.assert_allclose(product, np.tile(np.eye(4), (3, 1, 1)), atol=1e-12)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"width": 0}, "Cameras of 0 x 48 px, expected at least 1 x 1"),
            ({"height": -3}, "Cameras of 64 x -3 px"),
            ({"width": 10.5}, "width is 10.5, expected a whole number of pixels"),
            ({"height": "48"}, "height is '48', expected a whole number of pixels"),
            ({"K": [[1.0]]}, "Cameras: K is list, expected ndarray"),
            ({"world_from_camera": None}, "Cameras: world_from_camera is NoneType, expected ndarray"),
        ],
    )
    @pytest.mark.usefixtures("unchecked")
    def test_what_is_no_camera(self, change: dict[str, Any], message: str) -> None:
        given = {"K": np.eye(3)[None], "world_from_camera": np.eye(4)[None], "width": 64, "height": 48}
        assert len(Cameras(**{**given, "width": np.int64(64)})) == 1
        with pytest.raises(ShapeError, match=re.escape(message)):
            Cameras(**{**given, **change})

    def test_indexing_keeps_the_batch_axis(self) -> None:
        batch = cameras()
        assert len(batch[1]) == 1
        assert len(batch[np.array([0, 2])]) == 2
        assert len(batch[1:]) == 2
        np.testing.assert_array_equal(batch[1].centers[0], batch.centers[1])

    def test_resized_keeps_the_rays_of_image_corners(self) -> None:
        batch = cameras(1)
        half = batch.resized(32, 24)
        for camera in (batch, half):
            corner = np.linalg.inv(camera.K[0]) @ [camera.width, camera.height, 1]
            np.testing.assert_allclose(corner, [0.64, 0.48, 1], atol=1e-12)

    def test_rays_project_back_to_their_pixel_centres(self) -> None:
        batch = cameras(2)
        points = batch.centers[:, None, None] + 7.5 * pixel_rays(batch)
        pixels, depth = batch.project(points)
        assert pixels.shape == (2, 2, 48, 64, 2)
        columns, rows = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
        for camera in range(2):
            np.testing.assert_allclose(depth[camera, camera], 7.5, atol=1e-9)
            np.testing.assert_allclose(pixels[camera, camera, ..., 0], columns, atol=1e-9)
            np.testing.assert_allclose(pixels[camera, camera, ..., 1], rows, atol=1e-9)
            assert batch.contains(pixels[camera, camera]).all()

    def test_projection_is_the_matrix_product(self) -> None:
        batch = cameras(3)
        points = np.random.default_rng(1).normal(size=(200, 3)) * 30
        homogeneous = np.concatenate([points, np.ones((200, 1))], axis=1)
        pixels, depth = batch.project(points)
        for camera in range(3):
            image = batch.K[camera] @ (batch.viewmats[camera] @ homogeneous.T)[:3]
            np.testing.assert_allclose(depth[camera], image[2], atol=1e-9)
            front = image[2] > 0
            assert 0 < front.sum() < 200
            np.testing.assert_allclose(pixels[camera, front], (image[:2] / image[2]).T[front], rtol=1e-9)
            assert np.isnan(pixels[camera, ~front]).all()
            assert not batch.contains(pixels[camera, ~front]).any()

    def test_the_image_ends_at_its_edges(self) -> None:
        pixels = np.array(
            [[0.0, 0.0], [63.999, 47.999], [64.0, 10.0], [10.0, 48.0], [-1e-9, 3.0], [3.0, -1.0]]
        )
        np.testing.assert_array_equal(cameras(1).contains(pixels), [True, True, False, False, False, False])

    @pytest.mark.parametrize(
        ("width", "size"), [(100, (64, 48)), (64, (64, 48)), (32, (32, 24)), (1, (1, 1))]
    )
    def test_at_most_width(self, width: int, size: tuple[int, int]) -> None:
        small = cameras(2).at_most_width(width)
        assert (small.width, small.height) == size
        np.testing.assert_allclose(small.K[:, 0, 0], 50 * size[0] / 64)

    @pytest.mark.usefixtures("unchecked")
    def test_wrong_shapes_are_refused(self) -> None:
        with pytest.raises(ShapeError, match="world_from_camera"):
            Cameras(np.eye(3)[None], np.tile(np.eye(4), (2, 1, 1)), 4, 4)
        with pytest.raises(ShapeError, match=r"found \(1, 3, 3\) and \(1, 3, 4\)"):
            Cameras(np.eye(3)[None], np.eye(4)[None, :3], 4, 4)

    @pytest.mark.usefixtures("unchecked")
    @pytest.mark.parametrize("field", ["world_from_camera", "K"])
    @pytest.mark.parametrize("value", [np.nan, np.inf])
    def test_what_is_not_finite_is_refused_by_its_position(self, field: str, value: float) -> None:
        arrays = {"world_from_camera": np.stack([np.eye(4)] * 3), "K": np.stack([np.eye(3)] * 3)}
        Cameras(**arrays, width=4, height=3).check_finite()
        arrays[field][1, 0, 2] = value
        with pytest.raises(PoseError, match=f"{field}: view 1 of 3 holds NaN or infinity"):
            Cameras(**arrays, width=4, height=3).check_finite()

    def test_forward_is_the_ray_of_the_principal_point(self) -> None:
        batch = cameras(4)
        # Pixel centres lie at +0.5, the principal point between four of them.
        middle = pixel_rays(batch)[:, 23:25, 31:33].mean(axis=(1, 2))
        np.testing.assert_allclose(batch.forward, middle, atol=1e-12)

    def test_concatenated_keeps_the_order_of_views(self) -> None:
        batch = cameras(5)
        joined = Cameras.concatenated([batch[3:], batch[:2]])
        np.testing.assert_array_equal(joined.world_from_camera, batch.world_from_camera[[3, 4, 0, 1]])
        assert (joined.width, joined.height) == (64, 48)

    def test_concatenated_needs_equal_sizes(self) -> None:
        with pytest.raises(ShapeError, match="sizes"):
            Cameras.concatenated([cameras(1), cameras(1).resized(32, 24)])


class TestRotations:
    def test_rounded_rotation_is_projected_to_so3(self) -> None:
        rotation = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix()
        fixed = as_rotation(np.round(rotation, 5))
        np.testing.assert_allclose(fixed @ fixed.T, np.eye(3), atol=1e-14)
        np.testing.assert_allclose(fixed, rotation, atol=1e-5)

    def test_mirrored_rotation_is_refused_by_frame(self) -> None:
        with pytest.raises(PoseError, match=r"frame 0007.*mirrored"):
            as_rotation(np.diag([1.0, -1.0, 1.0]), frame="0007")

    @pytest.mark.parametrize(
        "bad",
        [
            2 * np.eye(3),
            np.full((3, 3), np.nan),
            np.diag([1.0, 1.0, 1.2]),
            np.eye(3) + 0.2 * np.eye(3, k=1),
            np.where(np.eye(3, k=2) > 0, np.nan, np.eye(3)),
        ],
        ids=["scaled", "unknown", "scaled along one axis", "sheared", "one entry unknown"],
    )
    def test_no_rotation_is_refused(self, bad: np.ndarray) -> None:
        with pytest.raises(PoseError):
            as_rotation(bad)

    @pytest.mark.parametrize(
        ("scale", "is_one"), [(0.991, True), (1.009, True), (0.989, False), (1.011, False)]
    )
    def test_only_rounding_is_taken_for_a_rotation(self, scale: float, is_one: bool) -> None:
        for rotation in Rotation.random(20, random_state=np.random.default_rng(3)).as_matrix():
            if is_one:
                np.testing.assert_allclose(as_rotation(scale * rotation), rotation, atol=1e-14)
            else:
                with pytest.raises(PoseError, match="not a rotation"):
                    as_rotation(scale * rotation)

    def test_rounding_is_told_from_shear(self) -> None:
        """Two digits are enough for any rotation; with one a camera is turned by degrees."""
        rotations = Rotation.random(4000, random_state=np.random.default_rng(0)).as_matrix()
        worst = [np.abs(np.linalg.svd(np.round(one, 2))[1] - 1).max() for one in rotations]
        assert max(worst) > 0.01
        rotation = rotations[np.argmax(worst)]
        np.testing.assert_allclose(as_rotation(np.round(rotation, 2)), rotation, atol=0.01)
        with pytest.raises(PoseError, match=r"not a rotation.*one digit after the point.*write six"):
            as_rotation(np.round(rotation_about(np.array([0.0, 0, 1]), np.radians(45)), 1))
        for sheared in (np.eye(3) + 0.2 * np.eye(3, k=1), 0.9 * np.eye(3), 1.1 * np.eye(3)):
            with pytest.raises(PoseError, match="scaled, sheared or transposed"):
                as_rotation(sheared)

    def test_rodrigues_agrees_with_scipy(self) -> None:
        axis = np.array([1.0, -2.0, 0.5])
        expected = Rotation.from_rotvec(0.7 * axis / np.linalg.norm(axis)).as_matrix()
        np.testing.assert_allclose(rotation_about(axis, 0.7), expected, atol=1e-14)

    def test_angle(self) -> None:
        turned = rotation_about(np.array([0.0, 0, 1]), np.radians(25))
        assert rotation_angle_deg(np.eye(3), turned) == pytest.approx(25)

    def test_angles_of_nearly_the_same_and_of_opposite_orientations(self) -> None:
        """Rounding takes the trace beyond 3 and below -1, where there is no arc cosine."""
        turns = Rotation.random(200, random_state=np.random.default_rng(0)).as_matrix()
        half = np.stack([2 * np.outer(turn[0], turn[0]) - np.eye(3) for turn in turns])
        # The arc cosine has half the digits at both ends.
        digits = np.degrees(4 * np.sqrt(np.finfo(np.float64).eps))
        np.testing.assert_allclose(rotation_angle_deg(turns, turns), 0, atol=digits)
        np.testing.assert_allclose(rotation_angle_deg(turns, turns @ half), 180, atol=digits)

    def test_distances_are_ways_and_turns_added(self) -> None:
        first, second = cameras(3), Cameras(np.tile(np.eye(3), (2, 1, 1)), random_poses(2, seed=5), 64, 48)
        found = pose_distances(first, second, 7.0)
        assert found.shape == (3, 2)
        for a in range(3):
            for b in range(2):
                one, other = first.world_from_camera[a], second.world_from_camera[b]
                turn = Rotation.from_matrix(one[:3, :3].T @ other[:3, :3]).magnitude()
                way = np.sqrt(((one[:3, 3] - other[:3, 3]) ** 2).sum()) / 7.0
                assert found[a, b] == pytest.approx(way + turn, rel=1e-12)

    @pytest.mark.parametrize("up", [np.array([0.0, -1, 0]), np.array([0.0, 0, 1])])
    def test_look_at_is_a_rotation_that_looks_there(self, up: np.ndarray) -> None:
        pose = look_at(np.array([1.0, 2, 3]), np.array([1.0, 2, 9]), up)
        np.testing.assert_allclose(pose[:3, 2], [0, 0, 1], atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)

    def test_what_lies_up_is_seen_above_the_target(self) -> None:
        center, target, up = np.array([3.0, -2, 1]), np.array([-4.0, 5, 2.5]), np.array([0.2, 0.5, 3.0])
        pose = look_at(center, target, up)
        np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-14)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
        np.testing.assert_array_equal(pose[:3, 3], center)
        K = np.array([[50.0, 0, 32], [0, 50.0, 24], [0, 0, 1]])
        pixels = project_points(transform_points(invert_poses(pose), np.stack([target, target + up])), K)
        np.testing.assert_allclose(pixels[0], [32, 24], atol=1e-11)
        # The axis of "up" stands upright in the image: to neither side of the target.
        assert pixels[1, 0] == pytest.approx(32, abs=1e-11)
        assert pixels[1, 1] < 24

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    @pytest.mark.parametrize("axis", range(3))
    def test_looking_along_up_is_a_rotation_too(self, axis: int, sign: float) -> None:
        along = sign * np.eye(3)[axis]
        pose = look_at(np.zeros(3), 5 * along, along)
        np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-15)
        np.testing.assert_array_equal(pose[:3, 2], along)

    def test_look_at_itself_is_refused(self) -> None:
        with pytest.raises(PoseError):
            look_at(np.zeros(3), np.zeros(3), np.array([0.0, -1, 0]))

    def test_inverting_twice_gives_the_pose(self) -> None:
        poses = random_poses(5)
        np.testing.assert_allclose(invert_poses(invert_poses(poses)), poses, atol=1e-12)

    def test_compose(self) -> None:
        turn = rotation_about(np.array([1.0, 2, 3]), 0.4)
        pose = compose(turn, np.array([1.0, 2, 3]))
        np.testing.assert_array_equal(pose[:3, :3], turn)
        np.testing.assert_array_equal(pose[:3, 3], [1, 2, 3])
        np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])


class TestInterpolated:
    def test_cameras_and_the_way_between(self) -> None:
        first = look_at(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0]))
        second = first.copy()
        second[:3, :3] = first[:3, :3] @ rotation_about(np.array([0.0, 1.0, 0.0]), np.pi / 2)
        second[:3, 3] = [2.0, 0.0, 4.0]
        K = np.tile(np.diag([10.0, 10.0, 1.0]), (2, 1, 1))
        K[1, 0, 0] = 30.0
        between = Cameras(K, np.stack([first, second]), 8, 6).interpolated(4)
        assert len(between) == 5
        np.testing.assert_allclose(between.world_from_camera[[0, 4]], [first, second], atol=1e-12)
        np.testing.assert_allclose(between.centers[1], [0.5, 0.0, 1.0])
        turned = rotation_angle_deg(between.world_from_camera[2, :3, :3], first[:3, :3])
        assert turned == pytest.approx(45.0)
        assert between.K[2, 0, 0] == pytest.approx(20.0)

    def test_every_stretch_runs_between_its_own_two_cameras(self) -> None:
        poses, steps = random_poses(4), 3
        K = np.tile(np.array([[50.0, 0, 32], [0, 40.0, 24], [0, 0, 1]]), (4, 1, 1))
        K[:, 0, 0] += [0.0, 6, -9, 3]
        found = Cameras(K, poses, 64, 48).interpolated(steps)
        assert len(found) == 10
        for stretch in range(3):
            first, second = poses[stretch], poses[stretch + 1]
            turn = Rotation.from_matrix(first[:3, :3].T @ second[:3, :3]).as_rotvec()
            for step in range(steps):
                at, share = stretch * steps + step, step / steps
                center = first[:3, 3] + share * (second[:3, 3] - first[:3, 3])
                rotation = first[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
                np.testing.assert_allclose(found.centers[at], center, atol=1e-12)
                np.testing.assert_allclose(found.world_from_camera[at, :3, :3], rotation, atol=1e-12)
                expected = K[stretch] + share * (K[stretch + 1] - K[stretch])
                np.testing.assert_allclose(found.K[at], expected, atol=1e-12)
        np.testing.assert_allclose(found.world_from_camera[-1], poses[-1], atol=1e-12)

    def test_one_camera_goes_nowhere(self) -> None:
        pose = look_at(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0]))
        alone = Cameras(np.eye(3)[None], pose[None], 8, 6)
        assert alone.interpolated(5) is alone


@pytest.mark.parametrize("lens", [None, LENS])
@pytest.mark.parametrize("seed", range(3))
def test_rays_of_some_pixels_have_the_bits_of_all(lens: RadialLens | None, seed: int) -> None:
    generator = np.random.default_rng(seed)
    poses = np.stack(
        [
            look_at(generator.normal(size=3), generator.normal(size=3) + 9, np.array([0.0, 1, 0]))
            for _ in range(4)
        ]
    )
    K = np.repeat(np.array([[[31.3, 0, 20.1], [0, 30.7, 14.9], [0, 0, 1]]]), 4, axis=0)
    cameras = Cameras(K, poses, 41, 29, lens)
    every = pixel_rays(cameras).reshape(-1, 3)
    # The third camera has none, as frames without depth do.
    at = np.flatnonzero((generator.random(len(every)) < 0.1) & (np.arange(len(every)) // (41 * 29) != 2))
    assert np.array_equal(rays_of_pixels(cameras, at), every[at])
    assert rays_of_pixels(cameras, at[:0]).shape == (0, 3)


def test_a_field_is_that_of_its_own_principal_point_and_focal_lengths() -> None:
    K = np.array([[20.0, 0, 31.5], [0, 12.0, 17.25], [0, 0, 1]])
    found = field_mask(K, LENS, 70, 40)
    assert found.shape == (40, 70)
    assert 0.2 < found.mean() < 0.5
    for row in range(40):
        for column in range(70):
            corners = [(column + dx, row + dy) for dx in (0, 1) for dy in (0, 1)]
            farthest = max(np.hypot((u - 31.5) / 20, (v - 17.25) / 12) for u, v in corners)
            assert found[row, column] == (farthest <= LENS.max_radius)
    batch = Cameras(np.stack([K, K + np.diag([5.0, 5.0, 0])]), np.tile(np.eye(4), (2, 1, 1)), 70, 40, LENS)
    np.testing.assert_array_equal(batch.field[0], found)
    assert batch.field[1].sum() > found.sum()


def test_all_of_a_pinhole_is_its_field() -> None:
    assert cameras(2).field.shape == (2, 48, 64)
    assert cameras(2).field.all()


def test_rays_of_several_cameras_with_a_lens_are_those_of_each_alone() -> None:
    """Cameras of the same intrinsics share the work; these have two, in turns."""
    K = np.tile(np.array([[20.0, 0, 16], [0, 21.0, 12], [0, 0, 1]]), (4, 1, 1))
    K[1::2, 0, 0] = 26.0
    batch = Cameras(K, random_poses(4), 32, 24, LENS)
    rays = pixel_rays(batch)
    for index in range(4):
        np.testing.assert_array_equal(rays[index], pixel_rays(batch[index])[0])
        local = rays[index] @ batch.world_from_camera[index, :3, :3]
        pixels = project_points(local, K[index], LENS)
        v, u = np.mgrid[:24, :32] + 0.5
        seen = batch.field[index]
        np.testing.assert_allclose(pixels[seen], np.stack([u, v], axis=-1)[seen], rtol=0, atol=1e-9)
