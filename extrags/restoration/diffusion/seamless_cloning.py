"""Seamless cloning: what is invented joins what is known without a seam, and the known stays as it is."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from extrags.view_synthesis.conditioning import Layers, known_share
from extrags.view_synthesis.filling import push_pull

__all__ = ["certainty", "cloned_seamlessly"]


def cloned_seamlessly(
    rgb: Float[Tensor, "t 3 h w"], base: Float[Tensor, "t 3 h w"], certain: Float[Tensor, "t 1 h w"]
) -> Float[Tensor, "t 3 h w"]:
    """Restored views whose colours are those of the base image wherever it is certain.

    By how much both differ there is carried smoothly into the holes and taken off: a shift of colours, which
    is most of what a network gets wrong on tissue that it does not know, goes, and texture and shapes that it
    has invented stay.

    Args:
        rgb: restored views, in [0, 1].
        base: the image that they began with, holes filled (`extrags.view_synthesis.conditioning`), in [0, 1].
        certain: how certain it is, in [0, 1].

    Source: [Perez2003]; the membrane is interpolated, as in [Farbman2009], here by push-pull [Gortler1996];
    see docs/references.md.
    """
    return (rgb - push_pull(rgb - base, certain)).clamp(0, 1)


def certainty(layers: Layers) -> Float[Tensor, "t 1 h w"]:
    """How certain the base image of views is: what real views or the rendering give, by its uncertainty."""
    return known_share(layers) * (1 - layers.get("uncertainty")).clamp(0, 1)
