"""Settings of the caverns, and the random streams that depend on them."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from data_catalog.rendered_dataset import Setting

__all__ = ["GENERATOR_VERSION", "CavernConfig", "Setting", "stream"]


GENERATOR_VERSION = 1
"""Raised by hand whenever the same settings give other pixels; part of every cache key."""

_STREAMS = ("shape", "texture", "light", "exposure", "noise", "trajectory")


class CavernConfig(BaseModel):
    """One cavern, recorded in one setting.

    The same `scene` has the same shape and texture in both settings and at every resolution.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    scene: int = Field(0, ge=0, description="which cavern; the seed of everything random")
    setting: Setting = Field("sparse", description="how far the two recordings are apart")
    width: int = Field(160, ge=16, le=4096, description="image width in pixels")
    height: int = Field(128, ge=16, le=4096, description="image height in pixels")
    field_of_view_deg: float = Field(92.0, gt=20, lt=150, description="horizontal field of view")
    supersample: int = Field(2, ge=1, le=6, description="rays per pixel and axis")
    train_frames: int = Field(20, ge=2, description="frames of the training recording")
    test_frames: int = Field(28, ge=1, description="frames of the other recording, all of which evaluate")
    max_frames: int | None = Field(
        None, ge=2, description="render at most so many, thinned evenly in both recordings"
    )

    @property
    def seed(self) -> int:
        """Number of the random streams."""
        return self.scene

    @property
    def aside(self) -> float:
        """Factor of how far cameras go to the side of the passage."""
        return 1.0


def stream(scene: int, purpose: str, *indices: int) -> np.random.Generator:
    """The random stream of a scene for one purpose; streams do not influence each other.

    The scene's number is `CavernConfig.seed`.

    No index and the index 0 give the same stream: numpy fills a short seed up with zeros. (So vignetting and
    gamma of a cavern come from the same numbers as exposure and first colour gain of recording A.)
    """
    return np.random.default_rng([0xCAE85, scene, _STREAMS.index(purpose), *indices])
