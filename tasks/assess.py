"""assess: what the scene lacks, and the plan that follows."""

from __future__ import annotations

from extrags.config import AssessConfig, PipelineConfig
from extrags.store import Ref, Slot
from tasks.stage import stage

__all__ = ["assess", "plan"]

PLAN = "plan.json"


@stage("assess", version=1)
def assess(slot: Slot, scene: Ref, sequence: Ref, config: AssessConfig) -> None:
    """Measure the scene; writes `plan.json` for the default budgets.

    The measurement depends on the scene and on its own settings alone, so that another budget of
    exploration does not measure again; `plan` turns its numbers into decisions.
    """
    from extrags.assess import assess as measure
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence

    found = measure(
        Scene.load(slot.open(scene) / "scene"),
        EndoscopicSequence.load(slot.open(sequence) / "sequence"),
        PipelineConfig(assess=config),
    )
    (slot.path / PLAN).write_text(found.model_dump_json(indent=1))
    slot.counts["lacking_share"] = found.measurements["lacking_share"]


@stage("plan", version=1)
def plan(slot: Slot, measured: Ref, config: PipelineConfig) -> None:
    """Decide on the measured numbers with the run's own budgets; writes `plan.json`."""
    from extrags.assess import ScenePlan, decide

    found = ScenePlan.model_validate_json((slot.open(measured) / PLAN).read_bytes())
    decisions = decide(found.measurements["lacking_share"], config)
    decided = ScenePlan(measurements=found.measurements, decisions=decisions)
    (slot.path / PLAN).write_text(decided.model_dump_json(indent=1))
