"""What one optimisation step is supervised with, and the order in which views are drawn.

Views stay in memory for a whole training, so they hold images as compactly as loses nothing: colours and
weights that are steps of 1/255 as such, in 8 bits, and masks as truth values. A step decodes the one that it
draws.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from extrags.cameras import Cameras
from extrags.frame_stacks import FrameStack
from extrags.sequence import EndoscopicSequence
from extrags.thresholds import SATURATED

__all__ = ["View", "depth_confidence", "epochs", "in_steps", "real_views"]


@dataclass(frozen=True)
class View:
    """One image to be matched.

    Args:
        camera: a single camera.
        rgb: the target in [0, 1], or uint8 in steps of 1/255, [H, W, 3].
        weight: per-pixel weight of the colour terms; zero outside the mask, [H, W]. Floats, uint8 in steps
            of 1/255, or truth values.
        depth_mm: z-depth, 0 where it does not supervise, [H, W]; None without depth.
        frame: position among the training frames, for its exposure; None for a virtual view.
        loss_weight: weight of the whole view.
        ssim_weight: per-pixel weight of the SSIM term where that is another, [H, W]; None takes `weight`.
        normalisation: pixels that the weighted sums of the colour terms are divided by; None is the sum of
            `weight`, which makes them weighted means.
        depth_confidence: weight of the depth term per pixel, in [0, 1], [H, W]; None is one.
        shown: pixels that belong to the picture, [H, W]; what lies beyond its mask is black in rendering and
            target, as beyond the edge of the image, so that no window of SSIM compares it. None: all.
        least_weight: what smaller weights of pixels are raised to where they are stored in steps.
        weight_factor: of all weights of pixels.
        saturating: saturated channels of `rgb` show that there is at least so much: what is rendered brighter
            is as right.
    """

    camera: Cameras
    rgb: Float[Tensor, "h w 3"] | UInt8[Tensor, "h w 3"]
    weight: Float[Tensor, "h w"] | UInt8[Tensor, "h w"] | Bool[Tensor, "h w"]
    depth_mm: Float[Tensor, "h w"] | None
    frame: int | None
    loss_weight: float = 1.0
    ssim_weight: Float[Tensor, "h w"] | None = None
    normalisation: float | None = None
    depth_confidence: Float[Tensor, "h w"] | None = None
    shown: Bool[Tensor, "h w"] | None = None
    least_weight: float = 0.0
    weight_factor: float = 1.0
    saturating: bool = False

    @property
    def colors(self) -> Float[Tensor, "h w 3"]:
        """The target in [0, 1]; decoded anew whenever it is asked for."""
        return _from_steps(self.rgb)

    @property
    def saturated(self) -> Bool[Tensor, "h w 3"] | None:
        """Channels of which the target only tells that they are white or brighter; None without any."""
        if not self.saturating:
            return None
        # Floats are as far as halfway to the step below.
        return self.rgb >= (SATURATED if self.rgb.dtype == torch.uint8 else (SATURATED - 0.5) / 255)

    @property
    def weights(self) -> Float[Tensor, "h w"]:
        """Weight of the colour terms; decoded anew whenever it is asked for."""
        weights = self.weight
        if weights.dtype == torch.bool:
            weights = weights.view(torch.uint8).to(torch.float32)  # Faster than from truth values.
        elif weights.dtype == torch.uint8:
            weights = _from_steps(weights).clamp_(min=self.least_weight)
        return weights if self.weight_factor == 1 else weights * self.weight_factor

    def to(self, device: torch.device | str) -> View:
        """The same view with its images on a device; this very one where they are there already."""
        if self.rgb.device == torch.device(device):
            return self
        images: dict[str, Any] = {
            name: value.to(device) for name, value in vars(self).items() if isinstance(value, Tensor)
        }
        return replace(self, **images)


def _from_steps(values: Tensor) -> Tensor:
    """Steps of 1/255 in [0, 1]; others as they are.

    The divisor is a tensor, since a GPU multiplies with the inverse of a plain number, which rounds
    otherwise.
    """
    if values.dtype != torch.uint8:
        return values
    decoded = values.to(torch.float32)
    return decoded.div_(torch.full((), 255.0, device=decoded.device))


def in_steps(values: Float[np.ndarray, "*n"]) -> UInt8[Tensor, "*n"] | Float[Tensor, "*n"]:
    """Values that are steps of 1/255 in [0, 1] in 8 bits, as stored images are; others as a float32 copy.

    Args:
        values: of any shape.

    Returns:
        What `View.colors` and `View.weights` decode to the same float32 values, bit by bit.
    """
    exact = np.array(values, dtype=np.float32)
    # Not a number is no step.
    with np.errstate(invalid="ignore"):
        steps = np.rint(exact * np.float32(255)).clip(0, 255).astype(np.uint8)
    stored = torch.from_numpy(steps)
    found = torch.from_numpy(exact)
    return stored if torch.equal(_from_steps(stored), found) else found


def _shared(array: np.ndarray) -> Tensor:
    """An array as a tensor in the same memory; a copy where that is read-only or has gaps."""
    return torch.from_numpy(np.require(array, requirements=("C", "W")))


CONFIDENT_ERROR = 0.15
"""Expected relative error of an estimated depth that has half the weight of a measured one."""


def depth_confidence(expected_error: Float[np.ndarray, "*f h w"]) -> Float[np.ndarray, "*f h w"]:
    """Weight of estimated depth in the loss: one where it is sure, else as the inverse square of its error.

    Args:
        expected_error: relative, as in `EndoscopicSequence.depth_error`.
    """
    return np.asarray(1 / (1 + np.square(expected_error / CONFIDENT_ERROR)), dtype=np.float32)


def real_views(sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"]) -> list[View]:
    """The training frames as views; highlights and pixels that are saturated in all channels weigh nothing.

    Of others, a saturated channel tells that there is at least so much.

    Colours, and depth that is zero outside the mask already, share the memory of the sequence; what is made
    of many large frames lies in mapped files, as they do (`extrags.frame_stacks`).
    """
    cameras = sequence.cameras
    count = len(frames)
    weights, depths, confidences = FrameStack(count), FrameStack(count), FrameStack(count)
    masks = FrameStack(count)
    views = []
    picture: np.ndarray | None = None
    for position, frame in enumerate(frames):
        index = int(frame)
        saturated = sequence.rgb[index] >= SATURATED
        # Where all channels are, nothing tells a wall that is too near from a highlight.
        weight = sequence.supervised_mask(index) & ~saturated.all(axis=-1)
        depth = confidence = None
        mask = sequence.mask[index]
        if sequence.depth_mm is not None:
            depth = sequence.depth_mm[index]
            if depth.dtype != np.float32 or depth[~mask].any():
                depth = depths.append(np.where(mask, depth, 0).astype(np.float32))
            depth = _shared(depth)
        shown = None
        if not mask.all():
            # Most recordings have one for all frames.
            if picture is None or not np.array_equal(picture, mask):
                picture = masks.append(mask)
            shown = _shared(picture)
        if sequence.depth_error is not None:
            confidence = _shared(confidences.append(depth_confidence(sequence.depth_error[index])))
        views.append(
            View(
                camera=cameras[index],
                rgb=_shared(sequence.rgb[index]),
                weight=_shared(weights.append(weight)),
                depth_mm=depth,
                frame=position,
                depth_confidence=confidence,
                shown=shown,
                saturating=bool(saturated.any()),
            )
        )
    return views


def epochs(count: int, generator: np.random.Generator) -> Iterator[int]:
    """Endless indices in random order, each once per epoch."""
    while True:
        yield from generator.permutation(count).tolist()
