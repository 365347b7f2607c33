"""Inputs of a pretrained model from a clip: images, mask, ranked real views, a seed per window."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from extrags.restoration.protocol import Clip
from extrags.view_synthesis.conditioning import condition

__all__ = ["clip_inputs", "ranked_references", "window_seed"]


def clip_inputs(
    clip: Clip, threshold: float, dilation_px: int
) -> tuple[Float[np.ndarray, "t h w 3"], Bool[np.ndarray, "t h w"]]:
    """Base images of a clip, and the mask of what neither scene nor real views show well enough.

    Args:
        clip: rendered views.
        threshold: pixels known by less than this count as unknown.
        dilation_px: unknown areas grow by so much.

    Returns:
        Light-compensated real views over the rendering, with holes filled, [T, H, W, 3]; and the mask.
    """
    from kornia.morphology import dilation

    with torch.no_grad():
        base = condition(clip.layers, clip.transfer).base
        sure = torch.maximum(1 - clip.layers.get("uncertainty"), clip.layers.get("blend_weight"))
        unknown = (sure < threshold).to(torch.float32)
        if dilation_px:
            side = 2 * dilation_px + 1
            unknown = dilation(unknown, torch.ones(side, side))
    return base.permute(0, 2, 3, 1).contiguous().numpy(), unknown[:, 0].numpy() > 0.5


def ranked_references(reference: Int[np.ndarray, "t"]) -> Int[np.ndarray, "r"]:
    """Distinct references of a window: the first frame's first, then by how many frames they serve."""
    values, counts = np.unique(reference, return_counts=True)
    order = sorted(
        zip(values, counts, strict=True), key=lambda row: (row[0] != reference[0], -row[1], row[0])
    )
    return np.array([value for value, _ in order], dtype=np.int64)


def window_seed(seed: int, clip: int, window: int) -> int:
    """Seed of a window; independent of process and order."""
    return int(np.random.SeedSequence([seed, 5, clip, window]).generate_state(1, np.uint64)[0] >> 1)
