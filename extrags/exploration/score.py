"""Score of a candidate view: its coverage gain, times the factors listed in `FACTORS`.

To change what the search looks for, add a factor here and its setting to `ExploreConfig`; the search itself
only ranks. `stage_inventory` then names the stages whose version has to be raised.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from extrags.config import ExploreConfig
from extrags.exploration.darkness import illumination_weight

__all__ = ["FACTORS", "Candidates", "fold_weight", "hole_weight", "score"]


@dataclass(frozen=True, slots=True)
class Candidates:
    """The feasible moves from one view, with the measurements of their scoring renders.

    Args:
        gain: newly covered (Gaussian, direction) pairs of each, [A].
        hole_share: share of pixels without a surface, [A].
        poses: `world_from_camera` of each, [A, 4, 4].
        start: that of the view they start from, [4, 4].
        dark: world-space unit ray through the darkest patch of that view; zero where none is dark, [3].
        turns_deg: angles turned in the last moves, the candidate's own last, [A, K].
    """

    gain: Int[np.ndarray, "a"]
    hole_share: Float[np.ndarray, "a"]
    poses: Float[np.ndarray, "a 4 4"]
    start: Float[np.ndarray, "4 4"]
    dark: Float[np.ndarray, "3"]
    turns_deg: Float[np.ndarray, "a k"]


def score(candidates: Candidates, config: ExploreConfig) -> Float[np.ndarray, "a"]:
    """Coverage gain times all factors, [A]; the search takes the largest."""
    total = candidates.gain.astype(np.float64)
    for factor in FACTORS.values():
        total = total * factor(candidates, config)
    return total


def _illumination(candidates: Candidates, config: ExploreConfig) -> Float[np.ndarray, "a"]:
    return illumination_weight(candidates.dark, candidates.start, candidates.poses, config.darkness_weight)


def _fold(candidates: Candidates, config: ExploreConfig) -> Float[np.ndarray, "a"]:
    return fold_weight(candidates.turns_deg, config)


def fold_weight(turns_deg: Float[np.ndarray, "*b k"], config: ExploreConfig) -> Float[np.ndarray, "*b"]:
    """Factor eta where the last moves together turn by more than tau_R, else one.

    One primitive alone turns by less than tau_R in every profile: a threshold on single moves would never
    be passed, so the turns of the last moves, the candidate's own included, are added up.

    Source: [ExtraGS, eq. 15 and 16], see docs/references.md.
    """
    return np.where(turns_deg.sum(axis=-1) > config.fold_angle_deg, config.fold_penalty, 1.0)


def hole_weight(candidates: Candidates, config: ExploreConfig) -> Float[np.ndarray, "a"]:
    """Factor 1 + `hole_weight` x hole share: missing surface has no Gaussians that could count as covered.

    Not in the paper; `explore.hole_weight=0` is the paper's rule.
    """
    return 1 + config.hole_weight * candidates.hole_share


Factor = Callable[[Candidates, ExploreConfig], Float[np.ndarray, "a"]]

FACTORS: dict[str, Factor] = {"illumination": _illumination, "fold": _fold, "holes": hole_weight}
"""By name; one factor per candidate, [A]. The order is part of the result's last bits."""
