"""Training of the embedded restorer on one scene's own pairs."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.config import EnhanceConfig
from extrags.errors import CaptureError
from extrags.events import MetricRecorded, emit
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.error_fit import with_calibration
from extrags.restoration.diffusion.network import SIZE_MULTIPLE, build_network
from extrags.restoration.diffusion.network_training import TrainingSettings, train_network
from extrags.restoration.diffusion.validation import restored_pairs, validation_pairs, validation_scores
from extrags.restoration.training_data.augmentation import CropSampler
from extrags.restoration.training_data.pairs import Pairs
from extrags.threads import one_torch_thread
from extrags.view_synthesis.conditioning import CONDITION_CHANNELS
from extrags.view_synthesis.gamut import Gamut
from extrags.view_synthesis.references import LightTransfer

__all__ = ["train_on_scene"]

MIN_PROBED_ITERATIONS = 200
PROBE_DIVISOR = 5
"""A training of at least so many iterations is first tried with this fraction of them."""
MIN_GAIN_DB = 0.1
"""Smallest PSNR gain on the validation pairs at which the training is kept; less may be chance."""

Scores = dict[str, dict[str, float]]


@one_torch_thread()
def train_on_scene(
    pairs: Pairs,
    transfer: LightTransfer,
    config: EnhanceConfig,
    start: EmbeddedEnhancer | None = None,
    *,
    patches: Float[Tensor, "r 3 s s"] | None = None,
    deterministic: bool = False,
) -> EmbeddedEnhancer:
    """Train on a scene's pairs, and keep the training only where the validation pairs show a gain.

    With `start`, its network is fine-tuned; without a gain on the validation pairs, and where no pair has a
    valid pixel, its weights are kept unchanged. With one, what it was before is kept beside it
    (`EmbeddedEnhancer.untrained`). The same pairs and settings give the same weights, whatever the number of
    threads.

    Args:
        pairs: training and validation pairs of the scene.
        transfer: how brightness changes with distance in this scene.
        config: budget, widths and seed.
        start: a restorer that was pretrained on other scenes.
        patches: parts of the scene's real frames, which a generative `start` takes texture from.
        deterministic: train a plain regression instead of a diffusion; with `start`, as that one is.

    Raises:
        CaptureError: without `start`, when no pair has a valid pixel: there is nothing to learn from.
        ConfigError: when no pair is left to train on, or the images are too small.
        DivergedError: when the loss stops being finite.
    """
    seen = bool((pairs.weight > 0).any())
    if start is None and not seen:
        raise CaptureError(
            "no training frame has a valid pixel that is not saturated, so that a restorer has nothing to "
            "learn from; set enhance.pretrained_weights to bundled, or enhance.backend to classical"
        )
    generator = torch.Generator().manual_seed(config.seed)
    chosen = pairs.subset(np.flatnonzero(~pairs.validation))
    gamut = Gamut.of_images(chosen.target, chosen.weight)
    base, rate = start, config.scene_learning_rate
    if base is None:
        network = build_network(CONDITION_CHANNELS, config.channels, generator)
        base = EmbeddedEnhancer(network, 1, 1, config.seed, False, gamut, {}, deterministic=deterministic)
        rate = config.learning_rate
    base = base.with_settings(config, gamut, patches)
    if not seen:
        # Nor is there anything to measure a gain by.
        return replace(base, record={**base.record, "scene_training_kept": False})
    candidates = base.candidate_steps(config)
    before = {} if start is None else validation_scores(base, pairs, transfer, candidates)
    training = _SceneTraining(pairs, transfer, config, base, rate, generator, candidates, before)
    trained = training.run(config.train_iterations) if start is None else training.probed()
    # Without validation pairs no gain can be measured, and the pretrained network is kept.
    kept = trained.gain_db > MIN_GAIN_DB and (start is None or validation_pairs(pairs) is not None)
    record = {**base.record, **training.record(trained)}
    validating = validation_pairs(pairs)

    def ready(restorer: EmbeddedEnhancer, scores: Scores, *, kept: bool) -> EmbeddedEnhancer:
        told = {**record, "scene_training_kept": kept}
        enhancer = replace(restorer, steps=_best(scores, candidates)[0], record=told)
        if validating is None:
            return enhancer
        return with_calibration(enhancer, restored_pairs(enhancer, validating, transfer))

    if not kept:
        return ready(base, before, kept=False)
    untrained = None if start is None else ready(base, before, kept=False)
    return replace(ready(trained.enhancer, trained.scores, kept=True), untrained=untrained)


@dataclass(frozen=True)
class _Trained:
    """Outcome of one training: the restorer, its loss, its scores and its PSNR gain in dB."""

    enhancer: EmbeddedEnhancer
    iterations: int
    history: list[dict[str, float]]
    scores: Scores
    gain_db: float


@dataclass(frozen=True)
class _SceneTraining:
    """What all trainings on a scene share.

    Args:
        pairs: training and validation pairs.
        transfer: how brightness changes with distance.
        config: budget and seed.
        base: the restorer before training; it is not changed.
        learning_rate: the peak.
        generator: of times and noise; trainings draw from it one after the other.
        candidates: numbers of sampling steps to choose from.
        before: validation scores of a pretrained base; empty without one.
    """

    pairs: Pairs
    transfer: LightTransfer
    config: EnhanceConfig
    base: EmbeddedEnhancer
    learning_rate: float
    generator: torch.Generator
    candidates: tuple[int, ...]
    before: Scores

    def run(self, iterations: int) -> _Trained:
        """Train a copy of the base."""
        config = self.config
        learner = replace(self.base, network=copy.deepcopy(self.base.network))
        patches = learner.patches
        sampler = CropSampler(
            self.pairs,
            self.transfer,
            batch=config.batch,
            crop_px=config.crop,
            side_multiple=SIZE_MULTIPLE,
            seed=config.seed,
            frames=None if patches is None else (patches, torch.ones_like(patches[:, 0], dtype=torch.bool)),
            patches=(0, 0) if patches is None else (len(patches), patches.shape[-1]),
            folded=learner.network.folded,
        )
        settings = TrainingSettings(
            iterations,
            self.learning_rate,
            learner.half_precision,
            deterministic=learner.deterministic,
        )
        _, history = train_network(learner.network, sampler.draw, settings, self.generator)
        scores = validation_scores(learner, self.pairs, self.transfer, self.candidates)
        reached = _best(self.before, self.candidates)[1] if self.before else -math.inf
        gain_db = _best(scores, self.candidates)[1] - reached
        return _Trained(learner, iterations, history, scores, gain_db)

    def probed(self) -> _Trained:
        """As `run` with all iterations, unless a short trial of a long training shows no gain."""
        iterations = self.config.train_iterations
        if iterations >= MIN_PROBED_ITERATIONS:
            probe = self.run(iterations // PROBE_DIVISOR)
            if probe.gain_db <= 0:
                return probe
        return self.run(iterations)

    def record(self, trained: _Trained) -> dict[str, Any]:
        """How it was trained and what it reached, ready for JSON; scores are emitted as events too."""
        untrained = {f"untrained_{k}": v for k, v in self.before.items() if k.startswith("embedded_")}
        scores = {**trained.scores, **untrained}
        for method, values in scores.items():
            emit(MetricRecorded("enhance", f"validation_psnr_{method}", values["psnr"]))
        return {
            "training_pairs": int((~self.pairs.validation).sum()),
            "validation_pairs": int(self.pairs.validation.sum()),
            "iterations": trained.iterations,
            "history": trained.history,
            "validation": scores,
        }


def _best(scores: Scores, candidates: tuple[int, ...]) -> tuple[int, float]:
    """The number of steps with the highest PSNR, and that PSNR."""
    steps = max(candidates, key=lambda count: scores[f"embedded_{count}"]["psnr"])
    return steps, scores[f"embedded_{steps}"]["psnr"]
