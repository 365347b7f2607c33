r"""Error of views off the trajectory, and how much of it a virtual view takes away.

*Probes* are views that a user might look from: training views, shifted and turned at random inside free
space. Each *row*, a Gaussian j or a frontier voxel f behind a hole, has in a probe p a size of S_p pixels:
the sum of its blending weights, or the number of empty pixels whose rays leave free space through the voxel.
What a view shows of a row is good enough from a share rho of that size on: surface that training showed with
fewer pixels than a view off the trajectory has of it is what the reconstruction is wrong about. From how many
directions it was seen says nothing about that (docs/experiments/exploration.md has the measurement).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from extrags.cameras import Cameras, rotation_about
from extrags.config import ExploreConfig
from extrags.exploration.frontier import Frontier
from extrags.exploration.seen import ErrorValue, Seen
from extrags.freespace import FREE, FreeSpace
from extrags.raster import Rendering

__all__ = ["CLEARANCE_ROUNDING", "SizeModel", "Sizes", "measure_sizes", "probe_cameras", "sizes_in"]

SMALLEST_SIZE_PX = 0.05
"""A Gaussian with fewer pixels in a view does not count as shown by it."""
CLEARANCE_ROUNDING = 1e-5
"""Share by which a clearance may fall short: it is of single precision, and interpolated."""
SHORTEST_SHIFT = 0.02
"""Probes are shifted by at least this share of the depth unit, or turned in place."""


@dataclass(frozen=True, slots=True)
class Sizes:
    """How many pixels of a view each row has: N Gaussians, then F frontier voxels.

    Args:
        row: rising, [M].
        size_px: [M].
    """

    row: Int[np.ndarray, "m"]
    size_px: Float[np.ndarray, "m"]


@dataclass(frozen=True)
class SizeModel:
    """How large rows are in views off the trajectory, and what is wrong with them there.

    Args:
        size_px: size of each row in the probes that show it, weighted by that size; 0 where none does, [R].
        value: error that is gone once a row is seen well.
        sufficient: rho.
    """

    size_px: Float[np.ndarray, "r"]
    value: ErrorValue
    sufficient: float

    def seen(self, sizes: Sizes) -> Seen:
        """Level at which a view shows each row, 1 for well enough; rows that no probe shows are left out."""
        needed = self.size_px[sizes.row]
        counts = needed > 0
        level = np.minimum(1.0, sizes.size_px[counts] / (self.sufficient * needed[counts]))
        return Seen(sizes.row[counts], level.astype(np.float32))


def probe_cameras(
    cameras: Cameras, freespace: FreeSpace, depth_unit_mm: float, margin_mm: float, config: ExploreConfig
) -> Cameras:
    """Views off the trajectory: training views, shifted and turned at random inside free space.

    The shift is uniform up to `probe_shift` depth units in any direction, halved until the straight way there
    is free and its end has the clearance of a virtual camera (or that of the training view, where it is
    nearer to the wall). The turn is uniform up to `probe_turn_deg` about any axis.

    Args:
        cameras: the training views at the size probes shall have.
        freespace: where cameras may go.
        depth_unit_mm: median rendered depth of the training views.
        margin_mm: clearance of virtual cameras.
        config: number, shift, turn and seed of the probes.
    """
    generator = np.random.default_rng(config.seed)
    count = config.probe_views
    which = np.arange(count) * len(cameras) // count
    poses = cameras.world_from_camera[which].copy()
    needed = np.minimum(margin_mm, freespace.clearance_at(poses[:, :3, 3])) * (1 - CLEARANCE_ROUNDING)
    for index in range(count):
        axis, side = _directions(generator)
        turn, shift = np.radians(config.probe_turn_deg) * generator.uniform(), generator.uniform()
        poses[index, :3, :3] = poses[index, :3, :3] @ rotation_about(axis, turn)
        # In the camera's own frame, so that nothing depends on how the world is turned.
        side = cameras.world_from_camera[which[index], :3, :3] @ side
        start, length = poses[index, :3, 3].copy(), shift * config.probe_shift * depth_unit_mm
        while length > SHORTEST_SHIFT * depth_unit_mm:
            center = start + length * side
            if (
                freespace.lookup(center) == FREE
                and freespace.clearance_at(center[None])[0] >= needed[index]
                and freespace.segment_is_free(start, center)
            ):
                poses[index, :3, 3] = center
                break
            length /= 2
    return Cameras(cameras.K[which], poses, cameras.width, cameras.height)


def _directions(generator: np.random.Generator) -> Float[np.ndarray, "2 3"]:
    directions = generator.normal(size=(2, 3))
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def sizes_in(
    rendering: Rendering, cameras: Cameras, frontier: Frontier, holes: Bool[np.ndarray, "c h w"]
) -> list[Sizes]:
    """Sizes of all rows in rendered views.

    Args:
        rendering: of the views, with `visibility`.
        cameras: the views.
        frontier: where views through holes leave free space.
        holes: pixels without a surface.
    """
    assert rendering.visibility_sum is not None
    sums = rendering.visibility_sum.numpy()
    found = []
    for index in range(len(cameras)):
        gaussians = np.flatnonzero(sums[index] > SMALLEST_SIZE_PX).astype(np.int32)
        voxels, pixels = frontier.counts(cameras[index], holes[index])
        found.append(
            Sizes(
                np.concatenate([gaussians, voxels.astype(np.int32) + np.int32(sums.shape[1])]),
                np.concatenate([sums[index, gaussians], pixels.astype(np.float32)]),
            )
        )
    return found


def measure_sizes(
    probes: Sequence[Sizes], n_gaussians: int, n_frontier: int, pixels: int, config: ExploreConfig
) -> SizeModel:
    r"""The size model from what the probes show.

    .. math:: m_e = \frac{1}{P} \sum_p S_p(e), \quad
        S_e = \frac{\sum_p S_p(e)^2}{\sum_p S_p(e)}, \quad \epsilon_e = c_e \, m_e / \text{pixels}

    with c the error per pixel that is gone once the row is seen well: `hole_error` behind holes,
    `unresolved_error` elsewhere.

    Args:
        probes: sizes in each of the P probes.
        n_gaussians: N.
        n_frontier: F.
        pixels: of a probe.
        config: the errors, and the share of the size that is enough.
    """
    first, second = np.zeros(n_gaussians + n_frontier), np.zeros(n_gaussians + n_frontier)
    for probe in probes:
        first[probe.row] += probe.size_px
        second[probe.row] += probe.size_px.astype(np.float64) ** 2
    error = first / max(1, len(probes)) / pixels
    error[:n_gaussians] *= config.unresolved_error
    error[n_gaussians:] *= config.hole_error
    size = np.where(first > 0, second / np.maximum(first, 1e-12), 0.0)
    value = ErrorValue(error.astype(np.float32))
    return SizeModel(size.astype(np.float32), value, config.sufficient_resolution)
