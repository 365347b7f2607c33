"""The estimate of a run's memory: against recorded peaks, in its growth, and in its advice."""

from __future__ import annotations

from dataclasses import replace

import pytest

from extrags.config import PROFILES, PipelineConfig, UcNerfConfig, profile_config
from extrags.memory_estimate import (
    CLIP_VIEWS,
    COMPARED_WIDTH,
    STEPS,
    FrameSize,
    _uc_nerf,
    estimate_memory,
    fitting_settings,
)
from extrags.restoration.benchmark import evaluation
from extrags.training.frame_comparison import MAX_WIDTH_PX

THUMBNAILS = FrameSize(60, 52, 225, 180)
HUNDREDS = FrameSize(400, 200, 675, 540)
SYNTHETIC = FrameSize(200, 200, 675, 540)
FULL = FrameSize(40, 20, 675, 540)


def test_the_width_at_which_frames_are_compared() -> None:
    assert COMPARED_WIDTH == MAX_WIDTH_PX


def test_the_number_of_held_out_views_restored_at_once() -> None:
    assert CLIP_VIEWS == evaluation.CLIP_VIEWS


class TestEstimate:
    @pytest.mark.parametrize(
        ("profile", "size", "stage", "recorded_mib"),
        [
            ("quick", THUMBNAILS, "finetune", 1401.0),
            ("quick", HUNDREDS, "enhance", 3481.1),
            ("balanced", FULL, "enhance", 3613.5),
            ("balanced", FULL, "finetune", 3997.1),
            # Plain frames of a phantom: depth was estimated.
            ("quick", FrameSize(100, 87, 640, 512), "depth", 1741.8),
        ],
    )
    def test_covers_recorded_peaks_without_exceeding_them_much(
        self, profile: str, size: FrameSize, stage: str, recorded_mib: float
    ) -> None:
        """Of runs on a path-traced colon, two threads each; hundreds of frames are these several times."""
        found = estimate_memory(profile_config(profile), size)
        assert 0.9 < found.by_stage[stage] / (recorded_mib * 2**20) < 1.4

    @pytest.mark.parametrize(
        ("profile", "size", "threads", "recorded_mib"),
        [
            ("quick", HUNDREDS, 1, 2697),
            ("quick", FrameSize(1000, 980, 1920, 1080), 1, 5873),
            ("balanced", FrameSize(48, 20, 1350, 1080), 2, 5810),
        ],
    )
    def test_covers_recorded_evaluations_with_alexnet(
        self, profile: str, size: FrameSize, threads: int, recorded_mib: float
    ) -> None:
        config = profile_config(profile).with_overrides({"evaluate.lpips_nets": ("alex",)})
        found = estimate_memory(config, size, threads=threads)
        assert 1.0 < found.by_stage["evaluate"] / (recorded_mib * 2**20) < 1.8

    @pytest.mark.parametrize(
        ("views", "width", "height", "threads", "vgg", "measured_mib"),
        [
            # What three made-up sets of renders, their figures and LPIPS took beyond a process without them.
            (400, 160, 128, 1, False, 446),
            (240, 320, 256, 1, False, 540),
            (20, 160, 128, 1, True, 543),
            (40, 160, 128, 2, True, 990),
            (2, 675, 540, 1, True, 622),
        ],
    )
    def test_covers_measured_photometric_figures(
        self, views: int, width: int, height: int, threads: int, vgg: bool, measured_mib: float
    ) -> None:
        config = profile_config("quick").with_overrides(
            {"evaluate.restored": "none", "evaluate.lpips_nets": ("alex", "vgg") if vgg else ("alex",)}
        )
        # Of a process: interpreter, libraries, and the frames.
        held = 200
        found = estimate_memory(config, FrameSize(views + 4, 4, width, height), threads=threads)
        share = found.by_stage["evaluate"] / ((measured_mib + held) * 2**20)
        assert 1.0 < share < 2.6

    def test_renders_of_long_recordings_are_mapped_files(self) -> None:
        """Ten times the held-out views hold no more than full stacks do; as arrays they would be 100 GB."""
        config = profile_config("quick")
        some, many = (
            estimate_memory(config, FrameSize(100 + views, 100, 1920, 1080)) for views in (100, 1000)
        )
        for stage in ("evaluate", "report"):
            assert many.by_stage[stage] < 1.01 * some.by_stage[stage]
        # 1,000 frames, of which one in ten trains, fit where they were said to take 143 GB.
        assert many.peak_gb < 8

    def test_each_thread_measures_images_of_its_own(self) -> None:
        config = profile_config("balanced")

        def needed(threads: int, frames: int = 400) -> int:
            size = FrameSize(frames, 20, 675, 540)
            return estimate_memory(config, size, threads=threads).by_stage["evaluate"]

        assert needed(8) > 1.5 * needed(4) > 1.5 * needed(2)
        # Of two held-out frames no more than two are measured at once.
        assert estimate_memory(
            config.with_overrides({"evaluate.restored": "none"}), FrameSize(22, 20, 675, 540), threads=8
        ).by_stage["evaluate"] < needed(4)

    def test_the_oracle_is_trained_on_all_frames(self) -> None:
        config = profile_config("balanced")
        oracle = config.with_overrides({"coarse.train_on": "all"})
        few, all_ = FrameSize(600, 60, 675, 540), FrameSize(600, 600, 675, 540)

        def coarse(settings: PipelineConfig, size: FrameSize) -> int:
            return estimate_memory(settings, size, until="coarse").by_stage["coarse"]

        assert coarse(oracle, few) == coarse(config, all_) > coarse(config, few)

    def test_frames_of_neither_part_are_read_and_no_more(self) -> None:
        oracle = profile_config("balanced").with_overrides({"coarse.train_on": "all"})
        whole = FrameSize(600, 60, 675, 540)
        found = estimate_memory(oracle, replace(whole, held_out_frames=60)).by_stage
        fewer = estimate_memory(oracle, FrameSize(120, 60, 675, 540)).by_stage
        more = estimate_memory(oracle, whole).by_stage
        assert more["ingest"] == found["ingest"] > fewer["ingest"]
        assert more["coarse"] > found["coarse"] == fewer["coarse"]

    def test_covers_many_full_size_training_frames(self) -> None:
        """A bound: measured were 20 iterations, long before there are as many Gaussians as there may be."""
        found = estimate_memory(profile_config("quick"), SYNTHETIC)
        assert 921 * 2**20 < found.by_stage["coarse"] < 4823 * 2**20

    @pytest.mark.parametrize(
        ("stage", "recorded_mib"),
        [("ingest", 606.3), ("coarse", 2078.3), ("surface", 805.4), ("explore", 807.6), ("enhance", 5335.7)],
    )
    def test_covers_a_thousand_frames_that_are_mapped_files(self, stage: str, recorded_mib: float) -> None:
        """Their pixels alone would be 2 GB for each byte."""
        found = estimate_memory(profile_config("quick"), FrameSize(1000, 980, 1920, 1080))
        assert 1.0 < found.by_stage[stage] / (recorded_mib * 2**20) < 1.9

    @pytest.mark.parametrize("profile", sorted(PROFILES))
    def test_grows_with_frames_pixels_and_budgets(self, profile: str) -> None:
        config = profile_config(profile)
        usual = estimate_memory(config, FULL).peak_bytes
        for size in (FrameSize(60, 40, 675, 540), FrameSize(40, 20, 1350, 1080)):
            assert estimate_memory(config, size).peak_bytes > usual
        for name, value in (("enhance.max_width", None), ("enhance.max_views", 2000)):
            assert estimate_memory(config.with_overrides({name: value}), FULL).peak_bytes > usual

    @pytest.mark.parametrize(
        ("changes", "size", "trained_mib", "rendered_mib"),
        [
            ({}, (14, 320, 256), 253, 493),
            ({}, (56, 320, 256), 313, 683),
            ({}, (14, 640, 512), 335, 851),
            ({"stereo_width": 80}, (14, 320, 256), 520, 571),
            ({"coarse_planes": 96}, (14, 320, 256), 384, 501),
            ({"source_views": 8}, (14, 320, 256), 334, 691),
            ({"width": 128}, (14, 320, 256), 260, 460),
            ({"samples_prior": 52}, (14, 320, 256), 401, 918),
            ({"rays": 1024, "patches": 32}, (14, 320, 256), 445, 532),
        ],
    )
    def test_covers_the_field_of_uc_nerf(
        self, changes: dict[str, int], size: tuple[int, int, int], trained_mib: float, rendered_mib: float
    ) -> None:
        """What training and the rendering of a view took on one thread, beside the sequence."""
        train, width, height = size
        trained, shown = _uc_nerf(UcNerfConfig(**changes), FrameSize(train + 2, train, width, height))
        assert 0.97 < trained / (trained_mib * 2**20) < 1.25
        assert 0.97 < shown / (rendered_mib * 2**20) < 1.25

    def test_of_uc_nerf_no_gaussians_count(self) -> None:
        config = profile_config("quick").with_overrides({"uc_nerf.enabled": True})
        found = estimate_memory(config, FULL)
        more = config.with_overrides({"coarse.max_points": 10_000_000, "uc_nerf.samples_prior": 200})
        larger = estimate_memory(more, FULL)
        grown = {stage for stage in found.by_stage if larger.by_stage[stage] > found.by_stage[stage]}
        assert "coarse" in grown
        assert larger.by_stage["coarse"] < 2 * found.by_stage["coarse"]
        assert larger.by_stage["evaluate"] > found.by_stage["evaluate"]

    def test_the_surface_is_fused_at_the_width_of_its_setting(self) -> None:
        config, size = profile_config("quick"), FrameSize(100, 80, 1350, 1080)

        def needed(max_width: int) -> int:
            settings = config.with_overrides({"surface.max_width": max_width})
            return estimate_memory(settings, size).by_stage["surface"]

        assert needed(160) < needed(320) < needed(640)
        # No frame is enlarged.
        assert needed(1350) == needed(5000)

    def test_ends_with_the_last_stage_and_leaves_stages_out(self) -> None:
        config = profile_config("balanced")
        assert list(estimate_memory(config, FULL, until="coarse").by_stage)[-1] == "coarse"
        whole = estimate_memory(config, FULL)
        alone = estimate_memory(config, FULL, leave_out=("explore", "enhance"))
        assert "enhance" not in alone.by_stage
        assert alone.by_stage["finetune"] < whole.by_stage["finetune"]

    def test_names_the_stage_that_needs_most(self) -> None:
        found = estimate_memory(profile_config("quick"), FrameSize(48, 20, 1350, 1080))
        assert found.stage == "evaluate"
        assert f"{found.peak_gb:.1f} GB, in evaluate" in str(found)

    def test_pairs_of_the_judge_do_not_grow_with_the_recording(self) -> None:
        """48 are compared, however many frames there are; a training on the scene takes two of each."""
        config = profile_config("quick")

        def growth(changes: dict[str, int]) -> int:
            settings = config.with_overrides(changes)
            few, many = (
                estimate_memory(settings, FrameSize(2 * n, n, 225, 180)).by_stage["enhance"]
                for n in (50, 500)
            )
            return many - few

        # References and the frames themselves, but no layers of pairs.
        assert growth({}) < 90 * 450 * 225 * 180
        assert growth({"enhance.train_iterations": 100}) > 600 * 450 * 225 * 180


class TestFittingSettings:
    def test_nothing_changes_where_it_fits(self) -> None:
        assert fitting_settings(profile_config("quick"), THUMBNAILS, 1000.0) == {}

    @pytest.mark.parametrize("share", [0.9, 0.75, 0.5])
    def test_what_it_names_fits_and_none_of_it_is_superfluous(self, share: float) -> None:
        config = profile_config("balanced")
        limit = share * estimate_memory(config, FULL).peak_gb

        def peak(changes: dict[str, int]) -> float:
            width = changes.get("ingest.width", FULL.width)
            size = FrameSize(
                FULL.frames, FULL.training_frames, width, round(FULL.height * width / FULL.width)
            )
            return estimate_memory(config.with_overrides(changes), size).peak_gb

        found = fitting_settings(config, FULL, limit)
        assert found
        assert peak(found) <= limit
        for name in found:
            assert peak({other: value for other, value in found.items() if other != name}) > limit
            assert peak({**found, name: found[name] + STEPS[name]}) > limit

    def test_smaller_virtual_views_come_before_smaller_frames(self) -> None:
        config = profile_config("balanced").with_overrides({"enhance.max_width": None})
        found = fitting_settings(config, FULL, 0.9 * estimate_memory(config, FULL).peak_gb)
        assert found is not None
        assert list(found) == ["enhance.max_width"]
        assert 320 <= found["enhance.max_width"] < FULL.width

    def test_what_was_cut_first_is_raised_again_once_another_cut_is_enough(self) -> None:
        """The ways are tried in large steps, the first of which may turn out to have been too large."""
        config, size = profile_config("balanced"), FrameSize(100, 88, 1920, 1080)
        for limit in (3.25, 3.75, 4.0, 4.25):
            found = fitting_settings(config, size, limit)
            assert found is not None
            assert found["ingest.width"] > 900
            smaller = replace(size, width=found["ingest.width"], height=found["ingest.width"] * 9 // 16)
            for more in range(found.get("enhance.max_views", 240) + 8, 240, 8):
                trial = config.with_overrides({**found, "enhance.max_views": more})
                assert estimate_memory(trial, smaller).peak_gb > limit

    def test_none_where_the_process_alone_takes_more(self) -> None:
        assert fitting_settings(profile_config("quick"), THUMBNAILS, 0.1) is None
