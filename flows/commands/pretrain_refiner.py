"""`pretrain --refiner`: the weights of the refiner, from the scenes that the restorer is trained on."""

from __future__ import annotations

import argparse
import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from extrags.errors import CaptureError, ConfigError, ExtragsError
from flows.commands.common import training_settings

if TYPE_CHECKING:
    from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
    from extrags.restoration.refinement.refiner import Refiner
    from extrags.restoration.refinement.training import RefinerConfig

__all__ = ["RefinedRestorer", "examples_of", "refiner_settings", "start_of_refiner", "trained_refiner"]

logger = logging.getLogger(__name__)


def refiner_settings(given: argparse.Namespace) -> RefinerConfig:
    """Settings of the training.

    Raises:
        ConfigError: for an option that refiners do not have, an unknown setting, or a wrong value.
    """
    from extrags.restoration.refinement.training import RefinerConfig

    for name in ("generative", "deterministic", "without_perceptual", "error_weight"):
        if getattr(given, name) not in (None, False):
            raise ConfigError(
                f"--{name.replace('_', '-')}: this is for restorers; --refiner trains a refiner"
            )
    names = (
        "scenes",
        "validation_scenes",
        "iterations",
        "batch",
        "learning_rate",
        "perceptual_weight",
        "seed",
    )
    return training_settings(given, RefinerConfig, names, "extrags pretrain --refiner")


@dataclass(frozen=True)
class RefinedRestorer:
    """The restorer whose views a refiner learns to refine, and the digest of its weights."""

    restorer: EmbeddedEnhancer
    digest: str


def start_of_refiner(start: str) -> RefinedRestorer:
    """Find the restorer whose views are to be refined.

    Args:
        start: a folder with weights, or the name of a set of the package's.

    Raises:
        ConfigError: where there are none.
    """
    from extrags.config import EnhanceConfig
    from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
    from extrags.restoration.diffusion.precision import chosen_precision
    from extrags.restoration.diffusion.weights import starting_weights, weights_digest

    try:
        restorer, digest = (
            EmbeddedEnhancer.load(starting_weights(start)).without_scene(),
            str(weights_digest(start)),
        )
    except ExtragsError as error:
        raise ConfigError(f"--start {start}: {error}") from error
    half = chosen_precision(EnhanceConfig()) == "bfloat16"
    return RefinedRestorer(replace(restorer, steps=1, half_precision=half), digest)


def examples_of(files: Sequence[Path], start: RefinedRestorer) -> list[Path]:
    """Restored views with texture of pretraining scenes, kept beside them.

    Args:
        files: of the scenes.
        start: gives the smooth views.

    Returns:
        One file for each scene that gives texture.

    Raises:
        WeightsError: when a file is not a pretraining scene.
    """
    from extrags.events import Progress, emit
    from extrags.restoration.refinement.examples import EXAMPLES_VERSION, RefinementExamples
    from extrags.restoration.training_data.pretraining_scenes import PretrainingScene

    found = []
    for done, file in enumerate(files):
        emit(Progress("refiner-examples", done, len(files)))
        origin = f"{EXAMPLES_VERSION} {start.digest} {PretrainingScene.made_from(file)}"
        key = hashlib.blake2b(origin.encode(), digest_size=8).hexdigest()
        example = file.parent / "refinement" / f"{file.stem}_{key}.safetensors"
        if not example.exists():
            try:
                made = RefinementExamples.of_scene(PretrainingScene.load(file), start.restorer)
            except CaptureError as error:
                logger.warning("%s: left out, %s", file.name, error)
                continue
            made.save(example)
        found.append(example)
    emit(Progress("refiner-examples", len(files), len(files)))
    return found


def trained_refiner(
    files: Sequence[Path], config: RefinerConfig, start: RefinedRestorer, about: dict[str, Any]
) -> Refiner:
    """Train a refiner on pretraining scenes.

    Args:
        files: of the scenes.
        config: budget.
        start: gives the smooth views.
        about: command and machine, for the record.

    Raises:
        ExtragsError: as `examples_of` and `train_refiner`.
    """
    from extrags.restoration.refinement.training import train_refiner

    refiner = train_refiner(examples_of(files, start), config)
    return replace(refiner, record={**refiner.record, "restorer": start.digest, **about})
