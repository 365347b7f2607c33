"""Points of a posed sequence, triangulated from features of its training frames; cameras stay as they are."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from extrags.config import PosesConfig
from extrags.errors import ShapeError
from extrags.frame_stacks import frames_of
from extrags.poses.job import PoseJob, PoseJobResult, run_job
from extrags.poses.registration_report import triangulation_angles_deg
from extrags.sequence import EndoscopicSequence

__all__ = ["Triangulation", "triangulate_points"]

MIN_TRAINING_FRAMES = 2
FEWEST_MATCHES = 200
"""Fewer tell nothing of the poses."""
CONTRADICTED_SHARE = 0.5
"""Of matches that agree with poses, below which these are wrong if what is left is far off as well. Right
poses keep 0.65 (frames far from one another, where many matches are false) to 0.98, poses in other axes or
inverted 0.3 to 0.41: in a small image many lines pass within 2 px of a point."""
CONTRADICTED_PX = 0.8
"""Median distance of projections from observations: of right poses 0.16 to 0.53, of wrong ones 1.1 to 1.4."""
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Triangulation:
    """Points with what tells how far to trust them; without any point all arrays are empty.

    Args:
        points: in world coordinates, in the unit of the poses, [P, 3], float64.
        points_rgb: their colours, [P, 3].
        track_length: training frames that observe each point, two or more, [P].
        reprojection_px: root mean square distance of a point's projections from its observations, [P].
        angle_deg: largest angle between two rays of a point, [P]; depth is uncertain where it is small.
        observed_frame: frame of each observation, an index into the sequence, [O].
        observed_point: index into `points`, [O].
        observed_px: where in the image, in pixels, centres at +0.5, [O, 2].
        report: counts of features, pairs and matches, ready for JSON; `contradiction` says in words that
            they show the poses to be wrong.
    """

    points: Float[np.ndarray, "p 3"]
    points_rgb: UInt8[np.ndarray, "p 3"]
    track_length: Int[np.ndarray, "p"]
    reprojection_px: Float[np.ndarray, "p"]
    angle_deg: Float[np.ndarray, "p"]
    observed_frame: Int[np.ndarray, "o"]
    observed_point: Int[np.ndarray, "o"]
    observed_px: Float[np.ndarray, "o 2"]
    report: dict[str, Any]

    def __len__(self) -> int:
        return len(self.points)

    @property
    def summary(self) -> str:
        """One line for plans and logs."""
        if not len(self):
            return "no point could be triangulated"
        return (
            f"{len(self)} points from {self.report['n_train']} training frames, "
            f"{np.median(self.track_length):.0f} views and {np.median(self.angle_deg):.1f} degrees in the "
            f"median, {np.median(self.reprojection_px):.2f} px off"
        )


def triangulate_points(
    sequence: EndoscopicSequence, config: PosesConfig | None = None, *, stage: str = "triangulation"
) -> Triangulation:
    """Triangulate points from features of the training frames; poses and intrinsics stay as they are.

    Features and their matching are those of the poses stage (`extrags.poses.estimate_poses`); matches count
    where they agree with the known epipolar geometry. COLMAP's triangulator joins them into tracks in a
    process of its own and adjusts points, never cameras. Held-out frames take no part.

    Same input and seed give the same points on one machine.

    Args:
        sequence: with poses, from any source.
        config: features, matching and seed; None takes the defaults.
        stage: named in progress events.

    Returns:
        The points; empty where too few features match, or with fewer than two training frames.

    Raises:
        ShapeError: while the sequence has no poses.
        CaptureError: when COLMAP's process ends on its own.

    Source: Schönberger and Frahm: Structure-from-Motion Revisited, CVPR 2016, section 4.3.
    """
    config = PosesConfig() if config is None else config
    if sequence.world_from_camera is None:
        raise ShapeError(f"{sequence.name} has no poses yet; the poses stage finds them")
    if len(sequence.train) < MIN_TRAINING_FRAMES:
        return _assessed(sequence, _no_points(sequence))
    module, seen = "extrags.poses.colmap_triangulation", sequence.at_most_width(config.max_width)
    result = run_job(module, _job(seen, config), sequence.name, stage=stage)
    larger = np.array([sequence.width / seen.width, sequence.height / seen.height])
    found = _assessed(sequence, replace(result, observed_px=result.observed_px * larger))
    contradiction = _contradiction(found, float(larger[0]))
    if not contradiction:
        return found
    _LOG.warning("%s: %s", sequence.name, contradiction)
    return replace(found, report=found.report | {"contradiction": contradiction})


def _job(sequence: EndoscopicSequence, config: PosesConfig) -> PoseJob:
    """The training frames alone: nothing of the others leaves this process."""
    train = np.asarray(sequence.train, dtype=np.int64)
    recording = sequence.recording
    poses = sequence.cameras.world_from_camera[train].astype(np.float64)
    return PoseJob(
        rgb=frames_of(sequence.rgb, train),
        mask=frames_of(sequence.mask, train),
        K=sequence.K[train].astype(np.float64),
        recording=np.zeros(len(train), dtype=np.int64) if recording is None else recording[train],
        train=np.arange(len(train)),
        test=np.zeros(0, dtype=np.int64),
        settings=config.model_dump(),
        world_from_camera=poses,
    )


def _assessed(sequence: EndoscopicSequence, result: PoseJobResult) -> Triangulation:
    count = len(result.points)
    cameras = sequence.training_cameras
    seen = result.points[result.observed_point]
    squared = np.zeros(len(seen))
    for frame in np.unique(result.observed_frame):
        rows = np.flatnonzero(result.observed_frame == frame)
        (projected,), _ = cameras[int(frame)].project(seen[rows])
        squared[rows] = ((projected - result.observed_px[rows]) ** 2).sum(-1)
    length = np.bincount(result.observed_point, minlength=count)
    mean = np.bincount(result.observed_point, weights=squared, minlength=count) / np.maximum(length, 1)
    found = Triangulation(
        points=result.points,
        points_rgb=result.points_rgb,
        track_length=length,
        reprojection_px=np.sqrt(mean),
        angle_deg=triangulation_angles_deg(result).astype(np.float64),
        observed_frame=np.asarray(sequence.train, dtype=np.int64)[result.observed_frame],
        observed_point=result.observed_point,
        observed_px=result.observed_px,
        report=result.report | {"n_train": len(sequence.train), "n_points": count},
    )
    _LOG.info("%s: %s", sequence.name, found.summary)
    return found


def _contradiction(found: Triangulation, larger: float) -> str:
    """That features say poses are wrong, and not only inexact; empty where they do not.

    Args:
        found: what its poses explain.
        larger: how many times as wide its frames are as those in which features were looked for.
    """
    matches = found.report.get("matches", 0)
    if matches < FEWEST_MATCHES or found.report["matches_kept"] >= CONTRADICTED_SHARE * matches:
        return ""
    if len(found) and np.median(found.reprojection_px) <= CONTRADICTED_PX * larger:
        return ""
    share = 100 * found.report["matches_kept"] / matches
    return (
        f"the poses explain {share:.0f} % of {matches} feature matches between training frames: they are "
        "probably in other axes, inverted or those of other frames, or K is wrong; `extrags data check` says "
        "which, where frames tell"
    )


def _no_points(sequence: EndoscopicSequence) -> PoseJobResult:
    empty = np.zeros(0, dtype=np.int64)
    return PoseJobResult(
        world_from_camera=sequence.training_cameras.world_from_camera,
        points=np.zeros((0, 3)),
        points_rgb=np.zeros((0, 3), dtype=np.uint8),
        observed_frame=empty,
        observed_point=empty,
        observed_px=np.zeros((0, 2)),
        report={},
    )
