"""Storage in a local directory: artefacts are written to a scratch directory and renamed."""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from extrags.errors import DamagedArtefactError, StoreError, reason_of
from extrags.store.canonical import Ref
from extrags.store.integrity import Damage, Depth, find_damage, intact_manifest
from extrags.store.manifest import MANIFEST, Manifest, manifest_text, parsed_manifest, same_content, stage_of

__all__ = [
    "ABOUT",
    "DAMAGED",
    "RECORD",
    "RECORDS",
    "DirectoryBackend",
    "held_directories",
    "private_directory",
    "remove_entries",
    "sweep_directories",
]

log = logging.getLogger(__name__)

DAMAGED = "damaged"
"""Where damaged artefacts are set aside, below the root of a store."""
RECORD = "damage.json"
"""Beside an artefact that was set aside: what is wrong with it."""
RECORDS = "records"
"""Where records of runs are, below the root of a store (`extrags.store.records`)."""
ABOUT = "about.json"
"""In a scratch directory: what is being made there."""
LOCK = "lock"
"""In a scratch directory: an empty file that its writer holds locked, as it holds the directory. NFS tells
other machines of locks on files, never of those on directories; earlier versions know the latter alone."""
_REMOVED = ".removed"
"""Ending of a directory in `scratch/` that is only there to be deleted, by whoever comes first."""


class DirectoryBackend:
    """Artefacts in `artefacts/<key>/` below a root directory; unfinished ones are in `scratch/`.

    What a scratch directory holds is committed with one atomic `rename`. Its writer holds a `flock` on it and
    on a file in it, which the kernel releases when the process ends for any reason; `sweep` removes the
    unlocked scratch directories.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.artefacts = root / "artefacts"
        self.scratch = root / "scratch"
        self.state = root

    def exists(self) -> bool:
        """Whether the root is a directory."""
        return self.root.is_dir()

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
            raise StoreError(f"{path} cannot be read: {reason_of(error)}") from error

    def uri(self, key: str) -> str:
        """Path of the artefact of a key."""
        return str(self.artefacts / key)

    def names(self) -> list[str]:
        """All keys, sorted; an entry of which nothing can be told is left out, with a warning."""
        try:
            return sorted(entry.name for entry in os.scandir(self.artefacts) if self._is_directory(entry))
        except FileNotFoundError:
            return []

    def _is_directory(self, entry: os.DirEntry[str]) -> bool:
        try:
            return entry.is_dir()
        except OSError as error:  # Such as a link to itself.
            log.warning("%s is left out: %s", entry.path, reason_of(error))
            return False

    def path(self, ref: Ref, manifest: Manifest) -> Path:
        """The artefact's files on the local disk."""
        return self.artefacts / manifest.key

    def touch(self, key: str) -> None:
        """Note that an artefact is used now: the time of its directory."""
        with suppress(OSError):  # A store may be read by who cannot write it.
            os.utime(self.artefacts / key)

    def last_used(self, keys: Iterable[str]) -> dict[str, float]:
        """When artefacts were used last, in seconds since 1970; without those that are gone."""
        found = {}
        for key in keys:
            with suppress(FileNotFoundError):
                found[key] = (self.artefacts / key).stat().st_mtime
        return found

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
            # The artefact is gone, or this place is, removed by who cleans the store: then it stays where it
            # is, to be replaced.
            shutil.rmtree(place, ignore_errors=True)
            return None
        return str(place)

    def remove_damaged(self, *, dry_run: bool = False) -> tuple[list[str], list[StoreError]]:
        """Remove what was set aside; returns the names, and what could not be removed, with the reason."""
        # One by one: what is set aside meanwhile stays.
        return remove_entries(self.root / DAMAGED, dry_run=dry_run)

    def write_record(self, name: str, text: bytes) -> None:
        """Write `records/<name>`; one that is there is replaced at once, never half."""
        target = self.root / RECORDS / name
        target.parent.mkdir(parents=True, exist_ok=True)
        self._put(target, text)

    def read_records(self, prefix: str) -> dict[str, bytes]:
        """Records by name, of those whose name begins so."""
        place = self.root / RECORDS
        try:
            names = sorted(entry.name for entry in os.scandir(place) if entry.name.startswith(prefix))
        except FileNotFoundError:
            return {}
        found = {}
        for name in names:
            try:
                found[name] = (place / name).read_bytes()
            except FileNotFoundError:
                continue  # Removed meanwhile.
            except OSError as error:
                if error.errno != errno.EIO:
                    raise
                found[name] = b""  # The disk does not give it back: it is damaged, and the others are not.
        return found

    def remove_record(self, name: str) -> None:
        """Remove `records/<name>`, if it is there."""
        (self.root / RECORDS / name).unlink(missing_ok=True)

    def _put(self, target: Path, text: bytes) -> None:
        with private_directory(self.scratch, target.name) as private:
            (private / "written").write_bytes(text)
            (private / "written").replace(target)

    def commit(self, scratch: Path, manifest: Manifest, *, renew: bool = False) -> Manifest:
        """Move a finished scratch directory into place.

        If another process has committed the same content before, its artefact is kept; with `renew` under
        the new manifest, which says when and how fast it was made this time.
        """
        (scratch / MANIFEST).write_bytes(manifest_text(manifest))
        target = self.artefacts / manifest.key
        target.parent.mkdir(parents=True, exist_ok=True)
        replaced: list[Path] = []
        try:
            return self._in_place(scratch, target, manifest, renew, replaced)
        finally:
            # After the new one is in place: deleting a large one takes its time.
            for aside in replaced:
                shutil.rmtree(aside, ignore_errors=True)

    def _in_place(
        self, scratch: Path, target: Path, manifest: Manifest, renew: bool, replaced: list[Path]
    ) -> Manifest:
        """As `commit`; adds to `replaced` where the artefacts are that were in the way."""
        for _ in range(8):
            try:
                scratch.rename(target)
                return manifest
            except OSError:
                present = intact_manifest(self, manifest.key)
                if present is not None and same_content(present, manifest):
                    if not renew:
                        return present
                    try:
                        self._put(target / MANIFEST, manifest_text(manifest))
                    except FileNotFoundError:
                        continue  # Removed meanwhile: then this one takes its place.
                    return manifest
                if not target.exists():
                    raise
                # Other content, or a damaged artefact: `refresh` replaces it. Between the two renames
                # the key is merely absent, which is a cache miss and never a half-written artefact.
                aside = self._move_aside(manifest.key)
                if aside is not None:
                    replaced.append(aside)
        raise StoreError(f"artefact {manifest.key} is being replaced by others again and again")

    def discard(self, key: str) -> bool:
        """Remove an artefact: it is first renamed, so that it disappears atomically, then deleted.

        Raises:
            StoreError: when the store cannot be written.
        """
        aside = self._move_aside(key)
        if aside is None:
            return False
        shutil.rmtree(aside, ignore_errors=True)
        return True

    def _move_aside(self, key: str) -> Path | None:
        """Rename an artefact to a name in `scratch/`, which is returned; None where there is none."""
        aside = self.scratch / f"{key}.{secrets.token_hex(4)}{_REMOVED}"
        try:
            self.scratch.mkdir(parents=True, exist_ok=True)
            (self.artefacts / key).rename(aside)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise StoreError(f"{key} cannot be removed from {self.root}: {reason_of(error)}") from error
        return aside

    def sweep(self, older_than_hours: float, *, dry_run: bool = False) -> list[str]:
        """Remove scratch directories of killed processes, and artefact directories without a manifest.

        Those that this user may not look into or remove, as those of another user, stay.
        """
        removed = sweep_directories(self.scratch, dry_run=dry_run)
        for key in self.names():
            try:
                if self._lacks_manifest(key) and (dry_run or self.discard(key)):
                    removed.append(f"artefacts/{key}")
            except StoreError as error:
                log.debug("left in place: %s", error)
        return removed

    def _lacks_manifest(self, key: str) -> bool:
        path = self.artefacts / key / MANIFEST
        try:
            path.stat()
        except (FileNotFoundError, NotADirectoryError):
            return True
        except OSError as error:
            log.debug("%s cannot be looked at, and stays: %s", path, error.strerror)
        return False


@contextmanager
def private_directory(parent: Path, name: str, stage: str = "") -> Iterator[Path]:
    """Create a directory locked by this process; it is removed at the end of the block.

    Args:
        parent: where.
        name: what it is for; its own begins so.
        stage: who needs it, for the message.

    Raises:
        StoreError: when it cannot be created.
    """
    try:
        path, locks = _claim(parent, name)
    except OSError as error:
        reason = error.strerror or error
        if not stage:
            raise StoreError(f"the store {parent.parent} cannot be written: {reason}") from error
        raise StoreError(
            f"stage {stage}: {parent / name} cannot be written: {reason} (store {parent.parent})"
        ) from error
    try:
        yield path
    finally:
        _remove(path, locks)


def _claim(parent: Path, name: str) -> tuple[Path, list[int]]:
    parent.mkdir(parents=True, exist_ok=True)
    while True:
        path = parent / f"{name}.{secrets.token_hex(4)}"
        path.mkdir()
        try:
            return path, _lock(path, fcntl.LOCK_EX, create=True)
        except (BlockingIOError, FileNotFoundError):
            # Another process's sweep removes it, or somebody looks at it just now.
            shutil.rmtree(path, ignore_errors=True)
        except OSError:
            shutil.rmtree(path, ignore_errors=True)
            raise


def _lock(directory: Path, kind: int, *, create: bool) -> list[int]:
    """Lock a scratch directory and the file in it; descriptors that hold the locks until they are closed.

    Args:
        directory: which.
        kind: `fcntl.LOCK_EX` to own it, `fcntl.LOCK_SH` to look.
        create: whether to make a file that is not there; otherwise the directory alone is locked then.

    Raises:
        BlockingIOError: when another process holds one of them.
        FileNotFoundError: when another process has removed one of them.
        OSError: when one may not be opened or made.
    """
    taken: list[int] = []

    def take(place: Path, flags: int) -> None:
        taken.append(os.open(place, flags | os.O_NOFOLLOW, 0o666))
        fcntl.flock(taken[-1], kind | fcntl.LOCK_NB)
        # Who had it may have removed it between our open and our lock.
        if not os.path.samestat(os.fstat(taken[-1]), os.stat(place)):
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(place))

    try:
        take(directory, os.O_RDONLY | os.O_DIRECTORY)
        # For an exclusive lock NFS wants a file that is open for writing.
        access = os.O_RDWR if kind == fcntl.LOCK_EX else os.O_RDONLY
        if create or (directory / LOCK).exists():
            take(directory / LOCK, access | (os.O_CREAT if create else 0))
    except BaseException:
        for lock in taken:
            os.close(lock)
        raise
    return taken


def _remove(directory: Path, locks: Iterable[int]) -> None:
    """Remove a scratch directory, then give its locks back."""
    shutil.rmtree(directory, ignore_errors=True)
    for lock in locks:
        os.close(lock)
    # On NFS a file that is removed while it is open stays, under another name, until it is closed.
    with suppress(OSError):
        directory.rmdir()


def held_directories(parent: Path) -> list[Path]:
    """The directories below `parent` that a process has locked, i.e. works in, on this or another machine."""
    held = []
    for name in _directories(parent):
        try:
            # Shared: looking must not seem to another who looks to be work.
            locks = _lock(parent / name, fcntl.LOCK_SH, create=False)
        except BlockingIOError:
            held.append(parent / name)
        except OSError as error:
            _say_left(parent / name, error)
        else:
            for lock in locks:
                os.close(lock)
    return held


def sweep_directories(parent: Path, *, dry_run: bool = False) -> list[str]:
    """Remove the directories below `parent` that no process has locked; returns their names.

    Those that this user may not look into or remove, as those of another user, stay.
    """
    removed = []
    for name in _directories(parent):
        path = parent / name
        try:
            # Without a file its writer may be about to make one: then who locks it first has the directory.
            # In those that are to be deleted nobody works, and a full disk may have no room for a file.
            locks = _lock(path, fcntl.LOCK_EX, create=not dry_run and not name.endswith(_REMOVED))
        except BlockingIOError:
            continue
        except OSError as error:
            _say_left(path, error)
            continue
        if dry_run:
            for lock in locks:
                os.close(lock)
        else:
            _remove(path, locks)
        if dry_run or not path.exists():
            removed.append(f"{parent.name}/{name}")
    return removed


def remove_entries(parent: Path, *, dry_run: bool = False) -> tuple[list[str], list[StoreError]]:
    """Remove what is below `parent`, each by itself; its names, and why others could not be removed.

    Of a folder of which a part could not be removed the rest is gone.
    """
    removed: list[str] = []
    refused: list[StoreError] = []
    try:
        names = sorted(os.listdir(parent))
    except FileNotFoundError:
        return removed, refused
    except OSError as error:
        refused.append(StoreError(f"{parent} cannot be listed: {reason_of(error)}"))
        return removed, refused
    for name in names:
        path = parent / name
        try:
            if not dry_run:
                # Another machine may clean the same store at the same hour.
                with suppress(FileNotFoundError):
                    shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
        except OSError as error:
            problem = StoreError(f"{path} cannot be removed: {reason_of(error)}")
            problem.__cause__ = error
            refused.append(problem)
        else:
            removed.append(f"{parent.name}/{name}")
    return removed, refused


def _directories(parent: Path) -> list[str]:
    """Names of the directories below `parent`, sorted; none where it may not be listed."""
    try:
        return sorted(entry.name for entry in os.scandir(parent) if entry.is_dir(follow_symlinks=False))
    except FileNotFoundError:
        return []
    except PermissionError as error:
        log.debug("%s cannot be listed: %s", parent, error.strerror)
        return []


def _say_left(directory: Path, error: OSError) -> None:
    if not isinstance(error, FileNotFoundError):
        log.debug("%s cannot be looked at, and stays: %s", directory, error.strerror)
