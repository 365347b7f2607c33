"""The refiner: from the mean of all plausible views, and texture of the scene, to one plausible view.

A restorer's view is smooth where it was invented, and `SurfaceTexture` lays detail of the scene's own frames
onto it that knows nothing of folds, shading and edges. The refiner is shown both, and how the surface lies,
and answers with a view in which they agree. What is random about the view is which tile lies where: the
lattice of tiles is one in space, so that all views of a place are refined from the same draw, and another
seed gives another plausible view.

Nothing changes where nothing is invented, and colours keep the means over wide areas that the restorer gave
them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrags.array_files import load_safetensors, save_safetensors
from extrags.cameras import Cameras
from extrags.errors import WeightsError, reason_of
from extrags.metrics.filters import filter_separable, gaussian_weights
from extrags.restoration.description import (
    DESCRIPTION,
    description_fields,
    read_description,
    write_description,
)
from extrags.restoration.diffusion.network import SIZE_MULTIPLE, RestorationNetwork, build_network
from extrags.restoration.surface_texture import LaidTexture, SurfaceTexture
from extrags.threads import in_threads
from extrags.view_synthesis.conditioning import COLOR_CENTER, COLOR_SCALE, Conditioning

__all__ = [
    "REFINER_CHANNELS",
    "REFINER_WIDTHS",
    "WEIGHTS",
    "Refiner",
    "refined_colors",
    "refiner_conditioning",
    "relative_depth",
    "textured_views",
]

REFINER_CHANNELS = 8
"""Of the conditioning: smooth colours (3), share that is invented, share that nothing confirms, log-depth,
cosine of ray and normal, logarithm of a pixel's width in texels."""
REFINER_WIDTHS = (32, 64, 96)
TEXELS_LIMIT = 3.0
"""Largest logarithm of a pixel's width in texels, and of its relative depth."""
LARGEST_TILE_PX = 384
"""Wider or higher views are refined in tiles: attention takes time with the square of the pixels."""
TILE_OVERLAP_PX = 64
COARSE_SHARE = 0.1
"""Standard deviation of the window of coarse colours, as a share of a view's width."""
LEAST_SHARE = 1e-3
WEIGHTS = "refiner.safetensors"
FORMAT = 1


def relative_depth(depth_mm: Float[Tensor, "v 1 h w"]) -> Float[Tensor, "v 1 h w"]:
    """z-depth over that of a typical pixel of the same view: the refiner knows no unit."""
    return depth_mm / depth_mm.flatten(1).median(dim=1).values[:, None, None, None].clamp_min(1e-9)


def refiner_conditioning(
    rgb: Float[Tensor, "v 3 h w"],
    laid: LaidTexture,
    depth: Float[Tensor, "v 1 h w"],
    unconfirmed: Float[Tensor, "v 1 h w"],
) -> Conditioning:
    """What the refiner is shown.

    Args:
        rgb: smooth views in [0, 1].
        laid: texture for them.
        depth: from `relative_depth`, of whole views or of crops.
        unconfirmed: share of each pixel that is invented.

    Returns:
        Channels; the textured view as the base; the depth.
    """
    channels = [
        (rgb - COLOR_CENTER) / COLOR_SCALE,
        laid.share,
        unconfirmed,
        depth.clamp_min(1e-9).log().clamp(-TEXELS_LIMIT, TEXELS_LIMIT),
        laid.facing,
        laid.texels.clamp_min(1e-9).log().clamp(-TEXELS_LIMIT, TEXELS_LIMIT),
    ]
    return Conditioning(torch.cat(channels, dim=1), (rgb + laid.change).clamp(0, 1), depth)


def refined_colors(
    network: RestorationNetwork,
    conditioning: Conditioning,
    laid: LaidTexture,
    *,
    half_precision: bool,
) -> tuple[Float[Tensor, "v 3 h w"], Float[Tensor, "v 2 h w"]]:
    """Refined views, about [0, 1], and what else the network says; sides are multiples of `SIZE_MULTIPLE`.

    Args:
        network: of a refiner.
        conditioning: from `refiner_conditioning`.
        laid: the same texture.
        half_precision: convolutions in bfloat16.
    """
    base = conditioning.base
    time = torch.ones(len(base), device=base.device)
    with torch.autocast(base.device.type, torch.bfloat16, enabled=half_precision):
        # The laid texture takes the place of the noise: it is what is drawn.
        answer: Tensor = network(conditioning.channels, laid.change / COLOR_SCALE, time)
    color, rest = answer.float().split((3, 2), dim=1)
    return base + laid.share * COLOR_SCALE * color, rest


@dataclass(frozen=True)
class Refiner:
    """A trained refiner.

    Args:
        network: `REFINER_CHANNELS` in.
        record: how it was trained; ready for JSON.
        half_precision: convolutions in bfloat16.
    """

    network: RestorationNetwork
    record: dict[str, Any]
    half_precision: bool = False

    def refined(
        self,
        rgb: Float[Tensor, "v 3 h w"],
        laid: LaidTexture,
        depth_mm: Float[Tensor, "v 1 h w"],
        unconfirmed: Float[Tensor, "v 1 h w"],
    ) -> Float[Tensor, "v 3 h w"]:
        """One plausible view for each smooth one; the same where nothing is invented.

        Args:
            rgb: smooth views in [0, 1].
            laid: texture for them.
            depth_mm: z-depth without gaps.
            unconfirmed: share of each pixel that is invented.
        """
        # Relative depth is that of the whole view: tiles of it must agree.
        depth = relative_depth(depth_mm)
        maps = torch.cat([rgb, laid.change, laid.share, laid.facing, laid.texels, depth, unconfirmed], dim=1)

        def one(view: int) -> Tensor:
            height, width = rgb.shape[-2:]
            total, weights = torch.zeros(1, 3, height, width), torch.zeros(1, 1, height, width)
            for top, bottom in _spans(height):
                for left, right in _spans(width):
                    tile = (slice(view, view + 1), slice(None), slice(top, bottom), slice(left, right))
                    ramp = _ramp(bottom - top)[:, None] * _ramp(right - left)[None]
                    place = (..., slice(top, bottom), slice(left, right))
                    total[place] += ramp * self._refined_tile(maps[tile])
                    weights[place] += ramp
            found = total / weights
            index = slice(view, view + 1)
            kept = _with_coarse_colors(found, rgb[index], laid.share[index])
            # Not a bit of what is known goes through the weights of tiles.
            return torch.where(laid.share[view] > 0, kept, rgb[view]).clamp(0, 1)

        return torch.cat(in_threads(one, range(len(rgb))))

    def _refined_tile(self, maps: Float[Tensor, "1 11 h w"]) -> Float[Tensor, "1 3 h w"]:
        parts: tuple[Tensor, ...] = maps.split((3, 3, 1, 1, 1, 1, 1), dim=1)
        rgb, change, share, facing, texels, depth, unknown = parts
        if not bool((share > 0).any()):
            return rgb
        height, width = maps.shape[-2:]
        padding = (0, -width % SIZE_MULTIPLE, 0, -height % SIZE_MULTIPLE)
        if any(padding):
            padded = functional.pad(maps, padding, mode="replicate")
            refined: Tensor = self._refined_tile(padded)[..., :height, :width]
            return refined
        laid = LaidTexture(change, share, facing, texels)
        with torch.no_grad():
            conditioning = refiner_conditioning(rgb, laid, depth, unknown)
            found, _ = refined_colors(self.network, conditioning, laid, half_precision=self.half_precision)
        return found

    def save(self, path: Path) -> None:
        """Write `refiner.safetensors`, in half precision, and its description."""
        weights = {name: value.half() for name, value in self.network.state_dict().items()}
        save_safetensors(path / WEIGHTS, weights)
        write_description(
            path,
            {
                "backend": "refiner",
                "format": FORMAT,
                "widths": list(self.network.widths),
                "record": self.record,
            },
        )

    @classmethod
    def load(cls, path: Path, *, half_precision: bool = False) -> Refiner:
        """Read what `save` wrote.

        Args:
            path: the folder.
            half_precision: convolutions in bfloat16.

        Raises:
            WeightsError: when a file is missing, or is not of this version.
        """
        description_file = path / DESCRIPTION
        description = read_description(description_file)
        if description.get("format") != FORMAT or description.get("backend") != "refiner":
            raise WeightsError(f"{description_file}: not the description of a refiner of format {FORMAT}")
        with description_fields(description_file):
            first, second, third = description["widths"]
            network = build_network(REFINER_CHANNELS, (first, second, third), torch.Generator())
            record = dict(description["record"])
        try:
            network.load_state_dict(
                {name: value.float() for name, value in load_safetensors(path / WEIGHTS).items()}
            )
        except (OSError, RuntimeError, ValueError) as error:
            raise WeightsError(
                f"{path / WEIGHTS}: not the weights of a refiner ({reason_of(error)})"
            ) from error
        return cls(network.eval(), record, half_precision=half_precision)


def _with_coarse_colors(
    refined: Float[Tensor, "1 3 h w"], rgb: Float[Tensor, "1 3 h w"], share: Float[Tensor, "1 1 h w"]
) -> Float[Tensor, "1 3 h w"]:
    """Refined views whose means over wide areas are those of the smooth ones.

    These are what a restorer is best at; in worlds that the refiner does not know it shifts them.
    """
    sigma = COARSE_SHARE * rgb.shape[-1]
    window = gaussian_weights(sigma, math.ceil(2.5 * sigma))
    change = filter_separable(refined - rgb, window, window)
    invented = filter_separable(share, window, window).clamp_min(LEAST_SHARE)
    return refined - share * change / invented


def _spans(length: int) -> list[tuple[int, int]]:
    """Where the tiles along a side begin and end: as few as possible, of one length, that overlap."""
    if length <= LARGEST_TILE_PX:
        return [(0, length)]
    count = math.ceil((length - TILE_OVERLAP_PX) / (LARGEST_TILE_PX - TILE_OVERLAP_PX))
    side = math.ceil((length + (count - 1) * TILE_OVERLAP_PX) / count)
    starts = [round(index * (length - side) / (count - 1)) for index in range(count)]
    return [(start, start + side) for start in starts]


def _ramp(length: int) -> Float[Tensor, "n"]:
    """Weights of a tile's pixels along a side: they fall towards its ends and are never zero."""
    steps = torch.arange(length) + 0.5
    return (torch.minimum(steps, length - steps) / TILE_OVERLAP_PX).clamp(max=1)


def textured_views(
    texture: SurfaceTexture,
    refiner: Refiner | None,
    rgb: Float[Tensor, "v 3 h w"],
    cameras: Cameras,
    depth_mm: Float[Tensor, "v 1 h w"],
    unconfirmed: Float[Tensor, "v 1 h w"],
) -> Float[Tensor, "v 3 h w"]:
    """Views with texture where they are invented, and refined where there is a refiner.

    Args:
        texture: of the scene.
        refiner: None only lays the texture.
        rgb: smooth views in [0, 1].
        cameras: of these.
        depth_mm: z-depth without gaps.
        unconfirmed: share of each pixel that is invented.
    """
    laid = texture.laid(rgb, cameras, depth_mm[:, 0], unconfirmed[:, 0])
    if refiner is None:
        return (rgb + laid.change).clamp(0, 1)
    return refiner.refined(rgb, laid, depth_mm, unconfirmed)
