"""`@stage`: a function that fills one artefact becomes a cached Prefect task that returns its ref.

    @stage("coarse", version=1)
    def coarse(slot: Slot, sequence: Ref, config: CoarseConfig) -> None:
        slot.save(reconstruct(slot.load(EndoscopicSequence, sequence), config).scene)

is called as `coarse(store="...", label="...", sequence=ref, config=config)`, inside a flow or, through
`coarse.fn(...)`, without any server.

The artefact's manifest is the only cache record. `ArtefactRecords` presents it to Prefect as a result record,
so records and artefacts cannot become inconsistent: a task run is `Cached` if and only if its artefact
exists, even after a kill between writing the artefact and Prefect's own commit.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from importlib import import_module
from pkgutil import iter_modules
from typing import Any, Concatenate, ParamSpec

from prefect import Task
from prefect.cache_policies import CachePolicy
from prefect.context import TaskRunContext
from prefect.filesystems import WritableFileSystem
from prefect.results import ResultRecord, ResultRecordMetadata  # type: ignore[attr-defined]
from prefect.serializers import JSONSerializer
from prefect.transactions import IsolationLevel, get_transaction
from pydantic import BaseModel

from extrags.errors import ConfigError
from extrags.store import Ref, Slot, Store, canonical, digest_of
from tasks.locks import FlockManager
from tasks.machine import machine_counts
from tasks.memory import peak_memory
from tasks.progress import reporting
from tasks.run_log import run_log
from tasks.run_page import stage_page
from tasks.spent_time import spent_time

__all__ = [
    "ArtefactRecords",
    "StageKey",
    "all_stage_versions",
    "at",
    "fill",
    "refreshing",
    "stage",
    "stage_key",
    "stage_versions",
]

P = ParamSpec("P")

NOT_IN_KEY = frozenset({"store", "label", "place", "time_limit_s", "threads"})
"""Parameters of every stage that do not affect the content of its artefact: store, display name, where the
sequence is, limit, threads."""

DEVICE = "device"
"""Parameter of stages that may run on a GPU: cpu or cuda. Their results differ by rounding: it counts."""

_versions: dict[str, int] = {}
_refresh: ContextVar[bool] = ContextVar("refresh", default=False)


@dataclass
class StageKey(CachePolicy):
    """Cache policy: key = stage name + version (raised by hand) + canonical inputs; no source, no run id."""

    name: str = ""
    version: int = 0
    ignore: tuple[str, ...] = ()
    """Further arguments that do not change what is in the artefact."""

    def compute_key(
        self,
        task_ctx: TaskRunContext | None,
        inputs: dict[str, Any] | None,
        flow_parameters: dict[str, Any] | None,
        **_: Any,
    ) -> str:
        """Compute the cache key of a task run.

        Raises:
            ConfigError: for inputs without a canonical form.
        """
        left_out = NOT_IN_KEY.union(self.ignore)
        counted = {name: value for name, value in (inputs or {}).items() if name not in left_out}
        # The processor is what all was made on before there was a choice: its keys stay.
        if counted.get(DEVICE) == "cpu":
            del counted[DEVICE]
        return f"{self.name}-v{self.version}-{digest_of(counted)}"


class ArtefactRecords(WritableFileSystem):
    """The artefact store as a Prefect file system for result records.

    Args:
        root: the store's root.
    """

    _block_type_name = "extrags store"

    root: str

    def _resolve_path(self, path: str) -> None:
        """Keys are names, not paths: nothing to resolve."""

    def read_path(self, path: str, _sync: bool = True) -> bytes:  # type: ignore[override]
        """The result record of a key, derived from its artefact.

        Raises:
            FileNotFoundError: without an artefact; Prefect then runs the task.
        """
        # A damaged artefact is no artefact: Prefect then makes it.
        ref = Store(self.root).find_or_set_aside(path)
        if ref is None:
            raise FileNotFoundError(path)
        metadata = ResultRecordMetadata(storage_key=path, serializer=JSONSerializer())
        return ResultRecord[Ref](metadata=metadata, result=ref).serialize()

    async def aread_path(self, path: str) -> bytes:
        """As `read_path`."""
        return self.read_path(path)

    def write_path(self, path: str, content: bytes, _sync: bool = True) -> None:  # type: ignore[override]
        """Do nothing: the stage has committed its artefact, and failures have no record."""

    async def awrite_path(self, path: str, content: bytes) -> None:
        """As `write_path`."""


def stage(
    name: str, *, version: int, ignore: tuple[str, ...] = ()
) -> Callable[[Callable[Concatenate[Slot, P], None]], Task[..., Ref]]:
    """Decorator factory: turn a function that writes a slot into a cached Prefect task.

    Args:
        name: name of the stage; part of the key.
        version: raised by hand whenever the same inputs give another artefact.
        ignore: arguments that are not part of the key, because others determine the result (e.g. a path
            whose content is given by a digest).

    Returns:
        A decorator. Its task takes the function's arguments by name, and in addition `store` (root of the
        store), `label` (display name of the sequence), `place` (its absolute path, if it is one),
        `time_limit_s` (see `tasks.progress.reporting`) and `threads` (of the kernels, where other processes
        share the cores; all by default); it returns a `Ref`. Arguments must be refs, settings or plain
        values, since their canonical form is the key.

    Raises:
        ConfigError: when two stages share a name.
    """

    def decorate(body: Callable[Concatenate[Slot, P], None]) -> Task[..., Ref]:
        if _versions.setdefault(name, version) != version:
            raise ConfigError(f"two versions of stage {name}: {_versions[name]} and {version}")
        key_of = StageKey(name=name, version=version, ignore=ignore)
        signature = _own_signature(body)

        @functools.wraps(body)
        def run(
            *,
            store: str,
            label: str = "",
            place: str = "",
            time_limit_s: float | None = None,
            threads: int | None = None,
            **inputs: Any,
        ) -> Ref:
            where = Store(store)
            bound = signature.bind(**inputs)
            bound.apply_defaults()
            inputs = dict(bound.arguments)
            key = key_of.compute_key(None, inputs, None)
            found = where.find_or_set_aside(key)
            if found is not None and not _refreshing():
                return found
            return _made(body, key_of, key, inputs, where, label, place, time_limit_s, threads)

        run.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
            [*signature.parameters.values(), *_PARAMETERS_OF_ALL], return_annotation=Ref
        )
        return Task(
            fn=run,
            name=name,
            version=str(version),
            task_run_name=f"{name} {{label}}",
            cache_policy=key_of,
            persist_result=True,
            result_serializer=JSONSerializer(),
            cache_result_in_memory=False,
        )

    return decorate


_PARAMETERS_OF_ALL = tuple(
    inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=annotation, default=default)
    for name, annotation, default in (
        ("store", str, inspect.Parameter.empty),
        ("label", str, ""),
        ("place", str, ""),
        ("time_limit_s", float | None, None),
        ("threads", int | None, None),
    )
)
"""What every stage takes beside its own arguments."""


def _own_signature(body: Callable[..., None]) -> inspect.Signature:
    """The arguments of a stage's function after the slot, by name alone."""
    own = list(inspect.signature(body).parameters.values())[1:]
    return inspect.Signature([parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in own])


def _made(
    body: Callable[..., None],
    key_of: StageKey,
    key: str,
    inputs: dict[str, Any],
    where: Store,
    label: str,
    place: str,
    time_limit_s: float | None,
    threads: int | None,
) -> Ref:
    """Fill a new slot by a stage's function, and commit it."""
    # Here, because it loads torch, which looking up an artefact must not.
    from extrags.threads import kernel_threads, one_torch_thread

    # What a key ignores may be an artefact all the same: the lineage has it, the settings have not.
    refs, settings = _split(
        {name: value for name, value in inputs.items() if name not in key_of.ignore or isinstance(value, Ref)}
    )
    with (
        run_log(),
        stage_page(),
        reporting(label, key_of.name, time_limit_s),
        where.slot(
            stage=key_of.name,
            version=key_of.version,
            key=key,
            label=label,
            place=place,
            config=settings,
            inputs=refs,
            renew=_refreshing(),
        ) as slot,
    ):
        # Workers with other numbers of threads share the store.
        with peak_memory() as peak, spent_time() as spent, kernel_threads(threads), one_torch_thread():
            body(slot, **inputs)
        slot.counts["peak_mib"] = peak.mib
        slot.counts.update(elapsed_s=spent.elapsed_s, processor_s=spent.processor_s)
        slot.counts.update(machine_counts(inputs))
    return slot.ref


def fill(task: Task[..., Ref], slot: Slot, inputs: Mapping[str, Any]) -> None:
    """Let a stage write into a slot that becomes no artefact, where the store itself cannot be written.

    Args:
        task: made by `stage`.
        slot: of a folder outside the store that its inputs are read from.
        inputs: the stage's own arguments, by name.
    """
    body: Callable[..., None] = inspect.unwrap(task.fn)
    body(slot, **inputs)


def at(task: Task[..., Ref], store: str, *, refresh: bool = False) -> Task[..., Ref]:
    """Configure a task to cache in a store, with locks so that only one process computes a key at a time.

    Args:
        task: made by `stage`.
        store: root of the store.
        refresh: run it even if its artefact exists.
    """
    policy = task.cache_policy
    if not isinstance(policy, StageKey):
        raise ConfigError(f"task {task.name} is not a stage")
    bound = task.with_options(
        cache_policy=policy.configure(
            lock_manager=FlockManager(Store(store).locks), isolation_level=IsolationLevel.SERIALIZABLE
        )
    )
    if refresh:
        bound = bound.with_options(refresh_cache=True)
    # `with_options` accepts only blocks saved on a server; this one is not saved, it only wraps a path.
    bound.result_storage = ArtefactRecords(root=store)
    return bound


def stage_key(task: Task[..., Ref], inputs: Mapping[str, Any]) -> str:
    """The key of a stage for the given inputs, defaults included, without running anything.

    Raises:
        ConfigError: for inputs without a canonical form, or a task that is no stage.
    """
    policy = task.cache_policy
    if not isinstance(policy, StageKey):
        raise ConfigError(f"task {task.name} is not a stage")
    bound = inspect.signature(task.fn).bind(store="", **inputs)
    bound.apply_defaults()
    return policy.compute_key(None, dict(bound.arguments), None)


def stage_versions() -> dict[str, int]:
    """Current version of every stage that has been imported."""
    return dict(_versions)


def all_stage_versions() -> dict[str, int]:
    """Current version of every stage there is; imports all modules of this package."""
    import tasks

    for module in iter_modules(tasks.__path__):
        import_module(f"tasks.{module.name}")
    return stage_versions()


@contextmanager
def refreshing() -> Iterator[None]:
    """In this block stages that are called without Prefect run although their artefacts are there.

    An artefact stays until the new one is committed in its place.
    """
    token = _refresh.set(True)
    try:
        yield
    finally:
        _refresh.reset(token)


def _refreshing() -> bool:
    transaction = get_transaction()
    return _refresh.get() or (transaction is not None and transaction.overwrite)


def _split(inputs: Mapping[str, Any]) -> tuple[dict[str, Ref], dict[str, Any]]:
    """Refs by argument (lists numbered, dicts by name), and everything else as JSON for the manifest."""
    refs: dict[str, Ref] = {}
    settings: dict[str, Any] = {}
    for name, value in inputs.items():
        if isinstance(value, Ref):
            refs[name] = value
        elif isinstance(value, list | tuple) and value and all(isinstance(item, Ref) for item in value):
            refs |= {f"{name}[{index}]": item for index, item in enumerate(value)}
        elif isinstance(value, dict) and value and all(isinstance(item, Ref) for item in value.values()):
            refs |= {f"{name}.{part}": item for part, item in value.items()}
        else:
            settings[name] = _json(value)
    return refs, settings


def _json(value: Any) -> Any:
    if isinstance(value, Ref):
        return value.digest
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, list | tuple):
        return [_json(item) for item in value]
    if isinstance(value, dict):
        return {name: _json(item) for name, item in value.items()}
    canonical(value)
    return value
