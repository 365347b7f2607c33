"""Which training frames are blurred, and count less, and which show tissue that has moved.

A frame is judged by the others that see the same surface, warped into it through its depth. Sharpness is a
ratio on the same surface: smooth tissue is no blurred frame, and frames that are all equally soft are all
sharp enough. What remains displaced after the warp has moved by itself, or the frame's pose is wrong.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from extrags.config import CoarseConfig
from extrags.errors import ShapeError
from extrags.sequence import EndoscopicSequence
from extrags.store.storable import Storable
from extrags.training.frame_comparison import ComparedFrames, PairComparison
from extrags.training.views import View, real_views

__all__ = ["FrameWeights", "frame_weights", "weighted_views"]

logger = logging.getLogger(__name__)

NOISE = 1e-6
"""Squared gradient of log-brightness in 8-bit pictures without any detail: added to both sides of a ratio."""

LEAST_SHARPNESS = 0.84
"""A frame with this share of the others' detail counts fully; frames of clear sequences stay above it."""

MIN_SOURCES = 2
"""Other frames without which a frame cannot be judged."""

DISPLACED_SHARE = 0.01
"""Displacement, as a share of the image width, above which pixels of two frames disagree."""

TIMES_TYPICAL = 3.0
"""So many times the typical displacement is tolerated where poses or depth leave all frames displaced."""

DISPLACED_QUANTILE = 0.9
"""Frames disagree when a tenth of their pixels do."""

DISAGREEING_SHARE = 0.5
"""A frame has moved when it disagrees with at least this share of the frames it is compared with."""

LEAST_WEIGHT = 0.1
"""No frame loses all weight: it may be the only one that shows some of the surface."""

_TOLD_WEIGHT = 0.995
"""Weights of this or more are shown as 100 %: nothing is told of them."""


@dataclass(frozen=True)
class FrameWeights(Storable):
    """What training frames are worth.

    Args:
        names: of the frames, M.
        sharpness: detail in the frame's softest direction over that of other frames on the same surface, [M];
            NaN where too few see it.
        displaced: share of the pixels that have moved, [M]; zero where the frame agrees with the others.
        weights: of a frame's colours, [M]: one unless it is blurred.
        applied: whether training used the weights, or they are only reported.
    """

    stored_as: ClassVar[str] = "frame_weights.json"

    names: tuple[str, ...]
    sharpness: Float[np.ndarray, "m"]
    displaced: Float[np.ndarray, "m"]
    weights: Float[np.ndarray, "m"]
    applied: bool = False

    @property
    def statements(self) -> list[str]:
        """Which frames are blurred or have moved, by what evidence; empty where none is."""
        blurred = [
            f"frame {self.names[position]} is blurred: {self.sharpness[position]:.0%} of the detail that "
            f"others show there" + (f", it counts {self.weights[position]:.0%}" if self.applied else "")
            for position in np.flatnonzero(self.weights < _TOLD_WEIGHT).tolist()
        ]
        return blurred + [
            f"frame {self.names[position]} disagrees with the others: {self.displaced[position]:.0%} of "
            "it displaced"
            for position in np.flatnonzero(self.displaced).tolist()
        ]

    def applied_to(self, views: Sequence[View]) -> list[View]:
        """The frames' views with these weights; those that count fully are returned as they are.

        Blur spoils colours alone: the weight of depth stays.
        """
        found = list(views)
        for position in np.flatnonzero(self.weights < 1).tolist():
            view = views[position]
            found[position] = replace(
                view,
                weight_factor=float(self.weights[position]),
                # Divided by what the sum of the weights was: a weighted mean would undo a frame's weight.
                normalisation=max(float(view.weight.sum()), 1.0),
            )
        return found

    def to_json(self) -> list[dict[str, Any]]:
        """A row per frame, for the artefact."""
        return [
            {
                "frame": name,
                "sharpness": None if np.isnan(self.sharpness[position]) else float(self.sharpness[position]),
                "displaced_share": float(self.displaced[position]),
                "weight": float(self.weights[position]),
            }
            for position, name in enumerate(self.names)
        ]

    def save(self, path: Path) -> None:
        """Write `to_json`, which leaves out whether they are applied."""
        path.write_text(json.dumps(self.to_json(), indent=1, allow_nan=False), encoding="utf-8")

    @classmethod
    def load(cls, path: Path) -> FrameWeights:
        """Read what `save` wrote."""
        rows = json.loads(path.read_bytes())
        sharpness = [np.nan if row["sharpness"] is None else row["sharpness"] for row in rows]
        return cls(
            names=tuple(row["frame"] for row in rows),
            sharpness=np.array(sharpness, dtype=np.float64),
            displaced=np.array([row["displaced_share"] for row in rows], dtype=np.float64),
            weights=np.array([row["weight"] for row in rows], dtype=np.float64),
        )


def frame_weights(sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"]) -> FrameWeights | None:
    """Find frames that are blurred, or show tissue that has moved.

    Args:
        sequence: posed frames.
        frames: which of them; no other is looked at.

    Returns:
        The weights, or None where none of the frames has depth to compare it through.
    """
    depth_mm = sequence.depth_mm
    if depth_mm is None or not any(bool((depth_mm[frame] > 0).any()) for frame in frames):
        logger.info("%s: without depth no blurred or moved frames are looked for", sequence.name)
        return None
    # On image planes: homographies and flow know no lens.
    compared = ComparedFrames(sequence.as_pinhole(), frames)
    pairs: set[tuple[int, int]] = set()
    for frame in range(len(compared)):
        for source in compared.sources(frame):
            pairs |= {(frame, source), (source, frame)}
    tensors: dict[tuple[int, int], PairTensors] = {}
    displacements: dict[tuple[int, int], float] = {}
    for pair in sorted(pairs):
        found = compared.compare(*pair)
        if found is not None:
            tensors[pair] = found.own, found.other
            displacements[pair] = _displacement(found)
    sharpness = _sharpness(tensors, len(compared))
    # NaN compares as false: what cannot be judged counts fully.
    weights = np.where(
        sharpness < LEAST_SHARPNESS, np.clip((sharpness / LEAST_SHARPNESS) ** 2, LEAST_WEIGHT, 1), 1.0
    )
    displaced = np.zeros(len(compared))
    positions, limit = _disagreeing(displacements, len(compared), DISPLACED_SHARE * compared.width)
    for position in positions:
        agreeing = [
            source for frame, source in sorted(pairs) if frame == position and source not in positions
        ]
        displaced[position] = _displaced_share(compared, position, agreeing, limit)
    names = tuple(sequence.frame_name(int(frame)) for frame in frames)
    return FrameWeights(names, sharpness, displaced, weights)


def weighted_views(
    sequence: EndoscopicSequence,
    frames: Int[np.ndarray, "m"],
    config: CoarseConfig,
    found: FrameWeights | None = None,
) -> tuple[list[View], FrameWeights | None]:
    """Frames as views, and what was found of them; None where the settings or the data say nothing.

    Args:
        sequence: posed frames.
        frames: which of them.
        config: says in `inconsistent_frames` whether to look, and whether the views get the weights.
        found: of these frames, earlier; None looks for it.

    Raises:
        ShapeError: where something was found of other frames than these.
    """
    views = real_views(sequence, frames)
    if config.inconsistent_frames == "ignore":
        return views, None
    weights = frame_weights(sequence, frames) if found is None else found
    if weights is not None and weights.names != tuple(sequence.frame_name(int(frame)) for frame in frames):
        raise ShapeError(
            f"{sequence.name}: weights of {len(weights.names)} frames do not fit {len(frames)} frames"
        )
    if weights is None or config.inconsistent_frames == "report":
        return views, weights
    return weights.applied_to(views), replace(weights, applied=True)


PairTensors = tuple[NDArray[np.floating[Any]], NDArray[np.floating[Any]]]
"""Structure tensors of a frame, and of another warped into it."""


def _sharpness(tensors: dict[tuple[int, int], PairTensors], count: int) -> Float[np.ndarray, "m"]:
    """Of each frame the median over the others.

    Resampling softens the frame that is warped: each pair is compared both ways, which cancels that.
    """
    ratios: list[list[float]] = [[] for _ in range(count)]
    for (frame, source), (own, other) in tensors.items():
        if (source, frame) in tensors:
            theirs, warped = tensors[source, frame]
            ratios[frame].append(0.5 * (_log_least_ratio(own, other) + _log_least_ratio(warped, theirs)))
    return np.array([np.exp(np.median(r)) if len(r) >= MIN_SOURCES else np.nan for r in ratios])


def _log_least_ratio(tensor: Float[np.ndarray, "2 2"], reference: Float[np.ndarray, "2 2"]) -> float:
    """Logarithm of the ratio of two pictures' gradients in the direction where it is least.

    Motion blurs one direction and leaves the other sharp: the least generalised eigenvalue finds it.
    """
    noise = NOISE * np.eye(2)
    both = np.linalg.solve(reference + noise, tensor + noise)
    half = 0.5 * float(np.trace(both))
    least = half - np.sqrt(max(half**2 - float(np.linalg.det(both)), 0.0))
    return 0.5 * float(np.log(max(least, 1e-6)))


def _displacement(found: PairComparison) -> float:
    lengths = np.linalg.norm(found.displacement_px[found.compared], axis=-1)
    return float(np.quantile(lengths, DISPLACED_QUANTILE))


def _disagreeing(
    displacements: dict[tuple[int, int], float], count: int, least_limit: float
) -> tuple[list[int], float]:
    """Frames that explain, with as few of them as may be, why pairs disagree; and the limit taken, in pixels.

    A frame that has moved disagrees with all others, these with it alone: the frame in most of the
    disagreeing pairs is taken, its pairs are put aside, and so on.
    """
    pairs: dict[tuple[int, int], float] = {}
    for (frame, source), length in displacements.items():
        both = min(frame, source), max(frame, source)
        pairs[both] = max(length, pairs.get(both, 0.0))
    if not pairs:
        return [], least_limit
    limit = max(least_limit, TIMES_TYPICAL * float(np.median(list(pairs.values()))))
    chosen: list[int] = []
    while True:
        disagreeing, judged = np.zeros(count), np.zeros(count)
        for both, length in pairs.items():
            if not set(both) & set(chosen):
                judged[list(both)] += 1
                disagreeing[list(both)] += length > limit
        share = disagreeing / np.maximum(judged, 1)
        worth = np.where((judged >= MIN_SOURCES) & (share >= DISAGREEING_SHARE), share * disagreeing, 0)
        worst = int(np.argmax(worth))
        if worth[worst] == 0:
            return chosen, limit
        chosen.append(worst)


def _displaced_share(compared: ComparedFrames, frame: int, sources: list[int], limit_px: float) -> float:
    """Share of a frame's pixels that are farther than the limit from where the other frames say."""
    found = [pair for source in sources if (pair := compared.compare(frame, source)) is not None]
    if len(found) < MIN_SOURCES:
        return 0.0
    seen = np.stack([pair.compared for pair in found])
    flows = np.stack([pair.displacement_px for pair in found])
    judged = seen.sum(axis=0) >= MIN_SOURCES
    known = np.where(seen[..., None], flows, np.nan)[:, judged]
    length = np.linalg.norm(np.nanmedian(known, axis=0), axis=-1)
    return float((length > limit_px).sum() / judged.size)
