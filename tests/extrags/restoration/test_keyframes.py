from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from extrags.cameras import Cameras
from extrags.confidence import PerceptualDifference
from extrags.config import EnhanceConfig
from extrags.errors import ShapeError
from extrags.restoration.benchmark.evaluation import RestorerBenchmark, TrueViews, restore_views
from extrags.restoration.classical import ClassicalEnhancer
from extrags.restoration.clips import render_clips
from extrags.restoration.keyframes import Keyframes, choose_keyframes, following, make_keyframes
from extrags.restoration.protocol import Clip, Restoration
from extrags.restoration.trajectories import restore, restore_batch, restore_keyframes
from extrags.view_synthesis.conditioning import known_share
from tests.extrags.lit_tube import Tube, cast_tube, tube_cameras

TRAJECTORIES = [
    tube_cameras(4, offset_mm=offset, start_mm=start, turn=turn)
    for offset, start, turn in ((4.0, 16.0, 0.0), (6.0, 15.0, 0.1), (2.0, 18.0, -0.1))
]
SETTINGS = EnhanceConfig(backend="classical", references=4, keyframes=3, clips_per_batch=2)
MEASURE = PerceptualDifference(None, "test")


class Fanciful:
    """Paints what nothing shows, in every clip with another colour."""

    name = "fanciful"
    follows_keyframes = True

    def restore(self, clip: Clip) -> Restoration:
        base = ClassicalEnhancer().restore(clip).rgb
        weight = clip.layers.get("invented_weight")
        unknown = (1 - known_share(clip.layers) - weight).clamp(0, 1)[:, 0, ..., None].numpy()
        color = np.random.default_rng(clip.index).uniform(0.1, 0.9, 3).astype(np.float32)
        return Restoration((1 - unknown) * base + unknown * color, None, {"backend": self.name})

    def save(self, path: Path) -> None:
        raise NotImplementedError


class Deaf(Fanciful):
    follows_keyframes = False


def flat_views(places: list[float]) -> Cameras:
    """Views of a plane 10 mm away, moved along it; one millimetre is two pixels, the image 20 mm wide."""
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, 0, 3] = places
    K = np.array([[20.0, 0, 20], [0, 20.0, 8], [0, 0, 1]])
    return Cameras(np.tile(K, (len(places), 1, 1)), poses, 40, 16)


class TestChoice:
    def test_each_adds_most_and_those_that_add_nothing_are_left_out(self) -> None:
        cameras = flat_views([0.0, 1.0, 60.0, 61.0, 120.0])
        depth = torch.full((5, 1, 16, 40), 10.0)
        missing = torch.zeros(5, 1, 16, 40)
        missing[0, ..., 10:16] = 1
        missing[1, ..., 8:16] = 1
        missing[2:4, ..., 20:24] = 1
        chosen = choose_keyframes(cameras, depth, missing, 5)
        # The second view sees a wider hole than the first and all of its; the last misses nothing.
        assert chosen[0] == 1
        assert chosen[1] in (2, 3)
        assert 4 not in chosen
        assert choose_keyframes(cameras, depth, missing, 1) == chosen[:1]

    def test_a_view_that_adds_nothing_is_left_out(self) -> None:
        cameras = flat_views([0.0, 0.0, 60.0])
        depth = torch.full((3, 1, 16, 40), 10.0)
        missing = torch.zeros(3, 1, 16, 40)
        missing[..., 10:16] = 1
        assert sorted(choose_keyframes(cameras, depth, missing, 3)) == [0, 2]

    def test_the_nearer_of_two_views_of_one_hole_serves_both(self) -> None:
        cameras = flat_views([0.0, 0.0])
        cameras.world_from_camera[1, 2, 3] = -10.0
        depth = torch.full((2, 1, 16, 40), 10.0)
        depth[1] = 20.0
        missing = torch.zeros(2, 1, 16, 40)
        missing[0, ..., 4:12, 12:28] = 1
        missing[1, ..., 6:10, 16:24] = 1
        assert choose_keyframes(cameras, depth, missing, 1) == [0]

    def test_what_stands_before_a_hole_does_not_show_it(self) -> None:
        cameras = flat_views([0.0, 0.0])
        depth = torch.full((2, 1, 16, 40), 10.0)
        depth[1] = 30.0
        missing = torch.zeros(2, 1, 16, 40)
        missing[..., 10:16] = 1
        assert sorted(choose_keyframes(cameras, depth, missing, 2)) == [0, 1]

    def test_nothing_missing_needs_none(self) -> None:
        cameras = flat_views([0.0, 1.0])
        depth = torch.full((2, 1, 16, 40), 10.0)
        assert choose_keyframes(cameras, depth, torch.zeros_like(depth), 4) == []
        assert choose_keyframes(cameras, depth, torch.ones_like(depth), 0) == []

    def test_greedy_never_takes_more_than_allowed(self) -> None:
        generator = torch.Generator().manual_seed(1)
        cameras = flat_views(list(np.arange(8) * 7.0))
        depth = 10 + torch.rand(8, 1, 16, 40, generator=generator)
        missing = (torch.rand(8, 1, 16, 40, generator=generator) > 0.5).float()
        whole = choose_keyframes(cameras, depth, missing, 8)
        assert len(set(whole)) == len(whole)
        for count in range(1, 8):
            assert choose_keyframes(cameras, depth, missing, count) == whole[:count]


class TestKeyframes:
    def test_they_are_views_that_are_restored(self, tube: Tube) -> None:
        clips = [cameras[1:] for cameras in TRAJECTORIES]
        found = make_keyframes(tube.scene, tube.references, clips, ClassicalEnhancer(), SETTINGS)
        assert 1 <= len(found) <= 3
        for (clip, view), pose in zip(found.view, found.cameras.world_from_camera, strict=True):
            np.testing.assert_array_equal(pose, clips[clip].world_from_camera[view])
        assert found.depth_mm.min() > 0
        assert found.unknown.max() > 200
        again = restore_keyframes(tube.scene, tube.sequence, TRAJECTORIES, ClassicalEnhancer(), SETTINGS)
        assert np.array_equal(again.rgb, found.rgb)

    def test_each_has_the_exposure_of_its_view(self, tube: Tube) -> None:
        clips = [cameras[1:] for cameras in TRAJECTORIES]
        gains = 0.5 + torch.arange(9).reshape(3, 3) / 10
        found = make_keyframes(
            tube.scene, tube.references, clips, ClassicalEnhancer(), SETTINGS, exposure=list(gains)
        )
        assert found.view[:, 1].any()
        np.testing.assert_array_equal(found.exposure, gains.numpy()[found.view[:, 0], found.view[:, 1]])

    def test_others_are_shown_them_at_their_exposures(self, tube: Tube) -> None:
        clips = [cameras[1:] for cameras in TRAJECTORIES]
        found = make_keyframes(tube.scene, tube.references, clips, ClassicalEnhancer(), SETTINGS)
        gains = np.linspace(0.5, 0.8, len(found), dtype=np.float32)
        invented = replace(found, exposure=gains).invented(tube.references.transfer)
        assert invented is not None
        np.testing.assert_array_equal(invented.views.exposure, gains)

    def test_a_later_one_follows_the_earlier(self, tube: Tube) -> None:
        # The same view in two clips: alone, each paints it with a colour of its own.
        twice = [TRAJECTORIES[0][[1]], TRAJECTORIES[0][[1]]]
        clips = render_clips(tube.scene, tube.references, twice, count=4)
        enhancer = Fanciful()
        alone = [enhancer.restore(clip).rgb for clip in clips]
        hole = known_share(clips[0].layers)[:, 0].numpy() < 0.2
        assert np.abs(alone[0] - alone[1])[hole].mean() > 0.1
        first = make_keyframes(
            tube.scene, tube.references, twice, enhancer, SETTINGS.model_copy(update={"keyframes": 1})
        )
        invented = first.invented(tube.references.transfer)
        both = [enhancer.restore(following(clip, invented)).rgb for clip in clips]
        assert np.abs(both[0] - both[1])[hole].mean() < 0.4 * np.abs(alone[0] - alone[1])[hole].mean()

    def test_none_where_they_are_switched_off_or_not_followed(self, tube: Tube) -> None:
        off = SETTINGS.model_copy(update={"keyframes": 0})
        for enhancer, config in ((ClassicalEnhancer(), off), (Deaf(), SETTINGS)):
            found = restore_keyframes(tube.scene, tube.sequence, TRAJECTORIES, enhancer, config)
            assert len(found) == 0
            assert found.invented(tube.references.transfer) is None

    def test_none_without_any_view(self, tube: Tube) -> None:
        nothing = [TRAJECTORIES[0][:0]]
        found = make_keyframes(tube.scene, tube.references, nothing, ClassicalEnhancer(), SETTINGS)
        assert len(found) == 0

    def test_save_and_load(self, tube: Tube, tmp_path: Path) -> None:
        found = restore_keyframes(tube.scene, tube.sequence, TRAJECTORIES, ClassicalEnhancer(), SETTINGS)
        for number, one in enumerate((found, Keyframes.none(TRAJECTORIES[0]))):
            one.save(tmp_path / str(number))
            loaded = Keyframes.load(tmp_path / str(number))
            for name in ("rgb", "depth_mm", "unknown", "exposure", "view"):
                np.testing.assert_array_equal(getattr(loaded, name), getattr(one, name))
            np.testing.assert_array_equal(loaded.cameras.world_from_camera, one.cameras.world_from_camera)

    def test_parts_must_fit(self) -> None:
        none = Keyframes.none(TRAJECTORIES[0])
        with pytest.raises(ShapeError, match="rgb"):
            replace(none, cameras=TRAJECTORIES[0])


class TestClipsThatFollow:
    def test_zero_keyframes_change_no_bit(self, tube: Tube) -> None:
        views = [
            restore_batch(
                tube.scene,
                tube.sequence,
                TRAJECTORIES,
                ClassicalEnhancer(),
                SETTINGS,
                0,
                MEASURE,
                keyframes=keyframes,
            )
            for keyframes in (None, Keyframes.none(TRAJECTORIES[0]))
        ]
        for name in ("restored", "target", "depth_mm", "uncertainty", "pixel_confidence"):
            assert np.array_equal(getattr(views[0], name), getattr(views[1], name)), name

    def test_batches_do_not_depend_on_each_other(self, tube: Tube) -> None:
        def restored(clips_per_batch: int, order: list[int]) -> list[np.ndarray]:
            config = SETTINGS.model_copy(update={"clips_per_batch": clips_per_batch})
            keyframes = restore_keyframes(tube.scene, tube.sequence, TRAJECTORIES, Fanciful(), config)
            parts = {
                batch: restore_batch(
                    tube.scene,
                    tube.sequence,
                    TRAJECTORIES,
                    Fanciful(),
                    config,
                    batch,
                    MEASURE,
                    keyframes=keyframes,
                )
                for batch in order
            }
            return [
                np.concatenate([getattr(parts[batch], name) for batch in sorted(order)])
                for name in ("restored", "depth_mm")
            ]

        for one, other in zip(restored(1, [2, 0, 1]), restored(3, [0]), strict=True):
            assert np.array_equal(one, other)

    def test_the_whole_restoration_uses_them(self, tube: Tube) -> None:
        with_them, without = (
            restore(
                tube.scene,
                tube.sequence,
                TRAJECTORIES,
                SETTINGS.model_copy(update={"keyframes": count}),
                measure=MEASURE,
                enhancer=Fanciful(),
            )
            for count in (3, 0)
        )
        hole = with_them.alpha < 0.2
        assert np.abs(with_them.restored - without.restored)[hole].mean() > 0.03
        known = with_them.uncertainty < 0.1
        np.testing.assert_allclose(with_them.target[known], without.target[known], atol=0.02)

    def test_what_was_invented_agrees(self, tube: Tube) -> None:
        light = tube.references.transfer.light
        clips = render_clips(tube.scene, tube.references, TRAJECTORIES, count=4)
        rgb, depth = cast_tube(Cameras.concatenated(TRAJECTORIES), light)
        truth = TrueViews(
            rgb.astype(np.float32), np.ones(depth.shape, bool), depth_mm=depth.astype(np.float32)
        )
        benchmark = RestorerBenchmark(clips, truth)
        enhancer = Fanciful()
        keyframes = make_keyframes(tube.scene, tube.references, TRAJECTORIES, enhancer, SETTINGS)
        invented = keyframes.invented(tube.references.transfer)
        alone = benchmark.figures(restore_views(enhancer, clips))["inconsistency"]
        told = benchmark.figures(restore_views(enhancer, [following(clip, invented) for clip in clips]))
        assert alone["of_photographs"] < 0.01
        assert told["inconsistency"]["across"] < 0.6 * alone["across"]
