"""The `manifest.json` of an artefact: its provenance, with a checksum of its own."""

from __future__ import annotations

import hashlib
import json
import platform
import re
from functools import cache
from importlib import metadata
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from extrags.store.canonical import DIGEST_BYTES

__all__ = [
    "MANIFEST",
    "Manifest",
    "is_name",
    "manifest_text",
    "parsed_manifest",
    "same_content",
    "software_versions",
    "stage_of",
]

MANIFEST = "manifest.json"
_CLOSE = b"\n}"
_SEAL = b',\n "checksum": "'
_SEALED = b'"\n}'


class Manifest(BaseModel):
    """Provenance of an artefact. Written last: an artefact exists once its manifest does."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    stage: str
    version: int
    key: str
    digest: str
    """Digest over the files (relative names and bytes), without this manifest and the list of checksums."""
    label: str = ""
    """Display name: the sequence it was made for. Not part of the key."""
    place: str = ""
    """Absolute path of a sequence that `label` names by a relative one, where it was made; empty for others,
    and in manifests of earlier versions. Not part of the key."""
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
    contents: dict[str, tuple[int, str] | tuple[int, str, int, str]] = Field(default_factory=dict)
    """Size and digest of each file by relative name; of packed arrays also where their metadata begins, and
    its digest. Earlier artefacts have a file `checksums.json` instead, the first ones nothing."""
    run_files: list[str] = Field(default_factory=list)
    """Names of the files that tell of the run that made the artefact, such as a page with its times. `digest`
    leaves them out: equal inputs give equal digests."""
    data: str = ""
    """On object stores: the prefix, below the artefact's own, that holds the files of this attempt."""
    checksum: str = ""
    """In the file: over the text before it. Manifests from before there were checksums have none."""

    @property
    def elapsed_s(self) -> float:
        """Its share of the time while it was made, where other artefacts were made at the same time.

        Those of earlier versions have no share, and count in full.
        """
        share = self.counts.get("elapsed_s")
        return float(share) if isinstance(share, int | float) else self.seconds


def manifest_text(manifest: Manifest) -> bytes:
    """The JSON of a manifest, closed by a checksum over everything before it."""
    head = manifest.model_dump_json(indent=1, exclude={"checksum"}).encode().removesuffix(_CLOSE)
    return head + _SEAL + _checksum(head) + _SEALED


def parsed_manifest(text: bytes, key: str | None = None) -> Manifest:
    """A manifest from its JSON; those written before there were checksums have none.

    Args:
        text: the file.
        key: of the artefact that it should be of; None for any.

    Raises:
        ValueError: when it is no manifest, or differs from its checksum.
    """
    # The bytes are compared, not the values written again: how numbers are written may change with a library.
    head, seal, tail = text.rpartition(_SEAL)
    if seal and tail != _checksum(head) + _SEALED:
        raise ValueError("its content has changed since it was written")
    try:
        fields = json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if seal:
        # With a valid checksum, an unknown field is no damage but that of a later version.
        fields = {name: value for name, value in fields.items() if name in Manifest.model_fields}
    try:
        manifest = Manifest.model_validate(fields)
    except ValidationError as error:
        fault = error.errors()[0]
        raise ValueError(f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}") from error
    if not is_name(manifest.key) or (manifest.data and not is_name(manifest.data)):
        raise ValueError("its key or data is no name, but a path")
    if key is not None and manifest.key != key:
        raise ValueError(f"it is the manifest of {manifest.key}")
    if manifest.checksum and not seal:
        raise ValueError("its checksum is not where it was written")
    return manifest


def same_content(one: Manifest, other: Manifest) -> bool:
    """Whether two manifests are of the same files with the same bytes."""
    told = [{name: item.contents.get(name) for name in item.run_files} for item in (one, other)]
    return one.digest == other.digest and told[0] == told[1]


def is_name(text: str) -> bool:
    """Whether a text can name one file or folder: nothing that would lead elsewhere."""
    return bool(re.fullmatch(r"[^/\\\0]{1,250}", text)) and text not in (".", "..")


def stage_of(key: str) -> str:
    """The name of the stage in a key."""
    found = re.match(r"(.+)-v\d+-", key)
    return key if found is None else found[1]


def _checksum(text: bytes) -> bytes:
    return hashlib.blake2b(text, digest_size=DIGEST_BYTES).hexdigest().encode()


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
