"""Which restorer a scene gets, and how a saved one comes back."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from extrags.config import CoarseConfig, EnhanceConfig
from extrags.errors import ConfigError, WeightsError
from extrags.events import MetricRecorded, emit
from extrags.restoration.classical import ClassicalEnhancer
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer, validation_scores
from extrags.restoration.diffusion.weights import find_weights
from extrags.restoration.pretrained.checkpoint import CheckpointEnhancer
from extrags.restoration.pretrained.enhancer import ADAPTERS, PretrainedEnhancer
from extrags.restoration.protocol import Enhancer
from extrags.restoration.training_data.pairs import MIN_FRAMES, Pairs, make_pairs
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.view_synthesis.gamut import Gamut
from extrags.view_synthesis.references import LightTransfer, ReferenceViews

__all__ = ["judged", "load_enhancer", "scene_gamut", "starting_restorer", "train_enhancer"]

MAX_LOSS_DB = 0.5
"""Leave-out views lie near the path, where there is little to restore: so much behind is not yet harm."""

logger = logging.getLogger(__name__)


def train_enhancer(
    scene: Scene, sequence: EndoscopicSequence, config: EnhanceConfig, coarse: CoarseConfig
) -> Enhancer:
    """The restorer of a scene: trained on the scene's own pairs, or prepared where nothing is trained.

    Args:
        scene: the coarse scene, trained on `sequence.train`.
        sequence: posed frames; only training frames are used.
        config: backend and budgets.
        coarse: settings of the leave-out reconstructions.

    Raises:
        CaptureError: with too few training frames for the embedded backend.
        DivergedError: when a reconstruction or the training does not stay finite.
        WeightsError: when a pretrained model is not there; says how to get it.
        MissingDependencyError: when a pretrained backend lacks a package.
        ConfigError: when its settings do not fit.
    """
    if config.backend == "classical":
        return ClassicalEnhancer()
    if config.backend == CheckpointEnhancer.name:
        return CheckpointEnhancer.prepare(scene, sequence, config)
    if config.backend in ADAPTERS:
        return PretrainedEnhancer.prepare(scene, sequence, config)
    start = starting_restorer(config)
    transfer = ReferenceViews.gather(scene, sequence, sequence.train).transfer
    if start is not None and config.train_iterations == 0:
        pretrained = start.with_settings(config, scene_gamut(sequence))
        if not config.judge or len(sequence.train) < MIN_FRAMES:
            return pretrained
        # Nothing is trained: all pairs judge, and torn ones would flatter who fills holes.
        fresh = make_pairs(scene, sequence, config.model_copy(update={"synthetic_views": 0}), coarse)
        pairs = replace(fresh, validation=np.ones(len(fresh), dtype=bool))
        return judged(pretrained, pairs, transfer)
    pairs = make_pairs(scene, sequence, config, coarse)
    trained = EmbeddedEnhancer.train(pairs, transfer, config, start)
    return judged(trained, pairs, transfer) if config.judge else trained


def judged(enhancer: EmbeddedEnhancer, pairs: Pairs, transfer: LightTransfer) -> Enhancer:
    """The restorer, unless blending and filling does better on the scene's leave-out pairs.

    A network far from what it has learned from does harm: on such a scene the classical restorer serves,
    and says why.

    Args:
        enhancer: ready for the scene.
        pairs: those that validate were not trained on.
        transfer: how brightness changes with distance.
    """
    scores = validation_scores(enhancer, pairs, transfer, (enhancer.steps,))
    restored, filled = scores[f"embedded_{enhancer.steps}"]["psnr"], scores["classical"]["psnr"]
    emit(MetricRecorded("enhance", "judged_gain_over_classical_db", restored - filled))
    if restored < filled - MAX_LOSS_DB:
        reason = (
            f"on leave-out pairs of this scene the embedded restorer reaches {restored:.2f} dB, blending and "
            f"filling {filled:.2f} dB"
        )
        logger.warning("%s; the scene is restored by blending and filling", reason)
        return ClassicalEnhancer(reason)
    found = {**enhancer.record.get("validation", {}), **scores}
    return replace(enhancer, record={**enhancer.record, "validation": found})


def starting_restorer(config: EnhanceConfig) -> EmbeddedEnhancer | None:
    """What the embedded backend starts from; None where it learns from the scene's pairs alone.

    Args:
        config: weights and budget.

    Raises:
        WeightsError: when the weights are not there, or do not fit.
        ConfigError: when there would be neither weights nor training.
    """
    weights = find_weights(config.pretrained_weights)
    if weights is None and config.train_iterations == 0:
        raise ConfigError(
            "enhance.train_iterations is 0 and enhance.pretrained_weights is none: nothing would restore"
        )
    return None if weights is None else EmbeddedEnhancer.load(weights)


def scene_gamut(sequence: EndoscopicSequence) -> Gamut:
    """Hues of the training frames' valid tissue."""
    images = torch.from_numpy(sequence.rgb[sequence.train].astype(np.float32) / 255).permute(0, 3, 1, 2)
    weight = torch.from_numpy(sequence.mask[sequence.train].astype(np.float32))[:, None]
    return Gamut.of_images(images, weight)


def load_enhancer(path: Path) -> Enhancer:
    """Read a restorer that `Enhancer.save` wrote.

    Raises:
        WeightsError: when there is none, or it does not fit this version.
    """
    description = path / "restorer.json"
    if not description.exists():
        raise WeightsError(f"{description}: no such file; train the restorer first (stage enhance)")
    backend = json.loads(description.read_text()).get("backend")
    if backend == ClassicalEnhancer.name:
        return ClassicalEnhancer(json.loads(description.read_text()).get("reason", ""))
    if backend == EmbeddedEnhancer.name:
        return EmbeddedEnhancer.load(path)
    if backend == CheckpointEnhancer.name:
        return CheckpointEnhancer.load(path)
    if backend in ADAPTERS:
        return PretrainedEnhancer.load(path)
    known = ["classical", "embedded", *sorted(ADAPTERS), CheckpointEnhancer.name]
    raise WeightsError(f"{description}: unknown backend {backend!r}; known: {', '.join(known)}")
