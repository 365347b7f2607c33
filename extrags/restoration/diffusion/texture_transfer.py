"""Texture from the scene's own frames: features of their patches, fetched by similarity.

What training never saw still looks like this patient's mucosa. Patches of real frames are encoded once per
scene; every place of the U-Net's coarsest level looks for the patch features most like its own, and takes
from there what they were at each level: at the coarse one the attended mean, at the finer ones a copy of the
block that lies at the best match, so that its texture stays sharp.

Source: hard and soft attention of [YangTTSR2020].
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

__all__ = ["PATCH_MULTIPLE", "PatchEncoder", "PatchFeatures", "TextureTransfer"]

NORM_GROUPS = 8
KEY_WIDTH = 64
INITIAL_SHARPNESS = 10.0
PATCH_MULTIPLE = 8
"""Sides of patches must be multiples of this: one unshuffling, two halvings."""
QUERIES_AT_ONCE = 4096
"""Bounds the memory of the similarities at full size."""


@dataclass(frozen=True)
class PatchFeatures:
    """Features of the patches of N scenes; P places of the coarse level each.

    Args:
        key: of unit length, [N, P, 64].
        coarse: [N, P, C].
        middle: blocks of 2 x 2 places of the middle level, [N, P, 4 C'].
        fine: blocks of 4 x 4 places of the fine level, [N, P, 16 C''].
    """

    key: Float[Tensor, "n p k"]
    coarse: Float[Tensor, "n p c"]
    middle: Float[Tensor, "n p m"]
    fine: Float[Tensor, "n p f"]

    def expanded(self, views: int) -> PatchFeatures:
        """The features of a single scene for several of its views."""
        parts = (self.key, self.coarse, self.middle, self.fine)
        return PatchFeatures(*(part.expand(views, -1, -1) for part in parts))


@dataclass(frozen=True)
class Taken:
    """What each level of a view takes from the patches, ready to be added to its features."""

    coarse: Float[Tensor, "n c h w"]
    middle: Float[Tensor, "n c2 h2 w2"]
    fine: Float[Tensor, "n c4 h4 w4"]


class _Block(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(NORM_GROUPS, channels)
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, features: Tensor) -> Tensor:
        hidden = functional.silu(self.first(functional.silu(self.norm(features))))
        return features + self.second(hidden)  # type: ignore[no-any-return]


class PatchEncoder(nn.Module):
    """Features of patches at the three levels of the U-Net.

    Args:
        widths: channels of the levels here: half of the U-Net's.
    """

    def __init__(self, widths: tuple[int, int, int]) -> None:
        super().__init__()
        fine, middle, coarse = widths
        self.entrance = nn.Conv2d(3 * 4, fine, 3, padding=1)
        self.fine = _Block(fine)
        self.to_middle = nn.Conv2d(fine, middle, 3, stride=2, padding=1)
        self.middle = _Block(middle)
        self.to_coarse = nn.Conv2d(middle, coarse, 3, stride=2, padding=1)
        self.coarse = _Block(coarse)

    def forward(self, patches: Float[Tensor, "b 3 s s"]) -> tuple[Tensor, Tensor, Tensor]:
        """Features at 1/2, 1/4 and 1/8 of the patches' side."""
        packed = functional.pixel_unshuffle(patches, 2)
        fine = self.fine(self.entrance(packed.contiguous(memory_format=torch.channels_last)))
        middle = self.middle(self.to_middle(fine))
        return fine, middle, self.coarse(self.to_coarse(middle))


class TextureTransfer(nn.Module):
    """Encodes patches, and fetches from them what is most like the places of a view.

    Args:
        widths: channels of the U-Net's levels.
    """

    def __init__(self, widths: tuple[int, int, int]) -> None:
        super().__init__()
        fine, middle, coarse = widths
        inner = tuple(max(NORM_GROUPS, width // 2 // NORM_GROUPS * NORM_GROUPS) for width in widths)
        self.encoder = PatchEncoder((inner[0], inner[1], inner[2]))
        self.query = nn.Conv2d(coarse, KEY_WIDTH, 1)
        self.key = nn.Linear(inner[2], KEY_WIDTH)
        self.log_sharpness = nn.Parameter(torch.zeros(1))
        self.gate = nn.Conv2d(coarse + 1, 3, 1)
        self.to_coarse = nn.Conv2d(inner[2], coarse, 1)
        self.to_middle = nn.Conv2d(inner[1], middle, 1)
        self.to_fine = nn.Conv2d(inner[0], fine, 1)

    def initialise(self) -> None:
        """Nothing is taken by an untrained network."""
        for layer in (self.to_coarse, self.to_middle, self.to_fine):
            nn.init.zeros_(layer.weight)
        nn.init.zeros_(self.gate.weight)
        nn.init.zeros_(self.log_sharpness)

    def encode(self, patches: Float[Tensor, "n r 3 s s"]) -> PatchFeatures:
        """Features of R patches of each of N scenes, normalised as the network's colours are."""
        scenes, count = patches.shape[:2]
        fine, middle, coarse = self.encoder(patches.flatten(0, 1))

        def places(features: Tensor, block: int) -> Tensor:
            blocks = functional.pixel_unshuffle(features, block) if block > 1 else features
            placed: Tensor = blocks.unflatten(0, (scenes, count)).flatten(3).transpose(2, 3)
            return placed.flatten(1, 2)

        values = places(coarse, 1)
        key = functional.normalize(self.key(values).float(), dim=-1)
        return PatchFeatures(key, values, places(middle, 2), places(fine, 4))

    def forward(self, coarse: Float[Tensor, "n c h w"], patches: PatchFeatures) -> Taken:
        """What the places of a view take."""
        height, width = coarse.shape[-2:]
        query = functional.normalize(self.query(coarse).float().flatten(2).transpose(1, 2), dim=-1)
        sharpness = INITIAL_SHARPNESS * self.log_sharpness.exp()
        attended, best, likeness = [], [], []
        for part in query.split(QUERIES_AT_ONCE, dim=1):
            # In bfloat16 similarities are multiples of 1/256: of many places one could not tell the best.
            with torch.autocast(part.device.type, enabled=False):
                similarity = part @ patches.key.transpose(1, 2)
                attention = (sharpness * similarity).softmax(dim=2).to(patches.coarse.dtype)
            nearest = similarity.max(dim=2)
            attended.append(attention @ patches.coarse)
            best.append(nearest.indices)
            likeness.append(nearest.values)
        index = torch.cat(best, dim=1)
        alike = torch.cat(likeness, dim=1).unflatten(1, (height, width))[:, None]
        gates = self.gate(torch.cat([coarse, alike.to(coarse.dtype)], dim=1)).sigmoid()
        soft = torch.cat(attended, dim=1).transpose(1, 2).unflatten(2, (height, width))
        middle = functional.pixel_shuffle(_fetched(patches.middle, index, height, width), 2)
        fine = functional.pixel_shuffle(_fetched(patches.fine, index, height, width), 4)
        return Taken(
            gates[:, 0:1] * self.to_coarse(soft),
            _enlarged(gates[:, 1:2], 2) * self.to_middle(middle),
            _enlarged(gates[:, 2:3], 4) * self.to_fine(fine),
        )


def _fetched(
    features: Float[Tensor, "n p m"], index: Int[Tensor, "n q"], height: int, width: int
) -> Float[Tensor, "n m h w"]:
    taken = features.gather(1, index[..., None].expand(-1, -1, features.shape[2]))
    laid: Tensor = taken.transpose(1, 2).unflatten(2, (height, width))
    return laid


def _enlarged(gate: Tensor, factor: int) -> Tensor:
    return functional.interpolate(gate, scale_factor=factor, mode="bilinear", align_corners=False)
