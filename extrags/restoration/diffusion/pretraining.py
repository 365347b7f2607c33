"""Pretraining of the weights that come with the package: one network, trained on many scenes."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import Field

from extrags.config.base import StageConfig
from extrags.errors import ConfigError
from extrags.metrics.lpips import Lpips
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.error_fit import with_error_model
from extrags.restoration.diffusion.network import SIZE_MULTIPLE, RestorationNetwork, build_network
from extrags.restoration.diffusion.precision import has_fast_half_precision
from extrags.restoration.diffusion.rectified_flow import TrainingSettings, train_network
from extrags.restoration.diffusion.validation import validation_scores
from extrags.restoration.training_data.augmentation import CropSampler, MixedSampler
from extrags.restoration.training_data.pretraining_scenes import PretrainingScene
from extrags.view_synthesis.conditioning import CONDITION_CHANNELS, Layers
from extrags.view_synthesis.gamut import Gamut

__all__ = ["PretrainingConfig", "pretrain"]

ANY_HUE = Gamut(0.0, 1e6, 0.0, 1e6)
MAX_STEPS = 4


class PretrainingConfig(StageConfig):
    """Budget of a pretraining."""

    scenes: int = Field(86, ge=2, description="pretraining scenes in all")
    validation_scenes: int = Field(6, ge=1, description="how many of them, the last ones, validate only")
    iterations: int = Field(13_500, ge=1, description="optimisation steps")
    batch: int = Field(4, ge=1, description="crops per step, each from a scene of its own")
    crop: int = Field(96, ge=32, description="side of a crop in pixels, a multiple of 8")
    channels: tuple[int, int, int] = Field((48, 96, 160), description="widths of the U-Net's levels")
    learning_rate: float = Field(8e-4, gt=0, description="peak, after the warm-up")
    ema_decay: float = Field(0.999, ge=0, lt=1, description="memory of the running mean of the weights")
    perceptual: bool = Field(
        True, description="LPIPS with SqueezeNet counts beside the pixels' errors; its weights are needed"
    )
    perceptual_weight: float = Field(0.15, gt=0, description="of that distance")
    error_weight: float = Field(0.02, gt=0, description="of the expected error's likelihood")
    deterministic: bool = Field(False, description="a plain regression instead of a diffusion")
    seed: int = Field(0, ge=0)


def pretrain(
    files: Sequence[Path],
    config: PretrainingConfig,
    start: EmbeddedEnhancer | None = None,
    *,
    stage: str = "pretrain",
) -> EmbeddedEnhancer:
    """Train on pretraining scenes; the last ones validate it and calibrate the expected error of one step.

    The same files, settings and number of threads give the same weights.

    Args:
        files: pretraining scenes in order; as many as the settings say.
        config: budget.
        start: restorer whose weights are trained further; None starts from random weights.
        stage: named in progress events.

    Raises:
        ConfigError: when the number of files does not fit the settings.
        WeightsError: when a file is not a pretraining scene, or the perceptual distance has no weights.
        DivergedError: when the loss stops being finite.
    """
    if len(files) != config.scenes or config.validation_scenes >= config.scenes:
        raise ConfigError(
            f"{len(files)} pretraining scenes found, settings say {config.scenes}, of which "
            f"{config.validation_scenes} are for validation"
        )
    perceptual = Lpips.load(net="squeeze") if config.perceptual else None
    samplers = [_sampler(file, config, n) for n, file in enumerate(files[: -config.validation_scenes])]
    mixed = MixedSampler(samplers, batch=config.batch, seed=config.seed)
    generator = torch.Generator().manual_seed(config.seed)
    network = _starting_network(config, start, generator)
    half = has_fast_half_precision()
    settings = TrainingSettings(
        config.iterations,
        config.learning_rate,
        half,
        perceptual,
        config.perceptual_weight,
        config.error_weight,
        deterministic=config.deterministic,
        ema_decay=config.ema_decay,
    )
    network, history = train_network(network, mixed.draw, settings, generator, stage=stage)
    record: dict[str, Any] = {
        "pretraining": config.model_dump(mode="json"),
        "before": None if start is None else start.record,
        "threads": torch.get_num_threads(),
        "history": history[:: max(1, len(history) // 200)],
    }
    trained = EmbeddedEnhancer(
        network, 1, 1, config.seed, half, ANY_HUE, record, deterministic=config.deterministic
    )
    return _scored(trained, files[-config.validation_scenes :])


def _sampler(file: Path, config: PretrainingConfig, number: int) -> CropSampler:
    scene = PretrainingScene.load(file)
    # In half precision, as in the file: in full precision a hundred scenes would take ten gigabytes.
    pairs = replace(scene.pairs, layers=Layers(scene.pairs.layers.data.half()))
    return CropSampler(
        pairs,
        scene.transfer,
        batch=1,
        crop_px=config.crop,
        side_multiple=SIZE_MULTIPLE,
        seed=config.seed * 100_003 + number,
    )


def _starting_network(
    config: PretrainingConfig, start: EmbeddedEnhancer | None, generator: torch.Generator
) -> RestorationNetwork:
    if start is None:
        return build_network(CONDITION_CHANNELS, config.channels, generator)
    if start.network.widths != config.channels or start.deterministic != config.deterministic:
        raise ConfigError(
            f"the weights to start from have channels {start.network.widths}, deterministic is "
            f"{start.deterministic}; the settings say {config.channels} and {config.deterministic}"
        )
    return copy.deepcopy(start.network)


def _scored(enhancer: EmbeddedEnhancer, files: Sequence[Path]) -> EmbeddedEnhancer:
    """The restorer with error model, calibration and scores from the validation scenes.

    Args:
        enhancer: trained.
        files: pretraining scenes for validation.
    """
    candidates = (1,) if enhancer.deterministic else (1, MAX_STEPS)
    loaded = [PretrainingScene.load(file) for file in files]
    scores: dict[str, list[dict[str, float]]] = {}
    for scene in loaded:
        for name, values in validation_scores(enhancer, scene.pairs, scene.transfer, candidates).items():
            scores.setdefault(name, []).append(values)
    means: dict[str, dict[str, float]] = {}
    for name, of_scenes in scores.items():
        # A scene without holes has no figure for them.
        known = {key: [one[key] for one in of_scenes if key in one] for key in ("psnr", "ssim", "psnr_hole")}
        means[name] = {key: round(float(np.mean(found)), 4) for key, found in known.items() if found}
    record = {**enhancer.record, "validation_scores": means}
    return with_error_model(replace(enhancer, record=record), [(one.pairs, one.transfer) for one in loaded])
