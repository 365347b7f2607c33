"""How long runs keep trying: retries of what can pass, time limits of stages, failures that a run bears."""

from __future__ import annotations

import errno
import logging
from typing import Any

from prefect import Task
from prefect.client.schemas.objects import State, TaskRun
from pydantic import BaseModel, ConfigDict, Field

from extrags.errors import ExtragsError, StoreError
from extrags.store import Ref
from flows.failures import is_connection_error

__all__ = ["DEFAULT_LIMITS", "StageLimits", "can_pass"]

log = logging.getLogger(__name__)

PASSING = frozenset(
    {
        errno.EAGAIN,
        errno.EBUSY,
        errno.EHOSTDOWN,
        errno.EHOSTUNREACH,
        errno.EIO,
        errno.EMFILE,
        errno.ENETDOWN,
        errno.ENETRESET,
        errno.ENETUNREACH,
        errno.ENFILE,
        errno.ENOLCK,
        errno.EREMOTEIO,
        errno.ESTALE,
        errno.ETIMEDOUT,
    }
)
"""Errors of the operating system that may be gone in a minute. A full disk, a missing file and a forbidden
one are not among them."""


class StageLimits(BaseModel):
    """What a stage, or the run of a sequence, may cost before it counts as failed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    retries: int = Field(
        2,
        ge=0,
        le=10,
        description="further tries of a stage after an error that can pass: store, network, lost worker, I/O",
    )
    retry_delay_s: float = Field(
        5.0, ge=0, le=3600, description="before the second try; doubled after each, and spread at random"
    )
    time_limit_s: float | None = Field(
        None,
        gt=0,
        description="a stage fails at the first progress event after so long, each of its tasks for "
        "itself; no limit by default",
    )
    memory_gb: float | None = Field(
        None,
        gt=0,
        description="a sequence whose estimated peak memory, in GB (1e9 bytes), is higher is refused as soon "
        "as its frames are read; no limit by default",
    )

    def delays_s(self) -> list[float]:
        """The wait before each retry, in seconds."""
        return [self.retry_delay_s * 2**attempt for attempt in range(self.retries)]

    def applied_to(self, task: Task[..., Ref]) -> Task[..., Ref]:
        """The same task, tried again after errors that can pass."""
        return task.with_options(
            retries=self.retries,
            retry_delay_seconds=self.delays_s() or 0,
            # Runs that met the same outage do not all come back at once.
            retry_jitter_factor=0.5,
            retry_condition_fn=_is_tried_again,
        )


DEFAULT_LIMITS = StageLimits()
"""Two more tries, and no limit of time."""


def can_pass(error: BaseException) -> bool:
    """Whether the same stage may succeed a little later, with nobody doing anything about it.

    True of lost connections, of errors of the operating system in `PASSING`, and of a store that cannot be
    used because of one of these. False of all other errors of extrags: wrong input, settings or weights,
    and optimisations that diverge, fail again. Damaged artefacts are seen to elsewhere (`flows.damage`).
    """
    if isinstance(error, ExtragsError):
        if type(error) is not StoreError:
            return False
        return error.__cause__ is None or can_pass(error.__cause__)
    if is_connection_error(error):
        return True
    return isinstance(error, OSError) and (isinstance(error, TimeoutError) or error.errno in PASSING)


def _is_tried_again(task: Task[..., Any], task_run: TaskRun, state: State[Any]) -> bool:
    error = state.data
    if not isinstance(error, BaseException) or not can_pass(error):
        return False
    log.warning("%s: tried again after %s: %s", task_run.name, type(error).__name__, error)
    return True
