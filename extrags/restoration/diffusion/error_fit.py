"""The embedded restorer's expected error, fitted to the error it makes on pairs with a known truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from torch import Tensor

from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.validation import RestoredPairs, restored_pairs
from extrags.restoration.training_data.pairs import Pairs
from extrags.restoration.uncertainty.calibration import SMALLEST_ERROR, Calibration, cell_means
from extrags.restoration.uncertainty.error_model import ErrorModel, error_features
from extrags.view_synthesis.references import LightTransfer

__all__ = ["cell_errors", "error_over_expected", "with_calibration", "with_error_model"]

MIN_VALID_SHARE = 0.5
"""Cells with a smaller share of valid pixels are not counted."""


def with_calibration(enhancer: EmbeddedEnhancer, restored: RestoredPairs) -> EmbeddedEnhancer:
    """The restorer with the calibration curve of validation pairs; unchanged where they are too few.

    The error model stays: a few pairs of one scene determine a curve, but not six weights.

    Args:
        enhancer: trained.
        restored: what it makes of the validation pairs.
    """
    calibration = Calibration.fitted(*cell_errors(restored))
    if not calibration.predicted:
        return enhancer
    return enhancer.with_calibration_of_scene(calibration)


def error_over_expected(enhancer: EmbeddedEnhancer, restored: RestoredPairs) -> float | None:
    """How many times larger its error on validation pairs is than what the restorer expects of itself.

    About 1 in scenes like those that it was calibrated on; well above, the scene is not what it knows. None
    without valid cells.

    Args:
        enhancer: with the calibration of its weights, not of this scene.
        restored: what it makes of the validation pairs.
    """
    expected, true = cell_errors(restored)
    if len(true) == 0:
        return None
    return float(true.mean() / max(float(enhancer.calibration.applied(expected).mean()), SMALLEST_ERROR))


def with_error_model(
    enhancer: EmbeddedEnhancer, scenes: Sequence[tuple[Pairs, LightTransfer, Float[Tensor, "r 3 s s"] | None]]
) -> EmbeddedEnhancer:
    """The restorer with error model and calibration curve fitted to pairs of many scenes.

    Args:
        enhancer: trained.
        scenes: pairs that were not trained on, how brightness changes with distance in each, and patches of
            its frames.
    """
    plain = replace(enhancer, error_model=ErrorModel(), calibration=Calibration())
    features, errors = [], []
    for pairs, transfer, patches in scenes:
        with_patches = replace(plain, patches=patches)
        for view in range(len(pairs)):
            layers, weight = pairs.layers[view], pairs.weight[view : view + 1]
            noise = plain.noise(pairs.size, view, 0)
            restored = with_patches.restored_layers(layers, transfer, noise, steps=plain.steps)
            error = (restored.rgb - pairs.target[view : view + 1]).abs().mean(dim=1, keepdim=True)
            mean, share = cell_means(error, weight)
            each = error_features(layers, restored.rgb, restored.error)
            columns = [cell_means(each[:, [k]], weight)[0] for k in range(each.shape[1])]
            features.append(np.stack(columns, axis=1)[share > MIN_VALID_SHARE])
            errors.append(mean[share > MIN_VALID_SHARE])
    fitted = replace(plain, error_model=ErrorModel.fitted(np.concatenate(features), np.concatenate(errors)))
    cells = [
        cell_errors(restored_pairs(replace(fitted, patches=patches), pairs, transfer))
        for pairs, transfer, patches in scenes
    ]
    expected, true = (np.concatenate(part) for part in zip(*cells, strict=True))
    return replace(fitted, calibration=Calibration.fitted(expected, true))


def cell_errors(restored: RestoredPairs) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Expected (not calibrated) and true absolute errors of cells that are mostly valid.

    Args:
        restored: pairs with the truth.
    """
    pairs = restored.pairs
    error = (restored.rgb - pairs.target).abs().mean(dim=1, keepdim=True)
    expected, true = [], []
    for view in range(len(pairs)):
        one = slice(view, view + 1)
        predicted, share = cell_means(restored.error[one], pairs.weight[one])
        counted = share > MIN_VALID_SHARE
        expected.append(predicted[counted])
        true.append(cell_means(error[one], pairs.weight[one])[0][counted])
    return np.concatenate(expected), np.concatenate(true)
