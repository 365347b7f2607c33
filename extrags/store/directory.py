"""Storage in a local directory: artefacts are written to a scratch directory and renamed."""

from __future__ import annotations

import fcntl
import json
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from extrags.errors import DamagedArtefactError, StoreError
from extrags.store.canonical import Ref
from extrags.store.integrity import Damage, Depth, find_damage, intact_manifest
from extrags.store.manifest import MANIFEST, Manifest, manifest_text, parsed_manifest, stage_of

__all__ = ["DAMAGED", "RECORD", "DirectoryBackend", "private_directory", "sweep_directories"]

DAMAGED = "damaged"
"""Where damaged artefacts are set aside, below the root of a store."""
RECORD = "damage.json"
"""Beside an artefact that was set aside: what is wrong with it."""


class DirectoryBackend:
    """Artefacts in `artefacts/<key>/` below a root directory; unfinished ones are in `scratch/`.

    A scratch directory is committed with one atomic `rename`. Its writer holds a `flock` on it, which the
    kernel releases when the process ends for any reason; `sweep` removes the unlocked scratch directories.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.artefacts = root / "artefacts"
        self.scratch = root / "scratch"
        self.state = root

    def check_writable(self) -> None:
        """Make the directories and try one write and one rename.

        Raises:
            StoreError: when that fails, with the reason.
        """
        try:
            self.artefacts.mkdir(parents=True, exist_ok=True)
            with private_directory(self.scratch, "probe") as probe:
                (probe / "written").write_bytes(b"x")
                (probe / "written").rename(probe / "renamed")
        except StoreError:
            raise
        except OSError as error:
            reason = error.strerror or error
            raise StoreError(f"the store {self.root} cannot be written: {reason}") from error

    def read_manifest(self, key: str) -> Manifest | None:
        """Manifest of a key; None where there is no such artefact.

        Raises:
            DamagedArtefactError: when the file is no manifest, or differs from its checksum.
            StoreError: when it cannot be read.
        """
        path = self.artefacts / key / MANIFEST
        try:
            return parsed_manifest(path.read_bytes(), key)
        except (FileNotFoundError, NotADirectoryError):
            return None
        except ValueError as error:
            raise DamagedArtefactError(
                f"is not the manifest that was written: {error}",
                file=MANIFEST,
                stage=stage_of(key),
                key=key,
                store=str(self.root),
            ) from error
        except OSError as error:
            raise StoreError(f"{path} cannot be read: {error.strerror or error}") from error

    def uri(self, key: str) -> str:
        """Path of the artefact of a key."""
        return str(self.artefacts / key)

    def names(self) -> list[str]:
        """All keys, sorted."""
        try:
            return sorted(entry.name for entry in os.scandir(self.artefacts) if entry.is_dir())
        except FileNotFoundError:
            return []

    def path(self, ref: Ref, manifest: Manifest) -> Path:
        """The artefact's files on the local disk."""
        return self.artefacts / manifest.key

    def drop_copy(self, manifest: Manifest) -> bool:
        """There are no copies; what is read is the artefact itself."""
        return False

    def damaged_sizes(self, manifest: Manifest) -> Damage | None:
        """Whether files are missing, truncated or too many; reads no contents."""
        return self._damage(manifest, "sizes")

    def examine(self, manifest: Manifest) -> Damage | None:
        """Whether the files differ from those that were stored; reads all of them."""
        return self._damage(manifest, "all")

    def _damage(self, manifest: Manifest, depth: Depth) -> Damage | None:
        directory = self.artefacts / manifest.key
        try:
            return find_damage(directory, manifest, depth)
        except FileNotFoundError:
            if directory.exists():
                raise
            return None  # Another process has removed or replaced it meanwhile.

    def set_aside(self, key: str, record: dict[str, Any]) -> str | None:
        """Move an artefact to `damaged/`, with a record of what is wrong; None when it is gone already."""
        place = self.root / DAMAGED / f"{key}.{secrets.token_hex(4)}"
        place.mkdir(parents=True)
        (place / RECORD).write_text(json.dumps(record, indent=1), encoding="utf-8")
        try:
            (self.artefacts / key).rename(place / "artefact")
        except FileNotFoundError:
            shutil.rmtree(place)
            return None
        return str(place)

    def remove_damaged(self) -> list[str]:
        """Remove what was set aside; returns the names."""
        place = self.root / DAMAGED
        names = [f"{DAMAGED}/{name}" for name in sorted(os.listdir(place))] if place.is_dir() else []
        shutil.rmtree(place, ignore_errors=True)
        return names

    def commit(self, scratch: Path, manifest: Manifest) -> Manifest:
        """Move a finished scratch directory into place.

        If another process has committed the same content before, its artefact is kept.
        """
        (scratch / MANIFEST).write_bytes(manifest_text(manifest))
        target = self.artefacts / manifest.key
        target.parent.mkdir(parents=True, exist_ok=True)
        for _ in range(8):
            try:
                scratch.rename(target)
                return manifest
            except OSError:
                present = intact_manifest(self, manifest.key)
                if present is not None and present.digest == manifest.digest:
                    return present
                if not target.exists():
                    raise
                # Other content, or a damaged artefact: `refresh` replaces it. Between the two renames
                # the key is merely absent, which is a cache miss and never a half-written artefact.
                self.discard(manifest.key)
        raise StoreError(f"artefact {manifest.key} is being replaced by others again and again")

    def discard(self, key: str) -> bool:
        """Remove an artefact: it is first renamed, so that it disappears atomically, then deleted."""
        aside = self.scratch / f"{key}.{secrets.token_hex(4)}.removed"
        self.scratch.mkdir(parents=True, exist_ok=True)
        try:
            (self.artefacts / key).rename(aside)
        except FileNotFoundError:
            return False
        shutil.rmtree(aside, ignore_errors=True)
        return True

    def sweep(self, older_than_hours: float) -> list[str]:
        """Remove scratch directories of killed processes, and artefact directories without a manifest."""
        removed = sweep_directories(self.scratch)
        for key in self.names():
            if not (self.artefacts / key / MANIFEST).exists() and self.discard(key):
                removed.append(f"artefacts/{key}")
        return removed


@contextmanager
def private_directory(parent: Path, name: str) -> Iterator[Path]:
    """Create a directory locked by this process; it is removed at the end of the block.

    Raises:
        StoreError: when it cannot be created.
    """
    try:
        path, lock = _claim(parent, name)
    except OSError as error:
        raise StoreError(f"the store {parent.parent} cannot be written: {error.strerror or error}") from error
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        os.close(lock)


def _claim(parent: Path, name: str) -> tuple[Path, int]:
    parent.mkdir(parents=True, exist_ok=True)
    while True:
        path = parent / f"{name}.{secrets.token_hex(4)}"
        path.mkdir()
        try:
            lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        except FileNotFoundError:
            continue  # Another process's sweep removed it before it was locked.
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(lock), os.stat(path)):
                return path, lock
        except (BlockingIOError, FileNotFoundError):
            pass  # Removed by a sweep after it was opened.
        os.close(lock)


def sweep_directories(parent: Path) -> list[str]:
    """Remove the directories below `parent` that no process has locked; returns their names."""
    removed = []
    try:
        entries = sorted(entry.name for entry in os.scandir(parent) if entry.is_dir(follow_symlinks=False))
    except FileNotFoundError:
        return []
    for name in entries:
        try:
            lock = os.open(parent / name, os.O_RDONLY | os.O_DIRECTORY)
        except FileNotFoundError:
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            pass
        else:
            shutil.rmtree(parent / name, ignore_errors=True)
            removed.append(f"{parent.name}/{name}")
        finally:
            os.close(lock)
    return removed
