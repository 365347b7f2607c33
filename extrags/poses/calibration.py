"""Frames of a lens that was estimated: as a pinhole sees them, or with the pixels they have."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from extrags.cameras import field_mask
from extrags.config import DEFAULT_PROFILE, PROFILES, IngestConfig
from extrags.errors import ConfigError, ShapeError
from extrags.frame_stacks import stacked
from extrags.lens import MUCH_LEFT_OUT, Lens, Undistortion, left_out_share, pinhole_size
from extrags.poses.lens_calibration import LensCalibration
from extrags.radial_lens import LensFit
from extrags.sequence import EndoscopicSequence

__all__ = ["check_lens_use", "with_calibration"]

LARGEST_KEPT_ERROR = 2 / 640
"""Of the width: pixels of a kept lens that its radial model is farther from leave the mask, as in corners
beyond which the estimated lens folds back."""

_LOG = logging.getLogger(__name__)


def check_lens_use(ingest: IngestConfig) -> None:
    """Refuse settings that contradict each other once a distorted lens is found.

    Raises:
        ConfigError: frames are to keep the lens's own field, and a pinhole's is asked for.
    """
    if ingest.lens == "native" and ingest.field_of_view_deg is not None:
        raise ConfigError("ingest.lens=native keeps the lens's own field: leave ingest.field_of_view_deg out")


def with_calibration(
    sequence: EndoscopicSequence, calibration: LensCalibration, ingest: IngestConfig | None = None
) -> EndoscopicSequence:
    """The sequence with the calibrated lens: as a pinhole sees it, or with the pixels it has.

    A lens without distortion only replaces `K`. Else all frames, held-out ones too, are resampled to a
    pinhole: that of the lens's central resolution, or of `ingest.field_of_view_deg`; what the lens did not
    see leaves the validity mask, and a warning says how much of the picture the pinhole leaves out. With
    `ingest.lens=native` pixels stay, and the sequence's `lens` is the radial model of the lens, if one is
    within `LARGEST_FIT_ERROR`; pixels off by more than `LARGEST_KEPT_ERROR` leave the mask. Poses and
    points are of the camera's centre and stay as they are. Pixels that were not square are.

    Args:
        sequence: frames as the lens made them; their pixels need not be square.
        calibration: of all of them.
        ingest: settings of reading, of which those of distorted sources count; None takes those of the
            profile `balanced`.

    Returns:
        A copy with `intrinsics` set to `estimated`; the same sequence where nothing was determined.

    Raises:
        ShapeError: when the frames, with square pixels, have another size than the lens.
        ConfigError: from `check_lens_use`.
    """
    ingest = PROFILES[DEFAULT_PROFILE].ingest if ingest is None else ingest
    lens, given = calibration.lens, sequence
    sequence = sequence.with_square_pixels()
    if (lens.width, lens.height) != (sequence.width, sequence.height):
        raise ShapeError(
            f"{sequence.name}: frames of {sequence.width} x {sequence.height} pixels, expected "
            f"{lens.width} x {lens.height} as the lens has"
        )
    if not calibration.determined:
        return given
    known = replace(sequence, intrinsics="estimated", focal_std_px=calibration.focal_std_px)
    if lens.is_pinhole:
        return replace(known, K=np.tile(lens.K, (len(sequence), 1, 1)))
    check_lens_use(ingest)
    if ingest.lens == "native":
        if calibration.radial is not None:
            return _kept(known, lens, calibration.radial)
        _LOG.warning(
            "%s: no radial model is near the lens that was estimated; frames are resampled to a pinhole "
            "although ingest.lens is native",
            sequence.name,
            extra={"topic": "lens"},
        )
    plan = Undistortion.planned(lens, ingest.field_of_view_deg, size=pinhole_size(lens, ingest))
    _tell_left_out(sequence, calibration, plan)
    return _resampled(known, plan)


def _kept(sequence: EndoscopicSequence, lens: Lens, fit: LensFit) -> EndoscopicSequence:
    """Frames that keep their pixels; what lies beyond the lens's field, or is far off, leaves the mask."""
    seen = field_mask(fit.K, fit.lens, sequence.width, sequence.height)
    error_px = _fit_error(lens, fit)
    near = error_px <= LARGEST_KEPT_ERROR * sequence.width
    _LOG.info(
        "%s: lens kept up to %.1f degrees from its axis: the radial model is %.2f px from the estimated one "
        "in the root mean square; %.1f %% of the pixels, where it is off by more than %.2f px (at most %.2f "
        "px), leave the mask",
        sequence.name,
        np.degrees(fit.lens.max_angle_rad),
        fit.rms_px,
        100 * np.count_nonzero(seen & ~near) / near.size,
        LARGEST_KEPT_ERROR * sequence.width,
        fit.error_px,
    )
    seen = seen & near
    return replace(
        sequence,
        K=np.tile(fit.K, (len(sequence), 1, 1)),
        lens=fit.lens,
        mask=stacked((mask & seen for mask in sequence.mask), len(sequence)),
    )


def _fit_error(lens: Lens, fit: LensFit) -> Float[np.ndarray, "h w"]:
    """Distance of each pixel from where the lens itself sees the fit's ray; infinite where it sees none."""
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    K = fit.K
    x, y = fit.lens.undistorted((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1])
    true_u, true_v = lens.project(x, y)
    off = np.hypot(true_u - u, true_v - v)
    return np.where(np.isfinite(off), off, np.inf)


def _tell_left_out(sequence: EndoscopicSequence, calibration: LensCalibration, plan: Undistortion) -> None:
    """Warn where the pinhole shows much less than the lens did."""
    picture = np.zeros(sequence.mask.shape[1:])
    for mask in sequence.mask:
        picture += mask / len(sequence)
    left_out = left_out_share(calibration.lens, plan, picture)
    if left_out <= MUCH_LEFT_OUT:
        return
    shown_deg = 2 * np.degrees(np.arctan(plan.valid.shape[1] / 2 / plan.K[0, 0]))
    _LOG.warning(
        "%s: the pinhole of %.0f degrees leaves out %.0f %% of the picture of the lens that was estimated, "
        "which sees %.0f degrees from side to side; a larger ingest.field_of_view_deg shows more of it%s",
        sequence.name,
        shown_deg,
        100 * left_out,
        calibration.own_field_of_view_deg,
        "" if calibration.radial is None else ", and ingest.lens=native all",
        extra={"topic": "lens"},
    )


def _resampled(sequence: EndoscopicSequence, plan: Undistortion) -> EndoscopicSequence:
    def through(change: Callable[[np.ndarray], np.ndarray], stack: np.ndarray | None) -> Any:
        return None if stack is None else stacked((change(frame) for frame in stack), len(stack))

    def without_highlights(specular: np.ndarray) -> np.ndarray:
        # One highlight among the pixels that a sample touches spoils it.
        return np.asarray(plan.valid & ~plan.mask(~specular))

    return replace(
        sequence,
        K=np.tile(plan.K, (len(sequence), 1, 1)),
        rgb=through(plan.color, sequence.rgb),
        mask=through(plan.mask, sequence.mask),
        depth_mm=through(plan.depth, sequence.depth_mm),
        withheld_depth_mm=through(plan.depth, sequence.withheld_depth_mm),
        depth_error=through(plan.depth, sequence.depth_error),
        observed=through(plan.mask, sequence.observed),
        specular=through(without_highlights, sequence.specular),
    )
