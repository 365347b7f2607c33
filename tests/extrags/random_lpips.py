"""Weights of LPIPS drawn at random, for machines without the published ones."""

from __future__ import annotations

import torch

from extrags.config import LpipsNet
from extrags.metrics.lpips_networks import LAYERS, array_names

CHANNELS = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}


def random_weights(net: LpipsNet) -> dict[str, torch.Tensor]:
    """Arrays of the right shapes with random values; heads are not negative."""
    generator = torch.Generator().manual_seed(3)
    sizes = {"conv stride 4 pad 2": 11, "conv stride 1 pad 2": 5}
    weights, channels, head = {}, 3, iter(CHANNELS[net])
    # The channels of a convolution are those of the next tap.
    upcoming = next(head)
    for kind, number in LAYERS[net]:
        if kind == "tap":
            weights[f"lin{number}"] = torch.rand(upcoming, generator=generator)
            upcoming = next(head, 0)
        elif kind.startswith("conv"):
            side = sizes.get(kind, 3)
            scale = (2 / (channels * side * side)) ** 0.5
            weights[f"features.{number}.weight"] = scale * torch.randn(
                upcoming, channels, side, side, generator=generator
            )
            weights[f"features.{number}.bias"] = 0.1 * torch.randn(upcoming, generator=generator)
            channels = upcoming
    assert set(weights) == set(array_names(net))
    return weights
