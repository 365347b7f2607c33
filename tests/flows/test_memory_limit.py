"""Memory limits of runs: said before the reconstruction begins, with settings that fit."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from extrags.config import profile_config
from extrags.errors import ConfigError
from extrags.stages import StageName
from flows.benchmark import run_method
from flows.cases import SequenceCase
from flows.expectation import Expectation, expected_words
from flows.memory_limit import check_memory
from flows.methods import METHODS, method_config, pinned_settings
from flows.runners import DirectRunner
from flows.wiring import run_sequence
from tests.flows.tiny import SEQUENCE, tiny_config

COUNTS = {"frames": 40, "train": 20, "test": 20, "width": 675, "height": 540, "has_depth": True}


def test_the_estimate_is_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="flows.memory_limit"):
        check_memory("a/b", profile_config("balanced"), COUNTS, None, "report", ())
    assert "a/b: 40 frames of 675 x 540 px take at most about" in caplog.text
    assert re.search(r", and about \d+ min of processor time\n$", caplog.text)
    with caplog.at_level(logging.INFO, logger="flows.memory_limit"):
        check_memory("a/b", profile_config("balanced"), COUNTS, None, "assess", ())
    # A plan says beside it what the whole run takes.
    assert re.search(r", and about \d+ (min|s) of processor time until assess\n$", caplog.text)


def test_the_time_is_said_to_be_that_of_the_kernels_where_these_are_missing(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("extrags.raster.available_backends", lambda: ("reference",))
    with caplog.at_level(logging.INFO, logger="flows.memory_limit"):
        check_memory("a/b", profile_config("balanced"), COUNTS, None, "report", ())
    assert "of processor time, with the compiled kernels; these are missing here, and what" in caplog.text
    found = Expectation(SequenceCase("a/b"), 60.0, measured=False)
    assert expected_words([found]).endswith(
        "by their frames, with the compiled kernels; these are missing "
        "here, and what renders takes many times as long"
    )
    assert "kernels" not in expected_words([replace(found, measured=True)])


def test_stages_that_do_not_run_take_no_time(caplog: pytest.LogCaptureFixture) -> None:
    config = profile_config("balanced")

    def minutes(counts: Mapping[str, Any], until: StageName, *leave_out: StageName) -> int:
        caplog.clear()
        with caplog.at_level(logging.INFO, logger="flows.memory_limit"):
            check_memory("a/b", config, counts, None, until, leave_out)
        found = re.search(r"about (\d+) min of processor", caplog.text)
        assert found is not None
        return int(found[1])

    whole = minutes(COUNTS, "report")
    assert whole > minutes(COUNTS, "coarse")
    assert whole > minutes(COUNTS, "report", "finetune")
    more = {**COUNTS, "frames": 400, "train": 200, "test": 200}
    assert minutes({**more, "has_depth": False}, "depth") > minutes(more, "depth")


@pytest.mark.parametrize(
    ("method", "settings", "limit_gb"),
    # UC-NeRF holds all its training frames in single precision.
    [("3dgs", {}, 6.5), ("uc-nerf", {}, 40.0), ("coarse", {"depth.enabled": False}, 6.5)],
    ids=str,
)
def test_a_stage_that_the_settings_do_without_needs_no_memory(
    method: str, settings: dict[str, Any], limit_gb: float
) -> None:
    many = {"frames": 1000, "train": 900, "test": 100, "width": 1920, "height": 1080, "has_poses": True}
    config, leave_out = method_config(method, "balanced", settings), METHODS[method].leave_out
    found = check_memory("a/b", config, many, limit_gb, "coarse", leave_out)
    assert list(found.by_stage) == ["ingest", "coarse"]
    with pytest.raises(ConfigError, match=r"in depth, more than the limit of 6\.5 GB"):
        check_memory("a/b", method_config("coarse", "balanced"), many, 6.5, "coarse", ())


def test_a_run_over_the_limit_is_refused_with_settings_that_fit() -> None:
    config = profile_config("balanced").with_overrides({"enhance.max_width": None})
    with pytest.raises(
        ConfigError, match=r"more than the limit of 6 GB; it fits with --enhance\.max_width \d\d\d$"
    ):
        check_memory("a/b", config, COUNTS, 6.0, "report", ())
    with pytest.raises(ConfigError, match="no smaller frames or fewer virtual views were found"):
        check_memory("a/b", config, COUNTS, 0.1, "report", ())


@pytest.fixture
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flows.memory_limit.usable_cores", lambda: 2)


@pytest.mark.usefixtures("two_cores")
def test_what_is_advised_is_not_refused_for_a_divisor_of_the_size() -> None:
    config = profile_config("balanced").with_overrides({"ingest.downscale": 1})
    with pytest.raises(ConfigError, match=r"--ingest\.width \d+ --ingest\.downscale none$"):
        check_memory("a/b", config, COUNTS, 2.5, "report", ())
    # Frames need not be smaller.
    with pytest.raises(ConfigError, match=r"it fits with --enhance\.max_width \d+$"):
        check_memory("a/b", config.with_overrides({"enhance.max_width": None}), COUNTS, 6.0, "report", ())


@pytest.mark.usefixtures("two_cores")
@pytest.mark.parametrize("method", ["paper", "exploregs"])
def test_no_setting_is_advised_that_the_method_sets_itself(method: str) -> None:
    config, leave_out = method_config(method, "balanced"), METHODS[method].leave_out
    pinned = pinned_settings(method)
    with pytest.raises(ConfigError, match=r"it fits with --enhance\.max_width"):
        check_memory("a/b", config, COUNTS, 6.0, "report", leave_out)
    with pytest.raises(ConfigError, match="it fits with") as refused:
        check_memory("a/b", config, COUNTS, 6.0, "report", leave_out, pinned=pinned)
    advised = re.findall(r"--(\S+)", str(refused.value))
    assert advised
    assert not pinned.intersection(advised)


def test_runs_say_what_their_method_sets(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    told: list[object] = []

    def refused(*given: object) -> None:
        told.append(given[-1])
        raise ConfigError("too much")

    monkeypatch.setattr("flows.wiring.check_memory", refused)
    store = str(tmp_path)
    runner = DirectRunner(store)
    run_sequence(SEQUENCE, tiny_config(), store, runner, pinned=("a.b",))
    run_method("paper", SEQUENCE, "quick", 0, {"ingest.max_frames": 4}, store, runner)
    assert told == [("a.b",), pinned_settings("paper")]


def test_nothing_but_ingest_is_made_of_a_refused_sequence(tmp_path: Path) -> None:
    store = str(tmp_path)
    outcome = run_sequence(SEQUENCE, tiny_config(), store, DirectRunner(store), memory_limit_gb=0.1)
    assert outcome.status == "failed"
    assert isinstance(outcome.error, ConfigError)
    assert outcome.stages[0].stage == "ingest"
    assert outcome.stages[0].state == "failed"
    assert {row.state for row in outcome.stages[1:]} == {"skipped"}


def test_what_is_in_the_store_needs_no_memory(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store, config = str(tmp_path), tiny_config()
    assert run_sequence(SEQUENCE, config, store, DirectRunner(store), until="coarse").status == "ok"
    again = run_sequence(SEQUENCE, config, store, DirectRunner(store), until="coarse", memory_limit_gb=0.01)
    assert {row.state for row in again.stages} == {"cached", "skipped"}
    # What comes after it is held against the limit, and alone.
    caplog.set_level("INFO", logger="flows.memory_limit")
    more = run_sequence(SEQUENCE, config, store, DirectRunner(store), until="surface", memory_limit_gb=0.01)
    assert isinstance(more.error, ConfigError)
    assert "in surface" in caplog.text
    anew = DirectRunner(store, refresh=True)
    refused = run_sequence(SEQUENCE, config, store, anew, until="coarse", memory_limit_gb=0.01)
    assert isinstance(refused.error, ConfigError)
