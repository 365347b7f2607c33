"""Sequences of one relative name in several folders: one store, and each by itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from extrags.errors import StoreError
from extrags.store import Store
from extrags.store.retention import usage
from flows.cli import main
from flows.runners import DirectRunner
from flows.sequence import reconstruct_sequence
from flows.wiring import run_sequence
from tests.flows.tiny import TINY, tiny_config

pytestmark = pytest.mark.usefixtures("prefect_server")


def folder_of_frames(place: Path, seed: int) -> None:
    place.mkdir(parents=True)
    chance = np.random.default_rng(seed)
    for index in range(6):
        frame = chance.integers(0, 255, (40, 48, 3), dtype=np.uint8)
        Image.fromarray(frame).save(place / f"{index:03d}.png")


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Store:
    """Made of `scan` in two folders, by a flow and without; the second is where the process is."""
    root = str(tmp_path / "store")
    for index, patient in enumerate(("patient_a", "patient_b")):
        folder_of_frames(tmp_path / patient / "scan", index)
        monkeypatch.chdir(tmp_path / patient)
        if index:
            made = run_sequence("scan", tiny_config(), root, DirectRunner(root), until="ingest")
        else:
            made = reconstruct_sequence("scan", "quick", TINY, store=root, until="ingest")
        assert made.status == "ok"
    return Store(root)


def test_of_one_name_only_those_here_are_removed(
    store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = (str(tmp_path / patient / "scan") for patient in ("patient_a", "patient_b"))
    assert {(item.label, item.place) for item in store.ls()} == {("scan", one), ("scan", two)}
    assert {row.sequence for row in usage(store)} == {one, two}

    # From elsewhere it is not known which is meant.
    monkeypatch.chdir(tmp_path)
    before = store.keys()
    assert main(["cache", "rm", "scan", "--store", store.root]) == 1
    told = " ".join(capsys.readouterr().err.split())
    assert "the name of" in told
    assert one in told
    assert two in told
    assert store.keys() == before

    monkeypatch.chdir(tmp_path / "patient_b")
    assert main(["cache", "rm", "scan", "--store", store.root]) == 0
    assert {item.place for item in store.ls()} == {one}
    assert [row.sequence for row in usage(store)] == ["scan"]

    # What is left is not of the folder that has this name here.
    assert main(["cache", "rm", "scan", "--store", store.root]) == 1
    assert main(["cache", "rm", one, "--store", store.root]) == 0
    assert store.keys() == []


def put(store: Store, key: str, place: str) -> None:
    with store.slot(stage="toy", version=1, key=key, label="scan", place=place):
        pass


@pytest.mark.usefixtures("untouched_environment")
def test_an_ambiguous_name_leaves_what_is_named_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    store = Store(tmp_path / "store")
    for place in ("a", "b"):
        put(store, f"toy-v1-{place}", f"/{place}/scan")
    assert main(["cache", "rm", "toy-v1-a", "scan", "--store", store.root]) == 1
    assert "is in this store the name of /a/scan and /b/scan" in capsys.readouterr().err
    assert store.keys() == ["toy-v1-a", "toy-v1-b"]
    # Named twice, it goes once.
    assert main(["cache", "rm", "toy-v1-a", "/a/scan", "--store", store.root]) == 0
    assert "1 artefact removed" in capsys.readouterr().out


class TestEarlierVersions:
    """Their manifests do not say where a sequence was."""

    def test_alone_they_go_by_name(self, tmp_path: Path) -> None:
        store = Store(tmp_path)
        put(store, "toy-v1-old", "")
        assert store.rm("scan", here="/b/scan") == ["toy-v1-old"]

    def test_with_those_of_one_place_they_go_by_name(self, tmp_path: Path) -> None:
        store = Store(tmp_path)
        put(store, "toy-v1-old", "")
        put(store, "toy-v1-b", "/b/scan")
        assert [(row.sequence, row.artefacts) for row in usage(store)] == [("scan", 2)]
        assert sorted(store.rm("scan", here="/b/scan")) == ["toy-v1-b", "toy-v1-old"]

    def test_with_those_of_several_places_they_stay(
        self, tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        store = Store(tmp_path)
        put(store, "toy-v1-old", "")
        for place in ("a", "b"):
            put(store, f"toy-v1-{place}", f"/{place}/scan")
        assert {row.sequence for row in usage(store)} == {"scan", "/a/scan", "/b/scan"}
        with pytest.raises(StoreError, match=r"/a/scan and /b/scan"):
            store.rm("scan")
        assert store.rm("scan", here="/b/scan") == ["toy-v1-b"]
        assert "are left: 2" in caplog.text
        assert store.rm("/a/scan") == ["toy-v1-a"]
        assert store.rm("scan") == ["toy-v1-old"]

    def test_a_pattern_is_no_name(self, tmp_path: Path) -> None:
        store = Store(tmp_path)
        for place in ("a", "b"):
            put(store, f"toy-v1-{place}", f"/{place}/scan")
        assert sorted(store.rm("sca?")) == ["toy-v1-a", "toy-v1-b"]
