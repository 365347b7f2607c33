"""Gaussians that another program made, whatever the format."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch

from extrags.errors import SourceError, SourceNotFoundError, reason_of
from extrags.gaussians import COMPRESSED_PLY, PACKED_PROPERTY
from extrags.scene import Scene
from extrags.splat_files.ply import read_ply_scene
from extrags.splat_files.spz import read_spz

__all__ = ["read_splat_file", "splat_format"]

_HEADER_BYTES = 1 << 16


def splat_format(path: Path) -> Literal["ply", "spz"]:
    """The format of a file of Gaussians by its content, without reading all of it.

    Raises:
        SourceNotFoundError: when there is no such file.
        SourceError: when it is of neither format, or a PLY of something else; names those that are written
            here and not read.
    """
    path = Path(path)
    if not path.is_file():
        raise SourceNotFoundError("no such file", file=path)
    try:
        with path.open("rb") as stream:
            start = stream.read(_HEADER_BYTES)
    except OSError as error:
        raise SourceError(f"cannot be read: {reason_of(error)}", file=path) from error
    if start[:2] == b"\x1f\x8b" or start[:4] == b"NGSP":
        return "spz"
    if start[:3] == b"ply":
        header, end, _ = start.partition(b"end_header")
        if f" {PACKED_PROPERTY}".encode() in header:
            raise SourceError(COMPRESSED_PLY, file=path, field=PACKED_PROPERTY)
        if end and b" opacity" not in header:
            raise SourceError(
                "not a 3DGS PLY: the property is missing, as in meshes and clouds of points",
                file=path,
                field="opacity",
            )
        return "ply"
    if start[:4] == b"PK\x03\x04":
        raise SourceError(
            "a zip archive, as SOG files are: neither is read; export the scene as PLY or SPZ", file=path
        )
    raise SourceError("neither PLY nor SPZ, by its first bytes", file=path)


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
    scene = Scene(read_spz(path)) if splat_format(path) == "spz" else read_ply_scene(path)
    if not len(scene.gaussians):
        raise SourceError("it holds no Gaussians", file=path)
    for name, values in scene.gaussians.parameters().items():
        wrong = int((~torch.isfinite(values.flatten(1) if values.ndim > 1 else values[:, None])).any(1).sum())
        if wrong:
            raise SourceError(f"{wrong} Gaussians hold NaN or infinity", file=path, field=name)
    if bool((scene.gaussians.quats.norm(dim=1) == 0).any()):
        raise SourceError("rotations of length zero", file=path, field="quats")
    return scene
