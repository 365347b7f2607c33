"""What a sequence in its own pixels becomes in stages that work on image planes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from extrags.cameras import Cameras, pixel_rays
from extrags.config import EnhanceConfig, PipelineConfig, SurfaceConfig
from extrags.depth import estimate
from extrags.depth.estimate import DepthEstimate
from extrags.errors import ShapeError
from extrags.evaluation import render
from extrags.gaussians import Gaussians
from extrags.radial_lens import WIDE_FIELD_DEG, RadialLens
from extrags.restoration import restored_renders as restored_renders_module
from extrags.restoration.benchmark.comparison import compare_methods
from extrags.restoration.classical import ClassicalEnhancer
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, Split
from extrags.surface import fuse_depth, rendered_depth
from extrags.view_synthesis.gather import gather_references

LENS = RadialLens((-0.209, 0.0397, 0.00787, -0.00334), float(np.radians(80)))
K = np.array([[23.0, 0, 20], [0, 23.0, 16], [0, 0, 1]])
WALL_MM = 5.0
NO_RGB = np.zeros((0, 3), np.uint8)


@pytest.fixture(scope="module")
def facing_a_wall() -> EndoscopicSequence:
    """Three frames of one camera before a plane, whose colour is its place."""
    poses = np.repeat(np.eye(4)[None], 3, axis=0)
    cameras = Cameras(np.repeat(K[None], 3, 0), poses, 40, 32, LENS)
    points = WALL_MM * pixel_rays(cameras)
    rgb = (127 + 100 * np.sin(points / 3)).astype(np.uint8)
    return EndoscopicSequence(
        name="wall",
        rgb=rgb,
        K=cameras.K,
        mask=cameras.field,
        split=Split("every2", np.array([0, 2]), np.array([1])),
        world_from_camera=poses,
        depth_mm=np.where(cameras.field, WALL_MM, 0).astype(np.float32),
        lens=LENS,
    )


@pytest.fixture(scope="module")
def wall() -> Scene:
    """The plane as Gaussians."""
    across = np.stack(np.meshgrid(np.linspace(-16, 16, 40), np.linspace(-12, 12, 30)), -1).reshape(-1, 2)
    points = np.concatenate([across, np.full((len(across), 1), WALL_MM)], axis=1)
    rgb = np.full((len(points), 3), 0.5)
    return Scene(Gaussians.from_points(points, rgb, np.full(len(points), 0.6), opacity=0.95, sh_degree=0))


def test_the_wall_is_seen_where_it_is(facing_a_wall: EndoscopicSequence, wall: Scene) -> None:
    """Rendered z-depth is that of the plane, 60 degrees from the axis as on it."""
    with torch.no_grad():
        rendering = wall.render(facing_a_wall.cameras[[0]])
    solid = (rendering.alpha[0] > 0.9).numpy()
    slope = np.linalg.norm(pixel_rays(facing_a_wall.cameras[[0]])[0][..., :2], axis=-1)
    assert (solid & (slope > np.tan(np.radians(60)))).sum() > 20
    np.testing.assert_allclose(rendering.depth[0].numpy()[solid], WALL_MM, rtol=1e-3)


def test_surfaces_are_fused_from_wide_pinholes(facing_a_wall: EndoscopicSequence, wall: Scene) -> None:
    cameras, depth = rendered_depth(wall, facing_a_wall.cameras, SurfaceConfig())
    assert cameras.lens is None
    angle_deg = 2 * np.degrees(np.arctan(20 / cameras.K[0, 0, 0]))
    assert 100 < angle_deg <= WIDE_FIELD_DEG
    np.testing.assert_allclose(depth[depth > 0], WALL_MM, rtol=1e-3)
    with pytest.raises(ShapeError, match="as_pinholes"):
        fuse_depth(facing_a_wall.cameras, depth, SurfaceConfig())


def test_references_are_pinholes(facing_a_wall: EndoscopicSequence, wall: Scene) -> None:
    with pytest.raises(ShapeError, match="as_pinhole"):
        gather_references(wall, facing_a_wall, facing_a_wall.train)
    flat = facing_a_wall.as_pinhole()
    found = gather_references(wall, flat, flat.train)
    assert found.cameras.lens is None


def test_restorers_are_compared_on_pinholes(facing_a_wall: EndoscopicSequence, wall: Scene) -> None:
    config = PipelineConfig(enhance=EnhanceConfig(references=2))
    none, classical = compare_methods(wall, facing_a_wall, config, ["none", "classical"], None)
    assert classical["views"] == 1
    # The wall's colours are known from the other frames alone.
    assert classical["psnr"] > none["psnr"] + 3


def test_estimated_depth_comes_back_to_the_pixels(
    facing_a_wall: EndoscopicSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The estimate is of wide pinholes; stood in for here by the plane itself."""
    seen: list[EndoscopicSequence] = []
    whole = estimate.estimate_depth

    def of_plane(sequence: EndoscopicSequence, *_: object, **__: object) -> DepthEstimate:
        seen.append(sequence)
        depth = np.where(sequence.mask, WALL_MM, 0).astype(np.float32)
        return DepthEstimate(
            depth, np.where(sequence.mask, 0.1, 0).astype(np.float32), np.zeros((0, 3)), NO_RGB
        )

    monkeypatch.setattr(estimate, "estimate_depth", of_plane)
    found = whole(replace(facing_a_wall, depth_mm=None))
    assert [part.lens for part in seen] == [None]
    known = found.depth > 0
    np.testing.assert_allclose(found.depth[known], WALL_MM)
    np.testing.assert_allclose(found.expected_error[known], 0.1, rtol=1e-6)
    assert not known[~facing_a_wall.mask].any()
    assert known.mean() > 0.75


def test_virtual_views_are_pinholes(facing_a_wall: EndoscopicSequence) -> None:
    cameras = facing_a_wall.training_cameras.as_pinholes()
    assert cameras.K[0, 0, 0] == pytest.approx(facing_a_wall.as_pinhole().K[0, 0, 0])
    np.testing.assert_array_equal(cameras.world_from_camera, facing_a_wall.training_cameras.world_from_camera)


def test_restored_renders_are_carried_back_and_depth_is_never_mixed(
    facing_a_wall: EndoscopicSequence, wall: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fold of the final scene, 5 and 20 mm away, stays two depths in the flat view."""
    renders = render(wall, facing_a_wall)
    folded = np.where(np.arange(40) < 17, 5.0, 20.0).astype(np.float32)
    folded = np.broadcast_to(folded, renders.depth_mm.shape) * (renders.depth_mm > 0)
    seen: list[np.ndarray] = []

    def spied(restored_mm: torch.Tensor, final_mm: torch.Tensor, _solid: torch.Tensor) -> torch.Tensor:
        seen.append(final_mm.numpy())
        return restored_mm

    monkeypatch.setattr(restored_renders_module, "_mean_depth", spied)
    restored = restored_renders_module.restored_renders(
        wall,
        replace(renders, depth_mm=folded.astype(np.float32)),
        facing_a_wall,
        facing_a_wall.training_part(),
        ClassicalEnhancer(),
        EnhanceConfig(references=2),
        finish="smooth",
    )
    assert set(np.unique(np.concatenate(seen)).tolist()) == {0.0, 5.0, 20.0}
    assert restored.rgb.shape == renders.rgb.shape
    inside = facing_a_wall.mask[facing_a_wall.split.test]
    assert np.isfinite(restored.rgb).all()
    # The photographs are colourful, the wall is grey: what restoration brings reaches the lens's own pixels.
    truth = facing_a_wall.rgb[facing_a_wall.split.test] / 255
    before, after = (np.abs(rgb - truth)[inside].mean() for rgb in (renders.rgb, restored.rgb))
    assert after < before
