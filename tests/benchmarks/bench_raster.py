"""The rasteriser's benchmarks from a checkout: `python tests/benchmarks/bench_raster.py train --json -`.

The same as `extrags bench ...`, with the same options.
"""

from __future__ import annotations

import sys

from flows.cli import main

if __name__ == "__main__":
    sys.exit(main(["bench", *sys.argv[1:]]))
