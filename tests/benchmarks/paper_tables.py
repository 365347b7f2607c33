"""Tables of docs/results.md and the pages beside it, as Markdown, from results of `extrags benchmark --json`.

`python tests/benchmarks/paper_tables.py methods|ablation|budget FILE...` and `... judge STORE`

* `methods`: every method by dataset, setting and region, plain and aligned, with the share of the way to the
  oracle and the differences of `extrags` to `3dgs`.
* `ablation`: each variant less `extrags`, scene by scene, and the mean with its 95 % interval.
* `budget`: the coarse and the final scene by budget.
* `judge`: what fine-tuning changed on training frames left out of a trial, of every run in a store.

Runs of several files are put together; a run that two files hold has to be the same in both.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from extrags.finetuning_judge import AMOUNTS
from extrags.metrics.comparison import CEILING, compare_runs, dataset_of, paired, spread
from extrags.metrics.registry import metric_named
from flows.tables import difference_text, figure, markdown_table, share_text, spread_text

METRICS = ("psnr", "ssim", "lpips_alex", "lpips_vgg", "flip", "depth_absrel")
REGIONS = ("whole", "observed", "unobserved")
ABLATED = (
    "aligned.psnr",
    "observed.aligned.psnr",
    "unobserved.aligned.psnr",
    "aligned.lpips_alex",
    "observed.depth_absrel",
)

KEPT = {None: "the coarse scene", 0.0: "real views alone"}


def cases_of(files: Iterable[Path]) -> list[dict[str, Any]]:
    """Runs of all files, each once.

    Raises:
        SystemExit: where two files disagree about a run, or a run failed.
    """
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    for file in files:
        for case in json.loads(file.read_text())["cases"]:
            key = tuple(case[name] for name in ("profile", "sequence", "setting", "seed", "method"))
            if case["metrics"] is None:
                raise SystemExit(f"{file}: {key} failed: {case['error']}")
            if found.setdefault(key, case)["metrics"] != case["metrics"]:
                raise SystemExit(f"{file}: {key} has other figures in another file")
    return list(found.values())


def path_of(metric: str, region: str, *, aligned: bool) -> str:
    """Where a figure is in the tree of metrics: `observed.aligned.psnr`."""
    parts = [] if region == "whole" else [region]
    return ".".join([*parts, *(["aligned"] if aligned else []), metric])


def methods_tables(cases: Sequence[dict[str, Any]]) -> str:
    """All methods of all datasets."""
    comparison = compare_runs(cases, "3dgs")
    order = list(dict.fromkeys(case["method"] for case in cases))
    texts = []
    for dataset in dict.fromkeys(dataset_of(case) for case in cases):
        runs = [case for case in cases if dataset_of(case) == dataset]
        several = len({case["sequence"] for case in runs}) > 1
        rows = comparison["datasets" if several else "sequences"]
        by_method = {row["method"]: row for row in rows if _about(row) == dataset}
        shares = {row["method"]: row for row in comparison["ceiling_datasets"] if row["dataset"] == dataset}
        each = sorted({case["seed"] for case in runs})
        seeds = f"seed{'s' * (len(each) > 1)} {', '.join(str(seed) for seed in each)}"
        over = "scenes" if several else "seeds"
        spread = f" Mean ± standard deviation over {over}." if several or len(each) > 1 else ""
        named = ", ".join(dict.fromkeys(case["sequence"] for case in runs))
        texts.append(f"### {dataset}\n\n{named}; {seeds}.{spread}\n")
        seconds = {
            method: sum(times) / len(times)
            for method in order
            if (times := [case["seconds"] for case in runs if case["method"] == method])
        }
        given = {name for row in by_method.values() for name in row["figures"]}
        measured = [metric for metric in METRICS if metric in given]
        for aligned in (False, True):
            shown = [metric for metric in measured if not (aligned and metric.startswith("depth"))]
            table = []
            for region in REGIONS:
                for method in [method for method in order if method in by_method]:
                    names = [path_of(metric, region, aligned=aligned) for metric in shown]
                    figures = by_method[method]["figures"]
                    if names[0] not in figures:
                        continue
                    share = shares.get(method, {"figures": {}})["figures"].get(names[0])
                    table.append(
                        [
                            region,
                            f"**{method}**" if method == "extrags" else method,
                            *(spread_text(name, figures.get(name)) for name in names),
                            share_text(names[0], share),
                            f"{seconds[method]:.0f}",
                        ]
                    )
            labels = [metric_named(metric).label for metric in shown]
            head = ["region", "method", *labels, f"share of the way to {CEILING}, PSNR", "seconds"]
            title = "Aligned by one gain for each view:" if aligned else "As rendered:"
            texts.append(f"{title}\n\n{markdown_table(head, table)}\n")
    paired = [row for row in comparison["paired_datasets"] if row["method"] == "extrags"]
    names = ["psnr", "observed.psnr", "unobserved.psnr", "lpips_alex", "lpips_vgg", "depth_absrel"]
    table = [
        [row["dataset"], row["n_sequences"], row["n_seeds"]]
        + [difference_text(name, row["figures"].get(name)) for name in names]
        for row in paired
    ]
    differences = markdown_table(["dataset", "scenes", "seeds", *names], table)
    texts.append(f"### `extrags` less `3dgs`\n\nMean over scenes and its 95 % interval.\n\n{differences}\n")
    return "\n".join(texts)


def ablation_tables(cases: Sequence[dict[str, Any]]) -> str:
    """Each variant less the whole method: scene by scene, and the mean over all with its interval."""
    scenes = list(dict.fromkeys((case["sequence"], case["setting"]) for case in cases))
    variants = [name for name in dict.fromkeys(case["method"] for case in cases) if name != "extrags"]
    texts = []
    for name in ABLATED:
        table = []
        for variant in variants:
            # Seeds of a scene are one sample: its mean.
            each: dict[tuple[str, str], list[float]] = {}
            for case, difference in paired(cases, variant, "extrags", name):
                each.setdefault((case["sequence"], case["setting"]), []).append(difference)
            means = {scene: sum(found) / len(found) for scene, found in each.items()}
            single = [
                difference_text(name, asdict(spread([means[scene]])) if scene in means else None)
                for scene in scenes
            ]
            table.append([variant, *single, difference_text(name, asdict(spread(list(means.values()))))])
        head = ["without", *("@".join(filter(None, scene)) for scene in scenes), "mean"]
        texts.append(f"`{name}`:\n\n{markdown_table(head, table)}\n")
    return "\n".join(texts)


def budget_tables(cases: Sequence[dict[str, Any]]) -> str:
    """Figures of `coarse` and `extrags`, and of their variants `coarse-2x`, `final-2x`, ..., by dataset."""
    comparison = compare_runs(cases, cases[0]["method"])
    names = [
        "psnr",
        "aligned.psnr",
        "observed.psnr",
        "unobserved.psnr",
        "observed.ssim",
        "lpips_alex",
        "observed.depth_absrel",
    ]
    rows = []
    for row in comparison["datasets"]:
        runs = [
            case for case in cases if case["method"] == row["method"] and dataset_of(case) == row["dataset"]
        ]
        stage, _, factor = row["method"].replace("extrags", "final").partition("-")
        seconds = sum(case["seconds"] for case in runs) / len(runs)
        figures = [figure(name, row["figures"][name]["mean"]) for name in names]
        budget = float(factor.rstrip("x") or 1)
        rows.append([row["dataset"], stage, budget, *figures, f"{seconds:.0f}"])
    head = ["dataset", "scene", "budget", *names, "seconds"]
    return markdown_table(head, [[*row[:2], f"{row[2]:g}x", *row[3:]] for row in sorted(rows)])


def judge_table(store: Path) -> str:
    """The trials of all judgements in a store; sequences that train on the same frames share one.

    Of judgements of the same run by several versions of the judge the newest counts.
    """
    rows: dict[tuple[Any, ...], list[Any]] = {}
    manifests = [
        (json.loads(manifest.read_text()), manifest)
        for manifest in (store / "artefacts").glob("finetune-judge-v*/manifest.json")
    ]
    for made, manifest in sorted(manifests, key=lambda found: int(found[0]["version"])):
        judged = json.loads((manifest.parent / "judgement.json").read_text())
        gains = {trial["amount"]: trial for trial in judged["trials"] if not trial.get("holes_only")}
        if not gains:
            continue
        settings = made["config"]["config"]
        run = (made["label"], settings["iterations"], settings["seed"])
        rows[run] = [
            *run,
            len(judged["left_out"]),
            *(
                "–"  # noqa: RUF001
                if amount not in gains
                else "{gain_db:+.2f} ± {standard_error_db:.2f}".format(**gains[amount])
                for amount in (0.0, *AMOUNTS)
            ),
            "in holes alone"
            if judged.get("holes_only")
            else KEPT.get(judged["amount"], f"weight x {judged['amount']}"),
        ]
    head = ["sequence", "iterations", "seed", "frames left out", "real views alone"]
    head += [*(f"weight x {amount:g}" for amount in AMOUNTS), "kept"]
    return markdown_table(head, [rows[run] for run in sorted(rows)])


def _about(row: dict[str, Any]) -> str:
    return row["dataset"] if "dataset" in row else dataset_of(row)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    tables = {"methods": methods_tables, "ablation": ablation_tables, "budget": budget_tables}
    parser.add_argument("table", choices=[*tables, "judge"])
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    arguments = parser.parse_args()
    if arguments.table == "judge":
        text = "\n\n".join(judge_table(store) for store in arguments.files)
    else:
        text = tables[arguments.table](cases_of(arguments.files))
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
