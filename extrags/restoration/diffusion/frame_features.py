"""How real frames look to the restorer's network: what tells the scenes it was trained on from others.

A frame is given to the network as a view of which everything is known. Means and standard deviations of its
coarsest features, over the places that show tissue, are compared by `extrags.restoration.uncertainty.domain`.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from extrags.restoration.diffusion.network import SIZE_MULTIPLE, RestorationNetwork
from extrags.restoration.training_data.photographs import photograph_layers
from extrags.sequence import EndoscopicSequence
from extrags.threads import one_torch_thread
from extrags.view_synthesis.conditioning import condition
from extrags.view_synthesis.references import LightTransfer

__all__ = ["frame_features", "sequence_features"]

FRAMES = 16
"""Of a scene, at most."""
WIDTH_PX = 160
"""Wider frames are made so wide, as most of those that the bundled network was trained on are: the same
scenes in frames of twice that width were three times as far from them as the limit."""
MIN_TISSUE_SHARE = 0.5
"""Of the pixels of a place of the coarsest level."""


def sequence_features(network: RestorationNetwork, sequence: EndoscopicSequence) -> Float[np.ndarray, "n c"]:
    """Features of a scene's training frames, evenly spread over them.

    Args:
        network: in evaluation mode.
        sequence: with training frames.

    Returns:
        Of the frames that show tissue: none for frames of fewer than eight pixels a side.
    """
    train = np.asarray(sequence.train, dtype=np.int64)
    spread = np.linspace(0, len(train) - 1, min(len(train), FRAMES)).round().astype(np.int64)
    found = []
    for index in train[np.unique(spread)]:
        rgb = torch.from_numpy(sequence.rgb[index].astype(np.float32) / 255).permute(2, 0, 1)
        found.append(frame_features(network, rgb[None], torch.from_numpy(sequence.mask[[index]])))
    return np.concatenate(found)


@one_torch_thread()
def frame_features(
    network: RestorationNetwork, rgb: Float[Tensor, "n 3 h w"], valid: Bool[Tensor, "n h w"]
) -> Float[np.ndarray, "m c"]:
    """Means and deviations of the network's coarsest features of frames.

    Args:
        network: in evaluation mode.
        rgb: frames of any size, in [0, 1].
        valid: where they show tissue; elsewhere they are not looked at.

    Returns:
        Of the frames that show tissue, in their order: the means of all features, then their deviations.
    """
    known = valid[:, None].float()
    width = min(WIDTH_PX, rgb.shape[-1])
    size = (max(1, round(rgb.shape[-2] * width / rgb.shape[-1])), width)
    # A mean over the area of a pixel, of what is tissue there.
    share = functional.interpolate(known, size=size, mode="area")
    colors = functional.interpolate(rgb * known, size=size, mode="area") / share.clamp_min(1e-6)
    height, width = (side // SIZE_MULTIPLE * SIZE_MULTIPLE for side in size)
    if height == 0 or width == 0:
        return np.empty((0, 2 * network.widths[-1]))
    colors, share = colors[..., :height, :width].clamp(0, 1), share[..., :height, :width]
    tissue = (share >= MIN_TISSUE_SHARE).float()
    found = []
    for frame in range(len(colors)):
        weight = functional.avg_pool2d(tissue[[frame]], SIZE_MULTIPLE)[0, 0]
        counted = weight >= MIN_TISSUE_SHARE
        if not bool(counted.any()):
            continue
        with torch.no_grad():
            channels = _known_view(network, colors[[frame]], tissue[[frame]])
            start, time = torch.zeros(1, 3, height, width), torch.ones(1)
            places = network.coarsest(channels, start, time)[0][:, counted].double()
        found.append(torch.cat([places.mean(dim=1), places.std(dim=1, correction=0)]).numpy())
    return np.stack(found) if found else np.empty((0, 2 * network.widths[-1]))


def _known_view(
    network: RestorationNetwork, rgb: Float[Tensor, "1 3 h w"], tissue: Float[Tensor, "1 1 h w"]
) -> Float[Tensor, "1 c h w"]:
    """Channels of a view that is rendered as it was photographed, at one distance."""
    layers = photograph_layers(rgb, tissue, depth_mm=1.0)
    # At the distance where the fall-off is one.
    return condition(layers, LightTransfer(None, 1.0, 1.0), folded=network.folded).channels
