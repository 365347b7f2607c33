"""Numbers and comparisons in words: how a figure is written, and whether a change is for the better."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from extrags.metrics.registry import Metric, metric_named, metrics
from extrags.sequence import EndoscopicSequence

__all__ = [
    "Comparison",
    "compare",
    "count",
    "coverage_of",
    "coverage_words",
    "described_metrics",
    "duration",
    "intrinsics_in_words",
    "metric_of",
    "number",
    "percent",
    "restorer_words",
    "same_pixels",
    "shown_metrics",
    "with_coverages",
]

MINUS = "\N{MINUS SIGN}"
MISSING = "\N{EN DASH}"
UNLIKE = 1.5
"""So many times the error that a restorer expects of itself in a scene unlike those it has learned from."""
COVERAGE_APART = 0.01
"""Figures over shares of the pixels that differ by more are over different pixels."""
Verdict = Literal["better", "worse", "equal", "other pixels", ""]


@dataclass(frozen=True, slots=True)
class Comparison:
    """A figure of the coarse and of the final scene, ready to be shown."""

    coarse: str
    final: str
    change: str
    verdict: Verdict
    why: str = ""
    """Why there is no figure."""
    coverage: str = ""
    """Which share of the pixels the figures are over, in words; empty for all of them."""


def number(value: float | int | None, digits: int, *, signed: bool = False) -> str:
    """A number with a real minus sign; an en dash for none."""
    if value is None or not math.isfinite(value):
        return MISSING
    text = f"{value:+.{digits}f}" if signed else f"{value:.{digits}f}"
    if float(text) == 0:
        text = f"{'±' if signed else ''}{0:.{digits}f}"
    return text.replace("-", MINUS)


def restorer_words(provenance: Mapping[str, Any]) -> str:
    """What restored the virtual views, and how it did on left-out frames; empty where nothing is known.

    Args:
        provenance: of the restored views; `judged` is `{restored_db, filled_db, error_over_expected}`, and
            has `plain_db` where the restorer only serves by cloning seamlessly.
    """
    if "backend" not in provenance:
        return ""
    score = provenance.get("domain_score")
    return _judged_words(provenance) + ("" if score is None else f" {_domain_words(float(score))}")


def _domain_words(score: float) -> str:
    likeness, side = ("unlike", "above") if score > 1 else ("like", "at most")
    return (
        f"Domain score {number(score, 2)}: frames of this scene are {likeness} those that the network was "
        f"trained on ({side} 1)."
    )


def _judged_words(provenance: Mapping[str, Any]) -> str:
    trained_on = provenance.get("trained_on")
    said = f"Restored by {provenance['backend']}{f', weights for {trained_on}' if trained_on else ''}."
    judged = provenance.get("judged")
    if provenance.get("seamless"):
        said += " What it invents is cloned seamlessly into what is known, which keeps its colours"
        said += f": {provenance['unjudged']}." if provenance.get("unjudged") else "."
    if not judged:
        if provenance["backend"] == "classical" and provenance.get("reason"):
            return f"Restored by blending and filling: {provenance['reason']}."
        return said
    restored, filled = (number(judged[name], 2) for name in ("restored_db", "filled_db"))
    if provenance["backend"] == "classical":
        loss = number(judged["filled_db"] - judged["restored_db"], 2)
        return (
            "Restored by blending and filling. The network was left out: on left-out frames of this scene "
            f"it reaches {restored} dB, {loss} dB less than blending and filling with {filled} dB."
        )
    plain = judged.get("plain_db")
    said += (
        f" On left-out frames of this scene the network reaches {restored} dB, "
        f"{'' if plain is None else f'without cloning {number(plain, 2)} dB, '}"
        f"blending and filling {filled} dB."
    )
    ratio = judged.get("error_over_expected")
    if ratio is None:
        return said
    said += f" Its error there is {number(ratio, 2)} times what it expected of itself"
    if ratio > UNLIKE:
        return f"{said}: this scene is unlike those it has learned from; trust what is invented less."
    return f"{said}, as in scenes like those it has learned from."


def percent(share: float | None) -> str:
    """A share as whole per cent with a real minus sign; an en dash for none."""
    text = number(None if share is None else 100 * share, 0)
    return text if text == MISSING else f"{text}\N{NARROW NO-BREAK SPACE}%"


def count(value: float | int | None) -> str:
    """A whole number with thin spaces between thousands."""
    return MISSING if value is None else f"{round(value):,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def duration(seconds: float | int | None) -> str:
    """Seconds in readable form: `0.3 s`, `42 s`, `3 min 05 s`, `2 h 04 min`."""
    if seconds is None:
        return MISSING
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def intrinsics_in_words(sequence: EndoscopicSequence) -> str:
    """Focal length and field of view of the first frame, and how they are known."""
    focal_px = float(sequence.K[0, 0, 0])
    angle_deg = math.degrees(2 * math.atan(sequence.width / 2 / focal_px))
    if sequence.intrinsics == "guessed":
        return f"guessed: {focal_px:.1f} px ({angle_deg:.0f} degrees), not determined"
    if sequence.lens is not None:
        lens_deg = 2 * math.degrees(sequence.lens.max_angle_rad)
        return f"{focal_px:.1f} px on the axis of a lens of {lens_deg:.0f} degrees, in its own pixels"
    spread = "" if sequence.focal_std_px is None else f" \N{PLUS-MINUS SIGN} {sequence.focal_std_px:.1f}"
    return f"{focal_px:.1f} px{spread} (field of view {angle_deg:.0f} degrees), {sequence.intrinsics}"


def metric_of(tree: Mapping[str, Any] | None, *path: str) -> float | None:
    """A figure of a tree of metrics, or None when any part of the way is missing."""
    node: Any = tree
    for name in path:
        if not isinstance(node, Mapping):
            return None
        node = node.get(name)
    return None if node is None or isinstance(node, Mapping) else float(node)


def coverage_of(metric: Metric, tree: Mapping[str, Any] | None, *path: str) -> float | None:
    """Share of the pixels, in [0, 1], that a metric is over; None where it is over all, or nobody knows."""
    return metric_of(tree, *path, metric.coverage) if metric.coverage else None


def same_pixels(*coverages: float | None) -> bool:
    """Whether figures over these shares of the pixels can be held against each other."""
    known = [coverage for coverage in coverages if coverage is not None]
    return not known or max(known) - min(known) <= COVERAGE_APART


def coverage_words(coarse: float | None, final: float | None = None) -> str:
    """Which share of the pixels a figure is over: `over more pixels: coverage 94 % → 100 %`.

    Empty where nothing is known.
    """
    shares = list(dict.fromkeys(percent(share) for share in (coarse, final) if share is not None))
    if not shares:
        return ""
    said = f"coverage {' → '.join(shares)}"
    if coarse is None or final is None or same_pixels(coarse, final):
        return said
    return f"over {'more' if final > coarse else 'fewer'} pixels: {said}"


def compare(
    metric: Metric,
    coarse: float | int | None,
    final: float | int | None,
    why: str = "",
    coverage: tuple[float | None, float | None] = (None, None),
) -> Comparison:
    """A figure before and after, with the change in words that do not need colour.

    Args:
        metric: of the figure.
        coarse: before.
        final: after.
        why: there is none.
        coverage: share of the pixels that each is over; where they differ, neither figure is called better.
    """
    change = None if coarse is None or final is None else final - coarse
    verdict: Verdict = ""
    if change is not None:
        if not same_pixels(*coverage):
            verdict = "other pixels"
        elif round(change, metric.digits) == 0:
            verdict = "equal"
        else:
            verdict = "better" if (change > 0) == metric.higher_is_better else "worse"
    missing = coarse is None and final is None
    return Comparison(
        number(coarse, metric.digits),
        number(final, metric.digits),
        number(change, metric.digits, signed=True),
        verdict,
        why if missing else "",
        "" if missing else coverage_words(*coverage),
    )


def shown_metrics(*trees: Mapping[str, Any] | None) -> list[Metric]:
    """The metrics a page has columns for: all but LPIPS with a network that was not asked for."""
    return [
        metric
        for metric in metrics()
        if metric.shown.get("tiles")
        # A network without weights keeps its column: its absence has a reason.
        and (metric.lpips_net is None or any(metric.key in (tree or {}) for tree in trees))
    ]


def with_coverages(shown: Sequence[Metric]) -> list[Metric]:
    """The metrics of a list, each that is over a part of the pixels followed by its coverage."""
    found = []
    for metric in shown:
        found += [metric, *([metric_named(metric.coverage)] if metric.coverage else [])]
    return found


def described_metrics(*trees: Mapping[str, Any] | None, reasons: str = "") -> dict[str, str]:
    """What the metrics of a page are, in words, by their label; all networks of LPIPS together.

    Args:
        trees: figures of the runs on the page.
        reasons: where it says why a figure is missing; empty where it does not.
    """
    found = {}
    shown = shown_metrics(*trees)
    networks = " and ".join(metric.network for metric in _measured(shown, trees) if metric.network)
    for metric in shown:
        if metric.lpips_net is None:
            found[metric.label] = metric.description
            continue
        found["LPIPS"] = (
            f"Version 0.1, on the network {networks}. Figures of another network cannot be compared with "
            "these."
            if networks
            else f"Not measured here; {reasons or 'the page of a sequence says why'}. Where it is measured, "
            "its network is named."
        )
    return found


def _measured(candidates: Sequence[Metric], trees: Sequence[Mapping[str, Any] | None]) -> list[Metric]:
    return [metric for metric in candidates if any(metric_of(tree, metric.key) is not None for tree in trees)]
