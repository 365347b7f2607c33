"""Pretraining of the weights that come with the package: one network, trained on many scenes."""

from __future__ import annotations

import copy
import hashlib
import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from pydantic import Field, model_validator
from torch import Tensor

from extrags.array_files import load_safetensors, save_safetensors
from extrags.config.base import Seed, StageConfig
from extrags.config.restorer import LevelWidth
from extrags.devices import chosen_device
from extrags.errors import ConfigError, WeightsError, reason_of
from extrags.metrics.lpips import Lpips
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.error_fit import with_error_model
from extrags.restoration.diffusion.frame_features import frame_features
from extrags.restoration.diffusion.network import SIZE_MULTIPLE, RestorationNetwork, build_network
from extrags.restoration.diffusion.network_training import NetworkTraining, TrainingSettings
from extrags.restoration.diffusion.precision import has_fast_half_precision
from extrags.restoration.diffusion.validation import validation_scores
from extrags.restoration.training_data.augmentation import (
    PATCH_SIDE_MULTIPLE,
    Batch,
    CropSampler,
    MixedSampler,
    random_patches,
)
from extrags.restoration.training_data.parallel import drawn_in_processes
from extrags.restoration.training_data.pretraining_scenes import PretrainingScene
from extrags.restoration.uncertainty.domain import Domain
from extrags.view_synthesis.conditioning import CONDITION_CHANNELS, INVENTED_CHANNELS, Layers
from extrags.view_synthesis.gamut import Gamut

__all__ = ["PretrainingConfig", "check_settings", "check_sizes", "pretrain"]

ANY_HUE = Gamut(0.0, 1e6, 0.0, 1e6)
MAX_STEPS = 4
SCORED_PATCHES = 8
"""Patches per scene that tell what the network has learned from."""
SETTINGS = "settings"
"""Name in a checkpoint of the settings of its training."""
BEGINNING = "beginning"
"""Name in a checkpoint of how its training began."""
UNKNOWN = "unknown"
"""Stands for what a checkpoint of an earlier version does not say."""
MAY_CHANGE = ("iterations", "scenes", "device", "drawing_processes", "most_seconds", "checkpoint_seconds")
"""Settings that a training which goes on may have otherwise than the one that wrote its checkpoint."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Beginning:
    """How a training began, for its record, whoever makes its last steps; ready for JSON.

    Args:
        start: digest of the weights that it began with; None for random ones, `UNKNOWN` where a checkpoint
            of an earlier version does not say.
        before: record of these weights; None and `UNKNOWN` as above.
        about: whatever its caller said of it, such as the command.
        resumed: what each call said that went on from a checkpoint.
    """

    start: str | None
    before: dict[str, Any] | str | None
    about: dict[str, Any]
    resumed: Sequence[dict[str, Any]] = ()


class PretrainingConfig(StageConfig):
    """Budget of a pretraining."""

    scenes: int = Field(86, ge=2, description="pretraining scenes in all")
    validation_scenes: int = Field(6, ge=1, description="how many of them, the last ones, validate only")
    iterations: int = Field(13_500, ge=1, description="optimisation steps")
    batch: int = Field(4, ge=1, description="crops per step, each from a scene of its own")
    crop: int = Field(96, ge=32, multiple_of=8, description="side of a crop in pixels")
    channels: tuple[LevelWidth, LevelWidth, LevelWidth] = Field(
        (48, 96, 160), description="widths of the U-Net's levels"
    )
    learning_rate: float = Field(8e-4, gt=0, description="peak, after the warm-up")
    ema_decay: float = Field(0.999, ge=0, lt=1, description="memory of the running mean of the weights")
    perceptual: bool = Field(
        True, description="LPIPS with SqueezeNet counts beside the pixels' errors; its weights are needed"
    )
    perceptual_weight: float = Field(0.15, gt=0, description="of that distance")
    error_weight: float = Field(0.02, gt=0, description="of the expected error's likelihood")
    deterministic: bool = Field(False, description="a plain regression instead of a diffusion")
    generative: bool = Field(
        False, description="draws plausible views as well as their mean, with texture from the scene's frames"
    )
    drawn_share: float = Field(0.7, ge=0, le=1, description="share of the steps that train drawing")
    drawn_perceptual_weight: float = Field(1.0, gt=0, description="of the perceptual distance in these")
    adversarial_weight: float = Field(
        1.0, ge=0, description="pull of the adversary at invented colours, relative to all else in these"
    )
    adversary_rate: float = Field(4e-4, gt=0, description="learning rate of the adversary")
    color_variety: float = Field(
        0.0, ge=0, le=1, description="how far hue, saturation and contrast of crops are varied"
    )
    photograph_share: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="share of the crops that are frames of the recording, blurred in parts and with holes",
    )
    patches: int = Field(6, ge=1, description="patches of the scene's frames beside each crop")
    patch_px: int = Field(64, ge=32, multiple_of=8, description="side of a patch")
    device: Literal["auto", "cpu", "cuda"] = Field(
        "cpu", description="where the network is trained; auto: cuda where there is one"
    )
    drawing_processes: int = Field(
        0, ge=0, description="processes that cut crops ahead, at most one per scene; 0: a thread does"
    )
    most_seconds: float | None = Field(
        None,
        gt=0,
        description="the training ends after this time, however many steps it has made; None: after all",
    )
    checkpoint_seconds: float = Field(300, gt=0, description="between two checkpoints")
    seed: Seed = 0

    @model_validator(mode="after")
    def _generative_needs_perception(self) -> PretrainingConfig:
        if self.generative and (self.deterministic or not self.perceptual):
            raise ValueError("generative needs the perceptual distance, and does not go with deterministic")
        return self


def pretrain(
    files: Sequence[Path],
    config: PretrainingConfig,
    start: EmbeddedEnhancer | None = None,
    *,
    stage: str = "pretrain",
    checkpoint: Path | None = None,
    about: Mapping[str, Any] | None = None,
) -> EmbeddedEnhancer:
    """Train on pretraining scenes; the last ones validate it and calibrate the expected error of one step.

    The same files, settings and number of threads give the same weights on one machine; a training that
    went on from a checkpoint draws other crops than one that was never interrupted.

    Args:
        files: pretraining scenes in order; as many as the settings say.
        config: budget.
        start: restorer whose weights are trained further; None starts from random weights.
        stage: named in progress events.
        checkpoint: file that the training is written to every now and then, and goes on from if it is there;
            it may have been written on another device, and for another number of iterations, time and
            processes, not with other settings or other weights to start from. None keeps none.
        about: of this call, ready for JSON: the record has it beside the settings. Of a training that goes on
            it is that of the beginning, and what was given later is listed as `resumed`.

    Raises:
        ConfigError: when the number of files does not fit the settings, or as `check_settings` and
            `check_sizes`.
        WeightsError: when a file is not a pretraining scene, the perceptual distance has no weights, or the
            checkpoint is of a training with other settings, or that began with other weights.
        DivergedError: when the loss or a weight stops being finite.
    """
    if len(files) != config.scenes or config.validation_scenes >= config.scenes:
        raise ConfigError(
            f"{len(files)} pretraining scenes found, settings say {config.scenes}, of which "
            f"{config.validation_scenes} are for validation"
        )
    device = check_settings(config, start)
    kept, unseen = files[: -config.validation_scenes], files[-config.validation_scenes :]
    check_sizes(config, [PretrainingScene.size_of(file) for file in kept])
    perceptual = Lpips.load(net="squeeze").to(device) if config.perceptual else None
    generator = torch.Generator().manual_seed(config.seed)
    network = _starting_network(config, start, generator).to(device)
    half = has_fast_half_precision() if device.type == "cpu" else True
    settings = TrainingSettings(
        config.iterations,
        config.learning_rate,
        half,
        perceptual,
        config.perceptual_weight,
        config.error_weight,
        deterministic=config.deterministic,
        ema_decay=config.ema_decay,
        drawn_share=config.drawn_share if config.generative else 0.0,
        drawn_perceptual_weight=config.drawn_perceptual_weight,
        adversarial_weight=config.adversarial_weight,
        adversary_rate=config.adversary_rate,
    )
    training = NetworkTraining(network, settings, generator, stage=stage)
    beginning = _Beginning(
        None if start is None else _digest(start.network),
        None if start is None else start.record,
        dict(about or {}),
    )
    if checkpoint is not None and checkpoint.exists():
        beginning = _go_on(training, checkpoint, config, beginning)
        generator.manual_seed(config.seed + training.iteration)
        logger.info("%s: going on from %s, step %d", stage, checkpoint, training.iteration)
    sampler = partial(_mixed_sampler, kept, config, training.iteration)
    with drawn_in_processes(sampler, config.drawing_processes) as draw:
        _train(training, draw, config, checkpoint, beginning)
    network, history = training.finished().cpu(), training.history
    record: dict[str, Any] = {
        "pretraining": config.model_dump(mode="json"),
        "before": beginning.before,
        **beginning.about,
        **({"resumed": list(beginning.resumed)} if beginning.resumed else {}),
        "threads": torch.get_num_threads(),
        "iterations_made": training.iteration,
        "history": history[:: max(1, len(history) // 200)],
    }
    trained = EmbeddedEnhancer(
        network, 1, 1, config.seed, half, ANY_HUE, record, deterministic=config.deterministic
    )
    return replace(_scored(trained, unseen, config), domain=_domain(trained, kept, unseen))


def check_settings(config: PretrainingConfig, start: EmbeddedEnhancer | None) -> torch.device:
    """Look at everything in the settings that would fail once the scenes are there.

    Args:
        config: budget.
        start: restorer whose weights are trained further; None starts from random weights.

    Returns:
        Where the network is trained.

    Raises:
        ConfigError: when there are more drawing processes than scenes, the device is not there, or the
            weights to start from are of another kind of network.
    """
    if config.drawing_processes > config.scenes - config.validation_scenes:
        raise ConfigError(
            f"drawing_processes={config.drawing_processes}: there are "
            f"{config.scenes - config.validation_scenes} scenes to train on, and each process needs one"
        )
    if start is not None:
        if start.network.widths != config.channels or start.deterministic != config.deterministic:
            raise ConfigError(
                f"the weights to start from have channels {start.network.widths}, deterministic is "
                f"{start.deterministic}; the settings say {config.channels} and {config.deterministic}"
            )
        if start.network.generative and not config.generative:
            raise ConfigError("the weights to start from are generative; set generative as well")
    return chosen_device(config.device, "pretraining.device")


def check_sizes(config: PretrainingConfig, sizes: Sequence[tuple[int, int]]) -> None:
    """Look whether one size of crops and of patches fits all scenes: those of a batch come from several.

    Args:
        config: budget.
        sizes: height and width in pixels of the images of each scene that is trained on.

    Raises:
        ConfigError: when crops or patches would be smaller in some scenes than in others; says which size
            fits all.
    """
    asked = {"crop": (config.crop, SIZE_MULTIPLE)}
    if config.generative:
        asked["patch_px"] = (config.patch_px, PATCH_SIDE_MULTIPLE)
    for name, (side, multiple) in asked.items():
        found = {min(side, *size) // multiple * multiple: size for size in sizes}
        if len(found) > 1:
            height, width = found[min(found)]
            raise ConfigError(
                f"{name}={side}: images of some scenes ({width}x{height} px) are too small for it, and "
                f"all of a batch have one size; set {name}={min(found)}"
            )


def _train(
    training: NetworkTraining,
    draw: Callable[[], Batch],
    config: PretrainingConfig,
    checkpoint: Path | None,
    beginning: _Beginning,
) -> None:
    """Steps until iterations or time are spent; batches are drawn while the network computes."""
    begun = written = time.monotonic()
    with ThreadPoolExecutor(1) as ahead:
        following = ahead.submit(draw)
        while training.iteration < config.iterations:
            batch = following.result()
            following = ahead.submit(draw)
            training.step(batch)
            now = time.monotonic()
            if checkpoint is not None and now - written > config.checkpoint_seconds:
                _write(checkpoint, training, config, beginning)
                written = now
            if config.most_seconds is not None and now - begun > config.most_seconds:
                break
        following.cancel()
    if checkpoint is not None:
        _write(checkpoint, training, config, beginning)


def _write(file: Path, training: NetworkTraining, config: PretrainingConfig, beginning: _Beginning) -> None:
    """A checkpoint, with the settings that shaped the training so far, and how it began.

    Raises:
        DivergedError: when a weight is not finite: no training goes on from there.
    """
    training.check_finite()
    further = {SETTINGS: _as_tensor(_lasting(config)), BEGINNING: _as_tensor(asdict(beginning))}
    save_safetensors(file, {**training.state(), **further})


def _as_tensor(value: dict[str, Any]) -> UInt8[Tensor, "b"]:
    """What is ready for JSON as bytes, which a file of tensors can hold."""
    return torch.frombuffer(bytearray(json.dumps(value).encode()), dtype=torch.uint8)


def _digest(network: RestorationNetwork) -> str:
    """Of all weights, by content: the file they are read from may lie elsewhere."""
    digest = hashlib.blake2b(digest_size=16)
    for name, value in network.state_dict().items():
        digest.update(f"{name} {tuple(value.shape)}\0".encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _lasting(config: PretrainingConfig) -> dict[str, Any]:
    return config.model_dump(mode="json", exclude=set(MAY_CHANGE))


def _go_on(training: NetworkTraining, file: Path, config: PretrainingConfig, now: _Beginning) -> _Beginning:
    """Take over a checkpoint.

    Args:
        training: changed in place.
        file: the checkpoint.
        config: of this call.
        now: what the training would begin with if there were no checkpoint.

    Returns:
        How the training began, and with what it was resumed, this time included.

    Raises:
        WeightsError: when the file is none, or of a training with other settings, or that began with other
            weights.
    """
    try:
        state = load_safetensors(file)
        # Checkpoints of an earlier version have none.
        given = json.loads(bytes(state[SETTINGS].numpy())) if SETTINGS in state else {}
        changed = [
            f"{name} was {given[name]} and is {value}"
            for name, value in _lasting(config).items()
            if name in given and given[name] != value
        ]
        if changed:
            raise ValueError(f"its settings are others: {', '.join(changed)}")
        if BEGINNING in state:
            began = _Beginning(**json.loads(bytes(state[BEGINNING].numpy())))
        else:
            began = _Beginning(UNKNOWN, UNKNOWN, dict.fromkeys(now.about, UNKNOWN))
        if began.start not in (UNKNOWN, now.start):
            raise ValueError("it began with other weights")
        training.restore(state)
    except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
        raise WeightsError(
            f"{file}: not a checkpoint of this training ({reason_of(error)}); give the same settings and "
            "start, or remove it to begin anew"
        ) from error
    return replace(began, resumed=(*began.resumed, now.about))


def _mixed_sampler(
    files: Sequence[Path], config: PretrainingConfig, iteration: int, number: int, processes: int
) -> Callable[[], Batch]:
    """What draws batches from every n-th scene, for one of n processes."""
    samplers = [
        _sampler(file, config, index, iteration)
        for index, file in enumerate(files)
        if index % processes == number
    ]
    seed = config.seed + iteration + 1_000_003 * number
    return MixedSampler(samplers, batch=config.batch, seed=seed).draw


def _sampler(file: Path, config: PretrainingConfig, number: int, iteration: int) -> CropSampler:
    scene = PretrainingScene.load(file)
    # In half precision, as in the file: all scenes are held at once.
    pairs = replace(
        scene.pairs,
        layers=Layers(scene.pairs.layers.data.half()),
        target=scene.pairs.target.half(),
        weight=scene.pairs.weight.half(),
        depth_mm=scene.pairs.depth_mm.half(),
    )
    shows_frames = config.generative or config.photograph_share > 0
    return CropSampler(
        pairs,
        scene.transfer,
        batch=1,
        crop_px=config.crop,
        side_multiple=SIZE_MULTIPLE,
        # A training that goes on must not see the same crops again.
        seed=config.seed * 100_003 + number + 1_000_003 * iteration,
        frames=(scene.references.images, scene.references.valid) if shows_frames else None,
        patches=(config.patches if config.generative else 0, config.patch_px),
        folded=not config.generative,
        color_variety=config.color_variety,
        photograph_share=config.photograph_share,
    )


def _starting_network(
    config: PretrainingConfig, start: EmbeddedEnhancer | None, generator: torch.Generator
) -> RestorationNetwork:
    if start is None:
        channels = CONDITION_CHANNELS + (INVENTED_CHANNELS if config.generative else 0)
        return build_network(channels, config.channels, generator, generative=config.generative)
    network = copy.deepcopy(start.network)
    if config.generative and not network.generative:
        return network.widened(CONDITION_CHANNELS + INVENTED_CHANNELS)
    return network


def _scored(enhancer: EmbeddedEnhancer, files: Sequence[Path], config: PretrainingConfig) -> EmbeddedEnhancer:
    """The restorer with error model, calibration and scores from the validation scenes.

    Args:
        enhancer: trained; a generative one is calibrated for the views that it draws.
        files: pretraining scenes for validation.
        config: size and seed of the patches.
    """
    candidates = (1,) if enhancer.deterministic else (1, MAX_STEPS)
    scenes = []
    scores: dict[str, list[dict[str, float]]] = {}
    for number, file in enumerate(files):
        scene = PretrainingScene.load(file)
        patches = _patches(scene, config, number) if enhancer.network.generative else None
        scenes.append((scene.pairs, scene.transfer, patches))
        own = replace(enhancer, patches=patches)
        found = validation_scores(own, scene.pairs, scene.transfer, candidates)
        if enhancer.network.generative:
            drawn = validation_scores(replace(own, drawing=True), scene.pairs, scene.transfer, candidates)
            found |= {name.replace("embedded", "drawn"): values for name, values in drawn.items()}
        for name, values in found.items():
            scores.setdefault(name, []).append(values)
    means: dict[str, dict[str, float]] = {}
    for name, of_scenes in scores.items():
        # A scene without holes has no figure for them.
        known = {key: [one[key] for one in of_scenes if key in one] for key in ("psnr", "ssim", "psnr_hole")}
        means[name] = {key: round(float(np.mean(found)), 4) for key, found in known.items() if found}
    record = {**enhancer.record, "validation_scores": means}
    return with_error_model(replace(enhancer, record=record, drawing=enhancer.network.generative), scenes)


def _patches(scene: PretrainingScene, config: PretrainingConfig, number: int) -> Float[Tensor, "r 3 s s"]:
    generator = np.random.default_rng([config.seed, 7, number])
    given = scene.references
    return random_patches(given.images, given.valid, SCORED_PATCHES, config.patch_px, generator)


def _domain(enhancer: EmbeddedEnhancer, trained: Sequence[Path], unseen: Sequence[Path]) -> Domain | None:
    """What the network was trained on, as it sees it; None where no frame shows tissue."""

    def features(file: Path) -> Float[np.ndarray, "r c"]:
        given = PretrainingScene.load(file).references
        return frame_features(enhancer.network, given.images.float(), given.valid)

    known = np.concatenate([features(file) for file in trained])
    others = [found for found in map(features, unseen) if len(found)]
    return Domain.fitted(known, others) if len(known) else None
