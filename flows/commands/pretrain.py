"""`pretrain`: the weights that come with the package, made from nothing."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from extrags.errors import CaptureError, ConfigError, reason_of
from flows.commands.common import is_terminal, set_up_logging, showing, training_settings
from flows.commands.options import Parser, add_output
from flows.commands.outputs import output_folder
from flows.commands.pretrain_folder import CHECKPOINT, check_weights_there, sole_training
from flows.commands.pretrain_scenes import SOURCES, make_scenes, scene_sources
from flows.interruption import say_when_interrupted

if TYPE_CHECKING:
    from extrags.restoration.diffusion.pretraining import PretrainingConfig

__all__ = ["add_arguments", "pretrain"]


OF_DRAWING = (
    *("drawn_share", "drawn_perceptual_weight", "adversarial_weight", "adversary_rate"),
    *("patches", "patch_px"),
)
"""Settings that nothing reads unless drawing is trained."""
INTERRUPTED = (
    "pretraining was interrupted; finished scenes, and the last checkpoint of a restorer, are kept, and the "
    "same command goes on from them"
)


def add_arguments(parser: Parser) -> None:
    """The options of `extrags pretrain`."""
    parser.description = (
        "Make pretraining scenes (procedural cavities that are never evaluated), reconstruct them, and train "
        "the restorer on views far off their paths. This is how the weights of the package were made; hours "
        "on two cores. Pretraining scenes that are in the folder already are taken from there."
    )
    parser.set_defaults(command=pretrain)
    add_output(
        parser, "FOLDER", output_folder, help="where the weights go; needed unless only scenes are made"
    )
    _add_scenes(parser)
    _add_training(parser)
    _add_networks(parser)
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="any setting of the training, such as most_seconds=1200, or of a restorer's device=cuda, "
        "drawing_processes=14 or drawn_share=0.8; repeatable. A wrong name lists all of them. A restorer's "
        "training that was ended goes on from the checkpoint in its folder",
    )


def _add_scenes(parser: Parser) -> None:
    """Where scenes come from, and how they are made."""
    parser.add_argument(
        "--scenes-folder",
        type=output_folder,
        default=".extrags/pretraining",
        metavar="FOLDER",
        help="where pretraining scenes are kept, 30 to 150 MB each (default: %(default)s)",
    )
    parser.add_argument(
        "--kinds",
        nargs="+",
        choices=SOURCES,
        default=list(SOURCES),
        metavar="KIND",
        help="families of scenes, which take turns: phantom (colons), cavities (colon, stomach, oesophagus, "
        "airways, sinus, joint, bladder, laparoscopic field); named twice, a family is twice as frequent "
        "(default: phantom cavities)",
    )
    parser.add_argument(
        "--first-scene",
        type=int,
        default=0,
        metavar="N",
        help="number of the first scene of each family: a training that starts from weights, or refines what "
        "they give, takes scenes that they have not seen (default: %(default)s)",
    )
    parser.add_argument(
        "--size-factor",
        type=int,
        default=1,
        metavar="N",
        help="pictures of cavities are so many times wider and higher (default: %(default)s)",
    )
    parser.add_argument(
        "--real-textures",
        action="store_true",
        help="a third of the cavities wear tissue of real laparoscopy frames, which must be on this machine",
    )
    parser.add_argument(
        "--explored",
        action="store_true",
        help="the virtual views of trajectories that the explorer chooses are practised on as well, besides "
        "the clips off the path (those of --hidden-depth always are, and alone)",
    )
    parser.add_argument(
        "--exact-share",
        type=float,
        default=0.0,
        metavar="X",
        help="how often, beyond chance, a reconstruction is given exact poses and depth and a light model "
        "(from 0 to 1; default: %(default)s)",
    )
    parser.add_argument("--scenes-only", action="store_true", help="make the scenes, and train nothing")


def _add_training(parser: Parser) -> None:
    """How much is trained, from what, and with which weights of the loss."""
    parser.add_argument(
        "--scenes",
        type=int,
        metavar="N",
        help="pretraining scenes (default: 86; of a refiner 90, of hidden depth 80)",
    )
    parser.add_argument(
        "--validation-scenes", type=int, metavar="N", help="how many of them validate only (default: 6; 8; 8)"
    )
    parser.add_argument(
        "--iterations", type=int, metavar="N", help="optimisation steps (default: 13500; 10000; 4000)"
    )
    parser.add_argument("--batch", type=int, metavar="N", help="crops per step (default: 4; 4; 8 views)")
    parser.add_argument(
        "--start",
        metavar="FOLDER",
        help="go on from these weights instead of from nothing: a folder, or a set of the package's (colons, "
        "cavities)",
    )
    parser.add_argument(
        "--learning-rate", type=float, metavar="X", help="the peak (default: 8e-4; 5e-4; 6e-4)"
    )
    parser.add_argument(
        "--perceptual-weight", type=float, metavar="X", help="of the perceptual distance (default: 0.15; 4)"
    )
    parser.add_argument(
        "--error-weight",
        type=float,
        metavar="X",
        help="of the expected error's likelihood (default: 0.02; of hidden depth 0.1)",
    )
    parser.add_argument("--seed", type=int, metavar="N", help="of the training (default: 0)")
    parser.add_argument("--threads", type=int, metavar="N", help="threads of the training (default: all)")
    parser.add_argument(
        "--workers", type=int, default=1, metavar="N", help="scenes made at once (default: %(default)s)"
    )


def _add_networks(parser: Parser) -> None:
    """What is trained: a restorer and by which loss, or another network."""
    parser.add_argument(
        "--without-perceptual",
        action="store_true",
        help="train without the perceptual distance, which needs weights (LPIPS, SqueezeNet)",
    )
    parser.add_argument(
        "--deterministic", action="store_true", help="a plain regression: the baseline of the diffusion"
    )
    parser.add_argument(
        "--generative",
        action="store_true",
        help="train drawing as well: plausible views with texture, not their mean alone",
    )
    parser.add_argument(
        "--refiner",
        action="store_true",
        help="train the refiner of restored views instead of a restorer; --start names the restorer whose "
        "views it refines (default: colons). It keeps no checkpoint",
    )
    parser.add_argument(
        "--hidden-depth",
        action="store_true",
        help="train the network that reads the depth of what a restored view has invented; the scenes are "
        "explored, and --start names the restorer of their virtual views (default: colons). It keeps no "
        "checkpoint",
    )


def pretrain(given: argparse.Namespace) -> int:
    """`extrags pretrain`."""
    say_when_interrupted(INTERRUPTED)
    terminal = is_terminal()
    set_up_logging(debug=given.debug, terminal=terminal, quiet=given.quiet)
    # Before torch is imported: threads that spin while they wait slow each other down.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    import torch

    from extrags.raster.bench import machine
    from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
    from extrags.restoration.diffusion.pretraining import PretrainingConfig, check_settings, check_sizes
    from extrags.restoration.diffusion.pretraining import pretrain as trained
    from extrags.restoration.diffusion.weights import COLONS, starting_weights
    from extrags.restoration.hidden_depth.training import HiddenDepthConfig
    from extrags.restoration.refinement.training import RefinerConfig
    from flows.commands.pretrain_hidden_depth import (
        FOLDER,
        beginning,
        hidden_depth_settings,
        make_examples,
        trained_reader,
    )
    from flows.commands.pretrain_refiner import refiner_settings, start_of_refiner, trained_refiner
    from flows.progress_display import progress_display
    from flows.terminal import console
    from tasks.progress import reporting

    config: HiddenDepthConfig | RefinerConfig | PretrainingConfig
    if given.hidden_depth:
        config = hidden_depth_settings(given)
    else:
        config = refiner_settings(given) if given.refiner else _settings(given)
    perceptual = isinstance(config, RefinerConfig) or (
        isinstance(config, PretrainingConfig) and config.perceptual
    )
    checked(given, config.scenes, config.validation_scenes, perceptual=perceptual)
    start = None
    sources = scene_sources(given, config.scenes)
    if isinstance(config, HiddenDepthConfig):
        begun = beginning(given.start or COLONS, config.completion)
    elif isinstance(config, RefinerConfig):
        restorer = start_of_refiner(given.start or COLONS)
    else:
        if given.start is not None:
            start = EmbeddedEnhancer.load(starting_weights(given.start)).without_scene()
        if not given.scenes_only:
            check_settings(config, start)
            # Those that validate may be of any size.
            trained_on = (source.config for source in sources[: -config.validation_scenes])
            check_sizes(config, [(scene.height, scene.width) for scene in trained_on])
    # As things are now: in some hours the working tree may be another.
    about: dict[str, Any] = {"command": _command(given), "machine": machine()}
    with _alone(given), progress_display(showing(given)), reporting("restorer", "pretrain"):
        folder = Path(given.scenes_folder)
        if isinstance(config, HiddenDepthConfig):
            files = make_examples(folder, sources, begun, given.workers)
            folder = folder / FOLDER
        else:
            files = make_scenes(folder, sources, given.workers)
            check_enough(len(files), config.scenes, 0 if given.scenes_only else config.validation_scenes)
        if given.scenes_only:
            console().print(f"{len(files)} scenes in {folder}", markup=False)
            return 0
        if given.threads is not None:
            torch.set_num_threads(given.threads)
        if isinstance(config, HiddenDepthConfig):
            return _told(trained_reader(files, config, begun, Path(given.output), about), given.output)
        if isinstance(config, RefinerConfig):
            refiner = trained_refiner(files, config, restorer, about)
            refiner.save(Path(given.output))
            return _told(refiner.record, given.output)
        checkpoint = Path(given.output) / CHECKPOINT
        config = for_scenes(config, len(files))
        enhancer = trained(files, config, start, checkpoint=checkpoint, about=about)
        enhancer.save(Path(given.output), half=True)
        if enhancer.record["iterations_made"] >= config.iterations:
            checkpoint.unlink()
    return _told(enhancer.record, given.output)


def _settings(given: argparse.Namespace) -> PretrainingConfig:
    """Settings of a restorer's training.

    Raises:
        ConfigError: for an unknown setting, a value out of its range, or one that would have no effect.
    """
    from extrags.restoration.diffusion.pretraining import PretrainingConfig

    names = ("scenes", "validation_scenes", "iterations", "batch", "learning_rate", "perceptual_weight")
    further = ("error_weight", "deterministic", "generative", "seed", "perceptual")
    given = argparse.Namespace(**vars(given), perceptual=not given.without_perceptual)
    config = training_settings(given, PretrainingConfig, (*names, *further), "extrags pretrain")
    unread = () if config.generative else OF_DRAWING
    for name in sorted(config.model_fields_set.intersection(unread)):
        raise ConfigError(f"setting {name}: nothing draws without --generative; leave it out")
    if "perceptual_weight" in config.model_fields_set and not config.perceptual:
        raise ConfigError("setting perceptual_weight: there is no such distance with --without-perceptual")
    return config


def check_enough(made: int, wanted: int, validation_scenes: int) -> None:
    """Refuse to go on where too few scenes could be made.

    Args:
        made: scenes that there are.
        wanted: scenes asked for.
        validation_scenes: how many of them validate only.

    Raises:
        CaptureError: when no scene is left beside those.
    """
    if made <= validation_scenes:
        validate = f", and {validation_scenes} are for validation" if validation_scenes else ""
        raise CaptureError(
            f"{made} of {wanted} scenes could be made{validate}; none is left. More --scenes, or others "
            "(--first-scene), may give some"
        )


def for_scenes(config: PretrainingConfig, made: int) -> PretrainingConfig:
    """The settings for those scenes that could be made, with one drawing process for each at most."""
    most = made - config.validation_scenes
    return config.model_copy(
        update={"scenes": made, "drawing_processes": min(config.drawing_processes, most)}
    )


@contextmanager
def _alone(given: argparse.Namespace) -> Iterator[None]:
    """No other training writes where this one does."""
    if given.scenes_only:
        yield
        return
    with sole_training(Path(given.output)):
        # Another may have ended since they were looked at.
        _check_weights_there(given)
        yield


def _check_weights_there(given: argparse.Namespace) -> None:
    if given.output is not None and not (given.scenes_only or given.hidden_depth):
        check_weights_there(Path(given.output), "refiner" if given.refiner else "embedded")


def _told(record: dict[str, Any], folder: str) -> int:
    from flows.terminal import console

    out = console()
    for method, scores in record["validation_scores"].items():
        out.print(f"{method:12} " + "  ".join(f"{name} {value}" for name, value in scores.items()))
    out.print(f"written to {folder}", markup=False)
    return 0


def checked(given: argparse.Namespace, scenes: int, validation_scenes: int, *, perceptual: bool) -> None:
    """Look at everything that would otherwise fail after hours.

    Args:
        given: the command line.
        scenes: pretraining scenes in all.
        validation_scenes: how many of them validate only.
        perceptual: whether the perceptual distance is needed.

    Raises:
        ConfigError: for settings that do not fit each other, a folder that cannot be written, or one whose
            weights would be lost.
        WeightsError: when the perceptual distance has no weights.
        SourceNotFoundError: when real textures are asked for and not on this machine.
    """
    from extrags.metrics.lpips_weights import find_weights

    if validation_scenes >= scenes and not given.scenes_only:
        raise ConfigError(f"{validation_scenes} of {scenes} scenes are for validation; none is left to train")
    if "cavities" not in given.kinds and (given.real_textures or given.size_factor != 1):
        raise ConfigError("--real-textures and --size-factor are for cavities, and --kinds names none")
    for name, least in (("workers", 1), ("threads", 1), ("size_factor", 1), ("first_scene", 0)):
        value = getattr(given, name)
        if value is not None and value < least:
            raise ConfigError(f"--{name.replace('_', '-')} {value}: expected {least} or more")
    if not 0 <= given.exact_share <= 1:
        raise ConfigError(f"--exact-share {given.exact_share}: expected a number from 0 to 1")
    if given.output is None and not given.scenes_only:
        raise ConfigError("--output: where do the weights go? (--scenes-only makes scenes alone)")
    _check_weights_there(given)
    if given.real_textures:
        from data_catalog.cavities.real_textures import texture_files

        texture_files()
    if perceptual and not given.scenes_only:
        find_weights(None, "squeeze")
    for folder in (given.output, given.scenes_folder):
        if folder is None:
            continue
        try:
            Path(folder).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{folder} cannot be written: {reason_of(error)}") from error


def _command(given: argparse.Namespace) -> str:
    parts = ["extrags pretrain"]
    for name in (
        *(
            "start",
            "scenes",
            "validation_scenes",
            "iterations",
            "batch",
            "learning_rate",
            "perceptual_weight",
        ),
        *("error_weight", "threads", "seed"),
    ):
        value = getattr(given, name)
        if value is not None:
            parts.append(f"--{name.replace('_', '-')} {value}")
    parts.append(f"--kinds {' '.join(given.kinds)}")
    if given.first_scene:
        parts.append(f"--first-scene {given.first_scene}")
    if given.size_factor != 1:
        parts.append(f"--size-factor {given.size_factor}")
    if given.exact_share:
        parts.append(f"--exact-share {given.exact_share}")
    parts += [
        f"--{name.replace('_', '-')}"
        for name in (
            "real_textures",
            "explored",
            "without_perceptual",
            "deterministic",
            "generative",
            "refiner",
            "hidden_depth",
        )
        if getattr(given, name)
    ]
    parts += [f"--set {text}" for text in given.set]
    return " ".join(parts)
