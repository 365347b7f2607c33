"""What one optimisation step is supervised with, and the order in which views are drawn."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrags.cameras import Cameras
from extrags.sequence import EndoscopicSequence, saturated_mask

__all__ = ["View", "epochs", "real_views"]


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
    """

    camera: Cameras
    rgb: Float[Tensor, "h w 3"]
    weight: Float[Tensor, "h w"]
    depth_mm: Float[Tensor, "h w"] | None
    frame: int | None
    loss_weight: float = 1.0
    ssim_weight: Float[Tensor, "h w"] | None = None
    normalisation: float | None = None


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
            )
        )
    return views


def epochs(count: int, generator: np.random.Generator) -> Iterator[int]:
    """Endless indices in random order, each once per epoch."""
    while True:
        yield from generator.permutation(count).tolist()
