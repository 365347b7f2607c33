"""Rows of the metrics: images without content, known values, depth with zeros and outliers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from extrags.metrics.depth import depth_errors
from extrags.metrics.image import psnr_per_image, ssim_map
from extrags.metrics.registry import metrics
from extrags.stress.inputs import IMAGES, SCALES, image
from extrags.stress.rows import (
    EPS,
    EXACT,
    FINITE,
    Effort,
    Row,
    Trial,
    differs,
    finite_or_refused,
    with_threads,
)
from extrags.threads import in_threads

__all__ = ["ROWS"]


def _photometric(render: Tensor, target: Tensor) -> list[float]:
    region = {"": torch.ones(render.shape[:-1], dtype=torch.bool)}
    found = []
    for metric in metrics("photometric"):
        if metric.measure is not None:
            found += [value for value in metric.measure(render, target, region)[""] if value is not None]
    return found


def _metric_extremes(effort: Effort) -> Iterator[Trial]:
    for one in IMAGES:
        for other in IMAGES:
            for height, width in ((1, 1), (11, 11), (24, 30)):
                pair = image(one, 1, height, width, 3), image(other, 1, height, width, 3, seed=1)
                yield (
                    f"{one} against {other}, {width}x{height}",
                    finite_or_refused(partial(_photometric, *pair)),
                )


def _exact_ssim(first: Tensor, second: Tensor) -> Tensor:
    """SSIM written out: float64, a window of 11 x 11 summed at every pixel, mirrored borders."""
    offsets = torch.arange(-5, 6, dtype=torch.float64)
    window = torch.exp(-0.5 * (offsets / 1.5) ** 2)
    kernel = torch.outer(window, window) / window.sum() ** 2
    x, y = (np.pad(v.double().numpy(), ((5, 5), (5, 5), (0, 0)), mode="reflect") for v in (first, second))
    height, width = first.shape[:2]
    found = torch.zeros(height, width, dtype=torch.float64)
    for row in range(height):
        for column in range(width):
            a, b = (torch.from_numpy(v[row : row + 11, column : column + 11]) for v in (x, y))
            mean_a, mean_b = ((kernel[..., None] * v).sum((0, 1)) for v in (a, b))
            # About the mean: no difference of large sums.
            var_a, var_b = (
                (kernel[..., None] * (v - mean).square()).sum((0, 1))
                for v, mean in ((a, mean_a), (b, mean_b))
            )
            both = (kernel[..., None] * (a - mean_a) * (b - mean_b)).sum((0, 1))
            ssim = (2 * mean_a * mean_b + 1e-4) * (2 * both + 9e-4)
            found[row, column] = (ssim / ((mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4))).mean()
    return found


def _ssim_error(effort: Effort) -> Iterator[Trial]:
    for one in IMAGES:
        for other in ("constant", "noise", "saturated"):
            first, second = image(one, 14, 13, 3), image(other, 14, 13, 3, seed=1)
            error = (ssim_map(first[None], second[None])[0].double() - _exact_ssim(first, second)).abs().max()
            yield f"{one} against {other}", float(error)


def _metric_repeat(effort: Effort) -> Iterator[Trial]:
    pair = image("noise", 2, 90, 120, 3), image("noise", 2, 90, 120, 3, seed=1)

    def run() -> list[list[float]]:
        # As `evaluate_views` runs it.
        return in_threads(
            lambda index: _photometric(*(images[index : index + 1] for images in pair)), range(2)
        )

    first = with_threads(1, run)
    for threads in (1, 2, 4):
        yield f"{threads} threads", differs(with_threads(threads, run), first)


def _metric_values(effort: Effort) -> Iterator[Trial]:
    """What is known without measuring."""
    for kind in IMAGES:
        same = image(kind, 1, 24, 30, 3)
        yield f"SSIM of {kind} with itself", abs(float(ssim_map(same, same).min()) - 1)
    shifted = psnr_per_image(image("constant", 1, 24, 30, 3), image("constant", 1, 24, 30, 3) + 0.1)[0]
    yield "PSNR of a difference of 0.1", math.inf if shifted is None else abs(shifted - 20) / 20
    truth = np.full((1, 8, 8), 2.0, np.float32)
    for unit in SCALES:
        errors = depth_errors(1.1 * truth * unit, truth * unit)
        share = None if errors is None else errors.absrel
        yield f"AbsRel of 10 %, times {unit:g}", math.inf if share is None else abs(share - 0.1)


def _depth_metrics(effort: Effort) -> Iterator[Trial]:
    truth = np.full((1, 8, 8), 2.0, np.float32)
    for name, value in {
        "zero": 0.0,
        "NaN": math.nan,
        "infinity": math.inf,
        "1e-30": 1e-30,
        "1e30": 1e30,
        "negative": -1.0,
    }.items():
        for one in (True, False):
            spoilt = truth.copy()
            spoilt[0, 0, 0] = value
            pair = (spoilt, truth) if one else (truth, spoilt)
            yield (
                f"{name} in {'rendered' if one else 'true'} depth",
                finite_or_refused(partial(depth_errors, *pair)),
            )
        everywhere = np.full_like(truth, value)
        yield f"{name} everywhere", finite_or_refused(partial(_errors_or_nothing, everywhere, truth))


def _errors_or_nothing(rendered: np.ndarray, truth: np.ndarray) -> Any:
    found = depth_errors(rendered, truth)
    return [] if found is None else found


def _rows() -> Iterator[Row]:
    yield Row(
        "metrics", "images without content, from one pixel", "values not finite", FINITE, _metric_extremes
    )
    yield Row("metrics", "SSIM to float64", "absolute error", EPS / 9e-4, _ssim_error)
    yield Row("metrics", "known values", "error", 1e-5, _metric_values)
    yield Row("metrics", "depth with zeros, NaN, outliers", "values not finite", FINITE, _depth_metrics)
    yield Row("metrics", "repeat and threads", "results that differ", EXACT, _metric_repeat)


ROWS = tuple(_rows())
