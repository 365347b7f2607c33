"""Whether restored regions look like tissue: deep features and fine detail against those of photographs.

A restored hole cannot show the true texture at the true place, so that distances of image pairs punish any
texture at all. These two figures ask for the same kinds of texture and as much of it, wherever it lies.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from extrags.metrics.detail import detail_ratios
from extrags.metrics.frechet import cell_features, frechet_distance
from extrags.metrics.lpips import Lpips

__all__ = ["Realism", "rims"]

RIM_PX = 6
"""Width of the rim of a hole, in an image 160 pixels wide; it grows with the image."""
RIM_IMAGE_WIDTH = 160


def rims(mask: Bool[Tensor, "v h w"], hole: Bool[Tensor, "v h w"]) -> Bool[Tensor, "v h w"]:
    """Pixels around holes, where what is known and what is invented meet.

    Args:
        mask: pixels that count.
        hole: pixels of holes.
    """
    reach = max(1, round(RIM_PX * mask.shape[-1] / RIM_IMAGE_WIDTH))
    near = functional.max_pool2d(hole[:, None].float(), 2 * reach + 1, stride=1, padding=reach)[:, 0] > 0
    return mask & near & ~hole


class Realism:
    """Photographs that restored views of the same places are held against.

    Args:
        photographs: in [0, 1].
        regions: pixels that count, by name.
        lpips: whose backbone gives the features; None leaves the Fréchet distance out.
        valid: what of the images counts at all. Fields of features and filters reach farther than a region;
            outside they see the photograph.
    """

    def __init__(
        self,
        photographs: Float[Tensor, "v h w 3"],
        regions: dict[str, Bool[Tensor, "v h w"]],
        lpips: Lpips | None,
        valid: Bool[Tensor, "v h w"],
    ) -> None:
        self.photographs, self.regions, self.lpips, self.valid = photographs, regions, lpips, valid

    def figures(self, images: Float[Tensor, "v h w 3"]) -> dict[str, Any]:
        """Figures of restored views.

        Args:
            images: in [0, 1].

        Returns:
            `{frechet: {region: distance}, detail: {region: ratios}}`: see `extrags.metrics.frechet` and
            `extrags.metrics.detail`; None where a region is too small or there is no LPIPS.
        """
        images = torch.where(self.valid[..., None], images, self.photographs)
        frechet: dict[str, float | None] = dict.fromkeys(self.regions)
        if self.lpips is not None:
            for name, region in self.regions.items():
                own = cell_features(self.lpips, images, region)
                frechet[name] = frechet_distance(own, self._features[name])
        detail = {
            name: detail_ratios(images, self.photographs, region, self.valid)
            for name, region in self.regions.items()
        }
        return {"frechet": frechet, "detail": detail}

    @cached_property
    def _features(self) -> dict[str, Float[np.ndarray, "m c"]]:
        assert self.lpips is not None
        return {
            name: cell_features(self.lpips, self.photographs, region) for name, region in self.regions.items()
        }
