"""Where a lens can be in a cavity, and ways from place to place that keep away from the wall."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from data_catalog.cavities.surface import Lattice
from data_catalog.ray_casting import RayCaster
from extrags.errors import CaptureError

__all__ = ["FreeSpace"]

_MOST_NODES = 30_000
_NARROWEST_MM, _WIDEST_MM = 1.6, 5.0


@dataclass(frozen=True)
class FreeSpace:
    """The largest connected part of a cavity whose places are clear of the wall.

    Args:
        lattice: of the cavity.
        rays: its wall.
        margin_mm: what a lens keeps from the wall.
        places: nodes of a coarser lattice where that is so, in mm, [N, 3].
        clearance_mm: distance to the wall there, [N].
        edges: pairs of neighbouring places, [E, 2].
    """

    lattice: Lattice
    rays: RayCaster
    margin_mm: float
    places: Float[np.ndarray, "n 3"]
    clearance_mm: Float[np.ndarray, "n"]
    edges: Int[np.ndarray, "e 2"]

    @classmethod
    def of(cls, lattice: Lattice, rays: RayCaster) -> FreeSpace:
        """Look for it.

        Raises:
            CaptureError: when there is hardly any.
        """
        from scipy.ndimage import label

        stride = max(1, round((np.count_nonzero(lattice.values > 0) / _MOST_NODES) ** (1 / 3)))
        values = lattice.values[::stride, ::stride, ::stride]
        index = np.argwhere(values > 0)
        distance = np.zeros(values.shape, dtype=np.float32)
        distance[tuple(index.T)] = rays.clearance_mm(lattice.positions(index * stride))
        widest = float(np.quantile(distance[distance > 0], 0.98)) if len(index) else 0.0
        margin = float(np.clip(0.4 * widest, _NARROWEST_MM, _WIDEST_MM))
        parts, count = label(distance > margin)
        if count == 0:
            raise CaptureError("the cavity has no room for a lens")
        sizes = np.bincount(parts.ravel(), distance.ravel() ** 0.5 * (parts.ravel() > 0))
        kept = parts == int(np.argmax(sizes))
        number = np.full(values.shape, -1, dtype=np.int64)
        places = np.argwhere(kept)
        if len(places) < 8:
            raise CaptureError("the cavity has no room for a lens")
        number[kept] = np.arange(len(places))
        edges = []
        for step in _STEPS:
            beside = places + step
            inside = ((beside >= 0) & (beside < values.shape)).all(axis=1)
            there = np.full(len(places), -1, dtype=np.int64)
            there[inside] = number[tuple(beside[inside].T)]
            joined = there >= 0
            edges.append(np.stack([np.flatnonzero(joined), there[joined]], axis=1))
        return cls(
            lattice,
            rays,
            margin,
            lattice.positions(places * stride).astype(np.float64),
            distance[kept].astype(np.float64),
            np.concatenate(edges),
        )

    def clear(self, points: Float[np.ndarray, "n 3"], margin_mm: float | None = None) -> np.ndarray:
        """Which points are on the free side of the wall and at least the margin away from it."""
        margin = self.margin_mm if margin_mm is None else margin_mm
        return np.asarray((self.lattice.at(points) > 0) & (self.rays.clearance_mm(points) >= margin))

    def way(self, rng: np.random.Generator, *, stops: int) -> Float[np.ndarray, "k 3"]:
        """A smooth way through the cavity, its points a millimetre apart.

        Args:
            rng: draws where it goes.
            stops: 2 goes from one end to the other; more visits places in between, drawn.
        """
        from scipy.ndimage import gaussian_filter1d
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import dijkstra

        count = len(self.places)
        first, second = self.edges.T
        length = np.linalg.norm(self.places[first] - self.places[second], axis=1)
        room = np.minimum(self.clearance_mm[first], self.clearance_mm[second])
        cost = length * (float(self.clearance_mm.max()) / room) ** 2
        graph = coo_matrix((cost, (first, second)), shape=(count, count)).tocsr()
        visited = [int(rng.integers(count))]
        if stops == 2:
            far = dijkstra(graph, directed=False, indices=visited[0])
            visited = [int(np.argmax(np.where(np.isfinite(far), far, -1)))]
            far = dijkstra(graph, directed=False, indices=visited[0])
            visited.append(int(np.argmax(np.where(np.isfinite(far), far, -1))))
            if rng.random() < 0.5:
                visited.reverse()
        else:
            weight = np.minimum(self.clearance_mm, 3 * self.margin_mm)
            visited += [int(k) for k in rng.choice(count, stops - 1, p=weight / weight.sum())]
        line: list[np.ndarray] = []
        for start, end in pairwise(visited):
            _, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
            chain = [end]
            while chain[-1] != start and before[chain[-1]] >= 0:
                chain.append(int(before[chain[-1]]))
            line.append(self.places[chain[::-1]])
        points = _evenly(np.concatenate(line), 1.0)
        for _ in range(3):
            smooth = gaussian_filter1d(points, 6.0, axis=0, mode="nearest")
            kept = self.clear(smooth)
            # Where a smoothed corner comes too near to the wall, it is smoothed less.
            share = gaussian_filter1d(kept.astype(np.float64), 3.0, mode="nearest")[:, None] * kept[:, None]
            points = share * smooth + (1 - share) * points
        return np.asarray(points[self.clear(points, 0.8 * self.margin_mm)])


def _evenly(points: Float[np.ndarray, "n 3"], step_mm: float) -> Float[np.ndarray, "k 3"]:
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.arange(0, max(length[-1], 2 * step_mm), step_mm)
    return np.stack([np.interp(at, length, points[:, axis]) for axis in range(3)], axis=1)


_STEPS = tuple(
    np.array([a, b, c]) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1) if (a, b, c) > (0, 0, 0)
)
