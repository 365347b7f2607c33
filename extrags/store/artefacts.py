"""The artefact store: artefacts by key, written atomically."""

from __future__ import annotations

import datetime
import errno
import json
import logging
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, TypeVar

from extrags.errors import ArtefactGoneError, ConfigError, DamagedArtefactError, StoreError, reason_of
from extrags.redaction import has_credentials, without_credentials, without_credentials_in
from extrags.store.artefact_names import found_by, keys_of_other_places, matches
from extrags.store.canonical import Ref
from extrags.store.directory import (
    ABOUT,
    DirectoryBackend,
    private_directory,
    remove_entries,
    sweep_directories,
)
from extrags.store.integrity import Damage, Depth, default_depth, find_damage, list_contents
from extrags.store.kept import kept_or_read
from extrags.store.manifest import MANIFEST, Manifest, is_name, software_versions, stage_of
from extrags.store.permissions import give_usual_permissions
from extrags.store.refusal import refused_write
from extrags.store.slot import Slot
from extrags.store.storable import Storable
from extrags.store.url import UrlBackend
from extrags.user_paths import expanded

__all__ = ["Store"]

log = logging.getLogger(__name__)


S = TypeVar("S", bound=Storable)

_opened: set[tuple[str, str, int, Depth]] = set()
"""Artefacts whose contents this process has compared: path, digest, inode (another one after a repair)."""


class Store:
    """Content-addressed artefacts below a directory or an fsspec URL.

    An artefact exists if and only if it has a manifest; there is no other record that could become stale.
    Safe for concurrent processes and against SIGKILL at any point.

    What is read is what was stored, or there is a `DamagedArtefactError`: number and size of files are
    compared on every access, contents once per process and artefact, and chunks of arrays have checksums of
    their own, which are compared whenever they are read (`extrags.zarr_io`).

    Args:
        root: a directory, or a URL such as `s3://bucket/prefix` or `memory://name`.
        cache: local directory for reading remote artefacts; default: the user's cache directory.
        verify: which contents are compared when an artefact is opened for the first time: of `all` files, or
            of those alone that are no chunks of arrays (`metadata`), which is faster for large artefacts;
            default: `EXTRAGS_VERIFY`, else `all`.

    Raises:
        StoreError: for a URL that fsspec does not know.
        ConfigError: for another value of `EXTRAGS_VERIFY`, or a URL with credentials in it.
    """

    def __init__(
        self,
        root: str | Path,
        *,
        cache: Path | None = None,
        verify: Literal["metadata", "all"] | None = None,
    ) -> None:
        text = str(root)
        if "://" in text and has_credentials(text):
            raise ConfigError(
                f"the URL of the store {text} holds credentials, and URLs of stores are written to "
                "manifests, logs and Prefect's database; give them in the environment, such as "
                "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY for s3, or FSSPEC_<PROTOCOL>_PASSWORD"
            )
        self._depth: Depth = verify or default_depth()
        self.backend: DirectoryBackend | UrlBackend
        if "://" in text and not text.startswith("file://"):
            self.root = text.rstrip("/")
            self.backend = UrlBackend(self.root, cache)
        else:
            directory = expanded(text.removeprefix("file://")).absolute()
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

    def exists(self) -> bool:
        """Whether there is anything at the root.

        Raises:
            StoreError: when that cannot be found out.
        """
        return self.backend.exists()

    def find(self, key: str) -> Ref | None:
        """The artefact of a key, or None.

        Raises:
            DamagedArtefactError: when its manifest is damaged, or files are missing, truncated or too many.
        """
        manifest = self.backend.read_manifest(_checked(key))
        if manifest is None:
            return None
        damage = self.backend.damaged_sizes(manifest)
        if damage is not None:
            raise self._damaged(key, damage)
        self.backend.touch(key)
        return self.ref_of(manifest)

    def find_or_set_aside(self, key: str) -> Ref | None:
        """As `find`, for who can make an artefact anew: a damaged one is set aside, and None returned."""
        try:
            return self.find(key)
        except DamagedArtefactError as error:
            self.set_aside(error)
            return None

    def manifest(self, ref: Ref) -> Manifest:
        """Manifest of an artefact.

        Raises:
            ArtefactGoneError: when it is gone, or was replaced by other content.
            DamagedArtefactError: when it is damaged.
        """
        key = _key_of(ref)
        manifest = self.backend.read_manifest(key)
        if manifest is None:
            raise ArtefactGoneError(
                f"artefact {key} is not in the store {self.root}; it was removed meanwhile", key
            )
        if manifest.digest != ref.digest:
            raise ArtefactGoneError(
                f"artefact {key} has digest {manifest.digest}, expected {ref.digest}: "
                "it was replaced meanwhile",
                key,
            )
        return manifest

    def open(self, ref: Ref) -> Path:
        """Local directory with the files of an artefact; read only.

        Raises:
            ArtefactGoneError: when it is gone or was replaced.
            DamagedArtefactError: when its files are not those that were stored.
        """
        manifest = self.manifest(ref)
        damage = None
        # A local copy that is damaged is dropped and fetched once more.
        for _ in range(2):
            path = self.backend.path(ref, manifest)
            damage = self._first_look(path, manifest)
            if damage is None:
                self.backend.touch(manifest.key)
                return path
            if not self.backend.drop_copy(manifest):
                break
            log.warning("the local copy of %s is damaged and is fetched again: %s", manifest.key, damage)
        assert damage is not None
        raise self._damaged(manifest.key, damage)

    def _first_look(self, path: Path, manifest: Manifest) -> Damage | None:
        """Compare contents, if this process has not done so; else number and size of files."""
        try:
            look = (str(path), manifest.digest, path.stat().st_ino, self._depth)
            damage = find_damage(path, manifest, "sizes" if look in _opened else self._depth)
        except FileNotFoundError as error:
            if path.exists():
                raise
            raise ArtefactGoneError(f"artefact {manifest.key} was removed meanwhile", manifest.key) from error
        if damage is None:
            _opened.add(look)
        return damage

    def load(self, kind: type[S], ref: Ref) -> S:
        """An object from an artefact; of `Storable.kept_when_loaded` the one that this process read last.

        Args:
            kind: its class, e.g. `extrags.scene.Scene`.
            ref: an artefact that holds one.

        Raises:
            StoreError: as `open`.
        """
        path = self.open(ref)

        def read() -> S:
            with self._blaming([ref]):
                found: S = kind.load(path / kind.stored_as)
            return found

        return kept_or_read(kind, ref.digest, read) if kind.kept_when_loaded else read()

    def load_json(self, file: str, ref: Ref) -> Any:
        """What `Slot.save_json` wrote.

        Raises:
            StoreError: as `open`.
        """
        path = self.open(ref)
        with self._blaming([ref]):
            return json.loads((path / file).read_bytes())

    @contextmanager
    def _blaming(self, refs: Iterable[Ref]) -> Iterator[None]:
        """What fails inside the block because of damage, since the first look, is named as such."""
        try:
            yield
        except Exception as error:
            if isinstance(error, DamagedArtefactError) and error.key:
                raise
            for ref in refs:
                self._check_what_was_read(ref, error)
            raise

    def _check_what_was_read(self, ref: Ref, error: Exception) -> None:
        try:
            manifest = self.manifest(ref)
            path = self.backend.path(ref, manifest)
            damage = find_damage(path, manifest, "all")
        except (ArtefactGoneError, FileNotFoundError) as gone:
            if isinstance(error, OSError):
                # It was set aside or replaced while it was read.
                raise ArtefactGoneError(f"{_key_of(ref)} went away while it was read", _key_of(ref)) from gone
            return
        if damage is not None:
            self.backend.drop_copy(manifest)
            raise self._damaged(manifest.key, damage) from error

    def examine(self, key: str) -> DamagedArtefactError | None:
        """Read all files of an artefact, on an object store the remote ones; what is wrong, or None.

        Raises:
            StoreError: when the store cannot be read, or a file for a reason that is no damage, such as
                permissions.
        """
        try:
            manifest = self.backend.read_manifest(_checked(key))
            damage = None if manifest is None else self.backend.examine(manifest)
        except StoreError as error:
            return _as_damage(error, key, self.root)
        except OSError as error:
            raise StoreError(f"{error.filename or key} cannot be read: {reason_of(error)}") from error
        return None if damage is None else self._damaged(key, damage)

    def verify(self, ref: Ref) -> bool:
        """Whether the files still have the digest they were stored with; reads all of them."""
        return self.manifest(ref).digest == ref.digest and self.examine(_key_of(ref)) is None

    def keys(self) -> list[str]:
        """Keys of all artefacts, damaged ones among them, sorted."""
        return self.backend.names()

    def set_aside(self, damage: DamagedArtefactError) -> str | None:
        """Move a damaged artefact to `damaged/` in the store, so that its stage makes it anew.

        A record of what is wrong, `damage.json`, lies beside it; `gc` removes both.

        Args:
            damage: what `find`, `open`, `load` or a stage raised, or `examine` returned.

        Returns:
            Where it is now; None when it is not damaged any more, because another process has made it anew.

        Raises:
            StoreError: when it cannot be moved.
        """
        if not damage.key or self.examine(damage.key) is None:
            return None
        record = {
            "stage": damage.stage,
            "key": damage.key,
            "file": damage.file,
            "problem": damage.problem,
            "found": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        }
        try:
            place = self.backend.set_aside(damage.key, record)
        except OSError as error:
            raise StoreError(
                f"{damage.key} cannot be set aside in {self.root}: {reason_of(error)}"
            ) from error
        if place is not None:
            log.warning(
                "stage %s: artefact %s is damaged (%s); it is set aside as %s and recomputed when needed",
                damage.stage,
                damage.key,
                f"{damage.file}: {damage.problem}" if damage.file else damage.problem,
                place,
            )
        return place

    def _damaged(self, key: str, damage: Damage) -> DamagedArtefactError:
        return DamagedArtefactError(
            damage.problem, file=damage.file, stage=stage_of(key), key=key, store=self.root
        )

    def ref_of(self, manifest: Manifest) -> Ref:
        """Reference to the artefact of a manifest."""
        return Ref(uri=self.backend.uri(manifest.key), digest=manifest.digest)

    @contextmanager
    def slot(
        self,
        *,
        stage: str,
        version: int,
        key: str,
        label: str = "",
        place: str = "",
        config: Mapping[str, Any] | None = None,
        inputs: Mapping[str, Ref] | None = None,
        renew: bool = False,
    ) -> Iterator[Slot]:
        """Write an artefact atomically: it is committed when the block ends, and discarded when it raises.

        Args:
            stage: name of the stage.
            version: version of the stage, raised by hand.
            key: the cache key; also the artefact's name.
            label: display name, e.g. of the sequence.
            place: absolute path of a sequence that is one.
            config: settings, as JSON types.
            inputs: the input artefacts by name.
            renew: where the same content is there already, its manifest says from now on when and how fast
                it was made this time.

        Yields:
            The slot; after the block `slot.ref` is the artefact.

        Raises:
            StoreError: when the store cannot be written.
        """
        started = datetime.datetime.now(datetime.UTC)
        clock = time.monotonic()
        with private_directory(self.backend.scratch, _checked(key), stage) as scratch:
            slot = Slot(scratch / "files", self)
            about = {
                "key": key,
                "stage": stage,
                "label": label,
                "started": started.isoformat(timespec="seconds"),
            }
            try:
                (scratch / ABOUT).write_text(json.dumps(about), encoding="utf-8")
                slot.path.mkdir()
                with self._blaming(slot._inputs.values()):
                    yield slot
                give_usual_permissions(slot.path, like=scratch / ABOUT)
                listing = list_contents(slot.path, slot.run_files)
                slot._manifest = self.backend.commit(
                    slot.path,
                    Manifest(
                        stage=stage,
                        version=version,
                        key=key,
                        digest=listing.digest,
                        label=without_credentials(label),
                        place="" if place == label else without_credentials(place),
                        config=without_credentials_in(dict(config or {})),
                        inputs={name: ref.digest for name, ref in (inputs or {}).items()},
                        input_keys={name: _key_of(ref) for name, ref in (inputs or {}).items()},
                        software=software_versions(),
                        started=started.isoformat(timespec="seconds"),
                        seconds=round(time.monotonic() - clock, 3),
                        counts=slot.counts,
                        files=listing.files,
                        bytes=listing.bytes,
                        contents=listing.contents,
                        run_files=sorted(slot.run_files),
                    ),
                    renew=renew,
                )
            except Exception as error:
                self._keep_failure(slot, key, label, error)
                refused = refused_write(error, stage, self.root, slot.path)
                if refused is None:
                    raise
                # Here, while the file that could not be written is still there to be named.
                raise refused from error

    def _keep_failure(self, slot: Slot, key: str, label: str, error: Exception) -> None:
        if not slot._debug.is_dir():
            return
        kept = self.state / "failed" / key
        try:
            (slot._debug / "error.json").write_text(
                json.dumps(
                    {"key": key, "label": label, "kind": type(error).__name__, "message": str(error)},
                    indent=1,
                )
            )
            kept.parent.mkdir(parents=True, exist_ok=True)
            shutil.rmtree(kept, ignore_errors=True)
            slot._debug.rename(kept)
            log.info("what the failed stage left for debugging: %s", kept)
        except OSError as problem:
            # A failure to keep debugging files must not hide the error of the stage.
            log.warning("could not keep the debugging files of %s in %s: %s", key, kept, reason_of(problem))

    def ls(self, pattern: str = "*") -> list[Manifest]:
        """Manifests of the artefacts whose key, stage, label or place matches a shell pattern, by age.

        Those whose manifest is damaged, or not for this user, are left out, with a warning.

        Raises:
            StoreError: as `manifests`.
        """
        found, _ = self.manifests()
        return [item for item in found if matches(pattern, item.key, *found_by(item))]

    def manifests(self) -> tuple[list[Manifest], list[str]]:
        """Manifests of all artefacts, and keys of those whose manifest cannot be read, with a warning each.

        For who looks over a whole store, which one artefact that is damaged, or not for this user, must not
        keep from the others.

        Raises:
            StoreError: when the store cannot be read. An object store that does not answer tells nothing of
                a single artefact.
        """
        found, unreadable = [], []
        for key in self.backend.names():
            try:
                manifest = self.backend.read_manifest(key)
            except StoreError as error:
                if "://" in self.root and not isinstance(error, DamagedArtefactError):
                    raise
                log.warning("%s is skipped: %s", key, error)
                unreadable.append(key)
            else:
                found += [] if manifest is None else [manifest]
        return sorted(found, key=lambda manifest: (manifest.started, manifest.key)), unreadable

    def rm(self, pattern: str, *, here: str | None = None) -> list[str]:
        """Remove artefacts by a shell pattern, as `removable` chooses them; returns their keys.

        Args:
            pattern: of the names.
            here: absolute path that the pattern names for who gives it; None for none.

        Raises:
            StoreError: as `removable`, before anything is removed, and when one cannot be removed.
        """
        return [key for key in self.removable(pattern, here=here) if self.backend.discard(key)]

    def removable(self, pattern: str, *, here: str | None = None) -> list[str]:
        """Keys of artefacts to remove by a shell pattern over key, stage, label or place, the oldest first.

        A relative path may be the name of several sequences: where it is the pattern, those in one place go.

        Of those with a damaged manifest the label is not known; they go by key or stage. Those whose manifest
        this user may not read may be whole: they go by their own key alone, or are left, with a warning.

        Args:
            pattern: of the names.
            here: absolute path that the pattern names for who gives it; None for none.

        Raises:
            StoreError: as `manifests`, and when the pattern names sequences in several places, or in another
                one than here.
        """
        chosen = []
        named: dict[str, list[str]] = {}
        for key in self.backend.names():
            try:
                manifest = self.backend.read_manifest(key)
            except StoreError as error:
                if "://" in self.root and not isinstance(error, DamagedArtefactError):
                    raise
                if not _tells_damage(error) and key != pattern:
                    log.warning("%s is left: %s", key, error)
                    continue
                about, started = [stage_of(key)], ""
            else:
                if manifest is None:
                    continue
                about, started = found_by(manifest), manifest.started
                if pattern == manifest.label and pattern not in (key, manifest.stage):
                    named.setdefault(manifest.place, []).append(key)
            if matches(pattern, key, *about):
                chosen.append((started, key))
        spared = keys_of_other_places(pattern, named, here)
        return [key for _, key in sorted(chosen) if key not in spared]

    def sweep_scratch(self) -> list[str]:
        """Remove scratch directories of killed processes of this machine alone; as `sweep`, but at once."""
        return sweep_directories(self.backend.scratch)

    def sweep(self, *, older_than_hours: float = 24.0) -> list[str]:
        """Remove leftovers of killed processes; scratch directories of running processes are kept.

        Args:
            older_than_hours: on object stores, age after which unfinished uploads are removed.

        Returns:
            Names of the removed files and directories.
        """
        return self.backend.sweep(older_than_hours)

    def gc(
        self,
        *,
        older_than_hours: float = 24.0,
        dry_run: bool = False,
        refused: list[StoreError] | None = None,
    ) -> list[str]:
        """Garbage collection: `sweep`, files of failures and damaged artefacts that were set aside.

        Which whole artefacts go is the matter of `extrags.store.retention`. What cannot be removed hinders
        nothing else.

        Args:
            older_than_hours: as in `sweep`.
            dry_run: remove nothing.
            refused: takes what could not be removed, with the reason.

        Returns:
            Names of what was removed, or would be.

        Raises:
            StoreError: once all else is removed, of the first that could not be, where `refused` is not
                given.
        """
        removed = self.backend.sweep(older_than_hours, dry_run=dry_run)
        failures = remove_entries(self.state / "failed", dry_run=dry_run)
        damaged = self.backend.remove_damaged(dry_run=dry_run)
        problems = failures[1] + damaged[1]
        if refused is not None:
            refused += problems
        elif problems:
            raise problems[0]
        return removed + failures[0] + damaged[0]


def _tells_damage(error: StoreError) -> bool:
    """Whether a manifest that could not be read is damaged: by its content, or as the disk says."""
    cause = error.__cause__
    return isinstance(error, DamagedArtefactError) or (
        isinstance(cause, OSError) and cause.errno == errno.EIO
    )


def _as_damage(error: StoreError, key: str, root: str) -> DamagedArtefactError:
    """What is wrong with an artefact whose manifest could not be read.

    A disk that does not give it back has damaged it, for who looks through the whole store; who needs it
    tries again first (`flows.limits`). Object stores answer so when they are busy.

    Raises:
        StoreError: the error itself, where it tells nothing of this artefact.
    """
    if isinstance(error, DamagedArtefactError):
        return error
    cause = error.__cause__
    if "://" in root or not _tells_damage(error) or not isinstance(cause, OSError):
        raise error
    problem = f"cannot be read: {cause.strerror}"
    return DamagedArtefactError(problem, file=MANIFEST, stage=stage_of(key), key=key, store=root)


def _key_of(ref: Ref) -> str:
    return _checked(ref.uri.rstrip("/").rsplit("/", 1)[-1])


def _checked(key: str) -> str:
    """A key names a folder of the store, and no other place.

    Raises:
        StoreError: otherwise.
    """
    if not is_name(key):
        raise StoreError(f"{key[:200]!r} is no key of an artefact: keys are names, not paths")
    return key
