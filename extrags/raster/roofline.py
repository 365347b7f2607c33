"""Roofline model of a training iteration, and a breakdown of its time.

The lower bound on the time follows from the arithmetic and the memory traffic of the kernels, at the peak
rates measured on the machine itself.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from extrags.raster import native
from extrags.raster.adam import SelectiveAdam
from extrags.raster.loss import l1_ssim_loss
from extrags.raster.peers import rasterize_scene

__all__ = ["part_times", "roofline"]

FLOPS_PER_LANE = {"forward": 38, "backward": 61}
"""Floating-point operations per pixel and Gaussian, reduction of the gradients included."""

PARAMETERS_PER_GAUSSIAN = 59
"""Floats: mean 3, quaternion 4, scales 3, opacity 1, harmonics of degree 3 48."""


def part_times(scene: Mapping[str, Tensor], rounds: int = 8) -> tuple[dict[str, float], int]:
    """Breakdown of the time of a training iteration on the native kernels.

    Args:
        scene: from `bench_scene`.
        rounds: number of repetitions; the result is their median.

    Returns:
        Milliseconds by part (`rest` is what autograd and Python add), and the number of entries (a Gaussian
        in a block of pixels) composited.
    """
    learned = ("means", "quats", "scales", "opacities", "sh")
    parameters = {name: scene[name].clone().requires_grad_() for name in learned}
    adam = SelectiveAdam(parameters, dict.fromkeys(parameters, 1e-9))
    target = scene["target"]
    height, width = target.shape[1:3]
    records: list[dict[str, float]] = []
    entries = 0
    for _ in range(rounds + 2):
        start = time.perf_counter()
        rendering = rasterize_scene({**scene, **parameters}, "native", width, height)
        rendered = time.perf_counter()
        loss = l1_ssim_loss(rendering.rgb, target)
        compared = time.perf_counter()
        # The frame holds the kernels' timers; the graph keeps it alive until the backward pass is over.
        frame = rendering.rgb.grad_fn.call.frames[0]  # type: ignore[union-attr]
        loss.backward()
        carried = time.perf_counter()
        adam.step(rendering.visible[0])
        adam.zero_grad()
        end = time.perf_counter()
        project, tiles, tiles_backward, project_backward = frame.seconds()
        parts = {
            "project": project,
            "tiles": tiles,
            "loss": compared - rendered,
            "tiles_backward": tiles_backward,
            "project_backward": project_backward,
            "adam": end - carried,
        }
        records.append({**parts, "rest": end - start - sum(parts.values())})
        entries = int(frame.entries())
    kept = records[2:]
    return {name: 1e3 * float(np.median([r[name] for r in kept])) for name in kept[0]}, entries


def roofline(n_gaussians: int, entries: int, threads: int, iteration_ms: float) -> dict[str, float]:
    """Lower bounds on the time of an iteration at the measured arithmetic peak and memory bandwidth.

    Arithmetic: composited entries times sixteen lanes, forward and backward (projection, loss and Adam
    left out). Memory: parameters read twice, gradients written and read, Adam's moments and parameters
    read and written; none of it from a cache.

    Args:
        n_gaussians: in the scene.
        entries: composited, as `part_times` counts them.
        threads: of the kernels.
        iteration_ms: measured time of an iteration.

    Returns:
        The two peaks, the two bounds in milliseconds, and `share`: the larger bound over the time taken.
    """
    flops = 16 * entries * sum(FLOPS_PER_LANE.values())
    traffic = 4 * PARAMETERS_PER_GAUSSIAN * n_gaussians * (2 + 2 + 6)
    peak_gflops, bandwidth_gbs = threads * _peak_gflops(), _bandwidth_gbs()
    arithmetic_ms, memory_ms = 1e-6 * flops / peak_gflops, 1e-6 * traffic / bandwidth_gbs
    floor_ms = max(arithmetic_ms, memory_ms)
    return {
        "peak_gflops": peak_gflops,
        "bandwidth_gbs": bandwidth_gbs,
        "entries": float(entries),
        "gflop": flops / 1e9,
        "traffic_mib": traffic / 2**20,
        "arithmetic_ms": arithmetic_ms,
        "memory_ms": memory_ms,
        "floor_ms": floor_ms,
        "share": floor_ms / iteration_ms,
    }


def _peak_gflops() -> float:
    """Best of a few runs of independent fused multiply-adds: 16 chains of 16 lanes, 2 flops each."""
    kernels, rounds = native.compiled_kernels(), 200_000
    best = math.inf
    for _ in range(5):
        start = time.thread_time()
        kernels.fma_chain(rounds)
        best = min(best, time.thread_time() - start)
    return rounds * 16 * 16 * 2 / best / 1e9


def _bandwidth_gbs() -> float:
    """Best of a few copies of 64 MiB, read and written."""
    source = torch.ones(16 * 2**20)
    target = torch.empty_like(source)
    best = math.inf
    for _ in range(5):
        start = time.thread_time()
        target.copy_(source)
        best = min(best, time.thread_time() - start)
    return 2 * 4 * source.numel() / best / 1e9
