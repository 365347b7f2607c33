"""The ingest stage: what it reads is what its key says."""

from __future__ import annotations

import hashlib
import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import data_catalog
from data_catalog.catalog import resolve, source_fingerprint
from data_catalog.dataset import Source
from extrags.config import IngestConfig
from extrags.errors import SourceError
from extrags.sequence import EndoscopicSequence
from extrags.store import Ref, Store
from tasks.ingest import ingest

CONFIG = IngestConfig()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "scene"
    (place / "rgb").mkdir(parents=True)
    rng = np.random.default_rng(0)
    frames = []
    for index in range(4):
        Image.fromarray(rng.integers(30, 220, (24, 32, 3), dtype=np.uint8)).save(place / f"rgb/{index}.png")
        pose = np.eye(4)
        pose[0, 3] = index
        frames.append({"file": f"rgb/{index}.png", "world_from_camera": pose.tolist()})
    content = {"K": [[30, 0, 16], [0, 30, 12], [0, 0, 1]], "frames": frames}
    (place / "poses.json").write_text(json.dumps(content))
    return place


def ingested(store: Path, source: Source, fingerprint: dict[str, object]) -> Ref:
    return ingest.fn(store=str(store), source=source, fingerprint=fingerprint, config=CONFIG)


def test_files_that_change_while_they_are_read(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, store = resolve(folder), tmp_path / "store"
    fingerprint = source_fingerprint(source, CONFIG)
    poses = folder / "poses.json"
    before = poses.read_text()
    poses.write_text(before.replace("[[30, 0, 16]", "[[31, 0, 16]"))
    with pytest.raises(SourceError, match=r"scene: the files changed while they were read; run again"):
        ingested(store, source, fingerprint)
    assert Store(str(store)).ls() == []
    poses.write_text(before)

    read = data_catalog.read

    def read_then_changed(*given: Any, **named: Any) -> EndoscopicSequence:
        found = read(*given, **named)
        (folder / "rgb" / "2.png").write_bytes((folder / "rgb" / "1.png").read_bytes())
        return found

    monkeypatch.setattr(data_catalog, "read", read_then_changed)
    with pytest.raises(SourceError, match="the files changed"):
        ingested(store, source, fingerprint)
    assert Store(str(store)).ls() == []


def test_only_files_that_changed_are_read_again(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the time of change that programs cannot set."""
    source, read = resolve(folder), []
    blake2b = hashlib.blake2b

    def counted(*given: object, **named: object) -> object:
        read.append(1)
        return blake2b(*given, **named)

    monkeypatch.setattr(hashlib, "blake2b", counted)
    before = source_fingerprint(source, CONFIG)
    read.clear()
    assert source_fingerprint(source, CONFIG) == before
    # They are as new as changes that leave no trace.
    assert len(read) == len(before["files"])
    later_ns = time.time_ns() + 3_600_000_000_000
    monkeypatch.setattr(time, "time_ns", lambda: later_ns)
    source_fingerprint(source, CONFIG)
    read.clear()
    assert source_fingerprint(source, CONFIG) == before
    assert not read

    poses, times = folder / "poses.json", (folder / "poses.json").stat()
    poses.write_text(poses.read_text().replace("[[30, 0, 16]", "[[31, 0, 16]"))
    os.utime(poses, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert poses.stat().st_size == times.st_size
    with pytest.raises(SourceError, match="the files changed"):
        ingested(tmp_path / "store", source, before)


@pytest.mark.parametrize("name", ["folder", "phantom"])
def test_files_that_stay_as_they_are(name: str, folder: Path, tmp_path: Path) -> None:
    config = CONFIG if name == "folder" else IngestConfig(width=32, height=26, max_frames=4)
    source = resolve(folder if name == "folder" else "phantom/0@sparse")
    made = ingest.fn(
        store=str(tmp_path / "store"),
        source=source,
        # As workers get it.
        fingerprint=json.loads(json.dumps(source_fingerprint(source, config))),
        config=config,
    )
    assert Store(str(tmp_path / "store")).manifest(made).counts["frames"] != 0
