"""Storage behind an fsspec URL (S3-compatible object stores and others), which has no atomic rename.

The files of each attempt go below a prefix of their own, `<key>/<attempt>/`; `<key>/manifest.json`,
written last with a single put, names the attempt. Before that nothing is visible, and two writers of
one key can never mix their files.
"""

from __future__ import annotations

import datetime
import logging
import os
import secrets
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from extrags.data_directories import cache_directory
from extrags.errors import MissingDependencyError, StoreError
from extrags.store.canonical import Ref, digest_of
from extrags.store.directory import private_directory, sweep_directories
from extrags.store.manifest import MANIFEST, Manifest, content_digest

__all__ = ["UrlBackend", "default_cache_directory"]

log = logging.getLogger(__name__)


def default_cache_directory() -> Path:
    """Where remote artefacts are kept for reading: `EXTRAGS_CACHE`, or the user's cache directory."""
    chosen = os.environ.get("EXTRAGS_CACHE")
    if chosen:
        return Path(chosen)
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

    def check_writable(self) -> None:
        """Try one write to the local cache and one to the remote store.

        Raises:
            StoreError: when either fails, with the reason.
        """
        name = f"{self.prefix}/probe-{secrets.token_hex(4)}"
        try:
            self.fs.pipe_file(name, b"x")
            self.fs.rm_file(name)
            with private_directory(self.scratch, "probe"):
                pass
        except Exception as error:
            # Each fsspec backend raises its own kinds (botocore's are not OSErrors).
            raise StoreError(f"the store {self.url} cannot be written: {error}") from error

    def read_manifest(self, key: str) -> Manifest | None:
        """Manifest of a key; None where there is no such artefact."""
        name = f"{self.prefix}/{key}/{MANIFEST}"
        try:
            return Manifest.model_validate_json(self.fs.cat_file(name))
        except FileNotFoundError:
            return None
        except ValidationError as error:
            log.warning("%s is not a manifest (%d faults); ignored", name, error.error_count())
            return None
        except OSError as error:
            raise StoreError(f"{self.url}/{key}/{MANIFEST} cannot be read: {error}") from error

    def uri(self, key: str) -> str:
        """URL of the artefact of a key."""
        return f"{self.url}/{key}"

    def names(self) -> list[str]:
        """All keys, sorted; also those whose manifest is still missing."""
        return sorted(name for name, kind in self._children(self.prefix) if kind == "directory")

    def path(self, ref: Ref, manifest: Manifest) -> Path:
        """Local directory with the artefact's files; downloaded at the first call, verified by the digest."""
        target = self.local / f"{manifest.key}.{manifest.digest}"
        if target.is_dir():
            return target
        with private_directory(self.scratch, manifest.key) as private:
            scratch = private / "files"
            scratch.mkdir()
            source = f"{self.prefix}/{manifest.key}/{manifest.data}"
            for name in self.fs.find(source):
                relative = str(name).removeprefix(source).lstrip("/")
                (scratch / relative).parent.mkdir(parents=True, exist_ok=True)
                self.fs.get_file(name, str(scratch / relative))
            digest, _, _ = content_digest(scratch)
            if digest != manifest.digest:
                raise StoreError(
                    f"{self.url}/{manifest.key} is damaged: its files have digest {digest}, "
                    f"the manifest says {manifest.digest}"
                )
            (scratch / MANIFEST).write_text(manifest.model_dump_json(indent=1))
            self.local.mkdir(parents=True, exist_ok=True)
            try:
                scratch.rename(target)
            except OSError:
                if not target.is_dir():  # Otherwise another process fetched it meanwhile.
                    raise
        return target

    def commit(self, scratch: Path, manifest: Manifest) -> Manifest:
        """Upload the files, then the manifest."""
        present = self.read_manifest(manifest.key)
        if present is not None and present.digest == manifest.digest:
            return present
        attempt = secrets.token_hex(8)
        manifest = manifest.model_copy(update={"data": attempt})
        try:
            for path in sorted(scratch.rglob("*")):
                if path.is_file():
                    name = path.relative_to(scratch).as_posix()
                    self.fs.pipe_file(f"{self.prefix}/{manifest.key}/{attempt}/{name}", path.read_bytes())
            self.fs.pipe_file(
                f"{self.prefix}/{manifest.key}/{MANIFEST}", manifest.model_dump_json(indent=1).encode()
            )
        except OSError as error:
            raise StoreError(f"the store {self.url} cannot be written: {error}") from error
        return manifest

    def discard(self, key: str) -> bool:
        """Remove an artefact; its manifest is deleted first, so that it disappears atomically."""
        found = self.fs.exists(f"{self.prefix}/{key}")
        if found:
            if self.fs.exists(f"{self.prefix}/{key}/{MANIFEST}"):
                self.fs.rm_file(f"{self.prefix}/{key}/{MANIFEST}")
            if self.fs.exists(f"{self.prefix}/{key}"):
                self.fs.rm(f"{self.prefix}/{key}", recursive=True)
        return bool(found)

    def sweep(self, older_than_hours: float) -> list[str]:
        """Remove local leftovers, and remote attempts without a manifest older than `older_than_hours`.

        Only the age of remote files is known, not whether their writer is still running.
        """
        removed = sweep_directories(self.scratch)
        limit = datetime.datetime.now(datetime.UTC) - datetime.timedelta(hours=older_than_hours)
        for key in self.names():
            manifest = self.read_manifest(key)
            for attempt, kind in self._children(f"{self.prefix}/{key}"):
                if kind != "directory" or (manifest is not None and attempt == manifest.data):
                    continue
                place = f"{self.prefix}/{key}/{attempt}"
                if all(self._modified(name) <= limit for name in self.fs.find(place)):
                    self.fs.rm(place, recursive=True)
                    removed.append(f"{key}/{attempt}")
        return removed

    def _children(self, place: str) -> list[tuple[str, str]]:
        # Object stores cache listings; another process may have written since.
        self.fs.invalidate_cache()
        try:
            entries: list[dict[str, Any]] = self.fs.ls(place, detail=True)
        except FileNotFoundError:
            return []
        return [(str(entry["name"]).rstrip("/").rsplit("/", 1)[-1], str(entry["type"])) for entry in entries]

    def _modified(self, name: str) -> datetime.datetime:
        moment: datetime.datetime = self.fs.modified(name)
        return moment if moment.tzinfo else moment.replace(tzinfo=datetime.UTC)
