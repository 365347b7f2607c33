"""The stages of a sequence: what runs them, and which of them run.

`extrags.stages` has the order of the stages, `Pipeline` alone the rules by which one is skipped. It has two
subclasses: `extrags.in_memory_pipeline.InMemoryPipeline`, behind `run_pipeline`, calls the library and keeps
the results in memory; `flows.wiring.SequenceRun` computes the same results as cached tasks, with the same
functions of the library.

This module loads nothing heavy by itself, so that flows and the command line can read the rules.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

from extrags.config import PipelineConfig
from extrags.errors import ConfigError
from extrags.stages import REGISTRY, STAGES, StageName, leading_to, stage_named, stages_until

if TYPE_CHECKING:
    from extrags.scene_plan import Decision, ScenePlan

__all__ = [
    "HELD_OUT_TRAINED_ON",
    "NO_GAUSSIANS",
    "Pipeline",
    "needs_plan",
    "stages_that_can_run",
]

log = logging.getLogger(__name__)

HELD_OUT_TRAINED_ON = "oracle: held-out frames were trained on"
"""Said wherever figures of such a scene are shown."""

NO_GAUSSIANS = "the scene is a radiance field, and the stage needs Gaussians"
"""Why stages that need some are skipped then."""


class Pipeline(ABC):
    """The stages of one sequence in their order, and the rules by which one is skipped.

    A subclass implements each stage in a method of the stage's name, and the properties the rules depend on.

    Args:
        config: settings of all stages; the plan's budgets are applied to them after `assess`.
        leave_out: stages to skip regardless of the plan, with the reason.

    Raises:
        ConfigError: for a stage that does not exist, or that cannot be left out; for a reconstruction from
            held-out frames (`coarse.train_on`) that a later stage or refined poses would rest on; for
            settings that an imported scene makes meaningless.
    """

    def __init__(self, config: PipelineConfig, leave_out: Mapping[str, str] | None = None) -> None:
        self.config = config = config.with_run_device()
        self.leave_out = dict(leave_out or {})
        self.plan: ScenePlan | None = None
        self.skipped: set[StageName] = set()
        for stage in self.leave_out:
            if stage_named(stage).indispensable:
                raise ConfigError(f"the stage {stage} cannot be left out: everything rests on it")
        config.check_imported()
        if config.coarse.train_on == "all":
            resting: list[str] = [
                stage.name for stage in REGISTRY if stage.planned and stage.name not in self.leave_out
            ]
            resting += ["coarse.refine_poses"] if config.coarse.refine_poses is True else []
            if resting:
                raise ConfigError(
                    "coarse.train_on is all: held-out frames are trained on, so nothing may rest on the "
                    f"coarse scene but its evaluation, and {', '.join(resting)} would; the method oracle is "
                    "such a run"
                )

    def run_stages(self, until: StageName = "report") -> None:
        """Run all stages up to and including one.

        Raises:
            ConfigError: for a stage that does not exist.
        """
        for stage in stages_until(until):
            reason = self.reason_to_skip(stage)
            if reason is None:
                getattr(self, stage)()
            else:
                self.skipped.add(stage)
                self.skip(stage, reason)
            if stage == "assess" and self.plan is not None:
                self.config = self.plan.applied_to(self.config)

    def reason_to_skip(self, stage: StageName) -> str | None:
        """Why a stage is skipped, or None if it runs; called after the stages before it have run."""
        if stage in self.leave_out:
            return self.leave_out[stage]
        if stage == "assess" and not needs_plan(self.leave_out):
            return "no stage of this run depends on the plan"
        described = stage_named(stage)
        if described.needs_gaussians and self.config.uc_nerf.enabled:
            return NO_GAUSSIANS
        planned = self.planned(stage)
        # Stages are left out to compare methods. The remaining stages then run regardless of the plan, so
        # that all methods are compared under the same conditions.
        if planned is not None and not planned.run and not self.leave_out:
            return planned.reason
        # A method that restores views and is left without any by another left-out stage has nothing to show;
        # without `enhance` among the stages, fine-tuning is a control on real views alone.
        lost = "enhance" not in self.leave_out and "enhance" in self.skipped
        if stage == "finetune" and lost and self.leave_out:
            return "there are no virtual views"
        if described.needs in self.skipped:
            return f"it needs the stage {described.needs}, which was skipped"
        if stage == "poses" and self.has_poses() and not self.config.poses.replace_given:
            unused = self.config.poses.working_distance_mm is not None
            return "the source has poses" + ("; poses.working_distance_mm is of no use" if unused else "")
        if stage == "depth":
            return _reason_to_skip_depth(self.config, self.has_depth(), self.training_frame_count())
        if stage == "enhance" and self.virtual_views() == 0:
            return "exploration found no view that adds anything"
        if stage == "evaluate" and self.held_out_frames() == 0:
            _, without_pose = self.frames_without_pose()
            if without_pose:
                return f"no pose was found for any of the {without_pose} held-out frames"
            return "the sequence has no held-out frames"
        return None

    def planned(self, stage: str) -> Decision | None:
        """The plan's decision on a stage; None for stages that are not planned."""
        lines = () if self.plan is None else self.plan.decisions
        return next((line for line in lines if line.stage == stage), None)

    @abstractmethod
    def skip(self, stage: StageName, reason: str) -> None:
        """Record that a stage is skipped."""

    @abstractmethod
    def has_poses(self) -> bool:
        """Whether the sequence has camera poses."""

    @abstractmethod
    def has_depth(self) -> bool:
        """Whether training frames have depth that is taken as it is, in the unit of the poses."""

    @abstractmethod
    def training_frame_count(self) -> int:
        """Number of training frames."""

    @abstractmethod
    def held_out_frames(self) -> int:
        """Number of held-out frames."""

    @abstractmethod
    def frames_without_pose(self) -> tuple[int, int]:
        """Numbers of training and of held-out frames that have left the sequence for want of a pose."""

    @abstractmethod
    def virtual_views(self) -> int:
        """Number of virtual views the exploration found."""

    @abstractmethod
    def ingest(self) -> None:
        """Read the source into an `EndoscopicSequence`."""

    @abstractmethod
    def poses(self) -> None:
        """Estimate camera poses."""

    @abstractmethod
    def depth(self) -> None:
        """Estimate depth of the training frames from these alone."""

    @abstractmethod
    def coarse(self) -> None:
        """Reconstruct the scene from the training frames."""

    @abstractmethod
    def assess(self) -> None:
        """Measure what the scene lacks and set `plan`."""

    @abstractmethod
    def surface(self) -> None:
        """Fuse a mesh from rendered depth."""

    @abstractmethod
    def freespace(self) -> None:
        """Carve the space virtual cameras may enter."""

    @abstractmethod
    def explore(self) -> None:
        """Search virtual trajectories."""

    @abstractmethod
    def enhance(self) -> None:
        """Restore the virtual views."""

    @abstractmethod
    def finetune(self) -> None:
        """Fine-tune the scene on real and restored views."""

    @abstractmethod
    def evaluate(self) -> None:
        """Measure coarse and final scene on the held-out frames."""

    @abstractmethod
    def report(self) -> None:
        """Write the HTML report of the run."""


def needs_plan(leave_out: Collection[str]) -> bool:
    """Whether a run that leaves these stages out depends on the plan.

    With any stage left out the plan skips none of the others (`Pipeline.reason_to_skip`). What it then still
    sets are the budgets of exploration and of what follows it.
    """
    return not leave_out or not {"assess", *leading_to("explore")}.intersection(leave_out)


def stages_that_can_run(
    config: PipelineConfig,
    leave_out: Collection[str],
    *,
    has_poses: bool,
    has_depth: bool,
    train: float,
    test: float,
) -> set[StageName]:
    """The stages that a run with these settings goes through, as far as its source tells.

    The rules are those of `Pipeline.reason_to_skip`; the plan, and an exploration that finds nothing, may
    skip more. An imported scene is read in the place of `coarse`, which is not among them: nothing is
    optimised.

    Args:
        config: settings of all stages.
        leave_out: stages that the method leaves out.
        has_poses: whether the source has camera poses.
        has_depth: whether training frames have depth that is taken as it is.
        train: number of training frames.
        test: number of held-out frames.
    """
    skipped: set[str] = set(leave_out)
    if not needs_plan(leave_out):
        skipped.add("assess")
    if has_poses and not config.poses.replace_given:
        skipped.add("poses")
    if _reason_to_skip_depth(config, has_depth, train) is not None:
        skipped.add("depth")
    if test == 0:
        skipped.add("evaluate")
    for stage in REGISTRY:
        if stage.needs in skipped or (stage.needs_gaussians and config.uc_nerf.enabled):
            skipped.add(stage.name)
    if leave_out and "enhance" not in leave_out and "enhance" in skipped:
        skipped.add("finetune")
    if config.imported.scene is not None:
        skipped.add("coarse")
    return set(STAGES).difference(skipped)


def _reason_to_skip_depth(config: PipelineConfig, has_depth: bool, train: float) -> str | None:
    if has_depth:
        return "the source has depth"
    if config.uc_nerf.enabled:
        return "the radiance field has a stereo of its own"
    if not config.depth.enabled:
        return "the settings do without it (depth.enabled)"
    if train < 2:
        return "a single training frame has no other to be matched with"
    return None
