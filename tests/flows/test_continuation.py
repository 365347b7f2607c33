"""A sequence that grows: its coarse scene goes on from that of fewer frames, where the settings say so."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import tasks.coarse
from extrags.config import CoarseConfig
from extrags.errors import ConfigError
from extrags.store import Manifest, Ref, Slot, Store
from extrags.store.retention import Policy, planned_removals
from flows.outcome import SequenceOutcome, StageRow
from flows.runners import DirectRunner, StoreRunner
from flows.wiring import run_sequence
from tasks.continuation import nearest_scene
from tests.extrags.training.textured_plane import textured_plane
from tests.flows.tiny import tiny_config

PLANE = textured_plane()

SETTINGS: dict[str, Any] = {
    "ingest__width": None,
    "ingest__height": None,
    "ingest__max_frames": None,
    "ingest__holdout_every": 4,
    "coarse__iterations": 40,
    "coarse__max_points": 300,
    "coarse__densify__enabled": False,
    "continuation__scene": "nearest",
    "continuation__iterations_per_new_share": 1.0,
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A posed folder with the first five frames: 0 and 4 are held out."""
    made = tmp_path / "growing"
    (made / "rgb").mkdir(parents=True)
    (made / "depth").mkdir()
    grow(made, 5)
    return made


@pytest.fixture
def store(tmp_path: Path) -> str:
    return str(tmp_path / "store")


def grow(folder: Path, frames: int) -> None:
    """So many of the plane's frames, the first ones; fewer than before as well."""
    assert PLANE.depth_mm is not None
    for file in [*(folder / "rgb").iterdir(), *(folder / "depth").iterdir()]:
        file.unlink()
    listed = []
    for k in range(frames):
        Image.fromarray(PLANE.rgb[k]).save(folder / "rgb" / f"{k:04d}.png")
        np.save(folder / "depth" / f"{k:04d}.npy", PLANE.depth_mm[k])
        pose = PLANE.cameras.world_from_camera[k].tolist()
        listed.append({"file": f"rgb/{k:04d}.png", "world_from_camera": pose})
    content = {"length_unit": "mm", "K": PLANE.K[0].tolist(), "frames": listed}
    (folder / "poses.json").write_text(json.dumps(content))


def run(folder: Path, store: str, **changes: Any) -> SequenceOutcome:
    config = tiny_config(**{**SETTINGS, **changes})
    outcome = run_sequence(str(folder), config, store, DirectRunner(store), until="coarse")
    if outcome.error is not None:
        raise outcome.error
    return outcome


def coarse_row(outcome: SequenceOutcome) -> StageRow:
    row = outcome.row("coarse")
    assert row is not None
    return row


def made(outcome: SequenceOutcome, store: str) -> Manifest:
    return Store(store).manifest(outcome.refs["coarse"])


def test_it_goes_on_from_the_scene_of_fewer_frames(folder: Path, store: str) -> None:
    first = run(folder, store)
    assert made(first, store).stage == "coarse"
    assert "started anew, no earlier scene" in coarse_row(first).reason
    grow(folder, 8)
    second = run(folder, store)
    manifest = made(second, store)
    key = made(first, store).key
    assert manifest.stage == "continued-coarse"
    assert manifest.input_keys["earlier"] == key
    assert manifest.inputs["earlier"] == first.refs["coarse"].digest
    # Of frames 1 2 3 5 6 7 the first three; 3 of 6 are new, so half of the 40 iterations.
    assert manifest.config["frames"] == [0, 1, 2]
    assert manifest.counts["continued_from"] == key
    said = f"continued from {key}, 3 of 6 training frames, 20 of 40 iterations"
    assert manifest.counts["summary"] == said
    assert said in coarse_row(second).reason
    history = Store(store).load_json("history.json", second.refs["coarse"])
    assert history[-1]["iteration"] == 19


def test_a_repeated_run_finds_its_own_whatever_has_come_or_gone(folder: Path, store: str) -> None:
    first = run(folder, store)
    grow(folder, 8)
    second = run(folder, store)
    # A scene that shares more frames has come since.
    grow(folder, 7)
    between = run(folder, store)
    assert made(between, store).counts["continued_frames"] == 3
    grow(folder, 8)
    Store(store).rm(made(first, store).key)
    again = run(folder, store)
    assert again.refs["coarse"] == second.refs["coarse"]
    assert coarse_row(again).state == "cached"
    config = tiny_config(**SETTINGS)
    looked_up = run_sequence(str(folder), config, store, StoreRunner(store), until="coarse")
    assert looked_up.refs["coarse"] == second.refs["coarse"]
    # Made anew, it takes what is there.
    runner = DirectRunner(store, refresh=True)
    renewed = run_sequence(str(folder), config, store, runner, until="coarse")
    assert renewed.error is None
    assert made(renewed, store).counts["continued_frames"] == 5


def test_made_anew_it_goes_on_from_its_start_as_that_is_now(
    folder: Path, store: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Never from the scene of the same frames, which it replaces."""

    def renewed() -> SequenceOutcome:
        runner = DirectRunner(store, refresh=True)
        return run_sequence(str(folder), tiny_config(**SETTINGS), store, runner, until="coarse")

    first = run(folder, store)
    grow(folder, 8)
    second = run(folder, store)
    assert renewed().refs["coarse"] == second.refs["coarse"]
    # The start is made anew, and is not the same, as on another number of threads.
    grow(folder, 5)
    usual = tasks.coarse.save_reconstruction

    def otherwise(slot: Slot, *given: Any) -> None:
        usual(slot, *given)
        slot.save_json("other.json", {})

    with monkeypatch.context() as patched:
        patched.setattr(tasks.coarse, "save_reconstruction", otherwise)
        other = renewed()
    assert other.refs["coarse"].digest != first.refs["coarse"].digest
    grow(folder, 8)
    again = renewed()
    assert again.error is None
    manifest = made(again, store)
    assert manifest.inputs["earlier"] == other.refs["coarse"].digest
    assert manifest.counts["continued_frames"] == 3


def test_the_one_that_shares_most_frames_is_taken(folder: Path, store: str) -> None:
    run(folder, store)
    grow(folder, 7)
    nearer = run(folder, store, continuation__scene="none")
    grow(folder, 8)
    assert made(run(folder, store), store).counts["continued_from"] == made(nearer, store).key


def test_without_the_setting_every_scene_starts_anew(folder: Path, store: str) -> None:
    run(folder, store)
    grow(folder, 8)
    anew = run(folder, store, continuation__scene="none")
    assert made(anew, store).stage == "coarse"
    assert coarse_row(anew).reason == ""
    # With it, what started anew of the same frames is as near as can be.
    same = run(folder, store)
    assert same.refs["coarse"] == anew.refs["coarse"]
    assert "in the store already" in coarse_row(same).reason


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"coarse__seed": 3}, "other settings: coarse.seed"),
        ({"coarse__iterations": 41}, "40 iterations, fewer than 41"),
        ({"ingest__width": 48, "ingest__height": 40}, "its frames are 96 x 80 pixels, not 48 x 40"),
        # Frames 0, 3 and 6 are held out now; 3 was trained on.
        ({"ingest__holdout_every": 3}, "0003 is not among the training frames of this run"),
    ],
)
def test_others_are_refused_with_the_reason(
    changes: dict[str, Any], reason: str, folder: Path, store: str
) -> None:
    run(folder, store)
    grow(folder, 8)
    outcome = run(folder, store, **changes)
    assert made(outcome, store).stage == "coarse"
    assert coarse_row(outcome).reason.startswith("started anew, no earlier scene to continue from: coarse-v")
    assert reason in coarse_row(outcome).reason


def test_frames_that_have_gone_are_a_reason(folder: Path, store: str) -> None:
    first = run(folder, store)
    Store(store).rm(made(first, store).input_keys["sequence"])
    grow(folder, 8)
    assert "its training frames are not in the store any more" in coarse_row(run(folder, store)).reason


def test_another_folder_is_another_source(folder: Path, store: str, tmp_path: Path) -> None:
    run(folder, store)
    elsewhere = folder.rename(tmp_path / "elsewhere")
    grow(elsewhere, 8)
    assert "the store has no other coarse scene of that name" in coarse_row(run(elsewhere, store)).reason


@pytest.mark.parametrize(("first", "second"), [("{}", "{}/"), ("{}/", "{}"), ("{}/../growing", "growing")])
def test_spellings_of_a_path_are_one_source(
    first: str, second: str, folder: Path, store: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder.parent)
    config = tiny_config(**SETTINGS)

    def outcome(spelling: str) -> SequenceOutcome:
        name = spelling.format(folder)
        return run_sequence(name, config, store, DirectRunner(store), until="coarse")

    earlier = made(outcome(first), store)
    assert not earlier.label.endswith("/")
    grow(folder, 8)
    assert made(outcome(second), store).counts["continued_from"] == earlier.key


def test_labels_of_earlier_versions_are_the_same_source(folder: Path, store: str) -> None:
    """They end in a slash where the user ended the path in one."""
    config = CoarseConfig()
    frames = Ref(uri="none", digest="none")
    there = Store(store)
    with there.slot(stage="coarse", version=1, key="coarse-v1-0", label=f"{folder}/"):
        pass
    assert set(nearest_scene(there, str(folder), frames, config).refusals) == {"coarse-v1-0"}
    assert not nearest_scene(there, f"{folder.parent}/other", frames, config).refusals


def test_an_at_in_a_folder_is_no_setting(tmp_path: Path) -> None:
    there = Store(tmp_path / "store")
    with there.slot(stage="coarse", version=1, key="coarse-v1-0", label="/data/me@here/a@sparse"):
        pass

    def looked_at(label: str) -> bool:
        search = nearest_scene(there, label, Ref(uri="none", digest="none"), CoarseConfig())
        return bool(search.refusals)

    assert looked_at("/data/me@here/a@distanced")
    assert not looked_at("/data/me@there/b@sparse")


def test_what_it_went_on_from_is_kept(folder: Path, store: str) -> None:
    first = run(folder, store)
    grow(folder, 8)
    run(folder, store)
    later = 1e10
    policy = Policy(keep_last=1, unreachable=True)
    gone = {item.key for item in planned_removals(Store(store), policy, now=later).removed}
    assert not gone & {made(first, store).key, made(first, store).input_keys["sequence"]}


def test_beside_an_imported_scene_it_is_refused() -> None:
    config = tiny_config(**SETTINGS, imported__scene="scene.ply")
    with pytest.raises(ConfigError, match=r"continuation\.scene=nearest"):
        config.check_imported()
