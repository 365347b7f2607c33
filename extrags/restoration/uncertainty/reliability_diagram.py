"""Reliability diagram of predicted errors, and their rank correlation with the true ones."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped

from extrags.errors import ConfigError, ShapeError
from extrags.restoration.uncertainty.calibration import cell_means

__all__ = ["calibration", "cell_correlation", "interval_coverage", "rank_correlation"]

CALIBRATION_BINS = 10
INTERVALS = (0.5, 0.9)
"""Shares of the errors that the intervals should hold whose coverage is measured."""


def calibration(
    predicted: Shaped[np.ndarray, "v h w"],
    error: Shaped[np.ndarray, "v h w c"],
    mask: Bool[np.ndarray, "v h w"],
    *,
    bins: int = CALIBRATION_BINS,
) -> dict[str, Any]:
    """Predicted against true error, on means over channels and cells of 8 x 8 pixels.

    Args:
        predicted: the error the restorer expects.
        error: the true absolute error of each channel.
        mask: which pixels count; a cell counts with at least half of its pixels.
        bins: of equal numbers of cells, by prediction.

    Returns:
        `{rank_correlation, calibration_error, coverage: {50, 90}, cells, bins: [{predicted, error, low, high,
        cells}]}`: Spearman's; the mean distance of the bins from the diagonal; see `interval_coverage`; in
        each bin the means, and the quartiles of the true error.

    Raises:
        ShapeError: when the shapes differ.
        ConfigError: without any bin.
    """
    if not predicted.shape == error.shape[:-1] == mask.shape:
        raise ShapeError(f"predicted {predicted.shape}, error {error.shape} and mask {mask.shape} differ")
    if bins < 1:
        raise ConfigError(f"{bins} calibration bins; expected 1 or more")
    expected, found = _cells(predicted, mask), _cells(error.mean(axis=-1), mask)
    order = np.argsort(expected, kind="stable")
    table = []
    for chosen in np.array_split(order, bins):
        if len(chosen) == 0:
            continue
        low, high = np.quantile(found[chosen], [0.25, 0.75])
        table.append(
            {
                "predicted": float(expected[chosen].mean()),
                "error": float(found[chosen].mean()),
                "low": float(low),
                "high": float(high),
                "cells": len(chosen),
            }
        )
    off = [abs(row["predicted"] - row["error"]) * row["cells"] for row in table]
    return {
        "rank_correlation": rank_correlation(expected, found),
        "calibration_error": sum(off) / len(order) if len(order) else None,
        "coverage": interval_coverage(predicted, error, mask),
        "cells": len(order),
        "bins": table,
    }


def interval_coverage(
    predicted: Shaped[np.ndarray, "v h w"],
    error: Shaped[np.ndarray, "v h w c"],
    mask: Bool[np.ndarray, "v h w"],
) -> dict[str, float | None]:
    r"""Share of values whose error lies in an interval that should hold 50 % or 90 % of them.

    Where a channel's error is Laplace distributed, as the restorer's likelihood takes it to be, its absolute
    value is exponentially distributed: with the predicted mean :math:`b` a share :math:`q` of them lies
    between 0 and :math:`-b \log(1 - q)`. The mean of the channels has another distribution, of fewer small
    values.

    Args:
        predicted: the error the restorer expects.
        error: the true absolute error of each channel.
        mask: which pixels count.

    Returns:
        Share by percentage; None without any pixel.
    """
    ratio = error[mask] / np.maximum(predicted[mask], np.finfo(np.float32).tiny)[:, None]
    return {
        f"{100 * share:.0f}": float((ratio <= -math.log(1 - share)).mean()) if len(ratio) else None
        for share in INTERVALS
    }


def rank_correlation(first: Shaped[np.ndarray, "n"], second: Shaped[np.ndarray, "n"]) -> float | None:
    """Spearman's rank correlation, ties at their mean rank; None where either does not vary."""
    from scipy.stats import rankdata

    if len(first) < 2:
        return None
    ranks = rankdata(np.stack([first, second]), axis=1)
    centered = ranks - ranks.mean(axis=1, keepdims=True)
    norms = np.sqrt((centered**2).sum(axis=1))
    if norms.min() == 0:
        return None
    return float((centered[0] * centered[1]).sum() / (norms[0] * norms[1]))


def cell_correlation(
    values: Shaped[np.ndarray, "v h w"], error: Shaped[np.ndarray, "v h w"], mask: Bool[np.ndarray, "v h w"]
) -> float | None:
    """Rank correlation of any map with the error, on the same cells."""
    return rank_correlation(_cells(values, mask), _cells(error, mask))


def _cells(values: np.ndarray, mask: np.ndarray) -> Float[np.ndarray, "n"]:
    """Means over cells that lie wholly in the image and at least half in the mask."""
    # `where` and not a product: pixels outside the mask may be NaN.
    inside = torch.from_numpy(np.where(mask, values, 0).astype(np.float32))[:, None]
    means, share = cell_means(inside, torch.from_numpy(mask.astype(np.float32))[:, None])
    return means[share >= 0.5].astype(np.float64)
