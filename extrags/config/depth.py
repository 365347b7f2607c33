"""Settings of the stage that estimates depth where no sensor gave any."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from extrags.config.base import StageConfig

__all__ = ["DepthConfig"]


class DepthConfig(StageConfig):
    """Dense depth of the training frames, for sources without it."""

    enabled: bool = Field(True, description="False: sources without depth stay without it")
    sources: int = Field(6, ge=1, le=16, description="frames each frame is matched with")
    hypotheses: int = Field(96, ge=8, le=512, description="depths tried per pixel in the first sweep")
    window_radius_px: int = Field(3, ge=1, le=8, description="windows have sides of 2 radius + 1 pixels")
    shading: bool = Field(True, description="use how brightness falls with distance as a cue")
    triangulate: bool = Field(
        True, description="triangulate points with the given poses where a source has none"
    )
    completion: str = Field(
        "bundled",
        description="weights of the completion network: bundled, none (stereo alone), or a .safetensors file",
    )
    monocular: str | None = Field(
        None,
        description="folder of a saved monocular depth network (Depth Anything, DPT), a further cue; None: "
        "none",
    )
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="auto: cuda where there is one")
    max_width: int = Field(
        256, ge=32, le=2048, description="wider frames are matched at this width, their depth is enlarged"
    )
    range_margin: float = Field(
        1.6, ge=1, le=10, description="depths are searched so much beyond the nearest and farthest points"
    )
