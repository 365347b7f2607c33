"""One sequence through all stages: which artefact goes where, what is skipped and why."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from data_catalog.catalog import resolve, source_fingerprint
from extrags.config import PipelineConfig
from extrags.errors import ExtragsError
from extrags.store import Manifest, Ref, Store
from flows.outcome import SequenceOutcome, StageRow
from flows.runners import Call, NotInStoreError, Runner
from flows.settings import STAGES
from tasks.assess import PLAN, assess, plan
from tasks.coarse import coarse, refined_frames
from tasks.enhance import assemble, restore, train
from tasks.evaluate import measure, render
from tasks.explore import NEXT, branch, explore, merge, start
from tasks.finetune import finetune
from tasks.freespace import freespace
from tasks.ingest import ingest, training_frames
from tasks.poses import poses
from tasks.progress import StageProgress, notify
from tasks.report import report
from tasks.surface import surface
from tasks.weights import Weights, lpips_weights, restorer_digest

__all__ = ["SequenceRun", "run_sequence"]

log = logging.getLogger(__name__)


class _StoppedError(Exception):
    """A stage failed; its row is written already."""


def run_sequence(
    name: str,
    config: PipelineConfig,
    store: str,
    runner: Runner,
    *,
    profile: str = "",
    until: str = "report",
    leave_out: Mapping[str, str] | None = None,
) -> SequenceOutcome:
    """Take one sequence through all stages.

    A failing stage ends the sequence; what is finished stays in the store, so that the next run goes on
    there. The failure is in the outcome and is not raised.

    Args:
        name: `DATASET/SEQUENCE[@SETTING]` or a path.
        config: settings of all stages.
        store: root of the store.
        runner: how artefacts are made.
        profile: name of the profile the settings come from, for the report.
        until: last stage to run.
        leave_out: stages among the planned ones to leave out whatever the plan says, with the reason.
            Fine-tuning without `enhance` uses real views alone: the control of a comparison.

    Raises:
        NotInStoreError: from a runner that only looks.
    """
    return SequenceRun(name, config, store, runner, profile, leave_out=leave_out).run(until)


class SequenceRun:
    """The wiring of one sequence.

    Args:
        name: `DATASET/SEQUENCE[@SETTING]` or a path.
        config: settings of all stages.
        store: root of the store.
        runner: how artefacts are made.
        profile: name of the profile the settings come from, for the report.
        leave_out: see `run_sequence`.
    """

    def __init__(
        self,
        name: str,
        config: PipelineConfig,
        store: str,
        runner: Runner,
        profile: str = "",
        *,
        leave_out: Mapping[str, str] | None = None,
    ) -> None:
        self.outcome = SequenceOutcome(name)
        self.config = config
        self.store = Store(store)
        self.runner = runner
        self.profile = profile
        self.leave_out = dict(leave_out or {})
        self.refs: dict[str, Ref] = {}

    def run(self, until: str = "report") -> SequenceOutcome:
        """All stages up to one; see `run_sequence`."""
        begun = time.monotonic()
        steps = {
            "ingest": self._ingest,
            "poses": self._poses,
            "coarse": self._coarse,
            "assess": self._assess,
            "surface": self._surface,
            "freespace": self._freespace,
            "explore": self._explore,
            "enhance": self._enhance,
            "finetune": self._finetune,
            "evaluate": self._evaluate,
            "report": self.report,
        }
        try:
            for stage in STAGES[: STAGES.index(until) + 1]:
                steps[stage]()
        except _StoppedError:
            self.outcome.status = "failed"
            done = {row.stage for row in self.outcome.stages}
            failed = self.outcome.stages[-1].stage
            for stage in STAGES[: STAGES.index(until) + 1]:
                if stage not in done:
                    self._skip(stage, f"{failed} failed")
        self.outcome.seconds = time.monotonic() - begun
        self.outcome.artefacts = {stage: ref.uri for stage, ref in self.refs.items()}
        self.outcome.digests = {stage: ref.digest for stage, ref in self.refs.items()}
        return self.outcome

    # Each stage below is one method; `self.refs` holds what it made.

    def _ingest(self) -> None:
        with self._stage("ingest") as row:
            source = resolve(self.outcome.name)
            fingerprint = source_fingerprint(source, self.config.ingest)
            inputs = {"source": source, "fingerprint": fingerprint, "config": self.config.ingest}
            self.refs["ingest"] = self.refs["sequence"] = self._one(row, Call(ingest, inputs))

    def _poses(self) -> None:
        if self._manifest("sequence").counts["has_poses"] and not self.config.poses.replace_given:
            self._skip("poses", "the source has poses")
            return
        with self._stage("poses") as row:
            inputs = {"sequence": self.refs["sequence"], "config": self.config.poses}
            self.refs["poses"] = self.refs["sequence"] = self._one(row, Call(poses, inputs))
            row.reason = str(self._manifest("poses").counts["summary"])

    def _coarse(self) -> None:
        with self._stage("coarse") as row:
            # Only the training frames go on from here. Cutting them out takes no time, and does not count
            # when it comes to whether the stage ran.
            call = Call(training_frames, {"sequence": self.refs["sequence"]})
            (part,) = self.runner.run([call], self.outcome.name)
            self.refs["training"] = part.ref
            inputs = {"sequence": self.refs["training"], "config": self.config.coarse}
            self.refs["coarse"] = self._one(row, Call(coarse, inputs))
            if self._manifest("coarse").counts.get("refined_poses"):
                # The scene belongs to the corrected poses: all that follows takes those.
                inputs = {"sequence": self.refs["sequence"], "coarse": self.refs["coarse"]}
                (whole,) = self.runner.run([Call(refined_frames, inputs)], self.outcome.name)
                call = Call(training_frames, {"sequence": whole.ref})
                (part,) = self.runner.run([call], self.outcome.name)
                self.refs["sequence"], self.refs["training"] = whole.ref, part.ref
                counts = self._manifest("coarse").counts
                row.reason = f"poses refined, by {counts['refined_mean_turn_deg']:.2f} degrees on average"

    def _assess(self) -> None:
        with self._stage("assess") as row:
            inputs = {**self._scene_inputs(), "config": self.config.assess}
            self.refs["assess"] = self._one(row, Call(assess, inputs))
            # The decisions follow from the measurement and all budgets. They take no time, and do not
            # count when it comes to whether the stage ran.
            inputs = {"measured": self.refs["assess"], "config": self.config}
            (decided,) = self.runner.run([Call(plan, inputs)], self.outcome.name)
            self.refs["plan"] = decided.ref
            self.outcome.plan = self._json("plan", PLAN)
        self._apply_budgets()

    def _surface(self) -> None:
        with self._planned("surface") as row:
            if row is not None:
                inputs = {**self._scene_inputs(), "config": self.config.surface}
                self.refs["surface"] = self._one(row, Call(surface, inputs))

    def _freespace(self) -> None:
        with self._planned("freespace") as row:
            if row is not None:
                inputs = {
                    **self._scene_inputs(),
                    "surface": self.refs["surface"],
                    "config": self.config.freespace,
                }
                self.refs["freespace"] = self._one(row, Call(freespace, inputs))

    def _explore(self) -> None:
        with self._planned("explore") as row:
            if row is None:
                return
            shared = {
                **self._scene_inputs(),
                "freespace": self.refs["freespace"],
                "config": self.config.explore,
            }
            self.refs["waves"] = self._one(row, Call(start, shared))
            while anchors := self._json("waves", NEXT)["anchors"]:
                state = self.refs["waves"]
                calls = [Call(branch, {**shared, "state": state, "anchor": anchor}) for anchor in anchors]
                branches = self._all(row, calls)
                self.refs["waves"] = self._one(row, Call(merge, {"state": state, "branches": branches}))
                accepted = self._json("waves", NEXT)["accepted"]
                self._tell(row, "running", accepted, self.config.explore.trajectories)
            self.refs["explore"] = self._one(row, Call(explore, {**shared, "state": self.refs["waves"]}))

    def _enhance(self) -> None:
        with self._planned("enhance") as row:
            if row is None:
                return
            found = self._manifest("explore").counts
            if not found["virtual_views"]:
                self._turn_to_skip(row, "exploration found no view that adds anything")
                return
            settings = self.config.enhance
            inputs = {
                **self._scene_inputs(),
                "config": settings,
                "coarse": self.config.coarse,
                "model_digest": restorer_digest(settings),
            }
            self.refs["restorer"] = self._one(row, Call(train, inputs))
            weights = self._weights()
            shared = {
                **self._scene_inputs(),
                "explore": self.refs["explore"],
                "restorer": self.refs["restorer"],
                "config": settings,
                "weights_digest": weights.digest,
                "weights": weights,
            }
            batches = -(-int(found["trajectories"] or 0) // settings.clips_per_batch)
            parts = self._all(row, [Call(restore, {**shared, "batch": batch}) for batch in range(batches)])
            self.refs["enhance"] = self._one(row, Call(assemble, {"parts": parts}))

    def _finetune(self) -> None:
        with self._planned("finetune") as row:
            if row is None:
                return
            if "enhance" not in self.refs and "enhance" not in self.leave_out:
                self._turn_to_skip(row, "there are no virtual views")
                return
            inputs = {
                **self._scene_inputs(),
                "pseudo": self.refs.get("enhance"),
                "config": self.config.finetune,
                "coarse": self.config.coarse,
            }
            self.refs["finetune"] = self._one(row, Call(finetune, inputs))

    def _evaluate(self) -> None:
        if not self._manifest("sequence").counts["test"]:
            self._skip("evaluate", "the sequence has no held-out frames")
            return
        with self._stage("evaluate") as row:
            scenes = {"coarse": self.refs["coarse"]}
            if "finetune" in self.refs:
                scenes["final"] = self.refs["finetune"]
            sequence = self.refs["sequence"]
            renders = self._all(
                row, [Call(render, {"scene": scene, "sequence": sequence}) for scene in scenes.values()]
            )
            weights = self._weights()
            settings = {"net": weights.net, "weights_digest": weights.digest, "weights": weights}
            measured = self._all(
                row, [Call(measure, {"renders": ref, "sequence": sequence, **settings}) for ref in renders]
            )
            for which, shown, figures in zip(scenes, renders, measured, strict=True):
                self.refs[f"renders_{which}"] = shown
                self.refs[f"metrics_{which}"] = figures
                self.outcome.metrics[which] = self._json(f"metrics_{which}", "metrics.json")["metrics"]
            if "final" not in scenes:
                # Nothing was fine-tuned: the coarse scene is the final one.
                self.outcome.metrics["final"] = self.outcome.metrics["coarse"]

    def report(self) -> None:
        """Build the page from what the other stages made."""
        with self._stage("report") as row:
            parts = {name: ref for name, ref in self.refs.items() if name in REPORT_PARTS}
            skipped = {item.stage: item.reason for item in self.outcome.stages if item.state == "skipped"}
            inputs = {
                "parts": parts,
                "skipped": skipped,
                "config": self.config,
                "profile": self.profile,
                "rows": [item.to_json() for item in self.outcome.stages if item.stage != "report"],
            }
            self.refs["report"] = self._one(row, Call(report, inputs))
            self.outcome.report = f"{self.refs['report'].uri}/report.html"

    # Helpers.

    def _scene_inputs(self) -> dict[str, Any]:
        return {"scene": self.refs["coarse"], "sequence": self.refs["training"]}

    def _weights(self) -> Weights:
        return lpips_weights(self.config.evaluate)

    def _one(self, row: StageRow, call: Call) -> Ref:
        return self._all(row, [call])[0]

    def _all(self, row: StageRow, calls: list[Call]) -> list[Ref]:
        results = self.runner.run(calls, self.outcome.name)
        for result in results:
            manifest = self.store.manifest(result.ref)
            peak = manifest.counts.get("peak_mib")
            if isinstance(peak, float):
                row.peak_mib = max(row.peak_mib or 0.0, peak)
            row.made_seconds += manifest.seconds
            row.tasks += 1
            if result.state == "ran":
                row.state = "ran"
        return [result.ref for result in results]

    def _manifest(self, name: str) -> Manifest:
        return self.store.manifest(self.refs[name])

    def _json(self, name: str, file: str) -> Any:
        return json.loads((self.store.open(self.refs[name]) / file).read_bytes())

    @contextmanager
    def _stage(self, stage: str) -> Iterator[StageRow]:
        """One row of the outcome: timed, announced, and marked when the block raises."""
        row = self.outcome.row(stage)
        if row is None:
            row = StageRow(stage, "cached")
            self.outcome.stages.append(row)
        self._tell(row, "running")
        begun = time.monotonic()
        try:
            yield row
        except NotInStoreError:
            raise
        except Exception as error:
            row.state = "failed"
            row.reason = str(error) if isinstance(error, ExtragsError) else f"{type(error).__name__}: {error}"
            self.outcome.error = error
            raise _StoppedError from error
        finally:
            row.seconds += time.monotonic() - begun
            self._tell(row, row.state)

    @contextmanager
    def _planned(self, stage: str) -> Iterator[StageRow | None]:
        """As `_stage`, or None when the plan leaves the stage out."""
        if stage in self.leave_out:
            self._skip(stage, self.leave_out[stage])
            yield None
            return
        decision = next(
            (line for line in (self.outcome.plan or {})["decisions"] if line["stage"] == stage), None
        )
        if decision is not None and not decision["run"] and not self.leave_out:
            self._skip(stage, decision["reason"])
            yield None
            return
        with self._stage(stage) as row:
            row.reason = "" if decision is None else decision["reason"]
            yield row

    def _skip(self, stage: str, reason: str) -> None:
        row = StageRow(stage, "skipped", reason=reason)
        self.outcome.stages.append(row)
        self._tell(row, "skipped")

    def _turn_to_skip(self, row: StageRow, reason: str) -> None:
        row.state = "skipped"
        row.reason = reason

    def _tell(self, row: StageRow, state: str, done: int = 0, total: int = 0) -> None:
        reason = row.reason if state in ("skipped", "failed") else ""
        notify(StageProgress(self.outcome.name, row.stage, state, done, total, reason, row.seconds))

    def _apply_budgets(self) -> None:
        """Put the plan's budgets into the settings of the stages that follow."""
        budgets = {
            f"{line['stage']}.{setting}": value
            for line in (self.outcome.plan or {})["decisions"]
            for setting, value in line["budget"].items()
        }
        self.config = self.config.with_overrides(budgets)


REPORT_PARTS = frozenset(
    {
        "sequence",
        "coarse",
        "plan",
        "surface",
        "freespace",
        "explore",
        "enhance",
        "finetune",
        "renders_coarse",
        "renders_final",
        "metrics_coarse",
        "metrics_final",
    }
)
