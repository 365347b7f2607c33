"""Environment of runs from the command line; call before Prefect and torch are imported."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from extrags.data_directories import check_home
from extrags.errors import StoreError, reason_of
from tasks.page_choice import PAGE_VARIABLE, page_chosen

__all__ = ["has_own_home", "prepare", "without_heartbeat"]


def has_own_home() -> bool:
    """Whether `prepare` keeps Prefect's database in the store, because the user has named no other place."""
    return not os.environ.get("PREFECT_API_URL") and not os.environ.get("PREFECT_HOME")


def prepare(state: Path, *, debug: bool = False, looks: bool = False) -> None:
    """Set up a separate Prefect home with quiet logging; variables set by the user are kept.

    OpenMP threads are set to wait passively: active waiting, their default, makes training up to five times
    slower when other processes use the cores.

    Args:
        state: local directory of the store; Prefect's database goes to `prefect/` in it. Left alone when
            PREFECT_HOME or PREFECT_API_URL is set: then runs land where the user wants them.
        debug: let Prefect log.
        looks: for what may find all it needs in the store, which somebody else may have filled and which
            cannot be written then: Prefect's home may be missing.

    Raises:
        StoreError: when the directory cannot be made.
        ConfigError: without a home folder, or for a value of `EXTRAGS_RUN_PAGE` that it does not have.
    """
    check_home()
    page_chosen()  # What is wrong with it is said before anything runs.
    chosen = {
        "OMP_WAIT_POLICY": "passive",
        # Without an API URL the run gets a temporary server (`flows.temporary_server`). Prefect's start-up
        # timeout of 20 s is too short on a busy machine.
        "PREFECT_SERVER_EPHEMERAL_ENABLED": "true",
        "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "90",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "DO_NOT_TRACK": "1",
        "PREFECT_CLI_PROMPT": "false",
        # Failures are reported by `flows.failures`; Prefect would add a traceback for each.
        "PREFECT_LOGGING_LEVEL": "INFO" if debug else "CRITICAL",
        "PREFECT_SERVER_LOGGING_LEVEL": "WARNING" if debug else "CRITICAL",
    }
    if has_own_home():
        home = state / "prefect"
        try:
            home.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            if not looks:
                raise StoreError(f"the store {state} cannot be written: {reason_of(error)}") from error
            # Prefect would say so at its import.
            warnings.filterwarnings("ignore", message="Failed to create the Prefect home directory")
        # Nobody looks at the page of a run on a server that goes with it.
        chosen["PREFECT_LOGGING_TO_API_ENABLED"] = "false"
        chosen[PAGE_VARIABLE] = "0"
        chosen["PREFECT_HOME"] = str(home)
    for name, value in chosen.items():
        os.environ.setdefault(name, value)


@contextmanager
def without_heartbeat() -> Iterator[None]:
    """Flow runs inside the block send no heartbeat.

    Waiting for its thread costs a second per flow run, and it cannot be switched off by environment. A
    command that somebody waits for needs no zombie detection; deployments keep it.
    """
    from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY, temporary_settings

    with temporary_settings({PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}):
        yield
