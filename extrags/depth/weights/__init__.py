"""Weights of the depth completion: those of the package, trained by this project, or a user's own.

The same network with other weights reads the depth of what restored views have invented. `completion.json`
and `hidden.json` beside this file say how they were made and how they score.
"""

from __future__ import annotations

import hashlib
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from extrags.array_files import load_safetensors
from extrags.errors import WeightsError, reason_of
from extrags.user_paths import expanded

if TYPE_CHECKING:
    # What computes is imported on first use: digests are asked for whenever an artefact is looked up.
    from extrags.depth.completion import CompletionNetwork

__all__ = [
    "BUNDLED",
    "HIDDEN",
    "NONE",
    "completion_digest",
    "find_completion",
    "hidden_digest",
    "load_completion",
    "load_hidden",
]

BUNDLED = "bundled"
"""Setting: the weights of the package."""
NONE = "none"
"""Setting: no network; the depth is that of stereo."""
HIDDEN = "hidden"
"""Name of the files of the weights that read hidden depth."""


def find_completion(setting: str) -> Path | None:
    """File of the weights; None for `none`.

    Raises:
        WeightsError: when there is no such file.
    """
    if setting == NONE:
        return None
    bundled = setting == BUNDLED
    file = Path(str(files(__name__))) / "completion.safetensors" if bundled else expanded(setting)
    if not file.is_file() or file.suffix != ".safetensors":
        raise WeightsError(
            f"depth.completion={setting}: there is no .safetensors file {file}; {BUNDLED} takes those of "
            f"the package, {NONE} leaves stereo as it is"
        )
    return file


def completion_digest(setting: str) -> str | None:
    """Digest of the weights, independent of their path; None without.

    Raises:
        WeightsError: as `find_completion`.
    """
    file = find_completion(setting)
    return None if file is None else hashlib.blake2b(file.read_bytes(), digest_size=16).hexdigest()


def load_completion(setting: str) -> CompletionNetwork | None:
    """The network with its weights, ready to use; None for `none`.

    Raises:
        WeightsError: when there is no such file, or it holds another network.
    """
    file = find_completion(setting)
    return None if file is None else _network(file, f"depth.completion={setting}")


def hidden_digest() -> str:
    """Digest of the weights that read hidden depth.

    Raises:
        WeightsError: when the installation is incomplete.
    """
    return hashlib.blake2b(_hidden_file().read_bytes(), digest_size=16).hexdigest()


def load_hidden() -> CompletionNetwork:
    """The network that reads the depth of what restored views have invented, ready to use.

    Raises:
        WeightsError: when the installation is incomplete.
    """
    return _network(_hidden_file(), "depth in holes")


def _hidden_file() -> Path:
    file = Path(str(files(__name__))) / f"{HIDDEN}.safetensors"
    if not file.is_file():
        raise WeightsError(f"there is no file {file}: this installation is incomplete, reinstall extrags")
    return file


def _network(file: Path, wanted_for: str) -> CompletionNetwork:
    from extrags.depth.completion import CompletionNetwork

    network = CompletionNetwork()
    try:
        network.load_state_dict({name: value.float() for name, value in load_safetensors(file).items()})
    except (OSError, RuntimeError, ValueError) as error:
        raise WeightsError(f"{wanted_for}: {file} is not a completion network: {reason_of(error)}") from error
    return network.eval()
