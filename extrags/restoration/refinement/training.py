"""Training of the refiner: as a restorer is trained to draw, on the invented parts alone."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from pydantic import Field

from extrags.config.base import Seed, StageConfig
from extrags.errors import ConfigError
from extrags.metrics.image import psnr_per_image
from extrags.metrics.lpips import Lpips
from extrags.restoration.diffusion.network import build_network
from extrags.restoration.diffusion.network_training import NetworkTraining, TrainingSettings
from extrags.restoration.diffusion.precision import has_fast_half_precision
from extrags.restoration.diffusion.rectified_flow import LOG_ERROR_LIMIT, TYPICAL_ERROR, Predicted
from extrags.restoration.refinement.examples import ExampleCrops, RefinementExamples, RefinerBatch
from extrags.restoration.refinement.refiner import (
    REFINER_CHANNELS,
    REFINER_WIDTHS,
    Refiner,
    refined_colors,
)
from extrags.restoration.surface_texture import LaidTexture
from extrags.restoration.training_data.augmentation import Batch

__all__ = ["RefinerConfig", "refiner_scores", "train_refiner"]


class RefinerConfig(StageConfig):
    """Budget of a refiner's training."""

    scenes: int = Field(90, ge=2, description="pretraining scenes in all")
    validation_scenes: int = Field(8, ge=1, description="how many of them, the last ones, validate only")
    iterations: int = Field(10_000, ge=1, description="optimisation steps")
    batch: int = Field(4, ge=1, description="crops per step, each from a scene of its own")
    crop: int = Field(96, ge=64, multiple_of=8, description="side of a crop in pixels")
    learning_rate: float = Field(5e-4, gt=0, description="peak, after the warm-up")
    perceptual_weight: float = Field(4.0, gt=0, description="of the perceptual distance")
    adversarial_weight: float = Field(
        0.6, ge=0, description="pull of the adversary at invented colours, relative to all else"
    )
    adversary_every: int = Field(2, ge=1, description="it judges and learns in one of so many steps")
    pixel_weight: float = Field(
        0.08, ge=0, le=1, description="of the error of single invented pixels, relative to known ones"
    )
    most_seconds: float | None = Field(
        None, gt=0, description="the training ends after this time; None: after all steps"
    )
    seed: Seed = 0


class _RefinerTraining(NetworkTraining):
    """The drawing part of a restorer's training, for the refiner alone."""

    def _predicted(self, batch: Batch, *, drawing: bool) -> Predicted:
        assert isinstance(batch, RefinerBatch)
        rgb, rest = refined_colors(
            self.network, batch.conditioning, batch.laid, half_precision=self.settings.half_precision
        )
        depth, error = rest.split((1, 1), dim=1)
        return Predicted(rgb, depth, math.log(TYPICAL_ERROR) + error.clamp(-LOG_ERROR_LIMIT, LOG_ERROR_LIMIT))


def train_refiner(
    files: Sequence[Path], config: RefinerConfig, *, stage: str = "pretrain-refiner"
) -> Refiner:
    """Train a refiner from random weights, and score it on the scenes that are left out of the training.

    Args:
        files: of `RefinementExamples`, one for each scene that gives texture; the last ones validate.
        config: budget.
        stage: named in progress events.

    Raises:
        ConfigError: when there are not more scenes than those for validation.
        WeightsError: when the perceptual distance has no weights.
        DivergedError: when the loss or a weight stops being finite.
    """
    if len(files) <= config.validation_scenes:
        raise ConfigError(
            f"{len(files)} scenes give texture, and {config.validation_scenes} are for validation; none is "
            "left to train a refiner on"
        )
    perceptual = Lpips.load(net="squeeze")
    generator = torch.Generator().manual_seed(config.seed)
    network = build_network(REFINER_CHANNELS, REFINER_WIDTHS, generator)
    half = has_fast_half_precision()
    settings = TrainingSettings(
        config.iterations,
        config.learning_rate,
        half,
        perceptual,
        ema_decay=0.999,
        drawn_share=1.0,
        drawn_perceptual_weight=config.perceptual_weight,
        adversarial_weight=config.adversarial_weight,
        drawn_pixel_weight=config.pixel_weight,
        adversary_every=config.adversary_every,
        adversary_half_precision=half,
    )
    training = _RefinerTraining(network, settings, generator, stage=stage)
    crops = [
        ExampleCrops(RefinementExamples.load(file), config.crop, config.seed * 100_003 + number)
        for number, file in enumerate(files[: -config.validation_scenes])
    ]
    chosen = np.random.default_rng([config.seed, 9])
    begun = time.monotonic()
    left = math.inf if config.most_seconds is None else config.most_seconds
    while training.iteration < config.iterations and time.monotonic() - begun < left:
        picked = chosen.integers(len(crops), size=config.batch)
        training.step(RefinerBatch.of_crops(torch.cat([crops[int(scene)].draw() for scene in picked])))
    record = {
        "training": config.model_dump(mode="json"),
        "scenes": len(files),
        "iterations_made": training.iteration,
        "threads": torch.get_num_threads(),
        "history": training.history[:: max(1, len(training.history) // 200)],
    }
    refiner = Refiner(training.finished(), record, half_precision=half)
    scores = refiner_scores(refiner, files[-config.validation_scenes :], perceptual)
    return replace(refiner, record={**record, "validation_scores": scores})


def refiner_scores(
    refiner: Refiner, files: Sequence[Path], lpips: Lpips
) -> dict[str, dict[str, float | None]]:
    """Figures of the invented pixels: smooth, with texture laid onto it, and refined.

    Args:
        refiner: trained.
        files: of `RefinementExamples` that it was not trained on.
        lpips: any backbone.

    Returns:
        For each of the three the means of PSNR and of LPIPS over the views in which something is invented;
        None where that is no view.
    """
    found: dict[str, dict[str, list[float]]] = {}
    for file in files:
        examples = RefinementExamples.load(file)
        smooth, clean = examples.rgb.float(), examples.target.float().permute(0, 2, 3, 1)
        share, unknown, depth, facing, texels = examples.maps.float().split(1, dim=1)
        laid = LaidTexture(examples.changes[0].float(), share, facing, texels)
        region = (share[:, 0] > 0.5) & (examples.weight[:, 0] > 0)
        views = {
            "smooth": smooth,
            "textured": (smooth + laid.change).clamp(0, 1),
            "refined": refiner.refined(smooth, laid, depth, unknown),
        }
        for name, rgb in views.items():
            shown = rgb.permute(0, 2, 3, 1)
            distances = lpips.regional_distances(shown, clean, {"invented": region})["invented"]
            figures = found.setdefault(name, {"psnr": [], lpips.name: []})
            figures[lpips.name] += [value for value in distances if value is not None]
            figures["psnr"] += [value for value in psnr_per_image(shown, clean, region) if value is not None]
    return {
        name: {
            figure: round(float(np.mean(values)), 4) if values else None for figure, values in figures.items()
        }
        for name, figures in found.items()
    }
