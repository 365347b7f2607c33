"""3D Gaussians: their parameters, reading and writing of 3DGS PLY files, and storage in zarr."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from extrags.array_files import load_ply_vertices
from extrags.errors import (
    CaptureError,
    NonFiniteError,
    ShapeError,
    SourceError,
    SourceNotFoundError,
    reason_of,
)
from extrags.output_files import whole_file
from extrags.zarr_io import new_group, open_group, read_array, write_array

__all__ = ["COMPRESSED_PLY", "PACKED_PROPERTY", "SH_C0", "Gaussians"]

SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic."""

PACKED_PROPERTY = "packed_position"
"""By this a compressed PLY is known (`extrags.splat_files.compressed_ply`)."""
COMPRESSED_PLY = "a compressed PLY, which is not read: export the scene as PLY or SPZ"

_HIGHER = (0, 3, 8, 15)
"""SH coefficients above degree 0, by degree: files and kernels know no other."""


@dataclass(frozen=True)
class Gaussians:
    """Parameters of N Gaussians before activation, as 3DGS stores them.

    Args:
        means: centres in world units, [N, 3].
        quats: rotations (w, x, y, z), any length above zero, [N, 4].
        scales: logarithm of the standard deviations, [N, 3].
        opacities: logits, [N].
        sh0: constant SH coefficient per colour, [N, 1, 3].
        shN: higher SH coefficients, [N, K - 1, 3]; K - 1 is 0, 3, 8 or 15, for degrees 0 to 3.

    Raises:
        ShapeError: when the arrays do not describe the same number of Gaussians, or the coefficients no
            degree.
    """

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    opacities: Float[Tensor, "n"]
    sh0: Float[Tensor, "n 1 3"]
    shN: Float[Tensor, "n k 3"]

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        expected = {
            "means": (n, 3),
            "quats": (n, 4),
            "scales": (n, 3),
            "opacities": (n,),
            "sh0": (n, 1, 3),
        }
        for name, shape in expected.items():
            if tuple(getattr(self, name).shape) != shape:
                raise ShapeError(f"{name} has shape {tuple(getattr(self, name).shape)}, expected {shape}")
        if self.shN.ndim != 3 or self.shN.shape[0] != n or self.shN.shape[2] != 3:
            raise ShapeError(f"shN has shape {tuple(self.shN.shape)}, expected ({n}, K - 1, 3)")
        if self.shN.shape[1] not in _HIGHER:
            raise ShapeError(
                f"shN has {self.shN.shape[1]} coefficients per colour; expected 0, 3, 8 or 15, for degrees "
                "0 to 3"
            )

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def __repr__(self) -> str:
        return f"Gaussians({len(self)}, SH degree {self.sh_degree}, on {self.device})"

    @property
    def n_gaussians(self) -> int:
        """Number of Gaussians, N."""
        return len(self)

    @property
    def sh_degree(self) -> int:
        """Degree of the stored spherical harmonics."""
        return math.isqrt(self.shN.shape[1] + 1) - 1

    @property
    def sh(self) -> Float[Tensor, "n k 3"]:
        """All SH coefficients, [N, K, 3]."""
        return torch.cat([self.sh0, self.shN], dim=1)

    def parameters(self) -> dict[str, Tensor]:
        """The parameter tensors by name."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def detached(self) -> Gaussians:
        """A copy without gradient history."""
        return Gaussians(**{k: v.detach().clone() for k, v in self.parameters().items()})

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return self.means.device

    def to(self, device: torch.device | str) -> Gaussians:
        """The same on a device; these very Gaussians where they are there already."""
        if self.device == torch.device(device):
            return self
        return Gaussians(**{k: v.to(device) for k, v in self.parameters().items()})

    def subset(self, index: Int[Tensor, "m"] | Bool[Tensor, "n"]) -> Gaussians:
        """The Gaussians of an index or a mask."""
        return Gaussians(**{k: v[index] for k, v in self.parameters().items()})

    @staticmethod
    def concatenated(first: Gaussians, second: Gaussians) -> Gaussians:
        """Both sets, `first` before `second`."""
        other = second.parameters()
        return Gaussians(**{k: torch.cat([v, other[k]]) for k, v in first.parameters().items()})

    @classmethod
    def from_points(
        cls,
        points: Float[np.ndarray, "n 3"],
        rgb: Float[np.ndarray, "n 3"],
        radius: Float[np.ndarray, "n"],
        *,
        opacity: float = 0.5,
        sh_degree: int = 0,
        normals: Float[np.ndarray, "n 3"] | None = None,
        thickness: float = 1.0,
    ) -> Gaussians:
        """Initialise Gaussians at points: isotropic, or flat discs on the surface where normals are given.

        Args:
            points: centres in world units.
            rgb: colours in [0, 1]; they set the SH coefficients of degree 0.
            radius: standard deviation of each, in world units.
            opacity: the same for all, in (0, 1).
            sh_degree: degree of the SH coefficients; those above degree 0 are zero.
            normals: unit normals of the surface, of either sign; None makes isotropic Gaussians.
            thickness: standard deviation along the normal, as a share of the radius.
        """
        n = len(points)
        quats = torch.zeros(n, 4)
        quats[:, 0] = 1
        scales = torch.tensor(radius, dtype=torch.float32).log()[:, None].repeat(1, 3)
        if normals is not None:
            quats = torch.tensor(_quaternions_from_normals(normals), dtype=torch.float32)
            scales[:, 2] += float(np.log(thickness))
        return cls(
            means=torch.tensor(points, dtype=torch.float32),
            quats=quats,
            scales=scales,
            opacities=torch.full((n,), float(np.log(opacity / (1 - opacity)))),
            sh0=((torch.tensor(rgb, dtype=torch.float32) - 0.5) / SH_C0)[:, None, :],
            shN=torch.zeros(n, (sh_degree + 1) ** 2 - 1, 3),
        )

    def save(self, path: Path) -> None:
        """Write a zarr v3 group, one array per attribute; from any device."""
        with new_group(path) as group:
            for name, value in self.parameters().items():
                write_array(group, name, value.detach().cpu().numpy())

    @classmethod
    def load(cls, path: Path) -> Gaussians:
        """Read what `save` wrote, to the processor."""
        group = open_group(path)
        return cls(**{f.name: torch.from_numpy(read_array(group, f.name)) for f in fields(cls)})

    def for_file(self, path: Path) -> Gaussians:
        """As writers of files take them: on the processor, without gradient history; no copy where they are.

        Args:
            path: file to write, for the error message.

        Raises:
            CaptureError: when there are no Gaussians, which readers of none of the formats expect.
            NonFiniteError: when a parameter is NaN or infinite, which they refuse as well.
        """
        if not len(self):
            raise CaptureError(f"there are no Gaussians to write into {path}")
        for name, value in self.parameters().items():
            wrong = int((~torch.isfinite(value.detach().reshape(len(self), -1))).any(dim=1).sum())
            if wrong:
                raise NonFiniteError(
                    f"{name} of {wrong} of {len(self)} Gaussians hold NaN or infinity; {path} is not written"
                )
        return Gaussians(**{name: value.detach().to("cpu") for name, value in self.parameters().items()})

    def write_ply(self, path: Path, *, comments: Sequence[str] = ()) -> None:
        """Write the PLY format of 3DGS (opens in SuperSplat and brush); from any device.

        Colours are written as stored. In a scene with near-field light they are albedo, so a viewer does not
        show the brightness of the recording unless the light was baked into the colours before.

        Args:
            path: file to write.
            comments: lines of the header, of ASCII.

        Raises:
            CaptureError: when there are no Gaussians.
            NonFiniteError: when a parameter is NaN or infinite.
        """
        from plyfile import PlyData, PlyElement

        n = len(self)
        values = {name: value.numpy() for name, value in self.for_file(path).parameters().items()}
        columns: dict[str, np.ndarray] = {}
        for axis, name in enumerate("xyz"):
            columns[name] = values["means"][:, axis]
        for name in ("nx", "ny", "nz"):
            columns[name] = np.zeros(n, np.float32)
        for axis in range(3):
            columns[f"f_dc_{axis}"] = values["sh0"][:, 0, axis]
        # 3DGS stores the higher coefficients channel by channel.
        rest = values["shN"].transpose(0, 2, 1).reshape(n, -1)
        for k in range(rest.shape[1]):
            columns[f"f_rest_{k}"] = rest[:, k]
        columns["opacity"] = values["opacities"]
        for axis in range(3):
            columns[f"scale_{axis}"] = values["scales"][:, axis]
        for axis in range(4):
            columns[f"rot_{axis}"] = values["quats"][:, axis]
        table = np.empty(n, dtype=[(name, "f4") for name in columns])
        for name, column in columns.items():
            table[name] = column
        with whole_file(path) as partial:
            PlyData([PlyElement.describe(table, "vertex")], comments=comments).write(str(partial))

    @classmethod
    def read_ply(cls, path: Path) -> Gaussians:
        """Read a standard 3DGS PLY.

        Raises:
            SourceNotFoundError: when there is no such file.
            SourceError: when it is damaged, a field is missing, or it is a compressed PLY.
        """
        if not Path(path).exists():
            raise SourceNotFoundError("no such file", file=path)
        try:
            vertex = load_ply_vertices(Path(path))
        except OSError as error:
            raise SourceError(f"cannot be read: {reason_of(error)}", file=path) from error
        except ValueError as error:
            raise SourceError(f"not a 3DGS PLY: {error}", file=path) from error
        names = set(vertex.dtype.names or ())
        if PACKED_PROPERTY in names:
            raise SourceError(COMPRESSED_PLY, file=path, field=PACKED_PROPERTY)
        required = [
            "x",
            "y",
            "z",
            "opacity",
            *(f"f_dc_{i}" for i in range(3)),
            *(f"scale_{i}" for i in range(3)),
            *(f"rot_{i}" for i in range(4)),
        ]
        for name in required:
            if name not in names:
                raise SourceError("not a 3DGS PLY: the property is missing", file=path, field=name)

        def stacked(*columns: str) -> Tensor:
            try:
                table = np.stack([np.asarray(vertex[c], dtype=np.float32) for c in columns], axis=1)
            except (TypeError, ValueError) as error:
                raise SourceError(f"not numbers: {error}", file=path, field=columns[0]) from error
            return torch.from_numpy(table)

        n_rest = sum(name.startswith("f_rest_") for name in names)
        missing = [k for k in range(n_rest) if f"f_rest_{k}" not in names]
        if missing or n_rest not in (0, 9, 24, 45):
            raise SourceError(
                f"{n_rest} properties f_rest_*; expected 0, 9, 24 or 45, counted from 0",
                file=path,
                field=f"f_rest_{missing[0]}" if missing else "f_rest_0",
            )
        rest = (
            stacked(*(f"f_rest_{k}" for k in range(n_rest))).reshape(len(vertex), 3, -1)
            if n_rest
            else torch.zeros(len(vertex), 3, 0)
        )
        return cls(
            means=stacked("x", "y", "z"),
            quats=stacked("rot_0", "rot_1", "rot_2", "rot_3"),
            scales=stacked("scale_0", "scale_1", "scale_2"),
            opacities=stacked("opacity")[:, 0],
            sh0=stacked("f_dc_0", "f_dc_1", "f_dc_2")[:, None, :],
            shN=rest.transpose(1, 2).contiguous(),
        )


def _quaternions_from_normals(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 4"]:
    """Quaternions (w, x, y, z) of the shortest rotations from the z axis to the normals."""
    facing = np.where(normals[:, 2:] < 0, -normals, normals)
    half = np.stack([1 + facing[:, 2], -facing[:, 1], facing[:, 0], np.zeros(len(facing))], axis=1)
    return np.asarray(half / np.linalg.norm(half, axis=1, keepdims=True))
