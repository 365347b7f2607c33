"""What is the same for every stage of a run with a store: tasks run, accounted, announced, and resumed."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from data_catalog.names import path_of, plain_name
from extrags.config import PipelineConfig
from extrags.errors import ArtefactGoneError, DamagedArtefactError, ExtragsError
from extrags.pipeline import Pipeline
from extrags.redaction import without_credentials
from extrags.stages import Part, StageName, stages_until
from extrags.store import Manifest, Ref, Store, digest_of, forget_loaded
from extrags.store.runs import RunRecord, recorded_run
from flows.damage import again_after_damage
from flows.estimate import expected_seconds
from flows.failures import release_locals
from flows.outcome import SequenceOutcome, StageRow
from flows.runners import Call, NotInStoreError, Result, Runner, StoreRunner
from flows.workloads import frames_work
from tasks.progress import StageProgress, notify

__all__ = ["CachedStages"]


class _StoppedError(Exception):
    """A stage failed; its row is written already."""


class CachedStages(Pipeline):
    """A run whose stages compute cached tasks; what each computes from what is a subclass's.

    A subclass implements a stage within `with self._stage(...) as row`, has its tasks run by `_run_task`, and
    keeps what they made in `refs`.

    Args:
        name: of the sequence; of a path, artefacts get the plain spelling (`data_catalog.names`).
        config: settings of all stages.
        store: root of the store.
        runner: how artefacts are made.
        profile: name of the profile the settings come from, for the report.
        leave_out: see `extrags.pipeline.Pipeline`.
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
        super().__init__(config, leave_out)
        self.check_frames: Callable[[Mapping[str, Any]], object] = dict  # Of the counts of `ingest`.
        self.outcome = SequenceOutcome(plain_name(name))
        self.store = Store(store)
        self.runner = runner
        self.profile = profile
        self._given = self.config
        self._record: RunRecord | None = None
        self._before: dict[str, StageRow] = {}
        """Rows of the attempts that met a damaged artefact."""

    @property
    def refs(self) -> dict[Part, Ref]:
        """What has been made so far."""
        return self.outcome.refs

    def run(self, until: StageName = "report") -> SequenceOutcome:
        """All stages up to one; see `run_sequence`."""
        begun = time.monotonic()
        try:
            if isinstance(self.runner, StoreRunner):
                self._attempt(until)  # Who only looks moves nothing.
            else:
                name, config = self.outcome.name, digest_of(self._given)
                with recorded_run(self.store, name, config, path_of(name) or "") as self._record:
                    again_after_damage(self.store, lambda: self._attempt(until))
        except (_StoppedError, ArtefactGoneError, DamagedArtefactError) as error:
            if not isinstance(error, _StoppedError):
                last = self.outcome.stages[-1]
                last.state, last.reason, self.outcome.error = "failed", str(error), error
            # Outcomes, errors among them, are kept until the last sequence of a run has ended.
            release_locals(error)
            self.outcome.status = "failed"
            done = {row.stage for row in self.outcome.stages}
            failed = self.outcome.stages[-1].stage
            for stage in stages_until(until):
                if stage not in done:
                    self.skip(stage, f"{failed} failed")
        finally:
            forget_loaded()
        self.outcome.seconds = time.monotonic() - begun
        return self.outcome

    def _attempt(self, until: StageName) -> None:
        """All stages from the beginning; raises what `again_after_damage` can mend."""
        self._before |= {row.stage: row for row in self.outcome.stages}
        self.outcome = SequenceOutcome(self.outcome.name)
        self.config, self.plan = self._given, None
        try:
            self.run_stages(until)
        except _StoppedError:
            if isinstance(self.outcome.error, ArtefactGoneError | DamagedArtefactError):
                raise self.outcome.error from None
            raise

    def skip(self, stage: StageName, reason: str) -> None:
        """Add a row to the outcome and report the progress."""
        row = StageRow(stage, "skipped", reason=reason)
        self.outcome.stages.append(row)
        self._report_progress(row, "skipped")

    def _run_uncounted(self, call: Call) -> Ref:
        """Run a task that is not counted in the row of its stage."""
        (result,) = self.runner.run([call], self.outcome.name)
        self._note([result.ref])
        manifest = self.store.manifest(result.ref)
        self.outcome.stages[-1].made[manifest.key] = manifest.bytes
        return result.ref

    def _note(self, refs: list[Ref]) -> None:
        """Retention keeps what a run has used."""
        if self._record is not None:
            self._record.add(ref.uri.rsplit("/", 1)[-1] for ref in refs)

    def _run_task(self, row: StageRow, call: Call) -> Ref:
        return self._run_tasks(row, [call])[0]

    def _run_tasks(self, row: StageRow, calls: list[Call]) -> list[Ref]:
        results = self.runner.run(calls, self.outcome.name)
        self._count(row, results)
        return [result.ref for result in results]

    def _count_found(self, row: StageRow, key: str) -> None:
        """Count an artefact of a former run that no task of this one looks up; nothing where it is gone."""
        found = None if key in row.made else self.store.find(key)
        if found is not None:
            self._count(row, [Result(found, "cached")])

    def _count(self, row: StageRow, results: list[Result]) -> None:
        """Account for artefacts in a row, and in the record of the run."""
        self._note([result.ref for result in results])
        for result in results:
            manifest = self.store.manifest(result.ref)
            peak = manifest.counts.get("peak_mib")
            if isinstance(peak, float):
                row.peak_mib = max(row.peak_mib or 0.0, peak)
            processor = manifest.counts.get("processor_s")
            if not isinstance(processor, int | float):
                row.processor_seconds = None
            elif row.tasks == 0:
                row.processor_seconds = float(processor)
            elif row.processor_seconds is not None:
                row.processor_seconds = round(row.processor_seconds + processor, 3)
            row.made_seconds += manifest.elapsed_s
            row.made[manifest.key] = manifest.bytes
            row.tasks += 1
            if result.state == "ran":
                row.spent_seconds += manifest.elapsed_s
                row.state = "ran"

    def _manifest(self, part: Part) -> Manifest:
        return self.store.manifest(self.refs[part])

    @contextmanager
    def _stage(self, stage: StageName) -> Iterator[StageRow]:
        """One row of the outcome: timed, announced, and marked when the block raises."""
        row = self.outcome.row(stage)
        if row is None:
            planned = self.planned(stage)
            row = StageRow(stage, "cached", reason="" if planned is None else planned.reason)
            before = self._before.get(stage)
            if before is not None:
                row.seconds, row.spent_seconds = before.seconds, before.spent_seconds
                row.state = "ran" if before.state == "ran" else "cached"
            self.outcome.stages.append(row)
        self._report_progress(row, "running")
        begun = time.monotonic()
        try:
            yield row
        except NotInStoreError:
            raise
        except Exception as error:
            row.state = "failed"
            told = str(error) if isinstance(error, ExtragsError) else f"{type(error).__name__}: {error}"
            row.reason = without_credentials(told)
            self.outcome.error = error
            raise _StoppedError from error
        except BaseException:
            row.state = "interrupted"
            raise
        finally:
            row.seconds += time.monotonic() - begun
            self._report_progress(row, row.state)

    def _report_progress(self, row: StageRow, state: str, done: int = 0, total: int = 0) -> None:
        reason = row.reason if state in ("skipped", "failed") else ""
        made = {} if state == "running" else {str(part): ref for part, ref in self.refs.items()}
        # What the stages to come will take is known better once frames are read, and once there is a plan.
        tells = row.stage in ("ingest", "assess") and state in ("ran", "cached") and "ingest" in self.refs
        expected = self._expected_seconds() if tells else None
        notify(
            StageProgress(
                self.outcome.name, row.stage, state, done, total, reason, row.seconds, made, expected
            )
        )

    def _expected_seconds(self) -> Mapping[str, Mapping[str, float]]:
        config = self.config if self.plan is None else self.plan.applied_to(self.config)
        coarse = self._manifest("coarse").counts if "coarse" in self.refs else None
        found = expected_seconds(config, frames_work(self._manifest("ingest").counts, config, coarse))
        return {str(stage): tasks for stage, tasks in found.items()}
