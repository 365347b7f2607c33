"""Findings about masks: inverted ones, and those that keep hardly anything."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import Bool, UInt8

from data_catalog.findings import Finding, warning
from extrags.sequence import EndoscopicSequence

__all__ = ["mask_findings", "tell_of_inverted_masks"]

_log = logging.getLogger(__name__)
_POLARITY = "mask polarity"

_NARROW_MASK = 0.3
"""Masks that leave more out are rare: round pictures fill over half of their images."""


def mask_findings(sequence: EndoscopicSequence) -> Iterator[Finding]:
    """Masks that keep the dark frame and leave the picture out, or hardly keep anything.

    Args:
        sequence: whose masks they are.

    Yields:
        At most one finding.
    """
    kept = np.array([float(mask.mean()) for mask in sequence.mask])
    if 1 - kept.mean() < 0.02:
        return
    lit_inside, lit_outside = _shares(sequence, (_brightest(image) > 25 for image in sequence.rgb))
    if lit_inside < 0.3 and lit_outside > 0.6:
        yield Finding(
            kind="error",
            topic=_POLARITY,
            sentence=f"{1 - lit_inside:.0%} of the pixels that the mask keeps are dark and {lit_outside:.0%} "
            "of those it leaves out are lit: the mask is inverted. Expected white on tissue",
            field="mask",
        )
        return
    if sequence.depth_mm is not None:
        known_inside, known_outside = _shares(sequence, (depth > 0 for depth in sequence.depth_mm))
        if known_inside < 0.2 and known_outside > 0.8:
            yield Finding(
                kind="error",
                topic=_POLARITY,
                sentence=f"depth is known for {known_inside:.0%} of the pixels that the mask keeps and for "
                f"{known_outside:.0%} of those it leaves out: the mask is inverted. Expected white on tissue",
                field="mask",
            )
            return
    if kept.mean() < _NARROW_MASK and lit_outside > 0.6:
        yield warning(
            _POLARITY,
            f"the mask keeps {kept.mean():.0%} of the pixels, and {lit_outside:.0%} of those it leaves out "
            "are lit. Is it inverted? Expected white on tissue",
            field="mask",
        )
        return
    if kept.min() < 0.05:
        index = int(kept.argmin())
        yield warning(
            "mask",
            f"the mask keeps {kept[index]:.1%} of the image",
            frame=sequence.frame_name(index),
            field="mask",
        )


def tell_of_inverted_masks(sequence: EndoscopicSequence) -> None:
    """Warn of masks that look inverted: training and figures would be of what they keep, without a word.

    Args:
        sequence: whose masks they are.
    """
    for finding in mask_findings(sequence):
        if finding.topic == _POLARITY:
            told = {"topic": finding.topic, "field": finding.field, "kind": finding.kind}
            _log.warning("%s: %s", sequence.name, finding.sentence, extra=told)


def _brightest(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
    """Largest channel of each pixel; several times as fast as over the last axis."""
    return np.asarray(np.maximum(np.maximum(image[..., 0], image[..., 1]), image[..., 2]))


def _shares(sequence: EndoscopicSequence, frames: Iterable[Bool[np.ndarray, "h w"]]) -> tuple[float, float]:
    """Share of the pixels that the mask keeps, and of those it leaves out, for which something holds.

    Args:
        sequence: whose mask it is.
        frames: where it holds, one frame after another.
    """
    within, beyond = 0, 0
    for holds, mask in zip(frames, sequence.mask, strict=True):
        within += int((holds & mask).sum())
        beyond += int((holds & ~mask).sum())
    inside = sum(int(mask.sum()) for mask in sequence.mask)
    return within / max(1, inside), beyond / max(1, sequence.mask.size - inside)
