"""Storage behind an fsspec URL (S3-compatible object stores and others), which has no atomic rename.

The files of each attempt go below a prefix of their own, `<key>/<attempt>/`; `<key>/manifest.json`,
written last with one put, names the attempt. Before that nothing is visible, and two writers of
one key can never mix their files.
"""

from __future__ import annotations

import datetime
import json
import os
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from extrags.data_directories import cache_directory
from extrags.errors import DamagedArtefactError, MissingDependencyError, StoreError
from extrags.store.canonical import Ref, digest_of
from extrags.store.directory import DAMAGED, RECORD, RECORDS, private_directory, sweep_directories
from extrags.store.integrity import Damage, find_damage, find_damaged_sizes, intact_manifest
from extrags.store.manifest import (
    MANIFEST,
    Manifest,
    is_name,
    manifest_text,
    parsed_manifest,
    same_content,
    stage_of,
)
from extrags.user_paths import expanded

__all__ = ["UrlBackend", "default_cache_directory"]


def default_cache_directory() -> Path:
    """Where remote artefacts are kept for reading: `EXTRAGS_CACHE`, or the user's cache directory."""
    chosen = os.environ.get("EXTRAGS_CACHE")
    if chosen:
        return expanded(chosen)
    return cache_directory()


class UrlBackend:
    """A store on an object store, read through a local directory."""

    def __init__(self, url: str, cache: Path | None) -> None:
        import fsspec

        try:
            self.fs, self.prefix = fsspec.core.url_to_fs(url)
        except ImportError as error:
            raise MissingDependencyError(f"the store {url} needs a further package: {error}") from error
        except ValueError as error:
            raise StoreError(f"the store {url} cannot be used: {error}") from error
        self.url = url.rstrip("/")
        self.prefix = self.prefix.rstrip("/")
        base = cache if cache is not None else default_cache_directory()
        # One folder per store, so that a sweep of one never touches another's.
        self.state = base / f"store-{digest_of(self.url)[:12]}"
        self.scratch = self.state / "scratch"
        self.local = self.state / "artefacts"

    def exists(self) -> bool:
        """Whether there is any object below the URL.

        Raises:
            StoreError: when the server says neither yes nor no.
        """
        try:
            self.fs.invalidate_cache()
            return bool(self.fs.exists(self.prefix))
        except Exception as error:
            # Each fsspec backend raises its own kinds.
            raise StoreError(f"the store {self.url} cannot be read: {error}") from error

    def check_writable(self) -> None:
        """Try one write to the local cache and one to the remote store, where an artefact's files would be.

        Raises:
            StoreError: when either fails, with the reason.
        """
        place = f"{self.prefix}/probe-{secrets.token_hex(4)}"
        name = f"{place}/{secrets.token_hex(8)}/written"
        try:
            self._put(name, b"x")
            self.fs.rm_file(name)
            self._remove_empty(place)
            with private_directory(self.scratch, "probe"):
                pass
        except Exception as error:
            # Each fsspec backend raises its own kinds (botocore's are not OSErrors).
            raise StoreError(f"the store {self.url} cannot be written: {error}") from error

    def read_manifest(self, key: str) -> Manifest | None:
        """Manifest of a key; None where there is no such artefact.

        Raises:
            DamagedArtefactError: when the file is no manifest, or differs from its checksum.
            StoreError: when it cannot be read.
        """
        name = f"{self.prefix}/{key}/{MANIFEST}"
        try:
            return parsed_manifest(self.fs.cat_file(name), key)
        except FileNotFoundError:
            return None
        except ValueError as error:
            raise DamagedArtefactError(
                f"is not the manifest that was written: {error}",
                file=MANIFEST,
                stage=stage_of(key),
                key=key,
                store=self.url,
            ) from error
        except Exception as error:
            # Each fsspec backend raises its own kinds (botocore's are not OSErrors).
            raise StoreError(f"{self.url}/{key}/{MANIFEST} cannot be read: {error}") from error

    def uri(self, key: str) -> str:
        """URL of the artefact of a key."""
        return f"{self.url}/{key}"

    def names(self) -> list[str]:
        """All keys, sorted; also those whose manifest is still missing."""
        children = self._children(self.prefix)
        return sorted(
            name for name, kind in children if kind == "directory" and name not in (DAMAGED, RECORDS)
        )

    def path(self, ref: Ref, manifest: Manifest) -> Path:
        """Local directory with the artefact's files; downloaded at the first call, verified by the digest.

        Raises:
            DamagedArtefactError: when the remote files are not those that were stored.
        """
        target = self._copy_of(manifest)
        if target.is_dir():
            return target
        with self._downloaded(manifest) as scratch:
            damage = find_damage(scratch, manifest, "all")
            if damage is not None:
                raise DamagedArtefactError(
                    damage.problem,
                    file=damage.file,
                    stage=manifest.stage,
                    key=manifest.key,
                    store=self.url,
                )
            (scratch / MANIFEST).write_bytes(manifest_text(manifest))
            self.local.mkdir(parents=True, exist_ok=True)
            try:
                scratch.rename(target)
            except OSError:
                if not target.is_dir():  # Otherwise another process fetched it meanwhile.
                    raise
        return target

    def touch(self, key: str) -> None:
        """Nothing: an object's time cannot be changed without writing it again."""

    def last_used(self, keys: Iterable[str]) -> dict[str, float]:
        """Not known; what counts is when they were made."""
        return {}

    def drop_copy(self, manifest: Manifest) -> bool:
        """Remove the local copy of an artefact, to be downloaded again; whether there was one."""
        return self._drop(self._copy_of(manifest).name)

    def _drop(self, copy: str) -> bool:
        aside = self.scratch / f"{copy}.{secrets.token_hex(4)}.removed"
        self.scratch.mkdir(parents=True, exist_ok=True)
        try:
            (self.local / copy).rename(aside)
        except FileNotFoundError:
            return False
        shutil.rmtree(aside, ignore_errors=True)
        return True

    def _copies(self) -> list[tuple[str, str]]:
        """Names of all local copies, sorted, each with its key."""
        names = sorted(os.listdir(self.local)) if self.local.is_dir() else []
        return [(name, name.rpartition(".")[0]) for name in names]

    def _drop_copies(self, key: str, *, but: str = "") -> None:
        """Remove the local copies of a key, but for the one of that name."""
        for name, of in self._copies():
            if of == key and name != but:
                self._drop_unless_refused(name)

    def _drop_unless_refused(self, copy: str) -> bool:
        """As `_drop`; a copy of another user stays, since it takes room and does no other harm."""
        with suppress(OSError):
            return self._drop(copy)
        return False

    def damaged_sizes(self, manifest: Manifest) -> Damage | None:
        """Whether files are missing, truncated or too many; with a local copy, that is what is looked at."""
        copy = self._copy_of(manifest)
        if copy.is_dir() and find_damage(copy, manifest, "sizes") is None:
            return None
        source = f"{self.prefix}/{manifest.key}/{manifest.data}"
        self.fs.invalidate_cache(source)
        found = self.fs.find(source, detail=True)
        sizes = {
            str(name).removeprefix(source).lstrip("/"): int(about["size"]) for name, about in found.items()
        }
        return find_damaged_sizes(sizes, manifest)

    def examine(self, manifest: Manifest) -> Damage | None:
        """Whether the remote files differ from those that were stored; downloads all of them."""
        with self._downloaded(manifest) as scratch:
            return find_damage(scratch, manifest, "all")

    def set_aside(self, key: str, record: dict[str, Any]) -> str | None:
        """Move an artefact below `damaged/`, with a record of what is wrong; None when it is gone already.

        Its manifest goes first, so that it disappears atomically.
        """
        place = f"{self.prefix}/{DAMAGED}/{key}.{secrets.token_hex(4)}"
        manifest = f"{self.prefix}/{key}/{MANIFEST}"
        try:
            self._put(f"{place}/artefact/{MANIFEST}", self.fs.cat_file(manifest))
            self.fs.rm_file(manifest)
        except FileNotFoundError:
            return None
        self._put(f"{place}/{RECORD}", json.dumps(record, indent=1).encode())
        for name in self.fs.find(f"{self.prefix}/{key}"):
            relative = str(name).removeprefix(f"{self.prefix}/{key}").lstrip("/")
            self._write(f"{place}/artefact/{relative}", partial(self.fs.mv, str(name)))
        self._remove_empty(f"{self.prefix}/{key}")
        return f"{self.url}/{DAMAGED}/{place.rsplit('/', 1)[-1]}"

    def remove_damaged(self, *, dry_run: bool = False) -> tuple[list[str], list[StoreError]]:
        """Remove what was set aside, all at once; returns the names, as that of a directory does."""
        place = f"{self.prefix}/{DAMAGED}"
        names = sorted(name for name, _ in self._children(place))
        if names and not dry_run:
            try:
                self._remove_all(place)
            except StoreError as error:
                return [], [error]
        return [f"{DAMAGED}/{name}" for name in names], []

    def _copy_of(self, manifest: Manifest) -> Path:
        return self.local / f"{manifest.key}.{manifest.digest}"

    @contextmanager
    def _downloaded(self, manifest: Manifest) -> Iterator[Path]:
        """The remote files in a scratch directory that is removed at the end of the block."""
        with private_directory(self.scratch, manifest.key) as private:
            scratch = private / "files"
            scratch.mkdir()
            source = f"{self.prefix}/{manifest.key}/{manifest.data}"
            self.fs.invalidate_cache(source)
            for name in self.fs.find(source):
                relative = str(name).removeprefix(source).lstrip("/")
                if not all(is_name(part) for part in relative.split("/")):
                    raise StoreError(f"{self.url}: the object {name!r} would be written outside the copy")
                (scratch / relative).parent.mkdir(parents=True, exist_ok=True)
                # What goes away meanwhile is missing then, and said to be.
                with suppress(FileNotFoundError):
                    self.fs.get_file(name, str(scratch / relative))
            yield scratch

    def write_record(self, name: str, text: bytes) -> None:
        """Write `records/<name>` with one put, which replaces one that is there."""
        with self._as_store_errors(f"the record {name} cannot be written"):
            self._put(f"{self.prefix}/{RECORDS}/{name}", text)

    def read_records(self, prefix: str) -> dict[str, bytes]:
        """Records by name, of those whose name begins so."""
        place = f"{self.prefix}/{RECORDS}"
        with self._as_store_errors("the records cannot be read"):
            names = sorted(name for name, _ in self._children(place) if name.startswith(prefix))
            if not names:
                return {}
            # All at once: on an object store each costs a round trip.
            found = self.fs.cat([f"{place}/{name}" for name in names], on_error="return")
            texts = {}
            for path, text in found.items():
                # What is gone was removed meanwhile; what cannot be read is there.
                if isinstance(text, FileNotFoundError):
                    continue
                if isinstance(text, Exception):
                    raise text
                texts[str(path).rsplit("/", 1)[-1]] = text
        return texts

    def remove_record(self, name: str) -> None:
        """Remove `records/<name>`, if it is there."""
        with self._as_store_errors(f"the record {name} cannot be removed"), suppress(FileNotFoundError):
            self.fs.rm_file(f"{self.prefix}/{RECORDS}/{name}")

    @contextmanager
    def _as_store_errors(self, what: str) -> Iterator[None]:
        """Each fsspec backend raises its own kinds (botocore's are not OSErrors)."""
        try:
            yield
        except StoreError:
            raise
        except Exception as error:
            raise StoreError(f"{what}, store {self.url}: {error}") from error

    def commit(self, scratch: Path, manifest: Manifest, *, renew: bool = False) -> Manifest:
        """Upload the files, then the manifest.

        The same content that is there already stays; with `renew` under the new manifest, which says when
        and how fast it was made this time.
        """
        present = intact_manifest(self, manifest.key)
        if present is not None and same_content(present, manifest):
            if renew:
                present = manifest.model_copy(update={"data": present.data})
                self._put(f"{self.prefix}/{manifest.key}/{MANIFEST}", manifest_text(present))
            return present
        attempt = secrets.token_hex(8)
        manifest = manifest.model_copy(update={"data": attempt})
        try:
            for path in sorted(scratch.rglob("*")):
                if path.is_file():
                    name = path.relative_to(scratch).as_posix()
                    # In parts where it is large; not through the memory.
                    target = f"{self.prefix}/{manifest.key}/{attempt}/{name}"
                    self._write(target, partial(self.fs.put_file, str(path)))
            self._put(f"{self.prefix}/{manifest.key}/{MANIFEST}", manifest_text(manifest))
        except Exception as error:
            # As above.
            raise StoreError(f"the store {self.url} cannot be written: {error}") from error
        self._drop_copies(manifest.key, but=self._copy_of(manifest).name)
        return manifest

    def _put(self, name: str, text: bytes) -> None:
        self._write(name, lambda target: self.fs.pipe_file(target, text))

    def _write(self, name: str, write: Callable[[str], object]) -> None:
        """Write an object; once more where its folder was missing, which object stores have none of."""
        try:
            write(name)
        except Exception:
            # Each fsspec backend raises its own kinds. Folders are made only where one is missing: asked for
            # one, object stores look for the bucket.
            folder = name.rpartition("/")[0]
            if self.fs.isdir(folder):
                raise
            self._make_folder(folder)
            write(name)

    def _make_folder(self, place: str) -> None:
        """Make a folder and those above it; but no bucket, which the first part of the path may be."""
        if "/" not in place or self.fs.isdir(place):
            return
        self._make_folder(place.rpartition("/")[0])
        with suppress(FileExistsError):  # Another process has made it meanwhile.
            self.fs.mkdir(place, create_parents=False)

    def discard(self, key: str) -> bool:
        """Remove an artefact: its manifest first, so that it disappears atomically, then the files it names.

        Files of other attempts stay, because another process may be uploading them; `sweep` removes them.
        Local copies go as well: those of this machine here, others by the `sweep` of theirs.
        """
        place = f"{self.prefix}/{key}"
        try:
            manifest = self.read_manifest(key)
        except DamagedArtefactError:
            attempts = [name for name, kind in self._children(place) if kind == "directory"]
        else:
            if manifest is None:
                self._drop_copies(key)
                return False
            attempts = [manifest.data]
        with suppress(FileNotFoundError):
            self.fs.rm_file(f"{place}/{MANIFEST}")
        for attempt in attempts:
            with suppress(FileNotFoundError):
                self.fs.rm(f"{place}/{attempt}", recursive=True)
        self._remove_empty(place)
        self._drop_copies(key)
        return True

    def _remove_empty(self, place: str) -> None:
        """Object stores have no directories, but other file systems keep empty ones."""
        for inner, kind in self._children(place):
            if kind == "directory":
                self._remove_empty(f"{place}/{inner}")
        self._remove_if_empty(place)

    def _remove_if_empty(self, place: str) -> None:
        if not self._children(place):
            with suppress(OSError):
                self.fs.rmdir(place)

    def sweep(self, older_than_hours: float, *, dry_run: bool = False) -> list[str]:
        """Remove local leftovers, and remote attempts without a manifest older than `older_than_hours`.

        Only the age of remote files is known, not whether their writer is still running. Local leftovers
        are scratch directories, and copies of what is no longer in the store, whoever has removed it.
        """
        removed = sweep_directories(self.scratch, dry_run=dry_run)
        # Listed before the store is: what is copied meanwhile stays.
        copies = self._copies()
        stored, unreadable = set(), set()
        limit = datetime.datetime.now(datetime.UTC) - datetime.timedelta(hours=older_than_hours)
        for key in self.names():
            try:
                manifest = self.read_manifest(key)
            except DamagedArtefactError:
                unreadable.add(key)
                continue  # Which attempt it named is not known; `set_aside` moves them all.
            if manifest is not None:
                stored.add(self._copy_of(manifest).name)
            for attempt, kind in self._children(f"{self.prefix}/{key}"):
                if kind != "directory" or (manifest is not None and attempt == manifest.data):
                    continue
                place = f"{self.prefix}/{key}/{attempt}"
                modified = self._modified(place)
                # Nothing there: another machine has removed it, or is about to write the first file.
                if modified is None or modified > limit:
                    continue
                if dry_run or self._remove_all(place):
                    removed.append(f"{key}/{attempt}")
                if not dry_run:
                    self._remove_empty(place)
                    self._remove_if_empty(f"{self.prefix}/{key}")
        for name, key in copies:
            if name not in stored and key not in unreadable and (dry_run or self._drop_unless_refused(name)):
                removed.append(f"{self.local.name}/{name}")
        return removed

    def _children(self, place: str) -> list[tuple[str, str]]:
        # Object stores cache listings; another process may have written since.
        self.fs.invalidate_cache()
        try:
            entries: list[dict[str, Any]] = self.fs.ls(place, detail=True)
        except FileNotFoundError:
            return []
        return [(str(entry["name"]).rstrip("/").rsplit("/", 1)[-1], str(entry["type"])) for entry in entries]

    def _remove_all(self, place: str) -> bool:
        """Remove all that is below a place; False where another process has removed some of it meanwhile."""
        try:
            self.fs.rm(place, recursive=True)
        except (FileNotFoundError, IsADirectoryError):  # The second is how s3fs says the first.
            return False
        return True

    def _modified(self, place: str) -> datetime.datetime | None:
        """When something below a place was changed last; None where nothing is there, or its time not known.

        An empty folder, which object stores have none of, has a time of its own.
        """
        self.fs.invalidate_cache(place)
        # With the listing, because what is asked for file by file may be gone by then.
        found = list(self.fs.find(place, detail=True).values())
        if not found:
            with suppress(FileNotFoundError):
                found = [self.fs.info(place)]
        moments = [_time_of(about) for about in found]
        known = [moment for moment in moments if moment is not None]
        return max(known) if moments and len(known) == len(moments) else None


def _time_of(about: Mapping[str, Any]) -> datetime.datetime | None:
    """When a file was changed last, as backends of fsspec tell in their listings; None where they do not."""
    for name in ("LastModified", "mtime", "last_modified", "modified", "updated", "created"):
        told = about.get(name)
        if isinstance(told, str):
            with suppress(ValueError):
                told = datetime.datetime.fromisoformat(told)
        if isinstance(told, int | float):
            told = datetime.datetime.fromtimestamp(told, datetime.UTC)
        if isinstance(told, datetime.datetime):
            return told if told.tzinfo else told.replace(tzinfo=datetime.UTC)
    return None
