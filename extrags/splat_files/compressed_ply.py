"""Compressed PLY of PlayCanvas: four 32-bit words per Gaussian, in chunks of 256 with bounds of their own.

Elements: `chunk` (bounds of positions, logarithmic scales and colours), `vertex` (packed_position 11-10-11
bits, packed_rotation 2-10-10-10, packed_scale 11-10-11, packed_color 8-8-8-8 with opacity last) and, above SH
degree 0, `sh` (8 bits per coefficient, channel by channel, over [-4, 4]).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt32

from extrags.gaussians import SH_C0, Gaussians
from extrags.output_files import whole_file
from extrags.splat_files.packing import (
    SCALE_LIMIT,
    largest_component,
    levels,
    neighbours_together,
    unit_quaternions,
)

__all__ = ["write_compressed_ply"]

_CHUNK = 256


def write_compressed_ply(gaussians: Gaussians, path: Path) -> None:
    """Write a compressed PLY; Gaussians are reordered along a space-filling curve.

    Args:
        gaussians: with colours, not albedo (`bake_light`).
        path: file to write; viewers expect it to end in `.ply`.

    Raises:
        CaptureError: when there are no Gaussians.
    """
    from plyfile import PlyData, PlyElement

    n = len(gaussians)
    gaussians = neighbours_together(gaussians.for_file(path))
    means = gaussians.means.double().numpy()
    scales = gaussians.scales.double().numpy().clip(-SCALE_LIMIT, SCALE_LIMIT)
    colors = 0.5 + SH_C0 * gaussians.sh0[:, 0].double().numpy()
    opacity = gaussians.opacities.sigmoid().double().numpy()
    columns: dict[str, np.ndarray] = {}
    shares = {}
    for values, axes, short in (
        (means, ("x", "y", "z"), "position"),
        (scales, ("scale_x", "scale_y", "scale_z"), "scale"),
        (colors, ("r", "g", "b"), "color"),
    ):
        low, high = _chunk_bounds(values)
        shares[short] = _share(values, low, high)
        for axis, name in enumerate(axes):
            columns[f"min_{name}"], columns[f"max_{name}"] = low[:, axis], high[:, axis]
    names = [
        f"{bound}_{part}{axis}"
        for part, letters in (("", "xyz"), ("scale_", "xyz"), ("", "rgb"))
        for bound in ("min", "max")
        for axis in letters
    ]
    chunk = np.empty(-(-n // _CHUNK), dtype=[(name, "f4") for name in names])
    for name in names:
        chunk[name] = columns[name]
    vertex = np.empty(
        n, dtype=[(f"packed_{part}", "u4") for part in ("position", "rotation", "scale", "color")]
    )
    vertex["packed_position"] = _packed(shares["position"], (11, 10, 11))
    vertex["packed_scale"] = _packed(shares["scale"], (11, 10, 11))
    vertex["packed_color"] = _packed(np.column_stack([shares["color"], opacity]), (8, 8, 8, 8))
    largest, rest = largest_component(unit_quaternions(gaussians.quats.numpy()))
    rotation = _packed(rest * np.sqrt(0.5) + 0.5, (10, 10, 10))
    vertex["packed_rotation"] = rotation | largest.astype(np.uint32) << 30
    elements = [PlyElement.describe(chunk, "chunk"), PlyElement.describe(vertex, "vertex")]
    if gaussians.shN.shape[1]:
        rest_n = gaussians.shN.numpy().transpose(0, 2, 1).reshape(n, -1)
        sh = np.empty(n, dtype=[(f"f_rest_{k}", "u1") for k in range(rest_n.shape[1])])
        for k in range(rest_n.shape[1]):
            sh[f"f_rest_{k}"] = np.floor((rest_n[:, k] / 8 + 0.5) * 256).clip(0, 255)
        elements.append(PlyElement.describe(sh, "sh"))
    with whole_file(path) as partial:
        PlyData(elements, byte_order="<").write(str(partial))


def _chunk_bounds(values: Float[np.ndarray, "n k"]) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of each chunk as float32 that enclose the values."""
    starts = np.arange(0, len(values), _CHUNK)
    return (
        np.minimum.reduceat(values, starts, axis=0).astype(np.float32),
        np.maximum.reduceat(values, starts, axis=0).astype(np.float32),
    )


def _share(
    values: Float[np.ndarray, "n k"], low: Float[np.ndarray, "c k"], high: Float[np.ndarray, "c k"]
) -> Float[np.ndarray, "n k"]:
    """Where values lie between the bounds of their chunk; 0 where these coincide."""
    owner = np.arange(len(values)) // _CHUNK
    low, width = low.astype(np.float64), (high - low).astype(np.float64)
    return np.asarray((values - low[owner]) / np.where(width > 0, width, 1.0)[owner])


def _packed(shares: Float[np.ndarray, "n k"], bits: tuple[int, ...]) -> UInt32[np.ndarray, "n"]:
    """Numbers in [0, 1] side by side in one word, the first in its highest bits."""
    word = np.zeros(len(shares), dtype=np.uint32)
    for column, width in enumerate(bits):
        word = word << np.uint32(width) | levels(shares[:, column], width)
    return word
