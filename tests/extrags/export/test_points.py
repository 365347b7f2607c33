"""Centres of Gaussians as a point cloud, read by trimesh and Open3D."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import torch
import trimesh

from extrags.errors import CaptureError, NonFiniteError
from extrags.export import write_points
from extrags.gaussians import SH_C0
from extrags.splat_files import bake_light
from tests.extrags.lit_tube import RADIUS_MM, Tube


def test_positions_colours_and_normals(tube: Tube, tmp_path: Path) -> None:
    baked = bake_light(tube.scene)
    count = write_points(baked, tmp_path / "a.ply")
    cloud = trimesh.load(tmp_path / "a.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    assert len(cloud.vertices) == count == len(baked)
    np.testing.assert_allclose(cloud.vertices, baked.means.numpy(), atol=1e-6)
    expected = (0.5 + SH_C0 * baked.sh0[:, 0].numpy()).clip(0, 1)
    np.testing.assert_allclose(cloud.colors[:, :3] / 255, expected, atol=0.5 / 255 + 1e-6)
    other = o3d.io.read_point_cloud(str(tmp_path / "a.ply"))
    normals, points = np.asarray(other.normals), np.asarray(other.points)
    # Those of the tube's wall, of either sign.
    across = np.abs((normals[:, :2] * points[:, :2]).sum(axis=1)) / RADIUS_MM
    assert float(across.min()) > 0.999


def test_faint_gaussians_are_left_out(tube: Tube, tmp_path: Path) -> None:
    gaussians = bake_light(tube.scene)
    gaussians.opacities[:100] = torch.logit(torch.tensor(0.3))
    assert write_points(gaussians, tmp_path / "a.ply") == len(gaussians) - 100
    assert write_points(gaussians, tmp_path / "a.ply", min_opacity=0.2) == len(gaussians)
    with pytest.raises(CaptureError, match=r"opacity of 0\.99"):
        write_points(gaussians, tmp_path / "a.ply", min_opacity=0.99)


def test_gaussians_elsewhere(tube: Tube, elsewhere: torch.device, tmp_path: Path) -> None:
    baked = bake_light(tube.scene)
    write_points(baked, tmp_path / "a.ply")
    write_points(baked.to(elsewhere), tmp_path / "b.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_what_is_no_number_is_refused(tube: Tube, tmp_path: Path) -> None:
    gaussians = bake_light(tube.scene)
    gaussians.means[:3] = torch.nan
    with pytest.raises(NonFiniteError, match=f"means of 3 of {len(gaussians)} Gaussians hold NaN"):
        write_points(gaussians, tmp_path / "a.ply")
    assert not (tmp_path / "a.ply").exists()
