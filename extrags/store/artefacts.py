"""The artefact store: artefacts by key, written atomically."""

from __future__ import annotations

import datetime
import json
import logging
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, TypeVar

from extrags.errors import StoreError
from extrags.store.canonical import Ref
from extrags.store.directory import DirectoryBackend, private_directory
from extrags.store.manifest import Manifest, content_digest, software_versions
from extrags.store.storable import Storable
from extrags.store.url import UrlBackend

__all__ = ["Slot", "Store"]

log = logging.getLogger(__name__)


S = TypeVar("S", bound=Storable)


class Slot:
    """A scratch directory that becomes an artefact when its `with` block ends without an exception.

    Args:
        path: where the stage writes.
        counts: numbers for the manifest, filled by the stage.
    """

    def __init__(self, path: Path, store: Store) -> None:
        self.path = path
        self.store = store
        self.counts: dict[str, float | int | str | None] = {}
        self._debug = path.with_name("debug")
        self._manifest: Manifest | None = None

    def open(self, ref: Ref) -> Path:
        """Files of an input artefact."""
        return self.store.open(ref)

    def load(self, kind: type[S], ref: Ref) -> S:
        """An object from an input artefact, as `Store.load`."""
        return self.store.load(kind, ref)

    def load_json(self, file: str, ref: Ref) -> Any:
        """Plain JSON from an input artefact, as `Store.load_json`."""
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
        return Ref(uri=self.store.backend.uri(self._manifest.key), digest=self._manifest.digest)


class Store:
    """Content-addressed artefacts below a directory or an fsspec URL.

    An artefact exists if and only if its manifest can be read; there is no other record that could become
    stale. Safe for concurrent processes and against SIGKILL at any point. (After a power failure, `verify`
    checks whether all bytes reached the disk.)

    Args:
        root: a directory, or a URL such as `s3://bucket/prefix` or `memory://name`.
        cache: local directory for reading remote artefacts; default: the user's cache directory.

    Raises:
        StoreError: for a URL that fsspec does not know.
    """

    def __init__(self, root: str | Path, *, cache: Path | None = None) -> None:
        text = str(root)
        self.backend: DirectoryBackend | UrlBackend
        if "://" in text and not text.startswith("file://"):
            self.root = text.rstrip("/")
            self.backend = UrlBackend(self.root, cache)
        else:
            directory = Path(text.removeprefix("file://")).expanduser().absolute()
            self.root = str(directory)
            self.backend = DirectoryBackend(directory)

    @property
    def state(self) -> Path:
        """Local directory for locks, failures and scratch of this store."""
        return self.backend.state

    @property
    def locks(self) -> Path:
        """Directory of the lock files, one per key."""
        return self.state / "locks"

    def check_writable(self) -> None:
        """Check that the store can be written.

        Raises:
            StoreError: when it cannot be written, with the reason.
        """
        self.backend.check_writable()

    def find(self, key: str) -> Ref | None:
        """The artefact of a key, or None."""
        manifest = self.backend.read_manifest(key)
        return None if manifest is None else Ref(uri=self.backend.uri(key), digest=manifest.digest)

    def manifest(self, ref: Ref) -> Manifest:
        """Manifest of an artefact.

        Raises:
            StoreError: when it is gone, or was replaced by other content.
        """
        key = _key_of(ref)
        manifest = self.backend.read_manifest(key)
        if manifest is None:
            raise StoreError(f"artefact {key} is not in the store {self.root}; it was removed meanwhile")
        if manifest.digest != ref.digest:
            raise StoreError(
                f"artefact {key} has digest {manifest.digest}, expected {ref.digest}: "
                "it was replaced meanwhile"
            )
        return manifest

    def open(self, ref: Ref) -> Path:
        """Local directory with the files of an artefact; read only.

        Raises:
            StoreError: when it is gone, replaced, or (remote) damaged.
        """
        return self.backend.path(ref, self.manifest(ref))

    def load(self, kind: type[S], ref: Ref) -> S:
        """An object from an artefact.

        Args:
            kind: its class, e.g. `extrags.scene.Scene`.
            ref: an artefact that holds one.

        Raises:
            StoreError: as `open`.
        """
        found: S = kind.load(self.open(ref) / kind.stored_as)
        return found

    def load_json(self, file: str, ref: Ref) -> Any:
        """What `Slot.save_json` wrote.

        Raises:
            StoreError: as `open`.
        """
        return json.loads((self.open(ref) / file).read_bytes())

    def verify(self, ref: Ref) -> bool:
        """Whether the files still have the digest they were stored with; reads all of them."""
        return content_digest(self.open(ref))[0] == ref.digest

    @contextmanager
    def slot(
        self,
        *,
        stage: str,
        version: int,
        key: str,
        label: str = "",
        config: Mapping[str, Any] | None = None,
        inputs: Mapping[str, Ref] | None = None,
    ) -> Iterator[Slot]:
        """Write an artefact atomically: it is committed when the block ends, and discarded when it raises.

        Args:
            stage: name of the stage.
            version: version of the stage, raised by hand.
            key: the cache key; also the artefact's name.
            label: display name, e.g. of the sequence.
            config: settings, as JSON types.
            inputs: the input artefacts by name.

        Yields:
            The slot; after the block `slot.ref` is the artefact.

        Raises:
            StoreError: when the store cannot be written.
        """
        started = datetime.datetime.now(datetime.UTC)
        clock = time.monotonic()
        with private_directory(self.backend.scratch, key) as scratch:
            slot = Slot(scratch / "files", self)
            slot.path.mkdir()
            try:
                yield slot
                digest, files, size = content_digest(slot.path)
                slot._manifest = self.backend.commit(
                    slot.path,
                    Manifest(
                        stage=stage,
                        version=version,
                        key=key,
                        digest=digest,
                        label=label,
                        config=dict(config or {}),
                        inputs={name: ref.digest for name, ref in (inputs or {}).items()},
                        input_keys={name: _key_of(ref) for name, ref in (inputs or {}).items()},
                        software=software_versions(),
                        started=started.isoformat(timespec="seconds"),
                        seconds=round(time.monotonic() - clock, 3),
                        counts=slot.counts,
                        files=files,
                        bytes=size,
                    ),
                )
            except Exception as error:
                self._keep_failure(slot, key, label, error)
                raise

    def _keep_failure(self, slot: Slot, key: str, label: str, error: Exception) -> None:
        if not slot._debug.is_dir():
            return
        kept = self.state / "failed" / key
        (slot._debug / "error.json").write_text(
            json.dumps(
                {"key": key, "label": label, "kind": type(error).__name__, "message": str(error)}, indent=1
            )
        )
        try:
            kept.parent.mkdir(parents=True, exist_ok=True)
            shutil.rmtree(kept, ignore_errors=True)
            slot._debug.rename(kept)
            log.info("what the failed stage left for debugging: %s", kept)
        except OSError as problem:
            # A failure to keep debugging files must not hide the error of the stage.
            log.warning("could not keep the debugging files of %s: %s", key, problem)

    def ls(self, pattern: str = "*") -> list[Manifest]:
        """Manifests of the artefacts whose key, stage or label matches a shell pattern, by stage and age."""
        manifests = [self.backend.read_manifest(key) for key in self.backend.names()]
        chosen = [manifest for manifest in manifests if manifest is not None and _matches(manifest, pattern)]
        return sorted(chosen, key=lambda manifest: (manifest.started, manifest.key))

    def rm(self, pattern: str) -> list[str]:
        """Remove artefacts by a shell pattern over key, stage or label; returns their keys."""
        return [manifest.key for manifest in self.ls(pattern) if self.backend.discard(manifest.key)]

    def sweep(self, *, older_than_hours: float = 24.0) -> list[str]:
        """Remove leftovers of killed processes; scratch directories of running processes are kept.

        Args:
            older_than_hours: on object stores, age after which unfinished uploads are removed.

        Returns:
            Names of the removed files and directories.
        """
        return self.backend.sweep(older_than_hours)

    def gc(self, current: Mapping[str, int] | None = None, *, older_than_hours: float = 24.0) -> list[str]:
        """Garbage collection: `sweep`, debugging files of failures, and artefacts of outdated versions.

        Args:
            current: version of each stage; artefacts of other versions are removed. None keeps all.
            older_than_hours: as in `sweep`.

        Returns:
            Names of what was removed.
        """
        removed = self.sweep(older_than_hours=older_than_hours)
        failures = self.state / "failed"
        if failures.is_dir():
            removed += [f"failed/{entry.name}" for entry in sorted(failures.iterdir())]
            shutil.rmtree(failures)
        for manifest in self.ls() if current is not None else []:
            wanted = current.get(manifest.stage) if current is not None else None
            if wanted is not None and wanted != manifest.version and self.backend.discard(manifest.key):
                removed.append(f"artefacts/{manifest.key}")
        return removed


def _matches(manifest: Manifest, pattern: str) -> bool:
    return any(fnmatchcase(text, pattern) for text in (manifest.key, manifest.stage, manifest.label))


def _key_of(ref: Ref) -> str:
    return ref.uri.rstrip("/").rsplit("/", 1)[-1]
