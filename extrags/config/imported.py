"""Settings of a scene that another program has made."""

from __future__ import annotations

from pydantic import Field

from extrags.config.base import StageConfig

__all__ = ["ImportedConfig"]


class ImportedConfig(StageConfig):
    """A scene that another program has made, in place of the coarse one."""

    scene: str | None = Field(
        None,
        min_length=1,
        description="file of Gaussians, 3DGS PLY or SPZ, in the world of the sequence's cameras: it takes "
        "the place of the coarse scene, and all later stages go on from it. Its content counts in cache "
        "keys, not its path; None: the coarse scene is reconstructed",
    )
    keep: bool = Field(
        True,
        description="fine-tuning leaves its Gaussians and light as they are and adds new ones in its holes: "
        "nothing tells which frames it was made with, so that none can show what further training would cost",
    )
    scale: float = Field(
        1.0,
        gt=0,
        le=1e6,
        description="units of the sequence's poses, mostly millimetres, in one unit of the file",
    )
