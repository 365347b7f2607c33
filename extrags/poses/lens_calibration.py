"""What is known of a lens that nobody stated: estimated by bundle adjustment, or guessed.

COLMAP's process loads this module, so that it needs no torch.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from extrags.errors import SourceError
from extrags.lens import LENS_PARAMETERS, Lens
from extrags.radial_lens import LensFit

__all__ = ["LensCalibration"]

LARGEST_FIT_ERROR = 1 / 640
"""Root mean square over the image, of its width: frames of a lens that a radial model is farther from do not
keep their pixels."""


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
        return self.lens.central_focal_px

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
