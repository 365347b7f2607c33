"""What going on from a scene of fewer frames gains: `python tests/benchmarks/bench_continuing.py`.

A coarse scene is made from the first part of the training frames; then one of all of them, anew and from the
first one, with several shares of the iterations. Figures are of held-out views, with processor seconds of one
thread. The surroundings of a restart, such as reading frames, are not in them.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from data_catalog.catalog import read, resolve
from extrags.config import CoarseConfig, IngestConfig, profile_config
from extrags.evaluation import evaluate
from extrags.raster import set_num_threads
from extrags.raster.bench import machine
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training import reconstruct
from extrags.training.continuing import EarlierScene


def figures(scene: Scene, sequence: EndoscopicSequence) -> dict[str, Any]:
    """PSNR and LPIPS of held-out views, whole, aligned and where training frames have seen the surface."""
    found = evaluate(scene, sequence).metrics
    aligned, observed = found.get("aligned") or {}, found.get("observed") or {}
    return {
        "psnr": found["psnr"],
        "psnr_aligned": aligned.get("psnr"),
        "psnr_observed": observed.get("psnr"),
        "lpips_alex": found["lpips_alex"],
        "n_gaussians": len(scene.gaussians),
    }


def compared(
    name: str, profile: str, first_share: float, shares: list[float], seed: int
) -> list[dict[str, Any]]:
    """The scene of the first frames, that of all anew, and those that go on from the first."""
    sequence = read(resolve(name), IngestConfig())
    config = profile_config(profile).coarse.model_copy(update={"seed": seed})
    first = sequence.train[: math.ceil(first_share * len(sequence.train))]
    about = {"sequence": name, "profile": profile, "seed": seed}
    about |= {"first_frames": len(first), "frames": len(sequence.train)}
    fewer = replace(sequence, split=replace(sequence.split, train=first))
    cases = []

    def note(what: str, scene: Scene, shown: EndoscopicSequence, seconds: float, share: float) -> None:
        case = {**about, "what": what, "iterations_share": share, "processor_s": round(seconds, 2)}
        cases.append(case | figures(scene, shown))
        sys.stderr.write(json.dumps(cases[-1]) + "\n")

    earlier, seconds = timed(sequence, config, first)
    note("first frames", earlier, fewer, seconds, 1.0)
    anew, seconds = timed(sequence, config, sequence.train)
    note("anew", anew, sequence, seconds, 1.0)
    for share in shares:
        start = EarlierScene(earlier, np.asarray(first), math.ceil(share * config.iterations))
        scene, seconds = timed(sequence, config, sequence.train, start)
        note("continued", scene, sequence, seconds, share)
    return cases


def timed(
    sequence: EndoscopicSequence,
    config: CoarseConfig,
    frames: np.ndarray,
    earlier: EarlierScene | None = None,
) -> tuple[Scene, float]:
    begun = time.process_time()
    scene = reconstruct(sequence, config, frames=frames, earlier=earlier).scene
    return scene, time.process_time() - begun


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--sequences", nargs="+", default=[f"phantom/{k}@sparse" for k in (11, 12, 13)])
    parser.add_argument("--profiles", nargs="+", default=["quick", "balanced"])
    parser.add_argument("--first-share", type=float, default=0.75)
    parser.add_argument("--shares", nargs="+", type=float, default=[0.15, 0.3, 0.5])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--json", default="-")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    set_num_threads(1)
    cases = [
        case
        for profile in chosen.profiles
        for name in chosen.sequences
        for seed in chosen.seeds
        for case in compared(name, profile, chosen.first_share, chosen.shares, seed)
    ]
    text = json.dumps({"machine": machine(), "cases": cases}, indent=1)
    if chosen.json == "-":
        sys.stdout.write(text + "\n")
    else:
        Path(chosen.json).write_text(text + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
