"""The `manifest.json` of an artefact, and the digest over its files."""

from __future__ import annotations

import hashlib
import platform
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from extrags.store.canonical import DIGEST_BYTES

__all__ = ["MANIFEST", "Manifest", "content_digest", "software_versions"]

MANIFEST = "manifest.json"
READ_BYTES = 1 << 20


class Manifest(BaseModel):
    """Provenance of an artefact. Written last: an artefact exists once its manifest does."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    stage: str
    version: int
    key: str
    digest: str
    """Digest over the files (relative names and bytes) without this manifest."""
    label: str = ""
    """Display name: the sequence it was made for. Not part of the key."""
    config: dict[str, Any] = Field(default_factory=dict)
    """The stage's settings and other plain inputs."""
    inputs: dict[str, str] = Field(default_factory=dict)
    """Digests of the input artefacts, by name."""
    input_keys: dict[str, str] = Field(default_factory=dict)
    """Keys of the input artefacts, by name, to trace the lineage."""
    software: dict[str, str] = Field(default_factory=dict)
    started: str = ""
    """UTC, ISO 8601."""
    seconds: float = 0.0
    counts: dict[str, float | int | str | None] = Field(default_factory=dict)
    """Summary of the content: numbers of frames, Gaussians, ..."""
    files: int = 0
    bytes: int = 0
    data: str = ""
    """On object stores: the prefix, below the artefact's own, that holds the files of this attempt."""


def content_digest(directory: Path) -> tuple[str, int, int]:
    """Digest, number of files and bytes below a directory; `manifest.json` at its top is left out.

    Two artefacts with equal digests hold the same files with the same bytes.
    """
    total = hashlib.blake2b(digest_size=DIGEST_BYTES)
    files = 0
    size = 0
    for name, path in sorted((path.relative_to(directory).as_posix(), path) for path in directory.rglob("*")):
        if name == MANIFEST or not path.is_file():
            continue
        one = hashlib.blake2b(digest_size=DIGEST_BYTES)
        with path.open("rb") as stream:
            while block := stream.read(READ_BYTES):
                one.update(block)
                size += len(block)
        total.update(f"{name}\0{one.hexdigest()}\n".encode())
        files += 1
    return total.hexdigest(), files, size


@cache
def software_versions() -> dict[str, str]:
    """Versions of the software that results depend on."""
    versions = {"python": platform.python_version()}
    for package in ("extrags", "numpy", "torch", "zarr", "open3d-cpu", "pycolmap", "prefect"):
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            # A source checkout without installation, or an optional package: nothing to record.
            continue
    return versions
