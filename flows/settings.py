"""Parameters that flows and commands share: store, profile and settings, task runner."""

from __future__ import annotations

import os
from typing import Any

from extrags.config import PipelineConfig, profile_config
from extrags.errors import ConfigError

__all__ = [
    "DEFAULT_STORE",
    "default_store",
    "pipeline_config",
    "task_runner",
    "usable_cores",
]

DEFAULT_STORE = ".extrags"


def default_store() -> str:
    """Root of the store when none is named: EXTRAGS_STORE, else `.extrags` here."""
    return os.environ.get("EXTRAGS_STORE") or DEFAULT_STORE


def pipeline_config(
    profile: str, settings: dict[str, Any] | None = None, seed: int | None = None
) -> PipelineConfig:
    """A profile with overrides and, if given, every stage's seed.

    Raises:
        ConfigError: for an unknown profile or setting, or a value out of range.
    """
    config = profile_config(profile)
    if seed is not None:
        if seed < 0:
            raise ConfigError(f"the seed is {seed}; expected 0 or more")
        config = config.with_seed(seed)
    return config.with_overrides(settings or {})


def task_runner(name: str, at_once: int = 1) -> Any:
    """A Prefect task runner by name.

    Args:
        name: `threads`; `dask` for a cluster of this machine's cores that lives as long as the process;
            `dask:ADDRESS` for one that is already there, e.g. `dask:tcp://127.0.0.1:8786`.
        at_once: how many runs use such a runner at the same time.

    Raises:
        ConfigError: for any other name.
    """
    kind, _, address = name.partition(":")
    if kind == "threads" and not address:
        from prefect.task_runners import ThreadPoolTaskRunner

        # One worker per core: the branches of a wave share the machine instead of fighting for it.
        return ThreadPoolTaskRunner(max_workers=usable_cores())
    if kind == "dask":
        from flows.dask_runner import ClusterTaskRunner

        return ClusterTaskRunner(address or None, usable_cores(), at_once)
    raise ConfigError(f"no task runner {name!r}; expected threads, dask or dask:ADDRESS")


def usable_cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0))
