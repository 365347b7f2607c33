"""Where poses, intrinsics and the unit of length of a sequence are from."""

from __future__ import annotations

from typing import Literal

__all__ = [
    "ARBITRARY_SCALE",
    "SCALE_WORDS",
    "IntrinsicsSource",
    "PoseSource",
    "ScaleSource",
    "StereoCamera",
]

PoseSource = Literal["given", "estimated", "aligned", "refined"]
"""Origin of the poses. given: by the source; estimated: by COLMAP; aligned: by RGB-D alignment; refined:
corrected during the reconstruction."""

IntrinsicsSource = Literal["given", "guessed", "estimated"]
"""Origin of the intrinsics. given: by the source or a calibration file; guessed: a usual field of view,
because nothing states them; estimated: by bundle adjustment, with the poses."""

ScaleSource = Literal["source", "setting", "depth", "working_distance"]
"""What the unit of length rests on. source: what the source says of it; setting: `ingest.scale_mm_per_unit`;
depth: known depth that estimated poses were scaled by; working_distance: `poses.working_distance_mm`."""

StereoCamera = Literal["left", "right"]
"""Whose frames these are, of a source with those of both cameras of a stereo endoscope."""

SCALE_WORDS: dict[ScaleSource, str] = {
    "source": "millimetres as the source has them",
    "setting": "millimetres from the scale given",
    "depth": "millimetres from known depth",
    "working_distance": "millimetres from the working distance given",
}
"""What lengths of a metric sequence are, and what says so."""
ARBITRARY_SCALE = "arbitrary scale"
"""What they are of any other."""
