"""`plan`: which stages a scene needs, why, and what they will cost."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from extrags.errors import ConfigError, ExtragsError
from flows.commands.common import run_config, store_root, write_json
from flows.commands.options import Parser, add_json, add_method, add_runner, add_sequence
from flows.commands.run import execute

if TYPE_CHECKING:
    from extrags.config import PipelineConfig
    from extrags.run_costs import Workload
    from extrags.stages import StageName
    from flows.run_costs import RunPrediction

__all__ = ["add_arguments", "plan", "print_prediction"]


def add_arguments(parser: Parser) -> None:
    """The options of `extrags plan`."""
    parser.description = (
        "Read, reconstruct coarsely and measure a scene, say which stages it needs, and predict what each "
        "will cost: processor time and memory of a whole run from an empty store, on this machine."
    )
    parser.set_defaults(command=plan)
    add_sequence(parser)
    parser.add_argument(
        "--before",
        action="store_true",
        help="run nothing: predict the cost from the catalogue, or from names and headers of the files",
    )
    add_method(parser)
    add_runner(parser)
    add_json(parser)


def plan(given: argparse.Namespace) -> int:
    """`extrags plan`.

    Raises:
        ConfigError: for a method that has no plan.
    """
    from extrags.pipeline import needs_plan
    from extrags.store import Store
    from flows.methods import METHODS

    left_out = METHODS[given.method].leave_out
    if given.before:
        predicted = _before(given, run_config(given), left_out)
        if given.json != "-":
            print_prediction(predicted)
        write_json({"sequence": given.sequence, "predicted": predicted.to_json()}, given.json)
        return 0
    if not needs_plan(left_out):
        raise ConfigError(f"no stage of the method {given.method} depends on a plan, so it has none")
    (outcome,) = execute([given.sequence], given, until="assess").sequences
    if outcome.status == "failed":
        raise outcome.error or ExtragsError(f"{outcome.name} failed")
    from extrags.provenance import ARBITRARY_SCALE
    from extrags.run_costs import packaged_model
    from flows.console import print_plan
    from flows.run_costs import pace_here, planned_work, predict_run, unplanned_work
    from flows.workloads import at_detail_size, detail_flags

    store, config = Store(store_root(given)), run_config(given)
    unplanned, unplanned_stages = unplanned_work(store, outcome, config)
    # With the settings that an imported scene leads to.
    pace = pace_here(store, unplanned.config, packaged_model())

    def cost(work: Workload, stages: set[StageName]) -> RunPrediction:
        scenes = 2 if "finetune" in stages else 1
        return predict_run(store, work, stages, measured_scenes=scenes, pace=pace)

    work, stages = planned_work(store, outcome, config)
    predicted = cost(work, stages)
    whole = cost(unplanned, unplanned_stages)
    counts = store.manifest(outcome.refs["ingest"]).counts
    smaller = at_detail_size(work, counts)
    reduced = None if smaller is None else cost(smaller, stages)
    if given.json != "-":
        scale = store.manifest(outcome.refs["sequence"]).counts.get("scale")
        print_plan(outcome, metric=scale != ARBITRARY_SCALE)
        print_prediction(predicted, whole)
        if reduced is not None:
            print_detail(str(counts["detail"]), detail_flags(config, counts), predicted, reduced)
    write_json(
        {
            "sequence": outcome.name,
            **(outcome.plan or {}),
            "predicted": predicted.to_json(),
            "without_plan": whole.to_json(),
            "detail": None
            if reduced is None
            else {
                "width": counts["detail_width"],
                "height": counts["detail_height"],
                "predicted": reduced.to_json(),
            },
        },
        given.json,
    )
    return 0


def _before(given: argparse.Namespace, config: PipelineConfig, left_out: Mapping[str, str]) -> RunPrediction:
    """What a run would cost; looks into the store, and makes none where there is none."""
    from extrags.store import Store
    from flows.environment import prepare

    store = Store(store_root(given))
    with TemporaryDirectory(prefix="extrags-") as elsewhere:
        prepare(store.state if store.exists() else Path(elsewhere), debug=given.debug)
        from flows.run_costs import predict_run
        from flows.workloads import work_before_reading

        work, stages = work_before_reading(given.sequence, config, left_out)
        return predict_run(store, work, stages, measured_scenes=2 if "finetune" in stages else 1)


def print_detail(found: str, flags: str, predicted: RunPrediction, reduced: RunPrediction) -> None:
    """What frames of the size that keeps their detail would save.

    Args:
        found: the size, in words.
        flags: what asks for it.
        predicted: of the run as it is.
        reduced: of the same run with such frames.
    """
    from flows.terminal import console

    seconds, smaller = predicted.processor_seconds, reduced.processor_seconds
    console().print(
        f"frames hold {found}: {flags} would take {smaller:.0f} s of processor time in place of "
        f"{seconds:.0f}",
        soft_wrap=True,
    )


def print_prediction(predicted: RunPrediction, whole: RunPrediction | None = None) -> None:
    """What a run will cost, stage by stage and in all.

    Args:
        predicted: of the run.
        whole: of one that is not planned, of which the savings are taken; None shows none.
    """
    from rich.table import Table

    from flows.terminal import console

    table = Table(box=None, pad_edge=False, header_style="bold", title="predicted cost of a whole run")
    table.add_column("stage")
    names = ["processor s", "elapsed s", "peak MiB"]
    for name in names if whole is None else [*names, "without the plan: processor s"]:
        table.add_column(name, justify="right")
    planned = {item.stage: item for item in predicted.stages}
    costs: list[tuple[str, list[float | None]]] = []
    for item in predicted.stages if whole is None else whole.stages:
        own = planned.get(item.stage)
        row = [0.0, None, None] if own is None else [own.processor_seconds, own.seconds, own.peak_mib]
        costs.append((item.stage, [*row, item.processor_seconds]))
    total = [predicted.processor_seconds, predicted.seconds, predicted.peak_mib]
    costs.append(("total", [*total, 0.0 if whole is None else whole.processor_seconds]))
    for stage, row in costs:
        shown = row[:-1] if whole is None else row
        texts = (("-" if cost is None else f"{cost:.0f}" if cost >= 10 else f"{cost:.1f}") for cost in shown)
        table.add_row(stage, *texts)
    out = console()
    out.print(table)
    rasteriser = predicted.source.removeprefix("probe of ")
    sources = {
        "history": f"at the pace of {predicted.records} records in this store",
        "probe": "at the speed that a short probe of this machine has shown; elapsed time is not predicted",
    }
    slow = (
        f"the compiled kernels are missing: rendering at the speed that a short probe of the {rasteriser} "
        "rasteriser has shown, all else as on the reference machine"
    )
    unknown = f"; not known: {', '.join(predicted.unknown)}" if predicted.unknown else ""
    out.print(f"[dim]{sources.get(predicted.source, slow)}{unknown}[/]", soft_wrap=True)
