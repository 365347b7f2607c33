"""Walls, growths, materials and tiles of cavities."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data_catalog.cavities import skin
from data_catalog.cavities.canvas import TEXEL_MM, Canvas
from data_catalog.cavities.growths import TISSUES, Growth, stamp, tissue_shares
from data_catalog.cavities.materials import MATERIALS, paint
from data_catalog.cavities.noise import SolidNoise, stream, tile_noise
from data_catalog.cavities.palettes import draw_palette
from data_catalog.cavities.scene import Cavity
from data_catalog.cavities.shapes import KINDS, Kind, make_shape
from data_catalog.cavities.surface import Lattice, contour
from data_catalog.cavities.tiles import Tile, lay
from extrags.errors import CaptureError


def ball(radius_mm: float = 10.0) -> Lattice:
    def clearance(points):
        return (radius_mm - np.sqrt(np.square(points).sum(axis=1))).astype(np.float32)

    corner = np.full(3, radius_mm + 3)
    return Lattice.of(clearance, -corner, corner, 40_000)


class TestWall:
    def test_a_ball_is_contoured_where_it_is_and_its_normals_point_inwards(self) -> None:
        wall = contour(ball())
        radius = np.linalg.norm(wall.vertices, axis=1)
        assert np.abs(radius - 10).max() < 0.1
        inward = -wall.vertices / radius[:, None]
        assert (wall.normals * inward).sum(axis=1).min() > 0.99
        corner = wall.vertices[wall.triangles]
        facing = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        assert ((facing * wall.normals[wall.triangles[:, 0]]).sum(axis=1) >= -1e-6).all()

    def test_without_a_wall_there_is_an_error(self) -> None:
        lattice = ball()
        with pytest.raises(CaptureError, match="there is no wall"):
            contour(Lattice(lattice.low_mm, lattice.step_mm, np.ones_like(lattice.values)))

    @pytest.mark.parametrize("kind", KINDS)
    def test_every_kind_is_closed_and_has_room(self, kind: Kind) -> None:
        shape = make_shape(kind, stream(3, "shape"))
        lattice = Lattice.of(shape.clearance, shape.low_mm, shape.high_mm, 20_000)
        assert lattice.values.max() > 2
        for axis in range(3):
            assert (lattice.values.take([0, -1], axis=axis) < 0).all()

    def test_kinds_differ(self) -> None:
        points = np.random.default_rng(0).uniform(-8, 8, (50, 3)).astype(np.float32)
        values = [make_shape(kind, stream(3, "shape")).clearance(points) for kind in KINDS]
        for one in range(len(KINDS)):
            for other in range(one):
                assert np.abs(values[one] - values[other]).max() > 0.5

    def test_solids_that_float_are_taken_away(self) -> None:
        lattice = ball()
        floating = stamp(lattice, [Growth("lump", np.zeros((1, 3)), 3.0, 0.5)])
        assert floating.at(np.zeros((1, 3)))[0] < 0
        assert floating.without_islands().at(np.zeros((1, 3)))[0] > 0
        assert (floating.without_islands().at(np.array([[12.0, 0, 0]])) < 0).all()


class TestGrowths:
    def test_a_polyp_stands_in_the_way_and_a_hollow_gives_room(self) -> None:
        lattice = ball()
        polyp = Growth("lump", np.array([[9.0, 0, 0]]), 3.0, 0.5)
        hollow = Growth("hollow", np.array([[-9.0, 0, 0]]), 3.0, 0.5)
        grown = stamp(lattice, [polyp, hollow])
        inside, behind = np.array([[7.0, 0, 0]]), np.array([[-10.8, 0, 0]])
        assert lattice.at(inside)[0] > 0 > grown.at(inside)[0]
        assert lattice.at(behind)[0] < 0 < grown.at(behind)[0]
        elsewhere = np.array([[0.0, 8, 0], [0, 0, -11]])
        np.testing.assert_array_equal(grown.at(elsewhere), lattice.at(elsewhere))

    def test_tissue_belongs_to_its_growth_alone(self) -> None:
        rod = Growth("metal", np.array([[0.0, 0, 0], [10, 0, 0]]), 1.0, 0.2)
        shares = tissue_shares(np.array([[5.0, 1, 0], [5, 3, 0], [-4, 0, 0]], dtype=np.float32), [rod], 0.5)
        assert shares[:, TISSUES.index("metal")].tolist() == [1, 0, 0]
        assert not shares[:, TISSUES.index("fat")].any()


class TestPaint:
    @pytest.mark.parametrize("material", MATERIALS)
    def test_materials_are_reflectances_that_tile(self, material: str) -> None:
        rng = stream(2, "paint")
        painted = paint(material, draw_palette("colon", rng), rng, 64)
        assert painted.shape == (64, 64, 6)
        assert np.isfinite(painted).all()
        assert painted[..., :3].min() > 0
        assert painted[..., :3].max() < 1
        # Across the edge it changes no more than anywhere else.
        inner = np.abs(np.diff(painted[..., :3], axis=0)).mean()
        assert np.abs(painted[0, :, :3] - painted[-1, :, :3]).mean() < 4 * inner + 1e-3

    def test_noise_has_unit_variance_and_its_own_scale(self) -> None:
        rng = np.random.default_rng(1)
        coarse, fine = (tile_noise(rng, 256, cells) for cells in (8, 64))
        assert coarse.std() == pytest.approx(1, abs=0.05)
        assert np.abs(np.diff(fine, axis=1)).mean() > 4 * np.abs(np.diff(coarse, axis=1)).mean()
        points = rng.uniform(-500, 500, (20_000, 3)).astype(np.float32)
        assert SolidNoise.random(rng, 40.0, 10.0)(points).std() == pytest.approx(1, abs=0.1)

    def test_what_is_finer_than_a_pixel_is_averaged_away(self) -> None:
        rng = np.random.default_rng(2)
        tile = Tile.of(
            Canvas(rng, 128).packed(rng.uniform(0.1, 0.9, (128, 128, 3)), *np.zeros((2, 128, 128))), TEXEL_MM
        )
        u, v = rng.uniform(0, 30, (2, 4000)).astype(np.float32)
        spread = [tile.sample(u, v, np.full(4000, size * TEXEL_MM))[:, 0].std() for size in (0.5, 4.0, 16.0)]
        assert spread[0] > 2.5 * spread[1] > 6 * spread[2]

    def test_relief_that_is_lost_to_the_pixel_becomes_slope_variance(self) -> None:
        rng = np.random.default_rng(3)
        canvas = Canvas(rng, 128)
        height = canvas.noise(0.3)
        tile = Tile.of(
            canvas.packed(np.full((128, 128, 3), 0.5), np.ones((128, 128)), height, slope=0.2), TEXEL_MM
        )
        points = rng.uniform(-20, 20, (2000, 3)).astype(np.float32)
        normals = np.tile(np.array([0, 0, 1], np.float32), (2000, 1))
        for size, share in ((0.02, 0.0), (2.0, 1.0)):
            values, gradient = lay(
                tile, points, normals, np.full(2000, size, np.float32), np.eye(3, dtype=np.float32)
            )
            lost = (values[:, 6] - np.square(gradient).sum(axis=1)).mean()
            assert lost == pytest.approx(share * 0.04, abs=0.012)


@pytest.mark.parametrize("narrow_band", [False, True])
def test_photographed_tissue_is_seen_in_the_light_of_the_scene(
    narrow_band: bool, colon: Cavity, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = draw_palette("colon", stream(1, "skin"))
    monkeypatch.setattr(skin, "draw_palette", lambda kind, rng: replace(drawn, narrow_band=narrow_band))
    photograph = np.random.default_rng(0).uniform(0.1, 0.9, (64, 64, 6)).astype(np.float32)
    made = skin.make_skin("colon", colon.wall, [], 1.0, stream(1, "skin"), 18.0, photograph)
    ground = made.layers[0].tile.stacked[0][1:65, 1:65]
    np.testing.assert_array_equal(ground[..., 3], photograph[..., 3])
    shown, (red, green, blue) = ground[..., :3], photograph[20, 30, :3].tolist()
    assert np.array_equal(shown, photograph[..., :3]) is not narrow_band
    seen = replace(drawn, narrow_band=narrow_band).seen((red, green, blue))
    np.testing.assert_allclose(shown[20, 30], seen, rtol=1e-6)


def test_a_cavity_is_the_same_each_time(colon: Cavity) -> None:
    from data_catalog.cavities.scene import build_cavity
    from tests.data_catalog.cavities.conftest import NODES

    again = build_cavity(0, "colon", nodes=NODES)
    np.testing.assert_array_equal(again.wall.vertices, colon.wall.vertices)
    np.testing.assert_array_equal(again.skin.at_vertices, colon.skin.at_vertices)
    other = build_cavity(8, "colon", nodes=NODES)
    assert len(other.wall.vertices) != len(colon.wall.vertices)
