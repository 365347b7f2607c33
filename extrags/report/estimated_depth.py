"""Depth that was estimated from images: maps of a few training frames, and the facts on each cue."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from extrags.report.encode import color_bar, color_mapped, fitted_image
from extrags.report.image_table import (
    ERROR_COLORMAP,
    SCALE_QUANTILE,
    ColorScale,
    ImageCell,
    ImageRow,
    ImageTable,
    error_scale,
    evenly_spaced,
    image_cell,
    scale_end,
)
from extrags.report.inputs import DepthLike
from extrags.report.wording import count, number
from extrags.sequence import EndoscopicSequence

__all__ = ["DEPTH_COLORMAP", "EstimatedDepth", "estimated_depth"]

DEPTH_COLORMAP = "viridis"


@dataclass(frozen=True, slots=True)
class EstimatedDepth:
    """The section on estimated depth.

    Args:
        table: frame, estimated depth, expected error and, where it was withheld, true depth.
        facts: figures with their names.
        unit: of the depths, in words.
        completed: whether a network had a part in it.
        combined: whether measured depth had, which is shown beside it.
    """

    table: ImageTable
    facts: tuple[tuple[str, str], ...]
    unit: str
    completed: bool
    combined: bool


def estimated_depth(
    sequence: EndoscopicSequence, estimate: DepthLike, views: int, largest_bytes: int
) -> EstimatedDepth:
    """Evenly spaced training frames with what was estimated of them.

    Args:
        sequence: all frames.
        estimate: depth of its training frames.
        views: rows.
        largest_bytes: bound per image.
    """
    truth = _true_depth(sequence)
    combined = bool(estimate.report.get("combined_with_measured", False))
    unit = "mm" if sequence.metric else "units of the scene"
    chosen = evenly_spaced(len(sequence.train), views)
    frames = sequence.train[chosen]
    masks = sequence.mask[frames]
    depths = {"Estimated depth": np.asarray(estimate.depth[chosen], dtype=np.float64)}
    if truth is not None:
        depths["Depth as measured" if combined else "True depth, withheld"] = truth[chosen].astype(np.float64)
    errors = np.where(masks, np.asarray(estimate.expected_error[chosen], dtype=np.float64), np.nan)
    known = np.concatenate([depth[(depth > 0) & masks] for depth in depths.values()])
    near, far = (
        (float(value) for value in np.quantile(known, [1 - SCALE_QUANTILE, SCALE_QUANTILE]))
        if known.size
        else (0.0, 1.0)
    )
    high = scale_end([errors[np.isfinite(errors)]])
    rows = []
    for place, frame in enumerate(map(int, frames)):
        name, mask = sequence.frame_name(frame), masks[place]
        cells = [image_cell(sequence.rgb[frame], mask, "Frame", f"Training frame {name}", largest_bytes)]
        for label, depth in depths.items():
            valid = (depth[place] > 0) & mask
            shown = color_mapped(depth[place], near, far, colormap=DEPTH_COLORMAP, valid=valid)
            alt = f"Training frame {name}, {label[:1].lower()}{label[1:]}"
            cells.append(ImageCell(fitted_image(shown, largest_bytes), label, alt))
        shown = color_mapped(errors[place], 0, high, colormap=ERROR_COLORMAP)
        alt = f"Training frame {name}, expected relative error of the estimated depth"
        cells.insert(2, ImageCell(fitted_image(shown, largest_bytes), "Expected error", alt))
        rows.append(ImageRow(f"Training frame {name}", "", tuple(cells)))
    scales = (
        ColorScale(color_bar(DEPTH_COLORMAP), f"≤ {near:.3g}", f"≥ {far:.3g}", f"z-depth in {unit}"),
        error_scale(high, "expected relative error of the depth"),
    )
    table = ImageTable(
        tuple(rows), scales, len(rows), len(sequence.train), masked=not bool(sequence.mask[frames].all())
    )
    facts = tuple(_facts(sequence, estimate, truth, combined=combined))
    return EstimatedDepth(table, facts, unit, estimate.report["completion"] != "none", combined)


def _facts(
    sequence: EndoscopicSequence, estimate: DepthLike, truth: np.ndarray | None, *, combined: bool
) -> list[tuple[str, str]]:
    report = estimate.report
    facts = [
        ("Scale", sequence.scale_words),
        ("Points", f"{count(report['n_points'])}, from {report['points_from']}"),
        ("Median expected error", f"{100 * report['median_expected_error']:.1f} %"),
        ("Pixels confirmed by other frames", f"{100 * report['agreeing_share']:.0f} %"),
    ]
    if combined:
        facts.insert(2, ("Error of the measured depth", f"{100 * report['median_measured_error']:.1f} %"))
    several = len(report["shading"]) > 1
    for index, fit in enumerate(report["shading"]):
        words = "no relation of brightness and distance"
        if fit["slope"] > 0:
            words = (
                f"distance as brightness to the power \N{MINUS SIGN}{number(fit['slope'], 2)}, scatter "
                f"{number(fit['scatter'], 2)} of log-distances that spread by {number(fit['spread'], 2)}"
            )
        facts.append((f"Shading, recording {index + 1}" if several else "Shading", words))
    networks = report.get("monocular", [])
    for index, fit in enumerate(networks):
        name = f"Monocular network, recording {index + 1}" if len(networks) > 1 else "Monocular network"
        words = (
            f"{fit['frames_aligned']} frames aligned, scatter {number(fit['scatter'], 2)} of log-distances"
        )
        facts.append((name, words if fit["frames_aligned"] else "could not be aligned with stereo"))
    if truth is not None:
        known = (truth > 0) & sequence.mask[sequence.train] & (estimate.depth > 0)
        if known.any():
            ratio = np.asarray(estimate.depth, dtype=np.float64)[known] / truth[known]
            name = "Mean difference from the measured depth" if combined else "Mean relative error"
            facts.append((name, f"{100 * float(np.abs(ratio - 1).mean()):.1f} %"))
    return facts


def _true_depth(sequence: EndoscopicSequence) -> np.ndarray | None:
    """True depth of the training frames that the evaluation alone may know; None without."""
    if sequence.true_depth_mm is None:
        return None
    truth = sequence.true_depth_mm[sequence.train]
    return truth if bool((truth > 0).any()) else None
