"""Score of a candidate view: what it newly covers, times the factors listed in `FACTORS`.

To change what the search looks for, add a factor here and its setting to `ExploreConfig`; the search itself
only ranks. Factors steer the choice of the next move alone: which path is kept and which trajectory is
accepted is decided by the worth of the new pairs itself. `stage_inventory` then names the stages whose
version has to be raised.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from extrags.cameras import rotation_angle_deg
from extrags.config import ExploreConfig
from extrags.exploration.darkness import illumination_weight

__all__ = ["FACTORS", "Candidates", "fold_weight", "net_turn_deg", "score"]


@dataclass(frozen=True, slots=True)
class Candidates:
    """The feasible moves from one view, with the measurements of their scoring renders.

    Args:
        value: worth of the newly covered pairs of each (`PairValue.gain`), [A].
        poses: `world_from_camera` of each, [A, 4, 4].
        start: that of the view they start from, [4, 4].
        dark: world-space unit ray through the darkest patch of that view; zero where none is dark, [3].
        turned_deg: net rotation over the last `fold_steps` moves, the candidate's own included, [A].
    """

    value: Float[np.ndarray, "a"]
    poses: Float[np.ndarray, "a 4 4"]
    start: Float[np.ndarray, "4 4"]
    dark: Float[np.ndarray, "3"]
    turned_deg: Float[np.ndarray, "a"]


def score(candidates: Candidates, config: ExploreConfig) -> Float[np.ndarray, "a"]:
    """Value times all factors, [A]; the search takes the largest."""
    total = candidates.value
    for factor in FACTORS.values():
        total = total * factor(candidates, config)
    return total


def _illumination(candidates: Candidates, config: ExploreConfig) -> Float[np.ndarray, "a"]:
    return illumination_weight(candidates.dark, candidates.start, candidates.poses, config.darkness_weight)


def _fold(candidates: Candidates, config: ExploreConfig) -> Float[np.ndarray, "a"]:
    return fold_weight(candidates.turned_deg, config)


def net_turn_deg(
    path: Float[np.ndarray, "t 4 4"], candidates: Float[np.ndarray, "a 4 4"], steps: int
) -> Float[np.ndarray, "a"]:
    r"""Rotation between a path's view `steps` moves ago and each candidate for its next view, in degrees.

    .. math:: \Delta R^{(a)} = \angle(R_{t + 1 - s}^{-1} R_t^{(a)})

    Args:
        path: `world_from_camera` of the views so far, the present one last.
        candidates: `world_from_camera` of the candidates.
        steps: s moves, the candidate's own included; on a shorter path, those since its start.

    Source: [ExtraGS, eq. 15] with one step, see docs/references.md.
    """
    before = path[max(0, len(path) - steps), :3, :3]
    return rotation_angle_deg(np.broadcast_to(before, (len(candidates), 3, 3)), candidates[:, :3, :3])


def fold_weight(turned_deg: Float[np.ndarray, "*b"], config: ExploreConfig) -> Float[np.ndarray, "*b"]:
    """Factor eta where the camera has turned by more than tau_R since the view `fold_steps` moves ago.

    The angle is that of the net rotation: a turn to the left and back again is none. With `fold_steps` of 1
    it is the rotation of the move alone, as in the paper, where tau_R of 20 degrees is never exceeded by
    turns of 10; over three moves turns in the same direction are.

    Source: [ExtraGS, eq. 15 and 16], see docs/references.md; more than one step is our own.
    """
    return np.where(turned_deg > config.fold_angle_deg, config.fold_penalty, 1.0)


Factor = Callable[[Candidates, ExploreConfig], Float[np.ndarray, "a"]]

FACTORS: dict[str, Factor] = {"illumination": _illumination, "fold": _fold}
"""By name; one factor per candidate, [A]. The order is part of the result's last bits."""
