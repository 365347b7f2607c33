"""The descriptions of a stage, its tasks and their costs; `extrags.stages.registry` has those there are."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from extrags.config import PipelineConfig

__all__ = ["Cost", "Part", "Repeats", "Stage", "StageName", "StageTask"]

StageName = Literal[
    "ingest",
    "poses",
    "depth",
    "coarse",
    "assess",
    "surface",
    "freespace",
    "explore",
    "enhance",
    "finetune",
    "evaluate",
    "report",
]

Part = Literal[
    "ingest",
    "sequence",
    "poses",
    "depth",
    "training",
    "coarse",
    "assess",
    "plan",
    "surface",
    "freespace",
    "waves",
    "explore",
    "restorer",
    "enhance",
    "judgement",
    "finetune",
    "renders_coarse",
    "renders_final",
    "renders_restored",
    "metrics_coarse",
    "metrics_final",
    "metrics_restored",
    "report",
]
"""Artefacts of a run. `sequence` has all frames with the latest poses, `depth` the estimated depth of the
training frames, `training` the training frames alone, with that depth where it was estimated,
`waves` the state of the exploration, `restorer` the restorer prepared for this scene, `judgement` how much of
the fine-tuning is kept; what is `restored` are the final scene's held-out views, restored in the image."""

Repeats = Literal["once", "scenes", "restored", "measured"]
"""How often a task runs: once; for each scene that is measured; once where there is a restorer of held-out
views; for each set of views that is measured, of scenes and restored ones."""


def _always(_: PipelineConfig) -> bool:
    return True


@dataclass(frozen=True, kw_only=True)
class Cost:
    """How `extrags.run_costs` models the time and memory of a task.

    Args:
        terms: products of numbers of `extrags.run_costs.Workload`, whose sum the time is. Terms that records
            cannot tell apart (one number of iterations only) must not be there: the fit would give one of
            them the part of the other. What was measured by itself, as the runs of the restoring network
            beyond the first, is in `run_costs.json` alone.
        runs: whether the task runs with given settings.
        repeats: how often it runs.
        charged_to: the stage whose cost it is part of, where that is another than the one that runs it.
        includes: tasks whose time on record is added to this one's.
        shares: shares of tasks in the time, where one model stands for several.
        renders: whether its time is that of the rasteriser.
        on_device: whether it works on the run's device (`device`): what it takes on a GPU is another thing.
        restores: whether it prepares the restorer of `enhance.backend`, or runs it.
        of_final_scene: whether its memory depends on the Gaussians of the final scene, not of the coarse one.
        unfitted: why the packaged model has no coefficients of it; empty where it has.
        usual_s: then, processor time for a recording of the phantom in seconds; None where no number is
            needed, or one number is not enough.
    """

    terms: tuple[str, ...] = ("one",)
    runs: Callable[[PipelineConfig], bool] = _always
    repeats: Repeats = "once"
    charged_to: StageName | None = None
    includes: tuple[str, ...] = ()
    shares: Mapping[str, float] = field(default_factory=dict)
    renders: bool = False
    on_device: bool = False
    restores: bool = False
    of_final_scene: bool = False
    unfitted: str = ""
    usual_s: float | None = None


@dataclass(frozen=True, kw_only=True)
class StageTask:
    """A cached task of a stage: one kind of artefact in the store.

    Args:
        name: as in `tasks.stage.stage`, and so in cache keys.
        cost: how its cost is modelled; else, in words, why it is not.
        in_place: whether it makes, in place of the task that has the stage's name, what completes the stage.
        shared: whether several stages run it, so that it does not tell how far a run has come.
        in_parallel: whether several of it run at once: the count of one says nothing about the stage.
        several_loops: whether it counts one thing after another: no count tells how far it is.
        intermediate: whether it only serves to make another artefact of this stage, which other runs share.
    """

    name: str
    cost: Cost | str
    in_place: bool = False
    shared: bool = False
    in_parallel: bool = False
    several_loops: bool = False
    intermediate: bool = False


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A stage of the pipeline; in `Pipeline` and its subclasses the method of the same name.

    Args:
        name: identifier.
        tasks: that it consists of. Where one has the stage's name, its artefact completes the stage.
        page_parts: artefacts that a run keeps of it and its page shows.
        other_parts: artefacts that a run keeps of it beside these.
        needs: the stage that it cannot do without, besides the indispensable ones; skipped with it.
        indispensable: whether every other stage rests on it.
        planned: whether the scene plan decides about it.
        needs_gaussians: whether it is skipped where the scene is a radiance field.
        counted: whether its time is part of a method's run time.
        costs_by_settings: whether costs, its own or those of other stages, are modelled by its settings.
    """

    name: StageName
    tasks: tuple[StageTask, ...]
    page_parts: tuple[Part, ...] = ()
    other_parts: tuple[Part, ...] = ()
    needs: StageName | None = None
    indispensable: bool = False
    planned: bool = False
    needs_gaussians: bool = False
    counted: bool = True
    costs_by_settings: bool = False
