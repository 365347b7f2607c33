"""Pretrained weights of the embedded restorer: those of the package, or a user's own.

`restorer.safetensors` beside this file was trained by this project; `restorer.json` records the command,
the data and the scores. A user's own pair of such files is given by its path.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path

from extrags.errors import WeightsError
from extrags.restoration.description import DESCRIPTION
from extrags.user_paths import expanded

__all__ = ["BUNDLED", "NONE", "WEIGHTS", "files_digest", "find_weights", "weights_digest"]

BUNDLED = "bundled"
"""Setting: the weights of the package."""
NONE = "none"
"""Setting: no weights; the restorer of a scene is trained from random ones."""
WEIGHTS = "restorer.safetensors"


def find_weights(setting: str) -> Path | None:
    """File of the weights that a scene's restorer starts from.

    Args:
        setting: `bundled`, `none`, or the path of a .safetensors file with its .json beside it, or of a
            folder that holds `restorer.safetensors` and `restorer.json` (a saved restorer is one).

    Returns:
        The .safetensors file, its description beside it with the suffix .json; None for `none`.

    Raises:
        WeightsError: when a file is missing or another kind is named; says what to do.
    """
    if setting == NONE:
        return None
    if setting == BUNDLED:
        weights = Path(str(files(__name__))) / WEIGHTS
        cure = f"this installation is incomplete: reinstall extrags, or set enhance.pretrained_weights={NONE}"
    else:
        given = expanded(setting)
        weights = given / WEIGHTS if given.is_dir() else given
        cure = (
            "expected a .safetensors file with its .json beside it, or a folder that holds "
            f"{WEIGHTS} and {DESCRIPTION}; {BUNDLED} takes the weights of the package, {NONE} trains from "
            "nothing"
        )
    for file in (weights, weights.with_suffix(".json")):
        if not file.is_file():
            raise WeightsError(f"enhance.pretrained_weights={setting}: there is no file {file}; {cure}")
    if weights.suffix != ".safetensors":
        raise WeightsError(f"enhance.pretrained_weights={setting}: {weights} is no .safetensors file; {cure}")
    return weights


def weights_digest(setting: str) -> str | None:
    """Digest of weights and description, independent of their path; None without weights.

    Raises:
        WeightsError: as `find_weights`.
    """
    weights = find_weights(setting)
    if weights is None:
        return None
    return files_digest((weights, weights.with_suffix(".json")))


def files_digest(files: Iterable[Path]) -> str:
    """Digest of the content of files, one after the other."""
    digest = hashlib.blake2b(digest_size=16)
    for file in files:
        # The length first: no byte can move from one file to the other unnoticed.
        digest.update(f"{file.stat().st_size}\0".encode())
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()
