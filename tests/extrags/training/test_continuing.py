from __future__ import annotations

import inspect
from dataclasses import replace

import numpy as np
import pytest
import torch

from extrags.config import CoarseConfig, ContinuationConfig, DensifyConfig
from extrags.errors import ConfigError, ShapeError
from extrags.events import Event, Progress, subscribed
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training import EarlierScene, TrainingResult, continuing, reconstruct
from extrags.training.continuing import (
    continued_iterations,
    continued_start,
    unexplained_pixels,
)
from tests.extrags.training.test_reconstruction import psnr_of

CONFIG = CoarseConfig(iterations=250, max_points=600, densify=DensifyConfig(enabled=False))


@pytest.fixture(scope="module")
def old_frames(tube_sequence: EndoscopicSequence) -> np.ndarray:
    return tube_sequence.train[: len(tube_sequence.train) * 2 // 3]


@pytest.fixture(scope="module")
def first(tube_sequence: EndoscopicSequence, old_frames: np.ndarray) -> Scene:
    return reconstruct(tube_sequence, CONFIG, frames=old_frames).scene


@pytest.fixture(scope="module")
def continued(tube_sequence: EndoscopicSequence, old_frames: np.ndarray, first: Scene) -> TrainingResult:
    return reconstruct(tube_sequence, CONFIG, earlier=EarlierScene(first, old_frames, 80))


class TestReconstruct:
    def test_new_frames_are_matched_in_fewer_iterations(
        self,
        tube_sequence: EndoscopicSequence,
        old_frames: np.ndarray,
        first: Scene,
        continued: TrainingResult,
    ) -> None:
        new = np.setdiff1d(tube_sequence.train, old_frames)
        assert psnr_of(continued.scene, tube_sequence, new) > psnr_of(first, tube_sequence, new) + 1
        short = reconstruct(tube_sequence, CONFIG.model_copy(update={"iterations": 80})).scene
        train = tube_sequence.train
        assert psnr_of(continued.scene, tube_sequence, train) > psnr_of(short, tube_sequence, train)

    def test_so_many_iterations(
        self, tube_sequence: EndoscopicSequence, old_frames: np.ndarray, first: Scene
    ) -> None:
        seen: list[Event] = []
        with subscribed(seen.append):
            reconstruct(tube_sequence, CONFIG, earlier=EarlierScene(first, old_frames, 12))
        steps = [event for event in seen if isinstance(event, Progress)]
        assert (steps[-1].done, steps[-1].total) == (12, 12)

    def test_same_input_same_bits_and_the_start_stays(
        self, tube_sequence: EndoscopicSequence, old_frames: np.ndarray, first: Scene
    ) -> None:
        before = first.gaussians.means.clone()
        start = EarlierScene(first, old_frames, 15)
        one, other = (reconstruct(tube_sequence, CONFIG, earlier=start).scene for _ in range(2))
        for name, value in one.gaussians.parameters().items():
            assert torch.equal(value, other.gaussians.parameters()[name]), name
        assert torch.equal(first.gaussians.means, before)

    def test_held_out_frames_change_nothing(
        self, tube_sequence: EndoscopicSequence, old_frames: np.ndarray, first: Scene
    ) -> None:
        rgb = tube_sequence.rgb.copy()
        rgb[tube_sequence.test] = 0
        start = EarlierScene(first, old_frames, 15)
        one = reconstruct(tube_sequence, CONFIG, earlier=start).scene
        other = reconstruct(replace(tube_sequence, rgb=rgb), CONFIG, earlier=start).scene
        assert torch.equal(one.gaussians.means, other.gaussians.means)

    def test_refined_poses_are_refused(
        self, tube_sequence: EndoscopicSequence, old_frames: np.ndarray, first: Scene
    ) -> None:
        refining = CONFIG.model_copy(update={"refine_poses": True})
        with pytest.raises(ConfigError, match="refine_poses"):
            reconstruct(tube_sequence, refining, earlier=EarlierScene(first, old_frames, 10))


class TestStart:
    def test_exposures_go_to_their_frames(
        self, tube_sequence: EndoscopicSequence, old_frames: np.ndarray, first: Scene
    ) -> None:
        train = tube_sequence.train
        shuffled = old_frames[::-1].copy()
        assert first.light is not None
        light = replace(first.light, log_exposure=first.light.log_exposure.flip(0) + 0.3)
        start = continued_start(
            EarlierScene(Scene(first.gaussians, light), shuffled, 10), tube_sequence, train, CONFIG
        )
        assert start.light is not None
        places = np.searchsorted(train, old_frames)
        torch.testing.assert_close(start.light.exposures()[places], first.light.exposures())
        new = np.setdiff1d(np.arange(len(train)), places)
        torch.testing.assert_close(start.light.exposures()[new], torch.ones(len(new)))

    def test_points_are_added_where_the_scene_explains_nothing(
        self, tube_sequence: EndoscopicSequence, old_frames: np.ndarray, first: Scene
    ) -> None:
        new = np.setdiff1d(tube_sequence.train, old_frames)
        before = unexplained_pixels(first, tube_sequence, new)
        start = continued_start(
            EarlierScene(first, old_frames, 10), tube_sequence, tube_sequence.train, CONFIG
        )
        assert before.sum() > 100
        assert len(start.gaussians) > len(first.gaussians)
        assert torch.equal(start.gaussians.means[: len(first.gaussians)], first.gaussians.means)
        assert tube_sequence.depth_mm is not None
        added = start.gaussians.means[len(first.gaussians) :].numpy().astype(np.float64)
        hit = np.zeros(len(added), dtype=bool)
        for where, frame in zip(before, new, strict=True):
            (pixels,), (z,) = tube_sequence.cameras[int(frame)].project(added)
            inside = tube_sequence.cameras.contains(pixels)
            column, row = pixels[inside].astype(np.int64).T
            near = np.abs(tube_sequence.depth_mm[frame][row, column] - z[inside]) < 0.05 * z[inside]
            hit[inside] |= where[row, column] & near
        # Averages of a cell beside an edge may fall on the other side of it.
        assert hit.mean() > 0.8

    def test_a_full_scene_gives_room_from_what_shows_least(
        self, tube_sequence: EndoscopicSequence, old_frames: np.ndarray, first: Scene
    ) -> None:
        limit = len(first.gaussians)
        full = CONFIG.model_copy(update={"densify": DensifyConfig(enabled=True, max_gaussians=limit)})
        start = continued_start(EarlierScene(first, old_frames, 10), tube_sequence, tube_sequence.train, full)
        assert len(start.gaussians) <= limit
        gone = ~torch.isin(first.gaussians.means[:, 0], start.gaussians.means[:, 0])
        assert gone.any()

        def lost(without: torch.Tensor) -> float:
            """Squared difference in the frames when some Gaussians are missing."""
            fewer = Scene(first.gaussians.subset(~without), first.light)
            cameras = tube_sequence.cameras[tube_sequence.train]
            with torch.no_grad():
                return float((fewer.render(cameras).rgb - first.render(cameras).rgb).square().mean())

        others = gone[torch.randperm(len(gone), generator=torch.Generator().manual_seed(0))]
        assert lost(gone) < 0.3 * lost(others)

    def test_what_shows_beyond_the_masks_gives_room_first(
        self, tube_sequence: EndoscopicSequence, old_frames: np.ndarray, first: Scene
    ) -> None:
        """A round picture: what a scene shows in its corners is not what the frames tell."""
        x, y = np.meshgrid(*(np.linspace(-1, 1, size) for size in tube_sequence.rgb.shape[2:0:-1]))
        inside = np.broadcast_to(np.hypot(x, y) < 0.6, tube_sequence.mask.shape)
        cameras = tube_sequence.cameras[tube_sequence.train]
        limit = len(first.gaussians) * 2 // 3
        full = CONFIG.model_copy(update={"densify": DensifyConfig(enabled=True, max_gaussians=limit)})

        def lost(mask: np.ndarray) -> float:
            """Squared difference inside the picture when what gave room is missing."""
            start = continued_start(
                EarlierScene(first, old_frames, 10),
                replace(tube_sequence, mask=mask),
                tube_sequence.train,
                full,
            )
            kept = torch.isin(first.gaussians.means[:, 0], start.gaussians.means[:, 0])
            fewer = Scene(first.gaussians.subset(kept), first.light)
            with torch.no_grad():
                off = (fewer.render(cameras).rgb - first.render(cameras).rgb).square()
            return float(off.mean(dim=-1)[:, torch.from_numpy(inside[0].copy())].mean())

        assert lost(inside.copy()) < 0.5 * lost(np.ones_like(inside))

    def test_points_of_new_frames_leave_the_others_their_share(
        self, tube_sequence: EndoscopicSequence, old_frames: np.ndarray, first: Scene
    ) -> None:
        limit = 100
        crowded = CONFIG.model_copy(
            update={"max_points": 4000, "densify": DensifyConfig(max_gaussians=limit)}
        )
        train = tube_sequence.train
        start = continued_start(EarlierScene(first, old_frames, 10), tube_sequence, train, crowded)
        stayed = torch.isin(start.gaussians.means[:, 0], first.gaussians.means[:, 0])
        assert int(stayed.sum()) >= limit * len(old_frames) // len(train)
        assert not bool(stayed.all())
        assert len(start.gaussians) <= limit

    def test_depth_that_differs_is_unexplained(
        self, tube_sequence: EndoscopicSequence, old_frames: np.ndarray, first: Scene
    ) -> None:
        assert tube_sequence.depth_mm is not None
        nearer = replace(tube_sequence, depth_mm=tube_sequence.depth_mm * np.float32(0.7))
        right = unexplained_pixels(first, tube_sequence, old_frames).mean()
        assert right < 0.2
        assert unexplained_pixels(first, nearer, old_frames).mean() > 0.7

    def test_new_frames_that_see_no_point_add_none(
        self,
        tube_sequence: EndoscopicSequence,
        old_frames: np.ndarray,
        first: Scene,
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        behind = tube_sequence.cameras.centers[0] - 1000 * tube_sequence.cameras.world_from_camera[0, :3, 2]
        known = replace(tube_sequence, depth_mm=None, points=np.repeat(behind[None], 50, axis=0))
        start = continued_start(EarlierScene(first, old_frames, 10), known, known.train, CONFIG)
        assert len(start.gaussians) == len(first.gaussians)
        assert "new frames add no starting points" in caplog.text

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"sh_degree": 2}, "harmonics of degree 1, expected 2"),
            ({"light": CONFIG.light.model_copy(update={"enabled": False})}, "coarse.light.enabled"),
        ],
    )
    def test_a_scene_of_another_kind_is_refused(
        self,
        change: dict[str, object],
        message: str,
        tube_sequence: EndoscopicSequence,
        old_frames: np.ndarray,
        first: Scene,
    ) -> None:
        config = CONFIG.model_copy(update=change)
        with pytest.raises(ShapeError, match=message):
            continued_start(EarlierScene(first, old_frames, 10), tube_sequence, tube_sequence.train, config)

    def test_frames_that_do_not_train_are_refused(
        self, tube_sequence: EndoscopicSequence, old_frames: np.ndarray, first: Scene
    ) -> None:
        held_out = np.concatenate([old_frames[:-1], tube_sequence.test[:1]])
        with pytest.raises(ShapeError, match="expected that all of them are among"):
            reconstruct(tube_sequence, CONFIG, earlier=EarlierScene(first, held_out, 10))
        with pytest.raises(ShapeError, match="exposures, expected one for each"):
            reconstruct(tube_sequence, CONFIG, earlier=EarlierScene(first, old_frames[:-1], 10))

    @pytest.mark.parametrize("dtype", [np.int64, np.uint8, np.uint64])
    def test_frames_out_of_order_are_refused(
        self, tube_sequence: EndoscopicSequence, old_frames: np.ndarray, first: Scene, dtype: type
    ) -> None:
        """Without a sign, the difference of two indices is never below zero."""
        # Callers' arrays are checked in tests alone, and those without a sign are none that should come.
        check = inspect.unwrap(continuing._check_fits)
        earlier = EarlierScene(first, old_frames, 10)
        in_order = tube_sequence.train.astype(dtype)
        check(earlier, tube_sequence, in_order, CONFIG)
        for frames in (in_order[::-1], np.concatenate([in_order, in_order[-1:]])):
            with pytest.raises(ShapeError, match="in ascending order"):
                check(earlier, tube_sequence, frames, CONFIG)


@pytest.mark.parametrize(
    ("shared", "frames", "expected"),
    [(99, 100, 300), (80, 100, 400), (50, 100, 1000), (1, 100, 1000)],
)
def test_iterations_follow_the_share_of_new_frames(shared: int, frames: int, expected: int) -> None:
    config = ContinuationConfig(iterations_per_new_share=2.0, min_iterations_share=0.3)
    assert continued_iterations(config, 1000, shared, frames) == expected
