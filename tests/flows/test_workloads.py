"""Size of the work that a sequence is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from data_catalog import describe, list_sequences
from extrags.config import IngestConfig, PipelineConfig, profile_config
from extrags.run_costs import Workload, packaged_model, stage_seconds
from flows.commands.plan import print_detail
from flows.run_costs import RunPrediction, StageCost
from flows.workloads import (
    _catalogue_work,
    at_detail_size,
    detail_flags,
    expected_work,
    frames_work,
    read_size,
)
from tests.data_catalog.footage_fixture import write_video
from tests.data_catalog.test_content import moving_scene


def test_frames_of_the_size_that_keeps_their_detail_cost_less() -> None:
    whole = Workload(675 * 540, 40, 20, 20, PipelineConfig(), width=675)
    reduced = at_detail_size(whole, {"detail_width": 450, "detail_height": 360})
    assert reduced is not None
    assert (reduced.pixels, reduced.width, reduced.frames) == (450 * 360, 450, 40)
    model = packaged_model()
    # Virtual views, which fine-tuning spends most on, are narrower than either.
    for stage, share in (("coarse", 0.75), ("finetune", 0.9), ("evaluate", 0.75)):
        assert stage_seconds(model, stage, reduced) < share * stage_seconds(model, stage, whole)


def test_frames_that_hold_all_their_detail_are_the_same_work() -> None:
    whole = Workload(675 * 540, 40, 20, 20, PipelineConfig(), width=675)
    assert at_detail_size(whole, {"detail_width": 675, "detail_height": 540}) is None


def test_frames_that_are_drawn_take_longer_than_frames_that_are_read() -> None:
    config = profile_config("quick")
    drawn = expected_work("phantom/0@sparse", config)
    # By its entry in the catalogue: its files may be elsewhere.
    read = _catalogue_work(describe("simcol3d/s1"), config)
    assert drawn is not None
    assert (drawn.drawn, read.drawn) == (True, False)
    assert drawn.size["drawn"]
    assert Workload(config=drawn.config, **drawn.size) == drawn
    # A run on record says how large its sequence was without a word on this.
    assert "drawn" not in read.size
    model = packaged_model()
    as_files = model.predict("ingest", replace(drawn, drawn=False)).seconds
    assert model.predict("ingest", drawn).seconds > 1.5 * as_files


def test_frames_without_depth_are_read_faster() -> None:
    config = profile_config("quick")
    counts = {"width": 960, "height": 890, "frames": 35, "train": 30, "test": 5, "has_depth": 0}
    without, known = (frames_work({**counts, "has_depth": has_depth}, config) for has_depth in (0, 1))
    assert (without.has_depth, known.has_depth) == (False, True)
    assert "has_depth" not in known.size
    assert Workload(config=config, **without.size) == without
    # Depth that is withheld was read, and earlier records do not say.
    assert frames_work(counts, config.with_overrides({"ingest.withhold_depth": True})).has_depth
    del counts["has_depth"]
    assert frames_work(counts, config).has_depth
    model = packaged_model()
    assert model.predict("ingest", known).seconds > 2 * model.predict("ingest", without).seconds
    for name, expected in (("sinus/hopkins", False), ("simcol3d/s1", True)):
        assert _catalogue_work(describe(name), config).has_depth is expected


class TestFootage:
    """Frames of a video are few, and all of it is decoded."""

    @staticmethod
    def work(**settings: Any) -> Workload:
        config = PipelineConfig(ingest=IngestConfig(width=320, max_frames=100))
        counts = {"width": 320, "height": 180, "frames": 100, "train": 87, "test": 13, "has_depth": 0}
        return frames_work({**counts, **settings}, config)

    def test_a_long_one_takes_longer_than_its_frames(self) -> None:
        size = {"source_pixels": 1920 * 1080}
        files, short, hour = (
            packaged_model().predict("ingest", self.work(**given)).seconds
            for given in ({}, {**size, "looked_at": 200}, {**size, "looked_at": 90_000})
        )
        assert files < short < 20
        assert hour > 2000

    def test_what_videos_took(self) -> None:
        """Processor seconds of `ingest` of four codecs, none of which is in the fit (docs/experiments)."""
        for width, height, source_px, looked_at, frames, seconds in (
            (720, 576, 720 * 576, 700, 136, 13.0),
            (1350, 1080, 1350 * 1080, 250, 59, 14.2),
            (960, 540, 960 * 540, 900, 100, 11.7),
            (1920, 1080, 1920 * 1080, 200, 53, 14.7),
            (320, 180, 1920 * 1080, 200, 53, 5.9),
            (320, 256, 1350 * 1080, 250, 59, 6.9),
            (320, 256, 720 * 576, 700, 100, 9.0),
        ):
            size = {"width": width, "height": height, "frames": frames}
            found = self.work(**size, looked_at=looked_at, source_pixels=source_px)
            assert packaged_model().predict("ingest", found).seconds == pytest.approx(seconds, rel=0.25)

    def test_what_is_passed_over_is_decoded(self) -> None:
        size = {"source_pixels": 1920 * 1080, "looked_at": 1000}
        start, late = (self.work(**size, passed_over=frames) for frames in (0, 10_000))
        model = packaged_model()
        more = model.predict("ingest", late).seconds - model.predict("ingest", start).seconds
        assert 50 < more < 200

    def test_records_tell_of_it(self) -> None:
        found = self.work(looked_at=200, source_pixels=640 * 480)
        assert Workload(config=found.config, **found.size) == found
        assert "looked_at" not in self.work().size

    def test_headers_tell_before_it_is_read(self, tmp_path: Path) -> None:
        file = write_video(tmp_path / "exam.avi", moving_scene(50, 160, 96, speed=6))
        found = expected_work(str(file), PipelineConfig(ingest=IngestConfig(max_frames=8, width=80)))
        assert found is not None
        assert (found.frames, found.looked_at, found.source_pixels) == (8, 50, 160 * 96)


def test_only_procedural_scenes_are_drawn() -> None:
    """Pairs of recordings of C3VD name no folder either, and are read."""
    config = profile_config("quick")
    works = {item.name: expected_work(item.name, config) for item in list_sequences() if item.available}
    drawn = {name.partition("/")[0] for name, work in works.items() if work is not None and work.drawn}
    assert drawn - {"ct_colon"} == {"phantom", "caverns"}
    assert not _catalogue_work(describe("c3vdv2/c1_cecum_t1@sparse"), config).drawn


@pytest.mark.parametrize(
    ("settings", "flags"),
    [
        ({"size": "source"}, "--ingest.size detail"),
        # Larger than the source in places, where no width could be asked for.
        ({"size": "central"}, "--ingest.size detail"),
        ({"size": "source", "downscale": 2}, "--ingest.width 180 --ingest.downscale none"),
        ({"size": "thumbnail"}, "--ingest.width 180"),
        ({"size": "source", "width": 225}, "--ingest.width 180"),
        ({"width": 225, "height": 180}, "--ingest.width 180 --ingest.height 144"),
    ],
)
def test_what_asks_for_frames_of_that_size(settings: dict[str, Any], flags: str) -> None:
    """`size=detail` measures the source, and gives way to a width."""
    config = PipelineConfig(ingest=IngestConfig(**settings))
    counts = {"detail_width": 180, "detail_height": 144, "has_poses": 1}
    assert detail_flags(config, counts) == flags


@pytest.mark.parametrize(
    ("settings", "flags"),
    [
        ({"size": "thumbnail"}, "--ingest.size detail"),
        ({"size": "thumbnail", "downscale": 2}, "--ingest.size detail --ingest.downscale none"),
        ({"width": 225}, "--ingest.width 180"),
    ],
)
def test_frames_that_may_have_been_cut_are_measured_again(settings: dict[str, Any], flags: str) -> None:
    """The width of the picture is not that of whole frames, which a width would be taken for."""
    config = PipelineConfig(ingest=IngestConfig(**settings))
    counts = {"detail_width": 180, "detail_height": 144, "has_poses": 0}
    assert detail_flags(config, counts) == flags


@pytest.mark.parametrize(
    ("name", "settings", "size"),
    [
        ("phantom/0@sparse", {}, (160, 128)),
        ("phantom/0@sparse", {"width": 64}, (64, 51)),
        ("caverns/0@sparse", {"downscale": 4}, (40, 32)),
        ("simcol3d/s1", {}, (237, 237)),
        ("simcol3d/s1", {"size": "source"}, (475, 475)),
        ("simcol3d/s1", {"width": 100}, (100, 100)),
        ("sinus/hopkins", {}, (262, 243)),
        ("sinus/hopkins", {"width": 64}, (64, 59)),
        ("c3vdv2_sim/c9_transverse1_t3@sparse", {}, (225, 180)),
        ("c3vdv2_sim/c9_transverse1_t3@sparse", {"size": "source", "downscale": 2}, (337, 270)),
    ],
)
def test_the_size_that_a_sequence_will_be_read_at(
    name: str, settings: dict[str, Any], size: tuple[int, int]
) -> None:
    found = read_size(describe(name), PipelineConfig(ingest=IngestConfig(**settings)))
    assert found == pytest.approx(size, abs=1)


def test_a_plan_says_what_smaller_frames_would_take(capsys: pytest.CaptureFixture[str]) -> None:
    predicted, reduced = (
        RunPrediction([StageCost("coarse", seconds, None, None)], "probe", 0) for seconds in (200.4, 79.6)
    )
    print_detail("no more detail than 450 x 360 px hold", "--ingest.size detail", predicted, reduced)
    said = capsys.readouterr().out
    assert "frames hold no more detail than 450 x 360 px hold: --ingest.size detail" in said
    assert "80 s of processor time in place of 200" in said
