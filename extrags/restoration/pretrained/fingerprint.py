"""Digests of model files, without reading gigabytes."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

__all__ = ["files_fingerprint", "fingerprint"]

EDGE_BYTES = 1 << 20
"""Bytes read at both ends of each file: large weight files hardly change in the middle alone."""


def fingerprint(folder: Path) -> str:
    """Digest of a saved pipeline: names and sizes of its files, small ones whole, weights at both ends.

    This detects that a folder holds another model than when its restorer was prepared.
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
