"""The weights of LPIPS: where they are looked for, how they are read, and their download on request.

Two forms are read. One is an npz file with all arrays of a network
(`extrags.metrics.lpips_networks.array_names`). The other is what a PyTorch installation may have already: the
heads inside an installed package (`lpips`, or `torchmetrics`, which carries the same arrays), and
torchvision's backbone in torch's cache. No package is imported for that, and torchvision is not needed.
"""

from __future__ import annotations

import hashlib
import os
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from extrags.array_files import load_npz, load_state_dict
from extrags.config import LpipsNet
from extrags.data_directories import weights_roots
from extrags.errors import ConfigError, WeightsError, installed_with, reason_of
from extrags.metrics.lpips_networks import LAYERS, array_names, misshapen_array
from extrags.user_paths import expanded

__all__ = [
    "BACKBONES",
    "BACKBONES_URL",
    "WEIGHTS_VARIABLE",
    "absent_parts",
    "check_weights",
    "download_backbone",
    "find_heads",
    "find_weights",
    "read_weights",
]

WEIGHTS_VARIABLE = "EXTRAGS_LPIPS_WEIGHTS"
"""Environment variable: an npz file, or a folder that holds `lpips_<net>_v0.1.npz`."""
BACKBONES: dict[LpipsNet, str] = {
    "alex": "alexnet-owt-7be5be79.pth",
    "vgg": "vgg16-397923af.pth",
    "squeeze": "squeezenet1_1-b8a52dc0.pth",
}
"""Torchvision's files of the backbones; a name ends with the first eight hex digits of the file's SHA-256."""
BACKBONES_URL = "https://download.pytorch.org/models/"
_HEADS = (("lpips", "weights/v0.1"), ("torchmetrics", "functional/image/lpips_models"))
"""Packages that hold the heads of version 0.1, and their folder inside."""
_State = tuple[int, int, int, int, int]
"""Device, inode, size and times of change of content and inode, the latter of which no program sets back."""


def find_weights(explicit: str | None = None, net: LpipsNet = "alex") -> tuple[Path, ...]:
    """The files with LPIPS weights of a backbone: one npz file, or heads and backbone of PyTorch.

    Looks, in this order, at the explicit path, at the environment variable `EXTRAGS_LPIPS_WEIGHTS`
    (each a file, or a folder that holds `lpips_<net>_v0.1.npz`), at `extrags/lpips` in the user's data and
    cache directories (`extrags.data_directories`), and at an installed package's heads together with
    torchvision's backbone in torch's cache. A named path that does not exist is an error; later places are
    then not searched. A file that the variable names serves the backbone it holds; others are looked for in
    the later places.

    Args:
        explicit: path the user named, or None.
        net: backbone.

    Raises:
        WeightsError: when there is none, with the command that helps; or a file is not what its name says.
        ConfigError: for an unknown network.
    """
    if net not in LAYERS:
        raise ConfigError(f"no LPIPS network {net!r}; known: {', '.join(LAYERS)}")
    filename = f"lpips_{net}_v0.1.npz"
    for origin, text in (("the setting", explicit), (WEIGHTS_VARIABLE, os.environ.get(WEIGHTS_VARIABLE))):
        if text:
            file = expanded(text)
            folder = file.is_dir()
            file = file / filename if folder else file
            if not file.is_file():
                raise WeightsError(f"LPIPS weights: {origin} names {file}, which does not exist")
            other = None if folder else _other_network(file, net)
            if other is None:
                return (file,)
            if text == explicit:
                raise WeightsError(
                    f"{file}: not the weights of LPIPS with {net}, but with {other}; name the folder that "
                    "holds both, or ask for one network (evaluate.lpips_nets)"
                )
    folders = weights_roots("lpips")
    for folder_path in folders:
        if (folder_path / filename).is_file():
            return (folder_path / filename,)
    heads, backbone = find_heads(net), _backbone_path(net)
    if heads is not None and backbone.is_file():
        _check_digest(backbone)
        return (heads, backbone)
    raise WeightsError(
        f"no LPIPS weights for {net}; `extrags weights lpips` says which files are missing, and with "
        "--download gets the backbone"
    )


def absent_parts(net: LpipsNet) -> str:
    """What is missing where no weights of a backbone are found, place by place, and how to get it.

    Args:
        net: backbone.

    Returns:
        Empty where weights are in one of the places that are always searched.
    """
    filename = f"lpips_{net}_v0.1.npz"
    heads, backbone = find_heads(net), _backbone_path(net)
    folders = weights_roots("lpips")
    if (heads is not None and backbone.is_file()) or any((folder / filename).is_file() for folder in folders):
        return ""
    parts = [
        *(f"no {folder / filename}" for folder in folders),
        *([] if heads is not None else [f"no package with the heads ({installed_with('lpips')})"]),
        *([] if backbone.is_file() else [f"no {backbone} (extrags weights lpips --download)"]),
    ]
    return (
        f"no LPIPS weights for {net}: there is {' and '.join(parts)}. Get heads and backbone, or convert the "
        "published LPIPS v0.1 weights to npz (features.N.weight, features.N.bias, lin0, lin1, ...) and put "
        f"the file there, or name it, or the folder that holds it, in {WEIGHTS_VARIABLE} or "
        "evaluate.lpips_weights"
    )


def find_heads(net: LpipsNet) -> Path | None:
    """The file of an installed package that holds the heads of a network; the package is not imported."""
    for package, folder in _HEADS:
        spec = find_spec(package)
        for root in (spec.submodule_search_locations or ()) if spec is not None else ():
            file = Path(root, folder, f"{net}.pth")
            if file.is_file():
                return file
    return None


def read_weights(files: tuple[Path, ...], net: LpipsNet) -> dict[str, Tensor]:
    """The arrays of LPIPS with a backbone, float32.

    Args:
        files: what `find_weights` found: an npz file, or the heads and the backbone as PyTorch stores them.
        net: backbone.

    Raises:
        WeightsError: when a file cannot be read, or an array is missing or of another shape.
    """
    said = " and ".join(str(file) for file in files)
    if len(files) == 1:
        try:
            arrays = load_npz(files[0])
            weights = {name: torch.from_numpy(value.astype(np.float32)) for name, value in arrays.items()}
        except (OSError, TypeError, ValueError) as error:
            raise WeightsError(f"{said}: not a readable npz file ({reason_of(error)})") from error
    else:
        heads, backbone = (_state_dict(file) for file in files)
        weights = {name: tensor.float() for name, tensor in backbone.items()}
        # A head is a convolution of one pixel behind a dropout layer.
        suffix = ".model.1.weight"
        weights |= {
            name.removesuffix(suffix): tensor.float().flatten()
            for name, tensor in heads.items()
            if name.endswith(suffix)
        }
    names = array_names(net)
    missing = [name for name in names if name not in weights]
    if missing:
        raise WeightsError(
            f"{said}: not the weights of LPIPS with {net}; {missing[0]} "
            f"and {len(missing) - 1} more arrays are missing"
        )
    wrong = misshapen_array(net, {name: tuple(weights[name].shape) for name in names})
    if wrong is not None:
        raise WeightsError(
            f"{said}: not the weights of LPIPS with {net}; {wrong} has the shape "
            f"{tuple(weights[wrong].shape)}, which does not fit the arrays before it"
        )
    # Torchvision's files hold the classifiers too, most of VGG16's 528 MB.
    return {name: weights[name] for name in names}


def check_weights(files: tuple[Path, ...], net: LpipsNet) -> None:
    """Make sure that weights can be read: a damaged file is there as well as a whole one.

    Files that have not changed are read once: a tenth of a second each.

    Args:
        files: what `find_weights` found.
        net: backbone.

    Raises:
        WeightsError: when a file is damaged, or does not hold this network.
    """
    _check(files, net, tuple(map(_state, files)))


@lru_cache(maxsize=8)
def _check(files: tuple[Path, ...], net: LpipsNet, states: tuple[_State, ...]) -> None:
    """Read weights; what is told of the files is part of the cache's key. What is raised is not kept."""
    read_weights(files, net)


def _state(file: Path) -> _State:
    """What the operating system tells of a file: size and time of change alone survive some copies."""
    found = file.stat()
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns


def download_backbone(net: LpipsNet) -> Path:
    """Download torchvision's backbone into torch's cache, where torchvision itself looks for it.

    The file is kept only if its SHA-256 begins as its name says.

    Args:
        net: backbone.

    Returns:
        The file; one that is there already and has the right digest is not downloaded again.

    Raises:
        WeightsError: when it cannot be downloaded, or the digest is another.
    """
    file = _backbone_path(net)
    if file.is_file():
        _check_digest(file)
        return file
    url = BACKBONES_URL + file.name
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        torch.hub.download_url_to_file(url, str(file), hash_prefix=_digest_prefix(file), progress=False)
    except (OSError, RuntimeError) as error:
        raise WeightsError(f"{url} could not be downloaded to {file}: {reason_of(error)}") from error
    return file


def _backbone_path(net: LpipsNet) -> Path:
    return Path(torch.hub.get_dir(), "checkpoints", BACKBONES[net])


def _digest_prefix(file: Path) -> str:
    return file.stem.rpartition("-")[2]


def _check_digest(file: Path) -> None:
    if not _sha256(file, _state(file)).startswith(_digest_prefix(file)):
        raise WeightsError(
            f"{file}: its SHA-256 does not begin with {_digest_prefix(file)}, as its name says; remove it "
            "and download it again (extrags weights lpips --download)"
        )


@lru_cache(maxsize=8)
def _sha256(file: Path, state: _State) -> str:
    """Digest of a file; what is told of it is part of the cache's key."""
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _state_dict(file: Path) -> dict[str, Tensor]:
    try:
        return load_state_dict(file)
    except (OSError, ValueError) as error:
        raise WeightsError(f"{file}: not a readable file of PyTorch weights ({reason_of(error)})") from error


def _other_network(file: Path, net: LpipsNet) -> LpipsNet | None:
    """The network whose weights an npz file holds, if it is not the one that is looked for."""
    try:
        names = set(load_npz(file))
    except (OSError, ValueError):
        return None  # Reading says what is wrong with it.
    held = [known for known in BACKBONES if names >= set(array_names(known))]
    return None if not held or net in held else held[0]
