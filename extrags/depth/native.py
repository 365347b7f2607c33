"""The native kernels of stereo; `extrags.depth.matching` is their specification, and serves other devices."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrags.depth.frames import PosedFrames, source_from_reference
from extrags.depth.matching import centred_brightness, kept_sources
from extrags.raster.native import compiled_kernels

__all__ = ["best_steps", "matching_cost"]


def matching_cost(
    frames: PosedFrames,
    references: Int[Tensor, "b"],
    sources: Int[Tensor, "b s"],
    base_depth: Float[Tensor, "b h w"],
    offsets: Float[Tensor, "b d"],
    *,
    radius_px: int = 3,
    best_share: float = 0.5,
) -> Float[Tensor, "b d h w"]:
    """As `extrags.depth.matching.matching_cost`, on the processor."""
    kernels = compiled_kernels()
    height, width = frames.size
    grey = frames.grey
    centred = centred_brightness(grey, frames.mask, references, radius_px)
    greys = grey.numpy()
    used = torch.cat([references, sources[sources >= 0]]).unique().tolist()
    masks = {frame: frames.mask[frame].numpy().astype(np.float32) for frame in used}
    costs = torch.empty(len(references), offsets.shape[1], height, width)
    ratios = torch.exp(offsets).numpy()
    K = frames.K.double()
    for row, reference in enumerate(references.tolist()):
        chosen = [int(source) for source in sources[row].tolist() if source >= 0]
        if not chosen:
            costs[row] = 1.0
            continue
        packed = []
        for source in chosen:
            pair = torch.tensor([reference]), torch.tensor([source])
            motion = source_from_reference(frames, *pair)[0].double()
            from_pixel = K[source] @ motion[:, :3] @ torch.linalg.inv(K[reference])
            offset = K[source] @ motion[:, 3]
            packed.append((greys[source], masks[source], _flat(from_pixel), _flat(offset)))
        kernels.sweep(
            np.ascontiguousarray(centred[row].numpy()),
            masks[reference],
            np.ascontiguousarray(base_depth[row].numpy()),
            np.ascontiguousarray(ratios[row]),
            packed,
            int(kept_sources(sources[row : row + 1], best_share)[0]),
            radius_px,
            costs[row].numpy(),
        )
    return costs


def best_steps(
    cost: Float[Tensor, "b d h w"],
    grey: Float[Tensor, "b h w"],
    *,
    small_step: float,
    jump: float,
    edge: float = 0.15,
) -> tuple[Float[Tensor, "b h w"], Float[Tensor, "b h w"], Float[Tensor, "b h w"]]:
    """As `extrags.depth.matching.best_steps`, on the processor."""
    kernels = compiled_kernels()
    results = torch.empty(3, *grey.shape)
    for row in range(len(cost)):
        images = (results[k, row].numpy() for k in range(3))
        kernels.semi_global(
            cost[row].contiguous().numpy(), grey[row].contiguous().numpy(), small_step, jump, edge, *images
        )
    position, lowest, margin = results
    return position, lowest, margin


def _flat(matrix: Tensor) -> np.ndarray:
    return np.ascontiguousarray(matrix.numpy().reshape(-1).astype(np.float32))
