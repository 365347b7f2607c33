"""The judging family, through the catalogue."""

from __future__ import annotations

import numpy as np
import pytest

from data_catalog import describe, list_sequences, read, resolve, source_fingerprint
from data_catalog.caverns.config import CavernConfig
from data_catalog.caverns.geometry import Cavern, build_cavern
from data_catalog.caverns.recording import MIN_CLEARANCE_MM, recording_cameras
from data_catalog.caverns.texture import make_texture
from data_catalog.ray_casting import RayCaster
from data_catalog.true_surface import true_surface
from extrags.config import IngestConfig
from extrags.errors import UnknownSequenceError
from extrags.sequence import EndoscopicSequence
from tests.data_catalog.two_recordings import check_the_same_again, off_the_surface_mm

TINY = IngestConfig(width=32, max_frames=6)


@pytest.fixture(scope="module")
def sequence() -> EndoscopicSequence:
    return read("caverns/1@distanced", TINY)


@pytest.fixture(scope="module")
def cavern() -> Cavern:
    return build_cavern(1)


def test_names_are_in_the_catalogue() -> None:
    assert "caverns/0@sparse" in {descriptor.name for descriptor in list_sequences()}
    assert resolve("caverns/12").name == "caverns/12@sparse"
    assert describe("caverns/3@distanced").frames == 48
    with pytest.raises(UnknownSequenceError, match="caverns has no setting 'far'"):
        resolve("caverns/3@far")


def test_a_key_depends_on_what_is_rendered() -> None:
    plain = source_fingerprint("caverns/3@sparse")
    assert source_fingerprint("caverns/3") == plain
    for other in ("caverns/4@sparse", "caverns/3@distanced", "phantom/3@sparse"):
        assert source_fingerprint(other) != plain


def test_it_is_the_same_each_time_and_has_its_truth(sequence: EndoscopicSequence) -> None:
    check_the_same_again(sequence, TINY, (26, 32, 3))
    other = read("caverns/2@distanced", TINY)
    assert np.abs(other.rgb.astype(float) - sequence.rgb).mean() > 10


def test_depth_lies_on_the_true_surface(sequence: EndoscopicSequence, cavern: Cavern) -> None:
    truth = true_surface(sequence)
    assert truth is not None
    np.testing.assert_array_equal(truth.mesh.vertices, cavern.wall.vertices)
    rays = RayCaster(cavern.wall.vertices, cavern.wall.triangles)
    assert off_the_surface_mm(sequence, 4, rays).max() < 1e-2


@pytest.mark.parametrize("setting", ["sparse", "distanced"])
def test_no_camera_touches_the_wall(cavern: Cavern, setting: str) -> None:
    rays = RayCaster(cavern.wall.vertices, cavern.wall.triangles)
    config = CavernConfig(scene=1, setting=setting)
    for letter in ("a", "b"):
        cameras = recording_cameras(config, cavern, rays, letter, np.linspace(0, 1, 15))
        assert (cavern.lattice.at(cameras.centers) > 0).all()
        assert rays.clearance_mm(cameras.centers).min() > 0.8 * MIN_CLEARANCE_MM


def test_texture_fades_into_its_mean_far_away(cavern: Cavern) -> None:
    texture = make_texture(1, cavern.wall)
    chosen = np.random.default_rng(0).choice(len(cavern.wall.vertices), 800, replace=False)
    points, normals = cavern.wall.vertices[chosen], cavern.wall.normals[chosen]
    slow = np.zeros((800, 0), dtype=np.float32)
    near, far = (texture.at(points, normals, slow, np.full(800, size, np.float32)) for size in (0.05, 6.0))
    assert near.albedo.std(axis=0).mean() > far.albedo.std(axis=0).mean()
    assert (near.normal * normals).sum(axis=1).mean() < (far.normal * normals).sum(axis=1).mean()
