"""What a terminal shows of a run, at times that the test sets."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pytest
from PIL import Image
from rich.console import Console

from extrags.stages import STAGES
from extrags.store import Store
from flows.outcome import SequenceOutcome
from flows.previews import stage_preview
from flows.progress_display import RunDisplay, RunInView, progress_display
from tasks.progress import StageProgress, current_observer, notify
from tests.flows.tiny import SEQUENCE


class Terminal:
    """A display with a clock, and what it printed above itself."""

    def __init__(self, sequences: int = 1, width: int = 110, height: int = 100) -> None:
        self.now = 0.0
        self.printed: list[str] = []
        self.width, self.height = width, height
        self.display = RunDisplay(
            RunInView(sequences), announce=self.printed.append, clock=lambda: self.now, preview=self.preview
        )

    def preview(self, progress: StageProgress, show: object) -> None:
        if callable(show) and progress.stage == "coarse":
            show("state/previews/scene.jpg (what the coarse scene shows)")

    def starts(self, stage: str, label: str = "scene") -> None:
        self.display(StageProgress(label, stage, "running"))

    def at(self, stage: str, done: int, total: int, detail: str = "") -> None:
        self.display(StageProgress("scene", stage, "running", done, total, detail))

    def ends(self, stage: str, state: str = "ran", label: str = "scene", why: str = "") -> None:
        self.display(StageProgress(label, stage, state, detail=why, seconds=3.0))

    def shown(self) -> str:
        out = Console(file=io.StringIO(), width=self.width, height=self.height, color_system=None)
        out.print(self.display)
        assert isinstance(out.file, io.StringIO)
        return out.file.getvalue()


class TestDisplay:
    def test_stages_rate_and_rest(self) -> None:
        terminal = Terminal()
        terminal.starts("ingest")
        terminal.ends("ingest")
        terminal.ends("poses", "skipped", why="the source has poses")
        terminal.starts("coarse")
        terminal.at("coarse", 0, 1000)
        terminal.now = 10.0
        terminal.at("coarse", 400, 1000, "loss 0.031")
        shown = " ".join(terminal.shown().split())
        assert "scene ✓ ingest - poses · depth ▸ coarse · assess" in shown
        assert "400 of 1000, 40/s, about 15 s left" in shown
        assert "loss 0.031" in shown
        assert "10 s so far" in shown

    def test_what_is_not_done_is_no_hundred_per_cent(self) -> None:
        terminal = Terminal()
        terminal.starts("evaluate")
        for stage in STAGES[:-1]:
            terminal.ends(stage)
        terminal.starts("report")
        terminal.at("report", 9999, 10000)
        assert "  99 %, " in terminal.shown()
        terminal.ends("report")
        assert "  100 %, " in terminal.shown()

    @pytest.mark.parametrize("label", ["大腸の内視鏡" * 3, "c" * 36])
    def test_breaks_stand_between_stages_however_wide_the_letters(self, label: str) -> None:
        terminal = Terminal(width=60)
        terminal.starts("ingest", label)
        first, second, *_ = terminal.shown().splitlines()
        assert first.rstrip() == f"{label}  ▸ ingest  · poses"
        assert second.startswith("  · depth")

    def test_the_end_of_a_stage_is_a_line_above(self) -> None:
        terminal = Terminal()
        terminal.starts("coarse")
        terminal.at("coarse", 5, 10)
        terminal.ends("coarse")
        terminal.ends("depth", "skipped", why="[sic] the source has depth")
        assert [line.split("]")[0] for line in terminal.printed] == ["[green", "[dim"]
        assert "scene  coarse     ran          3.0 s" in terminal.printed[0]
        assert r"\[sic] the source has depth" in terminal.printed[1]
        assert "5 of 10" not in terminal.shown()
        assert "picture  state/previews/scene.jpg (what the coarse scene shows)" in terminal.shown()

    def test_branches_do_not_flicker(self) -> None:
        terminal = Terminal()
        terminal.starts("explore")
        terminal.at("explore", 3, 12)
        terminal.at("explore-branch", 2, 10)
        assert "3 of 12" in terminal.shown()
        assert "2 of 10" not in terminal.shown()

    def test_a_failure_is_one_line(self) -> None:
        terminal = Terminal(sequences=2)
        terminal.starts("ingest", "broken")
        terminal.ends("ingest", "failed", "broken", "no frames")
        for stage in ("poses", "depth", "coarse"):
            terminal.ends(stage, "skipped", "broken", "ingest failed")
        assert len(terminal.printed) == 1
        terminal.starts("ingest", "sound")
        shown = terminal.shown()
        assert "1 of 2 sequences done, 1 failed" in shown
        assert "broken" not in shown
        assert "sound" in shown

    def test_more_sequences_than_there_is_room_for(self) -> None:
        terminal = Terminal(sequences=9)
        for number in range(7):
            terminal.starts("ingest", f"scene{number}")
        assert "and 3 more sequences" in terminal.shown()

    def test_a_narrow_terminal_wraps_between_stages(self) -> None:
        terminal = Terminal(width=50)
        terminal.starts("ingest")
        lines = terminal.shown().splitlines()
        assert all(len(line.rstrip()) <= 50 for line in lines)
        assert sum(line.count("· ") for line in lines) == 11

    @pytest.mark.parametrize("width", [28, 33, 36, 50, 60, 75, 76, 95, 110, 129])
    def test_names_stay_whole_as_long_as_anything_else_can_go(self, width: int) -> None:
        terminal = Terminal(width=width)
        for stage in ("finetune-judge", "pretrain-hidden-depth"):
            terminal.now = 0.0
            terminal.at(stage, 0, 1000)
            terminal.now = 10.0
            terminal.at(stage, 400, 1000, "loss 0.031, psnr 24.1")
            (line,) = (line for line in terminal.shown().splitlines() if "400" in line)
            assert len(line.rstrip()) <= width
            assert "400 of 1000" in line
            if width >= len(f"  {stage}  400 of 1000"):
                assert stage in line
            else:
                assert line.startswith(f"  {stage[:8]}")
                assert "…" in line

    @pytest.mark.parametrize(
        ("height", "shown", "told"),
        [(24, 4, "and 1 more sequence"), (7, 2, "and 3 more sequences"), (3, 0, "5 sequences in work")],
    )
    def test_the_whole_run_stays_in_sight_in_a_low_terminal(self, height: int, shown: int, told: str) -> None:
        terminal = Terminal(sequences=30, width=80, height=height)
        for number in range(5):
            terminal.starts("ingest", f"scene{number}")
        lines = terminal.shown().splitlines()
        assert len(lines) <= height
        assert sum("ingest" in line for line in lines) == shown
        assert told in map(str.strip, lines)
        assert "0 of 30 sequences done" in lines[-1]

    def test_one_sequence_needs_no_line_that_tells_of_more(self) -> None:
        terminal = Terminal(width=110, height=3)
        terminal.starts("ingest")
        assert "ingest" in terminal.shown()
        assert "in work" not in terminal.shown()

    def test_a_loop_that_is_no_stage_of_a_run(self) -> None:
        terminal = Terminal(sequences=0)
        terminal.at("pretrain", 5, 10)
        assert "pretrain" in terminal.shown()
        assert "whole run" not in terminal.shown()


def test_lines_of_others_and_the_display_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between looking where the cursor stands and writing, no other thread moves it."""
    held = 0

    class Turn:
        def __enter__(self) -> None:
            nonlocal held
            held += 1

        def __exit__(self, *_: object) -> None:
            nonlocal held
            held -= 1

    class Written(io.StringIO):
        def write(self, text: str) -> int:
            assert held or not text
            return super().write(text)

        def isatty(self) -> bool:
            return True

    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("flows.progress_display.threading.RLock", Turn)
    monkeypatch.setattr("flows.progress_display.REFRESH_SECONDS", 60.0)
    monkeypatch.setattr(sys, "stderr", Written())
    written = sys.stderr
    with progress_display("terminal", RunInView(1)):
        notify(StageProgress("scene", "coarse", "ran", seconds=1.0))
        print("a line of the log", file=sys.stderr)
    assert held == 0
    assert isinstance(written, io.StringIO)
    assert "a line of the log" in written.getvalue()


def test_quiet_says_nothing(caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]) -> None:
    caplog.set_level("INFO")
    with progress_display("nothing"):
        notify(StageProgress("scene", "coarse", "running"))
    assert caplog.messages == []
    assert capsys.readouterr() == ("", "")


def test_the_log_has_it_without_a_terminal() -> None:
    with progress_display("log"):
        assert current_observer() is None


@pytest.mark.parametrize(
    ("stage", "tiles", "words"),
    [
        ("ingest", 1, "as recorded"),
        ("coarse", 3, "recorded, coarse scene, final scene"),
        ("enhance", 2, "rendered, restored"),
        ("evaluate", 4, "recorded, coarse scene, final scene, the same, restored"),
    ],
)
def test_pictures_of_stages(
    finished: tuple[str, SequenceOutcome], stage: str, tiles: int, words: str
) -> None:
    root, outcome = finished
    found = stage_preview(SEQUENCE, stage, dict(outcome.refs), Store(root))
    assert found is not None
    path, said = found
    assert path == Path(Store(root).state / "previews" / "phantom-0@sparse.jpg")
    with Image.open(path) as picture:
        assert picture.size == (48 * tiles, 40)
    assert words in said


def test_stages_that_make_nothing_to_look_at(finished: tuple[str, SequenceOutcome]) -> None:
    root, outcome = finished
    assert stage_preview(SEQUENCE, "assess", dict(outcome.refs), Store(root)) is None
