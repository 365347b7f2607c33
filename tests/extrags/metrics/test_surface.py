"""Surface errors on shapes whose errors are known, against Open3D's own metrics, and what is observed."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from extrags.cameras import look_at
from extrags.errors import ConfigError, SourceError
from extrags.gaussians import Gaussians
from extrags.metrics.surface import (
    PROTOCOL_FUSION,
    TrueSurface,
    distance_to_surface,
    evaluate_surface,
    sample_surface,
    scene_surface,
    seen_by,
    surface_errors,
    surface_from_depth,
)
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, Split
from extrags.surface import Mesh

WIDTH, HEIGHT = 64, 48
WALL_MM = 20.0
TILT = 0.02


def rectangle(low: tuple[float, float], high: tuple[float, float], z: float, steps: int = 1) -> Mesh:
    """A rectangle across z, of 2 * steps^2 triangles."""
    x, y = np.meshgrid(
        np.linspace(low[0], high[0], steps + 1), np.linspace(low[1], high[1], steps + 1), indexing="ij"
    )
    vertices = np.stack([x, y, np.full_like(x, z)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(steps), np.arange(steps), indexing="ij")
    a = (i * (steps + 1) + j).ravel()
    b, c, d = a + 1, a + steps + 1, a + steps + 2
    triangles = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    return Mesh(vertices.astype(np.float32), triangles.astype(np.int32))


def sphere(radius: float, resolution: int = 60) -> Mesh:
    import open3d as o3d

    made = o3d.geometry.TriangleMesh.create_sphere(radius=radius, resolution=resolution)
    return Mesh(np.asarray(made.vertices, dtype=np.float32), np.asarray(made.triangles, dtype=np.int32))


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(
            [mesh.triangles + np.int32(start) for mesh, start in zip(meshes, starts, strict=True)]
        ),
    )


LINE = Mesh(np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], dtype=np.float32), np.array([[0, 1, 2]]))
EMPTY = Mesh(np.zeros((0, 3), dtype=np.float32), np.zeros((0, 3), dtype=np.int32))


class TestWholeSurfaces:
    @pytest.mark.parametrize("gap", [0.3, 2.0])
    def test_parallel_planes_are_their_distance_apart(self, gap: float) -> None:
        true = rectangle((0, 0), (10, 6), 5)
        errors = surface_errors(rectangle((0, 0), (10, 6), 5 + gap), true, 1.0)
        assert errors.accuracy_mm == pytest.approx(gap, abs=1e-5)
        assert errors.completeness_median_mm == pytest.approx(gap, abs=1e-5)
        assert errors.fscore == (1.0 if gap < 1 else 0.0)

    def test_half_a_plane_is_accurate_and_half_complete(self) -> None:
        true = rectangle((0, 0), (10, 6), 5)
        errors = surface_errors(rectangle((0, 0), (5, 6), 5), true, 1.0)
        assert errors.accuracy_mm == pytest.approx(0, abs=1e-6)
        assert errors.precision == 1
        # Half of it is there, and the strip of 1 mm beside it is near enough.
        assert errors.recall == pytest.approx(0.6, abs=0.01)
        # The other half lies 0 to 5 mm away.
        assert errors.completeness_mm == pytest.approx(0.5 * 2.5, abs=0.02)
        assert errors.fscore == pytest.approx(2 * 0.6 / 1.6, abs=0.01)

    def test_a_floater_spoils_accuracy_by_its_area(self) -> None:
        true = rectangle((0, 0), (10, 6), 5)
        floater = rectangle((2, 2), (4, 5), 1)
        errors = surface_errors(joined(true, floater), true, 1.0)
        share = 6 / 66
        assert errors.accuracy_mm == pytest.approx(4 * share, rel=1e-3)
        assert errors.accuracy_median_mm == pytest.approx(0, abs=1e-6)
        assert errors.precision == pytest.approx(1 - share, abs=1e-3)
        assert errors.recall == 1

    def test_concentric_spheres(self) -> None:
        errors = surface_errors(sphere(10.5), sphere(10.0), 1.0)
        assert errors.accuracy_mm == pytest.approx(0.5, abs=0.02)
        assert errors.completeness_mm == pytest.approx(0.5, abs=0.02)

    def test_agrees_with_open3d(self) -> None:
        import open3d as o3d
        from open3d.t.geometry import Metric, MetricParameters, TriangleMesh

        def tensor_mesh(mesh: Mesh) -> Any:
            return TriangleMesh(
                o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.triangles.astype(np.int64))
            )

        random = np.random.default_rng(0)
        true = sphere(10.0)
        noisy = Mesh(
            (true.vertices + random.normal(0, 0.4, true.vertices.shape)).astype(np.float32), true.triangles
        )
        parameters = MetricParameters([0.3, 0.6], 60_000)
        chamfer, narrow, wide = (
            tensor_mesh(true)
            .compute_metrics(tensor_mesh(noisy), [Metric.ChamferDistance, Metric.FScore], parameters)
            .numpy()
        )
        at_narrow, at_wide = (surface_errors(noisy, true, threshold) for threshold in (0.3, 0.6))
        assert at_narrow.accuracy_mm is not None
        assert at_narrow.completeness_mm is not None
        assert at_narrow.fscore is not None
        assert at_wide.fscore is not None
        # Open3D's Chamfer distance is the sum of both means, its F-score is in percent.
        assert at_narrow.accuracy_mm + at_narrow.completeness_mm == pytest.approx(float(chamfer), rel=0.02)
        assert 100 * at_narrow.fscore == pytest.approx(float(narrow), abs=1.0)
        assert 100 * at_wide.fscore == pytest.approx(float(wide), abs=1.0)
        assert at_narrow.fscore < 0.9 * at_wide.fscore

    @pytest.mark.parametrize("nothing", [EMPTY, LINE], ids=["no triangle", "no area"])
    def test_nothing_reconstructed(self, nothing: Mesh) -> None:
        errors = surface_errors(nothing, rectangle((0, 0), (1, 1), 0), 1.0)
        assert (errors.recall, errors.fscore) == (0.0, 0.0)
        assert errors.accuracy_mm is None
        assert errors.completeness_mm is None
        assert errors.precision is None

    @pytest.mark.parametrize("nothing", [EMPTY, LINE], ids=["no triangle", "no area"])
    def test_against_nothing_nothing_is_measured(self, nothing: Mesh) -> None:
        errors = surface_errors(rectangle((0, 0), (1, 1), 0), nothing, 1.0)
        assert set(asdict(errors).values()) == {None}

    def test_a_threshold_must_be_a_length(self) -> None:
        with pytest.raises(ConfigError, match="above zero"):
            surface_errors(EMPTY, EMPTY, 0.0)


class TestSamples:
    def test_uniform_by_area_whatever_the_triangles(self) -> None:
        # Left half: two triangles. Right half: two thousand.
        mesh = joined(rectangle((0, 0), (5, 10), 0), rectangle((5, 0), (10, 10), 0, steps=32))
        points = sample_surface(mesh, 20_000, seed=0)
        counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=5, range=[[0, 10], [0, 10]])
        expected = 20_000 / 25
        assert np.abs(counts - expected).max() < 5 * np.sqrt(expected)
        assert np.all(points[:, 2] == 0)

    def test_same_seed_same_points(self) -> None:
        mesh = sphere(3.0, 8)
        assert np.array_equal(sample_surface(mesh, 100, seed=1), sample_surface(mesh, 100, seed=1))
        assert not np.array_equal(sample_surface(mesh, 100, seed=1), sample_surface(mesh, 100, seed=2))

    def test_a_mesh_without_area_is_refused(self) -> None:
        with pytest.raises(SourceError, match="field triangles: a surface of 1 triangles without any area"):
            sample_surface(LINE, 10, seed=0)
        with pytest.raises(ConfigError, match="1 or more"):
            sample_surface(sphere(1.0, 8), 0, seed=0)

    def test_distance_is_to_triangles_not_to_vertices(self) -> None:
        distance, nearest = distance_to_surface(np.array([[5.0, 3.0, 2.0]]), rectangle((0, 0), (10, 6), 0))
        assert distance[0] == pytest.approx(2)
        np.testing.assert_allclose(nearest[0], [5, 3, 0], atol=1e-6)


def wall(low: tuple[float, float], high: tuple[float, float], behind: float = 0.0) -> Mesh:
    """A piece of the wall z = 20 + 0.02 y, or of one behind it."""
    flat = rectangle(low, high, WALL_MM + behind)
    return Mesh(flat.vertices + TILT * flat.vertices[:, 1:2] * np.float32([0, 0, 1]), flat.triangles)


@pytest.fixture(scope="module")
def sequence() -> EndoscopicSequence:
    """Two cameras before the wall: the training one sees its left, the held-out one its right."""
    up = np.array([0.0, -1.0, 0.0])
    poses = np.stack([look_at(np.array([x, 0.0, 0.0]), np.array([x, 0.0, WALL_MM]), up) for x in (-4.0, 4.0)])
    slope = (np.arange(HEIGHT, dtype=np.float32) + 0.5 - HEIGHT / 2) / 64
    depth = np.broadcast_to((WALL_MM / (1 - TILT * slope))[None, :, None], (2, HEIGHT, WIDTH))
    K = np.tile(np.array([[64.0, 0, WIDTH / 2], [0, 64.0, HEIGHT / 2], [0, 0, 1]]), (2, 1, 1))
    return EndoscopicSequence(
        name="wall/0@two",
        rgb=np.zeros((2, HEIGHT, WIDTH, 3), dtype=np.uint8),
        K=K,
        mask=np.ones((2, HEIGHT, WIDTH), dtype=bool),
        split=Split("two", np.array([0]), np.array([1])),
        world_from_camera=poses,
        depth_mm=np.array(depth, dtype=np.float32),
    )


# At 20 mm a camera sees 20 mm of the wall across: the training one x in [-14, 6], the other [-6, 14].
WALL = wall((-30, -30), (30, 30))


class TestObserved:
    def test_parts_are_what_the_cameras_see(self, sequence: EndoscopicSequence) -> None:
        result = evaluate_surface(WALL, TrueSurface(WALL, "mesh"), sequence)
        assert result.observed_share == pytest.approx(20 / 28, abs=0.02)
        assert result.coverage == 1
        assert result.observed.accuracy_mm == pytest.approx(0, abs=1e-5)
        assert result.threshold_mm == 1.0

    def test_errors_stay_in_their_part(self, sequence: EndoscopicSequence) -> None:
        left, right = wall((-30, -30), (6, 30)), wall((6, -30), (30, 30), behind=3.0)
        result = evaluate_surface(joined(left, right), TrueSurface(WALL, "mesh"), sequence)
        assert result.observed.recall == 1
        assert result.observed.accuracy_mm == pytest.approx(0, abs=0.05)
        assert result.unobserved.accuracy_mm == pytest.approx(3, abs=0.05)
        assert result.unobserved.recall == pytest.approx(1 / 8, abs=0.03)  # the strip beside the good half
        assert result.coverage == pytest.approx(21 / 28, abs=0.02)

    def test_what_nobody_sees_does_not_count(self, sequence: EndoscopicSequence) -> None:
        astray = wall((100, 100), (140, 140))
        alone = evaluate_surface(WALL, TrueSurface(WALL, "mesh"), sequence)
        more = evaluate_surface(WALL, TrueSurface(joined(WALL, astray), "mesh"), sequence)
        assert more.coverage == alone.coverage == 1
        assert more.observed_share == pytest.approx(alone.observed_share, abs=0.02)

    def test_hidden_surface_is_not_seen(self, sequence: EndoscopicSequence) -> None:
        shield = rectangle((-30, -30), (-4, 30), 10)
        cameras, mask = sequence.cameras[[0]], sequence.mask[[0]]
        points = np.array([[-9.0, 0, WALL_MM], [1.0, 0, WALL_MM], [-6.0, 0, 10]])
        hidden = joined(WALL, shield)
        assert seen_by(points, hidden, cameras, mask, np.inf).tolist() == [False, True, True]

    def test_seen_is_what_any_of_several_cameras_sees(self, sequence: EndoscopicSequence) -> None:
        """Each looks from its own place, past its own side of a shield, through its own mask."""
        shield = rectangle((-1, -30), (1, 30), 10)
        points = np.array([[-10.0, 0, WALL_MM], [10.0, 0, WALL_MM], [4.0, 0, WALL_MM], [-4.0, 0, WALL_MM]])
        hidden, mask = joined(WALL, shield), sequence.mask.copy()

        def seen(views: list[int]) -> list[bool]:
            found = seen_by(points, hidden, sequence.cameras[views], mask[views], np.inf)
            return [bool(flag) for flag in found]

        # From x = -4 the shield hides the wall from 2 to 6 mm, from x = 4 the other side.
        assert seen([0]) == [True, False, False, True]
        assert seen([1]) == [False, True, True, False]
        assert seen([0, 1]) == seen([1, 0]) == [True] * 4
        mask[1] = False
        assert seen([0, 1]) == [True, False, False, True]

    def test_masked_and_far_surface_is_not_seen(self, sequence: EndoscopicSequence) -> None:
        cameras, mask = sequence.cameras[[0]], sequence.mask[[0]].copy()
        points = np.array([[-9.0, 0, WALL_MM], [1.0, 0, WALL_MM]])
        mask[:, :, : WIDTH // 2] = False
        assert seen_by(points, WALL, cameras, mask, np.inf).tolist() == [False, True]
        assert seen_by(points, WALL, cameras, mask, WALL_MM - 1).tolist() == [False, False]

    def test_the_threshold_follows_the_scene_without_millimetres(self, sequence: EndoscopicSequence) -> None:
        arbitrary = replace(sequence, metric=False)
        assert evaluate_surface(WALL, TrueSurface(WALL, "mesh"), arbitrary).threshold_mm == pytest.approx(1.0)
        assert sequence.depth_mm is not None
        small = replace(arbitrary, depth_mm=sequence.depth_mm / 10)
        assert evaluate_surface(WALL, TrueSurface(WALL, "mesh"), small).threshold_mm == pytest.approx(0.1)

    @pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
    @pytest.mark.parametrize("known", ["held out", "mesh alone"])
    def test_it_has_no_unit_where_training_frames_have_no_depth(
        self, sequence: EndoscopicSequence, known: str, scale: float
    ) -> None:
        assert sequence.depth_mm is not None
        depth = sequence.depth_mm * np.float32(scale)
        depth[sequence.train] = 0
        poses = sequence.cameras.world_from_camera.copy()
        poses[:, :3, 3] *= scale
        moved = replace(
            sequence,
            metric=False,
            world_from_camera=poses,
            depth_mm=depth if known == "held out" else None,
        )
        wall = Mesh(WALL.vertices * np.float32(scale), WALL.triangles)
        result = evaluate_surface(wall, TrueSurface(wall, "mesh"), moved)
        assert result.threshold_mm / scale == pytest.approx(0.05 * WALL_MM, rel=0.1)

    def test_no_reconstruction_covers_nothing(self, sequence: EndoscopicSequence) -> None:
        tree = evaluate_surface(None, TrueSurface(WALL, "mesh"), sequence).to_json()
        assert (tree["coverage"], tree["recall"], tree["fscore"]) == (0.0, 0.0, 0.0)
        assert tree["accuracy_mm"] is None
        assert tree["unobserved"]["recall"] == 0.0


class TestFusion:
    def test_true_depth_becomes_the_true_surface(self, sequence: EndoscopicSequence) -> None:
        truth = surface_from_depth(sequence)
        assert truth is not None
        assert truth.kind == "depth"
        assert np.abs(truth.mesh.vertices[:, 2] - WALL_MM - TILT * truth.mesh.vertices[:, 1]).max() < 0.02
        assert truth.mesh.vertices[:, 0].min() == pytest.approx(-14, abs=0.8)
        assert truth.mesh.vertices[:, 0].max() == pytest.approx(14, abs=0.8)

    def test_no_depth_no_truth(self, sequence: EndoscopicSequence) -> None:
        assert surface_from_depth(replace(sequence, depth_mm=None)) is None
        assert surface_from_depth(replace(sequence, world_from_camera=None)) is None
        assert surface_from_depth(replace(sequence, mask=np.zeros_like(sequence.mask))) is None

    def test_a_scene_has_a_surface_of_its_own(self, sequence: EndoscopicSequence) -> None:
        x, y = np.meshgrid(np.linspace(-16, 16, 60), np.linspace(-9, 9, 36))
        points = np.stack([x, y, WALL_MM + TILT * y], axis=-1).reshape(-1, 3)
        gaussians = Gaussians.from_points(
            points, np.full_like(points, 0.5), np.full(len(points), 0.4), opacity=0.95, sh_degree=0
        )
        mesh = scene_surface(Scene(gaussians), sequence)
        assert mesh is not None
        result = evaluate_surface(mesh, TrueSurface(WALL, "mesh"), sequence)
        assert result.observed.accuracy_mm is not None
        assert result.observed.accuracy_mm < 0.5
        assert result.coverage is not None
        assert result.coverage > 0.9
        behind = Gaussians.from_points(
            points * (1, 1, -1), np.full_like(points, 0.5), np.full(len(points), 0.4), opacity=0.95
        )
        assert scene_surface(Scene(behind), sequence) is None

    def test_the_protocol_writes_down_every_setting(self) -> None:
        assert PROTOCOL_FUSION.model_fields_set == set(type(PROTOCOL_FUSION).model_fields)
