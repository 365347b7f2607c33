"""What is known of a lens that nobody stated: estimated by bundle adjustment, or guessed."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from extrags.cameras import field_mask
from extrags.config import DEFAULT_PROFILE, PROFILES, IngestConfig
from extrags.errors import ConfigError, ShapeError, SourceError
from extrags.frame_stacks import stacked
from extrags.lens import (
    LENS_PARAMETERS,
    MUCH_LEFT_OUT,
    Lens,
    Undistortion,
    left_out_share,
    pinhole_size,
)
from extrags.radial_lens import LensFit
from extrags.sequence import EndoscopicSequence

__all__ = ["LensCalibration", "check_lens_use", "with_calibration"]

LARGEST_FIT_ERROR = 1 / 640
"""Root mean square over the image, of its width: frames of a lens that a radial model is farther from do not
keep their pixels."""

LARGEST_KEPT_ERROR = 2 / 640
"""Of the width: pixels of a kept lens that its radial model is farther from leave the mask, as in corners
beyond which the estimated lens folds back."""

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class LensCalibration:
    """The one lens of a sequence, and how well the motion of the camera determines it.

    Args:
        lens: what poses and points were computed with: estimated where `determined`, else the guess.
        determined: whether the estimate was taken.
        estimated_focal_px: focal length that bundle adjustment found; None where there was no model.
        std: standard deviation of each estimated parameter (`f`, `k1`, ...); None where nothing bounds it.
        residual_px: standard deviation of one coordinate of an observation.
        reason: why the estimate was not taken, to follow a colon; empty where it was.
    """

    lens: Lens
    determined: bool
    estimated_focal_px: float | None = None
    std: dict[str, float | None] = field(default_factory=dict)
    residual_px: float | None = None
    reason: str = ""

    @property
    def focal_px(self) -> float:
        """Focal length in use."""
        return float(np.sqrt(self.lens.K[0, 0] * self.lens.K[1, 1]))

    @property
    def focal_std_px(self) -> float | None:
        """Standard deviation of the estimated focal length; None where nothing bounds it."""
        return self.std.get("f")

    @property
    def field_of_view_deg(self) -> float:
        """Horizontal, of the pinhole with this focal length."""
        return float(np.degrees(2 * np.arctan(self.lens.width / 2 / self.focal_px)))

    @cached_property
    def radial(self) -> LensFit | None:
        """The lens as frames that keep their pixels have it; None where no radial model is near enough."""
        try:
            fit = self.lens.radial()
        except SourceError:
            return None
        return fit if fit.rms_px <= LARGEST_FIT_ERROR * self.lens.width else None

    @property
    def own_field_of_view_deg(self) -> float:
        """Horizontal, of the lens itself, as far as its model holds; of the pinhole where no radial fits."""
        if self.lens.is_pinhole or self.radial is None:
            return self.field_of_view_deg
        K, radial = self.radial.K, self.radial.lens
        edges = np.array([K[0, 2], self.lens.width - K[0, 2]]) / K[0, 0]
        return float(np.degrees(np.minimum(radial.angle(edges), radial.max_angle_rad).sum()))

    @property
    def summary(self) -> str:
        """Focal length with its uncertainty and origin, for plans, logs and reports."""
        view = f"field of view {self.own_field_of_view_deg:.0f} degrees"
        if not self.lens.is_pinhole:
            view += f", {self.field_of_view_deg:.0f} as a pinhole"
        if not self.determined:
            return f"focal length {self.focal_px:.1f} px ({view}), guessed: {self.reason}"
        bent = [name for name in LENS_PARAMETERS[self.lens.model] if name.startswith("k")]
        terms = ", ".join(f"{name} {self.lens.value(name):.3f}" for name in bent)
        kind = "fisheye, " if self.lens.model.endswith("FISHEYE") else ""
        return (
            f"focal length {self.focal_px:.1f} px \N{PLUS-MINUS SIGN} {self.focal_std_px or 0:.1f} "
            f"({view}{f', {kind}{terms}' if terms else ''}), estimated"
        )

    def scaled(self, width: int, height: int) -> LensCalibration:
        """The same for images of another size, in whose pixels all figures then are."""
        across = width / self.lens.width
        focal_px, residual_px = (
            None if value is None else value * across for value in (self.estimated_focal_px, self.residual_px)
        )
        in_pixels = {"f", "fx", "fy", "cx", "cy"}
        std = {
            name: value if value is None or name not in in_pixels else value * across
            for name, value in self.std.items()
        }
        return replace(
            self,
            lens=self.lens.scaled(width, height),
            estimated_focal_px=focal_px,
            residual_px=residual_px,
            std=std,
        )

    def to_json(self) -> dict[str, Any]:
        """As plain JSON; `from_json` reads it."""
        return {
            "model": self.lens.model,
            "parameters": list(self.lens.parameters),
            "width": self.lens.width,
            "height": self.lens.height,
            "determined": self.determined,
            "estimated_focal_px": self.estimated_focal_px,
            "std": self.std,
            "residual_px": self.residual_px,
            "reason": self.reason,
        }

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> LensCalibration:
        """What `to_json` wrote."""
        lens = Lens(content["model"], tuple(content["parameters"]), content["width"], content["height"])
        rest = ("determined", "estimated_focal_px", "std", "residual_px", "reason")
        return cls(lens, **{name: content[name] for name in rest})


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
