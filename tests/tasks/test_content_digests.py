"""Digests of files in keys: of their content, whatever times programs have given them."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from extrags.config import EvaluateConfig, ImportedConfig
from extrags.errors import WeightsError
from extrags.file_digests import size_and_digest
from tasks.imported import scene_digest
from tasks.weights import lpips_weights

HOUR_NS = 3_600_000_000_000


@pytest.fixture
def files_are_old(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that their digests are remembered."""
    now_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: now_ns() + HOUR_NS)


def exchange(file: Path, content: bytes) -> None:
    """Give a file another content of the same size, and its time of change back, as `cp -p` does."""
    before = file.stat()
    file.write_bytes(content)
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    after = file.stat()
    assert (after.st_size, after.st_mtime_ns) == (before.st_size, before.st_mtime_ns)


@pytest.mark.usefixtures("files_are_old")
class TestExchanged:
    def test_weights(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        file = tmp_path / "alex.pth"
        file.write_bytes(b"first")
        monkeypatch.setattr("extrags.metrics.lpips_weights.find_weights", lambda *_: (file,))
        (before,) = lpips_weights(EvaluateConfig(lpips_nets=("alex",)))
        assert before.digest == hashlib.blake2b(b"first", digest_size=16).hexdigest()
        exchange(file, b"other")
        (after,) = lpips_weights(EvaluateConfig(lpips_nets=("alex",)))
        assert after.digest == hashlib.blake2b(b"other", digest_size=16).hexdigest()
        with pytest.raises(WeightsError, match="not those this run began with"):
            before.lpips()

    def test_an_imported_scene(self, tmp_path: Path) -> None:
        config = ImportedConfig(scene=str(tmp_path / "scene.ply"))
        (tmp_path / "scene.ply").write_bytes(b"first")
        digests = [scene_digest(config)]
        exchange(tmp_path / "scene.ply", b"other")
        digests.append(scene_digest(config))
        assert digests == [hashlib.blake2b(text, digest_size=16).hexdigest() for text in (b"first", b"other")]


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by one whenever content is digested."""
    found: list[int] = []
    blake2b: Callable[..., object] = hashlib.blake2b

    def counted(*given: object, **named: object) -> object:
        found.append(1)
        return blake2b(*given, **named)

    monkeypatch.setattr(hashlib, "blake2b", counted)
    return found


def test_several_files_count_one_after_the_other(tmp_path: Path) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    one.write_bytes(b"ab")
    two.write_bytes(b"cde")
    assert size_and_digest(one, two) == (5, hashlib.blake2b(b"abcde", digest_size=16).hexdigest())
    assert size_and_digest(two, one)[1] != size_and_digest(one, two)[1]


@pytest.mark.usefixtures("files_are_old")
def test_unchanged_files_are_read_once(tmp_path: Path, reads: list[int]) -> None:
    files = [tmp_path / "one", tmp_path / "two"]
    for file in files:
        file.write_bytes(b"x")
    assert size_and_digest(*files) == size_and_digest(*files)
    assert len(reads) == 1


def test_files_of_a_moment_ago_are_read_again(tmp_path: Path, reads: list[int]) -> None:
    (tmp_path / "one").write_bytes(b"x")
    assert size_and_digest(tmp_path / "one") == size_and_digest(tmp_path / "one")
    assert len(reads) == 2
