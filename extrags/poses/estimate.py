"""Poses of a sequence, and the sequence with them."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8

from extrags.cameras import as_rotation
from extrags.config import PosesConfig
from extrags.errors import CaptureError, ShapeError
from extrags.events import Progress, emit
from extrags.poses.calibration import LensCalibration, with_calibration
from extrags.poses.job import PoseJob, PoseJobResult
from extrags.poses.registration_report import (
    colmap_report,
    errors_against_given,
    failure_message,
    frames_without_pose,
)
from extrags.poses.rgbd import align_by_depth
from extrags.poses.scale import depth_scale
from extrags.sequence import EndoscopicSequence, Split

__all__ = ["PoseEstimate", "estimate_poses", "with_estimated_poses"]

MIN_TRAINING_FRAMES = 3
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
        metric: true when the unit is the millimetre, from known depth.
        report: counts of features, matches and registrations, ready for JSON.
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
        lens = "" if self.calibration is None else f"; {self.calibration.summary}"
        return (
            f"by {by}: {found['registered_train']} of {found['n_train']} training frames"
            f"{why}, {found['registered_test']} of {found['n_test']} held-out frames{lens}"
        )

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
            "against_given": errors,
            **self.report,
        }


def estimate_poses(sequence: EndoscopicSequence, config: PosesConfig | None = None) -> PoseEstimate:
    """Find the cameras of a sequence: by COLMAP, and where that fails, by colour and depth.

    *COLMAP*: SIFT inside the validity mask, known intrinsics held fixed, incremental mapping on the training
    frames alone; the largest model counts. Held-out frames are registered afterwards against the finished
    map, so that nothing of them reaches it. Where the sequence has depth, the unit becomes the millimetre
    (`extrags.poses.depth_scale`). COLMAP runs in a process of its own.

    *An unknown lens* (`sequence.intrinsics` is `guessed`, see `PosesConfig.refine_intrinsics`): focal
    length and radial distortion are estimated with the map (`extrags.poses.self_calibration`), and the
    guess is kept, with a warning, where the frames do not determine them.

    *Colour and depth* (`extrags.poses.rgbd`): where the sequence has depth and COLMAP registers too few
    training frames, unless `config.fallback` says `never`; or from the start if it says `rgbd`. Again
    training frames first, held-out ones against what these made.

    Same input and seed give the same poses, bit by bit, on one machine.

    Args:
        sequence: frames with intrinsics; poses it may have are not looked at.
        config: settings; None takes the defaults.

    Returns:
        Poses of the frames that registered; the others are named in the log and in the report.

    Raises:
        CaptureError: when too few training frames register, with a report of why; or when COLMAP's
            process ends on its own.

    Source: Schönberger and Frahm: Structure-from-Motion Revisited, CVPR 2016.
    """
    config = PosesConfig() if config is None else config
    if len(sequence.train) < MIN_TRAINING_FRAMES:
        raise CaptureError(
            f"{sequence.name}: poses need at least {MIN_TRAINING_FRAMES} training frames, "
            f"found {len(sequence.train)}"
        )
    if config.fallback == "rgbd":
        return _by_depth(sequence, config, None)
    result = _run(_job(sequence, config), sequence.name)
    registered = np.isfinite(result.world_from_camera).all((1, 2))
    report = colmap_report(sequence, result, registered)
    calibration = None
    if "calibration" in report:
        calibration = LensCalibration.from_json(report["calibration"])
        told = _LOG.info if calibration.determined else _LOG.warning
        told("%s: %s", sequence.name, calibration.summary)
    if _enough(report, config):
        _warn_of_missing(sequence, report)
        return replace(_from_colmap(sequence, result, registered, report), calibration=calibration)
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
    raise CaptureError(failure_message(sequence.name, report, config.min_registered_share, instead=instead))


def _job(sequence: EndoscopicSequence, config: PosesConfig) -> PoseJob:
    recording = sequence.recording
    return PoseJob(
        rgb=sequence.rgb,
        mask=sequence.mask,
        K=sequence.K,
        recording=np.zeros(len(sequence), dtype=np.int64) if recording is None else recording,
        train=np.asarray(sequence.train, dtype=np.int64),
        test=np.asarray(sequence.test, dtype=np.int64),
        settings=config.model_dump(),
        unknown_lens=_estimates_lens(sequence, config),
    )


def _estimates_lens(sequence: EndoscopicSequence, config: PosesConfig) -> bool:
    if config.refine_intrinsics == "never":
        return False
    if config.refine_intrinsics == "auto" and sequence.intrinsics != "guessed":
        return False
    if np.ptp(sequence.K, axis=0).any():
        _LOG.warning("%s: the frames have several cameras; their intrinsics are kept", sequence.name)
        return False
    return True


def _from_colmap(
    sequence: EndoscopicSequence, result: PoseJobResult, registered: np.ndarray, report: dict[str, Any]
) -> PoseEstimate:
    poses, points = _cleaned(result.world_from_camera, registered), result.points
    scale = None
    if sequence.depth_mm is not None and sequence.metric:
        scale = depth_scale(
            poses,
            points,
            result.observed_frame,
            result.observed_point,
            result.observed_px,
            sequence.depth_mm,
            sequence.mask,
        )
    if scale is not None:
        poses[:, :3, 3] *= scale.mm_per_unit
        points = points * scale.mm_per_unit
        report["scale"] = asdict(scale)
    return PoseEstimate(
        method="colmap",
        world_from_camera=poses,
        registered=registered,
        points=points.astype(np.float32),
        points_rgb=result.points_rgb,
        mean_reprojection_px=float(report["mean_reprojection_px"]),
        metric=scale is not None,
        report=report,
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
    if not _enough(report, config):
        message = (
            f"{sequence.name}: alignment by colour and depth placed {report['registered_train']} of "
            f"{report['n_train']} training frames, expected at least {config.min_registered_share:.0%}. "
            f"Without a pose: {', '.join(report['unregistered_train'])}; of these without depth: "
            f"{', '.join(report['without_depth']) or 'none'}. Give frames nearer together, or less "
            "noisy depth"
        )
        if failed is not None:
            because = failure_message(
                sequence.name,
                failed,
                config.min_registered_share,
                instead="Alignment by depth failed as well.",
            )
            message = f"{because} {message}"
        raise CaptureError(message)
    _warn_of_missing(sequence, report)
    return PoseEstimate(
        method="rgbd",
        world_from_camera=_cleaned(found.world_from_camera, registered),
        registered=registered,
        points=found.points.astype(np.float32),
        points_rgb=found.points_rgb,
        mean_reprojection_px=None,
        metric=sequence.metric,
        report=report,
    )


def with_estimated_poses(sequence: EndoscopicSequence, estimate: PoseEstimate) -> EndoscopicSequence:
    """The sequence with poses and points, without the frames that did not register.

    Frames keep their names; the split is renumbered. `truth` is kept as it is. Where a lens was estimated,
    `K` is that of its pinhole, and frames of a distorted lens are resampled to it
    (`extrags.poses.with_calibration`).

    Raises:
        ShapeError: when the estimate is of another sequence.
    """
    if len(estimate.registered) != len(sequence):
        raise ShapeError(
            f"{sequence.name} has {len(sequence)} frames, the estimate has {len(estimate.registered)}"
        )
    kept = np.flatnonzero(estimate.registered)
    number = np.cumsum(estimate.registered) - 1

    def renumbered(frames: np.ndarray) -> np.ndarray:
        return np.asarray(number[frames[estimate.registered[frames]]], dtype=np.int64)

    def of_kept(stack: np.ndarray | None) -> Any:
        return None if stack is None else stack[kept]

    split = sequence.split
    posed = replace(
        sequence,
        rgb=sequence.rgb[kept],
        K=sequence.K[kept],
        mask=sequence.mask[kept],
        depth_mm=of_kept(sequence.depth_mm),
        recording=of_kept(sequence.recording),
        observed=of_kept(sequence.observed),
        specular=of_kept(sequence.specular),
        world_from_camera=estimate.world_from_camera[kept],
        split=Split(split.name, renumbered(split.train), renumbered(split.test), split.version),
        frame_names=tuple(sequence.frame_name(int(frame)) for frame in kept),
        metric=estimate.metric,
        points=estimate.points,
        points_rgb=estimate.points_rgb,
        pose_source="estimated" if estimate.method == "colmap" else "aligned",
    )
    return posed if estimate.calibration is None else with_calibration(posed, estimate.calibration)


def _run(job: PoseJob, name: str) -> PoseJobResult:
    """Run the job in a process of its own and pass its progress on."""
    with TemporaryDirectory(prefix="extrags-poses-") as scratch:
        folder = Path(scratch)
        job.save(folder)
        log = folder / "colmap.log"
        # The child must find this very package, installed or not.
        root = str(Path(__file__).resolve().parents[2])
        paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
        with (
            log.open("wb") as log_file,
            subprocess.Popen(
                [sys.executable, "-m", "extrags.poses.colmap", scratch],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log_file,
                text=True,
                env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
            ) as process,
        ):
            try:
                for line in process.stdout or ():
                    told = json.loads(line)
                    emit(Progress("poses", told["done"], told["total"], told["values"]))
                code = process.wait()
            except BaseException:
                process.kill()
                raise
        if code != 0 or not (folder / "result.json").exists():
            last = log.read_text(errors="replace").strip().splitlines()[-8:]
            raise CaptureError(f"{name}: COLMAP's process ended with code {code}:\n" + "\n".join(last))
        return PoseJobResult.load(folder)


def _cleaned(found: np.ndarray, registered: np.ndarray) -> np.ndarray:
    """Poses with rotations orthonormal to rounding."""
    poses = found.copy()
    for frame in np.flatnonzero(registered):
        poses[frame, :3, :3] = as_rotation(poses[frame, :3, :3], frame=int(frame))
    return poses


def _enough(report: dict[str, Any], config: PosesConfig) -> bool:
    share = report["registered_train"] / report["n_train"]
    return bool(report["registered_train"] > 0 and share >= config.min_registered_share)


def _warn_of_missing(sequence: EndoscopicSequence, report: dict[str, Any]) -> None:
    for kind in ("train", "test"):
        if report[f"unregistered_{kind}"]:
            _LOG.warning(
                "%s: no pose for %s frames %s",
                sequence.name,
                "training" if kind == "train" else "held-out",
                ", ".join(report[f"unregistered_{kind}"]),
            )
