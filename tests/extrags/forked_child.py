"""A forked child that does some work, and how it ends."""

from __future__ import annotations

import os
import signal
import time
import warnings
from collections.abc import Callable

import pytest


def exit_code_of_child(work: Callable[[], bool], deadline_s: float = 60) -> int:
    """0 where the work is right, in a child forked from this process; a child that hangs fails the test."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # that a process with threads forks is the point
        child = os.fork()
    if child == 0:
        code = 2
        try:
            code = 0 if work() else 1
        finally:
            os._exit(code)
    deadline = time.monotonic() + deadline_s
    while (done := os.waitpid(child, os.WNOHANG))[0] == 0:
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            pytest.fail("the child hangs")
        time.sleep(0.01)
    return os.waitstatus_to_exitcode(done[1])
