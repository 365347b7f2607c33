"""What one optimisation step is supervised with, and the order in which views are drawn."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrags.cameras import Cameras
from extrags.sequence import EndoscopicSequence, saturated_mask

__all__ = ["View", "depth_confidence", "epochs", "real_views"]


@dataclass(frozen=True)
class View:
    """One image to be matched.

    Args:
        camera: a single camera.
        rgb: the target in [0, 1], [H, W, 3].
        weight: per-pixel weight of the colour terms; zero outside the mask, [H, W].
        depth_mm: z-depth, 0 where it does not supervise, [H, W]; None without depth.
        frame: position among the training frames, for its exposure; None for a virtual view.
        loss_weight: weight of the whole view.
        ssim_weight: per-pixel weight of the SSIM term where that is another, [H, W]; None takes `weight`.
        normalisation: pixels that the weighted sums of the colour terms are divided by; None is the sum of
            `weight`, which makes them weighted means.
        depth_confidence: weight of the depth term per pixel, in [0, 1], [H, W]; None is one.
    """

    camera: Cameras
    rgb: Float[Tensor, "h w 3"]
    weight: Float[Tensor, "h w"]
    depth_mm: Float[Tensor, "h w"] | None
    frame: int | None
    loss_weight: float = 1.0
    ssim_weight: Float[Tensor, "h w"] | None = None
    normalisation: float | None = None
    depth_confidence: Float[Tensor, "h w"] | None = None

    def to(self, device: torch.device | str) -> View:
        """The same view with its images on a device; this very one where they are there already."""
        if self.rgb.device == torch.device(device):
            return self
        images: dict[str, Any] = {
            name: value.to(device) for name, value in vars(self).items() if isinstance(value, Tensor)
        }
        return replace(self, **images)


CONFIDENT_ERROR = 0.15
"""Expected relative error of an estimated depth that has half the weight of a measured one."""


def depth_confidence(expected_error: Float[np.ndarray, "*f h w"]) -> Float[np.ndarray, "*f h w"]:
    """Weight of estimated depth in the loss: one where it is sure, else as the inverse square of its error.

    Args:
        expected_error: relative, as in `EndoscopicSequence.depth_error`.
    """
    return np.asarray(1 / (1 + np.square(expected_error / CONFIDENT_ERROR)), dtype=np.float32)


def real_views(sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"]) -> list[View]:
    """The training frames as views; saturated pixels and specular highlights carry no weight."""
    cameras = sequence.cameras
    views = []
    for position, frame in enumerate(frames):
        index = int(frame)
        mask = sequence.mask[index]
        # A saturated channel says nothing about albedo.
        weight = sequence.supervised_mask(index) & ~saturated_mask(sequence.rgb[index])
        depth = None
        if sequence.depth_mm is not None:
            depth = torch.from_numpy(np.where(mask, sequence.depth_mm[index], 0).astype(np.float32))
        views.append(
            View(
                camera=cameras[index],
                rgb=torch.from_numpy(sequence.rgb[index].astype(np.float32) / 255),
                weight=torch.from_numpy(weight.astype(np.float32)),
                depth_mm=depth,
                frame=position,
                depth_confidence=None
                if sequence.depth_error is None
                else torch.from_numpy(depth_confidence(sequence.depth_error[index])),
            )
        )
    return views


def epochs(count: int, generator: np.random.Generator) -> Iterator[int]:
    """Endless indices in random order, each once per epoch."""
    while True:
        yield from generator.permutation(count).tolist()
