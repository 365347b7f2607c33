"""Gaussians as planes of small integers, and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from extrags.cameras import Cameras
from extrags.errors import ShapeError, SourceError
from extrags.facing import FLAT
from extrags.gaussians import Gaussians
from extrags.raster.light import shortest_axes
from extrags.raster.rotations import rotation_matrices
from extrags.report.viewer.encoding import Quantity, decoded_scene, encoded_scene
from extrags.scene import Scene


def quantity(values: np.ndarray) -> Quantity:
    return Quantity(values, 0, 2, "what", ("none", "all"))


def nearest(gaussians: Gaussians, other: Gaussians) -> np.ndarray:
    from scipy.spatial import cKDTree

    return cKDTree(other.means.numpy()).query(gaussians.means.numpy())[1]


def test_every_parameter_comes_back(scene: Scene) -> None:
    found, _, _ = decoded_scene(encoded_scene(scene.gaussians))
    assert len(found) == len(scene.gaussians)
    true = scene.gaussians.subset(torch.from_numpy(nearest(found, scene.gaussians)))
    assert (found.means - true.means).abs().max() < 1e-3
    assert (found.scales - true.scales).abs().max() < 0.01
    assert (found.opacities.sigmoid() - true.opacities.sigmoid()).abs().max() < 1 / 400
    turn = rotation_matrices(found.quats).transpose(1, 2) @ rotation_matrices(true.quats)
    trace = turn.diagonal(dim1=1, dim2=2).sum(1)
    assert torch.rad2deg(torch.arccos(((trace - 1) / 2).clamp(-1, 1))).max() < 0.25
    assert (found.sh - true.sh).abs().max() < 0.01


def test_pictures_stay_the_same(scene: Scene, virtual_cameras: Cameras) -> None:
    found, _, _ = decoded_scene(encoded_scene(scene.gaussians))
    before = scene.render(virtual_cameras[:3]).rgb
    after = Scene(found, scene.light).render(virtual_cameras[:3]).rgb
    assert 10 * torch.log10(1 / (before - after).square().mean()) > 50


def test_size_per_gaussian(scene: Scene) -> None:
    """18 bytes without harmonics above degree 0, another 3 per term, and the ranges of the blocks."""
    for degree, terms in ((0, 1), (1, 4), (2, 9)):
        body = encoded_scene(scene.gaussians, degree=degree).body
        assert len(body) / len(scene.gaussians) < 14 + 3 * terms + (7 + 3 * terms) * 8 / 256 + 1


def test_the_order_does_not_matter(scene: Scene) -> None:
    mixed = torch.randperm(len(scene.gaussians), generator=torch.Generator().manual_seed(0))
    assert encoded_scene(scene.gaussians).body == encoded_scene(scene.gaussians.subset(mixed)).body


def test_quantities_follow_their_gaussians(scene: Scene) -> None:
    values = np.linspace(-1, 3, len(scene.gaussians))
    values[::5] = np.nan
    found, levels, _ = decoded_scene(encoded_scene(scene.gaussians, {"one": quantity(values)}))
    expected = values[nearest(found, scene.gaussians)]
    assert (levels["one"][np.isnan(expected)] == 255).all()
    known = np.isfinite(expected)
    assert np.abs(levels["one"][known] / 254 * 2 - np.clip(expected[known], 0, 2)).max() <= 1 / 254 + 1e-9


@pytest.mark.parametrize("count", [0, 1, 3, 256, 1023])
def test_sides_follow_their_gaussians(scene: Scene, count: int) -> None:
    few = scene.gaussians.subset(torch.arange(count))
    sides = torch.randint(-1, 2, (count,), generator=torch.Generator().manual_seed(1), dtype=torch.int8)
    encoded = encoded_scene(few, {"one": quantity(np.zeros(count))}, facing=sides)
    found, levels, facing = decoded_scene(encoded)
    assert facing is not None
    assert facing.dtype == torch.int8
    if count:
        assert torch.equal(facing, sides[torch.from_numpy(nearest(found, few))])
    assert (levels["one"] == 0).all()
    assert encoded.sided


def test_normals_keep_their_sign(scene: Scene) -> None:
    """The sides are of no use where rounding to 8 bits takes another axis for the shortest."""
    found, _, _ = decoded_scene(encoded_scene(scene.gaussians))
    true = scene.gaussians.subset(torch.from_numpy(nearest(found, scene.gaussians)))
    cosines = (shortest_axes(found.quats, found.scales) * shortest_axes(true.quats, true.scales)).sum(dim=1)
    ordered = true.scales.exp().sort(dim=1).values
    flat = ordered[:, 0] < FLAT * ordered[:, 1]
    assert flat.float().mean() > 0.3
    assert cosines[flat].min() > 0.99


def test_sides_take_a_quarter_of_a_byte(scene: Scene) -> None:
    count = len(scene.gaussians)
    sides = torch.randint(-1, 2, (count,), generator=torch.Generator().manual_seed(1), dtype=torch.int8)
    plain, sided = encoded_scene(scene.gaussians), encoded_scene(scene.gaussians, facing=sides)
    assert not plain.sided
    assert decoded_scene(plain)[2] is None
    assert len(sided.body) - len(plain.body) < 0.26 * count


def test_sides_of_another_number_are_refused(scene: Scene) -> None:
    with pytest.raises(ShapeError, match=r"facing has shape \(3,\)"):
        encoded_scene(scene.gaussians, facing=torch.zeros(3, dtype=torch.int8))


def test_what_no_picture_shows_is_left_out(scene: Scene) -> None:
    opacities = scene.gaussians.opacities.clone()
    opacities[:10] = -9.0
    assert encoded_scene(replace(scene.gaussians, opacities=opacities)).count == len(opacities) - 10


def test_a_rotation_of_length_zero_is_none(scene: Scene) -> None:
    one = scene.gaussians.subset(torch.arange(1))
    found, _, _ = decoded_scene(encoded_scene(replace(one, quats=torch.zeros(1, 4))))
    assert found.quats[0].tolist() == pytest.approx([1, 0, 0, 0], abs=1e-3)


@pytest.mark.parametrize("count", [0, 1, 256, 257])
def test_few_gaussians(scene: Scene, count: int) -> None:
    few = scene.gaussians.subset(torch.arange(count))
    found, _, _ = decoded_scene(encoded_scene(few))
    assert len(found) == count
    assert np.allclose(np.sort(found.means, axis=0), np.sort(few.means, axis=0), atol=1e-3)


def test_a_quantity_of_another_length_is_refused(scene: Scene) -> None:
    with pytest.raises(ShapeError, match=r"one has shape \(3,\)"):
        encoded_scene(scene.gaussians, {"one": quantity(np.zeros(3))})


def test_a_shortened_body_is_refused(scene: Scene) -> None:
    encoded = encoded_scene(scene.gaussians)
    with pytest.raises(SourceError, match="ends after"):
        decoded_scene(replace(encoded, count=encoded.count + 300))
    with pytest.raises(SourceError, match="expected"):
        decoded_scene(replace(encoded, degree=1))
