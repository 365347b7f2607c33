"""Ctrl-C and SIGTERM: what a command does when it is told to stop.

Stages run in threads, native code among them, which no exception of the main thread reaches. So a thread of
its own learns of the signal from the kernel by way of a pipe, whatever the main thread is doing, and

1. says in one sentence what happened,
2. lets running stages end at their next progress event (`tasks.progress.interrupt_stages`) while the main
   thread unwinds, so that scratch directories and locks go and Prefect learns of the end,
3. ends the process and all its children when that took too long.

Nothing is lost with 3: artefacts are committed by renaming, and the kernel releases the locks.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import NoReturn

__all__ = ["INTERRUPTED", "RESUMABLE", "interruptible", "say_when_interrupted", "until_told_to_stop"]

INTERRUPTED = "interrupted before the end"
"""For commands that do not say what their interruption means."""
RESUMABLE = "the run was interrupted; finished stages are kept, and the same command resumes"
"""For commands that run stages."""

UNWINDING_SECONDS = 3.0
"""How long the main thread may take to unwind."""
CHILDREN_SECONDS = 0.7
"""How long children may take to end by themselves."""

SIGNALS = (signal.SIGINT, signal.SIGTERM)

_sentence = INTERRUPTED
"""What the command that runs says when it is interrupted."""


def say_when_interrupted(sentence: str) -> None:
    """For a command that can say more than `INTERRUPTED`."""
    global _sentence
    _sentence = sentence


class _Interruption:
    """The end of this process by a signal; its methods may be called from any thread."""

    def __init__(self) -> None:
        self.signal: int | None = None
        self.raised: int | None = None
        """The signal that unwinds the main thread."""
        self._guard = threading.Lock()

    def raise_once(self, number: int, _: FrameType | None) -> None:
        """Signal handler: unwind the main thread. A second signal does not disturb that."""
        if self.raised is None:
            self.raised = number
            raise KeyboardInterrupt

    def watch(self, pipe: socket.socket) -> None:
        """Wait for a signal, and see to it that the process ends."""
        while received := pipe.recv(1):
            if received[0] in SIGNALS:
                self.begin(received[0])
                time.sleep(UNWINDING_SECONDS)
                self.end()

    def begin(self, number: int) -> None:
        """Say it, and stop the stages; the first signal counts."""
        with self._guard:
            if self.signal is not None:
                return
            self.signal = number
            # What follows from the interruption is no news: Ctrl-C ends the server too, which others miss.
            logging.disable(logging.CRITICAL)
            # In one piece: other threads may be writing.
            sys.stderr.write(f"extrags: {_sentence}\n")
            sys.stderr.flush()
            progress = sys.modules.get("tasks.progress")
            if progress is not None:
                progress.interrupt_stages()

    def end(self) -> NoReturn:
        """End all children and this process, without waiting for threads.

        Its exit code is that of shells for a signal: 128 + the signal's number.
        """
        with self._guard:
            _end_children()
            output_files = sys.modules.get("extrags.output_files")
            if output_files is not None:
                output_files.remove_unfinished()
            sys.stdout.flush()
            os._exit(128 + int(self.signal or signal.SIGINT))


@contextmanager
def interruptible() -> Iterator[None]:
    """In this block SIGINT and SIGTERM end the process as described above. For the main thread alone."""
    interruption = _Interruption()
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    before = {number: signal.signal(number, interruption.raise_once) for number in SIGNALS}
    threading.Thread(target=interruption.watch, args=(reader,), daemon=True, name="interruption").start()
    wakeup = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    try:
        yield
    except KeyboardInterrupt:
        interruption.begin(interruption.raised or signal.SIGINT)
        interruption.end()
    finally:
        if interruption.signal is not None:
            # Prefect has signals of its own, and what a run raises while it unwinds does not matter.
            interruption.end()
        signal.set_wakeup_fd(wakeup)
        for number, handler in before.items():
            signal.signal(number, handler)
        writer.close()


def until_told_to_stop() -> None:
    """Wait for SIGINT or SIGTERM: for a command that serves, which ends well by being told to.

    For the main thread alone. In this time the signals do not end the process.
    """
    told = threading.Event()
    wakeup = signal.set_wakeup_fd(-1)
    before = {number: signal.signal(number, lambda *_: told.set()) for number in SIGNALS}
    try:
        told.wait()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(wakeup, warn_on_full_buffer=False)


def _end_children() -> None:
    """SIGTERM to all descendants, and SIGKILL to those that stay."""
    living = _descendants(os.getpid())
    for number in (signal.SIGTERM, signal.SIGKILL):
        for process in living:
            # It may have ended by itself.
            with suppress(ProcessLookupError):
                os.kill(process, number)
        end = time.monotonic() + CHILDREN_SECONDS
        while (living := [process for process in living if _is_running(process)]) and time.monotonic() < end:
            time.sleep(0.02)
        if not living:
            return


def _descendants(ancestor: int) -> list[int]:
    parents = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal() and (fields := _status(int(entry.name))):
            parents[int(entry.name)] = int(fields[1])
    found = [ancestor]
    for process in found:
        found += [child for child, parent in parents.items() if parent == process]
    return found[1:]


def _is_running(process: int) -> bool:
    fields = _status(process)
    return bool(fields) and fields[0] != "Z"


def _status(process: int) -> list[str]:
    """State and further fields of /proc/PID/stat; empty when the process is gone."""
    try:
        # The name before the closing bracket may hold anything.
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return []
