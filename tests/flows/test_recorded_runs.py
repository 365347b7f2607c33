"""Runs on record: which are compared, by what names; the verbs that make pages of them."""

from __future__ import annotations

import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from data_catalog.catalog import describe
from extrags import __version__
from extrags.errors import ConfigError, StoreError
from extrags.metrics.registry import PROTOCOL_VERSION
from extrags.pipeline import HELD_OUT_TRAINED_ON
from extrags.sequence import EndoscopicSequence
from extrags.store import Manifest, Store, write_record
from extrags.store.records import remove_record
from flows.cases import SequenceCase, record_outcome
from flows.cli import main
from flows.commands.common import _on_record, parsed_settings, run_options
from flows.outcome import SequenceOutcome
from flows.outcome_records import OUTCOME, outcome_records
from flows.recorded_runs import (
    RecordedRun,
    board_rows,
    chosen_runs,
    compared_run,
    gallery_run,
    held_out_digest,
    last_runs,
    run_names,
)
from flows.runners import DirectRunner
from flows.store_status import store_status
from flows.wiring import run_sequence
from tests.flows.tiny import SEQUENCE, tiny_config

pytestmark = pytest.mark.usefixtures("untouched_environment")


@pytest.fixture(scope="module")
def store(finished: tuple[str, SequenceOutcome], tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Two runs on record that differ in a setting, and one that failed."""
    root = tmp_path_factory.mktemp("recorded") / "store"
    # Without the records that other tests have left there.
    shutil.copytree(finished[0], root, ignore=shutil.ignore_patterns("records"))
    found = Store(str(root))
    for views in (1, 2):
        config = tiny_config(report__held_out_views=views)
        outcome = run_sequence(SEQUENCE, config, str(root), DirectRunner(str(root)), profile="quick")
        changed = {} if views == 1 else {"report.held_out_views": views}
        case = SequenceCase(SEQUENCE, profile="quick", seed=0, changed=changed)
        record_outcome(found, case, outcome, "report", config)
    failed = SequenceOutcome(SEQUENCE, "failed")
    case = SequenceCase(SEQUENCE, method="3dgs", profile="quick", settings={"coarse.iterations": 60})
    record_outcome(found, case, failed, "report", config)
    return found


def test_a_sequence_stands_for_its_finished_runs(store: Store) -> None:
    runs = chosen_runs(store, [SEQUENCE])
    assert len(runs) == 2
    assert sorted(run_names(runs)) == ["report.held_out_views = 2", "run"]


def test_a_path_stands_for_runs_of_all_its_spellings(store: Store, tmp_path: Path) -> None:
    root = tmp_path / "store"
    shutil.copytree(store.root, root)
    copy = Store(str(root))
    for index, (name, record) in enumerate(sorted(outcome_records(store).items())):
        write_record(copy, name, {**record, "sequence": f"{tmp_path}/colon{'/' * (index % 2)}"})
    for spelling in ("colon", "colon/", "./colon"):
        assert len(chosen_runs(copy, [f"{tmp_path}/{spelling}"])) == 2
        assert "Finished runs of it had --profile quick --seed 0" in _on_record(
            str(root), f"{tmp_path}/{spelling}"
        )
    with pytest.raises(ConfigError, match="0 finished runs"):
        chosen_runs(copy, [f"{tmp_path}/col"])


def test_pages_are_named_by_file_folder_or_key(store: Store) -> None:
    keys = [run.report.key for run in chosen_runs(store, [SEQUENCE])]
    named = chosen_runs(store, [f"somewhere/{keys[0]}/report.html", keys[1]])
    assert [run.report.key for run in named] == keys
    assert all(run.record is not None for run in named)


def test_too_few_runs(store: Store) -> None:
    with pytest.raises(ConfigError, match=r"0 finished runs on record .* and 1 that did not come to a page"):
        chosen_runs(store, [SEQUENCE], methods=["3dgs"])
    with pytest.raises(ConfigError, match=r"did you mean phantom/0@sparse\? A comparison takes two"):
        chosen_runs(store, ["phantom/7@sparse"])
    with pytest.raises(
        ConfigError, match=r"a matrix .*--matrix coarse\.iterations=150,300.*pages of two runs"
    ):
        chosen_runs(store, ["phantom/7@sparse"])


def test_a_page_that_is_gone(store: Store) -> None:
    with pytest.raises(StoreError, match="is not in the store"):
        chosen_runs(store, ["report-v1-0123456789abcdef0123456789abcdef"])


def test_a_folder_of_frames_may_be_called_like_a_page(store: Store) -> None:
    with pytest.raises(ConfigError, match="0 finished runs on record"):
        chosen_runs(store, ["report-video"])


class Traits(RecordedRun):
    """A run of which nothing is known but its traits."""

    def __init__(self, **own: str) -> None:
        object.__setattr__(self, "own", own)

    def traits(self) -> dict[str, str]:
        return dict(self.own)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("traits", "names"),
    [
        (
            [{"method": "3dgs", "seed": "seed 0"}, {"method": "extrags", "seed": "seed 0"}],
            ["3dgs", "extrags"],
        ),
        (
            [{"method": "3dgs", "seed": "seed 0"}, {"method": "extrags", "seed": "seed 1"}],
            ["3dgs, seed 0", "extrags, seed 1"],
        ),
        ([{"method": "3dgs"}, {"method": "3dgs"}], ["run (1)", "run (2)"]),
    ],
)
def test_names_say_what_differs(traits: list[dict[str, str]], names: list[str]) -> None:
    assert run_names([Traits(**own) for own in traits]) == names


@pytest.mark.parametrize("verb", ["leaderboard", "gallery", "compare"])
def test_a_misspelt_sequence_is_answered_with_the_nearest(
    verb: str, store: Store, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([verb, SEQUENCE.replace("phantom", "phamtom"), "--store", store.root]) != 0
    assert f"; did you mean {SEQUENCE}?" in capsys.readouterr().err


@pytest.mark.parametrize(("verb", "name"), [("leaderboard", "board.html"), ("gallery", "folder")])
def test_no_sequence_is_left_out_in_silence(
    verb: str, name: str, store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / name
    misspelt = SEQUENCE.replace("phantom", "phamtom")
    given = ["--store", store.root, "--output", str(page)]
    assert main([verb, SEQUENCE, misspelt, *given]) != 0
    assert f"run of {misspelt} is on record" in (told := capsys.readouterr().err)
    assert f"; did you mean {SEQUENCE}?" in told
    assert not page.exists()
    assert main([verb, SEQUENCE, "phantom/*", *given]) == 0
    assert page.exists()


def test_rows_of_the_leaderboard(store: Store) -> None:
    rows = board_rows(store)
    assert [(row.method, row.status) for row in rows] == [
        ("3dgs", "failed"),
        ("extrags", "ok"),
        ("extrags", "ok"),
    ]
    assert [(row.settings, row.further) for row in rows] == [
        ("", "coarse.iterations = 60"),
        ("", ""),
        ("report.held_out_views = 2", ""),
    ]
    assert rows[1].metrics is not None
    assert rows[1].protocol == PROTOCOL_VERSION
    assert rows[1].link.startswith("file://")
    assert board_rows(store, ["c3vd/*"]) == []
    assert len(board_rows(store, ["phantom/*"])) == 3


def test_relative_names_of_several_places_are_several_sequences(store: Store, tmp_path: Path) -> None:
    """Of two groups that share a store: no mean is over the scans of both."""
    root = tmp_path / "store"
    shutil.copytree(store.root, root)
    copy = Store(str(root))
    (first, *others) = [
        (name, record) for name, record in outcome_records(copy).items() if record["status"] == "ok"
    ]
    for name, _ in others:
        remove_record(copy, name)
    for place in ("a", "b"):
        named = {"sequence": "scan", "path": f"/{place}/scan"}
        write_record(copy, f"{OUTCOME}{place}", {**first[1], **named})
    rows = {row.sequence for row in board_rows(copy, ["scan"])}
    assert rows == {"/a/scan", "/b/scan"}
    assert {row.sequence for row in board_rows(copy, ["/a/*"])} == {"/a/scan"}
    assert [run.place for run in last_runs(copy, ["scan"])] == ["/a/scan", "/b/scan"]
    assert len(last_runs(copy, ["/b/scan"])) == 1


def test_both_pages_from_the_command_line(
    store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "pages" / "compared.html"
    assert main(["compare", SEQUENCE, "--store", store.root, "--views", "1", "-o", str(page)]) == 0
    assert capsys.readouterr().out.strip() == str(page)
    assert "report.held_out_views" in page.read_text(encoding="utf-8")
    board = tmp_path / "board.html"
    assert main(["leaderboard", "phantom/*", "--store", store.root, "-o", str(board), "--quiet"]) == 0
    assert SEQUENCE in board.read_text(encoding="utf-8")


def test_links_can_be_moved_with_the_folder_that_holds_page_and_store(store: Store) -> None:
    """Relative where both are in one folder, else of this machine."""
    folder = Path(store.root).parent / "pages #1"
    links = {row.link for row in board_rows(store, target=str(folder / "board.html")) if row.link}
    for link in links:
        assert link.startswith("../store/artefacts/report-v")
        assert (folder / link).resolve().is_file()
    (apart,) = {row.link[:8] for row in board_rows(store, target="/board.html") if row.link}
    assert apart == "file:///"
    run = chosen_runs(store, [SEQUENCE])[0]
    assert compared_run(store, run, "one", str(folder / "compared.html")).link in links
    inside = compared_run(store, run, "one", f"{store.root}/here#/x.html").link
    assert inside.startswith("../artefacts/")


def test_pages_of_a_store_that_was_moved(store: Store, tmp_path: Path) -> None:
    """Its records have the address of before."""
    moved = Store(shutil.copytree(store.root, tmp_path / "elsewhere" / "store"))
    links = [row.link for row in board_rows(moved) if row.status == "ok"]
    assert len(links) == 2
    assert all(link.startswith((tmp_path / "elsewhere").as_uri()) for link in links)
    pages = [row.report for row in store_status(moved).rows if row.report is not None]
    assert len(pages) == 2
    assert all(Path(page).is_file() and moved.root in page for page in pages)


def test_a_page_that_was_removed_is_linked_from_nowhere(store: Store, tmp_path: Path) -> None:
    copy = Store(shutil.copytree(store.root, tmp_path / "store"))
    copy.rm(chosen_runs(copy, [SEQUENCE])[0].report.key)
    assert sorted(bool(row.link) for row in board_rows(copy) if row.status == "ok") == [False, True]
    assert len([row.report for row in store_status(copy).rows if row.report is not None]) == 1


def test_the_last_run_of_each_sequence(store: Store) -> None:
    last = chosen_runs(store, [SEQUENCE])[-1]
    assert [run.report.key for run in last_runs(store)] == [last.report.key]
    assert last_runs(store, ["c3vd/*"]) == []
    assert last_runs(store, methods=["3dgs"]) == []


def test_gallery_from_the_command_line(
    store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "gallery"
    assert main(["gallery", "phantom/*", "--store", store.root, "--out", str(folder)]) == 0
    assert capsys.readouterr().out.strip() == str(folder / "index.md")
    text = (folder / "index.md").read_text(encoding="utf-8")
    made = f"extrags run {SEQUENCE} --profile quick --seed 0 --set report.held_out_views=2"
    assert f"{made}\nextrags gallery {SEQUENCE}\n" in text
    assert str(tmp_path) not in text
    assert "Virtual view" in text
    assert f"Pictures derive from: {describe(SEQUENCE).description}. Licence: Apache-2.0 (generated)." in text
    said = re.search(r"Made by extrags (\S+)( \([0-9a-f]{9}\))? on (\d{4}-\d\d-\d\d)\n", text)
    assert said is not None
    assert said[1] == __version__


def test_the_command_of_a_gallery_has_its_options(store: Store, tmp_path: Path) -> None:
    folder = tmp_path / "gallery"
    options = ["--profiles", "quick", "--name", "My scenes", "--kb", "300"]
    assert main(["gallery", "phantom/*", "--store", store.root, "--out", str(folder), *options]) == 0
    text = (folder / "index.md").read_text(encoding="utf-8")
    assert f"extrags gallery {SEQUENCE} --profiles quick --name 'My scenes' --kb 300\n" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["compare", "phantom/7@sparse"], "0 finished runs on record"),
        (["compare", SEQUENCE.replace("sparse", "sprase")], f"; did you mean {SEQUENCE}? A comp"),
        (["gallery", SEQUENCE.replace("sparse", "sprase")], f"; did you mean {SEQUENCE}?"),
        (["compare", SEQUENCE, "--views", "0"], "--views 0: expected 1 or more"),
        (["gallery", "c3vd/*"], "no finished run of c3vd/* is on record"),
        (["gallery", "--kb", "0"], "--kb 0: expected 1 or more"),
        (["leaderboard", "c3vd/*"], "no run of c3vd/* is on record"),
    ],
)
def test_mistakes_are_one_sentence(
    store: Store, arguments: list[str], message: str, capsys: pytest.CaptureFixture[Any]
) -> None:
    assert main([*arguments, "--store", store.root]) in (1, 2)
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def test_a_name_with_brackets_is_no_pattern(store: Store, tmp_path: Path) -> None:
    copied = Store(str(tmp_path / "store"))
    shutil.copytree(store.root, copied.root)
    record = next(iter(outcome_records(copied).values()))
    write_record(copied, f"{OUTCOME}bracketed", {**record, "sequence": "scans/a [x]"})
    assert [row.sequence for row in board_rows(copied, ["scans/a [x]"])] == ["scans/a [x]"]
    assert board_rows(copied, ["scans/a [y]"]) == []


@pytest.mark.parametrize(
    ("reason", "config", "said"),
    [
        ("", {}, ""),
        (HELD_OUT_TRAINED_ON, {}, "Oracle: held-out frames were trained on"),
        ("", {"imported": {"scene": "their.ply"}}, "The scene is imported: whether it has seen the held-out"),
    ],
)
def test_what_a_scene_has_seen_is_said(reason: str, config: dict[str, Any], said: str, store: Store) -> None:
    run = chosen_runs(store, [SEQUENCE])[0]
    assert run.record is not None
    manifest = run.report.model_copy(update={"config": {"config": config}})
    seen = RecordedRun(manifest, {**run.record, "stages": [{"stage": "coarse", "reason": reason}]})
    shown = gallery_run(store, seen).held_out
    assert shown.startswith(said)
    assert bool(shown) == bool(said)


def test_pages_of_runs_are_named_after_the_run_not_after_its_frames(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames of equal content are one artefact, which has the name of the source that was read first."""
    renamed = [
        replace(run, report=run.report.model_copy(update={"config": {**run.report.config, "name": "copy"}}))
        for run in chosen_runs(store, [SEQUENCE])
    ]
    assert gallery_run(store, renamed[0]).sequence.name == "copy"
    monkeypatch.setattr("flows.recorded_runs.chosen_runs", lambda *_, **__: renamed)
    page = tmp_path / "page.html"
    assert main(["compare", SEQUENCE, "--views", "1", "--store", store.root, "--output", str(page)]) == 0
    assert "<title>copy" in page.read_text()


@pytest.mark.parametrize(
    ("sequence", "path", "config", "name"),
    [
        ("phantom/0@sparse", None, {}, "phantom/0@sparse"),
        ("scans/colon", "/data/scans/colon", {}, "colon"),
        ("scans/colon", "/data/scans/colon", {"name": "kept"}, "kept"),
    ],
)
def test_what_a_run_is_called_on_pages(
    sequence: str, path: str | None, config: dict[str, Any], name: str
) -> None:
    page = Manifest(stage="report", version=1, key="report-v1-a", digest="", config=config)
    assert RecordedRun(page, {"sequence": sequence, "path": path}).shown_name == name


def test_boards_know_what_has_seen_held_out_frames(store: Store, tmp_path: Path) -> None:
    copied = Store(str(tmp_path / "store"))
    shutil.copytree(store.root, copied.root)
    name, record = next(item for item in outcome_records(copied).items() if item[1]["status"] == "ok")
    assert not any(row.held_out_trained_on for row in board_rows(copied))
    stages = [{**stage, "reason": HELD_OUT_TRAINED_ON} for stage in record["stages"]]
    write_record(copied, name, {**record, "stages": stages})
    assert [row.held_out_trained_on for row in board_rows(copied)].count(True) == 1


def test_frames_are_told_by_what_they_show(store: Store) -> None:
    ref = chosen_runs(store, [SEQUENCE])[0].ref(store, "sequence")
    assert ref is not None
    sequence = store.load(EndoscopicSequence, ref)
    before = held_out_digest(sequence)
    train, test = int(sequence.train[0]), int(sequence.test[0])
    rgb = sequence.rgb.copy()
    rgb[train] ^= 1
    assert held_out_digest(replace(sequence, rgb=rgb)) == before
    rgb[test, 0, 0, 0] ^= 1
    assert held_out_digest(replace(sequence, rgb=rgb)) != before
    mask = sequence.mask.copy()
    mask[test, 0, 0] ^= True
    assert held_out_digest(replace(sequence, mask=mask)) != before


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (3, "a.b=3"),
        ([1, 2], "'a.b=[1, 2]'"),
        ("classical", "a.b=classical"),
        ("/home/me/their scene.ply", "'a.b=their scene.ply'"),
        # A word that YAML would read as something else.
        ("no", """'a.b="no"'"""),
    ],
)
def test_settings_are_written_as_they_are_read(value: Any, said: str) -> None:
    run = {"sequence": "x", "method": "extrags", "profile": "quick", "seed": None, "variant": {}}
    run["settings"] = {"a.b": value}
    options = run_options(run, elsewhere=True)
    assert options == f" --profile quick --set {said}"
    (assignment,) = shlex.split(options)[3:]
    read = parsed_settings([assignment])["a.b"]
    assert read == (Path(value).name if isinstance(value, str) else value)
    (assignment,) = shlex.split(run_options(run))[3:]
    assert parsed_settings([assignment])["a.b"] == value
