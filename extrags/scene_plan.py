"""The plan of a scene: which later stages run, with what budget, and why."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field

from extrags.config import PipelineConfig, StageConfig
from extrags.errors import ConfigError
from extrags.run_costs import Workload, packaged_model, stage_seconds
from extrags.store.storable import Storable

__all__ = ["Decision", "ScenePlan", "decide"]


class Decision(StageConfig):
    """The plan's decision on one stage."""

    stage: str = Field(description="name of the stage")
    run: bool = Field(description="whether it runs")
    budget: dict[str, bool | int] = Field(
        default_factory=dict, description="settings of the stage to use instead"
    )
    reason: str = Field(description="why, in words")
    value: float = Field(description="the number the decision rests on")
    threshold: float = Field(description="what it was compared with")
    saves_s: float | None = Field(
        None,
        description="predicted saving against the settings without a plan, in seconds of processor time on "
        "the machine that `extrags.run_costs` rests on; None where the size of the frames is not known",
    )


class ScenePlan(StageConfig, Storable):
    """Which later stages run, with what budget, and why."""

    stored_as: ClassVar[str] = "plan.json"

    measurements: dict[str, float] = Field(description="what was measured, by name")
    decisions: tuple[Decision, ...] = Field(description="one per stage, in the order they run")

    def decision(self, stage: str) -> Decision:
        """The decision on a stage.

        Raises:
            ConfigError: when the plan holds no decision on it.
        """
        for line in self.decisions:
            if line.stage == stage:
                return line
        raise ConfigError(
            f"the plan has no line for {stage!r}; it has {', '.join(line.stage for line in self.decisions)}"
        )

    def save(self, path: Path) -> None:
        """Write as JSON."""
        path.write_text(self.model_dump_json(indent=1))

    @classmethod
    def load(cls, path: Path) -> ScenePlan:
        """Read what `save` wrote."""
        return cls.model_validate_json(path.read_bytes())

    def applied_to(self, config: PipelineConfig) -> PipelineConfig:
        """A copy of the settings with the plan's budgets as overrides."""
        overrides: dict[str, Any] = {
            f"{line.stage}.{name}": value for line in self.decisions for name, value in line.budget.items()
        }
        return config.with_overrides(overrides)


def decide(measurements: Mapping[str, float], config: PipelineConfig) -> ScenePlan:
    """Decide which of the later stages run, and scale their budgets.

    The share of lacking pixels is compared with `assess.min_hole_share`. Above it the number of trajectories
    grows in proportion, up to the whole budget at `assess.full_budget_share`. Below it nothing is explored
    and no virtual view restored; the scene is fine-tuned on its real views, without a judge: there is no
    guess for it to judge.

    Args:
        measurements: from `measure`.
        config: thresholds in `assess`, and the full budgets of the stages.

    Returns:
        The plan, one decision per stage: surface, freespace, explore, enhance, finetune.
    """
    decisions = _decisions(measurements["lacking_share"], config)
    plan = ScenePlan(measurements=dict(measurements), decisions=decisions)
    return plan if "pixels" not in measurements else _with_savings(plan, config)


def _with_savings(plan: ScenePlan, config: PipelineConfig) -> ScenePlan:
    """The plan with what each decision saves."""
    found = plan.measurements
    frames = found["training_views"]
    model = packaged_model()

    def seconds(stage: str, settings: PipelineConfig) -> float:
        work = Workload(
            found["pixels"],
            frames,
            frames,
            0,
            settings,
            width=found["width"],
            coarse_gaussians=found.get("gaussians"),
        )
        return stage_seconds(model, stage, work)

    planned = plan.applied_to(config)
    lines = []
    for line in plan.decisions:
        left = seconds(line.stage, planned) if line.run else 0.0
        saved = round(seconds(line.stage, config) - left, 1)
        lines.append(line.model_copy(update={"saves_s": saved}))
    return plan.model_copy(update={"decisions": tuple(lines)})


def _restored_by(config: PipelineConfig) -> str:
    """What will restore the virtual views, as far as it is known before the stage runs."""
    settings = config.enhance
    if settings.backend == "classical":
        return "restored by blending and filling, without a network"
    steps = "as many steps as its weights say"
    if settings.steps != "auto":
        steps = f"{settings.steps} step{'' if settings.steps == 1 else 's'}"
    if settings.backend != "embedded":
        return f"restored by {settings.backend}" + ("" if settings.steps == "auto" else f" in {steps}")
    if settings.steps == "auto" and settings.train_iterations:
        steps = "as many steps as validation pairs of the scene decide"
    by = f"restored by the embedded network in {steps}"
    if settings.judge:
        by += ", or by blending and filling where leave-out frames find it worse (enhance.judge)"
    return by


def _decisions(lacking: float, config: PipelineConfig) -> tuple[Decision, ...]:
    settings = config.assess
    needed = lacking > settings.min_hole_share
    run = needed or settings.force
    share = f"holes and unresolved surface are {100 * lacking:.2f} % of nearby views"
    limit = f"{100 * settings.min_hole_share:.2f} %"
    if needed:
        why = f"{share}, more than {limit}"
    elif settings.force:
        why = f"{share}, no more than {limit}, but assess.force is set"
    else:
        why = f"{share}, no more than {limit}: the training views show the scene well enough"

    need = 1.0 if settings.force else min(1.0, lacking / settings.full_budget_share)
    wanted = max(1, math.ceil(need * config.explore.trajectories)) if run else 0
    # A trajectory of which no view is restored would be searched for nothing.
    trajectories = min(wanted, config.enhance.max_views)
    views = min(config.enhance.max_views, trajectories * (config.explore.length - 1))
    spent = (
        f"{trajectories} of {config.explore.trajectories} trajectories "
        f"(all of them from {100 * settings.full_budget_share:.3g} % on)"
    )
    if trajectories < wanted:
        spent += f", not {wanted}: enhance.max_views={config.enhance.max_views} allows no more"

    def line(stage: str, reason: str, *, runs: bool = run, **budget: bool | int) -> Decision:
        return Decision(
            stage=stage,
            run=runs,
            budget=budget,
            reason=reason,
            value=lacking,
            threshold=settings.min_hole_share,
        )

    if not run:
        left = (
            line("surface", f"only exploration needs it, and {why}"),
            line("freespace", f"only exploration needs it, and {why}"),
            line("explore", why),
            line("enhance", f"there will be no virtual views: {why}"),
        )
        if config.finetune.keep_scene:
            none = "the scene's own Gaussians stay as they are, and there will be no virtual views"
            return (*left, line("finetune", f"{none}: {why}"))
        unjudged = line("finetune", f"on real views alone, which need no judge: {why}", runs=True)
        return (*left, unjudged.model_copy(update={"budget": {"judge.enabled": False}}))
    return (
        line("surface", f"exploration needs it: {why}"),
        line("freespace", f"exploration needs it: {why}"),
        line("explore", f"{why}; {spent}", trajectories=trajectories),
        line(
            "enhance",
            f"at most {views} virtual views come from {trajectories} trajectories; {_restored_by(config)}",
            max_views=views,
        ),
        line("finetune", f"on at most {views} virtual views", iterations=config.finetune.iterations),
    )
