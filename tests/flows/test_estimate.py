"""How far a run is said to be, and how long it still takes."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

from extrags.config import profile_config
from extrags.stages import STAGES, StageName
from flows.estimate import RunEstimate, SequenceEstimate, expected_seconds, usual_pace
from flows.workloads import usual_work
from tasks.progress import StageProgress
from tasks.stage import all_stage_versions

EXPECTED: dict[StageName, dict[str, float]] = {
    stage: {"ingest": {"ingest": 12.0}, "coarse": {"coarse": 18.0}}.get(stage, tasks)
    for stage, tasks in expected_seconds(profile_config("quick")).items()
}


def step(stage: str, state: str = "running", done: int = 0, total: int = 0, seconds: float = 0.0) -> Any:
    return StageProgress("scene", stage, state, done, total, "", seconds)


class TestEstimate:
    def test_every_stage_is_expected_and_its_tasks_exist(self) -> None:
        assert tuple(EXPECTED) == STAGES
        named = {task for tasks in EXPECTED.values() for task in tasks}
        assert named <= set(all_stage_versions())

    def test_larger_frames_take_longer_where_pixels_count(self) -> None:
        # The number of Gaussians shall be the same.
        config = profile_config("balanced").with_overrides({"coarse.pixels_per_point": 1})
        small, large = (
            expected_seconds(config, replace(usual_work(config), pixels=pixels, width=width))
            for pixels, width in ((160 * 128, 160), (640 * 512, 640))
        )
        for stage in ("ingest", "poses", "coarse", "evaluate"):
            assert sum(large[stage].values()) > 1.5 * sum(small[stage].values())
        assert large["freespace"] == small["freespace"]

    def test_tasks_that_do_not_run_are_not_waited_for(self) -> None:
        def expected(stage: StageName, **settings: object) -> dict[str, float]:
            changes = {name.replace("__", "."): value for name, value in settings.items()}
            return expected_seconds(profile_config("quick").with_overrides(changes))[stage]

        assert list(expected("finetune")) == ["finetune-judge", "finetune"]
        assert list(expected("finetune", finetune__judge__enabled=False)) == ["finetune"]
        restored, plain = expected("evaluate"), expected("evaluate", evaluate__restored="none")
        assert "evaluate-restore" in restored
        assert "evaluate-restore" not in plain
        assert plain["evaluate-views"] < restored["evaluate-views"]
        assert "enhance-train" not in expected("enhance", enhance__backend="classical")

    def test_poses_take_as_long_as_they_did(self) -> None:
        """Against recorded stages; far more frames are not paired with one another all."""
        config = profile_config("balanced").with_overrides({"poses.max_width": 4000})

        def expected(width: int, height: int, frames: int, train: int) -> float:
            size = {"pixels": float(width * height), "width": float(width)}
            counts = {"frames": frames, "train": train, "test": frames - train}
            work = replace(usual_work(config), **size, **counts)
            return sum(expected_seconds(config, work)["poses"].values())

        for recorded, size in (
            (3.6, (160, 128, 48, 20)),
            (19.3, (320, 256, 48, 20)),
            (2.3, (237, 237, 10, 8)),
            (165, (675, 540, 40, 20)),
            (208, (1048, 972, 35, 30)),
        ):
            assert expected(*size) == pytest.approx(recorded, rel=0.25)
        few, many = expected(675, 540, 60, 53), expected(675, 540, 600, 525)
        assert 8 * few < many < 20 * few
        # They are looked for in frames of a bounded width.
        config = profile_config("balanced")
        assert expected(1600, 1000, 60, 53) == expected(800, 500, 60, 53)

    def test_depth_looks_at_frames_of_a_bounded_width(self) -> None:
        config = profile_config("balanced")
        depths = [
            sum(expected_seconds(config, replace(usual_work(config), pixels=p, width=w))["depth"].values())
            for p, w in ((160 * 128, 160), (256 * 144, 256), (1920 * 1080, 1920))
        ]
        # Nearly in proportion to the pixels that are matched: something is done once a frame.
        assert 0.9 * 256 * 144 / (160 * 128) < depths[1] / depths[0] < 256 * 144 / (160 * 128)
        assert depths[2] == pytest.approx(depths[1])

    def test_the_usual_pace_counts_before_something_ran(self) -> None:
        estimate = SequenceEstimate(EXPECTED, until="coarse")
        estimate.receive(step("ingest"), 0.0)
        whole = sum(sum(EXPECTED[stage].values()) for stage in ("ingest", "poses", "depth", "coarse"))
        assert estimate.seconds_left(0.0) == pytest.approx(whole * usual_pace())

    def test_what_is_left_goes_at_the_pace_of_what_ran(self) -> None:
        estimate = SequenceEstimate(EXPECTED, until="coarse")
        estimate.receive(step("ingest"), 0.0)
        estimate.receive(step("ingest", "ran", seconds=2000.0), 2000.0)
        for skipped in ("poses", "depth"):
            estimate.receive(step(skipped, "skipped"), 2000.0)
        # How long reading took says nothing of the 18 s that are expected of the coarse scene.
        assert estimate.seconds_left(2000.0) == pytest.approx(18 * usual_pace())
        assert estimate.share(2000.0) == pytest.approx(12 / 30)
        estimate.receive(step("coarse"), 2000.0)
        estimate.receive(step("coarse", done=750, total=1500), 2900.0)
        assert estimate.share(2900.0) == pytest.approx(21 / 30)
        # Of 9 expected seconds each took 100, and the usual pace counts for 10 more.
        assert estimate.seconds_left(2900.0) == pytest.approx(9 * (900.0 + 10 * usual_pace()) / 19)
        estimate.receive(step("coarse", "ran", seconds=1800.0), 3800.0)
        assert estimate.share(3800.0) == 1.0
        assert estimate.seconds_left(3800.0) == 0.0

    def test_a_long_video_is_read_no_faster_than_it_was_so_far(self) -> None:
        """All of its frames are decoded and few are used; the stages to come are no slower for it."""
        estimate = SequenceEstimate(EXPECTED, until="coarse")
        for skipped in ("poses", "depth"):
            estimate.receive(step(skipped, "skipped"), 0.0)
        estimate.receive(step("ingest"), 0.0)
        estimate.receive(step("ingest", done=7500, total=15000), 60.0)
        reading = 6 * (60 + 10 * usual_pace()) / 16
        assert estimate.seconds_left(60.0) == pytest.approx(reading + 18 * usual_pace())

    def test_what_is_left_falls_between_steps(self) -> None:
        estimate = SequenceEstimate(EXPECTED, until="coarse")
        estimate.receive(step("ingest"), 0.0)
        estimate.receive(step("ingest", "ran", seconds=12.0), 12.0)
        for skipped in ("poses", "depth"):
            estimate.receive(step(skipped, "skipped"), 12.0)
        estimate.receive(step("coarse"), 12.0)
        estimate.receive(step("coarse", done=1, total=3), 18.0)
        said = [estimate.seconds_left(now) for now in (18.0, 20.0, 22.0, 24.0, 40.0, 60.0)]
        assert said == sorted(said, reverse=True)
        assert said[0] > said[2] + 1
        # The second step has outlasted what was expected of it; of the third nothing is behind yet.
        assert said[-1] == said[-2] > said[0] / 2

    def test_what_counts_one_thing_after_another_goes_by_its_time(self) -> None:
        estimate = SequenceEstimate(EXPECTED)
        for name in ("ingest", "coarse"):
            estimate.receive(step(name), 0.0)
            estimate.receive(step(name, "ran", seconds=sum(EXPECTED[name].values())), 0.0)
        estimate.receive(step("finetune"), 0.0)
        shares = []
        for now, (done, total) in enumerate([(300, 600), (600, 600), (1, 4), (4, 4), (100, 400)], start=1):
            estimate.receive(step("finetune-judge", done=done, total=total), float(now))
            shares.append(estimate.share(float(now)))
        steps = [later - earlier for earlier, later in pairwise(shares)]
        assert steps == pytest.approx([steps[0]] * len(steps))
        assert steps[0] > 0

    def test_tasks_that_ended_tell_how_far_several_at_once_are(self) -> None:
        estimate = SequenceEstimate(EXPECTED)
        estimate.receive(step("enhance"), 0.0)
        # One of them is done with its steps: that says nothing, and no time has passed.
        estimate.receive(step("enhance-restore", done=4, total=4), 0.0)
        before = estimate.share(0.0)
        estimate.receive(replace(step("enhance-restore", done=2, total=3), of_tasks=True), 0.0)
        whole = sum(sum(tasks.values()) for tasks in EXPECTED.values())
        assert estimate.share(0.0) - before == pytest.approx(
            2 / 3 * EXPECTED["enhance"]["enhance-restore"] / whole
        )

    def test_frames_that_are_read_tell_what_is_to_come(self) -> None:
        estimate = SequenceEstimate(EXPECTED, until="coarse")
        estimate.receive(step("ingest"), 0.0)
        larger = {**EXPECTED, "ingest": {"ingest": 24.0}, "coarse": {"coarse": 180.0}}
        estimate.receive(replace(step("ingest", "ran", seconds=24.0), expected=larger), 24.0)
        for skipped in ("poses", "depth"):
            estimate.receive(step(skipped, "skipped"), 24.0)
        assert estimate.seconds_left(24.0) == pytest.approx(180.0 * usual_pace())
        assert estimate.share(24.0) == pytest.approx(24 / 204)

    def test_a_failure_keeps_its_share(self) -> None:
        estimate = SequenceEstimate(EXPECTED, until="coarse")
        estimate.receive(step("ingest"), 0.0)
        estimate.receive(step("ingest", "failed", seconds=1.0), 1.0)
        for skipped in ("poses", "depth", "coarse"):
            estimate.receive(step(skipped, "skipped"), 1.0)
        assert estimate.share(1.0) == 0.0

    def test_shares_never_fall(self) -> None:
        estimate = SequenceEstimate(EXPECTED)
        shares, now = [], 0.0
        for name, tasks in EXPECTED.items():
            estimate.receive(step(name), now)
            for task in tasks:
                for done in (1, 2):
                    estimate.receive(step(task, done=done, total=2), now)
                    now += 1.0
                    shares.append(estimate.share(now))
            estimate.receive(step(name, "ran", seconds=2.0), now)
            shares.append(estimate.share(now))
        assert shares == sorted(shares)
        assert shares[-1] == pytest.approx(1.0)

    def test_cached_stages_teach_nothing_of_the_pace(self) -> None:
        estimate = SequenceEstimate(EXPECTED)
        for name in ("ingest", "poses", "depth", "coarse"):
            estimate.receive(step(name), 0.0)
            estimate.receive(step(name, "cached", seconds=100.0), 0.0)
        rest = sum(sum(tasks.values()) for name, tasks in EXPECTED.items() if name not in estimate.ended)
        assert estimate.seconds_left(1.0) == pytest.approx(rest * usual_pace())


class TestRun:
    def test_waiting_sequences_take_as_long_as_those_before(self) -> None:
        run = RunEstimate(3, EXPECTED, "ingest")
        run.receive(step("ingest"), 0.0)
        run.receive(step("ingest", "ran", seconds=12.0), 12.0)
        run.sequence_ended("scene", 12.0, failed=False, ran=True)
        assert run.share(12.0) == pytest.approx(1 / 3)
        assert run.seconds_left(12.0) == pytest.approx(24.0)
        assert run.text(12.0) == "1 of 3 sequences done; about 24 s left"

    def test_more_sequences_than_were_announced_do_no_harm(self) -> None:
        run = RunEstimate(1, EXPECTED, "ingest")
        for _ in range(2):
            run.sequence_ended("scene", 0.0, failed=False, ran=True)
        assert run.share(0.0) == 1.0
        assert run.seconds_left(0.0) == 0.0
