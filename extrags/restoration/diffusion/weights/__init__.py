"""Pretrained weights of the embedded restorer: those of the package, or a user's own.

Both sets of the package were trained by this project: `colons` on the phantom's family, `cavities` on many
kinds of cavity in tissue of any colour. Their `restorer.json` record the commands, the data and the scores. A
user's own pair of such files is given by its path.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path

from extrags.errors import ConfigError, WeightsError
from extrags.restoration.description import DESCRIPTION
from extrags.user_paths import expanded

__all__ = [
    "BUNDLED",
    "COLONS",
    "NONE",
    "PACKAGED",
    "WEIGHTS",
    "files_digest",
    "find_weights",
    "starting_weights",
    "weights_digest",
]

BUNDLED = "bundled"
"""Setting: the weights of the package, of which each scene takes those that know it."""
COLONS = "colons"
PACKAGED = (COLONS, "cavities")
"""Settings: one set of the package's weights, whatever the scene."""
NONE = "none"
"""Setting: no weights; the restorer of a scene is trained from random ones."""
WEIGHTS = "restorer.safetensors"


def find_weights(setting: str) -> tuple[Path, ...]:
    """Files of the weights that a scene's restorer may start from.

    Args:
        setting: `bundled`, one of `PACKAGED`, `none`, or the path of a .safetensors file with its .json
            beside it, or of a folder that holds `restorer.safetensors` and `restorer.json` (a saved restorer
            is one: its weights count, and nothing that it was told of its scene).

    Returns:
        The .safetensors files, the description of each beside it with the suffix .json: all that the package
        has for `bundled`, the first preferred; one for other weights; none for `none`.

    Raises:
        WeightsError: when a file is missing or another kind is named; says what to do.
    """
    if setting == NONE:
        return ()
    if setting == BUNDLED:
        return tuple(_find_one(name) for name in PACKAGED)
    return (_find_one(setting),)


def _find_one(setting: str) -> Path:
    if setting in PACKAGED:
        weights = Path(str(files(__name__))) / setting / WEIGHTS
        cure = f"this installation is incomplete: reinstall extrags, or set enhance.pretrained_weights={NONE}"
    else:
        given = expanded(setting)
        weights = given / WEIGHTS if given.is_dir() else given
        cure = (
            "expected a .safetensors file with its .json beside it, or a folder that holds "
            f"{WEIGHTS} and {DESCRIPTION}; {BUNDLED} takes the weights of the package, "
            f"{' or '.join(PACKAGED)} one set of them, {NONE} trains from nothing"
        )
    for file in (weights, weights.with_suffix(".json")):
        if not file.is_file():
            raise WeightsError(f"enhance.pretrained_weights={setting}: there is no file {file}; {cure}")
    if weights.suffix != ".safetensors":
        raise WeightsError(f"enhance.pretrained_weights={setting}: {weights} is no .safetensors file; {cure}")
    return weights


def starting_weights(setting: str) -> Path:
    """File of the one set of weights that a training begins with.

    Args:
        setting: as `find_weights`.

    Raises:
        WeightsError: as `find_weights`.
        ConfigError: when there is none, or a choice of several.
    """
    found = find_weights(setting)
    if len(found) != 1:
        raise ConfigError(f"{setting}: expected one set of weights: {', '.join(PACKAGED)}, or a folder")
    return found[0]


def weights_digest(setting: str) -> str | None:
    """Digest of weights and description, independent of their path; None without weights.

    Raises:
        WeightsError: as `find_weights`.
    """
    found = find_weights(setting)
    files = [file for weights in found for file in (weights, weights.with_suffix(".json"))]
    return files_digest(files) if files else None


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
