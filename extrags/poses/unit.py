"""What a unit of COLMAP's poses is, from depth or from the working distance."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from extrags.config import PosesConfig
from extrags.poses.job import PoseJobResult
from extrags.poses.scale import DENSE_SHARE, depth_scale, typical_depth, working_distance_scale
from extrags.sequence import EndoscopicSequence, ScaleSource

__all__ = ["PoseUnit", "unit_of_map"]


@dataclass(frozen=True)
class PoseUnit:
    """What a unit of the map is.

    Args:
        length: of it, in the unit that poses and points are brought to; None leaves them as they are.
        scale_source: what makes that unit the millimetre, if anything does.
        depth_factor: from the unit of the sequence's own depth to that unit; None where it is not known.
        truth_per_unit: from the unit that poses are brought to, to that of withheld true depth; None without
            such, where it is not known, and where both are the millimetre.
        report: numbers on it, ready for JSON; None where nothing makes it metric.
    """

    length: float | None = None
    scale_source: ScaleSource = "source"
    depth_factor: float | None = 1.0
    truth_per_unit: float | None = None
    report: dict[str, Any] | None = None

    @property
    def metric(self) -> bool:
        """Whether poses and points are brought to millimetres."""
        return self.scale_source != "source"


def unit_of_map(
    sequence: EndoscopicSequence,
    poses: Float[np.ndarray, "f 4 4"],
    registered: Bool[np.ndarray, "f"],
    result: PoseJobResult,
    config: PosesConfig,
) -> PoseUnit:
    """The unit of COLMAP's map: by metric depth, else by the working distance, else that of other depth.

    Args:
        sequence: the frames it was made of.
        poses: of the frames, in the map's unit.
        registered: true for frames with a pose.
        result: the map.
        config: whether a working distance is given.
    """
    unit = _unit_of_poses(sequence, poses, registered, result, config)
    if sequence.withheld_depth_mm is None or (sequence.metric and unit.metric):
        return unit
    # A working distance that was told says nothing of the unit of the source.
    seen = (result.observed_frame, result.observed_point, result.observed_px)
    truth = depth_scale(poses, result.points, *seen, sequence.withheld_depth_mm, sequence.mask)
    if truth is None:
        return unit
    return replace(unit, truth_per_unit=truth.mm_per_unit / (1.0 if unit.length is None else unit.length))


def _unit_of_poses(
    sequence: EndoscopicSequence,
    poses: Float[np.ndarray, "f 4 4"],
    registered: Bool[np.ndarray, "f"],
    result: PoseJobResult,
    config: PosesConfig,
) -> PoseUnit:
    """The same, from what may be known of the scale: of withheld depth nothing is."""
    seen = (result.observed_frame, result.observed_point, result.observed_px)
    working_distance_mm = config.working_distance_mm
    scale = None
    if sequence.depth_mm is not None:
        # In the unit of the source, which may be any.
        scale = depth_scale(poses, result.points, *seen, sequence.depth_mm, sequence.mask)
    if scale is not None and sequence.metric:
        return PoseUnit(scale.mm_per_unit, "depth", report=asdict(scale))
    if working_distance_mm is None:
        return PoseUnit(
            # Of no known unit, but of one with the depth.
            length=None if scale is None else scale.mm_per_unit,
            depth_factor=None if scale is None and sequence.depth_mm is not None else 1.0,
        )
    typical = None
    if scale is not None and sequence.depth_mm is not None:
        mapped = sequence.train[registered[sequence.train]]
        typical = typical_depth(sequence.depth_mm, sequence.mask, mapped, least_share=DENSE_SHARE)
    depth_factor = None if sequence.depth_mm is not None else 1.0
    if scale is not None and typical is not None:
        depth_factor = working_distance_mm / typical
        mm_per_unit = scale.mm_per_unit * depth_factor
    else:
        mm_per_unit = working_distance_scale(poses, result.points, *seen, sequence.mask, working_distance_mm)
        if scale is not None:
            depth_factor = mm_per_unit / scale.mm_per_unit
    return PoseUnit(
        mm_per_unit,
        "working_distance",
        depth_factor,
        report={"mm_per_unit": mm_per_unit, "working_distance_mm": working_distance_mm},
    )
