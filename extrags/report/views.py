"""Rows of images: held-out views beside the truth, their depth, and virtual views before and after."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from extrags.report.encode import as_uint8, color_bar, color_mapped, fitted_image
from extrags.report.estimated_depth import DEPTH_COLORMAP
from extrags.report.image_table import (
    ERROR_COLORMAP,
    SCALE_QUANTILE,
    ColorScale,
    ImageCell,
    ImageRow,
    ImageTable,
    Judged,
    error_scale,
    evenly_spaced,
    image_cell,
    judged_table,
    scale_end,
)
from extrags.report.inputs import PseudoLike, RendersLike, ReportInputs
from extrags.report.wording import metric_of, number, shown_metrics
from extrags.sequence import EndoscopicSequence
from extrags.thresholds import HOLE_ALPHA

__all__ = ["depth_rows", "held_out_rows", "virtual_rows"]

UNCERTAINTY_COLORMAP = "cividis"
CHANGED_LEVELS = 8
"""A pixel counts as changed when a channel differs by more than this, of 255."""


def held_out_rows(inputs: ReportInputs, views: int, largest_bytes: int) -> ImageTable:
    """Coarse, final and true image of evenly spaced held-out views, and the error maps.

    Args:
        inputs: with renders of at least one of the two scenes.
        views: rows.
        largest_bytes: bound per image.
    """
    sequence = inputs.sequence
    chosen = evenly_spaced(len(inputs.frames), views)
    frames = inputs.frames[chosen]
    judged = [
        Judged(kind, kind.capitalize(), as_uint8(renders.rgb[chosen])) for kind, renders in _renders(inputs)
    ]
    notes = [_view_note(inputs, int(place)) for place in chosen]
    return judged_table(sequence, frames, judged, notes, len(inputs.frames), largest_bytes)


def depth_rows(inputs: ReportInputs, views: int, largest_bytes: int) -> ImageTable | None:
    """Rendered and true depth of the same views, and the relative errors.

    Args:
        inputs: with renders of at least one scene.
        views: rows.
        largest_bytes: bound per image.

    Returns:
        The table, or None when none of the views has true depth.
    """
    sequence = inputs.sequence
    if sequence.true_depth_mm is None:
        return None
    chosen = evenly_spaced(len(inputs.frames), views)
    frames = inputs.frames[chosen]
    masks = sequence.mask[frames]
    truth = sequence.true_depth_mm[frames].astype(np.float64)
    known = (truth > 0) & np.isfinite(truth) & masks
    if not known.any():
        return None
    near, far = (float(depth) for depth in np.quantile(truth[known], [1 - SCALE_QUANTILE, SCALE_QUANTILE]))
    # Restoration in the image leaves the depth as it is.
    depths = {
        kind: _surface_depth(renders, chosen) for kind, renders in _renders(inputs) if kind != "restored"
    }
    errors = {
        kind: np.where(known & (depth > 0), np.abs(depth - truth) / np.where(known, truth, 1), np.nan)
        for kind, depth in depths.items()
    }
    high = scale_end([error[np.isfinite(error)] for error in errors.values()])

    rows, holes = [], False
    for place, frame in enumerate(map(int, frames)):
        name = sequence.frame_name(frame)
        cells = []
        for label, depth in (*depths.items(), ("truth", np.where(known, truth, 0))):
            valid = (depth[place] > 0) & masks[place]
            holes = holes or not bool(valid.all())
            shown = color_mapped(depth[place], near, far, colormap=DEPTH_COLORMAP, valid=valid)
            alt = f"Frame {name}, depth, {label}"
            cells.append(ImageCell(fitted_image(shown, largest_bytes), label.capitalize(), alt))
        for kind, error in errors.items():
            shown = color_mapped(error[place], 0, high, colormap=ERROR_COLORMAP)
            alt = f"Frame {name}, relative depth error of the {kind} scene"
            cells.append(ImageCell(fitted_image(shown, largest_bytes), f"Error, {kind}", alt))
        rows.append(ImageRow(f"Frame {name}", "", tuple(cells)))
    unit = "mm" if sequence.metric else "units of the scene"
    scales = (
        ColorScale(color_bar(DEPTH_COLORMAP), f"≤ {near:.3g}", f"≥ {far:.3g}", f"z-depth in {unit}"),
        error_scale(high, "relative error of the depth"),
    )
    return ImageTable(tuple(rows), scales, len(rows), len(inputs.frames), masked=holes)


def virtual_rows(
    pseudo: PseudoLike, sequence: EndoscopicSequence, views: int, largest_bytes: int
) -> ImageTable:
    """Virtual views before and after restoration, evenly spaced over all trajectories.

    Args:
        pseudo: the pseudo-observations.
        sequence: its training frames are the references.
        views: rows.
        largest_bytes: bound per image.
    """
    total = len(pseudo.rendered)
    rows = []
    masked = False
    chosen = [int(index) for index in evenly_spaced(total, views)]
    errors = pseudo.expected_error
    high = 0.0 if errors is None else scale_end([np.asarray(errors[chosen], dtype=np.float64)])
    for index in chosen:
        u = np.asarray(pseudo.uncertainty[index], dtype=np.float64)
        reference = int(sequence.train[int(pseudo.reference[index])])
        # What is burnt in outside the picture, as a patient's name, has no place on a page.
        masked = masked or not bool(sequence.mask[reference].all())
        clip = int(pseudo.clip[index])
        where = f"virtual view {index + 1}"
        before, after = as_uint8(pseudo.rendered[index]), as_uint8(pseudo.target[index])
        changed = float((np.abs(after.astype(int) - before).max(-1) > CHANGED_LEVELS).mean())
        uncertainty = color_mapped(u, 0, 1, colormap=UNCERTAINTY_COLORMAP)
        name = sequence.frame_name(reference)
        cells = [
            image_cell(
                sequence.rgb[reference],
                sequence.mask[reference],
                "Reference",
                f"Reference frame {name}",
                largest_bytes,
            ),
            image_cell(before, None, "Rendered", f"Coarse render of {where}", largest_bytes),
            image_cell(
                as_uint8(pseudo.restored[index]), None, "Restored", f"Restored {where}", largest_bytes
            ),
            image_cell(after, None, "Used for training", f"Pseudo-observation of {where}", largest_bytes),
            image_cell(
                uncertainty,
                None,
                "Uncertainty",
                f"Uncertainty of {where}, mean {u.mean():.2f}",
                largest_bytes,
            ),
        ]
        if errors is not None:
            expected = np.asarray(errors[index], dtype=np.float64)
            shown = color_mapped(expected, 0, high, colormap=ERROR_COLORMAP)
            alt = f"Expected error of {where}, mean {expected.mean():.3f}"
            cells.append(image_cell(shown, None, "Expected error", alt, largest_bytes))
        note = (
            f"trajectory {clip + 1} · reference frame {name} · "
            f"image weight {number(float(pseudo.image_confidence[index]), 2)} · "
            f"mean uncertainty {number(float(u.mean()), 2)} · {100 * changed:.0f} % of the pixels changed"
        )
        rows.append(ImageRow(f"Virtual view {index + 1}", note, tuple(cells)))
    scales = [ColorScale(color_bar(UNCERTAINTY_COLORMAP), "0 known", "1 unknown", "uncertainty u")]
    if errors is not None:
        scales.append(error_scale(high, "error the restorer expects of its own colours"))
    return ImageTable(tuple(rows), tuple(scales), len(rows), total, masked=masked)


def _renders(inputs: ReportInputs) -> list[tuple[str, RendersLike]]:
    """The scenes that were rendered, by name."""
    pairs = (("coarse", inputs.coarse), ("final", inputs.final), ("restored", inputs.restored))
    return [(kind, renders) for kind, renders in pairs if renders is not None]


def _surface_depth(renders: RendersLike, chosen: np.ndarray) -> Float[np.ndarray, "n h w"]:
    """Depth where the render holds a surface, 0 elsewhere."""
    depth, alpha = (np.asarray(part[chosen], dtype=np.float64) for part in (renders.depth_mm, renders.alpha))
    return np.where((alpha >= HOLE_ALPHA) & np.isfinite(depth), depth, 0.0)


def _view_note(inputs: ReportInputs, index: int) -> str:
    """PSNR and SSIM of a view, before and after."""
    views: list[Any] = [
        None if result is None else result["per_view"][index]
        for result in (inputs.coarse_metrics, inputs.final_metrics, inputs.restored_metrics)
    ]
    said = []
    for metric in shown_metrics(*views)[:2]:
        values = [metric_of(view, metric.key) for view in views]
        known = [number(value, metric.digits) for value in values if value is not None]
        if known:
            said.append(f"{metric.label} {' → '.join(known)} {metric.unit}".strip())
    share = metric_of(views[1] or views[0], "unobserved", "pixel_share")
    if share is not None:
        said.append(f"{100 * share:.1f} % never observed")
    return " · ".join(said)
