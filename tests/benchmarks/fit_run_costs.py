"""Fit the packaged cost model to the stores of recorded runs of one machine, and say how well it holds.

    python -m tests.benchmarks.fit_run_costs --fit STORE... --check STORE... [--output run_costs.json]

`--fit` stores give the coefficients; those of `--check` are predicted without them and printed beside what
was spent. Processor time counts; the probe is taken on this machine, now. With `--tasks` only those are
fitted, the others stay as packaged: what these but ingest took in the stores tells how fast this machine is
beside the one of the package.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from extrags.run_costs import CostModel, TaskCost, Workload


def main() -> None:
    """Fit, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fit", nargs="+", required=True, metavar="STORE")
    parser.add_argument("--check", nargs="*", default=[], metavar="STORE")
    parser.add_argument("--leave-one-out", action="store_true", help="predict each run without its records")
    parser.add_argument("--tasks", nargs="+", metavar="TASK", help="fit these alone")
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    import flows.wiring  # noqa: F401  (all stages with their present versions)
    from extrags.config import profile_config
    from extrags.run_costs import fitted, probe_seconds
    from extrags.store import Store
    from flows.run_costs import recorded_costs

    def records(roots: list[str]) -> list[tuple[Workload, TaskCost]]:
        usual = profile_config("quick")
        return [
            item for root in roots for item in recorded_costs(Store(root), usual, of_this_machine=False)[1]
        ]

    known = records(given.fit)
    model = fitted(known, probe_seconds()) if given.tasks is None else with_tasks(known, given.tasks)
    print(f"{len(known)} records, probe {model.probe_s:.4f} s")
    if given.output is not None:
        given.output.write_text(json.dumps(model.to_json(), indent=1) + "\n", encoding="utf-8")
    for name, found in (("fitted", known), ("checked", records(given.check))):
        for work, cost in sorted(found, key=lambda item: (item[1].task, item[0].pixels)):
            if cost.seconds < 0.5:
                continue
            guess = model.predict(cost.task, work)
            memory = ""
            if guess.peak_mib is not None and cost.peak_mib is not None:
                off = guess.peak_mib / cost.peak_mib - 1
                memory = f"  MiB {cost.peak_mib:7.0f} {guess.peak_mib:7.0f} {off:+.0%}"
            print(
                f"{name:8} {cost.task:16} {work.pixels:7.0f} px  s {cost.seconds:7.2f} {guess.seconds:7.2f} "
                f"{guess.seconds / cost.seconds - 1:+.0%}{memory}"
            )
    if given.leave_one_out:
        print_without_each(known)


def with_tasks(known: list[tuple[Workload, TaskCost]], tasks: list[str]) -> CostModel:
    """The packaged model with other coefficients of some tasks, on its own machine."""
    from extrags.run_costs import beyond_the_fit, fitted, packaged_model

    model = packaged_model()
    others = [
        (cost.seconds, model.predict(cost.task, work).seconds)
        for work, cost in known
        if cost.task not in {"ingest", *tasks}
        and cost.task in model.time
        and not beyond_the_fit(cost.task, work.config)
    ]
    slower = sum(spent for spent, _ in others) / sum(usual for _, usual in others)
    print(f"{len(others)} records of other tasks took {slower:.3f} times what the package says")
    own = [(work, replace(cost, seconds=cost.seconds / slower)) for work, cost in known if cost.task in tasks]
    found = fitted(own, model.probe_s)
    return replace(model, time={**model.time, **found.time}, memory={**model.memory, **found.memory})


def print_without_each(known: list[tuple[Workload, TaskCost]]) -> None:
    """Sums of each run's tasks but ingest, and by a fit to the others, with Gaussians as expected before."""
    from extrags.run_costs import fitted

    runs: dict[tuple[float, float, int], list[tuple[Workload, TaskCost]]] = defaultdict(list)
    for work, cost in known:
        runs[float(work.pixels), float(work.train), work.config.coarse.iterations].append((work, cost))
    for (pixels, train, iterations), own in sorted(runs.items()):
        model = fitted([item for other in runs.values() if other is not own for item in other], 1.0)
        pairs = [
            (cost, model.predict(cost.task, replace(work, coarse_gaussians=None, final_gaussians=None)))
            for work, cost in own
            if cost.task != "ingest" and cost.task in model.time
        ]
        spent, guessed = sum(cost.seconds for cost, _ in pairs), sum(guess.seconds for _, guess in pairs)
        most = max((cost.peak_mib or 0.0 for cost, _ in pairs), default=0.0)
        guessed_most = max((guess.peak_mib or 0.0 for _, guess in pairs), default=0.0)
        print(
            f"without {pixels:.0f} px, {train:.0f} frames, {iterations} iterations: s {spent:.0f} "
            f"{guessed:.0f}, MiB {most:.0f} {guessed_most:.0f}"
        )


if __name__ == "__main__":
    main()
