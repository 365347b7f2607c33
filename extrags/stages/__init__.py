"""What a stage is, in one table: what it needs, its tasks and what they cost, and what it makes.

`REGISTRY` describes the stages in the order they run. Who skips, expects, counts, shows or looks up stages
derives from it; a new stage is described there, and has its code in the places that docs/extending.md lists.

This package loads nothing: flows, the command line and the store read it in processes without libraries.
"""

from extrags.stages.description import Cost, Part, Repeats, Stage, StageName, StageTask
from extrags.stages.registry import (
    PAGES_OF_SEVERAL,
    REGISTRY,
    STAGES,
    all_tasks,
    cost_of,
    leading_to,
    modelled_tasks,
    stage_named,
    stage_of_task,
    stages_until,
)

__all__ = [
    "PAGES_OF_SEVERAL",
    "REGISTRY",
    "STAGES",
    "Cost",
    "Part",
    "Repeats",
    "Stage",
    "StageName",
    "StageTask",
    "all_tasks",
    "cost_of",
    "leading_to",
    "modelled_tasks",
    "stage_named",
    "stage_of_task",
    "stages_until",
]
