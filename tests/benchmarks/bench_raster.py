"""Benchmark of the rasteriser: `python tests/benchmarks/bench_raster.py raster|train --json FILE|-`."""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path

from extrags.raster.bench import PEERS, STANDARD_SIZES, BenchSize, bench_raster, bench_train


def _size(text: str) -> BenchSize:
    match = re.fullmatch(r"(\d+)x(\d+)/(\d+)", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r}, expected WIDTHxHEIGHT/GAUSSIANS like 160x128/10000")
    return BenchSize(*(int(group) for group in match.groups()))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["raster", "train"])
    parser.add_argument("--size", type=_size, nargs="+", default=list(STANDARD_SIZES))
    parser.add_argument("--peers", default="torch", help=f"comma-separated, of {', '.join(PEERS)}")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--error", action="store_true", help="compare with the float64 reference")
    parser.add_argument("--json", default="-", help="file, or - for standard output")
    chosen = parser.parse_args(arguments)
    bench = bench_raster if chosen.what == "raster" else bench_train
    result = bench(
        chosen.size,
        peers=[peer for peer in chosen.peers.split(",") if peer],
        threads=chosen.threads,
        rounds=chosen.rounds,
        with_error=chosen.error,
    )
    text = json.dumps(result, indent=1)
    if chosen.json == "-":
        sys.stdout.write(text + "\n")
    else:
        Path(chosen.json).write_text(text + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
