"""A run of all stages without any of them: a runner that notes keys, and a store of made-up artefacts.

The digest of a made-up artefact comes from its key, so that a key that changes changes the keys of all stages
that follow. The plan alone is made as it is, since later stages read their budgets from it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from typing import Any
from unittest.mock import patch

from extrags.config import PipelineConfig
from extrags.finetuning_judgement import Judgement
from extrags.scene_plan import ScenePlan, decide
from extrags.store import Manifest, Ref, digest_of
from flows.outcome import SequenceOutcome
from flows.runners import Call, Result
from flows.wiring import SequenceRun
from tasks.evaluate import METRICS_FILE
from tasks.explore import NEXT_ANCHORS
from tasks.stage import stage_key

LACKING = {"lacking_share": 0.04}
"""What the assessment measured: the plan then takes 11 of 20 trajectories."""


KEPT = Judgement(1.0, "made up")
"""A judgement that keeps everything."""


class RecordedRun:
    """Runner and store in one.

    Args:
        has_poses: whether the source has poses.
        has_depth: whether the source has depth.
        judgement: of the fine-tuning.
    """

    def __init__(self, *, has_poses: bool, has_depth: bool, judgement: Judgement) -> None:
        self.judgement = judgement
        self.inputs: dict[str, dict[str, Any]] = {}
        self.keys: dict[str, list[str]] = defaultdict(list)
        self.plans: dict[str, ScenePlan] = {}
        self.counts: dict[str, Any] = {
            "has_poses": int(has_poses),
            "has_depth": int(has_depth),
            "summary": "made up",
            "width": 160,
            "height": 128,
            "frames": 24,
            "train": 20,
            "test": 4,
            "trajectories": 8,
            "virtual_views": 100,
            "n_gaussians": 1000,
            "sh_degree": 1,
            "has_light": 0,
        }

    def run(self, calls: Sequence[Call], label: str) -> list[Result]:
        """Note the keys."""
        return [Result(self._made(call), "ran") for call in calls]

    def _made(self, call: Call) -> Ref:
        key = stage_key(call.task, call.inputs)
        self.keys[call.task.name].append(key)
        self.inputs[call.task.name] = call.inputs
        ref = Ref(uri=f"made-up/{key}", digest=digest_of(key))
        if call.task.name == "plan":
            made = decide(LACKING, call.inputs["config"])
            ref = Ref(uri=ref.uri, digest=digest_of(made.model_dump(mode="json")))
            self.plans[ref.uri] = made
        return ref

    def find(self, key: str) -> Ref | None:
        """Nothing is there."""
        return None

    def manifest(self, ref: Ref) -> Manifest:
        """One for all."""
        # One wave of two branches.
        counts = {**self.counts, NEXT_ANCHORS: "3 7" if "explore-start" in ref.uri else "", "accepted": 0}
        return Manifest(stage="made-up", version=1, key=ref.uri, digest=ref.digest, counts=counts)

    def load(self, kind: type, ref: Ref) -> Any:
        """The plan, or the judgement."""
        return self.judgement if kind is Judgement else self.plans[ref.uri]

    def load_json(self, file: str, ref: Ref) -> Any:
        """No figures."""
        return {METRICS_FILE: {"metrics": {}}}[file]


def recorded_keys(
    name: str,
    config: PipelineConfig,
    *,
    has_poses: bool = False,
    has_depth: bool = False,
    leave_out: Mapping[str, str] | None = None,
) -> dict[str, list[str]]:
    """The keys of all stages of a sequence, by the stage's name; nothing is run, and all is judged well.

    Args:
        name: of the sequence; its content is looked at as in any run.
        config: settings of all stages.
        has_poses: whether the source shall have poses.
        has_depth: whether it shall have depth.
        leave_out: see `extrags.pipeline.Pipeline`.

    Raises:
        Exception: what a stage failed with.
    """
    recorded = RecordedRun(has_poses=has_poses, has_depth=has_depth, judgement=KEPT)
    recorded_run(name, config, recorded, leave_out)
    return dict(recorded.keys)


def recorded_run(
    name: str, config: PipelineConfig, recorded: RecordedRun, leave_out: Mapping[str, str] | None = None
) -> SequenceOutcome:
    """Go through all stages of a sequence; the arguments are those of `recorded_keys`.

    Raises:
        Exception: what a stage failed with.
    """
    run = SequenceRun(name, config, "memory://made-up", recorded, leave_out=leave_out)
    run.store = recorded  # type: ignore[assignment]
    # Nothing is kept of it.
    with patch("flows.cached_stages.recorded_run", lambda *_: nullcontext()):
        outcome = run.run()
    if outcome.error is not None:
        raise outcome.error
    return outcome
