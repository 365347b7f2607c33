from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from extrags.errors import CaptureError, ShapeError
from extrags.restoration.classical import ClassicalEnhancer
from extrags.restoration.clips import render_clips
from extrags.restoration.training_data.augmentation import cut_out, drop_references
from extrags.view_synthesis.conditioning import CONDITION_CHANNELS, Layers, condition, observe_views
from extrags.view_synthesis.gather import gather_references
from extrags.view_synthesis.references import LightTransfer
from tests.extrags.lit_tube import HEIGHT, WIDTH, Tube, cast_tube, tube_cameras


@pytest.fixture(scope="module")
def layers(tube: Tube) -> Layers:
    return observe_views(tube.scene, tube.references, tube_cameras(4, offset_mm=4.0), count=4).layers


class TestObservation:
    def test_a_training_view_is_known_and_a_gap_is_not(self, tube: Tube) -> None:
        own = observe_views(tube.scene, tube.references, tube.sequence.cameras[[3]], count=4).layers
        alpha, uncertainty = own.get("alpha"), own.get("uncertainty")
        assert uncertainty[alpha > 0.98].median() < 0.25
        assert (alpha < 0.1).any()
        assert uncertainty[alpha < 0.1].min() > 0.85

    def test_uncertainty_grows_with_the_angle(self, tube: Tube) -> None:
        medians = []
        for offset in (2.0, 9.0):
            seen = observe_views(tube.scene, tube.references, tube_cameras(4, offset_mm=offset), count=4)
            solid = seen.layers.get("alpha") > 0.95
            medians.append(float(seen.layers.get("uncertainty")[solid].median()))
        assert medians[1] > medians[0] + 0.05

    def test_everything_is_finite_and_in_range(self, layers: Layers) -> None:
        assert torch.isfinite(layers.data).all()
        for name in ("alpha", "uncertainty", "nearest_weight", "blend_weight", "blend", "nearest", "spread"):
            assert layers.get(name).min() >= 0, name
            assert layers.get(name).max() <= 1 + 1e-5, name

    def test_layers_refuse_another_number_of_channels(self) -> None:
        with pytest.raises(ShapeError):
            Layers(torch.zeros(1, 3, 8, 8))

    def test_no_real_view_is_an_error(self, tube: Tube) -> None:
        with pytest.raises(CaptureError):
            gather_references(tube.scene, tube.sequence, np.zeros(0, np.int64))

    def test_dark_corners_have_seen_nothing(self, tube: Tube) -> None:
        frames = tube.sequence.train
        mask = tube.sequence.mask.copy()
        mask[..., WIDTH // 2 :] = False
        masked = replace(tube.sequence, mask=mask)
        whole = gather_references(tube.scene, tube.sequence, frames)
        half = gather_references(tube.scene, masked, frames)
        own = tube.scene.render(tube.sequence.cameras[frames]).means2d.numpy()
        for view in range(len(frames)):
            seen, before = half.seen[view].numpy(), whole.seen[view].numpy()
            assert not (seen & ~before).any()
            # Gaussians reach a few pixels from their centres.
            inside, outside = own[view, :, 0] < WIDTH / 2 - 12, own[view, :, 0] > WIDTH / 2 + 12
            assert np.array_equal(seen[inside], before[inside])
            assert (before & outside).any()
            assert not seen[outside].any()
        assert torch.equal(half.of_scene(tube.scene).seen, half.seen)

    def test_depth_is_known_inside_the_mask_and_taken_from_the_scene_where_the_frame_has_none(
        self, tube: Tube
    ) -> None:
        assert tube.sequence.depth_mm is not None
        frames = tube.sequence.train[:2]
        mask, depth_mm = tube.sequence.mask.copy(), tube.sequence.depth_mm.copy()
        mask[..., WIDTH // 2 :] = False
        depth_mm[:, : HEIGHT // 2] = 0
        partly = replace(tube.sequence, mask=mask, depth_mm=depth_mm)
        found = gather_references(tube.scene, partly, frames, exposure=torch.ones(2)).packed
        assert not found[:, 4:, :, WIDTH // 2 :].any()
        assert found[:, 5, HEIGHT // 2 :, : WIDTH // 2].all()
        rendered = tube.scene.render(tube.sequence.cameras[frames])
        solid = rendered.alpha[:, : HEIGHT // 2, : WIDTH // 2] > 0.9
        assert solid.float().mean() > 0.5
        assert torch.equal(found[:, 5, : HEIGHT // 2, : WIDTH // 2] > 0, solid)

    def test_saturated_pixels_are_hardly_trusted(self, tube: Tube) -> None:
        frames = tube.sequence.train[:1]
        rgb = tube.sequence.rgb.copy()
        rgb[frames[0], 20:24, 30:34] = 255
        bright = gather_references(
            tube.scene, replace(tube.sequence, rgb=rgb), frames, exposure=torch.ones(1)
        ).packed[0, 3]
        assert bright[20:24, 30:34].max() <= 0.1
        assert bright[10:18, 20:28].min() == 1

    def test_exposures_must_belong_to_the_frames(self, tube: Tube) -> None:
        with pytest.raises(ShapeError, match="exposures"):
            gather_references(tube.scene, tube.sequence, np.array([0, 1]))


class TestCondition:
    def test_shapes(self, tube: Tube, layers: Layers) -> None:
        conditioning = condition(layers, tube.references.transfer)
        assert conditioning.channels.shape == (4, CONDITION_CHANNELS, HEIGHT, WIDTH)
        assert torch.isfinite(conditioning.channels).all()
        assert conditioning.depth_mm.min() > 0

    def test_dropped_references_leave_no_trace(self, tube: Tube, layers: Layers) -> None:
        dropped = drop_references(Layers(layers.data.clone()))
        dark = Layers(dropped.data.clone())
        dark.get("blend").zero_()
        dark.get("nearest").zero_()
        transfer = tube.references.transfer
        assert torch.equal(condition(dropped, transfer).channels, condition(dark, transfer).channels)

    def test_a_cut_out_hole_is_filled_from_its_surroundings(self, tube: Tube, layers: Layers) -> None:
        kept = torch.ones(1, 1, HEIGHT, WIDTH)
        kept[..., 10:25, 20:35] = 0
        cut = cut_out(Layers(layers.data.clone()), kept, unseen=True)
        assert cut.get("alpha")[..., 10:25, 20:35].max() == 0
        assert cut.get("uncertainty")[..., 10:25, 20:35].min() == 1
        base = condition(cut, tube.references.transfer).base
        assert base[..., 10:25, 20:35].min() > 0.01

    @pytest.mark.parametrize("faint", [1e-2, 1e-5, 1e-20])
    def test_faint_evidence_keeps_its_colour(self, layers: Layers, faint: float) -> None:
        """It is no darker than what is known well: the base image is grey where all that is seen is."""
        grey, unlit = Layers(layers.data.clone()), LightTransfer(None, 0.0, 10.0)
        for name in ("rendered", "nearest", "invented", "alpha", "invented_weight", "blend_weight"):
            grey.get(name).zero_()
        grey.get("blend").fill_(0.5)
        grey.get("blend_weight").fill_(faint)[..., :8] = 1
        base = condition(grey, unlit).base
        torch.testing.assert_close(base, torch.full_like(base, 0.5), atol=1e-4, rtol=0)

    def test_a_hole_may_keep_what_was_invented(self, layers: Layers) -> None:
        before = Layers(layers.data.clone())
        before.get("invented").fill_(0.4)
        before.get("invented_weight").fill_(0.5)
        kept = torch.ones(1, 1, HEIGHT, WIDTH)
        kept[..., 10:25, 20:35] = 0
        hole = (..., slice(10, 25), slice(20, 35))
        parts = [
            cut_out(Layers(before.data.clone()), kept, unseen=True, keep_invented=keep)
            for keep in (True, False)
        ]
        assert torch.equal(parts[0].get("invented_weight"), before.get("invented_weight"))
        assert torch.equal(parts[0].get("depth_mm")[hole], before.get("depth_mm")[hole])
        assert parts[1].get("invented_weight")[hole].max() == 0
        assert parts[1].get("depth_mm")[hole].max() == 0
        outside = kept.expand(len(layers), -1, -1, -1) > 0
        assert (parts[1].get("invented_weight")[outside] == 0.5).all()


class TestClassical:
    def test_leaves_no_holes_and_beats_the_rendering(self, tube: Tube) -> None:
        cameras = tube_cameras(4, offset_mm=4.0, start_mm=3.0)
        target, _ = cast_tube(cameras, tube.references.transfer.light)
        clip = render_clips(tube.scene, tube.references, [cameras], count=4)[0]
        restored = ClassicalEnhancer().restore(clip).rgb
        rendered = clip.layers.get("rendered").permute(0, 2, 3, 1).numpy()
        hole = clip.layers.get("alpha")[:, 0].numpy() < 0.3
        assert hole.any()
        assert restored[hole].min() > 0.01

        def psnr(image: np.ndarray) -> float:
            return float(-10 * np.log10(np.square(image - target).mean()))

        assert psnr(restored) > psnr(rendered) + 2
