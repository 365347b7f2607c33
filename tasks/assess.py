"""assess: measurements of the coarse scene, and the plan derived from them."""

from __future__ import annotations

from extrags.config import AssessConfig, CoverageConfig, PipelineConfig
from extrags.run_costs import WORKLOAD_SETTINGS
from extrags.store import Ref, Slot
from tasks.stage import stage

__all__ = ["assess", "measuring_settings", "plan", "planning_settings"]

MEASUREMENTS = "measurements.json"

_OF_PLAN = ("force", "full_budget_share", "min_hole_share")
"""Settings of the assessment that only the plan reads."""

_OF_BUDGETS = (
    "explore.trajectories",
    "explore.length",
    "enhance.max_views",
    "finetune.iterations",
    "finetune.keep_scene",
)
"""Settings that the decisions rest on."""

_OF_RESTORER = ("enhance.backend", "enhance.judge", "enhance.steps", "enhance.train_iterations")
"""Settings that say what will restore the virtual views."""

_OF_SAVINGS = tuple(
    name
    for name in WORKLOAD_SETTINGS
    if name.partition(".")[0] not in ("poses", "depth", "evaluate", "uc_nerf")
)
"""Settings that what a stage costs depends on; nothing is decided on the evaluation, nor on what has run, and
a radiance field has no plan."""


def measuring_settings(config: AssessConfig) -> AssessConfig:
    """The settings that `assess` reads, all others at their defaults: these are not part of the key."""
    return config.model_copy(update={name: AssessConfig.model_fields[name].default for name in _OF_PLAN})


def planning_settings(config: PipelineConfig) -> PipelineConfig:
    """The settings that `plan` reads, all others at their defaults: these are not part of the key."""
    names = (*(f"assess.{name}" for name in _OF_PLAN), *_OF_BUDGETS, *_OF_RESTORER, *_OF_SAVINGS)
    read = {name: config.value(name) for name in names}
    return PipelineConfig().with_overrides(read)


@stage("assess", version=5)
def assess(
    slot: Slot,
    scene: Ref,
    sequence: Ref,
    config: AssessConfig,
    coverage: CoverageConfig,
    device: str = "cpu",
) -> None:
    """Measure the scene; writes `measurements.json`.

    The measurements do not depend on budgets, so changed budgets do not repeat them; `plan` decides.
    Training views are rendered on the `device`, probe views where blending weights are.
    """
    from extrags.assessment import measure
    from extrags.devices import chosen_device
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence

    shown = slot.load(Scene, scene).to(chosen_device(device, "device"))
    found = measure(shown, slot.load(EndoscopicSequence, sequence), config, coverage)
    slot.save_json(MEASUREMENTS, found, indent=1)
    slot.counts["lacking_share"] = found["lacking_share"]


@stage("plan", version=8)
def plan(slot: Slot, measured: Ref, config: PipelineConfig) -> None:
    """Derive the plan from the measurements and the budgets of the run; writes `plan.json`."""
    from extrags.scene_plan import decide

    slot.save(decide(slot.load_json(MEASUREMENTS, measured), config))
