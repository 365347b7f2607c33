"""Three tiny stages that behave like real ones; importable from child processes."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from extrags.config import StageConfig
from extrags.errors import DivergedError
from extrags.events import Progress, emit
from extrags.store import Ref, Slot
from tasks.stage import stage


class ToyConfig(StageConfig):
    """Settings of the toys."""

    scale: float = 1.0
    fail: bool = False


PLAIN = ToyConfig()


def note_run(name: str) -> None:
    """Append to the file named by EXTRAGS_TEST_RUNS, so that tests can count real runs across processes."""
    target = os.environ.get("EXTRAGS_TEST_RUNS")
    if target:
        with Path(target).open("a") as stream:
            stream.write(name + "\n")


@stage("toy-source", version=1)
def source(slot: Slot, seed: int = 0) -> None:
    """Write a number."""
    note_run("source")
    (slot.path / "number").write_text(str(seed))


@stage("toy-double", version=3)
def double(slot: Slot, number: Ref, config: ToyConfig = PLAIN) -> None:
    """Double it, or fail on request."""
    note_run("double")
    value = float((slot.open(number) / "number").read_text())
    (slot.path / "half-written").write_text("...")
    emit(Progress("toy", 1, 2, {"value": value}))
    if config.fail:
        (slot.debug / "value").write_text(str(value))
        raise DivergedError("iteration 7: means are not finite")
    (slot.path / "half-written").unlink()
    (slot.path / "number").write_text(str(2 * value * config.scale))
    slot.counts["value"] = value


@stage("toy-total", version=1)
def total(slot: Slot, numbers: list[Ref], die: bool = False) -> None:
    """Sum; dies by SIGKILL in mid-write when told so and EXTRAGS_TEST_DIE is set."""
    note_run("total")
    values = [float((slot.open(ref) / "number").read_text()) for ref in numbers]
    (slot.path / "half-written").write_text("...")
    if die and os.environ.get("EXTRAGS_TEST_DIE"):
        os.kill(os.getpid(), signal.SIGKILL)
    (slot.path / "half-written").unlink()
    (slot.path / "number").write_text(str(sum(values)))
