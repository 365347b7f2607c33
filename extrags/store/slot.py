"""What a stage writes into: a scratch directory that becomes an artefact."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Protocol, TypeVar

from extrags.errors import StoreError
from extrags.store.canonical import Ref
from extrags.store.manifest import Manifest
from extrags.store.storable import Storable

__all__ = ["Artefacts", "Slot"]

S = TypeVar("S", bound=Storable)


class Artefacts(Protocol):
    """Where a stage reads its inputs: `extrags.store.Store`."""

    def manifest(self, ref: Ref) -> Manifest:
        """Manifest of an artefact."""

    def open(self, ref: Ref) -> Path:
        """Files of an artefact."""

    def load(self, kind: type[S], ref: Ref) -> S:
        """An object from an artefact."""

    def load_json(self, file: str, ref: Ref) -> Any:
        """Plain JSON from an artefact."""

    def ref_of(self, manifest: Manifest) -> Ref:
        """Reference to the artefact of a manifest."""


class Slot:
    """A scratch directory that becomes an artefact when its `with` block ends without an exception.

    Args:
        path: where the stage writes.
        counts: numbers for the manifest, filled by the stage.
        run_files: names of files that tell of this run, such as its times, filled by the stage. They are kept
            and compared as all others, but the artefact's digest does not cover them.
    """

    def __init__(self, path: Path, store: Artefacts) -> None:
        self.path = path
        self.store = store
        self.counts: dict[str, float | int | str | None] = {}
        self.run_files: set[str] = set()
        self._debug = path.with_name("debug")
        self._manifest: Manifest | None = None
        self._inputs: dict[str, Ref] = {}

    def open(self, ref: Ref) -> Path:
        """Files of an input artefact."""
        self._inputs[ref.digest] = ref
        return self.store.open(ref)

    def load(self, kind: type[S], ref: Ref) -> S:
        """An object from an input artefact, as `Store.load`."""
        self._inputs[ref.digest] = ref
        return self.store.load(kind, ref)

    def load_json(self, file: str, ref: Ref) -> Any:
        """Plain JSON from an input artefact, as `Store.load_json`."""
        self._inputs[ref.digest] = ref
        return self.store.load_json(file, ref)

    def save(self, value: Storable) -> None:
        """Write an object to its place in the artefact (`Storable.stored_as`)."""
        value.save(self.path / value.stored_as)

    def save_json(self, file: str, value: Any, *, indent: int | None = None) -> None:
        """Write a JSON file.

        Raises:
            ValueError: for NaN and infinity, which JSON cannot represent.
        """
        (self.path / file).write_text(json.dumps(value, indent=indent, allow_nan=False), encoding="utf-8")

    @property
    def debug(self) -> Path:
        """Directory for debugging files; kept only if the stage fails."""
        self._debug.mkdir(exist_ok=True)
        return self._debug

    @property
    def ref(self) -> Ref:
        """Reference to the finished artefact.

        Raises:
            StoreError: while the block still runs, or after it failed.
        """
        if self._manifest is None:
            raise StoreError("an unfinished artefact has no ref; read it after the block")
        return self.store.ref_of(self._manifest)
