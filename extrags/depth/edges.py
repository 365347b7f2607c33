"""Sharp edges of depth: what lies between a fold and the wall behind it belongs to one of them."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from extrags.depth.frames import PosedFrames

__all__ = ["sharpened"]

RADIUS_PX = 3
"""Windows have sides of 2 radius + 1 pixels."""

EDGE = 0.05
"""Range of log-depths in a window from which on it holds an edge; elsewhere depth stays as it is."""

COLOR_SPREAD = 0.4
"""Distance of log-colours at which a neighbour's vote falls to exp(-1/2): a lit fold against a dark lumen."""

PLACE_SPREAD_PX = 2.0
"""The same of places."""

CERTAIN = 0.02
"""Added to expected errors, whose inverse squares are votes: a few percent are as good as none."""


def sharpened(
    log_depth: Float[Tensor, "f h w"], error: Float[Tensor, "f h w"], frames: PosedFrames
) -> Float[Tensor, "f h w"]:
    """Weighted median of depth in windows that hold an edge.

    A network trained on mean errors draws a ramp where depth jumps, and Gaussians that start on it hang in
    the air behind every fold. The median takes one of the depths of the neighbours, which vote by likeness of
    colour, nearness and expected error.

    Args:
        log_depth: of all frames.
        error: expected absolute error of it.
        frames: their pictures and masks.

    Source: [Ma2013], with expected errors among the weights; see docs/references.md.
    """
    return torch.stack(
        [_sharpened(log_depth[f], error[f], frames.rgb[f], frames.mask[f]) for f in range(len(frames))]
    )


def _sharpened(
    log_depth: Float[Tensor, "h w"],
    error: Float[Tensor, "h w"],
    rgb: Float[Tensor, "3 h w"],
    mask: Bool[Tensor, "h w"],
) -> Float[Tensor, "h w"]:
    side = 2 * RADIUS_PX + 1
    padded = functional.pad(log_depth[None], (RADIUS_PX,) * 4, mode="replicate")
    highest = functional.max_pool2d(padded, side, stride=1)[0]
    lowest = -functional.max_pool2d(-padded, side, stride=1)[0]
    rows, columns = torch.nonzero((highest - lowest > EDGE) & mask, as_tuple=True)
    if len(rows) == 0:
        return log_depth
    height, width = log_depth.shape
    reach = torch.arange(-RADIUS_PX, RADIUS_PX + 1, device=log_depth.device)
    down, right = torch.meshgrid(reach, reach, indexing="ij")
    y = (rows[:, None] + down.reshape(1, -1)).clamp(0, height - 1)
    x = (columns[:, None] + right.reshape(1, -1)).clamp(0, width - 1)
    color = torch.log(rgb + 0.03)
    unlike = (color[:, y, x] - color[:, rows, columns][:, :, None]).square().sum(0)
    apart = (down.square() + right.square()).reshape(1, -1)
    votes = torch.exp(-0.5 * (unlike / COLOR_SPREAD**2 + apart / PLACE_SPREAD_PX**2))
    votes = votes * mask[y, x] / (CERTAIN + error[y, x]).square()
    ordered, order = log_depth[y, x].sort(dim=1)
    gathered = votes.gather(1, order).cumsum(1)
    middle = (gathered >= gathered[:, -1:] / 2).float().argmax(dim=1, keepdim=True)
    found = log_depth.clone()
    found[rows, columns] = ordered.gather(1, middle)[:, 0]
    return found
