"""Parameters that flows and commands share: store, profile and settings, task runner."""

from __future__ import annotations

import os
import re
from typing import Any

from extrags.config import LARGEST_SEED, PipelineConfig, profile_config
from extrags.cores import usable_cores
from extrags.data_directories import DATA_VARIABLE, user_directories
from extrags.errors import ConfigError, did_you_mean
from extrags.user_paths import absolute, expanded

__all__ = [
    "DEFAULT_STORE",
    "check_runner",
    "default_store",
    "pipeline_config",
    "run_store",
    "task_runner",
]

DEFAULT_STORE = ".extrags"
RUNNERS = ("threads", "dask")
STORE_VARIABLE = "EXTRAGS_STORE"

PLACES = (STORE_VARIABLE, DATA_VARIABLE, "EXTRAGS_LPIPS_WEIGHTS", "EXTRAGS_CACHE")
"""Variables of the environment that say where things are."""


def default_store() -> str:
    """Root of the store when the command line names none: EXTRAGS_STORE, else `.extrags` here."""
    return os.environ.get(STORE_VARIABLE) or DEFAULT_STORE


def run_store(named: str | None) -> str:
    """Root of the store of a flow run, as an absolute path or a URL.

    Args:
        named: the flow's parameter; None takes EXTRAGS_STORE, else `store` in the user's data directory
            (`~/.local/share/extrags/store`). A path is never relative to where a worker happened to be
            started: in a deployment a relative one is refused. Called from Python, it is relative to the
            working directory, as any path is.

    Raises:
        ConfigError: for a relative path in a deployment: of the store, or in one of the variables `PLACES`.
    """
    if _is_deployed():
        for variable in PLACES:
            _check_absolute(variable, os.environ.get(variable) or "/")
        _check_absolute("the parameter store", named or "/")
    root = named or os.environ.get(STORE_VARIABLE) or str(user_directories()[0] / "store")
    return root if "://" in root else str(expanded(root).absolute())


def _check_absolute(what: str, place: str) -> None:
    if "://" not in place and not expanded(place).is_absolute():
        raise ConfigError(
            f"{what} is {place}, which is relative to where this worker was started; "
            "give an absolute path or a URL"
        )


def _is_deployed() -> bool:
    from prefect.context import FlowRunContext

    context = FlowRunContext.get()
    run = None if context is None else context.flow_run
    return run is not None and run.deployment_id is not None


def pipeline_config(
    profile: str, settings: dict[str, Any] | None = None, seed: int | None = None
) -> PipelineConfig:
    """A profile with overrides and, if given, every stage's seed; the path of an imported scene is absolute.

    Raises:
        ConfigError: for an unknown profile or setting, or a value out of range.
    """
    config = profile_config(profile)
    if seed is not None:
        if not 0 <= seed <= LARGEST_SEED:
            raise ConfigError(f"the seed is {seed}; expected 0 to {LARGEST_SEED} (2^63 - 1)")
        config = config.with_seed(seed)
    config = config.with_overrides(settings or {})
    if config.imported.scene is None:
        return config
    # Pages show it: the same file, spelled otherwise, would get a page of its own.
    return config.with_overrides({"imported.scene": str(absolute(config.imported.scene))})


def check_runner(name: str) -> tuple[str, str]:
    """The kind of a task runner, and the address of its scheduler; empty where none is named.

    Args:
        name: as `task_runner` takes it.

    Raises:
        ConfigError: for any other name.
    """
    kind, _, address = name.partition(":")
    if kind not in RUNNERS or (kind == "threads" and address):
        meant = did_you_mean(kind, RUNNERS) if kind not in RUNNERS else ""
        raise ConfigError(f"no task runner {name!r}; expected threads, dask or dask:ADDRESS{meant}")
    if address and not _is_scheduler(address):
        raise ConfigError(
            f"no task runner {name!r}: {address} is no address of a Dask scheduler; expected HOST:PORT, or "
            "that behind tcp://, tls://, ws:// or wss://, e.g. dask:tcp://127.0.0.1:8786"
        )
    return kind, address


def _is_scheduler(address: str) -> bool:
    """Whether an address can be that of a scheduler in another process; nothing is connected to."""
    match = re.fullmatch(
        r"(?:(?:tcp|tls|ws|wss|ucx)://)?(?:[^\s:/\[\]]+|\[[0-9A-Fa-f:.%\w]+\]):([0-9]{1,5})", address
    )
    return match is not None and 0 < int(match[1]) <= 65_535


def task_runner(name: str, at_once: int = 1) -> Any:
    """A Prefect task runner by name.

    Args:
        name: `threads`; `dask` for a cluster of this machine's cores that lives as long as the process;
            `dask:ADDRESS` for one that is already there, e.g. `dask:tcp://127.0.0.1:8786`.
        at_once: how many runs use such a runner at the same time.

    Raises:
        ConfigError: for any other name.
    """
    kind, address = check_runner(name)
    if kind == "threads":
        from prefect.task_runners import ThreadPoolTaskRunner

        # One worker per core: the branches of a wave share the machine instead of fighting for it.
        return ThreadPoolTaskRunner(max_workers=usable_cores())
    from flows.dask_runner import ClusterTaskRunner

    return ClusterTaskRunner(address or None, usable_cores(), at_once)
