"""Scenes to pretrain on: which are meant, and how they are made."""

from __future__ import annotations

import argparse
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from extrags import __version__
from extrags.errors import CaptureError, DivergedError
from extrags.output_files import write_file
from extrags.source_commit import source_commit

if TYPE_CHECKING:
    from data_catalog.cavities.pretraining import CavityConfig
    from data_catalog.phantom.config import PhantomConfig
    from extrags.restoration.training_data.recordings import PretrainingRecording

__all__ = [
    "SOURCES",
    "SceneSource",
    "in_processes",
    "make_missing",
    "make_scene",
    "make_scenes",
    "scene_sources",
]

Result = TypeVar("Result")

logger = logging.getLogger(__name__)

SOURCES = ("phantom", "cavities")
"""Families of pretraining scenes."""


@dataclass(frozen=True)
class SceneSource:
    """Which pretraining scene is meant.

    Args:
        family: one of `SOURCES`.
        index: its number within the family, from 0.
        size_factor: how many times wider and higher pictures of cavities are.
        real_textures: whether some cavities wear tissue of real frames.
        explored: whether the virtual views of the explorer's trajectories are among those to restore.
        exact_share: how often the reconstruction is given exact poses and depth, beyond chance.
    """

    family: str
    index: int
    size_factor: int = 1
    real_textures: bool = False
    explored: bool = False
    exact_share: float = 0.0

    @property
    def file_name(self) -> str:
        """Of its file."""
        return f"{self.family}_{self.index:05d}.safetensors"

    @property
    def config(self) -> PhantomConfig | CavityConfig:
        """What the scene is like."""
        if self.family == "phantom":
            from data_catalog.phantom.pretraining import pretraining_scene_config

            return pretraining_scene_config(self.index)
        from data_catalog.cavities.pretraining import cavity_config

        return cavity_config(self.index, size_factor=self.size_factor, real_textures=self.real_textures)

    @property
    def origin(self) -> str:
        """What the scene depends on, as text: a scene made otherwise is made again."""
        from data_catalog.cavities.pretraining import GENERATOR_VERSION as CAVITY_VERSION
        from data_catalog.phantom.config import GENERATOR_VERSION as PHANTOM_VERSION
        from extrags.config import profile_config
        from extrags.restoration.training_data.pretraining_scenes import PRETRAINING_DATA_VERSION

        quick = profile_config("quick")
        parts = {
            "family": self.family,
            "generator": PHANTOM_VERSION if self.family == "phantom" else CAVITY_VERSION,
            "data": PRETRAINING_DATA_VERSION,
            "scene": self.config.model_dump(mode="json"),
            "coarse": quick.coarse.model_dump(mode="json"),
            "references": quick.enhance.references,
        }
        if self.explored:
            stages = {name: getattr(quick, name) for name in ("surface", "freespace", "explore")}
            parts |= {name: stage.model_dump(mode="json") for name, stage in stages.items()}
        if self.exact_share:
            parts["exact_share"] = self.exact_share
        return json.dumps(parts, sort_keys=True)

    @property
    def seed(self) -> int:
        """Of the degradation and the reconstruction: families do not share their draws."""
        return self.index + 1_000_000 * SOURCES.index(self.family)

    def recording(self, *, to_restore: bool = True) -> PretrainingRecording:
        """Photograph the scene.

        Args:
            to_restore: whether there are views to restore besides the training frames.
        """
        if self.family == "phantom":
            from data_catalog.phantom.pretraining import pretraining_recording

            return pretraining_recording(self.index, to_restore=to_restore)
        from data_catalog.cavities.pretraining import CavityConfig, cavity_recording

        config = self.config
        assert isinstance(config, CavityConfig)
        return cavity_recording(config, to_restore=to_restore)


def scene_sources(given: argparse.Namespace, count: int) -> list[SceneSource]:
    """Scenes of the families asked for, which take turns, from a number on."""
    made = dict.fromkeys(SOURCES, given.first_scene)
    sources = []
    for number in range(count):
        family = given.kinds[number % len(given.kinds)]
        sources.append(
            SceneSource(
                family,
                made[family],
                given.size_factor,
                given.real_textures,
                given.explored,
                given.exact_share,
            )
        )
        made[family] += 1
    return sources


def make_scenes(folder: Path, sources: Sequence[SceneSource], workers: int) -> list[Path]:
    """Pretraining scenes as files; those that are there and made in the same way stay.

    Why a scene cannot be made is kept beside it, and it is not tried again while it would be made in the same
    way by the same version.

    Args:
        folder: where they are kept.
        sources: which scenes.
        workers: processes at once.

    Returns:
        Files of the scenes that could be made; a warning names each of the others.
    """
    by_file = {folder / source.file_name: source for source in sources}
    return make_missing(
        {file: source.origin for file, source in by_file.items()},
        lambda file: partial(make_scene, by_file[file], file),
        workers,
        "pretraining-scenes",
    )


def make_missing(
    origins: Mapping[Path, str],
    job_of: Callable[[Path], Callable[[], str | None]],
    workers: int,
    told_as: str,
) -> list[Path]:
    """Files of scenes, or of examples from them, as `make_scenes` makes and keeps them.

    Args:
        origins: what each file is to be made from.
        job_of: what makes a file, and gives the reason where it cannot; can be pickled.
        workers: processes at once.
        told_as: named in progress events.

    Returns:
        Files that could be made; a warning names each of the others.
    """
    from extrags.restoration.training_data.pretraining_scenes import PretrainingScene

    missing, failed = [], {}
    for file, origin in origins.items():
        if PretrainingScene.made_from(file) == origin:
            continue
        reason = _recorded_failure(file, origin)
        if reason is None:
            missing.append(file)
        else:
            kept = _failure_file(file)
            failed[file] = f"{reason} (an earlier attempt of this version, {kept}; remove it to try again)"
    jobs = [job_of(file) for file in missing]
    reasons = in_processes(jobs, workers, told_as, done=len(origins) - len(missing))
    for file, new in zip(missing, reasons, strict=True):
        if new is None:
            _failure_file(file).unlink(missing_ok=True)
        else:
            failed[file] = new
            file.parent.mkdir(parents=True, exist_ok=True)
            record = {**_attempt(origins[file]), "reason": new}
            write_file(_failure_file(file), json.dumps(record, indent=1) + "\n")
    for file, reason in failed.items():
        # Told here: what a process of its own logs goes past the progress bar.
        logger.warning("%s: left out, %s", file.stem, reason)
    return [file for file in origins if file not in failed]


def _failure_file(file: Path) -> Path:
    return file.with_suffix(".failed.json")


def _attempt(origin: str) -> dict[str, str]:
    """What decides whether a file can be made; the version stands for the code of its reconstruction."""
    return {"extrags": f"{__version__} {source_commit() or ''}".strip(), "origin": origin}


def _recorded_failure(file: Path, origin: str) -> str | None:
    """Why an earlier attempt at the same file failed; None where there was none, or it was another."""
    try:
        record = json.loads(_failure_file(file).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    same = isinstance(record, dict) and all(record.get(key) == told for key, told in _attempt(origin).items())
    return str(record["reason"]) if same and "reason" in record else None


def make_scene(source: SceneSource, file: Path) -> str | None:
    """One pretraining scene.

    Args:
        source: of the scene.
        file: where it goes.

    Returns:
        Why there is none, where it cannot be recorded or reconstructed; else None.
    """
    from extrags.config import profile_config
    from extrags.restoration.training_data.pretraining_scenes import make_pretraining_scene

    quick = profile_config("quick")
    try:
        scene = make_pretraining_scene(
            source.recording(),
            quick,
            source.seed,
            explored=source.explored,
            exact_share=source.exact_share,
        )
    except (CaptureError, DivergedError) as error:
        return str(error)
    scene.save(file, origin=source.origin)
    return None


def in_processes(
    jobs: Sequence[Callable[[], Result]], workers: int, told_as: str, *, done: int = 0
) -> list[Result]:
    """Run jobs on one thread each, and tell the progress.

    Args:
        jobs: can be pickled.
        workers: processes at once.
        told_as: named in progress events.
        done: how many more there were, which are done already.

    Returns:
        What each job gave, in their order.
    """
    import multiprocessing

    from extrags.events import Progress, emit

    count = done + len(jobs)
    emit(Progress(told_as, done, count))
    # In processes of their own: they set their numbers of threads, and a fork would take over OpenMP's.
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        running = [pool.submit(_on_one_thread, job) for job in jobs]
        try:
            for future in as_completed(running):
                future.result()
                done += 1
                emit(Progress(told_as, done, count))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return [future.result() for future in running]


def _on_one_thread(job: Callable[[], Result]) -> Result:
    """The same bits on every machine with the same instructions."""
    import cv2
    import torch

    from extrags.raster import set_num_threads

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    set_num_threads(1)
    return job()
