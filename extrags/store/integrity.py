"""Whether the files of an artefact are still those that were stored.

The manifest holds size and digest of every file, in earlier artefacts `checksums.json` beside it. Neither
list needs a checksum of its own: the artefact's digest is computed from it, and the manifest has one. Number
and size of files are compared on every access, contents once per process and artefact (`Depth`).
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import zipfile
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, Protocol, runtime_checkable

from extrags.errors import ConfigError, DamagedArtefactError
from extrags.store.canonical import DIGEST_BYTES
from extrags.store.manifest import MANIFEST, Manifest

__all__ = [
    "CHECKSUMS",
    "VERIFY_VARIABLE",
    "Contents",
    "Damage",
    "Depth",
    "Listing",
    "content_digest",
    "default_depth",
    "find_damage",
    "find_damaged_sizes",
    "intact_manifest",
    "list_contents",
]

CHECKSUMS = "checksums.json"
"""In earlier artefacts: sizes and digests of the files, by relative name."""
PACKED_ARRAYS = ".zarr.zip"
"""Ending of files that hold arrays: chunks, which have checksums of their own, and then the metadata."""
NOT_CONTENT = frozenset({MANIFEST, CHECKSUMS})
"""Files at the top of an artefact that its digest does not cover."""
READ_BYTES = 1 << 20

VERIFY_VARIABLE = "EXTRAGS_VERIFY"
"""Environment variable: which contents are compared when a process opens an artefact for the first time."""

Depth = Literal["sizes", "metadata", "all"]
"""What is compared: number and size of files; also the contents of all files except chunks of arrays, whose
own checksums are compared when they are read; the contents of all files."""

Contents = dict[str, tuple[int, str] | tuple[int, str, int, str]]
"""See `Manifest.contents`."""


@dataclass(frozen=True)
class Damage:
    """What is wrong with an artefact."""

    problem: str
    file: str = ""
    """Relative name; empty where the artefact has no list of files."""


class Listing(NamedTuple):
    """What the files of an artefact amount to."""

    digest: str
    files: int
    bytes: int
    contents: Contents


class _File(NamedTuple):
    size: int
    digest: str
    metadata_at: int = 0
    """Of packed arrays: the byte where metadata begins, after the last chunk; else 0."""
    metadata: str = ""
    """Digest from there."""


def default_depth() -> Depth:
    """What `EXTRAGS_VERIFY` says: `all` (also where it is not set) or `metadata`.

    Raises:
        ConfigError: for another value.
    """
    chosen = os.environ.get(VERIFY_VARIABLE) or "all"
    if chosen == "all":
        return "all"
    if chosen == "metadata":
        return "metadata"
    raise ConfigError(f"{VERIFY_VARIABLE} is {chosen!r}; expected all or metadata")


def content_digest(directory: Path) -> tuple[str, int, int]:
    """Digest, number of files and bytes below a directory, without the store's own two files at its top.

    Two artefacts with equal digests hold the same files with the same bytes.
    """
    return _summary({name: _read(directory / name) for name in _sizes(directory)})


def list_contents(directory: Path, run_files: Collection[str] = ()) -> Listing:
    """The files of an artefact, for its manifest.

    Args:
        directory: the files.
        run_files: names of those that tell of the run; the digest does not cover them.
    """
    files = {name: _read(directory / name) for name in sorted(_sizes(directory))}
    contents: Contents = {}
    for name, file in files.items():
        begin = _metadata_at(directory / name) if name.endswith(PACKED_ARRAYS) else 0
        if begin:
            contents[name] = (file.size, file.digest, begin, _read(directory / name, begin).digest)
        else:
            contents[name] = (file.size, file.digest)
    return Listing(*_summary(files, run_files), contents)


def find_damage(directory: Path, manifest: Manifest, depth: Depth) -> Damage | None:
    """The first thing that is wrong with the files of an artefact, or None.

    Args:
        directory: its files.
        manifest: its manifest.
        depth: what is compared.

    Raises:
        OSError: when a file cannot be read for a reason that is no damage, such as permissions.
    """
    try:
        sizes = _sizes(directory)
    except OSError as error:
        if error.errno != errno.EIO:
            raise
        return Damage(f"cannot be listed: {error.strerror}")
    if depth == "sizes" and _as_counted(sizes, manifest):
        return None
    listed = _checksums(directory, manifest)
    if isinstance(listed, Damage):
        return listed
    if listed is None:
        # Made before there were checksums.
        counts = find_damaged_sizes(sizes, manifest)
        if counts is not None or depth == "sizes":
            return counts
        found, _, _ = _summary({name: _read(directory / name) for name in sizes})
        return None if found == manifest.digest else _other_digest(found, manifest)
    for name in sorted({*listed, *sizes}):
        if name not in listed:
            return Damage("does not belong to the artefact", name)
        if name not in sizes:
            return Damage("is missing", name)
        if sizes[name] != listed[name].size:
            return Damage(f"has {sizes[name]} bytes, expected {listed[name].size}", name)
    for name, file in listed.items():
        if depth == "all" or (depth == "metadata" and not _is_chunk(name)):
            try:
                if depth == "metadata" and file.metadata_at:
                    changed = _read(directory / name, file.metadata_at).digest != file.metadata
                else:
                    changed = _read(directory / name).digest != file.digest
            except OSError as error:
                if error.errno not in (errno.EIO, errno.ENOENT):
                    raise
                return Damage(f"cannot be read: {error.strerror}", name)
            if changed:
                return Damage("its content has changed since it was stored", name)
    return None


@runtime_checkable
class Examinable(Protocol):
    """Where artefacts lie, as far as their state can be asked for."""

    def read_manifest(self, key: str) -> Manifest | None:
        """Manifest of an artefact, None where there is none; raises for a damaged one."""

    def examine(self, manifest: Manifest) -> Damage | None:
        """What is wrong with an artefact's files."""


def intact_manifest(backend: Examinable, key: str) -> Manifest | None:
    """Manifest of an artefact whose files are all as they were stored, or None."""
    try:
        present = backend.read_manifest(key)
    except DamagedArtefactError:
        return None
    return None if present is None or backend.examine(present) is not None else present


def find_damaged_sizes(sizes: Mapping[str, int], manifest: Manifest) -> Damage | None:
    """Whether number and size of files are those of the manifest; names no file.

    Args:
        sizes: bytes by relative name.
        manifest: of the artefact.
    """
    if _as_counted(sizes, manifest):
        return None
    counted = {name: size for name, size in sizes.items() if name not in NOT_CONTENT}
    return Damage(
        f"{len(counted)} files of {sum(counted.values())} bytes, expected {manifest.files} files of "
        f"{manifest.bytes} bytes"
    )


def _as_counted(sizes: Mapping[str, int], manifest: Manifest) -> bool:
    if not (manifest.files or manifest.bytes or manifest.checksum):
        # An early manifest, without numbers.
        return True
    counted = [size for name, size in sizes.items() if name not in NOT_CONTENT]
    return (len(counted), sum(counted)) == (manifest.files, manifest.bytes)


def _checksums(directory: Path, manifest: Manifest) -> dict[str, _File] | Damage | None:
    """The files of an artefact; None where they were not listed, damage where the list is not its own."""
    if manifest.contents:
        files = {name: _File(*entry) for name, entry in manifest.contents.items()}
        if _summary(files, manifest.run_files) != (manifest.digest, manifest.files, manifest.bytes):
            return Damage("its list of files is not this artefact's", MANIFEST)
        return files
    try:
        read = json.loads((directory / CHECKSUMS).read_bytes())
        files = {name: _File(int(size), str(digest)) for name, (size, digest) in read.items()}
        summary = _summary(files)
    except FileNotFoundError:
        return None
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError):
        return Damage("is not a list of files", CHECKSUMS)
    if summary != (manifest.digest, manifest.files, manifest.bytes):
        return Damage("is not the list of this artefact's files", CHECKSUMS)
    return files


def _other_digest(found: str, manifest: Manifest) -> Damage:
    return Damage(f"its files have digest {found}, expected {manifest.digest}")


def _is_chunk(name: str) -> bool:
    # zarr v3: ARRAY/c/0/0, and ARRAY/c for a scalar.
    return "/c/" in name or name.endswith("/c")


def _summary(files: Mapping[str, _File], run_files: Collection[str] = ()) -> tuple[str, int, int]:
    """Digest of the files without those that tell of the run; number and bytes of all."""
    total = hashlib.blake2b(digest_size=DIGEST_BYTES)
    for name in sorted(set(files).difference(run_files)):
        total.update(f"{name}\0{files[name].digest}\n".encode())
    return total.hexdigest(), len(files), sum(file.size for file in files.values())


def _sizes(directory: Path) -> dict[str, int]:
    """Bytes of each file below a directory, by relative name, without the store's own."""
    found: dict[str, int] = {}
    waiting = [(str(directory), "")]
    while waiting:
        place, prefix = waiting.pop()
        with os.scandir(place) as entries:
            for entry in entries:
                name = prefix + entry.name
                if entry.is_dir(follow_symlinks=False):
                    waiting.append((entry.path, f"{name}/"))
                elif name not in NOT_CONTENT and entry.is_file(follow_symlinks=False):
                    found[name] = entry.stat().st_size
    return found


def _metadata_at(path: Path) -> int:
    """Where the metadata of packed arrays begins; 0 in a file that is none of ours."""
    try:
        with zipfile.ZipFile(path) as file:
            members = [(item.header_offset, item.filename.endswith("zarr.json")) for item in file.infolist()]
    except zipfile.BadZipFile:
        return 0
    begin = min((at for at, is_metadata in members if is_metadata), default=0)
    return begin if all(is_metadata or at < begin for at, is_metadata in members) else 0


def _read(path: Path, begin: int = 0) -> _File:
    """Size and digest of a file, from a byte on."""
    one = hashlib.blake2b(digest_size=DIGEST_BYTES)
    size = 0
    with path.open("rb") as stream:
        stream.seek(begin)
        while block := stream.read(READ_BYTES):
            one.update(block)
            size += len(block)
    return _File(size, one.hexdigest())
