"""Choice of the patches of a scene's frames that the restorer takes texture from."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.metrics.filters import filter_separable, gaussian_weights
from extrags.sequence import EndoscopicSequence, saturated_mask

__all__ = ["PATCHES", "PATCH_PX", "choose_patches"]

PATCHES = 8
PATCH_PX = 64
"""Side of a patch; smaller where frames are smaller, always a multiple of 8."""
MAX_FRAMES = 64
DARKEST, BRIGHTEST = 0.08, 0.85
"""Mean brightness of usable patches."""
MAX_SATURATED_SHARE = 0.1
DETAIL_SIGMA_PX = 1.5
DETAIL_RADIUS_PX = 4


def choose_patches(
    sequence: EndoscopicSequence, *, count: int = PATCHES, side_px: int = PATCH_PX
) -> Float[Tensor, "r 3 s s"] | None:
    """Patches with much texture, from training frames far from each other.

    Frames are cut into tiles. Of each frame the tile with the most detail for its brightness counts that is
    valid, neither dark nor glaring; of these tiles the ones with the most detail are taken, one from each run
    of neighbouring frames.

    Args:
        sequence: with training frames.
        count: how many patches at most.
        side_px: side of a patch.

    Returns:
        Colours in [0, 1]; None where no tile is usable, as in frames of fewer than 8 pixels a side.
    """
    height, width = sequence.rgb.shape[1:3]
    side = min(side_px, height // 8 * 8, width // 8 * 8)
    if side < 8:
        return None
    train = np.asarray(sequence.train, dtype=np.int64)
    frames = train[np.unique(np.linspace(0, len(train) - 1, min(len(train), MAX_FRAMES)).round().astype(int))]
    chosen: list[Tensor] = []
    for run in np.array_split(frames, min(count, len(frames))):
        best, most = None, -1.0
        for frame in run:
            for patch, detail in _tiles(sequence, int(frame), side):
                if detail > most:
                    best, most = patch, detail
        if best is not None:
            chosen.append(best)
    if not chosen:
        return None
    return torch.stack([chosen[index % len(chosen)] for index in range(count)])


def _tiles(sequence: EndoscopicSequence, frame: int, side: int) -> list[tuple[Tensor, float]]:
    """Usable tiles of a frame, each with its detail."""
    rgb = torch.from_numpy(sequence.rgb[frame].astype(np.float32) / 255).permute(2, 0, 1)
    valid = sequence.mask[frame]
    glaring = saturated_mask(sequence.rgb[[frame]])[0]
    gray = rgb.mean(dim=0)[None, None]
    window = gaussian_weights(DETAIL_SIGMA_PX, DETAIL_RADIUS_PX)
    fine = (gray - filter_separable(gray, window, window))[0, 0].abs()
    found = []
    for top in range(0, gray.shape[-2] - side + 1, side // 2):
        for left in range(0, gray.shape[-1] - side + 1, side // 2):
            part = (slice(top, top + side), slice(left, left + side))
            brightness = float(gray[0, 0][part].mean())
            usable = bool(valid[part].all()) and glaring[part].mean() <= MAX_SATURATED_SHARE
            if usable and DARKEST < brightness < BRIGHTEST:
                found.append((rgb[(slice(None), *part)], float(fine[part].mean()) / brightness))
    return found
