"""Training of the reader of hidden depth: the network that completes stereo, on restored views with holes."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from extrags.config.base import Seed, StageConfig
from extrags.depth.completion import SEEN, CompletionNetwork, completion_loss
from extrags.depth.hidden import LONGEST_SIDES_PX, met_where_known, read_depth
from extrags.depth.pretraining.training import CompletionTraining, ExampleBank, train_completion
from extrags.errors import ConfigError
from extrags.events import Progress, emit
from extrags.restoration.diffusion.precision import has_fast_half_precision
from extrags.restoration.hidden_depth.examples import HiddenDepthExamples
from extrags.thresholds import HOLE_ALPHA

__all__ = ["HiddenDepthConfig", "hidden_depth_loss", "hidden_depth_scores", "train_hidden_depth"]

KNOWN_WEIGHT = 0.05
"""Of pixels with known depth, relative to hidden ones. There the log-depth that is judged is the true one:
what counts are slopes across the border, and the expected error."""


class HiddenDepthConfig(StageConfig):
    """Budget of the training."""

    scenes: int = Field(80, ge=2, description="recordings in all")
    validation_scenes: int = Field(8, ge=1, description="how many of them, the last ones, validate only")
    iterations: int = Field(4000, ge=1, description="optimisation steps")
    batch: int = Field(8, ge=1, description="views per step")
    learning_rate: float = Field(6e-4, gt=0, description="peak, after the warm-up")
    slope_weight: float = Field(0.5, ge=0, description="of differences between neighbours")
    error_weight: float = Field(
        0.1, ge=0, description="of the expected error's likelihood; the error is not used yet"
    )
    completion: str = Field("bundled", description="the depth completion to start from: bundled, or a file")
    most_seconds: float | None = Field(
        None, gt=0, description="the training ends after this time; None: after all steps"
    )
    seed: Seed = 0


def hidden_depth_loss(
    channels: Float[Tensor, "v 19 h w"],
    log_depth: Float[Tensor, "v h w"],
    log_error: Float[Tensor, "v h w"],
    truth: Float[Tensor, "v h w"],
    known: Float[Tensor, "v h w"],
) -> dict[str, Tensor]:
    """Terms of the loss, as `completion_loss`, of what is hidden.

    What is read meets the truth where the rendering is solid, as it meets the rendering in use, so that only
    what differs from there counts: a reconstruction may stand at another scale, or a little beside the truth.

    Args:
        channels: from `reading_inputs`.
        log_depth: predicted, relative.
        log_error: logarithm of the expected absolute error of it.
        truth: true log-depth, relative to the same scale.
        known: one where the truth is known.
    """
    solid = channels[:, SEEN]
    met = met_where_known(log_depth, truth, solid * known)
    return completion_loss(met, log_error, truth, known * (1 - (1 - KNOWN_WEIGHT) * solid))


def train_hidden_depth(
    files: Sequence[Path], config: HiddenDepthConfig, start: CompletionNetwork
) -> tuple[CompletionNetwork, dict[str, Any]]:
    """Train a reader of hidden depth, and score it on the scenes that are left out of the training.

    Args:
        files: of `HiddenDepthExamples`; the last ones validate.
        config: budget.
        start: a network that completes stereo, which stays as it is.

    Returns:
        The network, and a record of its training.

    Raises:
        ConfigError: when there are not more scenes than those for validation, or none has a hole.
        DivergedError: as `train_completion`.
    """
    if len(files) <= config.validation_scenes:
        raise ConfigError(
            f"{len(files)} scenes could be explored, and {config.validation_scenes} are for validation; none "
            "is left to train on"
        )
    training, validation = files[: -config.validation_scenes], files[-config.validation_scenes :]
    bank = ExampleBank(torch.Generator().manual_seed(config.seed))
    for file in training:
        scene = HiddenDepthExamples.load(file)
        for longest in LONGEST_SIDES_PX:
            examples = scene.at_size(longest)
            if examples is not None:
                bank.add(examples)
    if len(bank) == 0:
        raise ConfigError(f"none of {len(training)} scenes has a hole to learn from")
    settings = CompletionTraining(
        config.iterations,
        config.batch,
        config.learning_rate,
        slope_weight=config.slope_weight,
        error_weight=config.error_weight,
        seconds=math.inf if config.most_seconds is None else config.most_seconds,
    )
    history: list[dict[str, float]] = []

    def told(iteration: int, means: dict[str, float]) -> None:
        history.append({"iteration": iteration, **{name: round(mean, 4) for name, mean in means.items()}})
        emit(Progress("pretrain-hidden-depth", iteration, config.iterations))

    half = has_fast_half_precision()
    network = train_completion(
        bank, settings, copy.deepcopy(start).train(), told=told, half=half, loss=hidden_depth_loss
    ).eval()
    record = {
        "training": json.loads(config.model_dump_json()),
        "scenes": len(files),
        "examples": len(bank),
        "half_precision": half,
        "threads": torch.get_num_threads(),
        "history": history[:: max(1, len(history) // 100)],
        "validation_scores": hidden_depth_scores({"before": start, "trained": network}, validation),
    }
    return network, record


def hidden_depth_scores(
    networks: dict[str, CompletionNetwork], files: Sequence[Path]
) -> dict[str, dict[str, float]]:
    """Errors of log-depth in holes of views: continued smoothly, and read by networks.

    Args:
        networks: by name.
        files: of `HiddenDepthExamples` that none was trained on.

    Returns:
        For each of them means over the views that have a hole: absolute error, and error with its sign.
    """
    found: dict[str, dict[str, list[float]]] = {}
    for file in files:
        views = HiddenDepthExamples.load(file)
        rgb, opacity = views.rgb.float(), views.opacity.float()
        hidden = (opacity < HOLE_ALPHA) & (views.depth_mm > 0)
        for name in ("smooth", *networks):
            depth_mm = views.filled_mm
            if name != "smooth":
                clips = [torch.nonzero(views.clip == number)[:, 0] for number in torch.unique(views.clip)]
                parts = (
                    read_depth(networks[name], rgb[clip], depth_mm[clip], opacity[clip], views.K[clip])
                    for clip in clips
                )
                depth_mm = torch.cat(list(parts))
            off = (depth_mm.clamp_min(1e-9) / views.depth_mm.clamp_min(1e-9)).log()
            figures = found.setdefault(name, {"error": [], "bias": []})
            for view in range(len(off)):
                if bool(hidden[view].any()):
                    figures["error"].append(float(off[view][hidden[view]].abs().mean()))
                    figures["bias"].append(float(off[view][hidden[view]].mean()))
    return {
        name: {figure: round(sum(values) / len(values), 4) for figure, values in figures.items() if values}
        for name, figures in found.items()
    }
