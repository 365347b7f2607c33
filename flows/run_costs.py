"""Costs of tasks on record in a store, and what a run of given settings will cost."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from data_catalog.catalog import drawn_formats, footage_formats
from extrags.config import PipelineConfig
from extrags.errors import StoreError
from extrags.run_costs import (
    CostModel,
    TaskCost,
    Workload,
    beyond_the_fit,
    packaged_model,
    probe_seconds,
    probed_rasteriser,
    stage_tasks,
    tells_pace,
)
from extrags.scene_plan import ScenePlan
from extrags.stages import REGISTRY, STAGES, StageName, cost_of, modelled_tasks
from extrags.store import Manifest, Store
from flows.outcome import SequenceOutcome
from flows.workloads import footage_numbers, frames_stages, frames_work, knows_depth, task_repeats

__all__ = [
    "Pace",
    "RunPrediction",
    "StageCost",
    "pace_here",
    "planned_work",
    "predict_run",
    "recorded_costs",
    "unplanned_work",
]

Record = tuple[Workload, TaskCost]
OF_RESTORER = ("backend", "fold_iterations", "folds", "judge", "samples", "steps", "train_iterations")
"""Settings that the restorer is prepared with, and that its runs depend on."""
COST_SETTINGS = tuple(stage.name for stage in REGISTRY if stage.costs_by_settings)
"""Groups of settings that costs depend on."""
ENOUGH_SECONDS = 10.0
"""So much work on record tells more of a machine than a probe."""


@dataclass(frozen=True)
class StageCost:
    """What a stage will cost.

    Args:
        stage: name.
        processor_seconds: of all threads.
        seconds: elapsed, at the pace of this store's records; None where there are none.
        peak_mib: peak resident memory of the process.
    """

    stage: str
    processor_seconds: float
    seconds: float | None
    peak_mib: float | None


@dataclass(frozen=True)
class RunPrediction:
    """What a run will cost, stage by stage.

    Args:
        stages: those that run.
        source: what tells how fast this machine is: `history` of the store, a `probe`, or `probe of
            RASTERISER` where the compiled kernels are missing.
        records: so many records the history has.
        unknown: stages, and tasks of stages, that run and of whose cost nothing is known; not in any sum.
    """

    stages: list[StageCost]
    source: str
    records: int
    unknown: list[str] = field(default_factory=list)

    @property
    def processor_seconds(self) -> float:
        """Of the whole run."""
        return sum(stage.processor_seconds for stage in self.stages)

    @property
    def seconds(self) -> float | None:
        """Elapsed time of the whole run."""
        known = [stage.seconds for stage in self.stages if stage.seconds is not None]
        return sum(known) if known and len(known) == len(self.stages) else None

    @property
    def peak_mib(self) -> float | None:
        """The largest of the stages."""
        return max((stage.peak_mib for stage in self.stages if stage.peak_mib is not None), default=None)

    def to_json(self) -> dict[str, Any]:
        """A JSON object: `{processor_seconds, seconds, peak_mib, source, records, unknown, stages}`."""
        return {
            "processor_seconds": round(self.processor_seconds, 1),
            "seconds": None if self.seconds is None else round(self.seconds, 1),
            "peak_mib": None if self.peak_mib is None else round(self.peak_mib),
            "source": self.source,
            "records": self.records,
            "unknown": self.unknown,
            "stages": [asdict(stage) for stage in self.stages],
        }


@dataclass(frozen=True)
class Pace:
    """How much longer tasks take here than on the reference machine, by task.

    Args:
        source: `history` of a store, a `probe`, or `probe of RASTERISER` without the compiled kernels.
        records: so many records the history has.
        processor: factors of processor time; tasks of which nothing is known are not among them.
        elapsed: factors of elapsed time; empty where nothing is known of it.
    """

    source: str
    records: int
    processor: dict[str, float]
    elapsed: dict[str, float]


def pace_here(store: Store, fallback: PipelineConfig, model: CostModel) -> Pace:
    """The pace of this machine: by the records of a store, else by a probe.

    Args:
        store: its records of this kind of machine count (`recorded_costs`).
        fallback: settings of the run, and those that manifests do not hold.
        model: of the reference machine.

    Raises:
        StoreError: when the store cannot be read.
    """
    fallback = _on_devices(fallback)
    elapsed, processor = recorded_costs(store, fallback)
    known = model.pace(processor, fallback)
    if known and sum(cost.seconds for work, cost in processor if tells_pace(work, cost)) >= ENOUGH_SECONDS:
        return Pace("history", len(processor), known, model.pace(elapsed, fallback))
    factor = probe_seconds() / model.probe_s
    fitted = [task for task in model.time if not beyond_the_fit(task, fallback)]
    rasteriser = probed_rasteriser()
    if rasteriser == "native":
        return Pace("probe", len(processor), dict.fromkeys(fitted, factor), {})
    # How much slower another rasteriser is tells nothing of what does not render.
    factors = {task: factor if cost_of(task).renders else 1.0 for task in fitted}
    return Pace(f"probe of {rasteriser}", len(processor), factors, {})


def predict_run(
    store: Store,
    work: Workload,
    stages: Collection[str],
    *,
    measured_scenes: int = 1,
    model: CostModel | None = None,
    pace: Pace | None = None,
) -> RunPrediction:
    """What a run will cost on this machine, when nothing of it is in the store.

    Of tasks with settings that the model does not know (`extrags.run_costs.beyond_the_fit`), records of the
    store tell, where it has some with the same settings; else they are `unknown`. So it is with tasks that
    run on a GPU.

    Args:
        store: its records tell how fast this machine is; without enough of them a probe does.
        work: size of the sequence and settings.
        stages: that will run.
        measured_scenes: scenes that are evaluated: 2 where the coarse and a fine-tuned one are.
        model: of the reference machine; the packaged one by default.
        pace: of this machine; `pace_here` by default.

    Raises:
        StoreError: when the store cannot be read.
    """
    model = model or packaged_model()
    work = replace(work, config=_on_devices(work.config))
    if "enhance" not in stages:
        # Nothing is restored, with whatever backend.
        unrestored = {"enhance.backend": "embedded", "enhance.train_iterations": 0}
        work = replace(work, config=work.config.with_overrides(unrestored))
    pace = pace or pace_here(store, work.config, model)
    found: list[StageCost] = []
    unknown: list[str] = []
    restored = int("enhance" in stages and work.config.evaluate.restored != "none")
    work = replace(work, stacks=measured_scenes + restored)
    for stage in STAGES:
        if stage not in stages:
            continue
        if not any(task in model.time for task in modelled_tasks(stage)):
            unknown.append(stage)
            continue
        repeats = task_repeats(stage, measured_scenes, restored)
        run = [task for task in stage_tasks(stage, work.config) if task in repeats and task in model.time]
        costs = [model.predict(task, work) for task in run if task in pace.processor]
        if not costs:
            unknown.append(stage)
            continue
        unknown += [task for task in run if task not in pace.processor]
        peaks = [cost.peak_mib for cost in costs if cost.peak_mib is not None]
        found.append(
            StageCost(
                stage,
                sum(repeats[cost.task] * cost.seconds * pace.processor[cost.task] for cost in costs),
                sum(repeats[cost.task] * cost.seconds * pace.elapsed[cost.task] for cost in costs)
                if pace.elapsed
                else None,
                max(peaks, default=None),
            )
        )
    return RunPrediction(found, pace.source, pace.records, unknown)


def planned_work(
    store: Store, outcome: SequenceOutcome, config: PipelineConfig
) -> tuple[Workload, set[StageName]]:
    """Size and settings of a sequence that has been read and assessed, and the stages that will run.

    Args:
        store: with what `outcome` made.
        outcome: of a run until `assess`, with its plan.
        config: settings that it was started with.

    Raises:
        StoreError: when the sequence's manifest cannot be read.
    """
    skipped = {row.stage for row in outcome.stages if row.state == "skipped"}
    # Its row says that it ran: the scene was read, and nothing was trained.
    skipped |= set() if config.imported.scene is None else {"coarse"}
    source = store.manifest(outcome.refs["ingest"])
    counts = source.counts
    coarse = store.manifest(outcome.refs["coarse"]).counts if "coarse" in outcome.refs else None
    # Rows tell of the stages that have run, the rules of those to come.
    possible = {*frames_stages(counts, config), *(row.stage for row in outcome.stages)}
    if config.imported.scene is not None and coarse is not None:
        # Here, because this loads Prefect.
        from flows.imported import of_imported_scene

        config = of_imported_scene(config, coarse)
    if outcome.plan is not None:
        decided = ScenePlan.model_validate(
            {name: outcome.plan[name] for name in ScenePlan.model_fields if name in outcome.plan}
        )
        config = decided.applied_to(config)
        skipped |= {line.stage for line in decided.decisions if not line.run}
    wanted = possible - skipped
    work = frames_work(counts, config, coarse, drawn=_is_drawn(source))
    return work, {stage for stage in STAGES if stage in wanted}


def unplanned_work(
    store: Store, outcome: SequenceOutcome, config: PipelineConfig
) -> tuple[Workload, set[StageName]]:
    """As `planned_work`, of a run without a plan: all stages with the whole of their budgets.

    Raises:
        StoreError: when the sequence's manifest cannot be read.
    """
    return planned_work(store, replace(outcome, plan=None), config)


def recorded_costs(
    store: Store, fallback: PipelineConfig, *, of_this_machine: bool = True
) -> tuple[list[Record], list[Record]]:
    """Costs that the manifests of a store tell of, of tasks in their present version.

    A store may be shared. What another processor or GPU, or other kernels, took is no record of this machine.
    Manifests of earlier versions do not tell where they were made, and count where none does.

    Waves of an exploration, and batches of a restoration, are added up to the artefact they lead to. Settings
    that a manifest does not hold are the fallback's.

    Args:
        store: with artefacts.
        fallback: settings of all stages.
        of_this_machine: leave out what another kind of machine made.

    Returns:
        Records with elapsed time, and those with processor time, which earlier versions did not measure.

    Raises:
        StoreError: when the store cannot be read.
    """
    # Here, because this loads Prefect.
    from tasks.stage import all_stage_versions

    manifests = {manifest.key: manifest for manifest in store.ls()}
    versions = all_stage_versions()
    modelled = {task for stage in STAGES for task in modelled_tasks(stage)}
    elapsed, processor = [], []
    candidates = [
        manifest
        for manifest in manifests.values()
        if manifest.stage in modelled and versions.get(manifest.stage) == manifest.version
    ]
    where_known = any("processor" in manifest.counts for manifest in candidates)
    for manifest in candidates:
        work = _workload(manifest, manifests, fallback)
        if work is None:
            continue
        parts = [manifest, *_parts(manifest, manifests)]
        if of_this_machine and where_known and not all(map(_made_here, parts)):
            continue
        peaks = [float(value) for part in parts if isinstance(value := part.counts.get("peak_mib"), float)]
        peak = max(peaks, default=None)
        elapsed.append((work, TaskCost(manifest.stage, sum(part.elapsed_s for part in parts), peak)))
        spent = [part.counts.get("processor_s") for part in parts]
        if all(isinstance(value, int | float) for value in spent):
            seconds = sum(float(value) for value in spent if isinstance(value, int | float))
            processor.append((work, TaskCost(manifest.stage, seconds, peak)))
    return elapsed, processor


def _made_here(manifest: Manifest) -> bool:
    """Whether it was made on a machine of this kind; not where it does not say."""
    from extrags.cores import processor_name
    from extrags.devices import device_name
    from extrags.raster import native_isa

    counts = manifest.counts
    kind = "cpu" if counts.get("device") == "cpu" else "cuda"
    here = (processor_name(), native_isa(), device_name(kind))
    return (counts.get("processor"), counts.get("isa"), counts.get("device")) == here


def _on_devices(config: PipelineConfig) -> PipelineConfig:
    """The same settings where devices that are `auto` are what that means on this machine."""
    from extrags.devices import chosen_device
    from extrags.placement import run_device

    config = config.with_run_device()
    depth = config.depth
    if depth.device == "auto":
        kind = chosen_device("auto", "depth.device").type
        depth = depth.model_copy(update={"device": kind})
    return config.model_copy(update={"device": run_device(config), "depth": depth})


def _parts(manifest: Manifest, manifests: Mapping[str, Manifest]) -> list[Manifest]:
    """What belongs to the same work: the waves before an exploration's end, the batches of a restoration."""
    wanted = cost_of(manifest.stage).includes
    found: dict[str, Manifest] = {}
    open_ = [manifest]
    while open_:
        for key in open_.pop().input_keys.values():
            part = manifests.get(key)
            if part is not None and key not in found and part.stage in wanted:
                found[key] = part
                open_.append(part)
    return list(found.values())


def _workload(
    manifest: Manifest, manifests: Mapping[str, Manifest], fallback: PipelineConfig
) -> Workload | None:
    """The numbers of a record: of the frames it was made from, and of the settings behind it.

    None where what tells them, frames or restorer, is not in the store any more.
    """
    line = [manifest, *_ancestors(manifest, manifests)]
    source = next((item for item in line if item.stage == "ingest"), None)
    restores = "restorer" in manifest.input_keys or manifest.stage == "enhance"
    if source is None or (restores and all(item.stage != "enhance-train" for item in line)):
        return None
    counts = source.counts
    size = [counts.get(name) for name in ("width", "height", "frames", "train", "test")]
    if not all(isinstance(value, int | float) for value in size):
        return None
    if manifest.stage == "ingest" and _format(source) in footage_formats() and "looked_at" not in counts:
        # Of an earlier version, which did not say how much of the footage was decoded.
        return None
    width, height, frames, train, test = (float(value or 0) for value in size)
    views = manifest.counts.get("views") if manifest.stage == "enhance" else None
    stacks = manifest.counts.get("stacks")
    scenes = {item.stage: item.counts.get("n_gaussians") for item in reversed(line)}
    coarse, final = scenes.get("coarse"), scenes.get("finetune")
    colors_kept = any(item.stage == "coarse" and item.counts.get("corrected_colors") for item in line)
    config = _config(line, fallback)
    return Workload(
        width * height,
        frames,
        train,
        test,
        config,
        float(views) if views else None,
        width,
        int(stacks) if stacks else 1,
        float(coarse) if coarse else None,
        float(final) if final else None,
        drawn=_is_drawn(source),
        has_depth=knows_depth(counts, config),
        colors_kept=colors_kept,
        **footage_numbers(counts),
    )


def _is_drawn(source: Manifest) -> bool:
    """Whether the frames of an artefact of `ingest` were drawn, not read."""
    return _format(source) in drawn_formats()


def _format(source: Manifest) -> str:
    """That of what an artefact of `ingest` was made from (`data_catalog.Source.format`); empty if unknown."""
    fingerprint = source.config.get("fingerprint")
    return str(fingerprint.get("format", "")) if isinstance(fingerprint, dict) else ""


def _ancestors(manifest: Manifest, manifests: Mapping[str, Manifest]) -> list[Manifest]:
    found: dict[str, Manifest] = {}
    open_ = [manifest]
    while open_:
        for key in open_.pop().input_keys.values():
            if key in manifests and key not in found:
                found[key] = manifests[key]
                open_.append(manifests[key])
    return list(found.values())


def _config(line: list[Manifest], fallback: PipelineConfig) -> PipelineConfig:
    """The fallback with the settings of the stages behind a record, nearest first."""
    changed: dict[str, Any] = {}
    for item in line:
        own = item.stage.partition("-")[0]
        groups = {**item.config, own: item.config.get("config")}
        for group in COST_SETTINGS:
            settings = groups.get(group)
            if isinstance(settings, dict) and group not in changed:
                known = type(getattr(fallback, group)).model_fields
                changed[group] = {name: value for name, value in settings.items() if name in known}
    device = line[0].config.get("device")
    fallback = fallback.model_copy(update={"device": "cuda" if device == "cuda" else "cpu"})
    # A scene says what it is by the task that made it, not by a setting.
    changed["uc_nerf"] = {"enabled": any(item.stage == "uc-nerf" for item in line)}
    # Of the restorer, others hold no more than what they read themselves.
    restorer = next((item.config.get("config") for item in line if item.stage == "enhance-train"), None)
    settings = restorer if isinstance(restorer, dict) else {"backend": "embedded", "train_iterations": 0}
    of_restorer = {name: settings[name] for name in OF_RESTORER if name in settings}
    changed["enhance"] = {**changed.get("enhance", {}), **of_restorer}
    networks = next(
        (item.config.get("lpips_digests") for item in line if item.stage.startswith("evaluate")), None
    )
    if isinstance(networks, dict):
        nets = tuple(sorted(networks))
        fallback = fallback.model_copy(
            update={"evaluate": fallback.evaluate.model_copy(update={"lpips_nets": nets})}
        )
    try:
        return fallback.model_copy(
            update={
                group: getattr(fallback, group).model_validate(
                    {**getattr(fallback, group).model_dump(), **settings}
                )
                for group, settings in changed.items()
            }
        )
    except ValueError as error:
        raise StoreError(f"the settings of {line[0].key} are not those of this version: {error}") from error
