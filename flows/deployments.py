"""The deployments that `prefect.yaml` declares, for `extrags serve`; the file is their only place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from extrags.errors import ConfigError, reason_of
from extrags.yaml_text import read_yaml

__all__ = ["FILE", "Declared", "chosen_deployments", "declared_deployments", "usual_file"]

FILE = "prefect.yaml"
SERVED = (
    "name",
    "entrypoint",
    "description",
    "tags",
    "parameters",
    "schedules",
    "concurrency_limit",
    "work_pool",
)
"""Fields of a deployment that `extrags serve` goes by; of `work_pool`, the environment of the runs."""


@dataclass(frozen=True)
class Declared:
    """One deployment of the file.

    Args:
        file: where it is declared.
        name: `nightly`.
        entrypoint: module path of its flow, `flows.dataset.reconstruct_dataset`.
        parameters: of its runs.
        cron: when it runs, if on a schedule.
        timezone: of the schedule.
        concurrency_limit: number of its runs at the same time, and what becomes of further ones; as Prefect
            has it.
        description: what it is.
        tags: of the deployment.
        environment: variables that its runs are to find.
        unserved: names of what it asks for beside all that: for a work pool, not for `extrags serve`.
    """

    file: Path
    name: str
    entrypoint: str
    parameters: dict[str, Any] = field(default_factory=dict)
    cron: str | None = None
    timezone: str = "UTC"
    concurrency_limit: dict[str, Any] = field(default_factory=dict)
    description: str = ""
    tags: tuple[str, ...] = ()
    environment: dict[str, str] = field(default_factory=dict)
    unserved: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """`FLOW/NAME`, as Prefect calls it.

        Raises:
            ConfigError: for an entrypoint that is no flow of an installed module.
        """
        return f"{self.flow().name}/{self.name}"

    def error(self, what: str) -> ConfigError:
        """That something is wrong with it."""
        return ConfigError(f"{self.file}: deployment {self.name}: {what}")

    def flow(self) -> Any:
        """Its flow, which takes all of its parameters.

        Raises:
            ConfigError: for an entrypoint that is no flow of an installed module, and for an unknown
                parameter or a value that the server would refuse.
        """
        from jsonschema.exceptions import best_match
        from prefect import Flow
        from prefect.utilities.schema_tools.validation import validate

        module, _, name = self.entrypoint.rpartition(".")
        try:
            found = getattr(import_module(module), name)
        except (ImportError, AttributeError, ValueError) as error:
            raise self.error(f"{self.entrypoint!r} is no flow of an installed module") from error
        if not isinstance(found, Flow):
            raise self.error(f"{self.entrypoint!r} is no flow")
        known = list(found.parameters.properties)
        for parameter in self.parameters:
            if parameter not in known:
                raise self.error(f"parameters.{parameter}: {found.name} has {', '.join(known)}")
        schema = found.parameters.model_dump_for_openapi()
        # As the server does when a run is asked for, which gives the parameters that are missing here. All
        # errors are asked for: to raise one, Prefect checks first that the schema is one, which takes
        # longer than everything else.
        fault = best_match(validate(self.parameters, schema, ignore_required=True))
        if fault is not None:
            place = fault.json_path.replace("$", "parameters", 1)
            raise self.error(f"{place}: {fault.message}") from fault
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
        content = read_yaml(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file} cannot be read: {reason_of(error)}") from error
    entries = content.get("deployments") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not entries:
        raise ConfigError(f"{file} declares no deployments")
    return [_declared(entry, file) for entry in entries]


def chosen_deployments(declared: Sequence[Declared], names: Sequence[str]) -> list[Declared]:
    """Those that are named, in the order of their file; all without names.

    Args:
        declared: of one file.
        names: `FLOW/NAME`, or `NAME` where only one is called so.

    Raises:
        ConfigError: for a name that none has, or that deployments of several flows have.
    """
    if not names:
        return list(declared)
    chosen = []
    for name in names:
        found = [item for item in declared if name == (item.title if "/" in name else item.name)]
        if not found:
            known = ", ".join(item.title for item in declared)
            raise ConfigError(f"no deployment {name!r}; known: {known}")
        if len(found) > 1:
            choices = ", ".join(item.title for item in found)
            raise ConfigError(f"{name!r} names {len(found)} deployments; give one of {choices}")
        chosen += found
    return [item for item in declared if item in chosen]


def _declared(entry: Any, file: Path) -> Declared:
    if not isinstance(entry, dict) or not all(
        isinstance(entry.get(name), str) for name in ("name", "entrypoint")
    ):
        raise ConfigError(f"{file}: a deployment needs a name and an entrypoint")
    place = f"{file}: deployment {entry['name']}"
    schedules = entry.get("schedules") or [{}]
    if (
        not isinstance(schedules, list)
        or len(schedules) > 1
        or not isinstance(schedules[0], dict)
        or not set(schedules[0]) <= {"cron", "timezone", "active"}
    ):
        raise ConfigError(f"{place}: expected one schedule at most, with cron and timezone")
    if entry.get("schedules") and not isinstance(schedules[0].get("cron"), str):
        raise ConfigError(f'{place}: schedules: expected cron as a text, e.g. "0 2 * * *"')
    tags = entry.get("tags") or []
    if not isinstance(tags, list):
        raise ConfigError(f"{place}: tags: expected a list")
    limit = entry.get("concurrency_limit")
    limit = limit if isinstance(limit, dict) else {"limit": limit}
    variables = _fields(_fields(entry, "work_pool", place), "job_variables", place)
    others = {name: value for name, value in entry.items() if name not in SERVED}
    others |= {f"work_pool.job_variables.{name}": value for name, value in variables.items() if name != "env"}
    return Declared(
        file=file,
        name=entry["name"],
        entrypoint=entry["entrypoint"],
        parameters=_fields(entry, "parameters", place),
        cron=schedules[0].get("cron"),
        timezone=schedules[0].get("timezone") or "UTC",
        concurrency_limit={name: value for name, value in limit.items() if value is not None},
        description=entry.get("description", ""),
        tags=tuple(map(str, tags)),
        environment={name: str(value) for name, value in _fields(variables, "env", place).items()},
        # `prefect deploy` writes fields without a value.
        unserved=tuple(name for name, value in others.items() if value not in (None, "", [], {})),
    )


def _fields(entry: dict[str, Any], name: str, place: str) -> dict[str, Any]:
    found = entry.get(name) or {}
    if not isinstance(found, dict):
        raise ConfigError(f"{place}: {name}: expected fields with values")
    return found
