"""What the refiner is trained on: smooth views of pretraining scenes, texture laid onto them, the truth."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrags.array_files import load_safetensors, save_safetensors
from extrags.errors import CaptureError, WeightsError, reason_of
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.network import SIZE_MULTIPLE
from extrags.restoration.refinement.refiner import refiner_conditioning, relative_depth
from extrags.restoration.surface_texture import LaidTexture
from extrags.restoration.training_data.augmentation import Batch, random_symmetry, unconfirmed
from extrags.restoration.training_data.pretraining_scenes import PretrainingScene
from extrags.view_synthesis.gamut import Gamut

__all__ = ["EXAMPLES_VERSION", "ExampleCrops", "RefinementExamples", "RefinerBatch"]

EXAMPLES_VERSION = 4
"""Raised by hand whenever the same scene and restorer give other examples."""
PLACEMENTS = 2
"""Ways to lay the tiles that each view is shown with."""
LEAST_INVENTED = 0.02
"""Share of a crop that has to be invented: others teach nothing."""
CROP_TRIALS = 6
LARGEST_ZOOM = 2.0
ZOOMED = 0.4
"""Share of crops that are enlarged, so that pictures of many pixels are not a world of their own."""
EXPOSURE_JITTER, COLOR_JITTER = 0.25, 0.08


@dataclass(frozen=True)
class RefinementExamples:
    """Views of one scene, ready for the refiner; all in half precision.

    Args:
        rgb: as a restorer gives them, [P, 3, H, W].
        changes: of the laid texture, one for each way to lay it, [L, P, 3, H, W].
        maps: invented share, unconfirmed share, depth, cosine of ray and normal, texels, [P, 5, H, W].
        target: the truth, [P, 3, H, W].
        weight: of each pixel, [P, 1, H, W].
    """

    rgb: Float[Tensor, "p 3 h w"]
    changes: Float[Tensor, "l p 3 h w"]
    maps: Float[Tensor, "p 5 h w"]
    target: Float[Tensor, "p 3 h w"]
    weight: Float[Tensor, "p 1 h w"]

    @classmethod
    def of_scene(cls, scene: PretrainingScene, restorer: EmbeddedEnhancer) -> RefinementExamples:
        """Restore the views of a scene, and lay its texture.

        Args:
            scene: a pretraining scene.
            restorer: gives the smooth views, in its own number of steps; one that draws gives its mean.

        Raises:
            CaptureError: when no frame of the scene gives texture.
        """
        if scene.texture is None:
            raise CaptureError("no frame of this pretraining scene gives texture")
        own = replace(
            restorer,
            drawing=False,
            gamut=Gamut.of_images(scene.references.images.float(), scene.references.valid[:, None].float()),
        )
        layers, pairs = scene.pairs.layers, scene.pairs
        restored = own.restored_layers(layers, scene.transfer, own.noise(pairs.size, 0, 0), steps=own.steps)
        to_invent = unconfirmed(layers)
        laid = [
            replace(scene.texture, seed=seed).laid(
                restored.rgb, scene.cameras, restored.depth_mm[:, 0], to_invent[:, 0]
            )
            for seed in range(PLACEMENTS)
        ]
        maps = [laid[0].share, to_invent, restored.depth_mm, laid[0].facing, laid[0].texels]
        return cls(
            restored.rgb.half(),
            torch.stack([one.change for one in laid]).half(),
            torch.cat(maps, dim=1).half(),
            pairs.target.half(),
            pairs.weight.half(),
        )

    def save(self, path: Path) -> None:
        """Write one safetensors file."""
        save_safetensors(path, dict(vars(self)))

    @classmethod
    def load(cls, path: Path) -> RefinementExamples:
        """Read what `save` wrote.

        Raises:
            WeightsError: when the file holds no examples.
        """
        try:
            return cls(**load_safetensors(path))
        except (OSError, RuntimeError, ValueError, TypeError) as error:
            raise WeightsError(f"{path}: not the examples of a refiner ({reason_of(error)})") from error


class ExampleCrops:
    """Draws augmented crops of one scene, the same sequence for the same seed.

    Args:
        examples: of the scene.
        side: of a crop in pixels.
        seed: of all random draws.
    """

    def __init__(self, examples: RefinementExamples, side: int, seed: int) -> None:
        self._examples = examples
        height, width = examples.target.shape[-2:]
        self._side = min(side, height, width) // SIZE_MULTIPLE * SIZE_MULTIPLE
        self._wanted = side
        self._generator = np.random.default_rng([seed, 8])

    def draw(self) -> Tensor:
        """Smooth colours, change, maps, target, weight: [1, 15, S, S]."""
        generator, given = self._generator, self._examples
        zoom = 1.0
        if generator.random() < ZOOMED or self._side < self._wanted:
            needed = max(1.0, self._wanted / self._side)
            zoom = float(generator.uniform(needed, max(needed, LARGEST_ZOOM)))
        side = min(self._side, round(self._wanted / zoom))
        height, width = given.target.shape[-2:]
        for _ in range(CROP_TRIALS):
            view = int(generator.integers(len(given.target)))
            top = int(generator.integers(height - side + 1))
            left = int(generator.integers(width - side + 1))
            window = (slice(view, view + 1), slice(None), slice(top, top + side), slice(left, left + side))
            if float(given.maps[window][:, 0].float().mean()) >= LEAST_INVENTED:
                break
        placement = int(generator.integers(len(given.changes)))
        parts = [given.rgb, given.changes[placement], given.maps, given.target, given.weight]
        crop = torch.cat([part[window] for part in parts], dim=1).float()
        if side != self._wanted:
            crop = functional.interpolate(
                crop, (self._wanted, self._wanted), mode="bilinear", align_corners=False
            )
            # A pixel shows less of the surface.
            crop[:, 10] *= side / self._wanted
        gains = np.exp(generator.normal(0, EXPOSURE_JITTER) + generator.normal(0, COLOR_JITTER, 3))
        gain = torch.from_numpy(gains.astype(np.float32))[None, :, None, None]
        for first in (0, 3, 11):
            crop[:, first : first + 3] *= gain
        for first in (0, 11):
            crop[:, first : first + 3] = crop[:, first : first + 3].clamp(0, 1)
        return random_symmetry(crop, generator)


@dataclass(frozen=True, kw_only=True)
class RefinerBatch(Batch):
    """Crops to train a refiner on; of the depth nothing is learned.

    Args:
        laid: texture for the crops.
    """

    laid: LaidTexture

    def to(self, device: torch.device) -> RefinerBatch:
        """The same on a device."""
        laid = LaidTexture(
            *(
                part.to(device)
                for part in (self.laid.change, self.laid.share, self.laid.facing, self.laid.texels)
            )
        )
        moved = super().to(device)
        return RefinerBatch(**{field.name: getattr(moved, field.name) for field in fields(Batch)}, laid=laid)

    @classmethod
    def of_crops(cls, crops: Float[Tensor, "n 15 s s"]) -> RefinerBatch:
        """Crops of several scenes, as `ExampleCrops` draws them."""
        rgb, change, share, unknown, depth, facing, texels, clean, weight = crops.split(
            (3, 3, 1, 1, 1, 1, 1, 3, 1), dim=1
        )
        laid = LaidTexture(change, share, facing, texels)
        conditioning = refiner_conditioning(rgb, laid, relative_depth(depth), unknown)
        return cls(conditioning, clean, weight, torch.zeros_like(depth), share, laid=laid)
