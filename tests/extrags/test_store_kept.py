"""Who asks again for the frames that this process has read last gets them without decoding them anew."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from extrags.errors import StoreError
from extrags.store import Ref, Storable, Store, forget_loaded, kept


@dataclass(frozen=True)
class Plain(Storable):
    """A word, read anew each time."""

    stored_as: ClassVar[str] = "word"

    word: str

    def save(self, path: Path) -> None:
        path.write_text(self.word)

    @classmethod
    def load(cls, path: Path) -> Any:
        return cls(path.read_text())


@dataclass(frozen=True)
class Kept(Plain):
    kept_when_loaded: ClassVar[bool] = True


@pytest.fixture(autouse=True)
def nothing_kept() -> Iterator[None]:
    forget_loaded()
    yield
    forget_loaded()


def stored(store: Store, key: str, word: str) -> Ref:
    with store.slot(stage="toy", version=1, key=f"toy-v1-{key}") as slot:
        slot.save(Plain(word))
    return slot.ref


def test_the_last_two_are_kept(tmp_path: Path) -> None:
    store = Store(tmp_path)
    one, other, third = (stored(store, word, word) for word in ("one", "other", "third"))
    found = store.load(Kept, one)
    assert found == Kept("one")
    # Equal content, wherever it lies.
    assert Store(tmp_path).load(Kept, stored(store, "again", "one")) is found
    second = store.load(Kept, other)
    assert store.load(Kept, one) is found
    # The one that was asked for first goes.
    assert store.load(Kept, third) == Kept("third")
    assert store.load(Kept, one) is found
    assert store.load(Kept, other) is not second


def test_other_classes_are_read_anew_and_put_nothing_out(tmp_path: Path) -> None:
    store = Store(tmp_path)
    one = stored(store, "a", "one")
    kept = store.load(Kept, one)
    plain = store.load(Plain, one)
    assert type(plain) is Plain
    assert store.load(Plain, one) is not plain
    assert store.load(Kept, one) is kept


def test_what_is_gone_is_an_error_although_it_was_read(tmp_path: Path) -> None:
    store = Store(tmp_path)
    one = stored(store, "a", "one")
    store.load(Kept, one)
    store.rm("toy-v1-a")
    with pytest.raises(StoreError):
        store.load(Kept, one)


def test_forgotten(tmp_path: Path) -> None:
    store = Store(tmp_path)
    one = stored(store, "a", "one")
    found = store.load(Kept, one)
    forget_loaded()
    assert store.load(Kept, one) is not found


@dataclass(frozen=True)
class Frames(Storable):
    """As many bytes as its word has letters."""

    stored_as: ClassVar[str] = "word"
    kept_when_loaded: ClassVar[bool] = True

    rgb: np.ndarray

    def save(self, path: Path) -> None:
        raise AssertionError

    @classmethod
    def load(cls, path: Path) -> Any:
        return cls(np.frombuffer(path.read_bytes(), np.uint8))


def test_of_large_ones_the_last_alone_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two long recordings would take the room of both in the folder of temporary files."""
    monkeypatch.setattr(kept, "KEPT_BYTES", 10)
    store = Store(tmp_path)
    small, other, large = (stored(store, word, word) for word in ("12345", "abcde", "1234567"))
    first = store.load(Frames, small)
    second = store.load(Frames, other)
    assert store.load(Frames, small) is first
    third = store.load(Frames, large)
    assert store.load(Frames, large) is third
    assert store.load(Frames, other) is not second
    assert store.load(Frames, large) is not third
