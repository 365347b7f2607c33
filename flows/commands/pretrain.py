"""`pretrain`: the weights that come with the package, made from nothing."""

from __future__ import annotations

import argparse
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from extrags.errors import ConfigError
from flows.commands.common import set_up_logging
from flows.terminal import console

__all__ = ["pretrain"]


def pretrain(given: argparse.Namespace) -> int:
    """`extrags pretrain`."""
    terminal = sys.stderr.isatty()
    set_up_logging(debug=given.debug, terminal=terminal)
    # Before torch is imported: threads that spin while they wait slow each other down.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    from extrags.enhance.pretraining import PretrainingConfig
    from extrags.enhance.pretraining import pretrain as trained
    from extrags.raster.bench import machine
    from flows.console import watched

    values = {
        "scenes": given.scenes,
        "kept_back": given.kept_back,
        "iterations": given.iterations,
        "batch": given.batch,
        "perceptual": not given.without_perceptual,
        "deterministic": given.deterministic,
        "seed": given.seed,
    }
    known = {name: value for name, value in values.items() if value is not None}
    try:
        config = PretrainingConfig(**known)
    except ValueError as error:
        raise ConfigError(f"extrags pretrain: {error}") from error
    folder = Path(given.scenes_folder)
    with watched(terminal=terminal):
        files = make_scenes(folder, config.scenes, given.workers)
        if given.threads is not None:
            import torch

            torch.set_num_threads(given.threads)
        enhancer = trained(files, config)
        record: dict[str, Any] = {**enhancer.record, "command": _command(given), "machine": machine()}
        from dataclasses import replace

        replace(enhancer, record=record).save(Path(given.out), half=True)
    out = console()
    for method, scores in enhancer.record["kept_back_scores"].items():
        out.print(f"{method:12} " + "  ".join(f"{name} {value}" for name, value in scores.items()))
    out.print(f"written to {given.out}")
    return 0


def make_scenes(folder: Path, count: int, workers: int) -> list[Path]:
    """Practice scenes 0 to count - 1 as files; those that are there already stay.

    Args:
        folder: where they are kept.
        count: how many.
        workers: processes at once.
    """
    from extrags.events import Progress, emit

    files = [folder / f"{index:04d}.safetensors" for index in range(count)]
    missing = [index for index, file in enumerate(files) if not file.is_file()]
    done = count - len(missing)
    emit(Progress("practice-scenes", done, count))
    if workers == 1:
        for index in missing:
            make_scene(index, files[index])
            done += 1
            emit(Progress("practice-scenes", done, count))
        return files
    import multiprocessing

    # Spawned: a fork would take over OpenMP's threads in whatever state they are.
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        running = [pool.submit(make_scene, index, files[index]) for index in missing]
        for future in running:
            future.result()
            done += 1
            emit(Progress("practice-scenes", done, count))
    return files


def make_scene(index: int, file: Path) -> None:
    """One practice scene, on one thread: the same bits on every machine with the same instructions."""
    import torch

    from data_catalog.phantom.practice import practice_sequence
    from extrags.config import profile_config
    from extrags.enhance.practice import practise_scene
    from extrags.raster import set_num_threads

    torch.set_num_threads(1)
    set_num_threads(1)
    profile = profile_config("quick")
    practise_scene(practice_sequence(index), profile.enhance, profile.coarse, index).save(file)


def _command(given: argparse.Namespace) -> str:
    parts = ["extrags pretrain"]
    for name in ("scenes", "kept_back", "iterations", "batch", "threads", "seed"):
        value = getattr(given, name)
        if value is not None:
            parts.append(f"--{name.replace('_', '-')} {value}")
    parts += [
        f"--{name.replace('_', '-')}"
        for name in ("without_perceptual", "deterministic")
        if getattr(given, name)
    ]
    return " ".join(parts)
