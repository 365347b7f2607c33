"""`pretrain --hidden-depth`: weights of the network that reads the depth of what a view has invented."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from extrags.errors import CaptureError, ConfigError, DivergedError, ExtragsError
from flows.commands.common import training_settings, write_json
from flows.commands.pretrain_scenes import make_missing

if TYPE_CHECKING:
    from extrags.depth.completion import CompletionNetwork
    from extrags.restoration.hidden_depth.training import HiddenDepthConfig
    from flows.commands.pretrain_scenes import SceneSource

__all__ = ["Beginning", "beginning", "hidden_depth_settings", "make_examples", "make_views", "trained_reader"]

FOLDER = "hidden_depth"
"""Where the examples are kept, beside the scenes of the other trainings."""


def hidden_depth_settings(given: argparse.Namespace) -> HiddenDepthConfig:
    """Settings of the training.

    Raises:
        ConfigError: for an option that this training does not have, an unknown setting, or a wrong value.
    """
    from extrags.restoration.hidden_depth.training import HiddenDepthConfig

    others = (
        *("generative", "deterministic", "refiner", "explored", "exact_share"),
        *("without_perceptual", "perceptual_weight"),
    )
    for name in others:
        if getattr(given, name) not in (None, False):
            raise ConfigError(
                f"--{name.replace('_', '-')}: this is not for --hidden-depth, which trains a reader of depth"
            )
    names = ("scenes", "validation_scenes", "iterations", "batch", "learning_rate", "error_weight", "seed")
    return training_settings(given, HiddenDepthConfig, names, "extrags pretrain --hidden-depth")


@dataclass(frozen=True)
class Beginning:
    """What the training begins with.

    Args:
        restorer: of the views that depth is read from: a folder with weights, or a set of the package's.
        restorer_digest: of its weights.
        network: completes stereo.
        network_digest: of its weights.
    """

    restorer: str
    restorer_digest: str
    network: CompletionNetwork
    network_digest: str


def beginning(restorer: str, completion: str) -> Beginning:
    """Find both weights.

    Args:
        restorer: a folder with weights, or a set of the package's.
        completion: a file with weights of the depth completion, or `bundled`.

    Raises:
        ConfigError: where there is no such restorer, or no such completion.
    """
    from extrags.depth.weights import completion_digest, load_completion
    from extrags.restoration.diffusion.weights import starting_weights, weights_digest

    try:
        starting_weights(restorer)
        digest = str(weights_digest(restorer))
    except ExtragsError as error:
        raise ConfigError(f"--start {restorer}: {error}") from error
    try:
        network, network_digest = load_completion(completion), completion_digest(completion)
    except ExtragsError as error:
        raise ConfigError(f"--set completion={completion}: {error}") from error
    if network is None or network_digest is None:
        raise ConfigError(f"--set completion={completion}: the training begins with a depth completion")
    return Beginning(restorer, digest, network, network_digest)


def make_examples(folder: Path, sources: Sequence[SceneSource], begun: Beginning, workers: int) -> list[Path]:
    """Restored virtual views of pretraining scenes as files, made and kept as `make_scenes` does scenes.

    Args:
        folder: of the pretraining scenes.
        sources: which scenes.
        begun: names the restorer.
        workers: processes at once.

    Returns:
        Files of the scenes that could be explored; a warning names each of the others.
    """
    by_file = {folder / FOLDER / source.file_name: source for source in sources}
    origins = {file: origin_of(source, begun.restorer_digest) for file, source in by_file.items()}
    return make_missing(
        origins,
        lambda file: partial(make_views, by_file[file], file, begun.restorer, origins[file]),
        workers,
        "pretraining-views",
    )


def origin_of(source: SceneSource, digest: str) -> str:
    """What the examples of a scene depend on, as text.

    Args:
        source: of the scene.
        digest: of the restorer's weights.
    """
    from extrags.config import profile_config
    from extrags.restoration.hidden_depth.examples import EXAMPLES_VERSION

    quick = profile_config("quick")
    stages = {
        name: getattr(quick, name).model_dump(mode="json") for name in ("surface", "freespace", "explore")
    }
    parts = {"version": EXAMPLES_VERSION, "restorer": digest, "scene": source.origin, **stages}
    return json.dumps(parts, sort_keys=True)


def make_views(source: SceneSource, file: Path, restorer: str, origin: str) -> str | None:
    """The examples of one scene.

    Args:
        source: of the scene.
        file: where they go.
        restorer: a folder with weights, or a set of the package's.
        origin: what they are made from.

    Returns:
        Why there are none, where it cannot be reconstructed, or there is nothing to explore; else None.
    """
    from extrags.config import profile_config
    from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
    from extrags.restoration.diffusion.weights import starting_weights
    from extrags.restoration.hidden_depth.examples import HiddenDepthExamples

    enhancer = EmbeddedEnhancer.load(starting_weights(restorer)).without_scene()
    try:
        recording = source.recording(to_restore=False)
        made = HiddenDepthExamples.of_recording(recording, enhancer, profile_config("quick"), source.seed)
    except (CaptureError, DivergedError) as error:
        return str(error)
    made.save(file, origin=origin)
    return None


def trained_reader(
    files: Sequence[Path], config: HiddenDepthConfig, begun: Beginning, out: Path, about: dict[str, Any]
) -> dict[str, Any]:
    """Train on examples, and write weights and record.

    Args:
        files: of the examples.
        config: budget.
        begun: what it begins with.
        out: folder.
        about: command and machine, for the record.

    Returns:
        The record.

    Raises:
        StoreError: when the record cannot be written.
        ExtragsError: as `train_hidden_depth`.
    """
    from extrags.array_files import save_safetensors
    from extrags.depth.weights import HIDDEN
    from extrags.restoration.hidden_depth.training import train_hidden_depth

    network, record = train_hidden_depth(files, config, begun.network)
    record |= {"restorer": begun.restorer_digest, "completion": begun.network_digest, **about}
    weights = {name: value.half() for name, value in network.state_dict().items()}
    save_safetensors(out / f"{HIDDEN}.safetensors", weights)
    write_json(record, str(out / f"{HIDDEN}.json"))
    return record
