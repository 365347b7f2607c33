"""Rendering of the phantom into an `EndoscopicSequence` with exact ground truth.

Axes are OpenCV's, lengths millimetres, depth is z-depth at pixel centres. Of two recordings the one that
trains comes first; frames of one recording are in the order of time. Only frames that are used are rendered.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from data_catalog.phantom import thorough
from data_catalog.phantom.appearance import Texture, bilinear, paint
from data_catalog.phantom.config import GENERATOR_VERSION, PhantomConfig, stream
from data_catalog.phantom.geometry import Wall, build_wall
from data_catalog.phantom.imaging import LightPair, Sensor, recording_sensor
from data_catalog.phantom.trajectories import camera_path
from data_catalog.phantom.variation import vary
from data_catalog.ray_casting import RayCaster
from extrags.cameras import Cameras, pixel_rays
from extrags.events import Progress, emit
from extrags.sequence import EndoscopicSequence, Split

__all__ = ["Phantom", "record"]

EVALUATES, TRAINS = 0, 1
_SCENE_GAIN_TARGET = 0.14
NOISE_PER_PASS = 10_000
"""So many numbers of frames each pass of an examination has for its streams of noise."""


class Phantom:
    """One colon: its wall, texture and light, ready to be photographed.

    Args:
        config: scene, setting and image size.
    """

    def __init__(self, config: PhantomConfig) -> None:
        self.config = config
        self.wall: Wall = build_wall(config)
        self.texture: Texture = paint(config, self.wall)
        self.light = LightPair.of(vary(config))
        self.rays = RayCaster(self.wall.vertices, self.wall.triangles)
        self._shape_grid = np.concatenate([self.wall.normals, self.wall.along], axis=2, dtype=np.float32)

    def intrinsics(self, width: int, height: int) -> Float[np.ndarray, "3 3"]:
        """A centred pinhole with square pixels."""
        focal = width / 2 / np.tan(np.radians(self.config.field_of_view_deg) / 2)
        return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])

    def cameras(
        self, recording: str, share: Float[np.ndarray, "n"], *, width: int = 0, height: int = 0
    ) -> Cameras:
        """Cameras of a recording at shares of its duration."""
        width, height = width or self.config.width, height or self.config.height
        poses = camera_path(self.config, self.wall, self.rays, recording, share)
        return Cameras(np.repeat(self.intrinsics(width, height)[None], len(poses), 0), poses, width, height)

    def z_depth(self, camera: Cameras) -> Float[np.ndarray, "h w"]:
        """Exact z-depth at pixel centres, float32; infinite where a ray leaves through no wall."""
        return self.rays.cast(camera.centers[0], pixel_rays(camera)[0]).distance

    def radiance(self, camera: Cameras, supersample: int) -> Float[np.ndarray, "h w 3"]:
        """Linear light that reaches the sensor at unit exposure, mean over a pixel's rays."""
        fine = camera.resized(camera.width * supersample, camera.height * supersample)
        rays = pixel_rays(fine)[0]
        center = camera.centers[0]
        hits = self.rays.cast(center, rays)
        rays = rays.reshape(-1, 3).astype(np.float32)
        depth = hits.distance.ravel()
        found = np.isfinite(depth)
        rays, depth = rays[found], depth[found]
        row, column = self.wall.grid_coordinates(
            hits.triangle.ravel()[found],
            hits.barycentric.reshape(-1, 2)[found],
        )
        length = np.sqrt(np.einsum("ij,ij->i", rays, rays))
        to_camera = -rays / length[:, None]
        shape = bilinear(self._shape_grid, row, column)
        normal, along = _unit(shape[:, :3]), _unit(shape[:, 3:])
        slant = np.clip(np.einsum("ij,ij->i", normal, to_camera), 0.08, 1)
        footprint = depth * length / (fine.K[0, 0, 0] * np.sqrt(slant))
        paint_values = self.texture.sample(row, column, footprint)
        bent = _unit(normal - paint_values[:, 3:4] * along - paint_values[:, 4:5] * np.cross(normal, along))

        rotation = camera.world_from_camera[0, :3, :3]
        to_lights, cosines, visible = [], [], []
        for offset in self.light.offsets_mm:
            position = rotation @ np.asarray(offset)
            # Relative to the camera: differences of world coordinates would lose digits in float32.
            from_lamp = rays * depth[:, None] - position.astype(np.float32)
            to_lights.append(-from_lamp)
            distance = np.sqrt(np.einsum("ij,ij->i", from_lamp, from_lamp))
            cosines.append((from_lamp @ rotation[:, 2].astype(np.float32)) / distance)
            visible.append(
                self.rays.reaches(center + position, from_lamp)
                if self.config.shadows
                else np.ones(len(rays), dtype=bool)
            )
        values = self.light.radiance(
            to_camera,
            to_lights,
            cosines,
            visible,
            normal,
            bent,
            paint_values[:, :3],
            paint_values[:, 5],
            speculars=self.config.speculars,
        )
        image = np.zeros((found.size, 3), dtype=np.float32)
        image[found] = values
        blocks = image.reshape(camera.height, supersample, camera.width, supersample, 3)
        return np.asarray(blocks.mean(axis=(1, 3)))

    def scene_gain(self) -> float:
        """Exposure that suits the scene: from a few small views of the training recording."""
        probe = self.cameras("b", np.linspace(0.1, 0.9, 5), width=40, height=32)
        levels = [np.quantile(self.radiance(probe[k], 1).mean(axis=2), 0.6) for k in range(5)]
        return float(_SCENE_GAIN_TARGET / np.median(levels))

    def photograph(
        self, camera: Cameras, sensor: Sensor, recording: int, frame: int
    ) -> tuple[UInt8[np.ndarray, "h w 3"], float]:
        """The 8-bit image of one frame and its exposure; depends on nothing but the arguments."""
        rng = stream(self.config.scene, "noise", recording, frame)
        exposure = sensor.exposure(rng)
        return sensor.develop(self.radiance(camera, self.config.supersample), exposure, rng), exposure


@dataclass(frozen=True)
class _Part:
    """Frames of one recording in the order of time: letter, number, camera, and whether it trains."""

    letters: tuple[str, ...]
    recording: int
    numbers: Int[np.ndarray, "n"]
    cameras: Cameras
    trains: Bool[np.ndarray, "n"]
    noise: Int[np.ndarray, "n"]
    """Numbers of their streams of noise."""


def record(config: PhantomConfig, name: str) -> EndoscopicSequence:
    """Render a scene's recordings and their ground truth."""
    phantom = Phantom(config)
    gain = phantom.scene_gain()
    parts = _two_recordings(phantom) if config.setting in ("sparse", "distanced") else _examination(phantom)

    rgb, recording, names = [], [], []
    sensors: dict[str, Any] = {}
    exposures: list[float] = []
    total = sum(len(part.numbers) for part in parts)
    for part in parts:
        sensor = recording_sensor(config, part.recording, gain)
        sensors |= dict.fromkeys(part.letters, sensor.as_json())
        for k, (letter, number) in enumerate(zip(part.letters, part.numbers.tolist(), strict=True)):
            image, exposure = phantom.photograph(part.cameras[k], sensor, part.recording, int(part.noise[k]))
            rgb.append(image)
            exposures.append(exposure)
            recording.append(part.recording)
            names.append(f"{letter}_{number:04d}")
            emit(Progress("ingest", len(rgb), total))
    cameras = [part.cameras for part in parts]
    trains = np.concatenate([part.trains for part in parts])
    every = Cameras.concatenated(cameras)
    depth = np.stack([phantom.z_depth(every[k]) for k in range(len(every))])
    valid = np.isfinite(depth)
    depth = np.where(valid, depth, 0).astype(np.float32)
    train, test = np.flatnonzero(trains), np.flatnonzero(~trains)
    observed = np.zeros(depth.shape, dtype=bool)
    for k in test.tolist():
        rays = pixel_rays(every[k])[0][valid[k]]
        points = every.centers[k] + rays * depth[k][valid[k]][:, None].astype(np.float64)
        observed[k][valid[k]] = phantom.rays.seen_by(points, every[train])
    truth = {
        "generator_version": GENERATOR_VERSION,
        "phantom": config.model_dump(),
        "light": phantom.light.as_json(),
        "sensor": sensors,
        "exposure": exposures,
        "scene_gain": gain,
        "polyps": [asdict(polyp) for polyp in phantom.wall.polyps],
        "separation": _separation(every[train], every[test], observed[test]),
    }
    return EndoscopicSequence(
        name=name,
        rgb=np.stack(rgb),
        K=every.K,
        mask=np.ones(depth.shape, dtype=bool),
        split=Split(config.setting, train, test),
        world_from_camera=every.world_from_camera,
        depth_mm=depth,
        recording=np.asarray(recording),
        frame_names=tuple(names),
        metric=True,
        observed=observed,
        truth=truth,
    )


def _two_recordings(phantom: Phantom) -> list[_Part]:
    """Recording B, which trains, and A, which evaluates."""
    config = phantom.config
    video, evaluation = _thinned(
        np.arange(0, config.video_frames, config.train_every),
        np.arange(config.test_frames),
        config.max_frames,
    )
    last = {"b": max(config.video_frames - 1, 1), "a": max(config.test_frames - 1, 1)}
    return [
        _Part(
            (letter,) * len(numbers),
            index,
            numbers,
            phantom.cameras(letter, numbers / last[letter]),
            np.full(len(numbers), index == TRAINS),
            numbers,
        )
        for letter, index, numbers in (("b", TRAINS, video), ("a", EVALUATES, evaluation))
    ]


def _examination(phantom: Phantom) -> list[_Part]:
    """One recording of several passes, its frames that train and those between them."""
    config = phantom.config
    plan = thorough.examination(config)
    poses = thorough.poses(config, phantom.wall, phantom.rays, plan)
    K = phantom.intrinsics(config.width, config.height)
    cameras = Cameras(np.repeat(K[None], len(poses), 0), poses, config.width, config.height)
    kept = plan.trains.copy()
    if config.setting == "pocket":
        # At one small size: which frames train does not depend on that of the images.
        small = cameras.resized(40, 32)
        depth = np.stack([phantom.z_depth(small[k]) for k in range(len(small))])
        kept &= ~thorough.sees_pocket(phantom.wall, small, depth)
    frames = np.sort(
        np.concatenate(_thinned(np.flatnonzero(kept), np.flatnonzero(~plan.trains), config.max_frames))
    )
    return [
        _Part(
            tuple(thorough.PASSES[index][0] for index in plan.passed[frames].tolist()),
            TRAINS,
            plan.number[frames],
            cameras[frames],
            plan.trains[frames],
            NOISE_PER_PASS * plan.passed[frames] + plan.number[frames],
        )
    ]


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return np.asarray(vectors / np.sqrt(np.einsum("ij,ij->i", vectors, vectors))[:, None])


def _thinned(
    train: Int[np.ndarray, "a"], test: Int[np.ndarray, "b"], max_frames: int | None
) -> tuple[Int[np.ndarray, "c"], Int[np.ndarray, "d"]]:
    """At most `max_frames` frames, spread evenly; both recordings keep their share, at least one frame."""
    total = train.size + test.size
    if max_frames is None or total <= max_frames:
        return train, test
    n_train = int(np.clip(round(max_frames * train.size / total), 1, max_frames - 1))
    n_test = min(max_frames - n_train, test.size)
    return (
        train[np.round(np.linspace(0, train.size - 1, n_train)).astype(int)],
        test[np.round(np.linspace(0, test.size - 1, n_test)).astype(int)],
    )


def _separation(train: Cameras, test: Cameras, observed: Bool[np.ndarray, "f h w"]) -> dict[str, float]:
    """How far the evaluation is from the training, as numbers."""
    distance = np.linalg.norm(test.centers[:, None] - train.centers[None], axis=2)
    nearest = distance.argmin(axis=1)
    cosine = (test.forward * train.forward[nearest]).sum(axis=1)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    unseen = 1 - observed.mean(axis=(1, 2))
    return {
        "distance_mm_median": float(np.median(distance.min(axis=1))),
        "distance_mm_max": float(distance.min(axis=1).max()),
        "axis_angle_deg_median": float(np.median(angle)),
        "axis_angle_deg_max": float(angle.max()),
        "unseen_share_mean": float(unseen.mean()),
        "unseen_share_max": float(unseen.max()),
    }
