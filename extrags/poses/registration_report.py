"""Report on a COLMAP registration, frame by frame and pair by pair, with advice on what to change."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from extrags.cameras import rotation_angle_deg
from extrags.metrics.pose import relative_pose_error, umeyama
from extrags.poses.job import PoseJobResult
from extrags.sequence import EndoscopicSequence

__all__ = [
    "MIN_TRAINING_FRAMES",
    "colmap_report",
    "errors_against_given",
    "expected_frames",
    "failure_message",
    "frames_without_pose",
    "named_frames",
    "parallax_warning",
    "triangulation_angles_deg",
]

MIN_TRAINING_FRAMES = 3
"""A map of fewer tells the surface from two views alone; COLMAP keeps such a map where it has no other."""
FEW_FEATURES = 100
FEW_INLIERS = 30
FEW_PARTNERS = 4
"""Fewer verified pairs per frame are too few: only points seen by three views help to register the next."""
LITTLE_PARALLAX_DEG = 2.0
NAMED_FRAMES = 12
"""More frames, or ranges of them, are counted and not named in a sentence; the report names them all."""
SHORTEST_RANGE = 3
"""Frames that follow each other and are named by the first and the last."""


def colmap_report(
    sequence: EndoscopicSequence, result: PoseJobResult, registered: np.ndarray
) -> dict[str, Any]:
    """Counts of the job with frames by their names, ready for JSON.

    Args:
        sequence: what was given.
        result: what COLMAP found.
        registered: true for frames with a pose, [F].

    Returns:
        Besides COLMAP's own counts: `frames` (features, inliers of the best pair, pose found or not),
        `registered_train/test`, `unregistered_train/test`, `registrations` of held-out frames, and
        `triangulation_angle_deg`, the median over points of the largest angle between their rays.
    """
    report = dict(result.report)
    report.setdefault("mean_reprojection_px", 0.0)
    report |= frames_without_pose(sequence, registered)
    report["registrations"] = {
        sequence.frame_name(int(frame)): counts for frame, counts in report["registrations"].items()
    }
    report["frames"] = {
        sequence.frame_name(int(frame)): counts | {"registered": bool(registered[int(frame)])}
        for frame, counts in report.get("frames", {}).items()
    }
    angles = triangulation_angles_deg(result)
    report["triangulation_angle_deg"] = float(np.median(angles)) if len(angles) else 0.0
    return report


def frames_without_pose(sequence: EndoscopicSequence, registered: np.ndarray) -> dict[str, Any]:
    """`registered_train/test` (counts) and `unregistered_train/test` (names)."""
    counts: dict[str, Any] = {}
    for kind, frames in (("train", sequence.train), ("test", sequence.test)):
        counts[f"n_{kind}"] = len(frames)
        counts[f"registered_{kind}"] = int(registered[frames].sum())
        counts[f"unregistered_{kind}"] = [
            sequence.frame_name(int(frame)) for frame in frames if not registered[frame]
        ]
    return counts


def triangulation_angles_deg(result: PoseJobResult) -> np.ndarray:
    """Largest angle between the rays of each point with two or more observations, in degrees."""
    order = np.argsort(result.observed_point, kind="stable")
    frames, points = result.observed_frame[order], result.observed_point[order]
    rays = result.points[points] - result.world_from_camera[frames][:, :3, 3]
    rays = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    first = np.flatnonzero(np.diff(points, prepend=-1))
    cosines = [float((own @ own.T).min()) for own in np.split(rays, first[1:]) if len(own) >= 2]
    return np.asarray(np.degrees(np.arccos(np.clip(cosines, -1, 1))))


def errors_against_given(
    sequence: EndoscopicSequence, world_from_camera: np.ndarray, *, metric: bool
) -> dict[str, Any]:
    """Errors of estimated poses where the source has poses too; for comparison only, never an input.

    The estimate is brought into the source's frame by its training frames alone (rigidly when `metric`, else
    with a scale); held-out frames are measured where that puts them.

    Args:
        sequence: with the source's poses.
        world_from_camera: estimated, [F, 4, 4], NaN for frames without.
        metric: both have the same unit.

    Returns:
        `{alignment, train: {...}, test: {...}}` with `frames`, `ate_rmse`, `ate_max`, `rotation_mean_deg`,
        `rotation_without_common_turn_mean_deg`, and for training frames `rpe_translation_rmse` and
        `rpe_rotation_rmse_deg` from frame to frame; empty without poses to compare with, or with fewer than
        three training frames. Positions alone align: a straight path leaves the turn about it open, and
        `rotation_mean_deg` has it in full. The other is what is left after the turn that all training frames
        have in common.
    """
    given = sequence.world_from_camera
    found = np.isfinite(world_from_camera).all((1, 2))
    train = sequence.train[found[sequence.train]]
    if given is None or len(train) < 3:
        return {}
    align = umeyama(world_from_camera[train, :3, 3], given[train, :3, 3], with_scale=not metric)
    errors: dict[str, Any] = {"alignment": "se3" if metric else "sim3"}
    common = _common_turn(align.apply_to_poses(world_from_camera[train]), given[train])
    for kind, frames in (("train", train), ("test", sequence.test[found[sequence.test]])):
        if len(frames) == 0:
            continue
        there = align.apply_to_poses(world_from_camera[frames])
        distance = np.linalg.norm(there[:, :3, 3] - given[frames, :3, 3], axis=1)
        angle = rotation_angle_deg(there[:, :3, :3], given[frames, :3, :3])
        errors[kind] = {
            "frames": len(frames),
            "ate_rmse": float(np.sqrt(np.mean(distance**2))),
            "ate_max": float(distance.max()),
            "rotation_mean_deg": float(angle.mean()),
            "rotation_without_common_turn_mean_deg": float(
                rotation_angle_deg(there[:, :3, :3], common @ given[frames, :3, :3]).mean()
            ),
        }
    drift = relative_pose_error(world_from_camera[train], given[train], alignment="se3" if metric else "sim3")
    errors["train"] |= {
        "rpe_translation_rmse": drift.translation_rmse,
        "rpe_rotation_rmse_deg": drift.rotation_rmse_deg,
    }
    return errors


def _common_turn(found: np.ndarray, given: np.ndarray) -> np.ndarray:
    """The rotation of the world that brings given poses nearest to those found, [3, 3]."""
    left, _, right = np.linalg.svd(np.einsum("fij,fkj->ik", found[:, :3, :3], given[:, :3, :3]))
    left[:, -1] *= np.linalg.det(left @ right)
    return np.asarray(left @ right)


def expected_frames(min_share: float, report: dict[str, Any]) -> str:
    """How many training frames had to have a pose, in words; `report` says how many have."""
    few = report["registered_train"] < MIN_TRAINING_FRAMES
    enough = report["registered_train"] >= min_share * report["n_train"]
    return f"at least {min_share:.0%}" + (f" and {MIN_TRAINING_FRAMES} frames" if few and enough else "")


def failure_message(
    name: str,
    report: dict[str, Any],
    min_share: float,
    *,
    train: Sequence[str],
    width: int,
    instead: str,
) -> str:
    """Why too few training frames have a pose, and what to do, in sentences.

    Args:
        name: of the sequence.
        report: from `colmap_report`.
        min_share: what was expected.
        train: names of the training frames.
        width: of the frames, in pixels.
        instead: why nothing else steps in, as a sentence.
    """
    share = report["registered_train"] / max(1, report["n_train"])
    pairs, verified = report["pairs"], report["pairs_verified"]
    parts = [
        f"{name}: COLMAP found poses for {report['registered_train']} of {report['n_train']} training "
        f"frames ({share:.0%}), expected {expected_frames(min_share, report)}.",
        f"Features per frame: {report['features_median']:.0f} (median), "
        f"{report['features_fewest']} at least; pairs matched: {pairs}, verified: {verified}; "
        f"inliers per verified pair: {report['inliers_median']:.0f} (median); angle between the rays of "
        f"matched points: {_degrees(report['pair_angle_deg'])}, pairs that differ by a turn alone: "
        f"{report['pairs_turn_only']} of {report['pairs_examined']}; frames per model: "
        f"{', '.join(map(str, report['model_sizes'])) or 'none'}.",
        f"Without a pose: {named_frames(report['unregistered_train'], train)}.",
        _advice(report, width),
        instead,
    ]
    return " ".join(parts)


def parallax_warning(report: dict[str, Any]) -> str | None:
    """What is to be said of a map whose points are hardly triangulated, as a sentence; None where they are.

    A scope that turns on the spot gets poses with good reprojection errors: the little motion that the
    noise of its features allows, and points at distances that it makes up.

    Args:
        report: from `colmap_report`.
    """
    angle = float(report["triangulation_angle_deg"])
    if not 0 < angle < LITTLE_PARALLAX_DEG:
        return None
    return (
        f"the rays to a point differ by {_degrees(angle)}, where {LITTLE_PARALLAX_DEG:g} or more tell its "
        "distance: the scope turns or stands where it should move. Positions of cameras and shape are hardly "
        "determined; give a part of the recording with sideways motion, or frames farther apart"
    )


def _advice(report: dict[str, Any], width: int) -> str:
    """The first quantity that is insufficient, and how to improve it."""
    if report["features_median"] < FEW_FEATURES:
        return (
            f"There is little texture: lower poses.peak_threshold, read larger images than of {width} pixels "
            "in width, if the source is larger (whichever of ingest.width, ingest.downscale and ingest.size "
            "sets their size), or check that the mask does not hide the tissue."
        )
    frames = list(report["frames"].values())
    weak = sum(frame["best_pair_inliers"] < FEW_INLIERS for frame in frames)
    partners = float(np.median([frame["verified_pairs"] for frame in frames]))
    if partners < FEW_PARTNERS or report["inliers_median"] < FEW_INLIERS or 4 * weak > len(frames):
        return (
            f"Frames share features with too few others ({partners:.0f} in the median; {weak} of "
            f"{len(frames)} have fewer than {FEW_INLIERS} in common with any): give frames nearer together "
            "in time, or larger images; blur, instruments and tissue that moves do the same harm."
        )
    if report["pair_angle_deg"] < LITTLE_PARALLAX_DEG or (
        2 * report["pairs_turn_only"] > report["pairs_examined"]
    ):
        return (
            "There is too little parallax: the scope turns or stands where it should move. Give a part of "
            "the video with sideways motion, or frames farther apart, or lower poses.min_tri_angle_deg."
        )
    return (
        "The pairs are good, but do not join: frames are missing where the models break off, or "
        "poses.min_tri_angle_deg is too high for the first pair."
    )


def named_frames(missing: Sequence[str], among: Sequence[str]) -> str:
    """Frames in a sentence: those that follow each other as a range, at most `NAMED_FRAMES` names and ranges.

    A stretch of a long recording is what is missing as a rule, and its place is what helps to find out why.

    Args:
        missing: names, in the order of `among`.
        among: names of all frames of their kind.

    Returns:
        For instance `0004, 0120 to 0187 and 5 more`.
    """
    place = {name: k for k, name in enumerate(among)}
    runs: list[list[str]] = []
    for name in missing:
        if runs and place[name] == place[runs[-1][-1]] + 1:
            runs[-1].append(name)
        else:
            runs.append([name])
    words: list[str] = []
    named = 0
    for run in runs:
        parts = [f"{run[0]} to {run[-1]}"] if len(run) >= SHORTEST_RANGE else run
        if len(words) + len(parts) > NAMED_FRAMES:
            break
        words += parts
        named += len(run)
    more = len(missing) - named
    return (", ".join(words) or "none") + (f" and {more} more" if more else "")


def _degrees(angle: float) -> str:
    return f"{angle:.1f} degrees (median)"
