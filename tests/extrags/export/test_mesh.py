"""Coloured meshes: read by trimesh, and pictures of them beside those of the scene they came from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import torch
import trimesh
from plyfile import PlyData

from extrags.cameras import Cameras, pixel_rays
from extrags.config import SurfaceConfig
from extrags.errors import CaptureError, ConfigError
from extrags.export import ColoredMesh, colored_mesh, write_mesh
from extrags.radial_lens import RadialLens
from extrags.scene import Scene
from extrags.splat_files import bake_recorded_light
from extrags.surface import Mesh, fuse_surface
from tests.extrags.lit_tube import Tube, tube_cameras

LEAST_DB = 24.0
"""Agreement of a mesh's picture with the scene's: fused geometry rounds off what Gaussians show sharply."""


@pytest.fixture(scope="module")
def baked(tube: Tube) -> Scene:
    return Scene(bake_recorded_light(tube.scene, tube.sequence.training_cameras))


@pytest.fixture(scope="module")
def surface(tube: Tube) -> Mesh:
    return fuse_surface(tube.scene, tube.sequence.training_cameras, SurfaceConfig(voxel_share=0.02))


@pytest.fixture(scope="module")
def colored(tube: Tube, baked: Scene, surface: Mesh) -> ColoredMesh:
    return colored_mesh(surface, baked, tube.sequence.training_cameras)


def rendered(mesh: trimesh.Trimesh, camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """A picture of a mesh as trimesh understands it, by casting a ray per pixel, and where it is hit."""
    caster = o3d.t.geometry.RaycastingScene()
    caster.add_triangles(
        o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32))
    )
    directions = pixel_rays(camera)[0].reshape(-1, 3)
    origins = np.broadcast_to(camera.centers[0], directions.shape)
    rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
    found = caster.cast_rays(o3d.core.Tensor(rays))
    hit = np.isfinite(found["t_hit"].numpy())
    face = found["primitive_ids"].numpy()[hit].astype(np.int64)
    second, third = found["primitive_uvs"].numpy()[hit].T
    shares = np.stack([1 - second - third, second, third], axis=1)
    picture = np.zeros((camera.height * camera.width, 3))
    if isinstance(mesh.visual, trimesh.visual.TextureVisuals):
        uv = np.einsum("nk,nkc->nc", shares, mesh.visual.uv[mesh.faces[face]])
        material = mesh.visual.material
        image = getattr(material, "baseColorTexture", None) or material.image
        picture[hit] = trimesh.visual.color.uv_to_interpolated_color(uv, image)[:, :3] / 255
    else:
        colors = mesh.visual.vertex_colors[:, :3].astype(np.float64) / 255
        picture[hit] = np.einsum("nk,nkc->nc", shares, colors[mesh.faces[face]])
    return picture.reshape(camera.height, camera.width, 3), hit.reshape(camera.height, camera.width)


def shown(mesh: Mesh, cameras: Cameras) -> np.ndarray:
    """Which vertices lie in any of the pictures, hidden or not."""
    pixels, depth = cameras.project(mesh.vertices.astype(np.float64))
    return np.asarray((cameras.contains(pixels) & (depth > 0)).any(axis=0))


def agreement(mesh: trimesh.Trimesh, scene: Scene, cameras: Cameras) -> float:
    """PSNR over the pixels that show the mesh, in dB."""
    errors = []
    for index in range(len(cameras)):
        picture, hit = rendered(mesh, cameras[index])
        # The rest is the far end of the tube, which fusion leaves out.
        assert hit.mean() > 0.5
        with torch.no_grad():
            expected = scene.render(cameras[index]).rgb[0].clamp(0, 1).numpy()
        errors.append(((picture - expected)[hit] ** 2).mean())
    return float(-10 * np.log10(np.mean(errors)))


class TestFiles:
    def test_glb(self, colored: ColoredMesh, baked: Scene, tube: Tube, tmp_path: Path) -> None:
        write_mesh(colored, tmp_path / "a.glb")
        scene = trimesh.load(tmp_path / "a.glb", process=False)
        mesh = scene.to_geometry()
        # Millimetres become metres, by the node.
        mesh.vertices = mesh.vertices * 1000
        assert len(mesh.faces) == len(colored.mesh.triangles)
        assert agreement(mesh, baked, tube.sequence.training_cameras[::3]) > LEAST_DB
        (geometry,) = scene.geometry.values()
        np.testing.assert_array_equal(
            geometry.vertex_attributes["_INVENTED"].reshape(-1),
            colored.invented[colored.mesh.triangles.reshape(-1)],
        )

    def test_glb_of_another_unit_is_not_scaled(self, colored: ColoredMesh, tmp_path: Path) -> None:
        write_mesh(colored, tmp_path / "a.glb", metric=False)
        mesh = trimesh.load(tmp_path / "a.glb", process=False).to_geometry()
        np.testing.assert_allclose(mesh.bounds[1], colored.mesh.vertices.max(axis=0), rtol=1e-6)

    def test_obj(self, colored: ColoredMesh, baked: Scene, tube: Tube, tmp_path: Path) -> None:
        mine = {tmp_path / "a.png": "a picture", tmp_path / "a.mtl": "a material"}
        for file, text in mine.items():
            file.write_text(text)
        written = write_mesh(colored, tmp_path / "a.obj")
        assert {file: file.read_text() for file in mine} == mine
        for file in mine:
            file.unlink()
        assert [file.name for file in written] == ["a.obj", "a_texture.mtl", "a_texture.png"]
        assert {file.name for file in tmp_path.iterdir()} == {"a.obj", "a_texture.mtl", "a_texture.png"}
        mesh = trimesh.load(tmp_path / "a.obj", process=False, force="mesh")
        assert len(mesh.faces) == len(colored.mesh.triangles)
        assert agreement(mesh, baked, tube.sequence.training_cameras[::3]) > LEAST_DB

    def test_obj_whose_name_has_a_space(self, colored: ColoredMesh, tmp_path: Path) -> None:
        """Of the names in OBJ and MTL white space is the end."""
        written = write_mesh(colored, tmp_path / "my scene.obj")
        assert set(tmp_path.iterdir()) == set(written)
        assert [file.name for file in written[1:]] == ["my_scene_texture.mtl", "my_scene_texture.png"]
        assert "mtllib my_scene_texture.mtl\n" in written[0].read_text()
        assert "map_Kd my_scene_texture.png\n" in written[1].read_text()

    def test_ply(self, colored: ColoredMesh, baked: Scene, tube: Tube, tmp_path: Path) -> None:
        write_mesh(colored, tmp_path / "a.ply")
        mesh = trimesh.load(tmp_path / "a.ply", process=False)
        assert len(mesh.faces) == len(colored.mesh.triangles)
        assert agreement(mesh, baked, tube.sequence.training_cameras[::3]) > LEAST_DB
        vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
        np.testing.assert_array_equal(vertex["invented"], colored.invented)

    def test_without_texture(self, surface: Mesh, baked: Scene, tube: Tube, tmp_path: Path) -> None:
        plain = colored_mesh(surface, baked, tube.sequence.training_cameras, texture=False)
        write_mesh(plain, tmp_path / "a.glb", metric=False)
        (mesh,) = trimesh.load(tmp_path / "a.glb", process=False).geometry.values()
        assert len(mesh.vertices) == len(surface.vertices)
        # Linear in glTF, unlike textures; beside a material trimesh keeps them as an attribute.
        linear = mesh.visual.vertex_attributes["color"][:, :3].astype(np.float64)
        linear = linear / 255 if linear.max() > 1 else linear
        encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        assert np.abs(encoded - plain.colors / 255).mean() < 0.02
        assert write_mesh(plain, tmp_path / "a.obj") == (tmp_path / "a.obj",)
        assert {file.name for file in tmp_path.iterdir()} == {"a.glb", "a.obj"}
        assert len(trimesh.load(tmp_path / "a.obj", process=False).faces) == len(surface.triangles)

    def test_another_suffix(self, colored: ColoredMesh, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match=r"a\.stl"):
            write_mesh(colored, tmp_path / "a.stl")


class TestInvented:
    def test_a_mesh_of_training_views_has_almost_nothing_invented(self, colored: ColoredMesh) -> None:
        assert float(colored.invented.mean()) < 0.01

    def test_what_virtual_views_alone_have_shown_is_invented(self, tube: Tube, baked: Scene) -> None:
        """Training views look forward from the middle of the tube, virtual ones look back."""
        train = tube_cameras(3, start_mm=25.0)
        turned = train.world_from_camera @ np.diag([-1.0, 1.0, -1.0, 1.0])
        back = Cameras(train.K, turned, train.width, train.height)
        mesh = fuse_surface(tube.scene, Cameras.concatenated([train, back]), SurfaceConfig(voxel_share=0.02))
        found = colored_mesh(mesh, baked, train, back, texture=False)
        outside = ~shown(mesh, train)
        assert outside.mean() > 0.1
        assert 0.05 < float(found.invented.mean()) < 0.95
        assert float(found.invented[outside].min()) == 1.0
        # Its colours are those of the virtual views, not black.
        assert float(found.colors[found.invented > 0].mean()) > 20

    def test_beyond_the_edge_of_the_picture_everything_is(self, tube: Tube, baked: Scene) -> None:
        train = tube_cameras(3, start_mm=25.0)
        mesh = fuse_surface(tube.scene, tube_cameras(10), SurfaceConfig(voxel_share=0.02))
        mask = np.zeros((train.height, train.width), dtype=bool)
        mask[:, : train.width // 2] = True
        whole = colored_mesh(mesh, baked, train, texture=False)
        half = colored_mesh(mesh, baked, train, masks=[mask] * 3, texture=False)
        assert (half.invented >= whole.invented).all()
        pixels, _ = train.project(mesh.vertices.astype(np.float64))
        with np.errstate(invalid="ignore"):
            left = (train.contains(pixels) & (pixels[..., 0] < train.width / 2)).any(axis=0)
        assert float(half.invented[~left].min()) == 1
        assert (half.invented[left] == whole.invented[left]).mean() > 0.9

    def test_training_views_with_a_lens(self, tube: Tube, baked: Scene) -> None:
        """Virtual views have none; what the wider views of the lens have shown is not invented."""
        lens = RadialLens((-0.05, 0.0, 0.0, 0.0), float(np.radians(70)))
        flat = tube_cameras(3, start_mm=25.0)
        train = Cameras(flat.K * [[0.5], [0.5], [1]], flat.world_from_camera, 64, 48, lens)
        virtual = tube_cameras(5, start_mm=25.0).resized(48, 36)
        mesh = fuse_surface(tube.scene, tube_cameras(10), SurfaceConfig(voxel_share=0.02))
        joined = colored_mesh(mesh, baked, train, virtual)
        assert joined.texture is not None
        alone = colored_mesh(mesh, baked, train, texture=False)
        np.testing.assert_array_equal(joined.invented, alone.invented)
        by_lens, by_pinhole = (shown(mesh, cameras) for cameras in (train, train.as_pinholes(60.0)))
        assert float(joined.invented[~by_lens].min()) == 1
        beyond = by_lens & ~by_pinhole
        assert beyond.mean() > 0.1
        assert float(joined.invented[beyond].mean()) < 0.5

    def test_groups_of_obj(self, tube: Tube, baked: Scene, tmp_path: Path) -> None:
        mesh = Mesh(
            np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype=np.float32),
            np.array([[0, 1, 2], [1, 3, 2]], dtype=np.int32),
        )
        colored = ColoredMesh(mesh, np.zeros((4, 3), np.uint8), np.array([0, 0, 0, 1], np.float32))
        write_mesh(colored, tmp_path / "a.obj")
        lines = (tmp_path / "a.obj").read_text().splitlines()
        assert lines[-4:] == ["g observed", "f 1 2 3", "g invented", "f 2 4 3"]


def test_a_mesh_that_no_view_sees(tube: Tube, baked: Scene) -> None:
    away = Mesh(
        np.array([[0, 0, -50], [1, 0, -50], [0, 1, -50]], dtype=np.float32),
        np.array([[0, 1, 2]], dtype=np.int32),
    )
    with pytest.raises(CaptureError, match="none of the 10 views"):
        colored_mesh(away, baked, tube.sequence.training_cameras)


def test_a_scene_elsewhere(
    surface: Mesh, baked: Scene, colored: ColoredMesh, tube: Tube, elsewhere: torch.device
) -> None:
    found = colored_mesh(surface, baked.to(elsewhere), tube.sequence.training_cameras, texture=False)
    np.testing.assert_array_equal(found.colors, colored.colors)
