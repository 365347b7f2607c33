"""Whether the files of an artefact are still those that were stored.

`checksums.json`, beside the manifest, holds size and digest of every file. It needs no checksum of its own:
the artefact's digest is computed from it. Number and size of files are compared on every access, contents
once per process and artefact (`Depth`).
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, Protocol, runtime_checkable

from extrags.errors import ConfigError, DamagedArtefactError
from extrags.store.canonical import DIGEST_BYTES
from extrags.store.manifest import MANIFEST, Manifest

__all__ = [
    "CHECKSUMS",
    "VERIFY_VARIABLE",
    "Damage",
    "Depth",
    "content_digest",
    "default_depth",
    "find_damage",
    "find_damaged_sizes",
    "intact_manifest",
    "write_checksums",
]

CHECKSUMS = "checksums.json"
"""Sizes and digests of an artefact's files, by relative name."""
NOT_CONTENT = frozenset({MANIFEST, CHECKSUMS})
"""Files at the top of an artefact that its digest does not cover."""
READ_BYTES = 1 << 20

VERIFY_VARIABLE = "EXTRAGS_VERIFY"
"""Environment variable: which contents are compared when a process opens an artefact for the first time."""

Depth = Literal["sizes", "metadata", "all"]
"""What is compared: number and size of files; also the contents of all files except chunks of arrays, whose
own checksums are compared when they are read; the contents of all files."""


@dataclass(frozen=True)
class Damage:
    """What is wrong with an artefact."""

    problem: str
    file: str = ""
    """Relative name; empty where the artefact has no list of files."""


class _File(NamedTuple):
    size: int
    digest: str


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


def write_checksums(directory: Path) -> tuple[str, int, int]:
    """Write `checksums.json`; returns what `content_digest` does."""
    files = {name: _read(directory / name) for name in sorted(_sizes(directory))}
    (directory / CHECKSUMS).write_text(json.dumps(files), encoding="utf-8")
    return _summary(files)


def find_damage(directory: Path, manifest: Manifest, depth: Depth) -> Damage | None:
    """The first thing that is wrong with the files of an artefact, or None.

    Args:
        directory: its files.
        manifest: its manifest.
        depth: what is compared.

    Raises:
        OSError: when a file cannot be read for a reason that is no damage, such as permissions.
    """
    sizes = _sizes(directory)
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
        found = _summary({name: _read(directory / name) for name in sizes})[0]
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
    """What `checksums.json` holds; None without one, damage where it is not that of the manifest."""
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


def _summary(files: Mapping[str, _File]) -> tuple[str, int, int]:
    total = hashlib.blake2b(digest_size=DIGEST_BYTES)
    for name in sorted(files):
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


def _read(path: Path) -> _File:
    one = hashlib.blake2b(digest_size=DIGEST_BYTES)
    size = 0
    with path.open("rb") as stream:
        while block := stream.read(READ_BYTES):
            one.update(block)
            size += len(block)
    return _File(size, one.hexdigest())
