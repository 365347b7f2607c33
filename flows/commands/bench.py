"""`bench raster`, `bench train`, `bench enhance`.

`bench stability`, `bench explore`, `bench pipeline` and `bench compare` have modules of their own.
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from extrags.errors import ConfigError
from extrags.metrics.registry import figures
from flows.commands import bench_compare, bench_explore, bench_pipeline, bench_stability
from flows.commands.common import items, set_up_logging, write_json
from flows.commands.options import Parser, add_json, add_profile, add_sequences, add_settings, add_verb
from flows.commands.outputs import output_file

__all__ = ["add_arguments", "enhance", "raster", "train"]

KERNEL_EXAMPLES = """examples:
  --size 160x128 --gaussians 10000
  --size 160x128,320x256 --gaussians 10000,30000 --threads 1 2 --json -
  --quick --peers torch,reference

peers: direct (the kernels as training uses them, without autograd; train only), torch (batched tiles,
float32), reference (the specification, float64), gsplat (CUDA).
A size goes with the number of Gaussians at the same place in the list."""


def add_arguments(parser: Parser) -> None:
    """The verbs below `extrags bench`."""
    verbs = parser.add_subparsers(
        metavar="raster|train|stability|enhance|explore|pipeline|compare", required=True, parser_class=Parser
    )
    for command, summary, with_error in (
        (raster, "time and error of the rasteriser, forward and backward", True),
        (train, "time of a whole training iteration: render, loss, backward, Adam", False),
    ):
        made = add_verb(
            verbs,
            command.__name__,
            command,
            summary,
            epilog=KERNEL_EXAMPLES,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        _add_kernel_cases(made, with_error=with_error)
        add_json(made)
    raw: dict[str, Any] = {"formatter_class": argparse.RawDescriptionHelpFormatter}
    summary = "stress-test every component with extreme inputs"
    bench_stability.add_arguments(
        add_verb(
            verbs, "stability", bench_stability.stability, summary, epilog=bench_stability.EXAMPLES, **raw
        )
    )
    _add_enhance(add_verb(verbs, "enhance", enhance, "restorers beside each other on held-out views"))
    summary = "ways to choose virtual views, against the true surface"
    bench_explore.add_arguments(add_verb(verbs, "explore", bench_explore.explore, summary))
    summary = "run time against error of whole runs, over methods and budgets"
    bench_pipeline.add_arguments(
        add_verb(verbs, "pipeline", bench_pipeline.pipeline, summary, epilog=bench_pipeline.EXAMPLES, **raw)
    )
    summary = "tell a regression between two results from noise"
    bench_compare.add_arguments(add_verb(verbs, "compare", bench_compare.compare, summary))


def _add_kernel_cases(parser: Parser, *, with_error: bool) -> None:
    many: dict[str, Any] = {"nargs": "+", "action": "extend"}
    parser.add_argument(
        "--size",
        metavar="WxH",
        **many,
        help="image sizes (default: 160x128 320x256 640x512, with 10000 30000 100000 Gaussians)",
    )
    parser.add_argument("--gaussians", metavar="N", **many, help="numbers of Gaussians, one per size")
    parser.add_argument("--quick", action="store_true", help="the smallest standard size only")
    parser.add_argument(
        "--peers",
        metavar="PEER",
        **many,
        help="what to run beside the native kernels (default: torch, and direct for train; native: nothing)",
    )
    parser.add_argument("--threads", metavar="N", **many, help="numbers of threads to measure (default: 1 2)")
    parser.add_argument("--rounds", type=int, default=20, metavar="N", help="timed rounds (default: 20)")
    parser.add_argument(
        "--error",
        action=argparse.BooleanOptionalAction,
        default=with_error,
        help=f"compare image and gradients with float64 (default: {'yes' if with_error else 'no'})",
    )


def _add_enhance(parser: Parser) -> None:
    parser.description = (
        "Reconstruct each sequence, restore its held-out views with every method, and compare with what they "
        "really look like: whole, well seen, holes, observed and unobserved."
    )
    add_sequences(parser, chosen=False)
    parser.add_argument(
        "--methods",
        nargs="+",
        default=["none", "classical", "embedded"],
        metavar="METHOD",
        help="none, classical, embedded (as the settings say), embedded-1, embedded-4 (steps), zero-shot "
        "(pretrained weights alone), seamless (the same, cloning seamlessly), scene-trained (trained further "
        "on the scene), scratch (trained on the scene alone), deterministic (the same as a plain "
        "regression), each also with /no-references, /agreed, /textured, /refined, /keyframes or "
        "/no-keyframes behind it (default: none classical embedded)",
    )
    add_profile(parser, "quick")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of all stages (default: 0)")
    add_settings(parser)
    parser.add_argument(
        "--figure",
        metavar="FILE.png",
        type=output_file,
        help="draw predicted against true error (the calibration)",
    )
    add_json(parser)


def raster(given: argparse.Namespace) -> int:
    """`extrags bench raster`."""
    return _kernels(given, training=False)


def train(given: argparse.Namespace) -> int:
    """`extrags bench train`."""
    return _kernels(given, training=True)


def enhance(given: argparse.Namespace) -> int:
    """`extrags bench enhance`."""
    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    _set_passive_openmp_wait()
    from flows.settings import pipeline_config

    config = pipeline_config(given.profile, given.settings, given.seed)
    from data_catalog.catalog import read, resolve
    from extrags.restoration.benchmark.comparison import bench_enhance, check_methods
    from tasks.weights import lpips_by_net, lpips_weights

    methods = check_methods(items(given.methods))
    # All of them before the first takes its minutes: a name that is wrong is said at once.
    sources = [resolve(name) for name in given.sequences]
    lpips = lpips_by_net(lpips_weights(config.evaluate))
    found = bench_enhance(
        (read(source, config.ingest) for source in sources),
        config,
        methods=methods,
        lpips=lpips,
    )
    reasons = {net: network for net, network in lpips.items() if isinstance(network, str)}
    found = {"profile": given.profile, **found, "lpips_reasons": reasons}
    if given.json != "-":
        _print_restorers(found["cases"])
    write_json(found, given.json)
    if given.figure is not None:
        from extrags.report.calibration_plot import write_calibration_plot

        several = len(sources) > 1
        curves = {
            f"{case['sequence']} {case['method']}" if several else case["method"]: case["calibration"]
            for case in found["cases"]
            if case["calibration"] is not None
        }
        write_calibration_plot(curves, Path(given.figure))
    return 0


def _kernels(given: argparse.Namespace, *, training: bool) -> int:
    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    _set_passive_openmp_wait()
    sizes = _sizes(given)
    threads = [_number("--threads", text) for text in items(given.threads or ["1", "2"])]
    usual = ["direct", "torch"] if training else ["torch"]
    peers = items(usual if given.peers is None else given.peers)
    from extrags.raster.bench import BenchSize, bench_raster, bench_train

    found = (bench_train if training else bench_raster)(
        None if sizes is None else [BenchSize(*size) for size in sizes],
        quick=given.quick,
        peers=peers,
        threads=threads,
        rounds=given.rounds,
        with_error=given.error,
    )
    if given.json != "-":
        _print_kernels(found["cases"])
    write_json(found, given.json)
    return 0


def _set_passive_openmp_wait() -> None:
    # Read when torch is loaded. Threads that spin while they wait starve the peers they are measured beside.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def _sizes(given: argparse.Namespace) -> list[tuple[int, int, int]] | None:
    """Sizes and numbers of Gaussians in pairs; None where the standard ones are wanted."""
    if given.size is None and given.gaussians is None:
        return None
    if given.quick:
        raise ConfigError("--quick is the smallest standard size: it does not go with --size or --gaussians")
    sizes, counts = items(given.size or []), items(given.gaussians or [])
    if len(sizes) != len(counts):
        raise ConfigError(
            f"--size names {len(sizes)} sizes and --gaussians {len(counts)} numbers; they go in pairs"
        )
    pairs = []
    for size, count in zip(sizes, counts, strict=True):
        match = re.fullmatch(r"(\d+)x(\d+)", size)
        if match is None:
            raise ConfigError(f"--size {size}: expected WIDTHxHEIGHT, e.g. 160x128")
        pairs.append((int(match[1]), int(match[2]), _number("--gaussians", count)))
    return pairs


def _number(option: str, text: str) -> int:
    if not text.isdecimal():
        raise ConfigError(f"{option} {text}: expected a whole number")
    return int(text)


def _print_kernels(cases: list[dict[str, Any]]) -> None:
    from flows.terminal import console

    header = ["size", "Gaussians", "backend", "threads", "forward ms", "backward ms", "iteration ms"]
    header += ["10 % - 90 %", "cpu ms", "x native", "peak MiB"]
    with_error = any("error" in case for case in cases)
    rows = []
    for case in cases:
        low, high = case["spread_ms"]
        row = [f"{case['width']}x{case['height']}", case["n_gaussians"], case["backend"], case["threads"]]
        row += [case["ms"].get(name) for name in ("forward", "backward", "iteration")]
        row += [
            f"{low:.4g} - {high:.4g}",
            case["cpu_ms"]["iteration"],
            case["times_native"],
            case["peak_mib"],
        ]
        if with_error:
            error = case.get("error")
            row += [None, None] if error is None else [error["image"], max(error["grads"].values())]
        rows.append(row)
    _print([*header, *(("image error", "worst gradient") if with_error else ())], rows)
    for case in cases:
        if "roofline" in case:
            parts = ", ".join(f"{name} {value:.3g}" for name, value in case.get("parts_ms", {}).items())
            console().print(
                f"{case['width']}x{case['height']}, {case['backend']}, {case['threads']} threads: "
                f"{f'{parts} ms; ' if parts else ''}floor "
                f"{case['roofline']['floor_ms']:.3g} ms, {case['roofline']['share']:.0%} of the time taken",
                soft_wrap=True,
            )


def _domain_line(case: dict[str, Any]) -> str:
    weights = f"weights for {case['trained_on']}, " if case["trained_on"] else ""
    place = "unlike" if case["domain_score"] > 1 else "like"
    return f"{case['method']}: {weights}domain score {case['domain_score']:.2f}, {place} its training data"


def _print_restorers(cases: list[dict[str, Any]]) -> None:
    """A table per sequence; what is kept of known texture is what fine-tuning is given."""
    from flows.terminal import console

    measured = [figure for figure in figures("restoration") if any(figure.key in case for case in cases)]
    header = ["method", *(figure.label for figure in measured)]
    header += ["well", "hole", "observed", "unobserved", "kept PSNR", "kept well"]
    header += ["changed", "flicker", "rank corr.", "s/frame", "prepared in s"]
    for sequence in dict.fromkeys(case["sequence"] for case in cases):
        chosen = [case for case in cases if case["sequence"] == sequence]
        shares = ", ".join(f"{name} {share:.0%}" for name, share in chosen[0]["pixel_share"].items())
        console().print(
            f"{sequence}: {chosen[0]['views']} held-out views; {shares} of the pixels",
            soft_wrap=True,
            markup=False,
        )
        for case in chosen:
            if case["domain_score"] is not None:
                console().print(_domain_line(case), soft_wrap=True, markup=False)
        rows = []
        for case in chosen:
            calibration, kept = case["calibration"], case["kept"]
            row = [case["method"], *(case.get(figure.key) for figure in measured)]
            row += [case[part]["psnr"] for part in ("well", "hole", "observed", "unobserved")]
            row += [kept["psnr"], kept["well"]["psnr"], case["changed_share"], case["flicker"]]
            row += [None if calibration is None else calibration["rank_correlation"]]
            rows.append([*row, case["seconds_per_frame"], case["prepare_seconds"]])
        _print(header, rows)
        # In tables of their own: one of all would be wider than a terminal.
        rows = []
        for case in chosen:
            aligned, found = case["aligned"], case["aligned"]["calibration"]
            coverage = {} if found is None else found["coverage"]
            row = [case["method"], *(aligned.get(figure.key) for figure in measured)]
            row += [aligned["well"]["psnr"], aligned["hole"]["psnr"], aligned["kept"]["well"]["psnr"]]
            row += [None if found is None else found["rank_correlation"]]
            rows.append([*row, coverage.get("50"), coverage.get("90")])
        labels = [f"aligned: {measured[0].label}", *(figure.label for figure in measured[1:])]
        _print(["method", *labels, "well", "hole", "kept well", "rank corr.", "within 50 %", "90 %"], rows)
        names = ("within", "across", "of_photographs")
        _print(
            [
                "method",
                "error flicker",
                "invented: within clips",
                "across clips",
                "photographs",
                "hole depth: mean error",
                "median",
            ],
            [
                [
                    case["method"],
                    case["error_flicker"],
                    *(case["inconsistency"][name] for name in names),
                    *(case["hole_depth_error"][name] for name in ("mean", "median")),
                ]
                for case in chosen
            ],
        )
        _print(
            [
                "method",
                "Fréchet: well",
                "rim",
                "hole",
                "fine detail: well",
                "rim",
                "hole",
                "within 50 %",
                "90 %",
            ],
            [_realism_row(case) for case in chosen],
        )


def _realism_row(case: dict[str, Any]) -> list[Any]:
    """Whether regions look like tissue, and how many errors lie in the intervals meant for 50 and 90 %."""
    parts = ("well", "rim", "hole")
    detail = [case["detail"][part] for part in parts]
    coverage = {} if case["calibration"] is None else case["calibration"]["coverage"]
    return [
        case["method"],
        *(case["frechet"][part] for part in parts),
        *(None if bands is None else bands[0] for bands in detail),
        *(coverage.get(share) for share in ("50", "90")),
    ]


def _print(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    from rich.markup import escape
    from rich.table import Table

    from flows.terminal import console, print_table

    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in header:
        table.add_column(name)
    for row in rows:
        table.add_row(*(escape(_text(value)) for value in row))
    print_table(console(), table)


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "NO"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
