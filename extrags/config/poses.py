"""Settings of the stage that estimates camera poses."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from extrags.config.base import Seed, StageConfig

__all__ = ["PosesConfig"]


class PosesConfig(StageConfig):
    """Camera poses, for sources without them."""

    max_width: int = Field(
        800,
        ge=64,
        description="features are looked for in frames that are at most so many pixels wide: larger ones "
        "take several times as long",
    )
    n_features: int = Field(6000, ge=100, description="SIFT features per image")
    peak_threshold: float = Field(
        0.001, gt=0, description="SIFT peak threshold; COLMAP's default is too high for mucosa"
    )
    edge_threshold: float = Field(20.0, gt=0, description="SIFT edge threshold")
    sequential_overlap: int = Field(12, ge=1, description="frames matched to each side")
    exhaustive_below: int = Field(
        60, ge=2, description="match all pairs when there are at most so many frames"
    )
    min_tri_angle_deg: float = Field(4.0, gt=0, description="smallest initial triangulation angle")
    min_registered_share: float = Field(
        0.5, gt=0, le=1, description="fewer registered training frames are an error"
    )
    lenient_retry: bool = Field(
        True,
        description="where COLMAP leaves more than a tenth of the training frames without a pose, try again "
        "with guided matching and lower thresholds; taken where that registers clearly more, since poses are "
        "less exact then. Not where too few registered and depth is there to align them by",
    )
    fallback: Literal["auto", "never", "rgbd"] = Field(
        "auto",
        description="auto: where COLMAP fails and depth is there, frames are aligned by colour and depth; "
        "never: COLMAP alone; rgbd: alignment by colour and depth from the start",
    )
    refine_intrinsics: Literal["auto", "always", "never"] = Field(
        "auto",
        description="auto: where the source states no intrinsics, focal length and radial distortion are "
        "estimated with the poses; always: even if it does; never: they stay as they came",
    )
    max_focal_std_share: float = Field(
        0.04,
        gt=0,
        le=1,
        description="an estimated focal length is taken where its standard deviation is at most this share "
        "of it; else the guess is kept and called so",
    )
    replace_given: bool = Field(
        False, description="estimate poses even if the source has them; the source's serve as reference"
    )
    working_distance_mm: float | None = Field(
        None,
        gt=0,
        le=1000,
        description="median distance from lens to tissue; makes an estimate metric where no depth in "
        "millimetres does. None: its scale is arbitrary",
    )
    rgbd_width: int = Field(192, ge=32, description="alignment by colour and depth works at most so wide")
    rgbd_neighbours: int = Field(6, ge=1, description="frames each frame is aligned with")
    seed: Seed = Field(0, description="seed of all random sampling")
