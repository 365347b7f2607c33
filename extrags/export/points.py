"""The centres of the Gaussians as a point cloud."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from extrags.errors import CaptureError
from extrags.gaussians import SH_C0, Gaussians
from extrags.output_files import whole_file
from extrags.raster.light import shortest_axes

__all__ = ["write_points"]


def write_points(gaussians: Gaussians, path: Path, *, min_opacity: float = 0.5) -> int:
    """Write centres, normals and colours as a binary PLY.

    Normals are the shortest axes; their sign is arbitrary, as that of a flat Gaussian is.

    Args:
        gaussians: with colours, not albedo (`extrags.splat_files.bake_light`).
        path: file to write.
        min_opacity: fainter ones are left out: they lie off the surface more often than on it.

    Returns:
        How many points were written.

    Raises:
        CaptureError: when none is opaque enough.
        NonFiniteError: when a parameter of one that is written is NaN or infinite.
    """
    from plyfile import PlyData, PlyElement

    kept = gaussians.subset(gaussians.opacities.sigmoid() >= min_opacity)
    if not len(kept):
        raise CaptureError(f"no Gaussian has an opacity of {min_opacity:g} or more; there are no points")
    kept = kept.for_file(path)
    rows = np.empty(
        len(kept),
        dtype=[(name, "f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
        + [(name, "u1") for name in ("red", "green", "blue")],
    )
    normals = shortest_axes(kept.quats, kept.scales).numpy()
    colors = np.rint((0.5 + SH_C0 * kept.sh0[:, 0].numpy()).clip(0, 1) * 255)
    for axis, name in enumerate("xyz"):
        rows[name], rows[f"n{name}"] = kept.means.numpy()[:, axis], normals[:, axis]
    for axis, name in enumerate(("red", "green", "blue")):
        rows[name] = colors[:, axis]
    with whole_file(path) as partial:
        PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(partial))
    return len(kept)
