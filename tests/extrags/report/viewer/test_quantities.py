"""What is known of each Gaussian."""

from __future__ import annotations

import numpy as np
import torch

from extrags.cameras import Cameras, look_at
from extrags.gaussians import Gaussians
from extrags.report.viewer.quantities import carried_to_gaussians, scene_quantities, training_coverage
from extrags.scene import Scene

K = np.array([[40.0, 0, 16], [0, 40.0, 16], [0, 0, 1]])
UP = np.array([0.0, -1.0, 0.0])


def cameras(*places: tuple[float, float, float]) -> Cameras:
    """Cameras that look at the origin."""
    poses = np.stack([look_at(np.array(place), np.zeros(3), UP) for place in places])
    return Cameras(np.tile(K, (len(poses), 1, 1)), poses, 32, 32)


def balls(*places: tuple[float, float, float], radius: tuple[float, ...] | float = 0.3) -> Scene:
    return Scene(
        Gaussians.from_points(
            np.array(places),
            np.full((len(places), 3), 0.5),
            np.broadcast_to(radius, len(places)).astype(float),
            opacity=0.99,
        )
    )


def test_views_and_directions() -> None:
    """The second ball stands behind the first in every view, the third outside of all."""
    scene = balls((0.0, 0.0, 0.0), (0.0, 0.0, 1.5), (0.0, 30.0, 0.0), radius=(0.6, 0.1, 0.3))
    # The second and the third camera are 2 degrees apart.
    seen_by = cameras((0.0, 0.0, -5.0), (-5.0, 0.0, 0.0), (-5.0, 0.0, 0.175))
    views, directions = training_coverage(scene, seen_by)
    assert views[0] == 3
    assert directions[0] == 2
    assert views[2] == directions[2] == 0
    hidden, _ = training_coverage(scene, seen_by[0])
    assert hidden.tolist() == [1, 0, 0]


def test_beyond_the_edge_of_the_picture_nothing_was_seen() -> None:
    scene = balls((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    view = cameras((0.0, 0.0, -5.0))
    left = int(scene.render(view).means2d[0, :, 0].argmin())
    mask = np.zeros((32, 32), dtype=bool)
    mask[:, :16] = True
    found = scene_quantities(scene, view, masks=[mask])["observed"].values
    assert found[left] == 1
    assert found[1 - left] == 0


def test_images_are_carried_by_blending_weight() -> None:
    scene = balls((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (30.0, 0.0, 0.0))
    view = cameras((0.0, 0.0, -5.0))
    columns = scene.render(view).means2d[0, :2, 0].argsort()
    maps = np.zeros((1, 32, 32, 2))
    maps[:, :, :16, 0] = 0.25
    maps[..., 1] = 0.5
    found = carried_to_gaussians(scene, view, maps)
    assert np.allclose(found[columns, 0], [0.25, 0.0], atol=0.01)
    assert np.allclose(found[:2, 1], 0.5)
    assert np.isnan(found[2]).all()


def test_only_what_the_run_has() -> None:
    scene, view = balls((0.0, 0.0, 0.0)), cameras((0.0, 0.0, -5.0))
    assert set(scene_quantities(scene, view)) == {"observed", "directions"}
    error = np.full((1, 32, 32), 0.2)
    found = scene_quantities(scene, view, view, None, error)
    assert set(found) == {"observed", "directions", "expected_error"}
    assert np.allclose(found["expected_error"].values, 0.2)
    assert found["observed"].values.tolist() == [1.0]


def test_the_light_does_not_matter(scene: Scene, virtual_cameras: Cameras) -> None:
    """Weights are those of opacities alone."""
    with torch.no_grad():
        lit, _ = training_coverage(scene, virtual_cameras[:4])
        unlit, _ = training_coverage(Scene(scene.gaussians), virtual_cameras[:4])
    assert (lit == unlit).all()
    assert lit.max() > 1
