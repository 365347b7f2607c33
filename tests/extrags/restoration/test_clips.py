from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import TypeCheckError

from extrags.cameras import pose_distances
from extrags.confidence import PerceptualDifference, image_confidence, pixel_confidence
from extrags.config import EnhanceConfig
from extrags.errors import ShapeError
from extrags.metrics.lpips import Lpips
from extrags.pseudo_views import PseudoViews
from extrags.restoration.classical import ClassicalEnhancer
from extrags.restoration.clips import choose_views, keep_known, make_pseudo_observations, render_clips
from extrags.restoration.trajectories import restore, restore_batch
from extrags.view_synthesis.conditioning import observe_views
from tests.extrags.lit_tube import Tube, tube_cameras


@pytest.fixture(scope="module")
def pseudo(tube: Tube) -> PseudoViews:
    trajectories = [tube_cameras(3, offset_mm=4.0), tube_cameras(2, offset_mm=6.0, turn=0.5)]
    return make_pseudo_observations(
        tube.scene,
        tube.references,
        trajectories,
        ClassicalEnhancer(),
        PerceptualDifference(None, "test"),
        count=4,
        first_index=7,
    )


class TestPseudoObservations:
    def test_contents(self, tube: Tube, pseudo: PseudoViews) -> None:
        assert len(pseudo) == 5
        assert pseudo.clip.tolist() == [7, 7, 7, 8, 8]
        assert set(pseudo.reference) <= set(tube.sequence.train)
        assert pseudo.provenance["pixel_confidence"] == "perceptual_map"
        for name in ("rendered", "restored", "target", "uncertainty", "pixel_confidence", "image_confidence"):
            values = getattr(pseudo, name)
            assert np.isfinite(values).all()
            assert values.min() >= 0
            assert values.max() <= 1
        assert pseudo.depth_mm.min() > 0
        assert 0 < pseudo.changed_share < 1

    def test_the_image_weight_compares_with_the_nearest_view(self, tube: Tube) -> None:
        cameras = tube_cameras(3, offset_mm=6.0, turn=0.8)
        scale = tube.references.transfer.scale_mm
        nearest = pose_distances(cameras, tube.references.cameras, scale).argmin(axis=1)
        named = observe_views(tube.scene, tube.references, cameras, count=4, reference="nearest")
        np.testing.assert_array_equal(named.reference, nearest)
        for iou in ("reference", "union"):
            (clip,) = render_clips(
                tube.scene, tube.references, [cameras], count=4, reference="nearest", iou=iou
            )
            np.testing.assert_array_equal(clip.reference, nearest)
            expected = image_confidence(named.seen, tube.references.seen[nearest], iou)
            np.testing.assert_allclose(clip.image_confidence, expected)
        assert (image_confidence(named.seen, tube.references.seen[nearest]) < expected).all()

    def test_holes_take_the_restored_colour(self, pseudo: PseudoViews) -> None:
        hole = pseudo.alpha < 0.05
        assert hole.any()
        assert np.abs(pseudo.target - pseudo.restored)[hole].max() < 0.05

    def test_batches_do_not_change_the_result(self, tube: Tube, pseudo: PseudoViews) -> None:
        alone = make_pseudo_observations(
            tube.scene,
            tube.references,
            [tube_cameras(2, offset_mm=6.0, turn=0.5)],
            ClassicalEnhancer(),
            PerceptualDifference(None, "test"),
            count=4,
            first_index=8,
        )
        assert np.array_equal(alone.target, pseudo.target[3:])
        assert np.array_equal(alone.pixel_confidence, pseudo.pixel_confidence[3:])

    def test_save_and_load(self, pseudo: PseudoViews, tmp_path) -> None:
        pseudo.save(tmp_path / "pseudo")
        loaded = PseudoViews.load(tmp_path / "pseudo")
        for name in ("rendered", "restored", "target", "alpha", "uncertainty", "pixel_confidence"):
            assert np.abs(getattr(loaded, name) - getattr(pseudo, name)).max() <= 0.5 / 255 + 1e-6
        assert np.array_equal(loaded.depth_mm, pseudo.depth_mm)
        assert np.array_equal(loaded.cameras.world_from_camera, pseudo.cameras.world_from_camera)
        assert np.array_equal(loaded.image_confidence, pseudo.image_confidence)
        assert np.array_equal(loaded.reference, pseudo.reference)
        assert loaded.provenance == pseudo.provenance
        loaded.save(tmp_path / "again")
        twice = PseudoViews.load(tmp_path / "again")
        assert np.array_equal(twice.target, loaded.target)

    def test_confidences_above_one_keep_their_steps(self, pseudo: PseudoViews, tmp_path) -> None:
        confidence = 3 * pseudo.pixel_confidence
        confidence[0] = np.minimum(confidence[0], 1)
        assert confidence.max() > 1
        raw = replace(pseudo, pixel_confidence=confidence)
        raw.save(tmp_path / "pseudo")
        loaded = PseudoViews.load(tmp_path / "pseudo").pixel_confidence
        assert np.abs(loaded - confidence).max() <= 0.5 / 255 + 1e-6
        assert np.array_equal(loaded, raw.quantised().pixel_confidence)
        # What a batch is stored with does not depend on the others.
        bounded = replace(raw, pixel_confidence=np.minimum(confidence, 1))
        assert np.array_equal(loaded[0], bounded.quantised().pixel_confidence[0])

    @pytest.mark.parametrize("form", ["bounded", "raw"])
    def test_the_settings_say_which_form_confidences_have(
        self, tube: Tube, shared_data: Path, form: Literal["bounded", "raw"]
    ) -> None:
        weights = next((shared_data / "lpips_weights").glob("*alex*.npz"))
        measure = PerceptualDifference(Lpips.load(weights, "alex"))
        views = restore_batch(
            tube.scene,
            tube.sequence,
            [tube_cameras(2, offset_mm=6.0, turn=0.5)],
            ClassicalEnhancer(),
            EnhanceConfig(pixel_confidence=form),
            0,
            measure,
        )
        compared = views.restored if form == "raw" else views.target
        expected = pixel_confidence(views.rendered, compared, replace(measure, raw=form == "raw"))
        assert np.array_equal(views.pixel_confidence, expected)
        assert views.provenance["pixel_confidence"] == {"bounded": "", "raw": "raw_"}[form] + "lpips_alex"

    def test_virtual_views_are_no_wider_than_the_settings_say(self, tube: Tube) -> None:
        cameras = tube_cameras(2, offset_mm=6.0, turn=0.5)

        def restored(max_width: int | None) -> PseudoViews:
            config = EnhanceConfig(max_width=max_width)
            measure = PerceptualDifference(None, "test")
            return restore_batch(
                tube.scene, tube.sequence, [cameras], ClassicalEnhancer(), config, 0, measure
            )

        small, whole, wide = restored(cameras.width // 2), restored(None), restored(cameras.width)
        assert (small.cameras.width, small.cameras.height) == (cameras.width // 2, cameras.height // 2)
        assert small.target.shape[1:3] == (cameras.height // 2, cameras.width // 2)
        assert np.array_equal(wide.target, whole.target)
        # The same views: what they show agrees with the larger ones, averaged.
        blocks = whole.restored.reshape(len(whole), cameras.height // 2, 2, cameras.width // 2, 2, 3)
        assert np.abs(small.restored - blocks.mean(axis=(2, 4))).mean() < 0.05

    @pytest.mark.parametrize("lengths", [(), (1,), (1, 1)])
    def test_without_any_virtual_view(self, tube: Tube, lengths: tuple[int, ...]) -> None:
        """Told before a restorer is made, which takes long."""
        starts = [tube_cameras(length) for length in lengths]
        with pytest.raises(ShapeError, match="test/tube: no trajectory"):
            restore(tube.scene, tube.sequence, starts, EnhanceConfig(backend="classical"))

    def test_sizes_are_checked(self, pseudo: PseudoViews) -> None:
        with pytest.raises((ShapeError, TypeCheckError), match="alpha"):
            replace(pseudo, alpha=pseudo.alpha[:, :-1])
        with pytest.raises(ShapeError):
            PseudoViews.concatenated([])


class TestKeepKnown:
    def test_known_pixels_stay_and_unknown_ones_are_restored(self) -> None:
        rendered = np.zeros((1, 32, 32, 3), np.float32)
        restored = np.ones((1, 32, 32, 3), np.float32)
        uncertainty = np.zeros((1, 32, 32), np.float32)
        uncertainty[:, 12:20, 12:20] = 1
        target, feathered = keep_known(rendered, restored, uncertainty)
        assert target[0, 12:20, 12:20].min() == 1
        assert target[0, :4].max() < 1e-3
        steps = np.abs(np.diff(target[0, 16, :, 0]))
        assert 0 < steps.max() < 0.35
        assert (feathered >= uncertainty).all()

    def test_sizes_must_fit(self) -> None:
        image = np.zeros((1, 8, 8, 3), np.float32)
        with pytest.raises((ShapeError, TypeCheckError)):
            keep_known(image, image, np.zeros((1, 8, 9), np.float32))


class TestChooseViews:
    @given(
        lengths=st.lists(st.integers(0, 30), min_size=1, max_size=20),
        spare=st.integers(0, 200),
    )
    def test_within_budget_without_starts_and_with_ends(self, lengths: list[int], spare: int) -> None:
        longer = sum(length > 1 for length in lengths)
        chosen = choose_views(lengths, longer + spare + 1)
        assert sum(map(len, chosen)) <= longer + spare + 1
        for length, views in zip(lengths, chosen, strict=True):
            if length > 1:
                assert views[-1] == length - 1
                assert views[0] >= 1
                assert (np.diff(views) > 0).all()
            else:
                assert len(views) == 0

    def test_all_views_fit(self) -> None:
        assert [v.tolist() for v in choose_views([4, 3], 100)] == [[1, 2, 3], [1, 2]]

    def test_fewer_views_than_trajectories_keep_the_ends_of_the_first(self) -> None:
        assert [v.tolist() for v in choose_views([5, 4, 6], 2)] == [[4], [3], []]
        # A batch would fail without any view: there is none for the third trajectory.
        assert EnhanceConfig(max_views=2, clips_per_batch=1).batches(3) == 2
