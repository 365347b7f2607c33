"""The pipeline of one sequence as cached tasks: the inputs and artefacts of every stage."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from data_catalog.catalog import resolve, source_fingerprint
from extrags.config import PipelineConfig
from extrags.errors import DamagedArtefactError
from extrags.metrics.registry import added_metrics
from extrags.pipeline import HELD_OUT_TRAINED_ON
from extrags.stages import Part, StageName
from extrags.store import Ref, Slot
from flows.cached_stages import CachedStages
from flows.continuation import coarse_call
from flows.imported import imported_call, of_imported_scene
from flows.memory_limit import check_memory, made_stages
from flows.outcome import SequenceOutcome, StageRow
from flows.runners import Call, Runner, StoreRunner
from tasks.assess import assess, measuring_settings, plan, planning_settings
from tasks.coarse import coarse, refined_frames
from tasks.depth import depth, depth_frames, triangulation_settings
from tasks.depth import keyed_settings as keyed_depth_settings
from tasks.enhance import (
    assemble,
    judging_settings,
    keyframe_settings,
    keyframes,
    restore,
    restoring_settings,
    train,
)
from tasks.enhance import keyed_settings as keyed_enhance_settings
from tasks.evaluate import METRICS_FILE, measure, measure_views, render
from tasks.evaluate import restore as restore_renders
from tasks.evaluate import restoring_settings as renders_settings
from tasks.explore import branch, explore, merge, next_anchors, start
from tasks.finetune import finetune, finetuning_settings, judge
from tasks.freespace import freespace
from tasks.ingest import ingest, training_frames
from tasks.poses import estimating_settings, lens_settings, poses
from tasks.report import PAGE, REPORT_PARTS, ROWS, report
from tasks.stage import fill, stage_key
from tasks.surface import surface
from tasks.uc_nerf import render_uc_nerf, uc_nerf
from tasks.weights import (
    Weights,
    depth_completion_digest,
    depth_monocular_digest,
    lpips_weights,
    refiner_digest,
    restorer_digest,
)

__all__ = ["SequenceRun", "run_sequence"]


def run_sequence(
    name: str,
    config: PipelineConfig,
    store: str,
    runner: Runner,
    *,
    profile: str = "",
    until: StageName = "report",
    leave_out: Mapping[str, str] | None = None,
    memory_limit_gb: float | None = None,
    pinned: Collection[str] = (),
) -> SequenceOutcome:
    """Run all stages of one sequence.

    A failing stage ends the sequence; finished artefacts stay in the store, and the next run resumes there.
    The error is in the outcome, not raised. A damaged artefact is set aside and made anew (`flows.damage`).

    Args:
        name: `DATASET/SEQUENCE[@SETTING]` or a path.
        config: settings of all stages.
        store: root of the store.
        runner: how artefacts are made.
        profile: name of the profile the settings come from, for the report.
        until: last stage to run.
        leave_out: see `extrags.pipeline.Pipeline`.
        memory_limit_gb: see `flows.memory_limit.check_memory`.
        pinned: settings that the method sets itself (`flows.methods.pinned_settings`); see there, too.

    Raises:
        NotInStoreError: from a runner that only looks.
        ConfigError: for a stage that does not exist.
    """
    run, limit = SequenceRun(name, config, store, runner, profile, leave_out=leave_out), memory_limit_gb
    if not isinstance(runner, StoreRunner):
        made: set[str] = set()
        if limit is not None and not getattr(runner, "refresh", False):
            look = StoreRunner(store)
            made = made_stages(SequenceRun(name, config, store, look, leave_out=leave_out), until)
        run.check_frames = lambda told: check_memory(
            name, config, told, limit, until, run.leave_out, made, pinned
        )
    return run.run(until)


class SequenceRun(CachedStages):
    """The stages of one sequence as cached tasks: the inputs of each, and what it makes.

    The arguments are those of `run_sequence`.
    """

    _restored_shares: tuple[float, float] | None = None
    """Of restored views, where the scene knows the surface and elsewhere, from the judge of fine-tuning."""
    _source_name = ""
    """Of the source that was looked at; frames of equal content may have been read under another one."""

    def has_poses(self) -> bool:
        """Whether the source has camera poses."""
        return bool(self._manifest("sequence").counts["has_poses"])

    def has_depth(self) -> bool:
        """Whether training frames have depth that is taken as it is, in the unit of the poses."""
        counts = self._manifest("sequence").counts
        return bool(counts["has_depth"]) and not counts.get("depth_error")

    def training_frame_count(self) -> int:
        """Number of training frames."""
        return int(self._manifest("sequence").counts["train"] or 0)

    def held_out_frames(self) -> int:
        """Number of held-out frames."""
        return int(self._manifest("sequence").counts["test"] or 0)

    def frames_without_pose(self) -> tuple[int, int]:
        """Numbers of training and of held-out frames that have left the sequence for want of a pose."""
        given, left = (self._manifest(part).counts for part in ("ingest", "sequence"))
        train, test = (int(given[name] or 0) - int(left[name] or 0) for name in ("train", "test"))
        return train, test

    def virtual_views(self) -> int:
        """Number of virtual views the exploration found."""
        return int(self._manifest("explore").counts["virtual_views"] or 0)

    # Each stage below is one method; `self.refs` holds what it made.

    def ingest(self) -> None:
        """The source becomes the artefact `sequence`."""
        with self._stage("ingest") as row:
            source = resolve(self.outcome.name)
            self._source_name = source.name
            fingerprint = source_fingerprint(source, self.config.ingest)
            # The calibration file counts by its content, which is in the fingerprint.
            config = self.config.ingest.model_copy(update={"calibration": None})
            inputs = {
                "source": source,
                "fingerprint": fingerprint,
                "config": config,
                "calibration": self.config.ingest.calibration,
            }
            self.refs["ingest"] = self.refs["sequence"] = self._run_task(row, Call(ingest, inputs))
            self.check_frames(self._manifest("ingest").counts)

    def poses(self) -> None:
        """The artefact `sequence` again, with poses."""
        with self._stage("poses") as row:
            self.config.check_imported_has_cameras()
            config, ingest = estimating_settings(self.config.poses), lens_settings(self.config.ingest)
            inputs = {"sequence": self.refs["sequence"], "config": config, "ingest": ingest}
            self.refs["poses"] = self.refs["sequence"] = self._run_task(row, Call(poses, inputs))
            row.reason = str(self._manifest("poses").counts["summary"])

    def depth(self) -> None:
        """Depth of the training frames."""
        with self._stage("depth") as row:
            settings = self.config.depth
            inputs = {
                "sequence": self._run_uncounted(Call(training_frames, {"sequence": self.refs["sequence"]})),
                "config": keyed_depth_settings(settings),
                "features": triangulation_settings(self.config.poses),
                "weights_digest": depth_completion_digest(settings),
                # The network counts by its content; where it lies is not part of the key.
                "monocular_digest": depth_monocular_digest(settings.monocular),
                "monocular": settings.monocular,
                "completion": settings.completion,
            }
            self.refs["depth"] = self._run_task(row, Call(depth, inputs))
            row.reason = str(self._manifest("depth").counts["summary"])

    def coarse(self) -> None:
        """The coarse scene from the training frames; where it refined poses, the frames with these."""
        with self._stage("coarse") as row:
            # Later stages get the training frames alone. Extracting them takes no time, and does not affect
            # whether the stage counts as cached.
            self.refs["training"] = self._training_frames()
            if self.config.uc_nerf.enabled:
                inputs = {"sequence": self.refs["training"], "config": self.config.uc_nerf}
                self.refs["coarse"] = self._run_task(row, Call(uc_nerf, inputs))
                return
            if self.config.imported.scene is not None:
                self.refs["coarse"] = self._run_task(row, imported_call(self.config, self.refs["training"]))
                counts = self._manifest("coarse").counts
                self.config, row.reason = of_imported_scene(self.config, counts), str(counts["summary"])
                return
            # The oracle alone is shown held-out frames, and no later stage sees what it made.
            oracle = self.config.coarse.train_on == "all"
            frames = self._with_depth(self.refs["sequence"]) if oracle else self.refs["training"]
            call = Call(coarse, {"sequence": frames, "config": self.config.coarse, **self._on_device()})
            said = [HELD_OUT_TRAINED_ON] if oracle else []
            # The oracle's frames are other ones than those of any scene that may be gone on from.
            if self.config.continuation.scene == "nearest" and not oracle:
                refresh = getattr(self.runner, "refresh", False)
                call, why_anew = coarse_call(
                    self.config, self.store, self.outcome.name, frames, **self._on_device(), refresh=refresh
                )
                said += [why_anew] if why_anew else []
            self.refs["coarse"] = self._run_task(row, call)
            counts = self._manifest("coarse").counts
            if counts.get("continued_from"):
                said.append(str(counts["summary"]))
            if counts.get("refined_poses") or counts.get("corrected_colors"):
                # The scene was optimised with the corrected poses and colours: later stages need them.
                inputs = {"sequence": self.refs["sequence"], "coarse": self.refs["coarse"]}
                self.refs["sequence"] = self._run_uncounted(Call(refined_frames, inputs))
                self.refs["training"] = self._training_frames()
            if counts.get("refined_poses"):
                said.append(f"poses refined, by {counts['refined_mean_turn_deg']:.2f} degrees on average")
            if counts.get("corrected_colors"):
                said.append("haze or white balance of single frames corrected")
            if counts.get("inconsistent_frames"):
                said.append(str(counts["inconsistent_frames"]))
            row.reason = "; ".join(said)

    def assess(self) -> None:
        """What the scene lacks, and the plan."""
        from extrags.scene_plan import ScenePlan

        with self._stage("assess") as row:
            coverage = self.config.explore.coverage
            settings = measuring_settings(self.config.assess)
            inputs = {
                **self._scene_inputs(),
                **self._on_device(),
                "config": settings,
                "coverage": coverage,
            }
            self.refs["assess"] = self._run_task(row, Call(assess, inputs))
            # The decisions depend on the measurements and all budgets. They take no time, and do not affect
            # whether the stage counts as cached.
            inputs = {"measured": self.refs["assess"], "config": planning_settings(self.config)}
            self.refs["plan"] = self._run_uncounted(Call(plan, inputs))
            self.plan = self.store.load(ScenePlan, self.refs["plan"])
            self.outcome.plan = self.plan.model_dump(mode="json")

    def surface(self) -> None:
        """The mesh."""
        with self._stage("surface") as row:
            inputs = {**self._scene_inputs(), "config": self.config.surface}
            self.refs["surface"] = self._run_task(row, Call(surface, inputs))

    def freespace(self) -> None:
        """Where virtual cameras may go."""
        with self._stage("freespace") as row:
            mesh = self.refs["surface"]
            inputs = {**self._scene_inputs(), "surface": mesh, "config": self.config.freespace}
            self.refs["freespace"] = self._run_task(row, Call(freespace, inputs))

    def explore(self) -> None:
        """The virtual trajectories, wave by wave."""
        with self._stage("explore") as row:
            space = self.refs["freespace"]
            inputs = {**self._scene_inputs(), "freespace": space, "config": self.config.explore}
            self.refs["waves"] = search = self._run_task(row, Call(start, inputs))
            shared = {name: inputs[name] for name in ("scene", "freespace", "config")} | {"search": search}
            while anchors := next_anchors(self._manifest("waves").counts):
                state = self.refs["waves"]
                calls = [Call(branch, {**shared, "state": state, "anchor": anchor}) for anchor in anchors]
                branches = self._run_tasks(row, calls)
                self.refs["waves"] = self._run_task(row, Call(merge, {"state": state, "branches": branches}))
                accepted = int(self._manifest("waves").counts["accepted"] or 0)
                self._report_progress(row, "running", accepted, self.config.explore.trajectories)
            collected = {**inputs, "search": search, "state": self.refs["waves"]}
            self.refs["explore"] = self._run_task(row, Call(explore, collected))
            accepted = int(self._manifest("explore").counts["trajectories"] or 0)
            if accepted < self.config.explore.trajectories:
                wanted = self.config.explore.trajectories
                told = f"{accepted} of {wanted} trajectories were accepted, since no other added enough"
                row.reason = "; ".join(filter(None, (row.reason, told)))

    def enhance(self) -> None:
        """The restorer, and the virtual views it restores in batches."""
        with self._stage("enhance") as row:
            given = self.config.enhance
            inputs = {
                **self._scene_inputs(),
                "config": keyed_enhance_settings(given),
                "coarse": self.config.coarse,
                "model_digest": restorer_digest(given),
                "given": given,
                # Of the backends here the embedded one alone reconstructs anything.
                **(self._on_device() if given.backend == "embedded" else {}),
            }
            self.refs["restorer"] = self._run_task(row, Call(train, inputs))
            weights, *_ = self._weights()
            settings = restoring_settings(given)
            views = {
                **self._scene_inputs(),
                "explore": self.refs["explore"],
                "restorer": self.refs["restorer"],
            }
            followed = None
            if given.keyframes > 0:
                inputs = {**views, "config": keyframe_settings(given)}
                followed = self._run_task(row, Call(keyframes, inputs))
            shared = {
                **views,
                "keyframes": followed,
                "config": settings,
                "weights_digest": weights.digest,
                "weights": weights,
            }
            trajectories = int(self._manifest("explore").counts["trajectories"] or 0)
            batches = range(settings.batches(trajectories))
            parts = self._run_tasks(row, [Call(restore, {**shared, "batch": batch}) for batch in batches])
            self.refs["enhance"] = self._run_task(row, Call(assemble, {"parts": parts}))

    def finetune(self) -> None:
        """The final scene; there is none where the judge keeps the coarse one."""
        from extrags.finetuning_judgement import Judgement
        from extrags.restoration.restored_renders import RestoredShares

        with self._stage("finetune") as row:
            settings, coarse = self.config.finetune, self.config.coarse
            weights, *_ = self._weights()
            inputs = {
                **self._scene_inputs(),
                "explore": self.refs.get("explore"),
                "restorer": self.refs.get("restorer"),
                "config": settings,
                "enhance": judging_settings(self.config.enhance),
                "coarse": coarse,
                "weights_digest": weights.digest,
                "weights": weights,
                "clips_per_batch": self.config.enhance.clips_per_batch,
                **self._on_device(),
            }
            self.refs["judgement"] = self._run_task(row, Call(judge, inputs))
            judgement = self.store.load(Judgement, self.refs["judgement"])
            shares = judgement.restored_shares
            # The usual shares are those of a run without a judge: the same views.
            if shares is not None and shares != RestoredShares():
                self._restored_shares = (shares.known, shares.invented)
            planned = self.planned("finetune")
            if planned is None or "judge.enabled" not in planned.budget:
                row.reason = judgement.reason
            if judgement.amount is None:
                return
            inputs = {
                **self._scene_inputs(),
                "pseudo_views": self.refs.get("enhance") if judgement.amount > 0 else None,
                "config": finetuning_settings(judgement.applied_to(settings)),
                "coarse": coarse,
                **self._on_device(),
            }
            self.refs["finetune"] = self._run_task(row, Call(finetune, inputs))

    def evaluate(self) -> None:
        """Held-out views of both scenes, and their figures."""
        with self._stage("evaluate") as row:
            sequence = self.refs["sequence"]
            parts: tuple[Part, ...] = ("coarse", "finetune")
            scenes = [self.refs[part] for part in parts if part in self.refs]
            if self.config.uc_nerf.enabled:
                calls = [Call(render_uc_nerf, {"scene": ref, "sequence": sequence}) for ref in scenes]
            else:
                shown = {
                    "sequence": sequence,
                    "train_on": self.config.coarse.train_on,
                    **self._on_device(),
                }
                calls = [Call(render, {"scene": ref, **shown}) for ref in scenes]
            renders = self._run_tasks(row, calls)
            restored = self._restored_renders(row, renders[-1])
            weights = self._weights()
            settings = {
                "lpips_digests": {item.net: item.digest for item in weights},
                "weights": weights,
                "added": added_metrics(),
                **self._on_device(),
            }
            measured = renders + ([] if restored is None else [restored])
            figures = self._figures(row, measured, {"sequence": sequence, **settings})
            self.refs["renders_coarse"], self.refs["metrics_coarse"] = renders[0], figures[0]
            if "finetune" in self.refs:
                self.refs["renders_final"], self.refs["metrics_final"] = renders[1], figures[1]
            # Where nothing was fine-tuned, the coarse scene is the final one.
            measurements = {"coarse": figures[0], "final": figures[len(renders) - 1]}
            if restored is not None:
                self.refs["renders_restored"] = restored
                self.refs["metrics_restored"] = measurements["restored"] = figures[-1]
            for which, ref in measurements.items():
                self.outcome.metrics[which] = self.store.load_json(METRICS_FILE, ref)["metrics"]

    def _figures(self, row: StageRow, renders: list[Ref], shared: dict[str, Any]) -> list[Ref]:
        """Metrics of each of the renders; views of all that are not in the store are measured together."""
        calls = [Call(measure, {"renders": ref, **shared}) for ref in renders]
        refresh = getattr(self.runner, "refresh", False)
        waiting = {
            ref.digest: ref
            for ref, call in zip(renders, calls, strict=True)
            if refresh or self.store.find(stage_key(call.task, call.inputs)) is None
        }
        if waiting:
            every = {ref.digest: ref for ref in renders}
            together, whole = (
                Call(measure_views, {"renders": list(each.values()), **shared}) for each in (waiting, every)
            )
            # A run that was interrupted may have measured all of them already.
            found = not refresh and self.store.find(stage_key(whole.task, whole.inputs)) is not None
            views = self._run_task(row, whole if found else together)
            calls = [
                Call(measure, {**call.inputs, "views": views if ref.digest in waiting else None})
                for ref, call in zip(renders, calls, strict=True)
            ]
        figures = self._run_tasks(row, calls)
        # What figures of a former run were made from is looked up by no task: it is in use all the same.
        for figure in figures:
            measured = self.store.manifest(figure).input_keys.get("views")
            if measured is not None:
                self._count_found(row, measured)
        return figures

    def _restored_renders(self, row: StageRow, renders: Ref) -> Ref | None:
        """The final scene's held-out views, restored; None without a restorer."""
        kind = self.config.evaluate.restored
        if kind == "none" or "restorer" not in self.refs:
            return None
        inputs = {
            **self._scene_inputs(),
            "renders": renders,
            "sequence": self.refs["sequence"],
            "training": self.refs["training"],
            "restorer": self.refs["restorer"],
            "config": renders_settings(self.config.enhance, kind),
            "finish": kind,
            "refiner": refiner_digest() if kind == "refined" else None,
            "shares": self._restored_shares,
        }
        return self._run_task(row, Call(restore_renders, inputs))

    def report(self) -> None:
        """The page, from what the other stages made."""
        with self._stage("report") as row:
            self._make_page(row, Call(report, self._page_inputs()))

    def report_again(self) -> None:
        """The page anew, with the times of the run that made what it shows, not those of looking it up."""
        with self._stage("report") as row:
            self._make_page(row, Call(report, self._inputs_of_page_again()))

    def report_elsewhere(self, folder: Path) -> Path:
        """As `report_again`, but the page is written to a folder outside the store, which stays as it is.

        Returns:
            The page.
        """
        fill(report, Slot(folder, self.store), self._inputs_of_page_again())
        return folder / PAGE

    def _inputs_of_page_again(self) -> dict[str, Any]:
        inputs = self._page_inputs()
        told = self._rows_of_page(stage_key(report, inputs))
        if not told:
            for item in inputs["rows"]:
                if item["state"] == "cached":
                    item |= {"state": "ran", "seconds": item["made_seconds"]}
        inputs["rows"] = told or inputs["rows"]
        return inputs

    def _make_page(self, row: StageRow, call: Call) -> None:
        self.refs["report"] = self._run_task(row, call)
        self.outcome.report = f"{self.refs['report'].uri}/{PAGE}"

    def _page_inputs(self) -> dict[str, Any]:
        skipped = {item.stage: item.reason for item in self.outcome.stages if item.state == "skipped"}
        return {
            "name": self._source_name,
            "parts": {part: self.refs[part] for part in REPORT_PARTS if part in self.refs},
            "skipped": skipped,
            "without_pose": self.frames_without_pose(),
            "config": self.config,
            "profile": self.profile,
            "rows": [item.to_json() for item in self.outcome.stages if item.stage != "report"],
        }

    def _rows_of_page(self, key: str) -> list[dict[str, Any]]:
        """The stages that a page tells of; none where it is gone, damaged, or of a version that kept none."""
        try:
            found = self.store.find(key)
            if found is None or ROWS not in self.store.manifest(found).run_files:
                return []
            rows: list[dict[str, Any]] = self.store.load_json(ROWS, found)
            return rows
        except DamagedArtefactError:
            return []

    def _scene_inputs(self) -> dict[str, Any]:
        return {"scene": self.refs["coarse"], "sequence": self.refs["training"]}

    def _on_device(self) -> dict[str, str]:
        """The run's device, as stages take it that optimise, render or measure."""
        from extrags.placement import run_device

        return {"device": run_device(self.config)}

    def _training_frames(self) -> Ref:
        """The training frames alone, with their estimated depth if the source has none."""
        frames = self._run_uncounted(Call(training_frames, {"sequence": self.refs["sequence"]}))
        return self._with_depth(frames)

    def _with_depth(self, frames: Ref) -> Ref:
        if "depth" not in self.refs:
            return frames
        return self._run_uncounted(Call(depth_frames, {"sequence": frames, "depth": self.refs["depth"]}))

    def _weights(self) -> list[Weights]:
        return lpips_weights(self.config.evaluate)
