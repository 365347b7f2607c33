"""Settings of the phantom, and the random streams that depend on them."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from data_catalog.rendered_dataset import Setting

__all__ = ["GENERATOR_VERSION", "PhantomConfig", "PhantomSetting", "Setting", "stream"]

PhantomSetting = Literal["sparse", "distanced", "covered", "pocket"]
"""`sparse` and `distanced`: two recordings (`data_catalog.phantom.trajectories`). `covered` and `pocket`: one
that looks everywhere, or everywhere but into a pocket (`data_catalog.phantom.thorough`)."""

GENERATOR_VERSION = 1
"""Raised by hand whenever the same settings give other pixels; part of every cache key."""

_STREAMS = ("shape", "vessels", "mucosa", "exposure", "noise", "trajectory", "variation")


class PhantomConfig(BaseModel):
    """One scene of the phantom, recorded in one setting.

    The same `scene` has the same anatomy and texture in all settings and at every resolution.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    scene: int = Field(0, ge=0, description="which colon; the seed of everything random")
    setting: PhantomSetting = Field("sparse", description="what was recorded, and how it is split")
    width: int = Field(160, ge=16, le=4096, description="image width in pixels")
    height: int = Field(128, ge=16, le=4096, description="image height in pixels")
    field_of_view_deg: float = Field(96.0, gt=20, lt=150, description="horizontal field of view")
    supersample: int = Field(2, ge=1, le=6, description="rays per pixel and axis")
    video_frames: int = Field(200, ge=2, description="length of the training recording as a video")
    train_every: int = Field(10, ge=1, description="every n-th video frame trains; only these are rendered")
    test_frames: int = Field(28, ge=1, description="frames of the other recording, all of which evaluate")
    max_frames: int | None = Field(
        None, ge=2, description="render at most so many, thinned evenly in both recordings"
    )
    polyps: int = Field(4, ge=0, le=8, description="sessile bumps on the wall")
    exposure_spread: float = Field(
        0.08, ge=0, lt=1, description="largest relative difference of a recording's exposure from the mean"
    )
    exposure_drift: float = Field(
        0.015, ge=0, lt=1, description="standard deviation of the exposure from frame to frame"
    )
    white_balance_spread: float = Field(
        0.02, ge=0, lt=1, description="largest relative deviation of a recording's colour gains"
    )
    noise: bool = Field(True, description="shot and read noise of the sensor")
    speculars: bool = Field(True, description="glints of the wet mucosa")
    variation: float = Field(
        0.0,
        ge=0,
        le=1,
        description="how far anatomy, mucosa, lamps and sensor leave the standard colon; to train on many",
    )
    shadows: bool = Field(True, description="shadows of folds, from each of the two lights")


def stream(scene: int, purpose: str, *indices: int) -> np.random.Generator:
    """The random stream of a scene for one purpose; streams do not influence each other.

    No index and the index 0 give the same stream: numpy fills a short seed up with zeros. (So the phase of
    the uneven pace of recording A in the setting `sparse` is the scene's reference direction.)
    """
    return np.random.default_rng([0xC0105, scene, _STREAMS.index(purpose), *indices])
