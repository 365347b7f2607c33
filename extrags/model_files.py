"""Folders of pretrained models: their digests, without reading gigabytes, and whether they are whole."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

__all__ = ["files_fingerprint", "fingerprint", "missing_weights"]

EDGE_BYTES = 1 << 20
"""Bytes read at both ends of each file: large weight files hardly change in the middle alone."""


def fingerprint(folder: Path) -> str:
    """Digest of a saved model: names and sizes of its files, small ones whole, weights at both ends.

    This detects that a folder holds another model than when it was looked at before.
    """
    found = {path.relative_to(folder): path for path in folder.rglob("*") if path.is_file()}
    return files_fingerprint(
        {
            name.as_posix(): path
            for name, path in found.items()
            if not any(part.startswith(".") for part in name.parts)
        }
    )


def files_fingerprint(files: Mapping[str, Path]) -> str:
    """As `fingerprint`, of chosen files.

    Args:
        files: by the names that enter the digest; their folders do not.
    """
    digest = hashlib.blake2b(digest_size=16)
    for name, file in sorted(files.items()):
        size = file.stat().st_size
        digest.update(f"{name}\0{size}\0".encode())
        with file.open("rb") as stream:
            digest.update(stream.read(EDGE_BYTES))
            if size > EDGE_BYTES:
                stream.seek(max(EDGE_BYTES, size - EDGE_BYTES))
                digest.update(stream.read(EDGE_BYTES))
    return digest.hexdigest()


def missing_weights(folder: Path, name: str) -> str | None:
    """The first file of a model's weights that is missing; None when all are there.

    Args:
        folder: that should hold them.
        name: of the file; without it `NAME.index.json` lists the files it was cut into.
    """
    if (folder / name).is_file():
        return None
    shards = folder / f"{name}.index.json"
    if not shards.is_file():
        return name
    try:
        names = sorted(set(json.loads(shards.read_text())["weight_map"].values()))
    except (ValueError, KeyError, TypeError, AttributeError):
        return shards.name
    return next((shard for shard in names if not (folder / shard).is_file()), None)
