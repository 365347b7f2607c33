"""Posed frames as tensors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

__all__ = ["PosedFrames", "source_from_reference"]


@dataclass(frozen=True)
class PosedFrames:
    """What stereo reads of frames with known poses, on one device.

    Args:
        rgb: colours in [0, 1], [F, 3, H, W].
        mask: pixels that show tissue, [F, H, W].
        K: pinhole intrinsics in pixels, pixel centres at +0.5, [F, 3, 3].
        world_from_camera: poses, OpenCV axes, [F, 4, 4].
    """

    rgb: Float[Tensor, "f 3 h w"]
    mask: Bool[Tensor, "f h w"]
    K: Float[Tensor, "f 3 3"]
    world_from_camera: Float[Tensor, "f 4 4"]

    def __len__(self) -> int:
        return int(self.rgb.shape[0])

    def of_frames(self, chosen: Int[Tensor, "k"]) -> PosedFrames:
        """Some of the frames."""
        return PosedFrames(
            self.rgb[chosen], self.mask[chosen], self.K[chosen], self.world_from_camera[chosen]
        )

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return int(self.rgb.shape[2]), int(self.rgb.shape[3])

    @cached_property
    def rays(self) -> Float[Tensor, "f 3 h w"]:
        """Directions through the pixels' centres in camera coordinates, with z = 1."""
        height, width = self.size
        rows, columns = torch.meshgrid(
            torch.arange(height, device=self.rgb.device) + 0.5,
            torch.arange(width, device=self.rgb.device) + 0.5,
            indexing="ij",
        )
        fx, fy, cx, cy = (self.K[:, i, j, None, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        x, y = (columns - cx) / fx, (rows - cy) / fy
        return torch.stack([x, y, torch.ones_like(x)], dim=1)

    @cached_property
    def grey(self) -> Float[Tensor, "f h w"]:
        """What is correlated: the logarithm of brightness, in which a change of exposure is an offset.

        Green and blue carry the vessels; red is nearly the same everywhere on mucosa.
        """
        weights = torch.tensor([0.2, 0.5, 0.3], device=self.rgb.device)
        return torch.log(torch.einsum("fchw,c->fhw", self.rgb, weights) + 0.03)


def source_from_reference(
    frames: PosedFrames, reference: Int[Tensor, "b"], source: Int[Tensor, "b"]
) -> Float[Tensor, "b 3 4"]:
    """Rigid motions from camera coordinates of `reference` to those of `source`."""
    to_world = frames.world_from_camera[reference]
    from_world = torch.linalg.inv(frames.world_from_camera[source])
    motion: Tensor = (from_world @ to_world)[:, :3]
    return motion
