"""Settings and options that do not fit are refused before anything is made."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
from PIL import Image

from extrags.errors import ConfigError
from flows.cases import SequenceCase
from flows.cli import main, parser
from flows.commands.run_checks import check_working_distance
from tests.flows.tiny import SEQUENCE

pytestmark = pytest.mark.usefixtures("untouched_environment")

DISTANCE = {"poses.working_distance_mm": 20.0}


@pytest.fixture
def frames(tmp_path: Path) -> str:
    """A folder of frames without poses."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for number in range(9):
        Image.new("RGB", (64, 48), (90, 60, 50 + number)).save(folder / f"{number}.png")
    return str(folder)


class TestSettingsOfOtherSources:
    @pytest.mark.parametrize("arguments", [["run"], ["plan"], ["data", "show"]])
    def test_a_part_of_what_has_no_times(
        self, arguments: list[str], frames: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        store = [] if arguments[0] == "data" else ["--store", str(tmp_path / "store")]
        assert main([*arguments, frames, "--ingest.start_s", "5", *store]) == 2
        said = capsys.readouterr().err
        assert said.startswith("extrags: frames: ingest.start_s = 5 cut a video or a DICOM file by its times")
        assert said.count("\n") == 1

    def test_a_check_of_what_has_no_times(self, frames: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["data", "check", frames, "--ingest.start_s", "5"]) == 1
        said = capsys.readouterr().out
        assert f"{frames}: frames: ingest.start_s = 5 cut a video or a DICOM file by its times" in said

    @pytest.mark.parametrize("verb", ["run", "plan"])
    def test_a_distance_for_given_poses(
        self, verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        arguments = [verb, SEQUENCE, "--poses.working_distance_mm", "20", "--store", str(tmp_path / "store")]
        assert main(arguments) == 2
        said = capsys.readouterr().err
        assert f"{SEQUENCE}: poses.working_distance_mm makes estimated poses metric" in said
        assert "ingest.scale_mm_per_unit (--scale)" in said
        assert said.count("\n") == 1

    def test_a_unit_of_poses_that_are_not_there(
        self, frames: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["run", frames, "--scale", "20", "--store", str(tmp_path / "store")]) == 2
        said = capsys.readouterr().err
        assert said.startswith("extrags: frames: ingest.scale_mm_per_unit is the unit of the source's poses")
        assert said.count("\n") == 1

    def test_a_distance_for_poses_that_are_estimated(self, frames: str) -> None:
        again = {**DISTANCE, "poses.replace_given": True}
        check_working_distance([SequenceCase(frames, settings=DISTANCE)])
        check_working_distance([SequenceCase(SEQUENCE, settings=again), SequenceCase(SEQUENCE)])

    def test_a_distance_for_some(self, frames: str, caplog: pytest.LogCaptureFixture) -> None:
        cases = [SequenceCase(name, settings=DISTANCE) for name in (frames, SEQUENCE, "phantom/1@sparse")]
        with caplog.at_level(logging.WARNING):
            check_working_distance(cases)
        (said,) = caplog.messages
        assert said.startswith(f"{SEQUENCE} and 1 more: poses.working_distance_mm makes estimated poses")
        with pytest.raises(ConfigError, match=r"and 1 more: poses\.working_distance_mm"):
            check_working_distance(cases[1:])


class TestRunners:
    @pytest.mark.parametrize("verb", ["run", "plan", "benchmark"])
    @pytest.mark.parametrize(
        ("name", "message"),
        [
            ("dsk", "no task runner 'dsk'; expected threads, dask or dask:ADDRESS; did you mean dask?"),
            ("threads:4", "no task runner 'threads:4'; expected threads, dask or dask:ADDRESS (see"),
            ("dask:nonsense", "nonsense is no address of a Dask scheduler; expected HOST:PORT, or"),
            ("dask:tcp://127.0.0.1", "tcp://127.0.0.1 is no address of a Dask scheduler"),
            ("dask:tcp://:8786", "tcp://:8786 is no address of a Dask scheduler"),
            ("dask:tpc://127.0.0.1:8786", "tpc://127.0.0.1:8786 is no address of a Dask scheduler"),
            ("dask:node-1:99999", "node-1:99999 is no address of a Dask scheduler"),
            ("dask:::1:8786", "::1:8786 is no address of a Dask scheduler"),
        ],
    )
    def test_an_unknown_one_is_refused_by_the_parser(self, verb: str, name: str, message: str) -> None:
        with pytest.raises(ConfigError) as caught:
            parser(verb).parse_args([verb, SEQUENCE, "--runner", name])
        assert message in str(caught.value)

    @pytest.mark.parametrize(
        "name",
        [
            *("threads", "dask", "dask:tcp://127.0.0.1:8786", "dask:node-1.cluster:8786"),
            *("dask:tls://[::1]:8786", "dask:[fe80::1%eth0]:8786"),
        ],
    )
    def test_known_ones(self, name: str) -> None:
        assert parser("run").parse_args(["run", SEQUENCE, "--runner", name]).runner == name


class TestLimits:
    """Limits are looked at by the parser: what is in the store already needs no flow that would."""

    @pytest.mark.parametrize("verb", ["run", "plan", "benchmark"])
    @pytest.mark.parametrize(
        ("option", "value", "expected"),
        [
            ("--retries", "-1", "a whole number from 0 to 10"),
            ("--retries", "11", "a whole number from 0 to 10"),
            ("--retries", "few", "a whole number from 0 to 10"),
            ("--stage-time-limit", "0", "a finite number above 0"),
            ("--stage-time-limit", "nan", "a finite number above 0"),
            ("--stage-time-limit", "-5", "a finite number above 0"),
            ("--stage-time-limit", "inf", "a finite number above 0"),
        ],
    )
    def test_out_of_range(self, verb: str, option: str, value: str, expected: str) -> None:
        with pytest.raises(ConfigError) as caught:
            parser(verb).parse_args([verb, SEQUENCE, option, value])
        assert f"argument {option}: {value}; expected {expected} (see" in str(caught.value)

    @pytest.mark.parametrize("value", ["-1", "0", "much"])
    def test_memory_out_of_range(self, value: str) -> None:
        with pytest.raises(ConfigError) as caught:
            parser("run").parse_args(["run", SEQUENCE, "--memory-limit", value])
        assert f"argument --memory-limit: {value}; expected a finite number above 0" in str(caught.value)

    def test_in_range(self) -> None:
        given = parser("run").parse_args(
            ["run", SEQUENCE, "--retries", "0", "--stage-time-limit", "0.5", "--memory-limit", "6"]
        )
        assert (given.retries, given.stage_time_limit, given.memory_limit) == (0, 0.5, 6.0)
