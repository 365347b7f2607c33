from __future__ import annotations

import json

import numpy as np
import pytest

from extrags.errors import ShapeError
from extrags.restoration.uncertainty.domain import Domain


def world(rng: np.random.Generator, shift: float = 0.0, scenes: int = 40) -> list[np.ndarray]:
    """Scenes of eight patches with 30 features that follow five causes."""
    mixing = np.random.default_rng(0).normal(size=(5, 30))
    found = []
    for _ in range(scenes):
        own = rng.normal(size=5)
        patches = own + 0.3 * rng.normal(size=(8, 5))
        found.append(patches @ mixing + 0.05 * rng.normal(size=(8, 30)) + shift)
    return found


@pytest.fixture(scope="module")
def domain() -> Domain:
    rng = np.random.default_rng(1)
    return Domain.fitted(np.concatenate(world(rng)), world(rng))


class TestDomain:
    def test_scenes_of_the_same_world_stay_inside(self, domain: Domain) -> None:
        scores = [domain.score(scene) for scene in world(np.random.default_rng(2), scenes=100)]
        assert np.mean(np.array(scores) > 1) < 0.15

    def test_another_world_is_outside(self, domain: Domain) -> None:
        scores = [domain.score(scene) for scene in world(np.random.default_rng(3), shift=1.0)]
        assert min(scores) > 1

    def test_the_distance_is_a_mean_over_directions(self) -> None:
        domain = Domain(np.ones(3), np.eye(3)[:2], np.array([1.0, 2.0]), 1.0)
        patches = np.array([[4.0, 9.0, 7.0], [1.0, 1.0, 1.0], [2.0, 3.0, 0.0]])
        assert domain.score(patches) == pytest.approx(1.0)
        assert domain.score(patches[:1]) == pytest.approx(np.sqrt((3**2 + 4**2) / 2))

    def test_it_goes_through_json(self, domain: Domain) -> None:
        loaded = Domain.from_dict(json.loads(json.dumps(domain.as_dict())))
        (scene,) = world(np.random.default_rng(4), scenes=1)
        assert loaded.score(scene) == pytest.approx(domain.score(scene), rel=1e-12)

    def test_parts_that_do_not_fit_are_refused(self) -> None:
        with pytest.raises(ShapeError, match="do not fit"):
            Domain(np.zeros(3), np.zeros((2, 4)), np.ones(2), 1.0)
