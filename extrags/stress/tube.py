"""A recording of the inside of a lit tube, with its exact scene: what later stages are given."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from extrags.cameras import Cameras, compose, rotation_about
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, Split
from extrags.stress.inputs import UPRIGHT
from extrags.surface import Mesh
from extrags.thresholds import HOLE_ALPHA

__all__ = ["Tube", "tube"]

COUNT = 40
"""Gaussians round the tube, and along it."""
LENGTH = -0.5, 6.0
"""From where to where it reaches, in radii; it is open at both ends."""
DISC_RADIUS, DISC_THICKNESS = 4.8, 0.1
"""Of a Gaussian, in radii of the tube over the number round it, and along its normal, in its own radii."""
FOCAL_SHARE = 0.625
"""Focal length as a share of the image's width."""


@dataclass(frozen=True)
class Tube:
    """Gaussians and mesh of a tube, and a recording of them by a camera that goes along it.

    Args:
        scene: discs on the wall under a light that rides on the camera.
        mesh: the wall.
        sequence: frames rendered from the scene, with exact poses and depth.
    """

    scene: Scene
    mesh: Mesh
    sequence: EndoscopicSequence

    @property
    def cameras(self) -> Cameras:
        """Of the training frames."""
        return self.sequence.training_cameras

    @property
    def trajectories(self) -> list[Cameras]:
        """Two virtual ways of three views from training views, which turn to the side; their start first."""
        ways = []
        for start in (0, len(self.cameras) // 2):
            poses = np.repeat(self.cameras.world_from_camera[start : start + 1], 3, axis=0)
            for step in range(3):
                poses[step, :3, :3] = poses[step, :3, :3] @ rotation_about(
                    np.array([0.0, 1.0, 0.0]), 0.3 * step
                )
            ways.append(Cameras(self.cameras.K[:3], poses, self.cameras.width, self.cameras.height))
        return ways

    def with_poses(self, world_from_camera: Float[np.ndarray, "f 4 4"]) -> Tube:
        """The same frames, said to be from elsewhere."""
        return replace(self, sequence=replace(self.sequence, world_from_camera=world_from_camera))


def tube(
    *,
    unit: float = 1.0,
    offset_mm: float = 0.0,
    turn: Float[np.ndarray, "3 3"] = UPRIGHT,
    frames: int = 6,
    size: tuple[int, int] = (48, 40),
    gains: Float[np.ndarray, "f"] | None = None,
    held_out: int = 0,
    count: int = COUNT,
) -> Tube:
    """The tube in any unit, place and direction, recorded at any exposure.

    Args:
        unit: radius of the tube in world units.
        offset_mm: of everything from the origin, along each axis.
        turn: of everything about that place.
        frames: of the recording.
        size: width and height of a frame, in pixels.
        gains: exposure of each frame; None is 1.
        held_out: so many frames, spread over the recording, are not for training.
        count: Gaussians round the tube, and along it.
    """
    width, height = size
    angle, along = (
        values.ravel()
        for values in np.meshgrid(
            np.linspace(0, 2 * np.pi, count, endpoint=False), np.linspace(*LENGTH, count)
        )
    )
    # Rings of one depth would be drawn in an order that rounding decides.
    jitter = np.random.default_rng(0).uniform(-0.3, 0.3, len(along))
    along = along + jitter * (LENGTH[1] - LENGTH[0]) / count
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    local = normals + np.stack([np.zeros_like(along), np.zeros_like(along), along], axis=1)
    paint = 0.5 + 0.3 * np.sin(3 * angle + along)[:, None] * np.cos(2 * along[:, None] + np.arange(3.0))
    middle = np.full(3, offset_mm)
    gaussians = Gaussians.from_points(
        unit * local @ turn.T + middle,
        paint,
        np.full(len(local), DISC_RADIUS / count * unit),
        normals=normals @ turn.T,
        thickness=DISC_THICKNESS,
    )
    steps = np.arange(frames)
    # Ever faster: between even steps a search for the farthest view would find ties, which rounding decides.
    along_axis = 2.4 * (steps / max(frames, 6)) ** 1.2
    centers = np.stack([0.1 * np.sin(steps), 0.1 * np.cos(steps), along_axis], axis=1)
    # Of different opacities: what is the same for all Gaussians is rounded the same way.
    opacity = 0.93 + 0.05 * np.sin(5 * angle + 7 * along)
    gaussians.opacities.copy_(torch.from_numpy(np.log(opacity / (1 - opacity))))
    poses = np.stack([compose(turn, center) for center in unit * centers @ turn.T + middle])
    focal = FOCAL_SHARE * width
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    cameras = Cameras(np.tile(K, (frames, 1, 1)), poses, width, height)
    test = np.unique(np.linspace(1, frames - 2, held_out).round().astype(np.int64))
    train = np.setdiff1d(steps, test)
    gains = np.ones(frames) if gains is None else gains
    light = NearFieldLight.initial(len(train), unit)
    # The light's mean exposure is one.
    light = replace(light, log_exposure=torch.from_numpy(np.log(gains[train])).float())
    scene = Scene(gaussians, light)
    relative = gains / np.exp(np.log(gains[train]).mean())
    with torch.no_grad():
        rendering = scene.render(cameras, exposure=torch.from_numpy(relative).float())
    shown = rendering.alpha.numpy() > HOLE_ALPHA
    sequence = EndoscopicSequence(
        name="stress/tube",
        rgb=np.rint(255 * rendering.rgb.clamp(0, 1).numpy()).astype(np.uint8),
        K=cameras.K,
        mask=np.ones(shown.shape, dtype=bool),
        split=Split("stress", train, test),
        world_from_camera=poses,
        depth_mm=np.where(shown, rendering.depth.numpy(), np.float32(0)),
    )
    return Tube(scene, _wall(gaussians, count), sequence)


def _wall(gaussians: Gaussians, count: int) -> Mesh:
    row, column = np.divmod(np.arange((count - 1) * count), count)
    right = (column + 1) % count
    low, high = row * count, (row + 1) * count
    triangles = np.concatenate(
        [
            np.stack([low + column, low + right, high + column], axis=1),
            np.stack([low + right, high + right, high + column], axis=1),
        ]
    )
    return Mesh(gaussians.means.numpy(), triangles.astype(np.int32))
