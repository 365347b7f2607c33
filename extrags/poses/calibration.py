"""What is known of a lens that nobody stated: estimated by bundle adjustment, or guessed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from extrags.errors import ShapeError
from extrags.frame_stacks import stacked
from extrags.lens import LENS_PARAMETERS, Lens, Undistortion
from extrags.sequence import EndoscopicSequence

__all__ = ["LensCalibration", "with_calibration"]


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

    @property
    def summary(self) -> str:
        """Focal length with its uncertainty and origin, for plans, logs and reports."""
        view = f"field of view {self.field_of_view_deg:.0f} degrees"
        if not self.determined:
            return f"focal length {self.focal_px:.1f} px ({view}), guessed: {self.reason}"
        bent = [name for name in LENS_PARAMETERS[self.lens.model] if name.startswith("k")]
        terms = ", ".join(f"{name} {self.lens.value(name):.3f}" for name in bent)
        kind = "fisheye, " if self.lens.model.endswith("FISHEYE") else ""
        return (
            f"focal length {self.focal_px:.1f} px \N{PLUS-MINUS SIGN} {self.focal_std_px or 0:.1f} "
            f"({view}{f', {kind}{terms}' if terms else ''}), estimated"
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


def with_calibration(sequence: EndoscopicSequence, calibration: LensCalibration) -> EndoscopicSequence:
    """The sequence as a pinhole camera of the calibrated lens sees it.

    A lens without distortion only replaces `K`. Else all frames, held-out ones too, are resampled to the
    pinhole of the lens's central resolution; what the lens did not see leaves the validity mask. Poses and
    points are of the camera's centre and stay as they are. Pixels that were not square are.

    Args:
        sequence: frames as the lens made them; their pixels need not be square.
        calibration: of all of them.

    Returns:
        A copy with `intrinsics` set to `estimated`; the same sequence where nothing was determined.

    Raises:
        ShapeError: when the frames, with square pixels, have another size than the lens.
    """
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
    plan = Undistortion.planned(lens)

    def through(change: Callable[[np.ndarray], np.ndarray], stack: np.ndarray | None) -> Any:
        return None if stack is None else stacked((change(frame) for frame in stack), len(stack))

    def without_highlights(specular: np.ndarray) -> np.ndarray:
        # One highlight among the pixels that a sample touches spoils it.
        return np.asarray(plan.valid & ~plan.mask(~specular))

    return replace(
        known,
        K=np.tile(plan.K, (len(sequence), 1, 1)),
        rgb=through(plan.colour, sequence.rgb),
        mask=through(plan.mask, sequence.mask),
        depth_mm=through(plan.depth, sequence.depth_mm),
        withheld_depth_mm=through(plan.depth, sequence.withheld_depth_mm),
        depth_error=through(plan.depth, sequence.depth_error),
        observed=through(plan.mask, sequence.observed),
        specular=through(without_highlights, sequence.specular),
    )
