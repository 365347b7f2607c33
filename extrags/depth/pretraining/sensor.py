"""What a sensor makes of radiance: exposure, blur, tone curve, noise, eight bits, compression."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrags.depth.pretraining.cavities import Cavities

__all__ = ["Sensor", "compressed"]

BADLY_EXPOSED, DEFOCUSED, SHAKEN, NOISY, COMPRESSED = 0.2, 0.2, 0.2, 0.2, 0.35
"""Shares of the clips with each flaw; they fall independently."""

LONGEST_SHAKE_PX = 5.0
SHAKE_TAPS = 5
BLUR_TAPS = 4
BLOCK = 8


class Sensor:
    """Exposure, vignetting, tone curve, blur by focus and by motion, noise, eight bits, compression.

    Args:
        scene: whose generator draws, one sensor per clip.
        views: frames per clip.
    """

    def __init__(self, scene: Cavities, views: int) -> None:
        c, uniform = scene.scenes, scene.uniform

        def falls(share: float) -> Tensor:
            return uniform(0.0, 1.0, c) < share

        badly = falls(BADLY_EXPOSED)[:, None]
        self.target = torch.where(badly, uniform(0.06, 1.1, c, 1), uniform(0.25, 0.6, c, 1))
        self.drift = uniform(0.0, 0.12, c, 1) * uniform(-1.0, 1.0, c, views)
        self.automatic = (uniform(0.0, 1.0, c, 1) < 0.3).float()
        self.vignetting = uniform(0.0, 0.4, c)
        self.gamma = uniform(1.0, 2.4, c)
        self.shoulder = (uniform(0.0, 1.0, c) < 0.5).float()
        self.noise = torch.where(falls(NOISY), uniform(0.012, 0.03, c), uniform(0.0, 0.012, c))
        self.blur = torch.where(falls(DEFOCUSED), uniform(0.8, 2.0, c), uniform(0.0, 0.8, c))
        length = falls(SHAKEN)[:, None] * uniform(0.0, LONGEST_SHAKE_PX, c, 1) * uniform(0.0, 1.0, c, views)
        angle = uniform(0.0, 2 * math.pi, c, views)
        self.shake_px = length[:, :, None] * torch.stack([angle.cos(), angle.sin()], dim=2)
        self.loss = falls(COMPRESSED) * uniform(0.1, 1.0, c)

    def develop(
        self, radiance: Float[Tensor, "c v 3 h w"], generator: torch.Generator
    ) -> Float[Tensor, "c v 3 h w"]:
        """Images in [0, 1] of linear radiance."""
        _c, views, _, height, width = radiance.shape
        brightness = radiance.mean(2).flatten(2)
        per_view = brightness.kthvalue(int(0.75 * brightness.shape[2]), dim=2).values.clamp_min(1e-6)
        common = per_view.mean(1, keepdim=True)
        gain = (
            self.target / (self.automatic * per_view + (1 - self.automatic) * common) * torch.exp(self.drift)
        )
        y = ((torch.arange(height, device=radiance.device) + 0.5) / height * 2 - 1)[:, None]
        x = ((torch.arange(width, device=radiance.device) + 0.5) / width * 2 - 1)[None]
        shade = 1 - self.vignetting[:, None, None] * 0.5 * (x.square() + y.square())
        signal = radiance * gain[:, :, None, None, None] * shade[:, None, None]
        sigma = self.noise[:, None, None, None, None] * (signal.clamp_min(0).sqrt() + 0.3)
        # A sensor is full long before a highlight is: else its blur would cover everything.
        signal = _shaken(signal.clamp_max(4.0), self.shake_px)
        curved = torch.where(
            self.shoulder[:, None, None, None, None] > 0, 1 - torch.exp(-1.3 * signal), signal
        )
        blurred = _blur(curved, self.blur)
        noisy = blurred + sigma * torch.randn(blurred.shape, generator=generator, device=blurred.device)
        toned = noisy.clamp(1e-6, 1) ** (1 / self.gamma[:, None, None, None, None])
        kept = compressed(toned.flatten(0, 1), self.loss.repeat_interleave(views))
        return torch.round(kept.unflatten(0, radiance.shape[:2]).clamp(0, 1) * 255) / 255


def compressed(images: Float[Tensor, "f 3 h w"], loss: Float[Tensor, "f"]) -> Float[Tensor, "f 3 h w"]:
    """Images as lossy compression leaves them: cosine transforms of 8 x 8 pixels, coarsely rounded.

    Args:
        images: in [0, 1].
        loss: of each; 0 leaves it as it is, 1 spoils it visibly.
    """
    height, width = images.shape[2:]
    device = images.device
    order = torch.arange(BLOCK, device=device, dtype=torch.float32)
    basis = torch.cos(math.pi / BLOCK * (order[None] + 0.5) * order[:, None]) * math.sqrt(2 / BLOCK)
    basis[0] = basis[0] / math.sqrt(2)
    colors = torch.tensor(
        [[0.299, 0.587, 0.114], [-0.169, -0.331, 0.5], [0.5, -0.419, -0.081]], device=device
    )
    value = torch.einsum("ij,fjhw->fihw", colors, images)
    value = functional.pad(value, (0, -width % BLOCK, 0, -height % BLOCK), mode="replicate")
    blocks = value.unflatten(3, (-1, BLOCK)).unflatten(2, (-1, BLOCK)).transpose(3, 4)
    transformed = basis @ blocks @ basis.T
    step = (10 + 6 * (order[None] + order[:, None])) / 255
    step = step * torch.tensor([1.0, 1.5, 1.5], device=device)[:, None, None, None, None]
    step = step * loss.clamp_min(1e-6)[:, None, None, None, None, None]
    restored = basis.T @ (torch.round(transformed / step) * step) @ basis
    value = restored.transpose(3, 4).flatten(4, 5).flatten(2, 3)[:, :, :height, :width]
    result = torch.einsum("ij,fjhw->fihw", torch.linalg.inv(colors), value)
    chosen: Tensor = torch.where(loss[:, None, None, None] > 0, result, images)
    return chosen


def _shaken(images: Tensor, shift_px: Tensor) -> Tensor:
    """Means along a straight way of the length and direction given, in pixels, [C, V, 2]."""
    height, width = images.shape[3:]
    flat, shift = images.flatten(0, 1), shift_px.flatten(0, 1)
    total = torch.zeros_like(flat)
    eye = torch.eye(2, 3, device=images.device).repeat(len(flat), 1, 1)
    scale = torch.tensor([2 / width, 2 / height], device=images.device)
    for tap in range(SHAKE_TAPS):
        placed = eye.clone()
        placed[:, :, 2] = (tap / (SHAKE_TAPS - 1) - 0.5) * shift * scale
        grid = functional.affine_grid(placed, list(flat.shape), align_corners=False)
        total += functional.grid_sample(flat, grid, padding_mode="border", align_corners=False)
    moved = shift.abs().sum(1) > 0
    result: Tensor = torch.where(moved[:, None, None, None], total / SHAKE_TAPS, flat).unflatten(
        0, images.shape[:2]
    )
    return result


def _blur(images: Tensor, sigma: Tensor) -> Tensor:
    c, views, channels, height, width = images.shape
    taps = torch.arange(-BLUR_TAPS, BLUR_TAPS + 1, device=images.device, dtype=torch.float32)
    kernel = torch.exp(-0.5 * (taps / sigma.clamp_min(0.05)[:, None]).square())
    kernel = kernel / kernel.sum(1, keepdim=True)
    flat = images.permute(1, 2, 0, 3, 4).reshape(views * channels, c, height, width)
    border = (BLUR_TAPS, BLUR_TAPS)
    flat = functional.conv2d(
        functional.pad(flat, (*border, 0, 0), mode="replicate"), kernel[:, None, None], groups=c
    )
    flat = functional.conv2d(
        functional.pad(flat, (0, 0, *border), mode="replicate"), kernel[:, None, :, None], groups=c
    )
    return flat.reshape(views, channels, c, height, width).permute(2, 0, 1, 3, 4)
