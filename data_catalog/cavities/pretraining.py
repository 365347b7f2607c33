"""Recordings of cavities to pretrain the restorer on, with clips of views off their paths.

Scenes are numbered from 0; everything else is drawn from the number. None of them is ever evaluated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8
from pydantic import BaseModel, ConfigDict, Field

from data_catalog.cavities.camera import pinhole, radiance, z_depth
from data_catalog.cavities.free_space import FreeSpace
from data_catalog.cavities.lamps import Lamps
from data_catalog.cavities.noise import stream
from data_catalog.cavities.processing import Processor, random_sensor
from data_catalog.cavities.real_textures import photographed_tile, texture_files
from data_catalog.cavities.scene import NODES, Cavity, build_cavity
from data_catalog.cavities.shapes import KINDS, Kind
from data_catalog.cavities.views import recording_poses, target_clips
from data_catalog.phantom.imaging import Sensor
from extrags.cameras import Cameras
from extrags.errors import CaptureError
from extrags.restoration.training_data.recordings import PretrainingRecording
from extrags.sequence import EndoscopicSequence, Split

__all__ = ["GENERATOR_VERSION", "CavityConfig", "cavity_config", "cavity_recording"]

GENERATOR_VERSION = 2
"""Raised by hand whenever the same number gives other pixels."""
_SIZES = (
    *((160, 128), (176, 144), (192, 144), (192, 160), (208, 176)),
    *((224, 176), (240, 192), (256, 208), (144, 144), (208, 208)),
)
_ATTEMPTS = 12
_REAL_SHARE = 0.35
_ROUND_SHARE = 0.2
_PROBE_WIDTH = 40


class CavityConfig(BaseModel):
    """What a recording of a cavity is like, as far as it is not drawn from its number later."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scene: int = Field(ge=0, description="number; the seed of everything random")
    kind: Kind = Field(description="what the cavity is like")
    width: int = Field(ge=16, le=4096, description="image width in pixels")
    height: int = Field(ge=16, le=4096, description="image height in pixels")
    field_of_view_deg: float = Field(ge=40, le=130, description="horizontal field of view")
    train_frames: int = Field(ge=2, description="frames of the recording")
    clips: int = Field(ge=1, description="clips of views to restore, five views each")
    supersample: int = Field(2, ge=1, le=4, description="rays per pixel and axis")
    nodes: int = Field(NODES, ge=8000, description="of the lattice that the wall is contoured on")
    real_texture: bool = Field(False, description="ordinary tissue from a real frame")


def cavity_config(index: int, *, size_factor: int = 1, real_textures: bool = False) -> CavityConfig:
    """What recording number `index` is like; the kinds take turns.

    Args:
        index: from 0.
        size_factor: how many times wider and higher pictures are.
        real_textures: whether a third of the cavities wear tissue from real frames.
    """
    rng = stream(index, "scene")
    width, height = _SIZES[int(rng.integers(len(_SIZES)))]
    return CavityConfig(
        scene=index,
        kind=KINDS[index % len(KINDS)],
        width=width * size_factor,
        height=height * size_factor,
        field_of_view_deg=float(rng.uniform(60, 120)),
        train_frames=int(np.round(np.exp(rng.uniform(np.log(10), np.log(40))))),
        clips=int(rng.integers(6, 11)),
        real_texture=bool(rng.random() < _REAL_SHARE) and real_textures,
    )


def cavity_recording(config: CavityConfig, *, to_restore: bool = True) -> PretrainingRecording:
    """A recording of a cavity with its clips of views to restore.

    Training frames come first, as a camera shows them. The clips' views are free of noise, motion and
    compression and taken at the mean exposure; depth is exact everywhere.

    Args:
        config: what it is like.
        to_restore: whether there are views to restore; the training frames are the same without.

    Raises:
        SourceNotFoundError: when real textures are asked for and not on this machine.
        CaptureError: when no cavity drawn has room for a lens.
    """
    problem = ""
    for attempt in range(_ATTEMPTS):
        # Further numbers of the same scene: those of other scenes are never touched.
        scene = config.scene * _ATTEMPTS + attempt
        try:
            cavity, space = _cavity(scene, config)
            train, targets, clip = _cameras(scene, config, cavity, space)
        except CaptureError as error:
            problem = str(error)
            continue
        if not to_restore:
            targets, clip = targets[np.arange(0)], clip[:0]
        return _photographed(scene, config, cavity, train, targets, clip)
    raise CaptureError(f"cavity {config.scene} ({config.kind}): {problem}, in {_ATTEMPTS} draws")


def _cavity(scene: int, config: CavityConfig) -> tuple[Cavity, FreeSpace]:
    tile = None
    if config.real_texture:
        tile = photographed_tile(texture_files(), stream(scene, "paint"))
    cavity = build_cavity(scene, config.kind, nodes=config.nodes, photograph=tile)
    return cavity, FreeSpace.of(cavity.lattice, cavity.rays)


def _cameras(
    scene: int, config: CavityConfig, cavity: Cavity, space: FreeSpace
) -> tuple[Cameras, Cameras, np.ndarray]:
    shape = cavity.shape
    poses = recording_poses(
        space,
        stream(scene, "path"),
        config.train_frames,
        tube=shape.tube,
        facing=shape.facing,
        radius_mm=shape.radius_mm,
    )
    K = pinhole(config.width, config.height, config.field_of_view_deg)
    train = Cameras(np.repeat(K[None], len(poses), 0), poses, config.width, config.height)
    away, clip = target_clips(space, stream(scene, "targets"), train, clips=config.clips)
    return train, Cameras(np.repeat(K[None], len(away), 0), away, config.width, config.height), clip


@dataclass(frozen=True)
class _Recorder:
    """Camera, lamps and processor in one cavity."""

    cavity: Cavity
    lamps: Lamps
    sensor: Sensor
    processor: Processor
    supersample: int

    @classmethod
    def drawn(cls, scene: int, config: CavityConfig, cavity: Cavity, train: Cameras) -> _Recorder:
        lamps, rng = Lamps.random(stream(scene, "lamps")), stream(scene, "sensor")
        height = max(8, round(_PROBE_WIDTH * config.height / config.width))
        levels = []
        for k in np.linspace(0, len(train) - 1, 5).round().astype(int):
            probe = train[int(k)].resized(_PROBE_WIDTH, height)
            levels.append(np.quantile(_light(cavity, lamps, probe, 1).mean(axis=2), 0.6))
        gain = float(np.exp(rng.uniform(np.log(0.09), np.log(0.32))) / max(np.median(levels), 1e-9))
        return cls(cavity, lamps, random_sensor(rng, gain), Processor.random(rng), config.supersample)

    def light(self, camera: Cameras) -> Float[np.ndarray, "h w 3"]:
        return _light(self.cavity, self.lamps, camera, self.supersample)


def _light(cavity: Cavity, lamps: Lamps, camera: Cameras, supersample: int) -> Float[np.ndarray, "h w 3"]:
    return radiance(cavity.wall, cavity.skin, lamps, cavity.rays, camera, supersample)


def _photographed(
    scene: int, config: CavityConfig, cavity: Cavity, train: Cameras, targets: Cameras, clip: np.ndarray
) -> PretrainingRecording:
    recorder = _Recorder.drawn(scene, config, cavity, train)
    light = [recorder.light(train[k]) for k in range(len(train))]
    exposure = _exposures(recorder.processor, light, stream(scene, "noise"))
    field = _field_of_view(config, stream(scene, "sensor", 1))
    pictures: list[UInt8[np.ndarray, "h w 3"]] = []
    for k, image in enumerate(light):
        rng = stream(scene, "noise", k + 1)
        shown = recorder.processor.picture(image, recorder.sensor, float(exposure[k]), rng, clean=False)
        pictures.append(np.where(field[..., None], shown, np.uint8(0)))
    quiet = replace(recorder.sensor, noise=False)

    def photographed(camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
        # Neither noise nor flaws: nothing is drawn.
        rng = stream(scene, "noise", 0)
        return recorder.processor.picture(recorder.light(camera), quiet, 1.0, rng, clean=True)

    pictures += [photographed(targets[k]) for k in range(len(targets))]
    cameras = Cameras.concatenated([train, targets])
    depth = np.stack([z_depth(cavity.rays, cameras[k]) for k in range(len(cameras))])
    mask = np.isfinite(depth)
    depth = np.where(mask, depth, 0).astype(np.float32)
    mask[: len(train)] &= field
    truth: dict[str, Any] = {
        "generator_version": GENERATOR_VERSION,
        "cavity": config.model_dump(),
        "exposure": [*(float(value) for value in exposure), *([1.0] * len(targets))],
    }
    sequence = EndoscopicSequence(
        name=f"cavities/{config.scene}",
        rgb=np.stack(pictures),
        K=cameras.K,
        mask=mask,
        split=Split("pretraining", np.arange(len(train)), np.arange(len(train), len(cameras))),
        world_from_camera=cameras.world_from_camera,
        depth_mm=depth,
        recording=np.zeros(len(cameras), dtype=np.int64),
        frame_names=tuple(f"c_{k:04d}" for k in range(len(cameras))),
        metric=True,
        truth=truth,
    )
    return PretrainingRecording(
        sequence, clip, config.kind, lambda camera: z_depth(cavity.rays, camera), photographed
    )


def _exposures(
    processor: Processor, light: list[Float[np.ndarray, "h w 3"]], rng: np.random.Generator
) -> Float[np.ndarray, "f"]:
    """Exposure of each frame; their geometric mean is one."""
    levels = np.log([float(np.quantile(image.mean(axis=2), 0.75)) + 1e-9 for image in light])
    follows = np.clip(processor.automatic * (levels.mean() - levels), -1.2, 1.2)
    drift = processor.drift * np.clip(rng.standard_normal(len(light)), -2.5, 2.5)
    logarithm = follows + drift
    return np.asarray(np.exp(logarithm - logarithm.mean()))


def _field_of_view(config: CavityConfig, rng: np.random.Generator) -> Bool[np.ndarray, "h w"]:
    """Where a frame shows anything: in some recordings a disc or a square without corners."""
    x = np.abs((np.arange(config.width) + 0.5) / config.width * 2 - 1)
    y = np.abs((np.arange(config.height) + 0.5) / config.height * 2 - 1)
    form = rng.random()
    if form < _ROUND_SHARE:
        size = rng.uniform(0.95, 1.3)
        return np.asarray(y[:, None] ** 2 * (config.height / config.width) ** 2 + x**2 < size**2)
    if form < 2 * _ROUND_SHARE:
        return np.asarray(x[None] + y[:, None] < rng.uniform(1.6, 1.9))
    return np.ones((config.height, config.width), dtype=bool)
