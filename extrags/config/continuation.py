"""Settings of coarse scenes that go on from an earlier one."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from extrags.config.base import StageConfig

__all__ = ["ContinuationConfig"]


class ContinuationConfig(StageConfig):
    """Whether a coarse scene goes on from that of fewer frames of the same sequence."""

    scene: Literal["none", "nearest"] = Field(
        "none",
        description="none: each coarse scene starts anew, and depends on its frames and settings alone; "
        "nearest: it goes on from the coarse scene in the store that was made with the same settings from "
        "the most of its training frames, and from no other frame; where there is none, it starts anew",
    )
    iterations_per_new_share: float = Field(
        1.5,
        gt=0,
        description="iterations of a continued scene, as a share of coarse.iterations, per share of new "
        "frames among its training frames; never more than coarse.iterations",
    )
    min_iterations_share: float = Field(
        0.15, gt=0, le=1, description="lower bound of that share of coarse.iterations"
    )
