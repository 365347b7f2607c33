from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from plyfile import PlyData

from extrags.cameras import Cameras, look_at, pixel_rays
from extrags.config import SurfaceConfig
from extrags.errors import CaptureError, PoseError, ShapeError
from extrags.scene import Scene
from extrags.surface import Mesh, fuse_depth, fuse_surface, rendered_depth
from extrags.zarr_io import new_group, open_group, read_array, write_array

from .exploration.tube import centre_line, small_mesh, small_tube

RADIUS = 10.0


def sphere_views(n: int = 8, width: int = 72) -> tuple[Cameras, np.ndarray]:
    """Exact depth of a sphere's inside, seen from its middle in all directions."""
    K = np.array([[width / 2, 0, width / 2], [0, width / 2, width / 2], [0, 0, 1]])
    poses = [
        look_at(np.zeros(3), np.array([np.cos(a), np.sin(a), 0.3 * (-1) ** i]), np.array([0, 0, 1.0]))
        for i, a in enumerate(np.arange(n) / n * 2 * np.pi)
    ]
    cameras = Cameras(np.broadcast_to(K, (n, 3, 3)).copy(), np.stack(poses), width, width)
    rays = pixel_rays(cameras)
    return cameras, (RADIUS / np.linalg.norm(rays, axis=-1)).astype(np.float32)


def normals_and_centres(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    corners = mesh.vertices[mesh.triangles].astype(np.float64)
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), corners.mean(axis=1)


def test_depth_of_faint_pixels_is_not_fused() -> None:
    tube = small_tube()
    gaussians = tube.scene.gaussians
    faint = Scene(replace(gaussians, opacities=gaussians.opacities - 3.5), tube.scene.light)
    with torch.no_grad():
        alpha = faint.render(tube.cameras).alpha.numpy()
    config = SurfaceConfig(min_alpha=float(np.median(alpha)))
    _, depth = rendered_depth(faint, tube.cameras, config)
    assert depth.shape == alpha.shape
    assert not depth[alpha < config.min_alpha - 1e-3].any()
    assert (depth[alpha > config.min_alpha + 1e-3] > 0).mean() > 0.9


def test_nothing_is_fused_that_no_mask_shows() -> None:
    tube = small_tube()
    cameras, config = tube.cameras, SurfaceConfig()
    y, x = np.mgrid[: cameras.height, : cameras.width] + 0.5
    disc = np.hypot(y - cameras.height / 2, x - cameras.width / 2) < 0.35 * cameras.height
    masks = [disc] * len(cameras)
    _, whole = rendered_depth(tube.scene, cameras, config)
    _, depth = rendered_depth(tube.scene, cameras, config, masks=masks)
    np.testing.assert_array_equal(depth, np.where(disc, whole, 0))
    mesh = fuse_surface(tube.scene, cameras, config, masks=masks)
    pixels, _ = cameras.project(mesh.vertices.astype(np.float64))
    radius = np.hypot(pixels[..., 0] - cameras.width / 2, pixels[..., 1] - cameras.height / 2)
    # Of each vertex the view that has it nearest to its middle; a voxel or two beyond the edge.
    assert np.nanmin(radius, axis=0).max() < 0.35 * cameras.height + 4
    larger = fuse_surface(tube.scene, cameras, config)
    assert len(mesh.vertices) < 0.9 * len(larger.vertices)
    with pytest.raises(ShapeError):
        fuse_surface(tube.scene, cameras, config, masks=masks[1:])


class TestFuseDepth:
    def test_recovers_a_sphere(self):
        cameras, depth = sphere_views()
        mesh = fuse_depth(cameras, depth, SurfaceConfig())
        error = np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS)
        assert np.median(error) < 0.01 * RADIUS
        assert np.quantile(error, 0.99) < 0.03 * RADIUS

    def test_has_no_half_pixel_shift(self):
        # Opposite views see the same surface shifted to opposite sides if pixel centres are wrong.
        cameras, depth = sphere_views()
        mesh = fuse_depth(cameras, depth, SurfaceConfig())
        inner = np.abs(mesh.vertices[:, 2]) < 5
        np.testing.assert_allclose(mesh.vertices[inner].mean(axis=0), 0, atol=0.05)

    def test_triangles_face_the_camera(self):
        normals, centres = normals_and_centres(fuse_depth(*sphere_views(), SurfaceConfig()))
        assert ((normals * -centres).sum(axis=1) > 0).mean() > 0.99

    def test_small_clusters_are_removed(self):
        cameras, depth = sphere_views(1)
        # A speck hangs in the middle of the view.
        depth[0, 33:39, 33:39] = 4.0
        mesh = fuse_depth(cameras, depth, SurfaceConfig(min_cluster_triangles=200))
        assert np.linalg.norm(mesh.vertices, axis=1).min() > 8
        kept = fuse_depth(cameras, depth, SurfaceConfig(min_cluster_triangles=1))
        assert np.linalg.norm(kept.vertices, axis=1).min() < 5

    def test_far_depth_is_not_fused(self):
        cameras, depth = sphere_views()
        outlier = depth.copy()
        outlier[0, ::7, ::7] = 500.0
        mesh = fuse_depth(cameras, outlier, SurfaceConfig())
        assert np.linalg.norm(mesh.vertices, axis=1).max() < 1.1 * RADIUS

    def test_scale_does_not_matter(self):
        cameras, depth = sphere_views(4, 60)
        mesh = fuse_depth(cameras, depth, SurfaceConfig())
        bigger = fuse_depth(cameras, 128 * depth, SurfaceConfig())
        assert len(mesh.vertices) == len(bigger.vertices)
        np.testing.assert_allclose(bigger.vertices, 128 * mesh.vertices, rtol=1e-4, atol=1e-2)

    def test_no_surface_is_lost_in_other_units(self):
        """Open3D by itself leaves 8 % of it at 2^20 times the usual numbers."""
        tube = small_tube()
        cameras, depth = rendered_depth(tube.scene, tube.cameras, SurfaceConfig())
        usual = fuse_depth(cameras, depth, SurfaceConfig())
        for exponent in (-20, 20):
            factor = 2.0**exponent
            poses = cameras.world_from_camera.copy()
            poses[:, :3, 3] *= factor
            scaled = Cameras(cameras.K, poses, cameras.width, cameras.height)
            found = fuse_depth(scaled, depth * np.float32(factor), SurfaceConfig())
            np.testing.assert_array_equal(found.triangles, usual.triangles)
            np.testing.assert_allclose(found.vertices / factor, usual.vertices, rtol=1e-5, atol=1e-5)

    def test_arrays_from_zarr_work(self, tmp_path):
        cameras, depth = sphere_views(2, 32)
        with new_group(tmp_path / "views") as group:
            for name, array in (("K", cameras.K), ("poses", cameras.world_from_camera), ("depth", depth)):
                write_array(group, name, array)
        group = open_group(tmp_path / "views")
        loaded = Cameras(read_array(group, "K"), read_array(group, "poses"), 32, 32)
        mesh = fuse_depth(loaded, read_array(group, "depth"), SurfaceConfig())
        assert mesh.vertices.tobytes() == fuse_depth(cameras, depth, SurfaceConfig()).vertices.tobytes()

    def test_no_depth_at_all_is_refused(self):
        cameras, depth = sphere_views(2, 32)
        with pytest.raises(CaptureError, match="none of the 2 views sees a surface"):
            fuse_depth(cameras, 0 * depth, SurfaceConfig())

    def test_no_views_are_refused(self):
        tube = small_tube()
        with pytest.raises(CaptureError, match="no views to fuse"):
            fuse_surface(tube.scene, tube.cameras[[]])

    def test_only_specks_are_refused(self):
        cameras, depth = sphere_views(2, 32)
        with pytest.raises(CaptureError, match="min_cluster_triangles = 1000000"):
            fuse_depth(cameras, depth, SurfaceConfig(min_cluster_triangles=1_000_000))

    @pytest.mark.parametrize("value", [np.nan, np.inf])
    def test_a_camera_that_stands_nowhere_is_refused(self, value):
        tube = small_tube()
        poses = tube.cameras.world_from_camera.copy()
        poses[2, 0, 3] = value
        lost = replace(tube.cameras, world_from_camera=poses)
        depth = np.ones((len(lost), lost.height, lost.width), np.float32)
        with pytest.raises(PoseError, match="world_from_camera: view 2 of 8"):
            fuse_depth(lost, depth, SurfaceConfig())

    def test_depth_of_another_size_is_refused(self):
        cameras, depth = sphere_views(2, 32)
        with pytest.raises(ShapeError, match="depth has shape"):
            fuse_depth(cameras, depth[:, :16], SurfaceConfig())


class TestFuseSurface:
    def test_lies_on_the_wall_of_the_tube(self):
        tube, mesh = small_tube(), small_mesh()
        arc = np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0])
        wall = (arc > 0.4) & (arc < 1.7)
        # Gaussians have a thickness: the surface lies up to their radius inside the wall.
        inside = tube.distance_from_wall(mesh.vertices[wall])
        assert 0 < np.median(inside) < 4
        assert np.quantile(np.abs(inside), 0.95) < 6

    def test_faces_the_lumen(self):
        normals, centres = normals_and_centres(small_mesh())
        inward = centre_line(np.arctan2(centres[:, 1], centres[:, 0])) - centres
        assert ((normals * inward).sum(axis=1) > 0).mean() > 0.85

    def test_the_same_inputs_give_the_same_bits(self):
        tube = small_tube()
        again = fuse_surface(tube.scene, tube.cameras, SurfaceConfig(voxel_share=1 / 32))
        assert again.vertices.tobytes() == small_mesh().vertices.tobytes()
        assert again.triangles.tobytes() == small_mesh().triangles.tobytes()

    def test_large_images_are_rendered_smaller(self):
        tube = small_tube()
        large = tube.cameras[:1].resized(480, 360)
        cameras, depth = rendered_depth(tube.scene, large, SurfaceConfig(max_width=40))
        assert (cameras.width, cameras.height) == (40, 30)
        assert depth.shape == (1, 30, 40)

    def test_transparent_pixels_have_no_depth(self):
        tube = small_tube()
        faint = replace(
            tube.scene, gaussians=replace(tube.scene.gaussians, opacities=tube.scene.gaussians.opacities - 9)
        )
        _, depth = rendered_depth(faint, tube.cameras[:1], SurfaceConfig())
        assert (depth == 0).all()


class TestMesh:
    def test_round_trip_on_disk(self, tmp_path):
        mesh = small_mesh()
        mesh.save(tmp_path / "mesh")
        loaded = Mesh.load(tmp_path / "mesh")
        np.testing.assert_array_equal(loaded.vertices, mesh.vertices)
        np.testing.assert_array_equal(loaded.triangles, mesh.triangles)
        assert (loaded.vertices.dtype, loaded.triangles.dtype) == (np.float32, np.int32)

    def test_ply_opens_elsewhere(self, tmp_path):
        mesh = small_mesh()
        mesh.write_ply(tmp_path / "mesh.ply")
        read = PlyData.read(str(tmp_path / "mesh.ply"))
        np.testing.assert_array_equal(read["vertex"]["y"], mesh.vertices[:, 1])
        np.testing.assert_array_equal(np.vstack(read["face"]["vertex_indices"]), mesh.triangles)
        read.write(str(tmp_path / "again.ply"))
        assert (tmp_path / "mesh.ply").read_bytes() == (tmp_path / "again.ply").read_bytes()

        import open3d as o3d

        opened = o3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
        assert len(opened.triangles) == len(mesh.triangles)

    def test_a_triangle_without_its_vertex_is_refused(self):
        with pytest.raises(ShapeError, match="but there are 2"):
            Mesh(np.zeros((2, 3), np.float32), np.array([[0, 1, 2]], np.int32))


class TestUnusualDepth:
    def test_a_wall_of_one_depth_is_fused(self):
        K = np.array([[30.0, 0, 24], [0, 30.0, 20], [0, 0, 1]])[None]
        wall = np.full((1, 40, 48), 2.0, np.float32)
        mesh = fuse_depth(Cameras(K, np.eye(4)[None], 48, 40), wall, SurfaceConfig())
        np.testing.assert_allclose(mesh.vertices[:, 2], 2.0, atol=1e-3)

    def test_views_whose_depth_is_too_sparse_are_left_out(self):
        cameras, depth = sphere_views(3, 60)
        sparse = np.zeros_like(depth[:1])
        sparse[0, 29, 30] = depth[0, 29, 30]
        found = fuse_depth(cameras, np.concatenate([sparse, depth[1:]]), SurfaceConfig())
        expected = fuse_depth(cameras[1:], depth[1:], SurfaceConfig())
        assert len(found.vertices) == pytest.approx(len(expected.vertices), rel=0.05)
        with pytest.raises(CaptureError, match="holds no surface that could be fused"):
            fuse_depth(cameras[:1], sparse, SurfaceConfig())
