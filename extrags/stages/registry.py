"""The stages there are, in the order they run, and how they are looked up."""

from __future__ import annotations

from extrags.errors import ConfigError
from extrags.stages.description import Cost, Stage, StageName, StageTask

__all__ = [
    "PAGES_OF_SEVERAL",
    "REGISTRY",
    "STAGES",
    "all_tasks",
    "cost_of",
    "leading_to",
    "modelled_tasks",
    "stage_named",
    "stage_of_task",
    "stages_until",
]

REGISTRY: tuple[Stage, ...] = (
    Stage(
        name="ingest",
        indispensable=True,
        page_parts=("sequence",),
        other_parts=("ingest",),
        tasks=(
            StageTask(
                name="ingest",
                cost=Cost(
                    terms=(
                        "one",
                        "frames",
                        "frames*pixels",
                        # Corrections are looked for in a bounded number of pairs of frames.
                        "known_depth",
                        "known_depth*files",
                        "known_depth*test*pixels",
                        "drawn*frames*pixels",
                        "looked_at",
                        "looked_at*source_pixels",
                    )
                ),
            ),
        ),
    ),
    Stage(
        name="poses",
        costs_by_settings=True,
        other_parts=("poses",),
        tasks=(
            StageTask(
                name="poses",
                # Of one attempt: whether COLMAP needs a second one is not known before.
                cost=Cost(terms=("frames*feature_pixels", "pairs*features*features", "train*train")),
            ),
        ),
    ),
    Stage(
        name="depth",
        costs_by_settings=True,
        page_parts=("depth",),
        tasks=(
            StageTask(
                name="depth",
                cost=Cost(
                    terms=(
                        "train",
                        "train*pixels",
                        "train*matched_pixels",
                        "train*matched_pixels*hypotheses",
                    )
                ),
            ),
        ),
    ),
    Stage(
        name="coarse",
        indispensable=True,
        costs_by_settings=True,
        page_parts=("coarse",),
        other_parts=("training",),
        tasks=(
            StageTask(
                name="training-frames",
                shared=True,
                cost=Cost(terms=("one", "train*pixels"), charged_to="ingest"),
            ),
            StageTask(
                name="depth-frames",
                shared=True,
                cost=Cost(charged_to="depth", unfitted="it takes hardly any time"),
            ),
            StageTask(name="refined-frames", shared=True, cost="it takes hardly any time"),
            StageTask(
                name="coarse",
                cost=Cost(
                    terms=(
                        "one",
                        "train*pixels",
                        "iterations",
                        "iterations*pixels",
                        "iterations*gaussians",
                        "iterations*coefficients",
                    ),
                    renders=True,
                    on_device=True,
                ),
            ),
            StageTask(name="continued-coarse", in_place=True, cost="it depends on the scene it goes on from"),
            StageTask(name="import-scene", in_place=True, cost="it reads a file"),
            StageTask(name="uc-nerf", in_place=True, cost="a baseline's, of which there are no records"),
        ),
    ),
    Stage(
        name="assess",
        needs_gaussians=True,
        page_parts=("plan",),
        other_parts=("assess",),
        tasks=(
            StageTask(name="assess", cost=Cost(terms=("one", "gaussians"), renders=True, on_device=True)),
            StageTask(name="plan", cost=Cost()),
        ),
    ),
    Stage(
        name="surface",
        planned=True,
        needs_gaussians=True,
        page_parts=("surface",),
        tasks=(
            StageTask(name="surface", cost=Cost(terms=("one", "train*pixels", "gaussians"), renders=True)),
        ),
    ),
    Stage(
        name="freespace",
        needs="surface",
        planned=True,
        needs_gaussians=True,
        page_parts=("freespace",),
        tasks=(StageTask(name="freespace", cost=Cost(terms=("one", "gaussians"), renders=True)),),
    ),
    Stage(
        name="explore",
        needs="freespace",
        planned=True,
        needs_gaussians=True,
        costs_by_settings=True,
        page_parts=("explore",),
        other_parts=("waves",),
        tasks=(
            StageTask(name="explore-start", cost="it counts in explore"),
            StageTask(name="explore-branch", in_parallel=True, cost="it counts in explore"),
            StageTask(name="explore-merge", cost="it counts in explore"),
            StageTask(
                name="explore",
                cost=Cost(
                    terms=("branches", "branches*gaussians"),
                    includes=("explore-start", "explore-branch", "explore-merge"),
                    renders=True,
                ),
            ),
        ),
    ),
    Stage(
        name="enhance",
        needs="explore",
        planned=True,
        needs_gaussians=True,
        costs_by_settings=True,
        page_parts=("enhance",),
        other_parts=("restorer",),
        tasks=(
            StageTask(
                name="enhance-train",
                several_loops=True,
                cost=Cost(
                    terms=(
                        "one",
                        "train*pixels",
                        "restored",
                        "fold_iterations",
                        "fold_iterations*restored",
                        "fold_iterations*gaussians",
                        "judge_pairs*restored",
                    ),
                    # Blending and filling need no preparation.
                    runs=lambda config: config.enhance.backend != "classical",
                    restores=True,
                    on_device=True,
                ),
            ),
            StageTask(name="enhance-keyframes", cost="it has a share of the time of enhance"),
            StageTask(name="enhance-restore", in_parallel=True, cost="it counts in enhance"),
            StageTask(
                name="enhance",
                cost=Cost(
                    terms=("one", "views", "views*restored", "views*restored*samples"),
                    includes=("enhance-restore",),
                    shares={"enhance-keyframes": 0.1, "enhance-restore": 0.8, "enhance": 0.1},
                    restores=True,
                ),
            ),
        ),
    ),
    Stage(
        name="finetune",
        planned=True,
        needs_gaussians=True,
        costs_by_settings=True,
        page_parts=("finetune",),
        other_parts=("judgement",),
        tasks=(
            StageTask(
                name="finetune-judge",
                several_loops=True,
                cost=Cost(
                    terms=(
                        "train*pixels",
                        "judge_iterations",
                        "judge_iterations*pixels",
                        "judge_iterations*gaussians",
                        "judge_iterations*final_gaussians",
                    ),
                    runs=lambda config: config.finetune.judge.enabled,
                    renders=True,
                    restores=True,
                    on_device=True,
                ),
            ),
            StageTask(
                name="finetune",
                cost=Cost(
                    terms=(
                        "train*pixels",
                        "tuning",
                        "tuning*pixels",
                        "tuning*restored",
                        "tuning*final_gaussians",
                    ),
                    renders=True,
                    of_final_scene=True,
                    on_device=True,
                ),
            ),
        ),
    ),
    Stage(
        name="evaluate",
        counted=False,
        page_parts=(
            "renders_coarse",
            "renders_final",
            "renders_restored",
            "metrics_coarse",
            "metrics_final",
            "metrics_restored",
        ),
        tasks=(
            StageTask(name="uc-nerf-render", cost="a baseline's, of which there are no records"),
            StageTask(
                name="evaluate-render",
                cost=Cost(
                    terms=("test", "test*pixels"),
                    repeats="scenes",
                    renders=True,
                    of_final_scene=True,
                    on_device=True,
                ),
            ),
            StageTask(
                name="evaluate-restore",
                cost=Cost(
                    terms=("test*pixels", "test*restored"),
                    runs=lambda config: config.evaluate.restored != "none",
                    repeats="restored",
                    restores=True,
                    of_final_scene=True,
                ),
            ),
            StageTask(
                name="evaluate-views",
                intermediate=True,
                cost=Cost(
                    terms=("test*pixels*stacks", "test*pixels*vgg*passes"),
                    of_final_scene=True,
                    on_device=True,
                ),
            ),
            StageTask(name="evaluate", cost=Cost(repeats="measured", of_final_scene=True, on_device=True)),
        ),
    ),
    Stage(
        name="report",
        counted=False,
        other_parts=("report",),
        tasks=(
            StageTask(
                name="report",
                cost=Cost(
                    terms=("one", "frames*pixels"),
                    unfitted="what it takes depends on what there is to be shown",
                    usual_s=4.0,
                ),
            ),
        ),
    ),
)
"""All stages, in the order they run."""

STAGES: tuple[StageName, ...] = tuple(stage.name for stage in REGISTRY)
"""Their names."""

PAGES_OF_SEVERAL = ("dataset-report", "benchmark-report")
"""Tasks beside the stages: pages of several sequences."""


def stage_named(name: str) -> Stage:
    """The stage of a name.

    Raises:
        ConfigError: for an unknown stage; lists the valid names.
    """
    for stage in REGISTRY:
        if stage.name == name:
            return stage
    raise ConfigError(f"no stage {name!r}; known: {', '.join(STAGES)}")


def stages_until(until: str) -> tuple[StageName, ...]:
    """The stages of a run that ends with a stage, that one included.

    Raises:
        ConfigError: for an unknown stage; lists the valid names.
    """
    return STAGES[: REGISTRY.index(stage_named(until)) + 1]


def leading_to(stage: StageName) -> tuple[StageName, ...]:
    """A stage and those it cannot do without, in the order they run; not the indispensable ones."""
    needed = stage_named(stage).needs
    return (stage,) if needed is None else (*leading_to(needed), stage)


def all_tasks() -> tuple[StageTask, ...]:
    """The tasks of all stages."""
    return tuple(task for stage in REGISTRY for task in stage.tasks)


def stage_of_task(task: str) -> Stage | None:
    """The stage that a task belongs to; None for a task that is not in the registry."""
    return next((stage for stage in REGISTRY if task in {own.name for own in stage.tasks}), None)


def cost_of(task: str) -> Cost:
    """How the cost of a task is modelled; as a constant where nothing is said of it."""
    found = next((own.cost for own in all_tasks() if own.name == task), None)
    return found if isinstance(found, Cost) else Cost()


def modelled_tasks(stage: str) -> dict[str, Cost]:
    """By name: the tasks whose cost is modelled and part of a stage's, in the order they run.

    Raises:
        ConfigError: for an unknown stage; lists the valid names.
    """
    wanted = stage_named(stage).name
    return {
        task.name: task.cost
        for owner in REGISTRY
        for task in owner.tasks
        if isinstance(task.cost, Cost) and (task.cost.charged_to or owner.name) == wanted
    }
