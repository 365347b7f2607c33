"""Damage in a run: noticed, set aside, made anew, and the same in the end."""

from __future__ import annotations

import json
import random
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from extrags.errors import ArtefactGoneError, DamagedArtefactError
from extrags.store import Ref, Store
from flows.damage import again_after_damage
from flows.outcome import SequenceOutcome
from flows.runners import Call, DirectRunner, PrefectRunner, Result, StoreRunner
from flows.wiring import run_sequence
from tests.flows.damaging import chunks_of, delete, files_of, flip_bit, trials, truncate
from tests.flows.tiny import SEQUENCE, TINY, tiny_config

RGB = "sequence.zarr.zip"


@pytest.fixture
def store(finished: tuple[str, SequenceOutcome], tmp_path: Path) -> Store:
    """A copy of the finished store, where this process has looked at nothing yet."""
    shutil.copytree(Path(finished[0]) / "artefacts", tmp_path / "store" / "artefacts")
    return Store(tmp_path / "store")


def key_of(outcome: SequenceOutcome, part: str) -> str:
    return Path(outcome.artefacts[part]).name


def flip(store: Store, key: str, file: str) -> None:
    flip_bit(Path(store.root) / "artefacts" / key / file, random.Random(0))


def run(store: Store) -> SequenceOutcome:
    return run_sequence(SEQUENCE, tiny_config(), store.root, DirectRunner(store.root), profile="quick")


def records(store: Store) -> Iterator[tuple[str, str]]:
    for path in sorted((Path(store.root) / "damaged").glob("*/damage.json")):
        record = json.loads(path.read_bytes())
        yield record["stage"], record["file"]


def test_a_missing_chunk_is_made_anew(
    finished: tuple[str, SequenceOutcome], store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    _, whole = finished
    key = key_of(whole, "ingest")
    (Path(store.root) / "artefacts" / key / RGB).unlink()
    outcome = run(store)
    assert outcome.status == "ok"
    assert [row.stage for row in outcome.stages if row.state == "ran"] == ["ingest"]
    assert outcome.digests == whole.digests
    assert outcome.metrics == whole.metrics
    assert f"stage ingest: artefact {key} is damaged ({RGB}: is missing); it is set aside as" in caplog.text
    assert list(records(store)) == [("ingest", RGB)]


def test_what_a_later_stage_finds_damaged_is_made_anew(
    finished: tuple[str, SequenceOutcome], store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    _, whole = finished
    for part in ("renders_coarse", "metrics_coarse", "metrics_final"):
        store.rm(key_of(whole, part))
    flip(store, key_of(whole, "ingest"), RGB)
    outcome = run(store)
    assert outcome.status == "ok"
    assert [row.stage for row in outcome.stages if row.state == "ran"] == ["ingest", "evaluate"]
    assert outcome.digests == whole.digests
    assert outcome.metrics == whole.metrics
    assert f"stage ingest: artefact {key_of(whole, 'ingest')} is damaged ({RGB}: its content" in caplog.text
    assert list(records(store)) == [("ingest", RGB)]


def test_what_was_spent_before_the_damage_was_met_counts(
    finished: tuple[str, SequenceOutcome], store: Store
) -> None:
    _, whole = finished
    for part in ("ingest", "coarse", "surface"):
        store.rm(key_of(whole, part))
    inner = DirectRunner(store.root)
    spent: list[float] = []

    class Damaging:
        def run(self, calls: Sequence[Call], label: str) -> list[Result]:
            results = inner.run(calls, label)
            if calls[0].task.name == "coarse" and results[0].state == "ran":
                spent.append(store.manifest(results[0].ref).elapsed_s)
                if len(spent) == 1:
                    flip_bit(min(Path(results[0].ref.uri).rglob("*.zip")), random.Random(0))
            return results

    outcome = run_sequence(SEQUENCE, tiny_config(), store.root, Damaging(), until="surface")
    assert outcome.status == "ok", outcome.error
    rows = {row.stage: row for row in outcome.stages}
    assert len(spent) == 2
    assert rows["coarse"].spent_seconds == pytest.approx(sum(spent))
    assert rows["coarse"].made_seconds == pytest.approx(spent[1])
    # Made before the damage was met, found in the store afterwards.
    assert rows["ingest"].state == "ran"
    assert rows["ingest"].spent_seconds > 0
    assert rows["ingest"].spent_seconds == pytest.approx(rows["ingest"].made_seconds)
    assert rows["assess"].spent_seconds == 0


def test_what_the_wiring_itself_reads_is_made_anew(
    finished: tuple[str, SequenceOutcome], store: Store
) -> None:
    _, whole = finished
    flip(store, key_of(whole, "plan"), "plan.json")
    flip(store, key_of(whole, "metrics_final"), "metrics.json")
    outcome = run(store)
    assert outcome.digests == whole.digests
    assert {stage for stage, _ in records(store)} == {"plan", "evaluate"}


def test_figures_of_all_scenes_serve_metrics_that_an_interrupted_run_lacks(
    finished: tuple[str, SequenceOutcome], store: Store
) -> None:
    """Nothing is measured again, nor stored under another key."""
    _, whole = finished
    before = sorted(store.keys())
    store.rm(key_of(whole, "metrics_final"))
    outcome = run(store)
    assert outcome.status == "ok"
    assert outcome.digests == whole.digests
    assert sorted(store.keys()) == before


def test_who_only_looks_moves_nothing(finished: tuple[str, SequenceOutcome], store: Store) -> None:
    _, whole = finished
    (Path(store.root) / "artefacts" / key_of(whole, "coarse") / "manifest.json").write_text("{")
    outcome = run_sequence(SEQUENCE, tiny_config(), store.root, StoreRunner(store.root))
    assert outcome.status == "failed"
    assert isinstance(outcome.error, DamagedArtefactError)
    assert not (Path(store.root) / "damaged").exists()


def test_a_run_that_is_not_whole_in_the_store_is_no_finished_run(
    finished: tuple[str, SequenceOutcome], store: Store
) -> None:
    from flows.cases import SequenceCase
    from flows.commands.run import _from_store

    _, whole = finished
    arguments = ([SequenceCase(SEQUENCE, profile="quick", settings=TINY)], store.root, "evaluate")
    assert _from_store(*arguments) is not None
    (Path(store.root) / "artefacts" / key_of(whole, "renders_final") / "renders.zarr.zip").unlink()
    assert _from_store(*arguments) is None


def test_outcomes_from_the_store_tell_several_seeds_apart(
    finished: tuple[str, SequenceOutcome], store: Store
) -> None:
    from flows.cases import SequenceCase
    from flows.commands.run import _from_store

    # Frames do not depend on the seed: what one run has read serves both.
    cases = [SequenceCase(SEQUENCE, profile="quick", seed=seed, settings=TINY) for seed in (0, 1)]
    several = _from_store(cases, store.root, "ingest", several_seeds=True)
    one = _from_store(cases[:1], store.root, "ingest")
    assert several is not None
    assert one is not None
    assert [outcome.seed for outcome in several.sequences] == [0, 1]
    assert one.sequences[0].seed is None


@pytest.mark.usefixtures("prefect_server")
def test_a_flow_goes_on(
    finished: tuple[str, SequenceOutcome], store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    from prefect import flow

    _, whole = finished
    store.rm(key_of(whole, "coarse"))
    flip(store, key_of(whole, "training"), RGB)
    (Path(store.root) / "artefacts" / key_of(whole, "ingest") / RGB).unlink()

    @flow(name="damaged")
    def damaged() -> SequenceOutcome:
        runner = PrefectRunner(store.root)
        return run_sequence(SEQUENCE, tiny_config(), store.root, runner, until="coarse")

    outcome = damaged()
    assert outcome.status == "ok"
    assert outcome.digests == {part: whole.digests[part] for part in outcome.digests}
    assert {stage for stage, _ in records(store)} == {"ingest", "training-frames"}


def test_an_artefact_that_is_damaged_again_and_again_ends_the_run(tmp_path: Path) -> None:
    store = Store(tmp_path)
    begun = []

    def work() -> Ref:
        begun.append(1)
        with store.slot(stage="toy", version=1, key="toy-v1-aa") as slot:
            (slot.path / "number").write_text("1")
        (tmp_path / "artefacts" / "toy-v1-aa" / "number").write_text("2")
        store.open(slot.ref)
        return slot.ref

    with pytest.raises(DamagedArtefactError, match="toy-v1-aa of stage toy"):
        again_after_damage(store, work)
    assert len(begun) == 2


def test_what_another_run_sets_aside_is_looked_up_again(tmp_path: Path) -> None:
    ends = [ArtefactGoneError("removed meanwhile", "toy-v1-aa"), None]

    def work() -> str:
        end = ends.pop(0)
        if end is not None:
            raise end
        return "made"

    assert again_after_damage(Store(tmp_path), work) == "made"


def test_other_errors_are_not_tried_again(tmp_path: Path) -> None:
    def work() -> None:
        raise DamagedArtefactError("read without a store", file="a/b")

    with pytest.raises(DamagedArtefactError, match="read without a store"):
        again_after_damage(Store(tmp_path), work)


def test_random_damage_is_named(finished: tuple[str, SequenceOutcome]) -> None:
    for ends in trials(Path(finished[0]), 4, seed=1).values():
        assert ends == Counter(named=4)


def test_random_damage_is_named_if_chunks_are_left_to_their_checksums(
    finished: tuple[str, SequenceOutcome],
) -> None:
    for ends in trials(Path(finished[0]), 2, seed=2, verify="metadata").values():
        assert ends == Counter(named=2)


@pytest.mark.slow
def test_much_random_damage_is_named(finished: tuple[str, SequenceOutcome]) -> None:
    for ends in trials(Path(finished[0]), 100, seed=3).values():
        assert ends == Counter(named=100)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_a_run_over_much_damage_ends_bit_identical(
    finished: tuple[str, SequenceOutcome], store: Store, seed: int
) -> None:
    _, whole = finished
    root = Path(store.root)
    chance = random.Random(seed)
    for pattern in chance.sample(["coarse", "explore*", "enhance*", "finetune*", "evaluate*", "surface"], 3):
        store.rm(pattern)
    for file in chance.sample(files_of(root), 8):
        flip_bit(root / file, chance)
    arrays = chunks_of(root)
    for file in chance.sample(arrays, min(5, len(arrays))):
        chance.choice([delete, truncate])(root / file, chance)
    outcome = run(store)
    assert outcome.status == "ok"
    assert outcome.digests == whole.digests
    # What no stage read is still there, and nobody was given it.
    left = [damage for damage in map(store.examine, store.keys()) if damage is not None]
    for damage in left:
        assert store.set_aside(damage) is not None
    outcome = run(store)
    assert outcome.digests == whole.digests
    assert not any(map(store.examine, store.keys()))
