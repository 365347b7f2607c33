from __future__ import annotations

import numpy as np
import pytest
import torch

from extrags.cameras import Cameras, pixel_rays
from extrags.restoration import surface_texture
from extrags.restoration.surface_texture import DARKNESS, MOST_DETAIL, SurfaceTexture, _hashed
from extrags.view_synthesis.references import LightTransfer, ReferenceViews

WIDTH, HEIGHT, FOCAL_PX, DEPTH_MM = 120, 96, 100.0, 50.0
PIXEL_MM = DEPTH_MM / FOCAL_PX


def facing_plane(*shifts_mm: tuple[float, float]) -> Cameras:
    """Cameras that look straight at a plane at `DEPTH_MM`."""
    poses = np.tile(np.eye(4), (len(shifts_mm), 1, 1))
    poses[:, :2, 3] = shifts_mm
    K = np.array([[FOCAL_PX, 0, WIDTH / 2], [0, FOCAL_PX, HEIGHT / 2], [0, 0, 1]])
    return Cameras(np.tile(K, (len(poses), 1, 1)), poses, WIDTH, HEIGHT)


def plane_references(cameras: Cameras, *, contrast: float = 0.2, known: bool = True) -> ReferenceViews:
    """A plane with stripes 3 mm wide, of a known relative contrast."""
    points = cameras.centers[:, None, None] + DEPTH_MM * pixel_rays(cameras)
    bright = 0.5 * (1 + contrast * np.sin(2 * np.pi * points[..., :1] / 3.0))
    flat = np.ones_like(bright)
    packed = np.concatenate([bright, bright, bright, flat, flat / DEPTH_MM, flat * known], axis=-1)
    return ReferenceViews(
        np.arange(len(cameras)),
        cameras,
        torch.from_numpy(packed.astype(np.float32)).permute(0, 3, 1, 2).contiguous(),
        torch.ones(len(cameras)),
        torch.zeros(len(cameras), 0, dtype=torch.bool),
        LightTransfer(None, 0.0, DEPTH_MM),
    )


@pytest.fixture(scope="module")
def noise() -> SurfaceTexture:
    generator = torch.Generator().manual_seed(3)
    tiles = torch.randn(40, 3, 32, 32, generator=generator) * 0.1
    return SurfaceTexture(tiles - tiles.mean(dim=(2, 3), keepdim=True), PIXEL_MM)


def test_any_seed_places_texture() -> None:
    cells = torch.arange(12).reshape(6, 2)
    assert torch.equal(_hashed(cells, 0, 5), _hashed(cells, 0, 5))
    assert not torch.equal(_hashed(cells, 0, 5), _hashed(cells, 0, 2**40 + 6))


def detail(texture: SurfaceTexture, camera: Cameras) -> torch.Tensor:
    depth = torch.full((HEIGHT, WIDTH), DEPTH_MM)
    return texture.detail(camera, depth, torch.ones(HEIGHT, WIDTH, dtype=torch.bool))


class TestTiles:
    def test_they_hold_the_relative_contrast_of_the_frames(self) -> None:
        texture = SurfaceTexture.of_references(plane_references(facing_plane((0, 0), (7, 3))))
        assert texture is not None
        assert texture.texel_mm == pytest.approx(PIXEL_MM, rel=1e-3)
        torch.testing.assert_close(texture.tiles.mean(dim=(2, 3)), torch.zeros(len(texture.tiles), 3))
        # A sine of relative amplitude 0.2, less what brightness gains by DARKNESS and a texel averages away.
        averaged = np.sinc(PIXEL_MM / 3.0)
        expected = 0.2 * 0.5 / (0.5 + DARKNESS) * averaged / np.sqrt(2)
        assert float(texture.tiles.std()) == pytest.approx(expected, rel=0.1)
        assert float(texture.tiles.abs().max()) <= 2 * MOST_DETAIL

    def test_the_edge_of_what_is_seen_is_no_detail(self) -> None:
        texture = SurfaceTexture.of_references(plane_references(facing_plane((0, 0)), contrast=0.0))
        assert texture is not None
        assert float(texture.tiles.abs().max()) < 1e-4

    def test_what_is_not_trusted_does_not_set_their_scale(self) -> None:
        references = plane_references(facing_plane((0, 0), (7, 3)))
        references.packed[1, 3] = 0
        references.packed[1, 4] *= 2
        texture = SurfaceTexture.of_references(references)
        assert texture is not None
        assert texture.texel_mm == pytest.approx(PIXEL_MM, rel=1e-3)

    def test_they_show_one_surface(self) -> None:
        references = plane_references(facing_plane((0, 0)))
        for left in range(0, WIDTH, 24):
            references.packed[..., left : left + 4] *= torch.tensor([1, 1, 1, 1, 2, 1])[None, :, None, None]
        assert SurfaceTexture.of_references(references) is None

    def test_there_is_none_where_no_depth_is_known(self) -> None:
        assert SurfaceTexture.of_references(plane_references(facing_plane((0, 0)), known=False)) is None

    def test_there_is_none_in_the_dark(self) -> None:
        references = plane_references(facing_plane((0, 0)))
        references.packed[:, :3] *= 0.05
        assert SurfaceTexture.of_references(references) is None

    def test_no_more_are_cut_than_are_kept(self, monkeypatch: pytest.MonkeyPatch) -> None:
        references = plane_references(facing_plane((0, 0), (7, 3)))
        every = SurfaceTexture.of_references(references)
        assert every is not None
        assert len(every.tiles) < surface_texture.MOST_TILES
        cut = 0
        original = surface_texture._detail_of

        def counted(rgb: torch.Tensor, solid: torch.Tensor) -> torch.Tensor:
            nonlocal cut
            cut += len(rgb)
            return original(rgb, solid)

        monkeypatch.setattr(surface_texture, "_detail_of", counted)
        monkeypatch.setattr(surface_texture, "MOST_TILES", 7)
        few = SurfaceTexture.of_references(references)
        assert few is not None
        assert cut == len(few.tiles) == 7
        chosen = np.linspace(0, len(every.tiles) - 1, 7).round().astype(np.int64)
        assert torch.equal(few.tiles, every.tiles[chosen])

    def test_views_are_not_copied_for_each_tile(self, monkeypatch: pytest.MonkeyPatch) -> None:
        sampled = surface_texture.functional.grid_sample

        def shared(image: torch.Tensor, grid: torch.Tensor, **rest: object) -> torch.Tensor:
            assert image.untyped_storage().nbytes() == 2 * 5 * WIDTH * HEIGHT * 4
            return sampled(image, grid, **rest)

        monkeypatch.setattr(surface_texture.functional, "grid_sample", shared)
        assert SurfaceTexture.of_references(plane_references(facing_plane((0, 0), (7, 3)))) is not None


class TestDetail:
    def test_all_views_show_the_same_texture_at_the_same_place(self, noise: SurfaceTexture) -> None:
        first = detail(noise, facing_plane((0, 0)))
        second = detail(noise, facing_plane((10 * PIXEL_MM, 4 * PIXEL_MM)))
        torch.testing.assert_close(second[:, :-4, :-10], first[:, 4:, 10:], rtol=0, atol=2e-4)

    def test_overlapping_tiles_keep_their_variance(self, noise: SurfaceTexture) -> None:
        shifts = [(float(x), 0.0) for x in range(0, 400, 57)]
        laid = torch.stack([detail(noise, facing_plane(shift)) for shift in shifts])
        # Pixels lie on texels here: nothing is averaged.
        assert float(laid.std() / noise.tiles.std()) == pytest.approx(1, abs=0.03)
        assert abs(float(laid.mean())) < 0.02

    @pytest.mark.parametrize("axis", range(3))
    def test_a_wall_shows_it_along_both_of_its_directions(self, noise: SurfaceTexture, axis: int) -> None:
        normals = torch.eye(3)[[axis] * 200]
        for along in range(3):
            points = torch.eye(3)[[along] * 200] * torch.arange(200.0)[:, None] * PIXEL_MM
            varies = float(noise._at(points, normals, torch.ones(200)).std(dim=0).min()) > 0.03
            assert varies == (along != axis)

    def test_between_two_planes_it_keeps_its_variance(self, noise: SurfaceTexture) -> None:
        points = 400 * torch.rand(20000, 3, generator=torch.Generator().manual_seed(1))
        along, between = (
            noise._at(points, torch.tensor(normal).expand(20000, 3), torch.ones(20000)).std()
            for normal in ((1.0, 0.0, 0.0), (0.5**0.5, 0.5**0.5, 0.0))
        )
        assert float(between / along) == pytest.approx(1, abs=0.05)

    def test_another_seed_lays_other_tiles(self, noise: SurfaceTexture) -> None:
        other = SurfaceTexture(noise.tiles, noise.texel_mm, seed=1)
        first, second = (detail(texture, facing_plane((0, 0))).flatten() for texture in (noise, other))
        assert abs(float(torch.corrcoef(torch.stack([first, second]))[0, 1])) < 0.1

    def test_far_walls_show_less_of_what_is_finer_than_a_pixel(self, noise: SurfaceTexture) -> None:
        camera, wanted = facing_plane((0, 0)), torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
        far = noise.detail(camera, torch.full((HEIGHT, WIDTH), 4 * DEPTH_MM), wanted)
        assert float(far.std()) < 0.4 * float(detail(noise, camera).std())

    def test_only_what_is_invented_changes(self, noise: SurfaceTexture) -> None:
        rgb = torch.full((1, 3, HEIGHT, WIDTH), 0.5)
        unconfirmed = torch.zeros(1, HEIGHT, WIDTH)
        unconfirmed[:, :, WIDTH // 2 :] = 1
        depth = torch.full((1, HEIGHT, WIDTH), DEPTH_MM)
        textured = noise.applied(rgb, facing_plane((0, 0)), depth, unconfirmed)
        assert torch.equal(textured[..., : WIDTH // 2], rgb[..., : WIDTH // 2])
        assert float(textured[..., WIDTH // 2 :].std()) > 0.01
        assert float(textured.min()) >= 0
        assert float(textured.max()) <= 1
