"""A grid of whole runs, methods by budgets by seeds, each in a process of its own and measured there.

All cells of a repeat share one store that begins empty, so that what several cells have in common (the same
frames, the same coarse scene) is made once; each is charged the seconds that were really spent on it within
this grid. Nothing is taken from any other store. What is finished stands in the folder of the grid, by its
settings and by the content of its source: the same command goes on where it was interrupted, and measures
anew what was changed meanwhile.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

from extrags.errors import ConfigError, ExtragsError
from extrags.metrics.regression import MACHINE
from extrags.output_files import write_file
from extrags.store import digest_of
from flows.budgets import Budget, reaching
from flows.outcome import NOT_COUNTED, StageRow
from flows.selection import Chosen

if TYPE_CHECKING:
    from extrags.config import PipelineConfig

__all__ = ["FORMAT", "Cell", "cells_of", "content_of", "in_own_process", "run_cell", "run_grid"]

log = logging.getLogger(__name__)

FORMAT = "extrags-pipeline-grid-1"
_RESOLVED = dict.fromkeys(("budget", "changed", "settings"))
"""What of a cell its settings, all of them together, stand for."""
SHARING = (
    "stages that cells of a repeat have in common were made once; every cell is charged their time. The "
    "process that made them keeps what they took: memory depends on the order of cells, and is on no front"
)
DIED = "the process of this cell died, perhaps for lack of memory"


@dataclass(frozen=True)
class Cell:
    """One run of a grid.

    Args:
        sequence: `DATASET/SEQUENCE[@SETTING]` or a path.
        method: name.
        profile: name.
        budget: its name.
        changed: overrides of the budget that reach the method.
        settings: overrides of all runs, and of those of its sequence.
        seed: of all stages.
        repeat: number of the repeat, from 0.
    """

    sequence: str
    method: str
    profile: str
    budget: str
    changed: dict[str, Any]
    settings: dict[str, Any]
    seed: int
    repeat: int

    @property
    def key(self) -> str:
        """The digest of everything that makes it, but for what it reads (`content_of`)."""
        return digest_of({**asdict(self), "budget": ""})

    def config(self) -> PipelineConfig:
        """All of its settings.

        Raises:
            ConfigError: for an unknown method or profile, or a setting that is wrong.
        """
        from flows.methods import method_config

        return method_config(self.method, self.profile, {**self.settings, **self.changed}, self.seed)


def cells_of(
    sequences: Sequence[Chosen],
    methods: Sequence[str],
    profiles: Sequence[str],
    budgets_of: Callable[[PipelineConfig], Sequence[Budget]],
    seeds: Sequence[int],
    repeats: int,
    settings: dict[str, Any],
) -> list[Cell]:
    """The cells of a grid in the order in which they run; settings that no method takes are found here.

    Args:
        sequences: names, with settings that a manifest gives them.
        methods: names.
        profiles: names.
        budgets_of: the budgets of a run with these settings, which are those of its profile, method and
            sequence, and the overrides: parts and multiples are of what the run would have.
        seeds: of all stages.
        repeats: how often everything is measured, each time from an empty store.
        settings: overrides of all runs; those of a sequence come on top of them.

    Returns:
        Cells without repetitions, the first of those with equal settings: a budget that changes only what a
        method leaves out is the method's `profile` budget.

    Raises:
        ConfigError: for an unknown method or profile, or a setting that is wrong or that the method pins.
    """
    from flows.methods import METHODS, method_config, pinned_settings

    found: dict[str, Cell] = {}
    for repeat, chosen, profile, seed, method in product(range(repeats), sequences, profiles, seeds, methods):
        if method not in METHODS:
            raise ConfigError(f"no method {method!r}; known: {', '.join(METHODS)}")
        own = {**settings, **chosen.settings}
        pinned = pinned_settings(method)
        for budget in budgets_of(method_config(method, profile, own, seed)):
            changed = {
                name: value
                for name, value in reaching(budget, METHODS[method].leave_out).items()
                if name not in pinned
            }
            name = ", ".join(f"{key}={value}" for key, value in changed.items()) or "profile"
            cell = Cell(chosen.name, method, profile, name, changed, own, seed, repeat)
            # What is varied may have the value that the run has anyway.
            resolved = cell.config().model_dump(mode="json")
            found.setdefault(digest_of({**asdict(cell), **_RESOLVED, "config": resolved}), cell)
    return list(found.values())


def content_of(cell: Cell) -> str | None:
    """Digest of what a cell reads: its source, a calibration file, an imported scene, and weights.

    Returns:
        None where something cannot be read: the cell's run then says why.
    """
    from data_catalog.catalog import source_fingerprint
    from tasks.imported import scene_digest
    from tasks.weights import (
        depth_completion_digest,
        depth_monocular_digest,
        lpips_weights,
        refiner_digest,
        restorer_digest,
    )

    config = cell.config()
    try:
        source = source_fingerprint(cell.sequence, config.ingest)
        scene = None if config.imported.scene is None else scene_digest(config.imported)
        weights = [
            restorer_digest(config.enhance),
            refiner_digest(),
            depth_completion_digest(config.depth),
            depth_monocular_digest(config.depth.monocular),
            *(found.digest for found in lpips_weights(config.evaluate)),
        ]
    except ExtragsError as error:
        log.debug("%s cannot be read: %s", cell.sequence, error)
        return None
    return digest_of({"source": source, "scene": scene, "weights": weights})


def run_grid(
    cells: Sequence[Cell],
    folder: Path,
    *,
    separate: bool = False,
    settings: Mapping[str, Any] | None = None,
    run: Callable[[Cell, str], dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """Run all cells that are not finished, and gather all.

    Args:
        cells: from `cells_of`.
        folder: of this grid: stores and finished cells.
        separate: give each cell a store of its own, so that nothing is shared.
        settings: overrides of all runs, as `cells_of` was given them, for the result.
        run: what runs a cell; `in_own_process` by default.

    Returns:
        `{format, machine, protocol, settings, separate, sharing, cases, cells, fronts}`; `cases` as of
        `run_cell`, `cells` their means (`extrags.metrics.fronts.means_by_cell`), `fronts` as of
        `extrags.metrics.fronts.fronts`; none by memory where stages are shared.

    Raises:
        ConfigError: when the folder holds a grid of another machine, version or way of sharing.
    """
    from extrags.metrics.fronts import fronts, means_by_cell
    from extrags.metrics.registry import PROTOCOL_VERSION
    from extrags.raster.bench import machine

    about = machine()
    run = run or in_own_process
    _claim(folder, about, separate)
    cases = []
    for number, cell in enumerate(cells, 1):
        content = content_of(cell)
        name = digest_of([cell.key, content])
        file = folder / "cells" / f"{name}.json"
        if content is not None and file.exists():
            cases.append(json.loads(file.read_text(encoding="utf-8")))
            continue
        where = f"{cell.sequence}, {cell.method}, {cell.profile}, {cell.budget}, seed {cell.seed}"
        log.info("cell %d of %d: %s", number, len(cells), where)
        store = folder / "stores" / (name if separate else f"repeat-{cell.repeat}")
        try:
            case = run(cell, str(store.absolute()))
        except BrokenProcessPool:
            # The other cells go on: the same command would meet the same end at the same place.
            log.warning("%s: %s", where, DIED)
            case = _case_of(cell, error=DIED)
        if not case["error"]:
            # A cell that failed is tried again by the same command.
            _write(file, case)
        cases.append(case)
    means = means_by_cell(cases)
    return {
        "format": FORMAT,
        "machine": about,
        "protocol": PROTOCOL_VERSION,
        "settings": dict(settings or {}),
        "separate": separate,
        "sharing": "none: a store for each cell" if separate else SHARING,
        "cases": cases,
        "cells": means,
        "fronts": [entry for entry in fronts(means) if separate or entry["cost"] != "peak_mib"],
    }


def in_own_process(cell: Cell, store: str) -> dict[str, Any]:
    """`run_cell` in a new process, whose memory is that of this cell alone.

    Raises:
        BrokenProcessPool: when the process dies, for instance for lack of memory.
    """
    with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as pool:
        return pool.submit(run_cell, cell, store).result()


def run_cell(cell: Cell, store: str) -> dict[str, Any]:
    """Run a cell in this process; what fails is in the result, not raised.

    Returns:
        `{method, profile, budget, changed, settings, sequence, setting, seed, repeat, width, height, frames,
        seconds, processor_seconds, peak_mib, shared_seconds, load_average, stages, metrics, error}`. Seconds
        are those of all stages but evaluation, spent within this grid; `shared_seconds` the part of them that
        was spent by a cell before. `stages` has `{stage, state, seconds, processor_seconds, peak_mib,
        shared_seconds}` of each, evaluation too.
    """
    from extrags.store import Store
    from flows.methods import METHODS
    from flows.runners import DirectRunner
    from flows.wiring import run_sequence

    outcome = run_sequence(
        cell.sequence,
        cell.config(),
        store,
        DirectRunner(store),
        profile=cell.profile,
        until="evaluate",
        leave_out=METHODS[cell.method].leave_out or None,
    )
    ran = [row for row in outcome.stages if row.tasks]
    counted = [row for row in ran if row.stage not in NOT_COUNTED]
    processor = [row.processor_seconds for row in counted]
    peaks = [row.peak_mib for row in counted if row.peak_mib is not None]
    failed = next((row for row in outcome.stages if row.state == "failed"), None)
    # Where poses are estimated or refined, the sequence is theirs, and does not count its pixels.
    read = outcome.refs.get("ingest")
    counts = {} if read is None else Store(store).manifest(read).counts
    return _case_of(
        cell,
        **{key: counts.get(key) for key in ("width", "height", "frames")},
        seconds=round(sum(row.made_seconds for row in counted), 3),
        processor_seconds=None
        if None in processor
        else round(sum(value for value in processor if value is not None), 3),
        peak_mib=max(peaks) if peaks else None,
        shared_seconds=round(sum(map(_shared_seconds, counted)), 3),
        stages=[
            {
                "stage": row.stage,
                "state": row.state,
                "seconds": round(row.made_seconds, 3),
                "processor_seconds": row.processor_seconds,
                "peak_mib": row.peak_mib,
                "shared_seconds": round(_shared_seconds(row), 3),
            }
            for row in ran
        ],
        metrics=outcome.metrics["final"] if failed is None else None,
        error="" if failed is None else f"{failed.stage}: {failed.reason}",
    )


def _case_of(cell: Cell, **found: Any) -> dict[str, Any]:
    """The JSON of a case: what the cell is, and what was found; the rest is unknown."""
    name, _, setting = cell.sequence.partition("@")
    return {
        "method": cell.method,
        "profile": cell.profile,
        "budget": cell.budget,
        "changed": cell.changed,
        "settings": cell.settings,
        "sequence": name,
        "setting": setting or None,
        "seed": cell.seed,
        "repeat": cell.repeat,
        **dict.fromkeys(("width", "height", "frames")),
        "seconds": 0.0,
        "processor_seconds": None,
        "peak_mib": None,
        "shared_seconds": 0.0,
        "load_average": round(os.getloadavg()[0], 2),
        "stages": [],
        "metrics": None,
        **found,
    }


def _shared_seconds(row: StageRow) -> float:
    # What was damaged and made twice in this run has spent more than it took to make.
    return max(row.made_seconds - row.spent_seconds, 0.0)


def _claim(folder: Path, about: dict[str, Any], separate: bool) -> None:
    """Times of one machine and one version stand in one folder."""
    mine = {name: about[name] for name in (*MACHINE, "versions", "commit")} | {"separate": separate}
    file = folder / "grid.json"
    if not file.exists():
        _write(file, mine)
        return
    theirs = json.loads(file.read_text(encoding="utf-8"))
    changed = [name for name in mine if theirs.get(name) != mine[name]]
    if changed:
        told = "; ".join(f"{name} was {theirs.get(name)}, is {mine[name]}" for name in changed)
        raise ConfigError(
            f"{folder} holds cells that were measured under other conditions ({told}); "
            "give another folder with --output"
        )


def _write(file: Path, content: dict[str, Any]) -> None:
    """Whole or not at all: an interrupted command leaves no half a cell."""
    file.parent.mkdir(parents=True, exist_ok=True)
    write_file(file, json.dumps(content, indent=1))
