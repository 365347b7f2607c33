"""Training frames as reference images of pretrained models, saved with the restorer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from extrags.errors import ShapeError
from extrags.frame_stacks import frames_of, stacked
from extrags.illumination import NearFieldLight
from extrags.restoration.protocol import Clip
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.view_synthesis.references import LightTransfer
from extrags.zarr_io import new_group, open_group, read_array, write_array, write_frames

__all__ = ["RealViews"]


@dataclass(frozen=True)
class RealViews:
    """The training frames at the scene's mean exposure: the brightness virtual views are rendered at.

    Args:
        rgb: [R, H, W, 3].
        world_from_camera: [R, 4, 4].
    """

    rgb: UInt8[np.ndarray, "r h w 3"]
    world_from_camera: Float[np.ndarray, "r 4 4"]

    def __len__(self) -> int:
        return len(self.rgb)

    def images(
        self, index: Int[np.ndarray, "n"], clip: Clip, chosen: slice = slice(None)
    ) -> Float[np.ndarray, "n h w 3"]:
        """Chosen frames in [0, 1], of the size and at the mean exposure of the views they are continued into.

        Views are restored at the working size (`enhance.max_width`), which the frames may exceed; their
        colours are then means over the area of a pixel.

        Args:
            index: of the frames.
            clip: whose views these are.
            chosen: which of its views.
        """
        frames = _resized(self.rgb[index], clip.cameras.width, clip.cameras.height) / np.float32(255)
        if clip.exposure is None:
            return frames
        transfer, gain = clip.transfer, float(np.mean(clip.exposure[chosen]))
        return _brightened(torch.from_numpy(frames), transfer, gain)

    @classmethod
    def gather(cls, scene: Scene, sequence: EndoscopicSequence) -> RealViews:
        """The frames a scene was trained on.

        Args:
            scene: the reconstruction; its light has each frame's exposure.
            sequence: posed frames; training frames only are taken.

        Raises:
            ShapeError: when the light's exposures are not those of the training frames.
        """
        frames, light = sequence.train, scene.light
        poses = sequence.cameras.world_from_camera[frames]
        if light is None:
            return cls(frames_of(sequence.rgb, frames), poses)
        if len(light.log_exposure) != len(frames):
            raise ShapeError(
                f"the scene's light has {len(light.log_exposure)} exposures for {len(frames)} frames"
            )

        def at_mean_exposure(frame: int, gain: Tensor) -> UInt8[np.ndarray, "h w 3"]:
            shown = torch.from_numpy(sequence.rgb[frame].astype(np.float32) / 255)
            return np.asarray(np.rint(_brightened(shown, light, 1 / gain) * 255).astype(np.uint8))

        # One at a time: as floats, the frames of a long recording would not be in memory at once.
        gains = light.exposures().detach()
        found = (at_mean_exposure(int(frame), gain) for frame, gain in zip(frames, gains, strict=True))
        return cls(stacked(found, len(frames)), poses)

    def save(self, path: Path) -> None:
        """Write a zarr v3 group, one frame per chunk."""
        with new_group(path) as group:
            write_frames(group, "rgb", self.rgb)
            write_array(group, "world_from_camera", self.world_from_camera)

    @classmethod
    def load(cls, path: Path) -> RealViews:
        """Read what `save` wrote."""
        group = open_group(path)
        return cls(read_array(group, "rgb"), read_array(group, "world_from_camera"))


def _resized(frames: UInt8[np.ndarray, "n h w 3"], width: int, height: int) -> Float[np.ndarray, "n h2 w2 3"]:
    images = frames.astype(np.float32)
    if images.shape[1:3] == (height, width):
        return images
    import cv2

    smaller = np.empty((len(images), height, width, 3), np.float32)
    for position, image in enumerate(images):
        smaller[position] = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return smaller


def _brightened(
    rgb: Float[Tensor, "*n h w 3"], transfer: LightTransfer | NearFieldLight, gain: float | Tensor
) -> Float[np.ndarray, "*n h w 3"]:
    """Colours at another exposure; those darker than the glare, such as a black border, stay."""
    signal = transfer.invert_response(rgb)
    shown = torch.where(signal > 0, transfer.apply_response(gain * signal), rgb)
    return np.asarray(shown.detach().clamp(0, 1).numpy())
