"""assess: measurements of the coarse scene, and the plan derived from them."""

from __future__ import annotations

from extrags.config import AssessConfig, CoverageConfig, PipelineConfig
from extrags.store import Ref, Slot
from tasks.stage import stage

__all__ = ["assess", "plan"]

MEASUREMENTS = "measurements.json"


@stage("assess", version=2)
def assess(slot: Slot, scene: Ref, sequence: Ref, config: AssessConfig, coverage: CoverageConfig) -> None:
    """Measure the scene; writes `measurements.json`.

    The measurements do not depend on budgets, so changed budgets do not repeat them; `plan` decides.
    """
    from extrags.assessment import measure
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence

    found = measure(slot.load(Scene, scene), slot.load(EndoscopicSequence, sequence), config, coverage)
    slot.save_json(MEASUREMENTS, found, indent=1)
    slot.counts["lacking_share"] = found["lacking_share"]


@stage("plan", version=3)
def plan(slot: Slot, measured: Ref, config: PipelineConfig) -> None:
    """Derive the plan from the measurements and the budgets of the run; writes `plan.json`."""
    from extrags.assessment import decide

    slot.save(decide(slot.load_json(MEASUREMENTS, measured), config))
