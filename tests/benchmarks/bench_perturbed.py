"""What is wrong with recordings, and its cost: `python -m tests.benchmarks.bench_perturbed SEQUENCE ...`.

Each sequence is reconstructed as it is, through a lens that scatters a share of every image's mean (in
linear light, held-out frames as well), and with training poses off by normal errors: of 1 % of the median
depth and half a degree, times a factor. Once without the terms that meet these, and once as the profile has
it. One line of JSON each: PSNR of held-out views as rendered, with one gain and of observed pixels, LPIPS
where its weights are known, and what was learned. Held-out poses are exact.

With `--wrong` that is one of `tests.benchmarks.wrong_recordings`, without and with the corrections of reading
(`extrags.reading_corrections`), measured against frames and depth that are right.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from data_catalog import read
from extrags.config import PROFILES, PipelineConfig
from extrags.depth.estimate import estimate_depth
from extrags.depth.training_depth import with_training_depth
from extrags.evaluation import evaluate
from extrags.in_memory_pipeline import run_pipeline
from extrags.reading_corrections import with_corrections
from extrags.sequence import EndoscopicSequence
from extrags.training import as_reconstructed, reconstruct
from extrags.training.starting import median_depth
from tests.benchmarks.wrong_recordings import OTHERWISE_RECORDED, WRONG

GAMMA = 2.2
SHIFT_SHARE, TURN_DEG = 0.01, 0.5
WITHOUT = {"coarse.light.glare": False, "coarse.refine_poses": False}


def veiled(sequence: EndoscopicSequence, share: float) -> EndoscopicSequence:
    """With a share of the mean of each image over all of it."""
    rgb = np.array(sequence.rgb)
    for frame in rgb:
        linear = (frame / 255.0) ** GAMMA
        frame[:] = np.rint(255 * (linear + share * linear.mean((0, 1))).clip(0, 1) ** (1 / GAMMA))
    return replace(sequence, rgb=rgb)


def displaced(sequence: EndoscopicSequence, factor: float, seed: int) -> EndoscopicSequence:
    """With the poses of training frames off; those of held-out frames stay."""
    generator = np.random.default_rng(100 + seed)
    poses, depth = sequence.cameras.world_from_camera.copy(), median_depth(sequence, sequence.train)
    turn, shift = np.radians(TURN_DEG) * factor, SHIFT_SHARE * depth * factor
    for frame in np.sort(sequence.train):
        turned = Rotation.from_rotvec(turn * generator.normal(size=3) / np.sqrt(3)).as_matrix()
        poses[frame, :3, :3] = poses[frame, :3, :3] @ turned
        poses[frame, :3, 3] += shift * generator.normal(size=3) / np.sqrt(3)
    return replace(sequence, world_from_camera=poses)


def cases(given: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One for each sequence, change and setting."""
    for name in given.sequences:
        stages = ("coarse", "explore", "enhance", "finetune")
        seeds = {f"{stage}.seed": given.seed for stage in stages}
        base = PROFILES[given.profile].with_overrides(seeds)
        sequence = read(name, base.ingest)
        changed = {} if given.wrong else {"as it is": sequence}
        changed |= {f"glare of {share:g}": veiled(sequence, share) for share in given.glare}
        changed |= {f"poses off by {f:g}": displaced(sequence, f, given.seed) for f in given.pose_error}
        for change, frames in changed.items():
            for setting, overrides in (("without", WITHOUT), ("with", {})):
                case = {"sequence": name, "change": change, "setting": setting, "seed": given.seed}
                yield case | measured(frames, base.with_overrides(overrides), whole=given.whole)
        for change in given.wrong:
            wrong = WRONG[change](sequence)
            for setting, frames in (("without", wrong), ("with", with_corrections(wrong))):
                case = {"sequence": name, "change": change, "setting": setting, "seed": given.seed}
                right = wrong if change in OTHERWISE_RECORDED else sequence
                yield case | of_wrong(frames, right, base)


def measured(sequence: EndoscopicSequence, config: PipelineConfig, *, whole: bool) -> dict[str, Any]:
    """Figures of the coarse scene, and with `whole` those of all scenes of a run."""
    if whole:
        run = run_pipeline(sequence, config, until="evaluate")
        return {scene: figures(found.metrics) for scene, found in run.evaluations.items()}
    found = reconstruct(sequence, config.coarse)
    sequence = as_reconstructed(sequence, found)
    case: dict[str, Any] = {
        "coarse": figures(evaluate(found.scene, sequence).metrics),
        "poses_corrected": found.refined is not None,
        "colors_corrected": found.colors is not None,
    }
    if found.scene.light is not None:
        case["glare"] = [round(value, 3) for value in found.scene.light.log_glare.exp().tolist()]
    return case


def of_wrong(frames: EndoscopicSequence, right: EndoscopicSequence, config: PipelineConfig) -> dict[str, Any]:
    """Figures of the coarse scene of wrong frames, on the pictures and depth of right ones."""
    training = frames.training_part()
    if training.depth_error is not None:
        training = with_training_depth(training, estimate_depth(training, config.depth, config.poses))
    found = reconstruct(training, config.coarse)
    frames = replace(frames, rgb=right.rgb, depth_mm=right.depth_mm, depth_error=None, withheld_depth_mm=None)
    frames = as_reconstructed(frames, found)
    return {"coarse": figures(evaluate(found.scene, frames).metrics), "train": len(training)}


def figures(metrics: dict[str, Any]) -> dict[str, Any]:
    observed = metrics.get("observed") or {}
    return {
        "psnr": metrics["psnr"],
        "aligned_psnr": metrics["aligned"]["psnr"],
        "observed_psnr": observed.get("psnr"),
        "lpips_alex": metrics.get("lpips_alex"),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("sequences", nargs="+")
    parser.add_argument("--profile", default="quick", choices=list(PROFILES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--glare", nargs="*", type=float, default=[0.15])
    parser.add_argument("--pose-error", nargs="*", type=float, default=[1.0])
    parser.add_argument("--wrong", nargs="*", default=[], choices=list(WRONG), help="in place of both")
    parser.add_argument("--whole", action="store_true", help="whole runs, not coarse scenes alone")
    parser.add_argument("--json", metavar="FILE")
    given = parser.parse_args()
    if given.wrong:
        given.glare, given.pose_error = [], []
    found = []
    for case in cases(given):
        found.append(case)
        print(json.dumps(case), flush=True)
    if given.json:
        Path(given.json).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
