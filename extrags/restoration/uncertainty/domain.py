r"""Whether a scene is of the world that the restorer has learned from.

The network's features of real frames (`extrags.restoration.diffusion.frame_features`) are taken for normally
distributed over what it was trained on. A frame's distance is Mahalanobis's in the leading directions,

.. math:: d = \sqrt{\tfrac{1}{K} \sum_k (u_k^T (x - \mu))^2 / s_k^2} ,

and a scene's score the median distance of its frames, divided by the one that 95 % of scenes stay below
which were not trained on. Above one, the restorer is outside of what it knows.

Source: Mahalanobis distance of deep features, [LeeDomain2018].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from extrags.errors import ShapeError

__all__ = ["Domain"]

DIRECTIONS = 24
MIN_DEVIATION_SHARE = 0.02
"""Directions in which training scenes hardly differ are given this share of the largest deviation: there, the
smallest difference would decide."""
INSIDE_SHARE = 0.95


@dataclass(frozen=True)
class Domain:
    """Distribution of the features that were trained on.

    Args:
        mean: [C].
        directions: orthonormal, [K, C].
        deviation: standard deviation along each, [K].
        limit: distance that 95 % of unseen scenes of the same world stay below.

    Raises:
        ShapeError: when the parts do not fit each other.
    """

    mean: Float[np.ndarray, "c"]
    directions: Float[np.ndarray, "k d"]
    deviation: Float[np.ndarray, "k2"]
    limit: float

    def __post_init__(self) -> None:
        if self.directions.shape != (len(self.deviation), len(self.mean)):
            raise ShapeError(
                f"{self.directions.shape} directions, {len(self.deviation)} deviations and "
                f"{len(self.mean)} features do not fit"
            )

    @classmethod
    def fitted(
        cls,
        trained: Float[np.ndarray, "n c"],
        unseen: Sequence[Float[np.ndarray, "m c"]],
    ) -> Domain:
        """The distribution of the features of training frames.

        Args:
            trained: of frames of scenes that were trained on.
            unseen: of the frames of each scene that was not; they set the limit.
        """
        mean = trained.mean(axis=0)
        _, singular, directions = np.linalg.svd(trained - mean, full_matrices=False)
        count = min(DIRECTIONS, len(singular))
        deviation = singular[:count] / np.sqrt(max(1, len(trained) - 1))
        deviation = np.maximum(deviation, MIN_DEVIATION_SHARE * deviation.max(initial=1e-12))
        raw = cls(mean, directions[:count], deviation, 1.0)
        scores = [raw.score(features) for features in unseen]
        limit = float(np.quantile(scores, INSIDE_SHARE)) if scores else 1.0
        return cls(mean, directions[:count], deviation, max(limit, 1e-6))

    def score(self, features: Float[np.ndarray, "m c"]) -> float:
        """Distance of a scene from what was trained on, in units of the limit.

        Args:
            features: of its frames, at least one.
        """
        along = (features - self.mean) @ self.directions.T / self.deviation
        return float(np.median(np.sqrt((along**2).mean(axis=1))) / self.limit)

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "mean": self.mean.tolist(),
            "directions": self.directions.tolist(),
            "deviation": self.deviation.tolist(),
            "limit": self.limit,
        }

    @classmethod
    def from_dict(cls, values: dict[str, object]) -> Domain:
        """Read what `as_dict` gave.

        Raises:
            KeyError: when a part is missing.
            ShapeError: when the parts do not fit each other.
        """
        parts = [np.asarray(values[name], dtype=np.float64) for name in ("mean", "directions", "deviation")]
        return cls(parts[0], parts[1], parts[2], float(str(values["limit"])))
