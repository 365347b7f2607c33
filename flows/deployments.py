"""The deployments that `prefect.yaml` declares, for `extrags serve`; the file is their only place."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import yaml

from extrags.errors import ConfigError

__all__ = ["FILE", "Declared", "declared_deployments", "usual_file"]

FILE = "prefect.yaml"


@dataclass(frozen=True)
class Declared:
    """One deployment of the file.

    Args:
        name: `nightly`.
        entrypoint: module path of its flow, `flows.dataset.reconstruct_dataset`.
        parameters: of its runs.
        cron: when it runs, if on a schedule.
        timezone: of the schedule.
        limit: of its runs at the same time; further ones wait.
        description: what it is.
        tags: of the deployment.
    """

    name: str
    entrypoint: str
    parameters: dict[str, Any] = field(default_factory=dict)
    cron: str | None = None
    timezone: str = "UTC"
    limit: int | None = None
    description: str = ""
    tags: tuple[str, ...] = ()

    def flow(self) -> Any:
        """Its flow.

        Raises:
            ConfigError: for an entrypoint that is no flow of an installed module.
        """
        from prefect import Flow

        module, _, name = self.entrypoint.rpartition(".")
        try:
            found = getattr(import_module(module), name)
        except (ImportError, AttributeError, ValueError) as error:
            raise ConfigError(
                f"deployment {self.name}: {self.entrypoint!r} is no flow of an installed module"
            ) from error
        if not isinstance(found, Flow):
            raise ConfigError(f"deployment {self.name}: {self.entrypoint!r} is no flow")
        return found


def usual_file() -> Path:
    """The `prefect.yaml` of this installation.

    Raises:
        ConfigError: when there is none.
    """
    here = Path(__file__).resolve().parent
    # Beside the package in a checkout, inside it where it was installed from a wheel.
    for file in (here.parent / FILE, here / FILE):
        if file.is_file():
            return file
    raise ConfigError(f"no {FILE} comes with this installation; name one with --file")


def declared_deployments(file: Path) -> list[Declared]:
    """Read the deployments of a file.

    Raises:
        ConfigError: for a file that cannot be read, or a deployment without name or entrypoint.
    """
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"{file} cannot be read: {error}") from error
    entries = content.get("deployments") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not entries:
        raise ConfigError(f"{file} declares no deployments")
    return [_declared(entry, file) for entry in entries]


def _declared(entry: Any, file: Path) -> Declared:
    if not isinstance(entry, dict) or not all(
        isinstance(entry.get(name), str) for name in ("name", "entrypoint")
    ):
        raise ConfigError(f"{file}: a deployment needs a name and an entrypoint")
    schedules = entry.get("schedules") or [{}]
    if len(schedules) > 1 or not set(schedules[0]) <= {"cron", "timezone", "active"}:
        raise ConfigError(
            f"{file}: deployment {entry['name']}: expected one schedule at most, with cron and timezone"
        )
    limit = entry.get("concurrency_limit")
    return Declared(
        name=entry["name"],
        entrypoint=entry["entrypoint"],
        parameters=entry.get("parameters") or {},
        cron=schedules[0].get("cron"),
        timezone=schedules[0].get("timezone", "UTC"),
        limit=limit.get("limit") if isinstance(limit, dict) else limit,
        description=entry.get("description", ""),
        tags=tuple(entry.get("tags") or ()),
    )
