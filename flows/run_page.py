"""What the page of a flow run says while it runs: what it does, how far it is, how long it still takes."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from prefect.artifacts import create_image_artifact, create_link_artifact

from extrags.config import PipelineConfig
from extrags.run_costs import Workload
from extrags.stages import StageName
from extrags.store import Store
from flows.estimate import RunEstimate, expected_seconds
from flows.outcome import SequenceOutcome
from flows.previews import preview
from tasks.progress import (
    Observer,
    ProgressLog,
    StageProgress,
    current_observer,
    duration_text,
    observed,
)
from tasks.run_log import run_log
from tasks.run_page import ArtifactSender, StageBars, artifact_key, page_wanted

__all__ = ["NoPage", "RunPage", "run_page"]


class RunPage:
    """Observer of a flow run: its overall progress and that of its long stages, as artifacts and in the log.

    Args:
        name: of the run, in the keys of its artifacts.
        sequences: how many it takes through the stages, one after the other or at once.
        expected: of one sequence (`expected_seconds`).
        until: last stage.
        bars: whether stages get bars of their own; not where another flow run has them.
    """

    def __init__(
        self,
        name: str,
        sequences: int,
        expected: dict[StageName, dict[str, float]],
        until: StageName,
        *,
        bars: bool,
    ) -> None:
        self.sender = ArtifactSender()
        self._name = name
        self._key = artifact_key("progress", name)
        self._estimate = RunEstimate(sequences, expected, until)
        self._bars = StageBars(self.sender) if bars else None
        self._outer: Observer = current_observer() or ProgressLog()
        self._guard = threading.Lock()
        self._begun = time.monotonic()

    def __call__(self, progress: StageProgress) -> None:
        """Take note of a step; may be called from any thread, and often."""
        self._outer(progress)
        if self._bars is not None:
            self._bars(progress)
        now = time.monotonic()
        with self._guard:
            self._estimate.receive(progress, now)
            self._say(now)

    def restart(self) -> None:
        """All sequences are looked up again from the first (`flows.damage`)."""
        with self._guard:
            self._estimate.restart()

    def sequence_ended(self, outcome: SequenceOutcome, store: str) -> None:
        """A sequence is through; its pictures and its report are shown on the page that has the bars."""
        if self._bars is not None:
            self._show(outcome, store)
        now = time.monotonic()
        with self._guard:
            self._estimate.sequence_ended(
                outcome.name,
                now,
                failed=outcome.status == "failed",
                ran=any(row.state == "ran" for row in outcome.stages),
            )
            self._say(now)

    def _say(self, now: float) -> None:
        words = [self._estimate.text(now), f"{duration_text(now - self._begun)} so far"]
        share = 100 * self._estimate.share(now)
        self.sender.progress(self._key, share, "; ".join(word for word in words if word))

    def _show(self, outcome: SequenceOutcome, store: str) -> None:
        """Add the pictures of a sequence, and the link to its report."""

        def picture() -> None:
            # Read in the sender's thread: stages go on meanwhile.
            found = preview(outcome, Store(store))
            if found is not None:
                uri, words = found
                create_image_artifact(uri, key=artifact_key("preview", outcome.name), description=words)

        self.sender.add(picture)
        if outcome.report is not None:
            self.link(outcome.report, artifact_key("report", outcome.name), f"Report of {outcome.name}")

    def link(self, place: str, key: str, words: str) -> None:
        """Add a link to a page in the store."""
        address = place if "://" in place else Path(place).absolute().as_uri()
        self.sender.add(
            lambda: create_link_artifact(address, link_text=place, key=key, description=f"{words}: `{place}`")
        )

    def close(self, *, wait: bool = True) -> None:
        """The last word, and everything sent."""
        took = duration_text(time.monotonic() - self._begun)
        with self._guard:
            found = self._estimate
            share = found.share(time.monotonic())
            if found.failed == found.sequences == 1:
                words = f"failed after {took}"
            elif found.ended >= found.sequences:
                words = f"done in {took}"
                if found.failed:
                    words += f"; {found.failed} of {found.sequences} failed"
            else:
                words = f"ended after {took}"
        self.sender.progress(self._key, 100 * share, f"{self._name}: {words}")
        self.sender.close(wait=wait)


class NoPage:
    """Of a run that has none."""

    def restart(self) -> None:
        """Nothing was begun."""

    def sequence_ended(self, outcome: SequenceOutcome, store: str) -> None:
        """Nobody is told."""

    def link(self, place: str, key: str, words: str) -> None:
        """Nothing is linked."""


@contextmanager
def run_page(
    name: str,
    config: PipelineConfig,
    until: StageName,
    *,
    sequences: int = 1,
    bars: bool = True,
    work: Workload | None = None,
) -> Iterator[RunPage | NoPage]:
    """The page and the log of the current flow run.

    Args:
        name: of the run, in the keys of its artifacts.
        config: settings of its sequences.
        until: last stage.
        sequences: how many it takes through the stages.
        bars: whether stages get bars of their own here, and sequences their pictures; not where flow runs
            inside this one have them.
        work: size of a sequence, where it is known; stages then count as they will take.

    Yields:
        A page that is told when a sequence ends. One that says nothing where none is wanted
        (`tasks.run_page.page_wanted`).
    """
    with run_log():
        if not page_wanted():
            yield NoPage()
            return
        page = RunPage(name, sequences, expected_seconds(config, work), until, bars=bars)
        try:
            with observed(page):
                yield page
        except Exception:
            page.close()
            raise
        except BaseException:
            # Interrupted: whoever is waiting for the end must not wait for the server.
            page.close(wait=False)
            raise
        page.close()
