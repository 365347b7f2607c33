"""Fit the packaged cost model to the stores of recorded runs of one machine, and say how well it holds.

    python -m tests.benchmarks.fit_run_costs --fit STORE... --check STORE... [--output run_costs.json]

`--fit` stores give the coefficients; those of `--check` are predicted without them and printed beside what
was spent. Processor time counts; the probe is taken on this machine, now.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from extrags.run_costs import TaskCost, Workload


def main() -> None:
    """Fit, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fit", nargs="+", required=True, metavar="STORE")
    parser.add_argument("--check", nargs="*", default=[], metavar="STORE")
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    import flows.wiring  # noqa: F401  (all stages with their present versions)
    from extrags.config import profile_config
    from extrags.run_costs import fitted, probe_seconds
    from extrags.store import Store
    from flows.run_costs import recorded_costs

    def records(roots: list[str]) -> list[tuple[Workload, TaskCost]]:
        usual = profile_config("quick")
        return [item for root in roots for item in recorded_costs(Store(root), usual)[1]]

    known = records(given.fit)
    model = fitted(known, probe_seconds())
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


if __name__ == "__main__":
    main()
