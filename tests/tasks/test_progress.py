"""Progress in the log: how much is said, and what."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest

from extrags.events import MetricRecorded, Progress, emit
from tasks.progress import (
    LOG_EVERY_SECONDS,
    Pace,
    ProgressLog,
    StageProgress,
    duration_text,
    observed,
    rate_text,
    reporting,
)


class Clock:
    """Time that passes when told to."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def step(stage: str, done: int = 0, total: int = 0, detail: str = "", label: str = "scene") -> StageProgress:
    return StageProgress(label, stage, "running", done, total, detail)


class TestLog:
    def test_starts_and_ends_are_lines(self, caplog: pytest.LogCaptureFixture) -> None:
        caplog.set_level(logging.INFO, logger="extrags.progress")
        write = ProgressLog(Clock())
        write(step("coarse"))
        write(StageProgress("scene", "coarse", "ran", seconds=12.34))
        write(StageProgress("scene", "depth", "skipped", detail="the source has depth"))
        write(StageProgress("scene", "surface", "cached", seconds=0.01))
        write(StageProgress("scene", "explore", "failed", detail="no room", seconds=1.0))
        assert caplog.messages == [
            "scene coarse: starts",
            "scene coarse: ran in 12.3 s",
            "scene depth: skipped: the source has depth",
            "scene surface: cached",
            "scene explore: failed in 1.0 s: no room",
        ]

    def test_a_short_stage_says_nothing_in_between(self, caplog: pytest.LogCaptureFixture) -> None:
        caplog.set_level(logging.INFO, logger="extrags.progress")
        clock = Clock()
        write = ProgressLog(clock)
        write(step("coarse"))
        for done in range(1, 1500):
            write(step("coarse", done, 1500, "loss 0.1"))
            clock.now += 0.01
        assert caplog.messages == ["scene coarse: starts"]

    def test_a_long_one_says_how_far_it_is_at_what_rate(self, caplog: pytest.LogCaptureFixture) -> None:
        caplog.set_level(logging.INFO, logger="extrags.progress")
        clock = Clock()
        write = ProgressLog(clock)
        write(step("coarse"))
        write(step("coarse", 0, 1000))
        clock.now += LOG_EVERY_SECONDS
        write(step("coarse", 600, 1000, "loss 0.1"))
        write(step("coarse", 601, 1000, "loss 0.1"))
        assert caplog.messages[1:] == ["scene coarse: 600 of 1000, 20/s, about 20 s left; loss 0.1"]

    def test_many_branches_of_a_search_are_no_lines(self, caplog: pytest.LogCaptureFixture) -> None:
        caplog.set_level(logging.INFO, logger="extrags.progress")
        clock = Clock()
        write = ProgressLog(clock)
        write(step("explore"))
        for wave in range(12):
            for done in range(1, 11):
                clock.now += 1.0
                write(step("explore-branch", done, 10, "value 0.1"))
            write(step("explore", wave + 1, 12))
        said = caplog.messages[1:]
        assert all(line.startswith("scene explore: ") for line in said)
        assert len(said) == 4  # In 120 seconds.

    def test_of_several_tasks_at_once_those_that_ended_are_told(
        self, caplog: pytest.LogCaptureFixture
    ) -> None:
        caplog.set_level(logging.INFO, logger="extrags.progress")
        clock = Clock()
        write = ProgressLog(clock)
        write(step("enhance"))
        for ended in (1, 2, 3):
            clock.now += LOG_EVERY_SECONDS
            write(step("enhance-restore", 2, 4))
            write(replace(step("enhance-restore", ended, 3), of_tasks=True))
        assert caplog.messages[1:] == [
            "scene enhance-restore: 1 of 3",
            "scene enhance-restore: 2 of 3, 30 s each, about 30 s left",
            "scene enhance-restore: 3 of 3, 30 s each",
        ]

    def test_what_a_failure_leaves_out_is_not_listed(self, caplog: pytest.LogCaptureFixture) -> None:
        caplog.set_level(logging.INFO, logger="extrags.progress")
        write = ProgressLog(Clock())
        skipped = StageProgress("scene", "poses", "skipped", detail="ingest failed")
        write(step("ingest"))
        write(StageProgress("scene", "ingest", "failed", detail="no file", seconds=1.0))
        write(skipped)
        write(replace(skipped, label="another"))
        # Another run of the same sequence.
        write(step("ingest"))
        write(replace(skipped, detail="the source has poses"))
        assert caplog.messages == [
            "scene ingest: starts",
            "scene ingest: failed in 1.0 s: no file",
            "another poses: skipped: ingest failed",
            "scene ingest: starts",
            "scene poses: skipped: the source has poses",
        ]

    def test_each_sequence_has_an_interval_of_its_own(self, caplog: pytest.LogCaptureFixture) -> None:
        caplog.set_level(logging.INFO, logger="extrags.progress")
        clock = Clock()
        write = ProgressLog(clock)
        for label in ("a", "b"):
            write(step("coarse", label=label))
        clock.now += LOG_EVERY_SECONDS
        for _ in range(3):
            for label in ("a", "b"):
                write(step("coarse", 1, 2, label=label))
        assert caplog.messages[2:] == ["a coarse: 1 of 2", "b coarse: 1 of 2"]

    def test_tasks_without_an_observer_share_one_log(self, caplog: pytest.LogCaptureFixture) -> None:
        caplog.set_level(logging.INFO, logger="extrags.progress")
        for _ in range(20):
            with reporting("a sequence of this test alone", "enhance-keyframes"):
                emit(Progress("enhance-keyframes", 1, 4))
        assert caplog.messages == []


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("judged_gain_over_classical_db", 0.10524, "judged gain over classical 0.1052 dB"),
        ("domain_score", 2.0, "domain score 2"),
    ],
)
def test_a_figure_is_told_in_words(name: str, value: float, told: str) -> None:
    seen: list[StageProgress] = []
    with observed(seen.append), reporting("scene", "enhance"):
        emit(MetricRecorded("enhance", name, value))
    assert [progress.detail for progress in seen] == [told]


def test_events_of_a_stage_reach_the_observer() -> None:
    seen: list[StageProgress] = []
    with observed(seen.append), reporting("scene", "coarse"):
        emit(Progress("coarse", 3, 9, {"loss": 0.25, "n_gaussians": 13980}))
    assert seen == [step("coarse", 3, 9, "loss 0.25  n_gaussians 13980")]


class TestPace:
    def test_rate_and_rest(self) -> None:
        pace = Pace()
        assert pace.rate(step("coarse", 10, 100), 0.0) is None
        assert pace.rate(step("coarse", 30, 100), 10.0) == pytest.approx(2.0)
        assert pace.seconds_left(step("coarse", 30, 100), 10.0) == pytest.approx(35.0)
        assert pace.seconds_left(step("coarse", 100, 100), 40.0) is None

    def test_a_count_that_falls_is_another_loop(self) -> None:
        pace = Pace()
        pace.rate(step("finetune-judge", 1, 100), 0.0)
        assert pace.rate(step("finetune-judge", 100, 100), 10.0) == pytest.approx(9.9)
        assert pace.rate(step("finetune-judge", 0, 100), 20.0) is None
        assert pace.rate(step("finetune-judge", 5, 100), 25.0) == pytest.approx(1.0)

    def test_another_total_is_another_loop(self) -> None:
        """A training that goes on begins with its scenes, and then at the step of its checkpoint."""
        pace = Pace()
        pace.rate(step("pretrain", 0, 75), 0.0)
        assert pace.rate(step("pretrain", 5584, 14000), 10.0) is None
        assert pace.rate(step("pretrain", 5594, 14000), 15.0) == pytest.approx(2.0)

    def test_a_stage_that_ended_teaches_nothing(self) -> None:
        pace = Pace()
        pace.rate(step("coarse", 1, 100), 0.0)
        pace.forget("scene")
        assert pace.rate(step("coarse", 50, 100), 100.0) is None


def test_words_for_times_and_rates() -> None:
    assert duration_text(12.3) == "12 s"
    assert duration_text(600) == "10 min"
    assert duration_text(3 * 3600) == "3.0 h"
    assert rate_text(431.2) == "431/s"
    assert rate_text(12.54) == "12.5/s"
    assert rate_text(0.2) == "5 s each"
    assert rate_text(0.7) == "1.4 s each"
