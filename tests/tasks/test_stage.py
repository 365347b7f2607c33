"""Stages as plain functions: keys, artefacts, failures. No server."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cloudpickle
import pytest
from prefect import Task

from extrags.cores import processor_name
from extrags.errors import ConfigError, DamagedArtefactError, DivergedError
from extrags.raster import native_isa
from extrags.store import Ref, Slot, Store
from tasks.enhance import restore
from tasks.finetune import judge
from tasks.progress import StageProgress, observed
from tasks.stage import ArtefactRecords, StageKey, at, stage, stage_key, stage_versions
from tests.tasks.toy import ToyConfig, double, source, total


def test_fn_fills_an_artefact_and_returns_its_ref(tmp_path: Path) -> None:
    store = str(tmp_path)
    first = source.fn(store=store, seed=3)
    second = double.fn(store=store, label="phantom/0@sparse", number=first, config=ToyConfig(scale=0.5))
    assert (Store(store).open(second) / "number").read_text() == "3.0"
    manifest = Store(store).manifest(second)
    assert (manifest.stage, manifest.version) == ("toy-double", 3)
    assert manifest.label == "phantom/0@sparse"
    assert manifest.inputs == {"number": first.digest}
    assert manifest.config == {"config": {"scale": 0.5, "fail": False}}
    assert manifest.counts["value"] == 3.0
    peak = manifest.counts["peak_mib"]
    assert isinstance(peak, float)
    assert peak > 10
    assert manifest.counts["processor"] == processor_name()
    assert manifest.counts["isa"] == native_isa()
    assert manifest.counts["device"] == "cpu"


def test_a_second_call_does_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = tmp_path / "runs"
    monkeypatch.setenv("EXTRAGS_TEST_RUNS", str(runs))
    store = str(tmp_path / "store")
    refs = [source.fn(store=store, seed=1) for _ in range(3)]
    assert refs[0] == refs[1] == refs[2]
    assert runs.read_text() == "source\n"


def test_a_damaged_artefact_is_made_anew(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store = str(tmp_path)
    ref = source.fn(store=store, seed=12)
    (tmp_path / "artefacts" / stage_key(source, {"seed": 12}) / "number").write_text("1")
    assert source.fn(store=store, seed=12) == ref
    assert (Store(store).open(ref) / "number").read_text() == "12"
    assert "stage toy-source: artefact toy-source-v1-" in caplog.text
    assert "number: has 1 bytes, expected 2" in caplog.text


def test_a_stage_refuses_a_damaged_input(tmp_path: Path) -> None:
    store = str(tmp_path)
    ref = source.fn(store=store, seed=12)
    (tmp_path / "artefacts" / stage_key(source, {"seed": 12}) / "number").write_text("13")
    with pytest.raises(DamagedArtefactError, match="of stage toy-source is damaged: number: its content"):
        double.fn(store=store, number=ref)
    assert [manifest.stage for manifest in Store(store).ls()] == ["toy-source"]


def test_lists_of_refs_stand_in_the_manifest(tmp_path: Path) -> None:
    refs = [source.fn(store=str(tmp_path), seed=seed) for seed in (1, 2)]
    ref = total.fn(store=str(tmp_path), numbers=refs)
    manifest = Store(tmp_path).manifest(ref)
    assert manifest.inputs == {"numbers[0]": refs[0].digest, "numbers[1]": refs[1].digest}
    assert (Store(tmp_path).open(ref) / "number").read_text() == "3.0"


def test_a_failure_leaves_no_artefact_and_no_scratch(tmp_path: Path) -> None:
    store = str(tmp_path)
    first = source.fn(store=store)
    with pytest.raises(DivergedError, match="iteration 7"):
        double.fn(store=store, number=first, config=ToyConfig(fail=True))
    assert [manifest.stage for manifest in Store(store).ls()] == ["toy-source"]
    assert list((tmp_path / "scratch").iterdir()) == []
    (kept,) = (tmp_path / "failed").iterdir()
    assert (kept / "value").read_text() == "0.0"


def test_progress_reaches_the_observer_with_its_sequence(tmp_path: Path) -> None:
    seen: list[StageProgress] = []
    with observed(seen.append):
        double.fn(store=str(tmp_path), label="phantom/0", number=source.fn(store=str(tmp_path), seed=2))
    assert [(item.label, item.stage, item.done, item.total) for item in seen] == [
        ("phantom/0", "toy-double", 1, 2)
    ]
    assert "value 2" in seen[0].detail


class TestKey:
    def key(self, **inputs: object) -> str:
        return stage_key(double, {"number": Ref(uri="u", digest="d"), **inputs})

    def test_is_readable(self) -> None:
        assert self.key().startswith("toy-double-v3-")

    def test_paths_and_labels_do_not_count(self) -> None:
        elsewhere = stage_key(double, {"number": Ref(uri="elsewhere", digest="d"), "label": "me"})
        assert elsewhere == self.key()

    def test_defaults_count_as_if_given(self) -> None:
        assert self.key(config=ToyConfig()) == self.key()

    def test_settings_and_inputs_count(self) -> None:
        assert self.key(config=ToyConfig(scale=2.0)) != self.key()
        assert stage_key(double, {"number": Ref(uri="u", digest="e")}) != self.key()

    def test_another_device_counts_and_the_processor_is_as_none(self) -> None:
        key = StageKey(name="a", version=1)
        none, cpu, cuda = (
            key.compute_key(None, {"x": 1} | device, None)
            for device in ({}, {"device": "cpu"}, {"device": "cuda"})
        )
        assert none == cpu != cuda

    @pytest.mark.parametrize("task", [restore, judge])
    def test_weights_of_confidences_count_by_their_content(self, task: Task[..., Ref]) -> None:
        key = task.cache_policy
        assert isinstance(key, StageKey)
        one, other, elsewhere = (
            key.compute_key(None, {"weights_digest": digest, "weights": place}, None)
            for digest, place in (("one", "here"), ("other", "here"), ("one", "there"))
        )
        assert one == elsewhere != other

    def test_two_stages_never_share_a_key(self) -> None:
        assert StageKey(name="a", version=1).compute_key(None, {"x": 1}, None) != StageKey(
            name="b", version=1
        ).compute_key(None, {"x": 1}, None)

    def test_version_counts(self) -> None:
        one, two = (StageKey(name="a", version=v).compute_key(None, {"x": 1}, None) for v in (1, 2))
        assert one != two

    def test_what_prefect_computes_is_the_same(self) -> None:
        inputs = {"store": "s", "label": "l", "number": Ref(uri="u", digest="d"), "config": ToyConfig()}
        assert isinstance(double.cache_policy, StageKey)
        assert double.cache_policy.compute_key(None, inputs, {}) == self.key()

    @pytest.mark.parametrize("value", [Path("x"), {1}, object()])
    def test_what_has_no_content_is_refused(self, value: object) -> None:
        with pytest.raises(ConfigError, match="config"):
            self.key(config=value)


def test_ignored_arguments_are_in_neither_key_nor_manifest(tmp_path: Path) -> None:
    @stage("toy-ignoring", version=1, ignore=("path",))
    def ignoring(slot: Slot, digest: str, path: str) -> None:
        (slot.path / "said").write_text(Path(path).name)

    first = ignoring.fn(store=str(tmp_path), digest="d", path="a/x")
    assert ignoring.fn(store=str(tmp_path), digest="d", path="b/x") == first
    assert ignoring.fn(store=str(tmp_path), digest="e", path="a/x") != first
    assert Store(tmp_path).manifest(first).config == {"digest": "d"}


def test_an_artefact_that_the_key_ignores_stands_in_the_lineage(tmp_path: Path) -> None:
    @stage("toy-aided", version=1, ignore=("aid",))
    def aided(slot: Slot, number: Ref, aid: Ref | None = None) -> None:
        (slot.path / "aided").write_text(str(aid is not None))

    number, aid = (source.fn(store=str(tmp_path), seed=seed) for seed in (1, 2))
    ref = aided.fn(store=str(tmp_path), number=number, aid=aid)
    assert aided.fn(store=str(tmp_path), number=number) == ref
    manifest = Store(tmp_path).manifest(ref)
    assert manifest.inputs == {"number": number.digest, "aid": aid.digest}
    assert manifest.config == {}


def test_one_name_has_one_version() -> None:
    assert stage_versions()["toy-double"] == 3
    with pytest.raises(ConfigError, match="two versions of stage toy-double"):
        stage("toy-double", version=4)(lambda slot: None)


def test_all_stages_are_those_of_every_module() -> None:
    """In a process of its own, in which nothing has imported any."""
    command = "from tasks.stage import all_stage_versions; print(*all_stage_versions())"
    told = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True)
    assert {"ingest", "benchmark-report", "uc-nerf", "import-scene", "continued-coarse"} <= set(
        told.stdout.split()
    )


def test_unknown_arguments_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="sed"):
        source.fn(store=str(tmp_path), sed=1)


def test_records_are_the_artefacts(tmp_path: Path) -> None:
    records = ArtefactRecords(root=str(tmp_path))
    key = stage_key(source, {"seed": 5})
    with pytest.raises(FileNotFoundError):
        records.read_path(key)
    records.write_path(key, b"whatever")
    with pytest.raises(FileNotFoundError):
        records.read_path(key)
    ref = source.fn(store=str(tmp_path), seed=5)
    assert ref.digest.encode() in records.read_path(key)
    (tmp_path / "artefacts" / key / "number").unlink()
    with pytest.raises(FileNotFoundError):
        records.read_path(key)
    assert source.fn(store=str(tmp_path), seed=5) == ref
    Store(tmp_path).rm(key)
    with pytest.raises(FileNotFoundError):
        records.read_path(key)


def test_a_bound_task_can_be_sent_to_another_process(tmp_path: Path) -> None:
    bound = cloudpickle.loads(cloudpickle.dumps(at(double, str(tmp_path))))
    assert bound.name == "toy-double"
    assert bound.result_storage.root == str(tmp_path)
    assert bound.cache_policy.lock_manager.directory == tmp_path / "locks"


def test_only_stages_can_be_bound() -> None:
    from prefect import task

    with pytest.raises(ConfigError, match="not a stage"):
        at(task(lambda: None, name="plain"), "s")  # type: ignore[arg-type]
