"""The library's log lines in the log of the Prefect run that they belong to."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import copy_context
from uuid import UUID

from prefect.context import FlowRunContext, TaskRunContext
from prefect.logging.handlers import APILogHandler
from prefect.settings import PREFECT_LOGGING_TO_API_ENABLED

from extrags.redaction import CredentialFilter

__all__ = ["LOGGERS", "run_log"]

LOGGERS = ("extrags", "data_catalog", "tasks", "flows")
"""Packages whose log lines belong to the run."""

TASK_RUNS = "prefect.task_runs"
OF_RUNS = (TASK_RUNS, "prefect.flow_runs")


class RunLogHandler(APILogHandler):
    """Sends records to the run of the thread they come from.

    Threads that native code or a library starts know of no run, nor of settings that hold for a block
    only, such as the address of a temporary server; their records go to the flow run that opened the log,
    with its settings.
    """

    def __init__(self, flow_run_id: UUID | None) -> None:
        super().__init__(logging.INFO)
        self.addFilter(CredentialFilter())
        self.flow_run_id = flow_run_id
        self.opened_in = copy_context()

    def emit(self, record: logging.LogRecord) -> None:
        """Send one record; dropped where no run is known."""
        if FlowRunContext.get() is None and TaskRunContext.get() is None:
            if self.flow_run_id is None:
                return
            record.flow_run_id = str(self.flow_run_id)
            # A copy: a context can be entered by one thread at a time only.
            self.opened_in.copy().run(super().emit, record)
        else:
            super().emit(record)


class _Named(logging.Filter):
    """Says which task run it was that "Finished in state Completed()"."""

    def filter(self, record: logging.LogRecord) -> bool:
        name = getattr(record, "task_run_name", None)
        if name and isinstance(record.msg, str) and record.msg.startswith("Finished in state "):
            # Lower case: a second handler or an inner filter must not put the name there again.
            record.msg = f"{name}: finished{record.msg.removeprefix('Finished')}"
        return True


_guard = threading.Lock()
_open = 0
_undo: list[tuple[logging.Logger, int, logging.Handler | None]] = []
_named = _Named()
_unsaid = CredentialFilter()


@contextmanager
def run_log() -> Iterator[None]:
    """Log lines of the library from level INFO reach the log of the current run, from all threads.

    Nothing is changed outside a run, or where Prefect is told not to send logs to its server
    (PREFECT_LOGGING_TO_API_ENABLED). Levels that somebody has set, and handlers that
    PREFECT_LOGGING_EXTRA_LOGGERS has added, are left alone. Blocks may overlap: the last one to end closes
    the log. Tasks in other processes open their own.
    """
    flow, task = FlowRunContext.get(), TaskRunContext.get()
    if (flow is None and task is None) or not PREFECT_LOGGING_TO_API_ENABLED.value():
        yield
        return
    if task is not None:
        flow_run_id = task.task_run.flow_run_id
    else:
        flow_run_id = flow.flow_run.id if flow is not None and flow.flow_run is not None else None
    _enter(flow_run_id)
    try:
        yield
    finally:
        _leave()


def _enter(flow_run_id: UUID | None) -> None:
    global _open
    with _guard:
        _open += 1
        if _open > 1:
            return
        for name in LOGGERS:
            logger = logging.getLogger(name)
            before = logger.level
            if before == logging.NOTSET:
                logger.setLevel(logging.INFO)
            handler: logging.Handler | None = None
            if not any(isinstance(known, APILogHandler) for known in logger.handlers):
                handler = RunLogHandler(flow_run_id)
                logger.addHandler(handler)
            _undo.append((logger, before, handler))
        # It stays: Prefect says how a task in a worker process ended after the stage has left the log.
        logging.getLogger(TASK_RUNS).addFilter(_named)
        for name in OF_RUNS:
            logging.getLogger(name).addFilter(_unsaid)


def _leave() -> None:
    global _open
    with _guard:
        _open -= 1
        if _open > 0:
            return
        for logger, level, handler in _undo:
            logger.setLevel(level)
            if handler is not None:
                # Not closed: that would wait for the server, once per logger.
                logger.removeHandler(handler)
        _undo.clear()
