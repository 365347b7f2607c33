"""Folders of pretrained models: digests of their content, and whether they are whole."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

from extrags.file_digests import size_and_digest

__all__ = ["files_fingerprint", "fingerprint", "lacking_weights"]


def fingerprint(folder: Path) -> str:
    """Digest of a saved model: names and whole content of its files, hidden ones left out.

    This detects that a folder holds another model than when it was looked at before. Files that do not change
    are read once in a process (`size_and_digest`).

    Raises:
        OSError: when a file cannot be read.
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

    Raises:
        OSError: when a file cannot be read.
    """
    digest = hashlib.blake2b(digest_size=16)
    for name, file in sorted(files.items()):
        size, content = size_and_digest(file)
        digest.update(f"{name}\0{size}\0{content}\0".encode())
    return digest.hexdigest()


def lacking_weights(folder: Path, name: str) -> str | None:
    """What a model's weights lack, "FILE is missing" for instance; None when all are there and whole.

    Args:
        folder: that should hold them.
        name: of the file; without it `NAME.index.json` lists the files it was cut into.
    """
    names = [name]
    if not (folder / name).is_file():
        shards = folder / f"{name}.index.json"
        if not shards.is_file():
            return f"{name} is missing"
        try:
            names = sorted(set(json.loads(shards.read_text())["weight_map"].values()))
        except (ValueError, KeyError, TypeError, AttributeError):
            return f"{shards.name} is damaged"
    for each in names:
        if not (folder / each).is_file():
            return f"{each} is missing"
        if not _is_whole(folder / each):
            return f"{each} is cut short or no safetensors file"
    return None


def _is_whole(file: Path) -> bool:
    """Whether a safetensors file is as long as its header says; its tensors are not read."""
    size = file.stat().st_size
    with file.open("rb") as stream:
        length = int.from_bytes(stream.read(8), "little")
        if size < 8 or length > size - 8:
            return False
        try:
            header = json.loads(stream.read(length))
            ends = [entry["data_offsets"][1] for name, entry in header.items() if name != "__metadata__"]
            return size == 8 + length + max(ends, default=0)
        except (ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError):
            return False
