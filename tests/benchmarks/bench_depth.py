"""Depth of training frames from each cue: `python -m tests.benchmarks.bench_depth SEQUENCE ...`.

The sequence's depth is withheld and then compared with. With `--estimate-poses` COLMAP finds the poses, and
each frame's depth is scaled by the median of its ratios to the truth.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import spearmanr

from data_catalog import read
from extrags.config import DepthConfig, PosesConfig
from extrags.depth.estimate import estimate_depth, posed_frames
from extrags.depth.shading import fit_shading, smoothed_brightness
from extrags.depth.stereo import NEARLY_SATURATED
from extrags.poses import estimate_poses, with_estimated_poses
from extrags.sequence import EndoscopicSequence
from extrags.training.starting import depth_from_points

SURE_ERROR = 0.1


def measured(found: np.ndarray, truth: np.ndarray, known: np.ndarray, *, rescale: bool) -> dict[str, float]:
    """AbsRel, its median, RMSE and the share within a factor of 1.25, over all frames' pixels."""
    found = found.copy()
    if rescale:
        for image, true, valid in zip(found, truth, known & (found > 0), strict=True):
            image *= np.median(true[valid] / image[valid]) if valid.any() else 1.0
    valid = known & (found > 0)
    ratio = found[valid] / truth[valid]
    return {
        "absrel": float(np.abs(ratio - 1).mean()),
        "median": float(np.median(np.abs(ratio - 1))),
        "rmse": float(np.sqrt(np.mean((found[valid] - truth[valid]) ** 2))),
        "within_1.25": float((np.maximum(ratio, 1 / ratio) < 1.25).mean()),
        "share": float(valid.sum() / known.sum()),
    }


def rank_correlation(error: np.ndarray, expected: np.ndarray) -> float:
    """Spearman's; equal values have the mean of their ranks, not one by their place in the image."""
    return float(spearmanr(error, expected).statistic)


def cues(sequence: EndoscopicSequence, *, estimate_the_poses: bool) -> dict[str, Any]:
    """Figures of one sequence."""
    whole = sequence.without_training_depth()
    result: dict[str, Any] = {"sequence": sequence.name, "poses": "given"}
    if estimate_the_poses:
        whole = with_estimated_poses(whole, estimate_poses(whole, PosesConfig(replace_given=True)))
        result |= {"poses": "estimated", "registered": len(whole.train), "of": len(sequence.train)}
    training = whole.training_part()
    true = whole.true_depth_mm
    assert true is not None
    truth = true[whole.train]
    known = (truth > 0) & training.mask
    begun = time.perf_counter()
    estimate = estimate_depth(training)
    result["seconds_per_frame"] = (time.perf_counter() - begun) / len(training)
    result["n_points"] = len(estimate.points)
    if len(estimate.points):
        pointed = replace(training, points=estimate.points, points_rgb=estimate.points_rgb)
        sparse = depth_from_points(pointed, np.arange(len(training)))
    else:
        sparse = np.zeros_like(truth)
    stereo = estimate_depth(training, DepthConfig(completion="none", shading=False))
    lit = estimate_depth(training, DepthConfig(completion="none"))
    frames = posed_frames(training)
    sure = frames.mask & torch.from_numpy(stereo.expected_error < SURE_ERROR)
    sure &= frames.rgb.amax(dim=1) < NEARLY_SATURATED
    brightness = smoothed_brightness(frames)
    logs = torch.from_numpy(np.log(np.maximum(stereo.depth, 1e-9)))
    group = None if training.recording is None else torch.from_numpy(training.recording)
    light = torch.zeros_like(brightness)
    for index, fit in enumerate(fit_shading(brightness, logs, sure, group)):
        of_group = slice(None) if group is None else group == index
        light[of_group] = fit.log_depth(brightness[of_group]).exp()
    depths = {
        "points, interpolated": sparse,
        "light alone": light.numpy(),
        "stereo alone": stereo.depth,
        "stereo and light": lit.depth,
        "all": estimate.depth,
    }
    result["cues"] = {
        name: measured(depth, truth, known, rescale=estimate_the_poses) for name, depth in depths.items()
    }
    final = estimate.depth.copy()
    if estimate_the_poses:
        for image, one, valid in zip(final, truth, known, strict=True):
            image *= np.median(one[valid] / image[valid])
    error = np.abs(final[known] / truth[known] - 1)
    expected = estimate.expected_error[known]
    result["rank_correlation"] = rank_correlation(error, expected)
    result["true_over_expected"] = float(error.mean() / expected.mean())
    edges = np.quantile(expected, np.linspace(0, 1, 6))
    bins = np.clip(np.searchsorted(edges, expected, side="right") - 1, 0, 4)
    result["bins"] = [
        [round(float(expected[bins == k].mean()), 4), round(float(error[bins == k].mean()), 4)]
        for k in range(5)
        if (bins == k).any()
    ]
    return result


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sequences", nargs="+")
    parser.add_argument("--estimate-poses", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    results = []
    for name in options.sequences:
        results.append(cues(read(name), estimate_the_poses=options.estimate_poses))
        one = results[-1]
        print(f"{one['sequence']} ({one['poses']} poses): {one['seconds_per_frame']:.2f} s per frame")
        for cue, values in one["cues"].items():
            print(f"  {cue:22s} " + "  ".join(f"{key} {value:.3f}" for key, value in values.items()))
        print(
            f"  expected error: rank correlation {one['rank_correlation']:.2f}, true / expected "
            f"{one['true_over_expected']:.2f}, by fifths (expected, true) {one['bins']}",
            flush=True,
        )
        if options.json is not None:
            options.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
