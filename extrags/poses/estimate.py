"""Poses of a sequence, and the sequence with them."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from extrags.cameras import as_rotation
from extrags.config import DEFAULT_PROFILE, PROFILES, IngestConfig, PosesConfig
from extrags.errors import CaptureError, ConfigError, ShapeError
from extrags.frame_stacks import frames_of, stacked
from extrags.poses.attempts import attempted, enough_registered
from extrags.poses.calibration import with_calibration
from extrags.poses.job import PoseJob, PoseJobResult, run_job
from extrags.poses.lens_calibration import LensCalibration
from extrags.poses.registration_report import (
    MIN_TRAINING_FRAMES,
    errors_against_given,
    expected_frames,
    failure_message,
    frames_without_pose,
    named_frames,
    parallax_warning,
)
from extrags.poses.rgbd import align_by_depth
from extrags.poses.scale import typical_depth
from extrags.poses.unit import unit_of_map
from extrags.reading_corrections import as_given, with_corrections
from extrags.sequence import EndoscopicSequence, ScaleSource, Split
from extrags.threads import one_torch_thread

__all__ = ["MIN_TRAINING_FRAMES", "PoseEstimate", "estimate_poses", "with_estimated_poses"]

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class PoseEstimate:
    """Poses that were found.

    Args:
        method: how: by COLMAP, or by alignment of colour and depth.
        world_from_camera: [F, 4, 4], float64, NaN for frames that did not register.
        registered: true for frames with a pose, [F].
        points: of the surface, [P, 3], float32, in the unit of the poses.
        points_rgb: their colours, [P, 3].
        mean_reprojection_px: over the observations in training frames; None without such.
        metric: true when the unit is the millimetre.
        report: counts of features, matches and registrations, ready for JSON.
        truth_per_unit: length of one unit of the poses in the unit of withheld true depth; None where no
            depth is withheld, where the ratio is not known, and where both are the millimetre. The
            evaluation compares with the truth by it; no pose and no point depends on it.
        depth_factor: from the unit of the sequence's own depth to that of the poses; None where it is not
            known: that depth cannot be used with them.
        scale_source: what makes the estimate metric, if anything does.
        calibration: of the lens, where the sequence's intrinsics were a guess; None where they were given.
    """

    method: Literal["colmap", "rgbd"]
    world_from_camera: Float[np.ndarray, "f 4 4"]
    registered: Bool[np.ndarray, "f"]
    points: Float[np.ndarray, "p 3"]
    points_rgb: UInt8[np.ndarray, "p 3"]
    mean_reprojection_px: float | None
    metric: bool
    report: dict[str, Any]
    truth_per_unit: float | None = None
    depth_factor: float | None = 1.0
    scale_source: ScaleSource = "source"
    calibration: LensCalibration | None = None

    @property
    def summary(self) -> str:
        """One line for plans and logs."""
        found = self.report
        by = "COLMAP" if self.method == "colmap" else "colour and depth"
        why = ""
        if "colmap" in found:
            failed = found["colmap"]
            why = f" (COLMAP registered only {failed['registered_train']})"
        elif found.get("lenient"):
            why = f" in a second, lenient attempt ({found['first_attempt']['registered_train']} in the first)"
        lens = "" if self.calibration is None else f"; {self.calibration.summary}"
        warning = parallax_warning(found) if self.method == "colmap" else None
        parallax = "" if warning is None else f"; {warning}"
        return (
            f"by {by}: {found['registered_train']} of {found['n_train']} training frames"
            f"{why}, {found['registered_test']} of {found['n_test']} held-out frames; "
            f"{self._scale}{lens}{parallax}"
        )

    @property
    def _scale(self) -> str:
        return {
            "source": "scale as that of the depth" if self.method == "rgbd" else "arbitrary scale",
            "setting": "scale from ingest.scale_mm_per_unit",
            "depth": "scale from depth",
            "working_distance": "scale from the working distance given",
        }[self.scale_source]

    def to_json(self, given: EndoscopicSequence) -> dict[str, Any]:
        """Counts and errors as plain JSON.

        Args:
            given: the sequence as it came; where it has poses, `against_given` holds the errors against
                them, which are not looked at before.
        """
        errors = errors_against_given(given, self.world_from_camera, metric=self.metric and given.metric)
        return {
            "method": self.method,
            "summary": self.summary,
            "registered": [bool(found) for found in self.registered],
            "mean_reprojection_px": self.mean_reprojection_px,
            "truth_per_unit": self.truth_per_unit,
            "depth_factor": self.depth_factor,
            "against_given": errors,
            **self.report,
        }


@one_torch_thread()
def estimate_poses(sequence: EndoscopicSequence, config: PosesConfig | None = None) -> PoseEstimate:
    """Find the cameras of a sequence: by COLMAP, and where that fails, by colour and depth.

    *COLMAP*: SIFT inside the validity mask, in frames of at most `config.max_width` pixels across, known
    intrinsics held fixed, incremental mapping on the training frames alone; the largest model counts.
    Held-out frames are registered afterwards against the finished map, so that nothing of them reaches it.
    Where the sequence has depth, the unit becomes the millimetre (`extrags.poses.depth_scale`); where it has
    none and `config.working_distance_mm` is given, the median depth of the pixels, interpolated between the
    points that a frame observes, becomes that. Of depth in an arbitrary unit, known at half of the pixels,
    the median itself becomes that. COLMAP runs in
    a process of its own.

    Where that leaves more than a tenth of the training frames without a pose, a second attempt with guided
    matching and lower thresholds is made (`config.lenient_retry`), and taken if it registers clearly more
    (`extrags.poses.attempts`); not where too few registered and depth is there to align them by.

    *An unknown lens* (`sequence.intrinsics` is `guessed`, see `PosesConfig.refine_intrinsics`): focal
    length and radial distortion are estimated with the map (`extrags.poses.self_calibration`), and the
    guess is kept, with a warning, where the frames do not determine them.

    *Colour and depth* (`extrags.poses.rgbd`): where the sequence has depth and COLMAP registers too few
    training frames, unless `config.fallback` says `never`; or from the start if it says `rgbd`. Again
    training frames first, held-out ones against what these made.

    Same input and seed give the same poses, bit by bit, on one machine.

    Args:
        sequence: frames with intrinsics; poses it may have are not looked at.
        config: settings; None takes those of the profile `balanced`.

    Returns:
        Poses of the frames that registered; the others are named in the log and in the report.

    Raises:
        CaptureError: when too few training frames register, with a report of why; or when COLMAP's
            process ends on its own.
        ConfigError: when `ingest.scale_mm_per_unit` gave the unit of the source's own poses, and nothing
            gives that of others.

    Source: Schönberger and Frahm: Structure-from-Motion Revisited, CVPR 2016.
    """
    config = PROFILES[DEFAULT_PROFILE].poses if config is None else config
    # COLMAP and the alignment are told of pinholes; poses are those of the frames.
    native, sequence = sequence.lens is not None, sequence.as_pinhole()
    if not sequence.training_depth_known:
        # Held-out frames may have depth for the evaluation alone.
        sequence = replace(sequence, depth_mm=None)
    _check_possible(sequence, config)
    if config.fallback == "rgbd":
        return _by_depth(sequence, config, None)
    found, report = _by_colmap(
        sequence, config, unknown_lens=_estimates_lens(sequence, config, native=native)
    )
    if found is not None:
        return found
    if config.fallback == "never":
        instead = "Alignment by colour and depth is switched off (poses.fallback)."
    elif sequence.depth_mm is None:
        instead = "The source has no depth that frames could be aligned by instead."
    else:
        _LOG.warning(
            "%s: COLMAP registered %d of %d training frames; aligning by colour and depth instead",
            sequence.name,
            report["registered_train"],
            report["n_train"],
        )
        return _by_depth(sequence, config, report)
    raise CaptureError(
        failure_message(
            sequence.name,
            report,
            config.min_registered_share,
            train=_names(sequence, sequence.train),
            width=sequence.width,
            instead=instead,
        )
    )


def _check_possible(sequence: EndoscopicSequence, config: PosesConfig) -> None:
    """Refuse a unit of poses that are not estimated, and too few frames."""
    of_given_poses = sequence.scale_source == "setting"
    if of_given_poses and sequence.depth_mm is None and config.working_distance_mm is None:
        raise ConfigError(
            f"{sequence.name}: ingest.scale_mm_per_unit is the unit of the source's poses, and "
            "poses.replace_given estimates others, to which it does not apply; leave it out, or give "
            "poses.working_distance_mm instead"
        )
    if len(sequence.train) < MIN_TRAINING_FRAMES:
        raise CaptureError(
            f"{sequence.name}: poses need at least {MIN_TRAINING_FRAMES} training frames, "
            f"found {len(sequence.train)} beside {len(sequence.test)} that are held out "
            "(ingest.holdout_every); give more frames"
        )


def _by_colmap(
    sequence: EndoscopicSequence, config: PosesConfig, *, unknown_lens: bool
) -> tuple[PoseEstimate | None, dict[str, Any]]:
    """By COLMAP; None where too few training frames registered, and the report in either case."""
    # The lenses that are tried have one focal length.
    square = sequence.with_square_pixels() if unknown_lens else sequence
    seen = square.at_most_width(config.max_width)
    job = _job(seen, config, unknown_lens=unknown_lens)
    no_depth = sequence.depth_mm is None or config.fallback == "never"
    attempt = attempted(seen, job, config, _run, retry_too_few=no_depth)
    report = attempt.report
    # Told in the pixels of the frames.
    report["mean_reprojection_px"] *= square.width / seen.width
    calibration = None
    if "calibration" in report:
        calibration = LensCalibration.from_json(report["calibration"]).scaled(square.width, square.height)
        report["calibration"] = calibration.to_json()
        told = _LOG.info if calibration.determined else _LOG.warning
        told("%s: %s", sequence.name, calibration.summary)
    if not enough_registered(report, config):
        return None, report
    _warn_of_missing(sequence, report)
    if (warning := parallax_warning(report)) is not None:
        _LOG.warning("%s: %s", sequence.name, warning)
    found = _from_colmap(seen, attempt.result, attempt.registered, report, config)
    return replace(found, calibration=calibration), report


def _job(sequence: EndoscopicSequence, config: PosesConfig, *, unknown_lens: bool = False) -> PoseJob:
    recording = sequence.recording
    return PoseJob(
        rgb=sequence.rgb,
        mask=sequence.mask,
        K=sequence.K,
        recording=np.zeros(len(sequence), dtype=np.int64) if recording is None else recording,
        train=np.asarray(sequence.train, dtype=np.int64),
        test=np.asarray(sequence.test, dtype=np.int64),
        settings=config.model_dump(),
        unknown_lens=unknown_lens,
    )


def _estimates_lens(sequence: EndoscopicSequence, config: PosesConfig, *, native: bool) -> bool:
    if config.refine_intrinsics == "never":
        return False
    if config.refine_intrinsics == "auto" and sequence.intrinsics != "guessed":
        return False
    if native:
        # What is estimated would be the lens of the pinhole that the frames are looked at through.
        _LOG.warning("%s: the frames are those of a lens that is known; it is kept", sequence.name)
        return False
    if np.ptp(sequence.K, axis=0).any():
        _LOG.warning("%s: the frames have several cameras; their intrinsics are kept", sequence.name)
        return False
    return True


def _from_colmap(
    sequence: EndoscopicSequence,
    result: PoseJobResult,
    registered: np.ndarray,
    report: dict[str, Any],
    config: PosesConfig,
) -> PoseEstimate:
    poses, points = _cleaned(result.world_from_camera, registered), result.points
    unit = unit_of_map(sequence, poses, registered, result, config)
    if unit.length is not None:
        poses[:, :3, 3] *= unit.length
        points = points * unit.length
    if unit.report is not None:
        report["scale"] = unit.report
    if unit.depth_factor is None:
        _LOG.warning(
            "%s: too little of the depth lies where the poses have points: its unit is not that of the "
            "poses, and it is left out",
            sequence.name,
        )
    return PoseEstimate(
        method="colmap",
        world_from_camera=poses,
        registered=registered,
        points=points.astype(np.float32),
        points_rgb=result.points_rgb,
        mean_reprojection_px=float(report["mean_reprojection_px"]),
        metric=unit.metric,
        report=report,
        scale_source=unit.scale_source,
        truth_per_unit=unit.truth_per_unit,
        depth_factor=unit.depth_factor,
    )


def _by_depth(
    sequence: EndoscopicSequence, config: PosesConfig, failed: dict[str, Any] | None
) -> PoseEstimate:
    """By colour and depth; `failed` is COLMAP's report, if it was asked first."""
    found = align_by_depth(sequence, config)
    registered = np.isfinite(found.world_from_camera).all((1, 2))
    report = found.report | frames_without_pose(sequence, registered)
    if failed is not None:
        report["colmap"] = failed
    if not enough_registered(report, config):
        train = _names(sequence, sequence.train)
        blind = [name for name in report["unregistered_train"] if name in set(report["without_depth"])]
        message = (
            f"{sequence.name}: alignment by colour and depth placed {report['registered_train']} of "
            f"{report['n_train']} training frames, expected "
            f"{expected_frames(config.min_registered_share, report)}. "
            f"Without a pose: {named_frames(report['unregistered_train'], train)}; of these without depth: "
            f"{named_frames(blind, train)}. Give frames nearer together, or less "
            "noisy depth"
        )
        if failed is not None:
            because = failure_message(
                sequence.name,
                failed,
                config.min_registered_share,
                train=train,
                width=sequence.width,
                instead="Alignment by depth failed as well.",
            )
            message = f"{because} {message}"
        raise CaptureError(message)
    _warn_of_missing(sequence, report)
    poses, points = _cleaned(found.world_from_camera, registered), found.points
    scale_source: ScaleSource = "depth" if sequence.metric else "source"
    depth_factor = 1.0
    if config.working_distance_mm is not None and not sequence.metric and sequence.depth_mm is not None:
        placed = sequence.train[registered[sequence.train]]
        typical = typical_depth(sequence.depth_mm, sequence.mask, placed)
        if typical is not None:
            # The poses are in the unit of the depth.
            depth_factor, scale_source = config.working_distance_mm / typical, "working_distance"
            poses[:, :3, 3] *= depth_factor
            points = points * depth_factor
            report["scale"] = {
                "mm_per_unit": depth_factor,
                "working_distance_mm": config.working_distance_mm,
            }
    return PoseEstimate(
        method="rgbd",
        world_from_camera=poses,
        registered=registered,
        points=points.astype(np.float32),
        points_rgb=found.points_rgb,
        mean_reprojection_px=None,
        metric=scale_source != "source",
        report=report,
        # True depth is in the unit of the sequence's own.
        truth_per_unit=None if sequence.withheld_depth_mm is None or sequence.metric else 1 / depth_factor,
        depth_factor=depth_factor,
        scale_source=scale_source,
    )


def with_estimated_poses(
    sequence: EndoscopicSequence, estimate: PoseEstimate, ingest: IngestConfig | None = None
) -> EndoscopicSequence:
    """The sequence with poses and points, without the frames that did not register.

    Frames keep their names; the split is renumbered. `truth` is kept and told that the world is another
    (`world`). Depth is brought to the unit of the poses, that which was withheld for the evaluation as well,
    and left out where nothing tells that unit.
    Where a lens was estimated, `K` is that of its pinhole, and frames of a distorted lens are resampled to it
    or keep their pixels (`extrags.poses.with_calibration`).

    Args:
        sequence: what poses were estimated of.
        estimate: of its frames.
        ingest: settings of reading, which say what becomes of frames of a distorted lens; None takes
            those of the profile `balanced`.

    Raises:
        ShapeError: when the estimate is of another sequence.
        ConfigError: when the frames are to keep a distorted lens, and a pinhole's field of view is asked for.
    """
    if len(estimate.registered) != len(sequence):
        raise ShapeError(
            f"{sequence.name} has {len(sequence)} frames, the estimate has {len(estimate.registered)}"
        )
    sequence = as_given(sequence)
    kept = np.flatnonzero(estimate.registered)
    number = np.cumsum(estimate.registered) - 1

    def renumbered(frames: np.ndarray) -> np.ndarray:
        return np.asarray(number[frames[estimate.registered[frames]]], dtype=np.int64)

    def of_kept(stack: np.ndarray | None) -> Any:
        return None if stack is None else frames_of(stack, kept)

    def of_truth(depth: np.ndarray | None) -> Any:
        if depth is None or (estimate.metric and sequence.metric):
            return of_kept(depth)
        if estimate.truth_per_unit is None:
            return None  # its unit is not that of the poses, so that nothing could be compared with it
        unit = estimate.truth_per_unit
        return stacked(((depth[frame] / unit).astype(depth.dtype) for frame in kept), len(kept))

    def of_own(depth: np.ndarray | None) -> Any:
        factor = estimate.depth_factor
        if depth is None or factor is None or factor == 1:
            return None if factor is None else of_kept(depth)
        return stacked(((depth[frame] * factor).astype(depth.dtype) for frame in kept), len(kept))

    split = sequence.split
    hidden = not sequence.training_depth_known
    posed = replace(
        sequence,
        rgb=of_kept(sequence.rgb),
        K=sequence.K[kept],
        mask=of_kept(sequence.mask),
        depth_mm=of_truth(sequence.depth_mm) if hidden else of_own(sequence.depth_mm),
        withheld_depth_mm=of_truth(sequence.withheld_depth_mm),
        recording=of_kept(sequence.recording),
        observed=of_kept(sequence.observed),
        specular=of_kept(sequence.specular),
        world_from_camera=estimate.world_from_camera[kept],
        split=Split(split.name, renumbered(split.train), renumbered(split.test), split.version),
        frame_names=tuple(sequence.frame_name(int(frame)) for frame in kept),
        metric=estimate.metric,
        points=estimate.points,
        points_rgb=estimate.points_rgb,
        scale_source=estimate.scale_source,
        pose_source="estimated" if estimate.method == "colmap" else "aligned",
        truth={**sequence.truth, "world": "estimated"} if sequence.truth else {},
    )
    if estimate.calibration is not None:
        posed = with_calibration(posed, estimate.calibration, ingest)
    # Before, the depth of a few frames told the scale of the poses.
    return with_corrections(posed, ingest)


def _run(job: PoseJob, name: str) -> PoseJobResult:
    return run_job("extrags.poses.colmap", job, name, stage="poses")


def _cleaned(found: np.ndarray, registered: np.ndarray) -> np.ndarray:
    """Poses with rotations orthonormal to rounding."""
    poses = found.copy()
    for frame in np.flatnonzero(registered):
        poses[frame, :3, :3] = as_rotation(poses[frame, :3, :3], frame=int(frame))
    return poses


def _warn_of_missing(sequence: EndoscopicSequence, report: dict[str, Any]) -> None:
    for kind, frames in (("training", sequence.train), ("held-out", sequence.test)):
        missing = report["unregistered_train" if kind == "training" else "unregistered_test"]
        if missing:
            _LOG.warning(
                "%s: no pose for %d of %d %s frames: %s",
                sequence.name,
                len(missing),
                len(frames),
                kind,
                named_frames(missing, _names(sequence, frames)),
            )


def _names(sequence: EndoscopicSequence, frames: Int[np.ndarray, "n"]) -> list[str]:
    return [sequence.frame_name(int(frame)) for frame in frames]
