"""What views show of a surface whose shares are known: the inside of a ball, and a wall behind a screen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data_catalog.surface_views import SurfaceTruth, WellSeen
from extrags.cameras import Cameras, look_at, pixel_rays
from extrags.errors import CaptureError
from extrags.metrics.surface import TrueSurface
from extrags.sequence import EndoscopicSequence, Split
from extrags.surface import Mesh

SIZE = 48
RADIUS_MM = 20.0
X, Y, Z = np.eye(3)
RIGHT_ANGLE = np.array([[SIZE / 2, 0, SIZE / 2], [0, SIZE / 2, SIZE / 2], [0, 0, 1]])
"""A square image of 90 degrees: six of them make a cube."""


def cameras(*views: tuple[np.ndarray, np.ndarray]) -> Cameras:
    """Cameras of 90 degrees, from centres and directions."""
    poses = [
        look_at(center, center + forward, Y if abs(forward[1]) < 0.9 else X) for center, forward in views
    ]
    return Cameras(np.tile(RIGHT_ANGLE, (len(poses), 1, 1)), np.stack(poses), SIZE, SIZE)


def ball() -> Mesh:
    import open3d as o3d

    made = o3d.geometry.TriangleMesh.create_sphere(radius=RADIUS_MM, resolution=60)
    # Seen from inside: the other way round.
    return Mesh(
        np.asarray(made.vertices, dtype=np.float32), np.asarray(made.triangles, dtype=np.int32)[:, ::-1]
    )


def rectangle(low: tuple[float, float], high: tuple[float, float], z: float) -> Mesh:
    """A rectangle across z that is seen from smaller z."""
    corners = [(low[0], low[1], z), (high[0], low[1], z), (high[0], high[1], z), (low[0], high[1], z)]
    return Mesh(np.array(corners, dtype=np.float32), np.array([[0, 2, 1], [0, 3, 2]], dtype=np.int32))


def joined(first: Mesh, second: Mesh) -> Mesh:
    return Mesh(
        np.concatenate([first.vertices, second.vertices]),
        np.concatenate([first.triangles, second.triangles + np.int32(len(first.vertices))]),
    )


def recorded(
    mesh: Mesh, train: Cameras, test: Cameras | None = None, mask: np.ndarray | None = None
) -> EndoscopicSequence:
    """Frames with true depth; no pixel of a held-out frame was observed."""
    from data_catalog.ray_casting import RayCaster

    every = train if test is None else Cameras.concatenated([train, test])
    rays = RayCaster(mesh.vertices, mesh.triangles)
    depth = np.stack(
        [rays.cast(every.centers[k], pixel_rays(every[k])[0]).distance for k in range(len(every))]
    )
    count = len(every)
    return EndoscopicSequence(
        name="shape/0",
        rgb=np.zeros((count, SIZE, SIZE, 3), dtype=np.uint8),
        K=every.K,
        mask=np.ones(depth.shape, dtype=bool) if mask is None else mask,
        split=Split("shape", np.arange(len(train)), np.arange(len(train), count)),
        world_from_camera=every.world_from_camera,
        depth_mm=np.where(np.isfinite(depth), depth, 0).astype(np.float32),
        observed=np.zeros(depth.shape, dtype=bool),
    )


def truth_of(
    mesh: Mesh,
    train: Cameras,
    test: Cameras | None = None,
    mask: np.ndarray | None = None,
    rule: WellSeen | None = None,
) -> SurfaceTruth:
    sequence = recorded(mesh, train, test, mask)
    return SurfaceTruth.of(sequence, n_samples=6000, rule=rule, surface=TrueSurface(mesh, "mesh"))


CENTER = np.zeros(3)
AHEAD = cameras((CENTER, Z))
SIDES = cameras((CENTER, X), (CENTER, -X), (CENTER, Y), (CENTER, -Y), (CENTER, -Z))
ANY_VIEW = WellSeen(max_incidence_deg=85.0, max_distance_share=10.0, min_separation_deg=30.0)


class TestBall:
    def test_each_face_of_the_cube_shows_its_share(self) -> None:
        truth = truth_of(ball(), AHEAD)
        assert truth.reachable_share > 0.999
        assert truth.never_seen.mean() == pytest.approx(5 / 6, abs=0.003)
        found = truth.measure(SIDES)
        assert found.never_seen == pytest.approx(np.arange(6) / 5, abs=0.005)
        assert found.never_seen[-1] == 1.0
        assert truth.measure(AHEAD).never_seen[-1] == 0.0

    def test_the_area_is_that_of_the_ball(self) -> None:
        truth = truth_of(ball(), AHEAD)
        assert truth.area_mm2 * len(truth.points) == pytest.approx(4 * np.pi * RADIUS_MM**2, rel=0.005)

    def test_a_second_direction_makes_it_well_seen(self) -> None:
        truth = truth_of(ball(), AHEAD, rule=ANY_VIEW)
        assert np.array_equal(truth.badly_seen, ~truth.never_seen)
        # From the same place nothing is gained; from elsewhere what the two ways differ enough at.
        assert truth.measure(AHEAD).badly_seen[-1] == 0.0
        aside = np.array([12.0, 0.0, 5.0])
        view = cameras((aside, Z))
        points = truth.points[truth.badly_seen]
        (pixels,), _ = view.project(points)
        toward, toward_aside = (_unit(eye - points) for eye in (CENTER, aside))
        steep = np.einsum("nk,nk->n", toward_aside, truth.normals[truth.badly_seen]) > np.cos(np.radians(85))
        apart = np.einsum("nk,nk->n", toward, toward_aside) <= np.cos(np.radians(30))
        expected = (view.contains(pixels) & steep & apart).mean()
        assert 0.2 < expected < 0.95
        assert truth.measure(view).badly_seen[-1] == pytest.approx(expected, abs=1e-9)

    def test_far_or_grazing_views_are_not_good(self) -> None:
        eyes = np.array([[5.0, 0.0, 0.0], [5.0, 2.0, 0.0]])
        pair = cameras((eyes[0], Z), (eyes[1], Z))
        rule = WellSeen(max_incidence_deg=12.0, max_distance_share=1.3, min_separation_deg=0.0)
        truth = truth_of(ball(), pair, rule=rule)
        good = np.ones(len(truth.points), dtype=bool)
        for index, eye in enumerate(eyes):
            (pixels,), _ = pair[index].project(truth.points)
            steep = np.einsum("nk,nk->n", _unit(eye - truth.points), truth.normals) >= np.cos(np.radians(12))
            near = np.linalg.norm(eye - truth.points, axis=1) <= 1.3 * truth.unit_mm
            assert 0.05 < near.mean() < 0.95
            good &= pair.contains(pixels) & steep & near
        assert good.any()
        assert np.array_equal(truth.training.well, good)

    def test_held_out_pixels_are_served_by_who_sees_their_surface(self) -> None:
        truth = truth_of(ball(), AHEAD, cameras((CENTER, X)))
        assert len(truth.held_out_points) == SIZE * SIZE
        found = truth.measure([SIDES[1:3], SIDES[:1]])
        assert found.held_out == pytest.approx([0, 0, 0, 1])

    def test_never_less_with_more_views(self) -> None:
        rng = np.random.default_rng(3)
        places = rng.uniform(-10, 10, (20, 3))
        views = cameras(*zip(places, _unit(rng.normal(size=(20, 3))), strict=True))
        found = truth_of(ball(), AHEAD, cameras((CENTER, X)), rule=ANY_VIEW).measure(views)
        for shares in (found.never_seen, found.badly_seen, found.held_out):
            assert len(shares) == 21
            assert shares[0] == 0
            assert (np.diff(shares) >= 0).all()
        assert found.after(20) == found.after(500)
        assert found.after(4)["never_seen"] == found.never_seen[4]

    def test_pixels_outside_the_mask_saw_nothing(self) -> None:
        mask = np.ones((1, SIZE, SIZE), dtype=bool)
        mask[:, :, : SIZE // 2] = False
        truth = truth_of(ball(), AHEAD, mask=mask)
        assert truth.never_seen.mean() == pytest.approx(11 / 12, abs=0.003)

    def test_the_same_seed_gives_the_same_figures(self) -> None:
        first, second = (truth_of(ball(), AHEAD).measure(SIDES).never_seen for _ in range(2))
        assert np.array_equal(first, second)


class TestScreen:
    def test_what_the_screen_hides_was_never_seen(self) -> None:
        # The screen covers the half x < 0 of the wall as seen from the origin.
        scene = joined(rectangle((-20, -20), (20, 20), 20), rectangle((-10, -10), (0, 10), 10))
        truth = truth_of(scene, AHEAD)
        wall = truth.points[:, 2] > 15
        assert np.array_equal(truth.training.seen[wall], truth.points[wall, 0] > 0)
        behind = cameras((np.array([0.0, 0.0, 12.0]), Z))
        (pixels,), _ = behind.project(truth.points[truth.never_seen])
        found = truth.measure(behind).never_seen[-1]
        assert found == pytest.approx(behind.contains(pixels).mean())
        assert found > 0

    def test_surface_out_of_reach_does_not_count(self) -> None:
        # A second wall behind the first: no camera near the recording sees it.
        scene = joined(rectangle((-60, -60), (60, 60), 20), rectangle((-20, -20), (20, 20), 60))
        truth = truth_of(scene, AHEAD)
        assert truth.points[:, 2].max() == pytest.approx(20)
        assert truth.reachable_share < 0.9


def test_without_a_true_surface_it_says_so() -> None:
    sequence = recorded(ball(), AHEAD)
    with pytest.raises(CaptureError, match="shape/0 has no true surface"):
        SurfaceTruth.of(replace(sequence, depth_mm=None))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
