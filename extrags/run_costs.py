"""What the stages of a run will cost: seconds of processor time and peak memory, before it starts.

The cost of a task is a sum of terms, each a product of numbers that are known beforehand (iterations, pixels,
frames, Gaussians, views), with non-negative coefficients fitted to recorded runs (non-negative least squares
on relative errors, reweighted towards least absolute ones). The coefficients in `run_costs.json` are those of
one machine; another is slower or faster by a factor, which the history of a store or a short probe gives.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import resources
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from extrags.config import PipelineConfig
from extrags.errors import ConfigError
from extrags.frame_stacks import MAPPED_BYTES
from extrags.stages import cost_of, modelled_tasks, stage_of_task

if TYPE_CHECKING:
    from extrags.raster.bench import BenchSize

__all__ = [
    "FOOTAGE_NUMBERS",
    "MEMORY_TERMS",
    "WORKLOAD_SETTINGS",
    "CostModel",
    "TaskCost",
    "Workload",
    "beyond_the_fit",
    "fitted",
    "packaged_model",
    "probe_seconds",
    "probed_rasteriser",
    "stage_seconds",
    "stage_tasks",
]

MEMORY_TERMS = ("one", "pixels", "held_pixels", "restored", "train*restored", "views*restored", "gaussians")
"""Terms of the memory of each task; of some, of the Gaussians of the final scene."""
EVALUATION_TERMS = ("pixels*stacks", "pixels*vgg")
"""Further terms of the memory of what evaluates."""
HELD_PIXELS = MAPPED_BYTES / 3
"""Of all frames together, at most: the images of more are a mapped file, which the memory does not count."""
FOOTAGE_NUMBERS = ("looked_at", "passed_over", "source_pixels")
"""Of `Workload`: what is known of a video or a DICOM file alone."""
FITTED_BACKEND = "embedded"
"""The only one that there are records of."""
GAUSSIANS_WANTED = (51_000, 5000, 0.39)
"""So many, after so many iterations, and the power by which they grow with these: where densification ends
without a limit. In ten scenes of 160 x 128 to 675 x 540 px it depended on neither size nor number of frames
(28,000 to 36,000 Gaussians after 1,500 iterations, 33,000 to 95,000 after 5,000, 97,000 to 105,000 after
30,000)."""
GROWN_FROM_START = 1.5
"""What densification makes of the starting points, as a multiple: of eleven scenes that started from 24,000
eight reached their limit, which was that; the others ended at 1.24 to 1.44."""
FINAL_WANTED = 5.0
"""The same after fine-tuning, as a multiple: 3.4 and 7.4 in the two scenes whose limit was far away."""
FEATURES_PER_PX = 0.02
"""About so many are found, where `poses.n_features` does not bound them."""
REWEIGHTED = 20
"""Rounds of reweighting; the fit has settled by then."""
PRIOR_RECORDS = 2.0
"""A task's own factor on a machine counts as much as that of all tasks when it rests on so many records."""
PROBE_ROUNDS, PROBE_REPEATS = 12, 5

WORKLOAD_SETTINGS = (
    "coarse.iterations",
    "coarse.sh_degree",
    "coarse.max_points",
    "coarse.pixels_per_point",
    "coarse.densify.enabled",
    "coarse.densify.max_gaussians",
    "coarse.light.enabled",
    "coarse.light.frame_colors",
    "coarse.train_on",
    "depth.hypotheses",
    "depth.max_width",
    "depth.monocular",
    "depth.sources",
    "explore.score",
    "explore.starts",
    "explore.trajectories",
    "explore.wave",
    "enhance.backend",
    "enhance.folds",
    "enhance.fold_iterations",
    "enhance.judge",
    "enhance.judge_pairs",
    "enhance.max_views",
    "enhance.max_width",
    "enhance.samples",
    "enhance.steps",
    "enhance.train_iterations",
    "finetune.growth",
    "finetune.holes_only",
    "finetune.iterations",
    "finetune.keep_scene",
    "finetune.rounds",
    "finetune.judge.enabled",
    "finetune.judge.iterations_share",
    "finetune.judge.views",
    "evaluate.lpips_nets",
    "evaluate.restored",
    "poses.exhaustive_below",
    "poses.fallback",
    "poses.max_width",
    "poses.n_features",
    "poses.sequential_overlap",
    "uc_nerf.enabled",
)
"""All settings that predicted costs depend on: those that `Workload` reads, and those that say which tasks
run and whether the coefficients hold of them. Without one of these, predictions are of other settings."""


@dataclass(frozen=True)
class Workload:
    """The numbers that costs depend on.

    Args:
        pixels: of an image.
        frames: of the sequence.
        train: of them, those for training.
        test: of them, those that are held out.
        config: settings of all stages.
        views: virtual views to restore; None takes the setting.
        width: of an image, in pixels; None: of one that is narrow enough to be restored as it is.
        stacks: renders of the held-out frames that are measured together.
        coarse_gaussians: of the coarse scene, where there is one; None: as many as are expected.
        final_gaussians: of the final scene, likewise.
        drawn: whether the frames are drawn by a procedural scene, instead of read.
        has_depth: whether the source knows their depth, withheld or not.
        looked_at: pictures of a video or DICOM file that the frames are chosen among; 0 for other sources.
        passed_over: pictures before the part that is read.
        source_pixels: of such a picture.
        colors_kept: whether the coarse scene's frames have haze or white balance of their own; where they
            have none, it begins anew once that is known.
    """

    pixels: float | int
    frames: float | int
    train: float | int
    test: float | int
    config: PipelineConfig
    views: float | int | None = None
    width: float | int | None = None
    stacks: int = 3
    coarse_gaussians: float | int | None = None
    final_gaussians: float | int | None = None
    drawn: bool = False
    has_depth: bool = True
    looked_at: float | int = 0
    passed_over: float | int = 0
    source_pixels: float | int = 0
    colors_kept: bool = False

    @property
    def size(self) -> dict[str, float]:
        """What the sequence tells: pixels, frames, those for training and held out, width.

        Also `drawn` where they are, `has_depth` where there is none, and what is looked at of footage:
        earlier records tell of none of these.
        """
        found = {name: float(getattr(self, name)) for name in ("pixels", "frames", "train", "test")}
        if self.width is not None:
            found["width"] = float(self.width)
        if self.drawn:
            found["drawn"] = True
        if not self.has_depth:
            found["has_depth"] = False
        footage = {name: float(getattr(self, name)) for name in FOOTAGE_NUMBERS}
        if any(footage.values()):
            found |= footage
        return found

    def numbers(self) -> dict[str, float]:
        """By name in terms."""
        config = self.config
        enhance, judge = config.enhance, config.finetune.judge
        coarse, final = self._gaussians()
        samples = 1.0 if enhance.samples == "mean" else float(enhance.samples)
        # The weights of the package take one.
        steps = 1.0 if enhance.steps == "auto" else float(enhance.steps)
        return {
            "one": 1.0,
            "pixels": float(self.pixels),
            "held_pixels": float(min(self.frames * self.pixels, HELD_PIXELS)),
            # Of a virtual view.
            "restored": float(self.pixels) * self._restored_share(),
            "frames": float(self.frames),
            "drawn": float(self.drawn),
            # What is read with depth is resampled, and held-out pixels are looked for in training frames.
            "known_depth": float(self.has_depth),
            # Read from files of their own.
            "files": float(self.frames) * (not self.drawn and self.source_pixels == 0),
            "looked_at": float(self.looked_at),
            "passed_over": float(self.passed_over),
            "source_pixels": float(self.source_pixels),
            "train": float(self.train),
            "test": float(self.test),
            "iterations": config.coarse.iterations + (0.0 if self.colors_kept else self._trial_iterations()),
            "gaussians": coarse,
            "coefficients": coarse * (config.coarse.sh_degree + 1) ** 2,
            "final_gaussians": final,
            "branches": float(self._branches()),
            # Leave-out pairs are for who trains or judges.
            "fold_iterations": float(enhance.folds * enhance.fold_iterations)
            * (enhance.judge or enhance.train_iterations > 0),
            "judge_pairs": float(min(2 * self.train, enhance.judge_pairs)) * enhance.judge,
            "views": float(enhance.max_views if self.views is None else self.views),
            "judge_iterations": judge.iterations_share * config.finetune.first_round.iterations,
            "judge_views": float(judge.views),
            "tuning": float(config.finetune.iterations),
            # LPIPS with this backbone takes longer than all other metrics together.
            "vgg": float("vgg" in config.evaluate.lpips_nets),
            "stacks": float(self.stacks),
            "samples": samples,
            # Of the restoring network: what was recorded is one run of it for each view.
            "more_steps": steps - 1,
            "more_evaluations": steps * samples - 1,
            # Of a network over a view: the frame once, each render as it is and aligned.
            "passes": 1.0 + 2.0 * self.stacks,
            # Of an image as depth is estimated from it.
            "matched_pixels": self._pixels_within(config.depth.max_width),
            # In thousands, of all frames that one is matched with.
            "hypotheses": min(config.depth.sources, self.train - 1) * config.depth.hypotheses / 1000,
            # Of an image as features are looked for in it, in thousands of features.
            "feature_pixels": self._pixels_within(config.poses.max_width),
            "features": self._features() / 1000,
            "pairs": self._matched_pairs(),
        }

    def _trial_iterations(self) -> float:
        """That the coarse scene begins anew after."""
        decided = self.config.coarse.color_trial(round(self.train))
        return 0.0 if decided is None else decided + 1.0

    def _gaussians(self) -> tuple[float, float]:
        """Of the coarse and of the final scene."""
        limit = self.config.coarse.densify.max_gaussians
        count, iterations, power = GAUSSIANS_WANTED
        points = self.config.coarse.starting_points(round(self.train * self.pixels))
        wanted = count * (self.config.coarse.iterations / iterations) ** power
        # It goes on from what is there at the start.
        wanted = max(wanted, GROWN_FROM_START * points)
        if not self.config.coarse.densify.enabled:
            # As many as at the start, which no limit but this one bounds.
            limit = wanted = points
        coarse = float(min(limit, wanted) if self.coarse_gaussians is None else self.coarse_gaussians)
        most = self.config.finetune.growth * self.config.coarse.densify.max_gaussians
        tuned = max(coarse, min(most, FINAL_WANTED * max(wanted, coarse)))
        return coarse, float(tuned if self.final_gaussians is None else self.final_gaussians)

    def _branches(self) -> int:
        """Of the exploration, at least, where it uses its budget: with fewer trajectories all starts grow."""
        explore = self.config.explore
        if explore.score == "pairs" or explore.wave == 1:
            return explore.trajectories
        return max(explore.starts, explore.trajectories)

    def _restored_share(self) -> float:
        if self.width is None:
            return 1.0
        return (self.config.enhance.working_width(round(self.width)) / self.width) ** 2

    def _pixels_within(self, max_width: int) -> float:
        """Of an image that is no wider than that."""
        share = 1.0 if self.width is None else min(1.0, max_width / self.width)
        return float(self.pixels) * share**2

    def _features(self) -> float:
        """Of a frame."""
        poses = self.config.poses
        return min(float(poses.n_features), FEATURES_PER_PX * self._pixels_within(poses.max_width))

    def _matched_pairs(self) -> float:
        """Pairs of frames that COLMAP matches; see `extrags.poses.pairs`."""
        poses, train = self.config.poses, float(self.train)
        near, spread = poses.sequential_overlap, poses.exhaustive_below
        if train <= spread:
            return train * (train - 1) / 2 + self.test * train
        # Neighbours, frames a power of two apart, and evenly spread ones.
        farther = max(0.0, math.log2(train) - math.log2(near))
        return train * (near + farther) + spread * (spread - 1) / 2 + self.test * (2 * near + spread)

    def term(self, name: str) -> float:
        """A product of numbers, e.g. `iterations*pixels`."""
        return math.prod(self._known_numbers[factor] for factor in name.split("*"))

    @cached_property
    def _known_numbers(self) -> dict[str, float]:
        """All terms of all tasks are made of the same."""
        return self.numbers()


@dataclass(frozen=True)
class TaskCost:
    """What a task cost, or will.

    Args:
        task: name.
        seconds: of processor time.
        peak_mib: peak resident memory of the process; None where it is not known.
    """

    task: str
    seconds: float
    peak_mib: float | None


@dataclass(frozen=True)
class CostModel:
    """Coefficients of the costs of tasks on the reference machine.

    Args:
        time: by task and term, seconds.
        memory: by task and term, MiB.
        probe_s: seconds of the probe (`probe_seconds`) on the reference machine.
    """

    time: Mapping[str, Mapping[str, float]]
    memory: Mapping[str, Mapping[str, float]]
    probe_s: float

    def predict(self, task: str, work: Workload) -> TaskCost:
        """Cost of a task on the reference machine.

        Raises:
            ConfigError: for a task that is not in the model.
        """
        if task not in self.time:
            raise ConfigError(f"no costs are known of the task {task!r}; known: {', '.join(self.time)}")
        memory = self.memory.get(task)
        return TaskCost(
            task,
            sum(factor * work.term(term) for term, factor in self.time[task].items()),
            None if memory is None else sum(factor * work.term(term) for term, factor in memory.items()),
        )

    def pace(
        self, history: Sequence[tuple[Workload, TaskCost]], config: PipelineConfig | None = None
    ) -> dict[str, float]:
        """How much longer tasks take than on the reference machine, by their records.

        Args:
            history: what was done on this machine and what it took, seconds of any one kind. Records with
                settings beyond the fit count only for tasks that have the same ones.
            config: settings of what is asked for; None: such as the model was fitted to.

        Returns:
            A factor for every task of the model: the median of its own records, drawn towards that of all
            tasks (weighted by time) where they are few; of these `tells_pace` says which count. Of tasks with
            settings beyond the fit, that of their own records; left out where there are none. Empty without
            any record that fits the model.
        """
        beyond = {task: () if config is None else beyond_the_fit(task, config) for task in self.time}
        ratios: dict[str, list[float]] = {}
        taken = expected = 0.0
        for work, cost in history:
            if cost.task not in self.time or cost.seconds <= 0:
                continue
            usual, own_beyond = self.predict(cost.task, work).seconds, beyond_the_fit(cost.task, work.config)
            if usual > 0 and own_beyond == beyond[cost.task]:
                ratios.setdefault(cost.task, []).append(math.log(cost.seconds / usual))
            if usual > 0 and not own_beyond and tells_pace(work, cost):
                taken, expected = taken + cost.seconds, expected + usual
        if not expected:
            return {}
        whole = math.log(taken / expected)
        found: dict[str, float] = {}
        for task in self.time:
            own = ratios.get(task, [])
            if beyond[task]:
                # What all tasks say of the machine says nothing of work that the terms do not describe.
                found |= {task: math.exp(median(own))} if own else {}
                continue
            share = len(own) / (len(own) + PRIOR_RECORDS)
            found[task] = math.exp(share * median(own) + (1 - share) * whole if own else whole)
        return found

    def to_json(self) -> dict[str, Any]:
        """A JSON object; see `from_json`."""
        return {"probe_s": self.probe_s, "time": self.time, "memory": self.memory}

    @staticmethod
    def from_json(found: Mapping[str, Any]) -> CostModel:
        """A model from the JSON of `to_json`."""
        return CostModel(found["time"], found["memory"], float(found["probe_s"]))


def tells_pace(work: Workload, cost: TaskCost) -> bool:
    """Whether a record says how fast a machine is at other tasks too; reading frames depends on their files.

    Of a long video all frames are decoded and few are used, which made everything take four times as long.
    """
    return cost.task != "ingest" or work.drawn


def stage_tasks(stage: str, config: PipelineConfig) -> tuple[str, ...]:
    """The tasks of a stage that are modelled and that these settings run."""
    return tuple(task for task, cost in modelled_tasks(stage).items() if cost.runs(config))


def beyond_the_fit(task: str, config: PipelineConfig, *, devices: bool = True) -> tuple[str, ...]:
    """Settings of a task that no record behind the packaged coefficients had, and no term stands for.

    With the same ones, records of a store still tell what the task takes.

    Args:
        task: name.
        config: settings of all stages. What `auto` means is not asked: devices have to be settled.
        devices: whether work on a GPU is beyond; there was none where the coefficients were fitted.

    Returns:
        Names and values, in words; empty where the coefficients hold.
    """
    enhance = config.enhance
    restores = cost_of(task).restores
    found = []
    if restores and enhance.backend != FITTED_BACKEND:
        found.append(f"enhance.backend={enhance.backend}")
    # A restorer that was trained may have been found to be best with more steps.
    elif task == "enhance-train" or (restores and enhance.steps == "auto"):
        found += [f"enhance.train_iterations={enhance.train_iterations}"] * (enhance.train_iterations > 0)
    if task in ("coarse", "evaluate-render") and config.uc_nerf.enabled:
        # The radiance field's own tasks run in their place.
        found.append("uc_nerf.enabled=true")
    if task == "poses" and config.poses.fallback == "rgbd":
        found.append("poses.fallback=rgbd")
    if task == "depth" and config.depth.monocular is not None:
        found.append(f"depth.monocular={config.depth.monocular}")
    if task in ("finetune", "finetune-judge") and config.finetune.keep_scene:
        found.append("finetune.keep_scene=true")
    if task in ("finetune", "finetune-judge") and config.finetune.holes_only:
        found.append("finetune.holes_only=true")
    if devices and cost_of(task).on_device and config.device == "cuda":
        found.append("device=cuda")
    if devices and task == "depth" and config.depth.device == "cuda":
        found.append("depth.device=cuda")
    return tuple(found)


def stage_seconds(model: CostModel, stage: str, work: Workload) -> float:
    """Processor time of a stage on the reference machine, each task once.

    Unknown tasks, and those with settings `beyond_the_fit`, count nothing. What runs on a GPU counts as on
    that machine, which has none.
    """
    return sum(
        model.predict(task, work).seconds
        for task in stage_tasks(stage, work.config)
        if task in model.time and not beyond_the_fit(task, work.config, devices=False)
    )


def fitted(history: Sequence[tuple[Workload, TaskCost]], probe_s: float) -> CostModel:
    """Fit the coefficients to records.

    Args:
        history: what was done and what it took, all on one machine. Records with settings `beyond_the_fit`
            are left out.
        probe_s: what the probe took there.

    Raises:
        ConfigError: without any record of a task that has terms.
    """
    by_task: dict[str, list[tuple[Workload, TaskCost]]] = {}
    for work, cost in history:
        if not beyond_the_fit(cost.task, work.config):
            by_task.setdefault(cost.task, []).append((work, cost))
    if not by_task:
        raise ConfigError("there is no record to fit costs to")
    time, memory = {}, {}
    for task, records in sorted(by_task.items()):
        timed = [(work, cost.seconds) for work, cost in records if cost.seconds > 0]
        if timed:
            time[task] = _fit(cost_of(task).terms, timed)
        sized = [(work, cost.peak_mib) for work, cost in records if cost.peak_mib]
        if sized:
            memory[task] = _fit(memory_terms(task), sized)
    return CostModel(time, memory, probe_s)


def memory_terms(task: str) -> tuple[str, ...]:
    """Terms of the memory of a task."""
    stage = stage_of_task(task)
    if stage is not None and stage.name in ("poses", "depth"):
        # There are no views to restore yet.
        terms = [term for term in MEMORY_TERMS if term != "views*restored"]
        # Frames are matched at a width of their own.
        return tuple(
            term.replace("restored", "matched_pixels") if stage.name == "depth" else term for term in terms
        )
    if not cost_of(task).of_final_scene:
        return MEMORY_TERMS
    measured = EVALUATION_TERMS if stage is not None and stage.name == "evaluate" else ()
    return (*("final_gaussians" if term == "gaussians" else term for term in MEMORY_TERMS), *measured)


def _fit(terms: Sequence[str], records: Sequence[tuple[Workload, float]]) -> dict[str, float]:
    """Non-negative coefficients with the least sum of absolute relative errors (reweighted squares)."""
    from scipy.optimize import nnls

    value = np.array([amount for _, amount in records])
    matrix = np.array([[work.term(term) for term in terms] for work, _ in records]) / value[:, None]
    # Columns of one scale: products of iterations and pixels are larger than 1 by eight orders.
    size = np.maximum(np.abs(matrix).max(axis=0), 1e-300)
    weight = np.ones(len(value))
    factors = np.zeros(len(terms))
    for _ in range(REWEIGHTED):
        root = np.sqrt(weight)
        factors, _residual = nnls(matrix / size * root[:, None], root)
        residual = np.abs(matrix / size @ factors - 1)
        weight = 1 / np.maximum(residual, 0.02)
    return {
        term: float(f"{factor / scale:.4g}")
        for term, factor, scale in zip(terms, factors, size, strict=True)
        if factor > 0
    }


@cache
def packaged_model() -> CostModel:
    """The model that comes with this package; docs/benchmarks/run_time_and_error.md says what it rests on."""
    text = resources.files("extrags").joinpath("run_costs.json").read_text(encoding="utf-8")
    return CostModel.from_json(json.loads(text))


def probed_rasteriser() -> str:
    """The rasteriser that `probe_seconds` runs: `native`, else what renders here in its place."""
    # Here, because it loads torch and the kernels.
    from extrags.raster import available_backends, native

    return "native" if native.native_isa() is not None else available_backends()[0]


def probe_seconds() -> float:
    """Processor time of rendering and differentiating a small scene once, in seconds.

    The probe takes about one second, of the reference rasteriser two. Compare with `CostModel.probe_s` to
    tell how fast this machine is.
    """
    # Here, because it loads torch and the kernels.
    from extrags.raster.bench import BenchSize, bench_raster

    size = BenchSize(160, 128, 10_000)
    rasteriser = probed_rasteriser()
    if rasteriser != "native":
        return _seconds_of_peer(rasteriser, size)
    found = [
        bench_raster([size], peers=(), threads=(1,), rounds=PROBE_ROUNDS, with_error=False)
        for _ in range(PROBE_REPEATS)
    ]
    # The least: other work on the machine shares its caches, and only ever slows.
    return min(float(item["cases"][0]["cpu_ms"]["iteration"]) for item in found) / 1e3


def _seconds_of_peer(rasteriser: str, size: BenchSize) -> float:
    import torch

    from extrags.raster.bench import bench_scene
    from extrags.raster.peers import TimedPeer, use_threads

    peer, threads = TimedPeer(rasteriser, bench_scene(size), training=False), torch.get_num_threads()
    use_threads(rasteriser, 1)
    try:
        for _ in range(PROBE_ROUNDS):
            if not peer.finished:
                peer.iteration()
    finally:
        torch.set_num_threads(threads)
    return float(peer.summary()["cpu_ms"]["iteration"]) / 1e3
