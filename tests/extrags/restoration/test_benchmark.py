from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError

from extrags.cameras import Cameras, pixel_rays
from extrags.errors import CaptureError, ConfigError, ShapeError
from extrags.metrics.image import MAX_PSNR_DB, psnr, ssim
from extrags.metrics.lpips import Lpips
from extrags.restoration.benchmark.evaluation import (
    RestorerBenchmark,
    TrueViews,
    held_out_clips,
    restore_views,
)
from extrags.restoration.benchmark.inconsistency import view_pairs
from extrags.restoration.benchmark.variants import AsRendered
from extrags.restoration.clips import keep_known
from extrags.restoration.protocol import Clip, Restoration
from extrags.restoration.uncertainty.reliability_diagram import calibration, rank_correlation
from extrags.view_synthesis.conditioning import LAYER_CHANNELS, Layers
from extrags.view_synthesis.references import LightTransfer
from tests.extrags.lit_tube import Tube, cast_tube, tube_cameras

SIZE = (48, 16)


def plain_clip(views: int = 1, *, rendered: float = 0.6, index: int = 0) -> Clip:
    """Views of 48x16 px: a hole on the left half, well seen on the right."""
    width, height = SIZE
    right = (torch.arange(width) >= width // 2).float().expand(views, 1, height, width)
    layers = Layers(torch.zeros(views, LAYER_CHANNELS, height, width))
    planes = {
        "rendered": rendered,
        "alpha": right,
        "depth_mm": 10.0,
        "uncertainty": 1 - right,
        "ray_length": 1.0,
    }
    for name, values in planes.items():
        layers.get(name)[:] = values
    K = np.array([[30.0, 0, width / 2], [0, 30.0, height / 2], [0, 0, 1]])
    cameras = Cameras(np.tile(K, (views, 1, 1)), np.tile(np.eye(4), (views, 1, 1)), width, height)
    return Clip(index, cameras, layers, LightTransfer(None, 0.0, 10.0), np.zeros(views, int), np.ones(views))


class Given:
    """Hands out images, and what it expects of their error."""

    name = "given"

    def __init__(self, images: np.ndarray, expected: np.ndarray | None = None) -> None:
        self.images, self.expected, self.next = images.astype(np.float32), expected, 0

    def restore(self, clip: Clip) -> Restoration:
        part = slice(self.next, self.next + len(clip))
        self.next += len(clip)
        expected = None if self.expected is None else self.expected[part].astype(np.float32)
        return Restoration(self.images[part], expected, {"backend": self.name})

    def save(self, path) -> None:
        raise NotImplementedError


def flat_truth(value: float, views: int = 1) -> TrueViews:
    width, height = SIZE
    rgb = np.full((views, height, width, 3), value, np.float32)
    return TrueViews(rgb, np.ones(rgb.shape[:3], bool))


@pytest.fixture(scope="module")
def tube_benchmark(tube: Tube) -> RestorerBenchmark:
    test = tube.sequence.test
    clips = held_out_clips(tube.scene, tube.references, tube.sequence, test, count=4)
    return RestorerBenchmark(clips, TrueViews.of_sequence(tube.sequence, test))


class TestFigures:
    def test_a_perfect_restorer(self, tube_benchmark: RestorerBenchmark) -> None:
        found = tube_benchmark.evaluate(Given(tube_benchmark.truth.rgb))
        assert found["psnr"] == found["well"]["psnr"] == MAX_PSNR_DB
        assert found["ssim"] == pytest.approx(1)
        assert found["flicker"] == found["error_flicker"] == 0
        # Where the scene claims to know, its rendering stays.
        assert found["kept"]["psnr"] < MAX_PSNR_DB
        json.dumps(found, allow_nan=False)

    def test_none_is_the_rendering_compared_directly(
        self, tube: Tube, tube_benchmark: RestorerBenchmark
    ) -> None:
        found = tube_benchmark.evaluate(AsRendered())
        cameras = tube.sequence.cameras[tube.sequence.test]
        light = tube.scene.light
        assert light is not None
        gain = light.interpolated_exposures(tube.sequence.test, tube.sequence.train)
        with torch.no_grad():
            rendered = tube.references.shown(tube.scene).render(cameras, exposure=gain).rgb.clamp(0, 1)
        rendered = (255 * rendered).round() / 255
        truth = torch.from_numpy(tube.sequence.rgb[tube.sequence.test].astype(np.float32) / 255)
        assert found["psnr"] == pytest.approx(psnr(rendered, truth), abs=1e-6)
        assert found["ssim"] == pytest.approx(ssim(rendered, truth), abs=1e-6)
        assert found["changed_share"] == 0
        assert found["kept"]["psnr"] == pytest.approx(found["psnr"], abs=1e-4)
        assert "lpips_alex" not in found
        assert found["observed"]["psnr"] is None
        assert found["calibration"] is None

    def test_regions(self) -> None:
        clip = plain_clip()
        truth = flat_truth(0.4)
        benchmark = RestorerBenchmark([clip], truth)
        assert benchmark.pixel_share == {"well": 0.5, "hole": 0.5, "rim": pytest.approx(2 / SIZE[0])}
        left = np.arange(SIZE[0]) < SIZE[0] // 2
        images = np.where(left[None, None, :, None], truth.rgb + 0.4, truth.rgb + 0.2)
        found = benchmark.evaluate(Given(images))
        assert found["well"]["psnr"] == pytest.approx(-20 * np.log10(0.2))
        assert found["hole"]["psnr"] == pytest.approx(-20 * np.log10(0.4))
        # What is known stays as it was rendered, and its error too.
        assert found["kept"]["hole"]["psnr"] == pytest.approx(found["hole"]["psnr"])
        rendered = RestorerBenchmark([clip], truth).evaluate(AsRendered())
        assert rendered["psnr"] == pytest.approx(-20 * np.log10(0.2))
        assert 0.5 <= found["changed_share"] < 0.6

    def test_a_gain_is_divided_out(self, tube_benchmark: RestorerBenchmark) -> None:
        darker = tube_benchmark.evaluate(Given(0.6 * tube_benchmark.truth.rgb))
        assert darker["psnr"] < 30
        assert darker["aligned"]["psnr"] > 50
        assert darker["aligned"]["calibration"] is None

    def test_depth_of_holes(self) -> None:
        truth = replace(flat_truth(0.4), depth_mm=np.full((1, SIZE[1], SIZE[0]), 20.0, np.float32))
        truth.depth_mm[:, 0] = 0  # type: ignore[index]
        benchmark = RestorerBenchmark([plain_clip()], truth)
        restored = restore_views(Given(truth.rgb), [plain_clip()])
        assert benchmark.figures(restored)["hole_depth_error"] == {"mean": None, "median": None}
        # The right half is known, and its depth is not asked.
        left = np.arange(SIZE[0]) < SIZE[0] // 2
        depth = np.where(left, 20.0 * np.e, 1.0) * np.ones(truth.mask.shape)
        found = benchmark.figures(replace(restored, depth_mm=depth))["hole_depth_error"]
        assert found == {"mean": pytest.approx(1), "median": pytest.approx(1)}

    def test_errors_are_those_after_the_gain(self) -> None:
        clip = plain_clip()
        truth = flat_truth(0.4)
        # Twice as bright as the photograph on the left, which is the larger error, and less on the right.
        right = np.arange(SIZE[0]) >= SIZE[0] // 2
        images = 2 * np.where(right[None, None, :, None], truth.rgb - 0.1, truth.rgb)
        restored = replace(restore_views(Given(images), [clip]), predicted_error=images[..., 0] - 0.6)
        found = RestorerBenchmark([clip], truth).figures(restored)
        assert found["calibration"]["rank_correlation"] > 0.99
        # The gain by least squares leaves the left half too bright and the right one, by more, too dark.
        assert found["aligned"]["calibration"]["rank_correlation"] < -0.99

    def test_the_target_is_what_keep_known_makes(self) -> None:
        clip = plain_clip()
        restored = restore_views(Given(flat_truth(0.9).rgb), [clip])
        rendered = np.full_like(restored.rgb, 0.6)
        expected, _ = keep_known(rendered, restored.rgb, clip.layers.get("uncertainty")[:, 0].numpy())
        assert np.array_equal(restored.target, expected)
        assert restored.seconds_per_frame > 0

    def test_pixels_outside_the_mask_do_not_count(self) -> None:
        truth = flat_truth(0.4)
        mask = truth.mask.copy()
        mask[:, :, :10] = False
        images = truth.rgb.copy()
        images[:, :, :10] = 1.0
        observed = mask.copy()
        observed[:, :, 10:20] = False
        benchmark = RestorerBenchmark([plain_clip()], replace(truth, mask=mask, observed=observed))
        found = benchmark.evaluate(Given(images))
        assert found["psnr"] == found["unobserved"]["psnr"] == MAX_PSNR_DB
        assert benchmark.pixel_share["unobserved"] == pytest.approx(10 / 38)

    def test_a_handful_of_pixels_has_no_figure(self) -> None:
        truth = flat_truth(0.4)
        observed = np.ones_like(truth.mask)
        observed[0, 0, :2] = False
        found = RestorerBenchmark([plain_clip()], replace(truth, observed=observed)).evaluate(AsRendered())
        assert found["unobserved"]["psnr"] is None
        assert found["observed"]["psnr"] is not None

    @pytest.mark.weights
    def test_lpips(self, tube_benchmark: RestorerBenchmark, shared_data) -> None:
        lpips = Lpips.load(shared_data / "lpips_weights")
        benchmark = replace(tube_benchmark, lpips={"alex": lpips})
        assert benchmark.evaluate(Given(benchmark.truth.rgb))["lpips_alex"] == 0
        found = benchmark.evaluate(AsRendered())
        rendered = torch.cat([clip.layers.get("rendered") for clip in benchmark.clips]).permute(0, 2, 3, 1)
        rendered = (255 * rendered.clamp(0, 1)).round() / 255
        direct = lpips.distance(rendered, torch.from_numpy(benchmark.truth.rgb)).mean()
        assert found["lpips_alex"] == pytest.approx(float(direct), rel=1e-4)

    @pytest.mark.usefixtures("unchecked")
    def test_sizes_must_fit(self) -> None:
        with pytest.raises(ShapeError, match="2 views"):
            RestorerBenchmark([plain_clip(2)], flat_truth(0.4))
        with pytest.raises(ShapeError, match="mask"):
            replace(flat_truth(0.4), mask=np.ones((1, 2, 3), bool))
        benchmark, two = (
            RestorerBenchmark([plain_clip()], flat_truth(0.4)),
            restore_views(AsRendered(), [plain_clip(2)]),
        )
        with pytest.raises(ShapeError, match="restored"):
            benchmark.figures(two)
        with pytest.raises(ShapeError, match="no clips"):
            restore_views(AsRendered(), [])


@pytest.fixture(scope="module")
def walk() -> tuple[RestorerBenchmark, np.ndarray]:
    """Six neighbouring views of the tube, and the place on its wall that each pixel shows."""
    cameras = tube_cameras(6)
    rgb, depth = cast_tube(cameras, None)
    clip = plain_clip(6)
    layers = torch.zeros(6, LAYER_CHANNELS, cameras.height, cameras.width)
    clip = replace(clip, cameras=cameras, layers=Layers(layers))
    truth = TrueViews(rgb.astype(np.float32), np.ones(depth.shape, bool), depth_mm=depth.astype(np.float32))
    points = cameras.centers[:, None, None] + depth[..., None] * pixel_rays(cameras)
    return RestorerBenchmark([clip], truth), points


class TestInconsistency:
    """The walk is one clip whose every pixel is a hole."""

    def test_the_truth_agrees_whatever_its_exposure(self, walk: tuple[RestorerBenchmark, np.ndarray]) -> None:
        benchmark, _ = walk
        for gain in (1.0, 0.6):
            found = benchmark.evaluate(Given(benchmark.truth.rgb * gain))["inconsistency"]
            assert found["within"] < 6e-3
            assert found["across"] is None
        assert found["of_photographs"] < 6e-3

    def test_views_that_invent_for_themselves_do_not(
        self, walk: tuple[RestorerBenchmark, np.ndarray]
    ) -> None:
        benchmark, points = walk
        painted = np.clip((points + np.array([20, 20, 0])) / np.array([40, 40, 100]), 0, 1)
        steady = benchmark.evaluate(Given(painted * benchmark.truth.rgb))["inconsistency"]["within"]
        alone = np.random.default_rng(0).uniform(0.2, 1, (6, 1, 1, 3)) * np.ones_like(painted)
        loose = benchmark.evaluate(Given(alone * benchmark.truth.rgb))["inconsistency"]["within"]
        assert loose > 5 * steady

    def test_only_what_was_invented_counts(self, walk: tuple[RestorerBenchmark, np.ndarray]) -> None:
        benchmark, _ = walk
        solid = benchmark.clips[0].layers.data.clone()
        layers = Layers(solid)
        layers.get("alpha").fill_(1.0)
        seen = RestorerBenchmark([replace(benchmark.clips[0], layers=layers)], benchmark.truth)
        assert seen.evaluate(Given(benchmark.truth.rgb))["inconsistency"] == {
            "within": None,
            "across": None,
            "of_photographs": None,
        }
        half = np.zeros(benchmark.truth.mask.shape, bool)
        half[..., : half.shape[-1] // 2] = True
        told = RestorerBenchmark(seen.clips, replace(benchmark.truth, observed=half))
        assert told.evaluate(Given(benchmark.truth.rgb))["inconsistency"]["within"] is not None

    def test_pairs(self) -> None:
        within, across = view_pairs(np.array([0, 0, 0, 1, 1]))
        assert within == [(0, 1), (0, 2), (1, 2), (3, 4)]
        assert len(across) == 6
        _, many = view_pairs(np.arange(60))
        assert len(many) == 400
        assert len(set(many)) == 400


class TestFlicker:
    def test_what_sits_on_the_wall_does_not_flicker(self, walk: tuple[RestorerBenchmark, np.ndarray]) -> None:
        benchmark, points = walk
        # Colours that are places: linear along the wall, so that they can be carried without loss.
        painted = np.clip((points + np.array([20, 20, 0])) / np.array([40, 40, 100]), 0, 1)
        steady = benchmark.evaluate(Given(np.clip(benchmark.truth.rgb + 0.2 * painted, 0, 1)))
        assert steady["error_flicker"] < 4e-3
        swimming = np.broadcast_to(painted[:1], painted.shape)
        loose = benchmark.evaluate(Given(np.clip(benchmark.truth.rgb + 0.2 * swimming, 0, 1)))
        assert loose["error_flicker"] > 4 * steady["error_flicker"]

    def test_alternating_brightness(self, walk: tuple[RestorerBenchmark, np.ndarray]) -> None:
        benchmark, _ = walk
        sign = np.where(np.arange(6) % 2, 1, -1)[:, None, None, None]
        base = benchmark.truth.rgb
        assert base.min() > 0.05
        assert base.max() < 0.95
        found = benchmark.evaluate(Given(base + 0.05 * sign))
        assert found["error_flicker"] == pytest.approx(0.1, abs=1e-4)
        assert 0.05 < found["flicker"] <= 0.1
        brighter = benchmark.evaluate(Given(base + 0.05))
        assert brighter["error_flicker"] == pytest.approx(0, abs=1e-5)
        assert brighter["flicker"] == pytest.approx(0, abs=1e-5)

    def test_clips_are_apart(self, walk: tuple[RestorerBenchmark, np.ndarray]) -> None:
        benchmark, _ = walk
        whole = benchmark.clips[0]
        single = [
            replace(
                whole,
                index=view,
                cameras=whole.cameras[view],
                layers=whole.layers[view],
                reference=whole.reference[[view]],
                image_confidence=whole.image_confidence[[view]],
            )
            for view in range(6)
        ]
        assert (
            RestorerBenchmark(single, benchmark.truth).evaluate(Given(benchmark.truth.rgb))["flicker"] is None
        )

    def test_without_depth_nobody_knows(self, walk: tuple[RestorerBenchmark, np.ndarray]) -> None:
        benchmark = replace(walk[0], truth=replace(walk[0].truth, depth_mm=None))
        assert benchmark.evaluate(Given(benchmark.truth.rgb))["flicker"] is None


class TestCalibration:
    def test_a_prophet(self) -> None:
        error = np.random.default_rng(0).random((2, 40, 48))
        found = calibration(error, error[..., None], np.ones(error.shape, bool))
        assert found["rank_correlation"] == pytest.approx(1)
        assert found["calibration_error"] == pytest.approx(0, abs=1e-12)
        assert found["cells"] == sum(row["cells"] for row in found["bins"]) == 2 * 5 * 6
        assert len(found["bins"]) == 10
        means = [row["error"] for row in found["bins"]]
        assert means == sorted(means)
        assert all(row["low"] <= row["error"] <= row["high"] for row in found["bins"])

    def test_monotone_is_ranked_and_not_calibrated(self) -> None:
        blocks = np.linspace(0.1, 0.9, 20).reshape(1, 4, 5)
        error = np.kron(blocks, np.ones((1, 8, 8)))
        mask = np.ones(error.shape, bool)
        found = calibration(error**3, error[..., None], mask)
        assert found["rank_correlation"] == pytest.approx(1)
        assert found["calibration_error"] > 0.1
        assert calibration(1 - error, error[..., None], mask)["rank_correlation"] == pytest.approx(-1)

    def test_cells_with_little_mask_do_not_count(self) -> None:
        error = np.full((1, 16, 16), 0.1)
        error[0, :8, :8] = 9.0
        mask = np.ones(error.shape, bool)
        mask[0, :8, 3:8] = False
        found = calibration(error, error[..., None], mask, bins=2)
        assert found["cells"] == 3
        assert found["bins"][-1]["error"] == pytest.approx(0.1)
        assert found["rank_correlation"] is None

    def test_nothing_to_compare(self) -> None:
        nothing = calibration(np.zeros((1, 8, 8)), np.zeros((1, 8, 8, 3)), np.zeros((1, 8, 8), bool))
        assert nothing.pop("coverage") == {"50": None, "90": None}
        assert nothing == {"rank_correlation": None, "calibration_error": None, "cells": 0, "bins": []}
        with pytest.raises(ConfigError, match="bins"):
            calibration(np.zeros((1, 8, 8)), np.zeros((1, 8, 8, 3)), np.ones((1, 8, 8), bool), bins=0)
        with pytest.raises((ShapeError, TypeCheckError)):
            calibration(np.zeros((1, 8, 8)), np.zeros((1, 8, 9, 3)), np.ones((1, 8, 8), bool))

    def test_intervals_hold_what_they_should(self) -> None:
        """Channels that err independently, and all alike: each value counts, not their mean."""
        rng = np.random.default_rng(4)
        expected = rng.uniform(0.01, 0.2, (2, 64, 64))
        mask = np.ones(expected.shape, bool)
        independent = expected[..., None] * rng.exponential(size=(2, 64, 64, 3))
        alike = expected[..., None] * rng.exponential(size=(2, 64, 64, 1)).repeat(3, axis=-1)
        for error in (independent, alike):
            found = calibration(expected, error, mask)["coverage"]
            # Five standard deviations of a share among 8,192 values.
            assert found["50"] == pytest.approx(0.5, abs=0.028)
            assert found["90"] == pytest.approx(0.9, abs=0.017)

    def test_ranks(self) -> None:
        values = np.array([3.0, 1.0, 2.0, 2.0])
        assert rank_correlation(values, np.exp(values)) == pytest.approx(1)
        assert rank_correlation(values, np.ones(4)) is None
        # By hand: ranks 1 2 3 4 against 2 1 4 3.
        assert rank_correlation(np.arange(4.0), np.array([2.0, 1.0, 4.0, 3.0])) == pytest.approx(0.6)

    def test_of_a_restorer(self) -> None:
        """The right half is half as wrong as expected there, the left twice."""
        truth = flat_truth(0.4)
        left = np.arange(SIZE[0])[None, None] < SIZE[0] // 2
        expected = np.where(left, 0.1, 0.04) * np.ones(truth.mask.shape)
        error = np.where(left, 0.2, 0.02)[..., None]
        found = RestorerBenchmark([plain_clip()], truth).evaluate(Given(truth.rgb + error, expected))[
            "calibration"
        ]
        assert found["rank_correlation"] == pytest.approx(1)
        # 0.2 of expected 0.1 lies beyond ln 2 = 0.69 times, within ln 10 = 2.3 times of that.
        assert found["coverage"] == {"50": 0.5, "90": 1.0}
        assert found["bins"][0]["predicted"] == pytest.approx(0.04)
        assert found["bins"][0]["error"] == pytest.approx(0.02, abs=1e-5)
        assert found["bins"][-1]["error"] == pytest.approx(0.2, abs=1e-5)


class TestClips:
    def test_neighbours_recordings_and_order(self, tube: Tube) -> None:
        sequence = replace(tube.sequence, recording=np.array([0] * 5 + [1] * 7))
        frames = np.arange(12)
        clips = held_out_clips(tube.scene, tube.references, sequence, frames, count=2, length=3)
        assert [len(clip) for clip in clips] == [3, 2, 3, 2, 2]
        assert [clip.index for clip in clips] == list(range(5))
        poses = np.concatenate([clip.cameras.world_from_camera for clip in clips])
        assert np.array_equal(poses, sequence.cameras.world_from_camera)

    def test_exposures_are_those_of_the_evaluation(self, tube: Tube) -> None:
        light = tube.scene.light
        assert light is not None
        known = torch.linspace(-0.5, 0.5, 10)
        scene = replace(tube.scene, light=replace(light, log_exposure=known))
        last = tube.sequence.test[:1]
        (clip,) = held_out_clips(scene, tube.references, tube.sequence, last, count=2)
        with torch.no_grad():
            shown = tube.references.shown(scene)
            expected = shown.render(tube.sequence.cameras[last], exposure=known[-1:].exp()).rgb
        assert torch.equal(clip.layers.get("rendered"), expected.permute(0, 3, 1, 2).clamp(0, 1))
        elsewhere = replace(tube.sequence, recording=np.array([0] * 10 + [1] * 2))
        (clip,) = held_out_clips(scene, tube.references, elsewhere, last, count=2)
        with torch.no_grad():
            expected = shown.render(tube.sequence.cameras[last]).rgb
        assert torch.equal(clip.layers.get("rendered"), expected.permute(0, 3, 1, 2).clamp(0, 1))

    def test_there_must_be_frames(self, tube: Tube) -> None:
        with pytest.raises(CaptureError, match="no held-out"):
            held_out_clips(tube.scene, tube.references, tube.sequence, np.zeros(0, int), count=2)
        with pytest.raises(ConfigError, match="0 views"):
            held_out_clips(tube.scene, tube.references, tube.sequence, np.arange(2), count=2, length=0)
