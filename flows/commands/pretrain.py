"""`pretrain`: the weights that come with the package, made from nothing."""

from __future__ import annotations

import argparse
import json
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from extrags.errors import ConfigError
from flows.commands.common import set_up_logging
from flows.commands.options import Parser

if TYPE_CHECKING:
    from extrags.restoration.diffusion.pretraining import PretrainingConfig

__all__ = ["add_arguments", "pretrain"]


def add_arguments(parser: Parser) -> None:
    """The options of `extrags pretrain`."""
    parser.description = (
        "Make pretraining scenes (colons that are never evaluated), reconstruct them, and train the restorer "
        "on views far off their paths. This is how the weights of the package were made; hours on two cores. "
        "Pretraining scenes that are in the folder already are taken from there."
    )
    parser.set_defaults(command=pretrain)
    parser.add_argument("--out", required=True, metavar="FOLDER", help="where the weights go")
    parser.add_argument(
        "--scenes-folder",
        default=".extrags/pretraining",
        metavar="FOLDER",
        help="where pretraining scenes are kept, 40 MB each (default: %(default)s)",
    )
    parser.add_argument("--scenes", type=int, metavar="N", help="pretraining scenes (default: 86)")
    parser.add_argument(
        "--validation-scenes", type=int, metavar="N", help="how many of them validate only (default: 6)"
    )
    parser.add_argument("--iterations", type=int, metavar="N", help="optimisation steps (default: 13500)")
    parser.add_argument("--batch", type=int, metavar="N", help="crops per step (default: 4)")
    parser.add_argument("--start", metavar="FOLDER", help="go on from these weights instead of from nothing")
    parser.add_argument("--learning-rate", type=float, metavar="X", help="the peak (default: 8e-4)")
    parser.add_argument(
        "--perceptual-weight", type=float, metavar="X", help="of the perceptual distance (default: 0.15)"
    )
    parser.add_argument(
        "--error-weight", type=float, metavar="X", help="of the expected error's likelihood (default: 0.02)"
    )
    parser.add_argument("--seed", type=int, metavar="N", help="of the training (default: 0)")
    parser.add_argument("--threads", type=int, metavar="N", help="threads of the training (default: all)")
    parser.add_argument(
        "--workers", type=int, default=1, metavar="N", help="scenes made at once (default: %(default)s)"
    )
    parser.add_argument(
        "--without-perceptual",
        action="store_true",
        help="train without the perceptual distance, whose weights (LPIPS, SqueezeNet) must be had",
    )
    parser.add_argument(
        "--deterministic", action="store_true", help="a plain regression: the baseline of the diffusion"
    )


def pretrain(given: argparse.Namespace) -> int:
    """`extrags pretrain`."""
    terminal = sys.stderr.isatty()
    set_up_logging(debug=given.debug, terminal=terminal)
    # Before torch is imported: threads that spin while they wait slow each other down.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    import torch

    from extrags.raster.bench import machine
    from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
    from extrags.restoration.diffusion.pretraining import PretrainingConfig
    from extrags.restoration.diffusion.pretraining import pretrain as trained
    from flows.console import progress_bars
    from flows.terminal import console

    values = {
        "scenes": given.scenes,
        "validation_scenes": given.validation_scenes,
        "iterations": given.iterations,
        "batch": given.batch,
        "learning_rate": given.learning_rate,
        "perceptual": not given.without_perceptual,
        "perceptual_weight": given.perceptual_weight,
        "error_weight": given.error_weight,
        "deterministic": given.deterministic,
        "seed": given.seed,
    }
    known = {name: value for name, value in values.items() if value is not None}
    try:
        config = PretrainingConfig(**known)
    except ValueError as error:
        raise ConfigError(f"extrags pretrain: {error}") from error
    start = None if given.start is None else EmbeddedEnhancer.load(Path(given.start))
    checked(given, config)
    # As things are now: in some hours the working tree may be another.
    about: dict[str, Any] = {"command": _command(given), "machine": machine()}
    with progress_bars(terminal=terminal):
        files = make_scenes(Path(given.scenes_folder), config.scenes, given.workers)
        if given.threads is not None:
            torch.set_num_threads(given.threads)
        enhancer = trained(files, config, start)
        replace(enhancer, record={**enhancer.record, **about}).save(Path(given.out), half=True)
    out = console()
    for method, scores in enhancer.record["validation_scores"].items():
        out.print(f"{method:12} " + "  ".join(f"{name} {value}" for name, value in scores.items()))
    out.print(f"written to {given.out}")
    return 0


def checked(given: argparse.Namespace, config: PretrainingConfig) -> None:
    """Look at everything that would otherwise fail after hours.

    Raises:
        ConfigError: for settings that do not fit each other, or a folder that cannot be written.
        WeightsError: when the perceptual distance has no weights.
    """
    from extrags.metrics.lpips_weights import find_weights

    if config.validation_scenes >= config.scenes:
        raise ConfigError(
            f"{config.validation_scenes} of {config.scenes} scenes are for validation; none is left to train"
        )
    for name in ("workers", "threads"):
        value = getattr(given, name)
        if value is not None and value < 1:
            raise ConfigError(f"--{name} {value}: expected 1 or more")
    if config.perceptual:
        find_weights(None, "squeeze")
    for folder in (given.out, given.scenes_folder):
        try:
            Path(folder).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{folder} cannot be written: {error.strerror or error}") from error


def make_scenes(folder: Path, count: int, workers: int) -> list[Path]:
    """Pretraining scenes 0 to count - 1 as files; those that are there and made in the same way stay.

    Args:
        folder: where they are kept.
        count: how many.
        workers: processes at once.
    """
    from extrags.events import Progress, emit
    from extrags.restoration.training_data.pretraining_scenes import PretrainingScene

    files = [folder / f"{index:04d}.safetensors" for index in range(count)]
    missing = [index for index, file in enumerate(files) if PretrainingScene.made_from(file) != origin(index)]
    done = count - len(missing)
    emit(Progress("pretraining-scenes", done, count))
    import multiprocessing

    # In processes of their own: they set their numbers of threads, and a fork would take over OpenMP's.
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        running = [pool.submit(make_scene, index, files[index]) for index in missing]
        try:
            for future in running:
                future.result()
                done += 1
                emit(Progress("pretraining-scenes", done, count))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return files


def origin(index: int) -> str:
    """What a pretraining scene depends on, as text: a scene made otherwise is made again."""
    from data_catalog.phantom.config import GENERATOR_VERSION
    from data_catalog.phantom.pretraining import pretraining_scene_config
    from extrags.config import profile_config
    from extrags.restoration.training_data.pretraining_scenes import PRETRAINING_DATA_VERSION

    quick = profile_config("quick")
    parts = {
        "generator": GENERATOR_VERSION,
        "data": PRETRAINING_DATA_VERSION,
        "phantom": pretraining_scene_config(index).model_dump(mode="json"),
        "coarse": quick.coarse.model_dump(mode="json"),
        "references": quick.enhance.references,
    }
    return json.dumps(parts, sort_keys=True)


def make_scene(index: int, file: Path) -> None:
    """One pretraining scene, on one thread: the same bits on every machine with the same instructions."""
    import torch

    from data_catalog.phantom.pretraining import pretraining_sequence
    from extrags.config import profile_config
    from extrags.raster import set_num_threads
    from extrags.restoration.training_data.pretraining_scenes import make_pretraining_scene

    torch.set_num_threads(1)
    set_num_threads(1)
    quick = profile_config("quick")
    scene = make_pretraining_scene(pretraining_sequence(index), quick.enhance, quick.coarse, index)
    scene.save(file, origin=origin(index))


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
    parts += [
        f"--{name.replace('_', '-')}"
        for name in ("without_perceptual", "deterministic")
        if getattr(given, name)
    ]
    return " ".join(parts)
