from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from extrags.config import CoarseConfig, DensifyConfig, FinetuneConfig
from extrags.errors import CaptureError, ShapeError
from extrags.sequence import EndoscopicSequence
from extrags.training import finetune, reconstruct
from extrags.training.frame_comparison import ComparedFrames
from extrags.training.frame_weights import (
    LEAST_SHARPNESS,
    LEAST_WEIGHT,
    FrameWeights,
    _sharpness,
    frame_weights,
    weighted_views,
)
from extrags.training.views import real_views
from tests.extrags.training.textured_plane import (
    FOCAL_PX,
    FRAMES,
    HEIGHT,
    WIDTH,
    blurred_along_rows,
    changed,
    textured_plane,
)

WEIGHT = CoarseConfig(inconsistent_frames="weight")


def deformed(image: np.ndarray, peak_px: float) -> np.ndarray:
    """A bulge to the right in the left half."""
    columns, rows = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
    distance = np.hypot(columns - 0.3 * WIDTH, rows - 0.5 * HEIGHT) / (0.2 * WIDTH)
    source = columns - peak_px * np.exp(-0.5 * distance**2)
    return np.asarray(cv2.remap(image, source.astype(np.float32), rows, cv2.INTER_CUBIC))


def judged(sequence: EndoscopicSequence) -> FrameWeights:
    found = frame_weights(sequence, sequence.train)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def plane() -> EndoscopicSequence:
    return textured_plane()


class TestClearFrames:
    def test_all_count_one(self, plane: EndoscopicSequence) -> None:
        found = judged(plane)
        assert np.isfinite(found.sharpness).all()
        assert found.weights.tolist() == [1.0] * FRAMES
        assert not found.displaced.any()
        assert found.statements == []

    def test_their_views_are_left_alone(self, plane: EndoscopicSequence) -> None:
        views = real_views(plane, plane.train)
        assert all(a is b for a, b in zip(judged(plane).applied_to(views), views, strict=True))

    def test_all_equally_soft_count_one(self, plane: EndoscopicSequence) -> None:
        soft = np.stack([cv2.GaussianBlur(image, (0, 0), 1.5) for image in plane.rgb])
        found = judged(replace(plane, rgb=soft))
        assert found.weights.tolist() == [1.0] * FRAMES
        assert not found.displaced.any()

    def test_a_frame_of_smooth_tissue_is_no_blurred_frame(self, plane: EndoscopicSequence) -> None:
        # The right half of the surface has little texture; frames differ in how much of it they show.
        texture = plane.rgb.astype(np.float32)
        means = texture.mean(axis=(1, 2), keepdims=True)
        assert plane.depth_mm is not None
        columns = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL_PX
        poses = plane.cameras.world_from_camera
        x = poses[:, None, None, 0, 3] + plane.depth_mm * columns * poses[:, None, None, 0, 0]
        contrast = np.where(x > 0, 0.15, 1.0)[..., None]
        found = judged(replace(plane, rgb=(means + contrast * (texture - means)).astype(np.uint8)))
        assert found.weights.tolist() == [1.0] * FRAMES

    def test_the_black_border_of_a_round_picture_is_no_edge(self, plane: EndoscopicSequence) -> None:
        rows, columns = np.mgrid[:HEIGHT, :WIDTH]
        disc = np.hypot(columns + 0.5 - WIDTH / 2, rows + 0.5 - HEIGHT / 2) < 0.48 * HEIGHT
        mask = np.broadcast_to(disc, plane.mask.shape).copy()
        shown = judged(replace(plane, mask=mask))
        black = judged(replace(plane, mask=mask, rgb=plane.rgb * disc[..., None]))
        assert black.weights.tolist() == [1.0] * FRAMES
        assert black.statements == []
        np.testing.assert_allclose(black.sharpness, shown.sharpness, atol=0.03)


class TestBlur:
    @pytest.mark.parametrize("length_px", [5, 9])
    def test_motion_in_one_direction_is_found(self, plane: EndoscopicSequence, length_px: int) -> None:
        found = judged(changed(plane, 3, blurred_along_rows(plane.rgb[3], length_px)))
        assert np.flatnonzero(found.weights < 1).tolist() == [3]
        assert not found.displaced.any()
        assert "003.png" in found.statements[0]
        assert "blurred" in found.statements[0]

    def test_more_blur_counts_less(self, plane: EndoscopicSequence) -> None:
        weights = [
            judged(changed(plane, 3, blurred_along_rows(plane.rgb[3], length))).weights[3]
            for length in (5, 7, 9)
        ]
        assert weights[0] > weights[1] > weights[2] >= LEAST_WEIGHT

    def test_a_frame_counts_by_the_square_of_its_sharpness(
        self, plane: EndoscopicSequence, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        sharpness = np.ones(len(plane.train))
        sharpness[:5] = [1.2, LEAST_SHARPNESS, LEAST_SHARPNESS / 2, 0.01, np.nan]
        monkeypatch.setattr("extrags.training.frame_weights._sharpness", lambda *_: sharpness)
        np.testing.assert_allclose(judged(plane).weights[:5], [1, 1, 0.25, LEAST_WEIGHT, 1])

    def test_what_resampling_softens_is_no_blur(self) -> None:
        """Frames as sharp as each other, each of which is softer where it is warped into another."""
        sharp, soft = np.eye(2), 0.5 * np.eye(2)
        pairs = {
            (frame, source): (sharp, soft) for frame in range(3) for source in range(3) if frame != source
        }
        np.testing.assert_allclose(_sharpness(pairs, 3), 1)
        # One frame of half their gradient.
        for other in (1, 2):
            pairs[0, other], pairs[other, 0] = (0.25 * sharp, soft), (sharp, 0.25 * soft)
        np.testing.assert_allclose(_sharpness(pairs, 3)[0], 0.5, rtol=1e-4)

    def test_in_a_minority_of_several_frames(self, plane: EndoscopicSequence) -> None:
        sequence = changed(plane, 2, blurred_along_rows(plane.rgb[2], 7))
        sequence = changed(sequence, 5, blurred_along_rows(plane.rgb[5], 7))
        assert np.flatnonzero(judged(sequence).weights < 1).tolist() == [2, 5]


class TestMovement:
    def test_a_deformed_frame_is_found(self, plane: EndoscopicSequence) -> None:
        found = judged(changed(plane, 4, deformed(plane.rgb[4], 5.0)))
        assert np.flatnonzero(found.displaced).tolist() == [4]
        assert found.weights.tolist() == [1.0] * FRAMES
        assert 0.05 < found.displaced[4] < 0.6
        assert "disagrees" in found.statements[0]

    def test_what_more_has_moved_is_more_displaced(self, plane: EndoscopicSequence) -> None:
        shares = [judged(changed(plane, 4, deformed(plane.rgb[4], peak))).displaced[4] for peak in (3.0, 6.0)]
        assert 0 < shares[0] < shares[1]

    def test_a_wrong_pose_is_a_frame_that_disagrees(self, plane: EndoscopicSequence) -> None:
        poses = plane.cameras.world_from_camera.copy()
        poses[4, :3, 3] += poses[4, :3, :3] @ [1.5, 0, 0]
        assert np.flatnonzero(judged(plane.with_poses(poses)).displaced).tolist() == [4]

    def test_every_pose_a_little_wrong_is_none(self, plane: EndoscopicSequence) -> None:
        poses = plane.cameras.world_from_camera.copy()
        poses[:, :3, 3] += np.random.default_rng(1).uniform(-0.4, 0.4, (FRAMES, 3))
        assert not judged(plane.with_poses(poses)).displaced.any()


class TestViews:
    def test_blur_takes_weight_from_colour_alone(self, plane: EndoscopicSequence) -> None:
        sequence = changed(plane, 3, blurred_along_rows(plane.rgb[3], 9))
        plain = real_views(sequence, sequence.train)[3]
        views, found = weighted_views(sequence, sequence.train, WEIGHT)
        assert found is not None
        torch.testing.assert_close(views[3].weights, plain.weights * float(found.weights[3]))
        assert views[3].normalisation == pytest.approx(float(plain.weight.sum()))
        assert views[3].depth_confidence is None

    def test_movement_is_only_reported(self, plane: EndoscopicSequence) -> None:
        sequence = changed(plane, 4, deformed(plane.rgb[4], 5.0))
        views, found = weighted_views(sequence, sequence.train, WEIGHT)
        assert found is not None
        assert found.statements
        assert all(view.normalisation is None for view in views)

    def test_reported_alone_they_keep_their_weights(self, plane: EndoscopicSequence) -> None:
        sequence = changed(plane, 3, blurred_along_rows(plane.rgb[3], 9))
        views, found = weighted_views(sequence, sequence.train, CoarseConfig(inconsistent_frames="report"))
        assert found is not None
        assert "it counts" not in found.statements[0]
        assert all(view.normalisation is None for view in views)

    def test_not_looked_for_where_switched_off(self, plane: EndoscopicSequence) -> None:
        sequence = changed(plane, 3, blurred_along_rows(plane.rgb[3], 9))
        views, found = weighted_views(sequence, sequence.train, CoarseConfig(inconsistent_frames="ignore"))
        assert found is None
        assert all(view.normalisation is None for view in views)


class TestWithout:
    def test_depth_nothing_is_judged(self, plane: EndoscopicSequence) -> None:
        assert frame_weights(replace(plane, depth_mm=None), plane.train) is None

    def test_frames_that_no_other_sees_count_fully(self, plane: EndoscopicSequence) -> None:
        poses = plane.cameras.world_from_camera.copy()
        poses[3, 0, 3] += 500
        found = judged(changed(plane.with_poses(poses), 3, blurred_along_rows(plane.rgb[3], 9)))
        assert np.isnan(found.sharpness[3])
        assert found.weights[3] == 1
        assert found.to_json()[3]["sharpness"] is None

    def test_other_frames_are_not_looked_at(self, plane: EndoscopicSequence) -> None:
        some = np.array([0, 1, 3, 4, 6])
        spoiled = changed(plane, 5, np.zeros_like(plane.rgb[5]))
        first, second = frame_weights(plane, some), frame_weights(spoiled, some)
        assert first is not None
        assert second is not None
        np.testing.assert_array_equal(first.sharpness, second.sharpness)

    def test_a_background_beyond_float32_lies_nowhere(self, plane: EndoscopicSequence) -> None:
        assert plane.depth_mm is not None
        depth = plane.depth_mm.copy()
        depth[2, :3, :3] = np.finfo(np.float32).max
        found = judged(replace(plane, depth_mm=depth))
        assert np.isfinite(found.sharpness).all()
        np.testing.assert_array_equal(found.weights, 1)

    def test_depth_frames_cannot_be_compared(self, plane: EndoscopicSequence) -> None:
        with pytest.raises(CaptureError, match="made/plane"):
            ComparedFrames(replace(plane, depth_mm=None), plane.train)


def test_a_frame_that_counts_fully_as_shown_is_not_named() -> None:
    """A warning called it blurred and said that it counts 100 %."""
    shown = FrameWeights(
        names=("a.png", "b.png", "c.png"),
        sharpness=np.array([0.84, 0.83, 1.0]),
        displaced=np.zeros(3),
        weights=np.array([0.9957, 0.98, 1.0]),
        applied=True,
    )
    assert shown.statements == [
        "frame b.png is blurred: 83% of the detail that others show there, it counts 98%"
    ]


class TestReconstruct:
    CONFIG = CoarseConfig(
        iterations=30,
        max_points=300,
        densify=DensifyConfig(enabled=False),
        inconsistent_frames="weight",
    )

    def test_clear_frames_give_the_same_bits(self, plane: EndoscopicSequence) -> None:
        off = self.CONFIG.model_copy(update={"inconsistent_frames": "ignore"})
        with_weights, without = reconstruct(plane, self.CONFIG), reconstruct(plane, off)
        assert without.frame_weights is None
        for name, value in with_weights.scene.gaussians.parameters().items():
            assert torch.equal(value, without.scene.gaussians.parameters()[name]), name

    def test_names_blurred_frames(self, plane: EndoscopicSequence, caplog: pytest.LogCaptureFixture) -> None:
        sequence = changed(plane, 3, blurred_along_rows(plane.rgb[3], 9))
        with caplog.at_level(logging.WARNING, "extrags.training.reconstruction"):
            result = reconstruct(sequence, self.CONFIG)
        assert result.frame_weights is not None
        assert result.frame_weights.sharpness[3] < LEAST_SHARPNESS
        assert "frame 003.png is blurred" in caplog.text


class TestFinetune:
    def test_weights_of_reconstruction_give_the_same_bits(
        self, plane: EndoscopicSequence, tmp_path: Path
    ) -> None:
        coarse, config = TestReconstruct.CONFIG, FinetuneConfig(iterations=20, densify_share=0.0)
        sequence = changed(plane, 3, blurred_along_rows(plane.rgb[3], 9))
        made = reconstruct(sequence, coarse)
        assert made.frame_weights is not None
        made.frame_weights.save(tmp_path / FrameWeights.stored_as)
        stored = FrameWeights.load(tmp_path / FrameWeights.stored_as)
        given = finetune(made.scene, sequence, None, config, coarse, frame_weights=stored)
        looked = finetune(made.scene, sequence, None, config, coarse)
        unweighted = coarse.model_copy(update={"inconsistent_frames": "ignore"})
        ignored = finetune(made.scene, sequence, None, config, unweighted)
        for name, value in looked.scene.gaussians.parameters().items():
            assert torch.equal(value, given.scene.gaussians.parameters()[name]), name
        assert not torch.equal(ignored.scene.gaussians.means, given.scene.gaussians.means)

    def test_weights_of_other_frames_are_refused(self, plane: EndoscopicSequence) -> None:
        found = judged(plane)
        fewer = replace(found, names=found.names[1:])
        with pytest.raises(ShapeError, match="made/plane: weights of"):
            weighted_views(plane, plane.train, WEIGHT, fewer)
