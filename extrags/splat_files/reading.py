"""Gaussians that another program made, whatever the format."""

from __future__ import annotations

from pathlib import Path

import torch

from extrags.errors import SourceError, SourceNotFoundError
from extrags.scene import Scene
from extrags.splat_files.ply import read_ply_scene
from extrags.splat_files.spz import read_spz

__all__ = ["read_splat_file"]


def read_splat_file(path: Path) -> Scene:
    """Read a 3DGS PLY or an SPZ file; its content tells which.

    A scene of another program has no light: its colours hold the brightness of its recording. Only a PLY
    that `write_ply_scene` wrote brings one. Gaussians with numbers that are not finite are refused, since
    every later stage would fail on them without saying where.

    Raises:
        SourceNotFoundError: when there is no such file.
        SourceError: when it is neither, is damaged, or holds no Gaussians or not finite ones.
    """
    path = Path(path)
    if not path.is_file():
        raise SourceNotFoundError("no such file", file=path)
    with path.open("rb") as stream:
        start = stream.read(4)
    if start[:2] == b"\x1f\x8b" or start == b"NGSP":
        scene = Scene(read_spz(path))
    elif start[:3] == b"ply":
        scene = read_ply_scene(path)
    else:
        raise SourceError("neither PLY nor SPZ, by its first bytes", file=path)
    if not len(scene.gaussians):
        raise SourceError("it holds no Gaussians", file=path)
    for name, values in scene.gaussians.parameters().items():
        wrong = int((~torch.isfinite(values.flatten(1) if values.ndim > 1 else values[:, None])).any(1).sum())
        if wrong:
            raise SourceError(f"{wrong} Gaussians hold NaN or infinity", file=path, field=name)
    if bool((scene.gaussians.quats.norm(dim=1) == 0).any()):
        raise SourceError("rotations of length zero", file=path, field="quats")
    return scene
