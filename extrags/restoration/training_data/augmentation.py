"""Random augmented crops of training pairs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.errors import ConfigError
from extrags.restoration.training_data.pairs import Pairs
from extrags.restoration.training_data.photographs import degraded_photograph
from extrags.restoration.training_data.recoloring import Recoloring
from extrags.view_synthesis.conditioning import Conditioning, Layers, condition
from extrags.view_synthesis.references import LightTransfer

__all__ = [
    "Batch",
    "CropSampler",
    "MixedSampler",
    "cut_out",
    "drop_references",
    "random_patches",
    "random_symmetry",
    "unconfirmed",
]

PASTED_HOLES = 0.5
"""Probability of another pair's holes."""
HALF_PLANE = 0.35
"""Probability that one side of a random line is a hole."""
REFERENCE_DROPOUT = 0.35
"""Probability that all real views are removed."""
INVENTED_KEPT = 0.5
"""Probability that a hole which is cut leaves what keyframes have invented there."""
SMALLEST_CROP_PX = 32
PATCH_SIDE_MULTIPLE = 8
"""Sides of patches are multiples of this, which the network's patch encoder needs."""
PATCH_TRIALS = 8
"""Places tried for a patch that shows nothing but tissue; the best of them counts."""


@dataclass(frozen=True)
class Batch:
    """Crops to train on.

    Args:
        conditioning: network input, base image and completed depth.
        clean: the true view, in [0, 1], [N, 3, H, W].
        weight: of each pixel's error, [N, 1, H, W].
        depth_mm: true z-depth, 0 where unknown, [N, 1, H, W].
        invented: share of each pixel that neither the rendering nor a real view confirms, [N, 1, H, W].
        patches: parts of real frames of the same scene, in [0, 1], [N, R, 3, S, S]; None without.
    """

    conditioning: Conditioning
    clean: Float[Tensor, "n 3 h w"]
    weight: Float[Tensor, "n 1 h w"]
    depth_mm: Float[Tensor, "n 1 h w"]
    invented: Float[Tensor, "n 1 h w"]
    patches: Float[Tensor, "n r 3 s s"] | None = None

    def to(self, device: torch.device) -> Batch:
        """The same on a device."""
        given = self.conditioning
        return Batch(
            Conditioning(given.channels.to(device), given.base.to(device), given.depth_mm.to(device)),
            self.clean.to(device),
            self.weight.to(device),
            self.depth_mm.to(device),
            self.invented.to(device),
            None if self.patches is None else self.patches.to(device),
        )

    @staticmethod
    def concatenated(parts: list[Batch]) -> Batch:
        """Join crops of the same size; patches stay where all parts have some."""
        conditionings = [part.conditioning for part in parts]
        patches = [part.patches for part in parts if part.patches is not None]
        return Batch(
            Conditioning(
                torch.cat([part.channels for part in conditionings]),
                torch.cat([part.base for part in conditionings]),
                torch.cat([part.depth_mm for part in conditionings]),
            ),
            torch.cat([part.clean for part in parts]),
            torch.cat([part.weight for part in parts]),
            torch.cat([part.depth_mm for part in parts]),
            torch.cat([part.invented for part in parts]),
            torch.cat(patches) if len(patches) == len(parts) else None,
        )


class CropSampler:
    """Draws batches of augmented crops, the same sequence for the same seed.

    Args:
        pairs: of the scene; validation pairs are left out.
        transfer: how brightness changes with distance in this scene.
        batch: crops per batch.
        crop_px: side of a crop; images smaller than that give smaller crops.
        side_multiple: of which a crop's side must be a multiple; the network's.
        seed: of all random draws.
        frames: real frames of the scene that patches and photographs are taken from, in [0, 1],
            [F, 3, H, W], and which of their pixels show tissue, [F, H, W]; None without.
        patches: how many of them per crop, and the side of each in pixels.
        folded: what was invented appears as a blend of real views would, as `condition`.
        color_variety: how far hue, saturation and contrast are varied, as `Recoloring.drawn`.
        photograph_share: of the crops that are a frame of the scene, known but for what is cut or blurred.

    Raises:
        ConfigError: when the images are too small for any crop, or no pair is left to train on.
    """

    def __init__(
        self,
        pairs: Pairs,
        transfer: LightTransfer,
        *,
        batch: int,
        crop_px: int,
        side_multiple: int,
        seed: int,
        frames: tuple[Float[Tensor, "f 3 h w"], Bool[Tensor, "f h w"]] | None = None,
        patches: tuple[int, int] = (0, 0),
        folded: bool = True,
        color_variety: float = 0.0,
        photograph_share: float = 0.0,
    ) -> None:
        self._folded = folded
        self._color_variety = color_variety
        self._photograph_share = photograph_share if frames is not None else 0.0
        self._frames = frames
        self._patches = patches
        self._pairs = pairs.subset(np.flatnonzero(~pairs.validation))
        if len(self._pairs) == 0:
            raise ConfigError("all pairs are for validation; none is left to train on")
        height, width = pairs.target.shape[-2:]
        side = min(crop_px, height, width) // side_multiple * side_multiple
        if side < SMALLEST_CROP_PX:
            raise ConfigError(
                f"images of {width}x{height} px are too small to train a restorer on; "
                f"at least {SMALLEST_CROP_PX} px a side are needed"
            )
        self._side = side
        self._transfer = transfer
        self._batch = batch
        self._generator = np.random.default_rng([seed, 2])
        self._order: list[int] = []

    def draw(self) -> Batch:
        """The next batch."""
        crops, patches = [], []
        for _ in range(self._batch):
            recoloring = Recoloring.drawn(self._generator, self._color_variety)
            crops.append(self._crop(recoloring))
            if self._frames is not None and self._patches[0] > 0:
                cut = random_patches(*self._frames, *self._patches, self._generator)
                patches.append(recoloring.applied(cut))
        data, clean, weight, depth = (torch.cat(part) for part in zip(*crops, strict=True))
        layers = Layers(data)
        return Batch(
            condition(layers, self._transfer, folded=self._folded),
            clean,
            weight,
            depth,
            unconfirmed(layers),
            torch.stack(patches) if patches else None,
        )

    def _next(self) -> int:
        if not self._order:
            self._order = self._generator.permutation(len(self._pairs)).tolist()
        return self._order.pop()

    def _crop(self, recoloring: Recoloring) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        generator, pairs = self._generator, self._pairs
        # Drawn only where there may be some: other trainings see the draws they always saw.
        photograph = self._photograph_share > 0 and generator.random() < self._photograph_share
        layers, clean, weight, depth = self._photograph() if photograph else self._pair(self._next())
        for name in ("rendered", "nearest", "blend", "invented"):
            layers.get(name).copy_(recoloring.applied(layers.get(name)))
        clean = recoloring.applied(clean)
        if generator.random() < PASTED_HOLES:
            other = int(generator.integers(len(pairs)))
            row, column = self._corner()
            alpha = pairs.layers.get("alpha")[
                other : other + 1, :, row : row + self._side, column : column + self._side
            ]
            # In half of the holes real views may still see the surface.
            layers = cut_out(
                layers,
                random_symmetry(alpha, generator),
                unseen=generator.random() < 0.5,
                keep_invented=self._keeps_invented(layers),
            )
        if generator.random() < HALF_PLANE:
            layers = cut_out(
                layers, self._half_plane(), unseen=True, keep_invented=self._keeps_invented(layers)
            )
        if generator.random() < REFERENCE_DROPOUT:
            layers = drop_references(layers)
        everything = random_symmetry(torch.cat([layers.data, clean, weight, depth], dim=1), generator)
        data, clean, weight, depth = everything.split((layers.data.shape[1], 3, 1, 1), dim=1)
        return data, clean, weight, depth

    def _pair(self, index: int) -> tuple[Layers, Tensor, Tensor, Tensor]:
        """A window of a pair: layers that may be changed, truth, weight and depth."""
        pairs, window = self._pairs, self._window()
        # Many scenes are kept in half precision; crops are not.
        layers = Layers(pairs.layers.data[index : index + 1][window].clone().float())
        clean, weight, depth = (
            part[index : index + 1][window].float() for part in (pairs.target, pairs.weight, pairs.depth_mm)
        )
        return layers, clean, weight, depth

    def _photograph(self) -> tuple[Layers, Tensor, Tensor, Tensor]:
        """A window of a frame of the scene; its depth is not known."""
        assert self._frames is not None
        images, valid = self._frames
        frame, window = int(self._generator.integers(len(images))), self._window()
        rgb = images[frame : frame + 1][window].float()
        tissue = valid[frame : frame + 1, None][window].float()
        layers = degraded_photograph(
            rgb,
            tissue,
            self._half_plane(),
            depth_mm=self._transfer.scale_mm,
            generator=self._generator,
        )
        return layers, rgb * tissue, tissue, torch.zeros_like(tissue)

    def _window(self) -> tuple[Any, ...]:
        top, left = self._corner()
        return (..., slice(top, top + self._side), slice(left, left + self._side))

    def _keeps_invented(self, layers: Layers) -> bool:
        """Drawn only where there is something to keep: other pairs see the draws they always saw."""
        if not bool((layers.get("invented_weight") > 0).any()):
            return False
        return bool(self._generator.random() < INVENTED_KEPT)

    def _corner(self) -> tuple[int, int]:
        height, width = self._pairs.target.shape[-2:]
        return (
            int(self._generator.integers(height - self._side + 1)),
            int(self._generator.integers(width - self._side + 1)),
        )

    def _half_plane(self) -> Float[Tensor, "1 1 h w"]:
        angle = self._generator.uniform(0, 2 * math.pi)
        offset = self._generator.uniform(-0.1, 0.6) * self._side / 2
        steps = torch.arange(self._side) + 0.5 - self._side / 2
        across = math.cos(angle) * steps[None, :] + math.sin(angle) * steps[:, None]
        softness = self._generator.uniform(0.5, 3)
        return torch.sigmoid((offset - across) / softness)[None, None]


class MixedSampler:
    """Batches of crops from many scenes, each with its own light.

    Args:
        samplers: one per scene; each gives one crop at a time.
        batch: crops per batch.
        seed: of which scene is drawn.
    """

    def __init__(self, samplers: list[CropSampler], *, batch: int, seed: int) -> None:
        self._samplers = samplers
        self._batch = batch
        self._generator = np.random.default_rng([seed, 6])

    def draw(self) -> Batch:
        """The next batch."""
        chosen = self._generator.integers(len(self._samplers), size=self._batch)
        return Batch.concatenated([self._samplers[int(scene)].draw() for scene in chosen])


def random_patches(
    frames: Float[Tensor, "f 3 h w"],
    valid: Bool[Tensor, "f h w"],
    count: int,
    side_px: int,
    generator: np.random.Generator,
) -> Float[Tensor, "r 3 s s"]:
    """Parts of random frames: any place that shows tissue, seen from anywhere.

    Args:
        frames: real frames of a scene.
        valid: which of their pixels show tissue.
        count: how many.
        side_px: side of each, a multiple of 8; where frames are smaller, the largest such multiple.
        generator: of frames, places and symmetries.
    """
    height, width = frames.shape[-2:]
    side = min(side_px, height, width) // PATCH_SIDE_MULTIPLE * PATCH_SIDE_MULTIPLE
    cut = []
    for _ in range(count):
        best, most = frames[:1, :, :side, :side], -1.0
        for _trial in range(PATCH_TRIALS):
            frame = int(generator.integers(len(frames)))
            top = int(generator.integers(height - side + 1))
            left = int(generator.integers(width - side + 1))
            rows, columns = slice(top, top + side), slice(left, left + side)
            share = float(valid[frame, rows, columns].float().mean())
            if share > most:
                best, most = frames[frame : frame + 1, :, rows, columns], share
            if share == 1:
                break
        cut.append(random_symmetry(best.float(), generator))
    return torch.cat(cut)


def unconfirmed(layers: Layers) -> Float[Tensor, "v 1 h w"]:
    """Share of each pixel that is to be invented: neither the rendering nor a real view confirms it."""
    return layers.get("uncertainty") * (1 - layers.get("blend_weight"))


def cut_out(
    layers: Layers, kept: Float[Tensor, "1 1 h w"], *, unseen: bool, keep_invented: bool = False
) -> Layers:
    """Cut holes into layers as a rendering would show them.

    Args:
        layers: changed in place.
        kept: 1 where the view stays as it is, 0 in the hole.
        unseen: also no real view sees the surface there.
        keep_invented: what keyframes have invented stays, with the depth of its surface.
    """
    solid = kept.clamp(0, 1)
    invented = layers.get("invented_weight")
    if not keep_invented:
        invented.mul_(solid)
    for name in ("rendered", "alpha"):
        layers.get(name).mul_(solid)
    layers.get("depth_mm").mul_(((solid > 0.02) | (invented > 0)).float())
    uncertainty = layers.get("uncertainty")
    uncertainty.copy_(1 - (1 - uncertainty) * solid)
    if unseen:
        for name in ("nearest_weight", "blend_weight", "log_ratio"):
            layers.get(name).mul_((2 * solid - 1).clamp_min(0))
    return layers


def drop_references(layers: Layers) -> Layers:
    """Layers without any real view; changed in place."""
    for name in ("nearest_weight", "blend_weight", "log_ratio"):
        layers.get(name).zero_()
    return layers


def random_symmetry(
    images: Float[Tensor, "n c s s"], generator: np.random.Generator
) -> Float[Tensor, "n c s s"]:
    """Square images in one of the eight symmetries of the square."""
    choice = int(generator.integers(8))
    if choice & 1:
        images = images.flip(-1)
    if choice & 2:
        images = images.flip(-2)
    return images.transpose(-1, -2) if choice & 4 else images
