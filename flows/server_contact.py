"""Whether Prefect's server is still there, after a request to it has failed."""

from __future__ import annotations

import logging
import time

import httpx
from prefect.client.orchestration import get_client

from extrags.errors import ExtragsError
from flows.failures import is_connection_error

__all__ = ["ServerLostError", "check_server"]

log = logging.getLogger(__name__)

PATIENCE_SECONDS = 10.0
"""Prefect's client has tried for a minute by then: a server that restarts is back."""
POLL_SECONDS = 1.0


class ServerLostError(ExtragsError, ConnectionError):
    """Prefect's server does not answer any more."""


def check_server(error: Exception) -> None:
    """Tell a run that failed alone from a server that is gone, without which no other run can begin.

    Args:
        error: what a run ended with; of others than lost connections and faults of a server nothing follows.

    Raises:
        ServerLostError: when the server does not answer within `PATIENCE_SECONDS`.
    """
    if not (is_connection_error(error) or isinstance(error, httpx.HTTPStatusError)):
        return
    last = time.monotonic() + PATIENCE_SECONDS
    while (problem := _problem()) is not None:
        if time.monotonic() > last:
            raise ServerLostError(
                f"Prefect's server does not answer any more ({type(problem).__name__}: {problem}): no other "
                "sequence can begin. What is finished stays in the store; run again when the server is up"
            ) from error
        time.sleep(POLL_SECONDS)
    log.warning("Prefect's server was away for a while: %s: %s", type(error).__name__, error)


def _problem() -> Exception | None:
    with get_client(sync_client=True) as client:
        return client.api_healthcheck()
