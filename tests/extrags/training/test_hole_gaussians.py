"""Gaussians placed where restored virtual views show surface and the scene has none."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.pseudo_views import PseudoViews
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training import hole_gaussians as placing
from extrags.training.hole_gaussians import hole_gaussians
from extrags.training.starting import LEAST_COLOR
from tests.extrags.training.conftest import HEIGHT, WIDTH, tube_gaussians, tube_light
from tests.extrags.training.plain_finetuning import (
    N_GAUSSIANS,
)


def wall_scene(light: NearFieldLight | None) -> Scene:
    """Gaussians so close together that no two hole points share a cell of their spacing."""
    points = np.random.default_rng(1).normal(0, 1e-3, (50, 3)) - 50.0
    return Scene(Gaussians.from_points(points, np.full((50, 3), 0.5), np.full(50, 1e-3)), light)


def wall_views(pseudo: PseudoViews, depth_mm: np.ndarray, holes: np.ndarray) -> PseudoViews:
    return replace(
        pseudo,
        depth_mm=depth_mm.astype(np.float32),
        alpha=np.where(holes, 0.1, 0.9).astype(np.float32),
    )


@pytest.fixture
def holes() -> np.ndarray:
    found = np.zeros((3, HEIGHT, WIDTH), dtype=bool)
    found[0, 3:30, 5:41] = True
    found[2, 10:20, 20:30] = True
    return found


def projected(points: np.ndarray, camera: Any, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates and z-depth, with the pinhole model written out."""
    pose = camera.world_from_camera[index]
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    K = camera.K[index]
    z = local[:, 2]
    pixels = np.stack([K[0, 0] * local[:, 0] / z + K[0, 2], K[1, 1] * local[:, 1] / z + K[1, 2]], axis=1)
    return pixels, z


@pytest.fixture(autouse=True)
def every_point_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """None is merged with its neighbours (`wall_scene`)."""
    monkeypatch.setattr(placing, "LEAST_SPACING_PX", 0.0)


@pytest.fixture
def real_views_carve_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the rules on virtual views and on cameras, which have tests of their own."""
    monkeypatch.setattr(
        placing, "_in_front_of_virtual_surface", lambda points, _: np.zeros(len(points), dtype=bool)
    )
    monkeypatch.setattr(placing, "_clear_of_cameras", lambda points, *_: np.ones(len(points), dtype=bool))


class TestSurfaceThatFramesSaw:
    FRAME = 0

    def seen(self, tube_sequence: EndoscopicSequence, **changes: Any) -> np.ndarray:
        scene = Scene(tube_gaussians(), tube_light())
        return placing._real_depth(scene, replace(tube_sequence, **changes), self.FRAME)

    def test_gaps_of_measured_depth_are_the_scenes(self, tube_sequence: EndoscopicSequence) -> None:
        """A frame without any depth has the scene's throughout; a highlight must not open a way through."""
        assert tube_sequence.depth_mm is not None
        gaps = tube_sequence.depth_mm.copy()
        gaps[:, 2:12, 2:20] = 0
        found = self.seen(tube_sequence, depth_mm=gaps)
        assert (found[2:12, 2:20] > 0).all()
        np.testing.assert_allclose(found, self.seen(tube_sequence, depth_mm=None), rtol=1e-4)

    @pytest.mark.parametrize("known", [True, False])
    def test_nothing_is_seen_outside_the_mask(self, tube_sequence: EndoscopicSequence, known: bool) -> None:
        mask = tube_sequence.mask.copy()
        mask[:, :, :20] = False
        assert tube_sequence.depth_mm is not None
        depth = tube_sequence.depth_mm.copy()
        depth[:, 5, 30] = 0
        found = self.seen(tube_sequence, mask=mask, depth_mm=depth if known else None)
        assert not found[:, :20].any()
        assert (found[:, 20:] > 0).mean() > 0.9


class TestCells:
    def test_points_of_a_cell_are_averaged_with_their_colours(self) -> None:
        """Cells are counted from the lowest corner, wherever the points lie."""
        generator = np.random.default_rng(0)
        points = generator.uniform(-7, 9, (200, 3)) + np.array([40.0, -60, 3])
        rgb = generator.random((200, 3))
        found, colours = placing._one_per_cell(points, rgb, 4.0)
        cells: dict[tuple[float, ...], list[int]] = {}
        for index, point in enumerate(points):
            cells.setdefault(tuple((point - points.min(axis=0)) // 4.0), []).append(index)
        assert 20 < len(cells) < 100
        order = sorted(cells)
        expected = np.array([points[cells[cell]].mean(axis=0) for cell in order])
        means = np.array([rgb[cells[cell]].mean(axis=0) for cell in order])
        apart, which = cKDTree(expected).query(found)
        assert apart.max() < 1e-12
        assert sorted(which.tolist()) == list(range(len(order)))
        np.testing.assert_allclose(colours, means[which], rtol=1e-12)

    def test_spacing_is_that_of_most_gaussians(self) -> None:
        """One and a half times the way to the nearest neighbour; floaters and clusters say nothing."""
        lattice = 2.0 * np.argwhere(np.ones((5, 5, 5)))
        floaters = np.array([[1e4 * k, 0, 0] for k in range(1, 20)])
        cluster = np.array([-50.0, 0, 0]) + 1e-3 * np.argwhere(np.ones((2, 3, 3)))
        points = np.concatenate([lattice, floaters, cluster])
        gaussians = Gaussians.from_points(points, np.full(points.shape, 0.5), np.full(len(points), 1.0))
        assert placing._typical_spacing(gaussians) == pytest.approx(3.0, rel=1e-6)


class TestHoleGaussians:
    ROOM = 10_000

    @pytest.mark.usefixtures("real_views_carve_alone")
    @pytest.mark.parametrize("thickness", [1.0, 0.1])
    def test_lie_flat_on_the_surface(
        self, sequence: EndoscopicSequence, pseudo: PseudoViews, holes: np.ndarray, thickness: float
    ) -> None:
        holes[1:] = False
        blind = replace(sequence, mask=np.zeros_like(sequence.mask))
        # A slanted plane n x = d before the first camera.
        n, d = np.array([0.3, -0.2, 0.9]) / math.sqrt(0.94), 14.0
        K = pseudo.cameras.K[0]
        v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
        rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
        views = wall_views(pseudo, np.repeat((d / (rays @ n))[None], 3, axis=0), holes)
        new = hole_gaussians(wall_scene(None), blind, views, self.ROOM, thickness=thickness)
        assert new is not None
        scales = np.sort(new.scales.double().exp().numpy(), axis=1)
        np.testing.assert_allclose(scales[:, 1], scales[:, 2], rtol=1e-5)
        np.testing.assert_allclose(scales[:, 0], thickness * scales[:, 1], rtol=1e-5)
        np.testing.assert_allclose(torch.sigmoid(new.opacities), 0.3, rtol=1e-5)
        if thickness != 1:
            axes = Rotation.from_quat(new.quats.double().numpy()[:, [1, 2, 3, 0]]).as_matrix()
            thin = axes[np.arange(len(new)), :, new.scales.argmin(dim=1).numpy()]
            normal = pseudo.cameras.world_from_camera[0, :3, :3] @ n
            # Depths are of single precision, and neighbours 0.6 mm apart at 14 mm.
            np.testing.assert_allclose(np.abs(thin @ normal), 1, atol=1e-5)

    @pytest.mark.usefixtures("real_views_carve_alone")
    def test_lie_at_the_restored_depth_along_their_rays(
        self, sequence: EndoscopicSequence, pseudo: PseudoViews, holes: np.ndarray
    ) -> None:
        # Nothing real was seen: nothing carves.
        blind = replace(sequence, mask=np.zeros_like(sequence.mask))
        depth = np.random.default_rng(0).uniform(5, 40, holes.shape)
        depth[0, 4:8] = 0
        views = wall_views(pseudo, depth, holes)
        new = hole_gaussians(wall_scene(None), blind, views, self.ROOM)
        assert new is not None
        means = new.means.double().numpy()
        on_grid = np.zeros_like(holes)
        on_grid[:, ::2, ::2] = True
        wanted = {tuple(x) for x in np.argwhere(holes & on_grid & (depth > 0)).tolist()}
        got = set()
        for index in range(3):
            pixels, z = projected(means, views.cameras, index)
            column, row = np.floor(pixels).astype(int).T
            inside = (z > 0) & (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
            for i in np.flatnonzero(inside):
                centred = np.abs(pixels[i] - np.floor(pixels[i]) - 0.5).max() < 1e-3
                if centred and abs(z[i] / views.depth_mm[index, row[i], column[i]] - 1) < 1e-5:
                    got.add((index, row[i], column[i]))
        assert got == wanted
        assert len(new) == len(wanted)

    @pytest.mark.usefixtures("real_views_carve_alone")
    def test_none_in_front_of_a_real_surface(
        self, sequence: EndoscopicSequence, pseudo: PseudoViews, holes: np.ndarray
    ) -> None:
        depth = np.random.default_rng(0).uniform(2, 60, holes.shape)
        views = wall_views(pseudo, depth, holes)
        new = hole_gaussians(wall_scene(None), sequence, views, self.ROOM)
        blind = replace(sequence, mask=np.zeros_like(sequence.mask))
        every = hole_gaussians(wall_scene(None), blind, views, self.ROOM)
        assert new is not None
        assert every is not None
        assert sequence.depth_mm is not None

        def hiding(points: np.ndarray) -> np.ndarray:
            found = np.zeros(len(points), dtype=bool)
            for frame in sequence.train:
                pixels, z = projected(points, sequence.cameras, frame)
                for i, (u, v) in enumerate(pixels):
                    if z[i] > 0 and 0 <= u < WIDTH and 0 <= v < HEIGHT:
                        row, column = int(v), int(u)
                        seen = sequence.depth_mm[frame, row, column] * sequence.mask[frame, row, column]
                        found[i] |= seen > 0 and z[i] < 0.95 * seen
            return found

        assert not hiding(new.means.double().numpy()).any()
        hides = hiding(every.means.double().numpy())
        assert 20 < hides.sum() < len(every) - 20
        assert len(new) == len(every) - hides.sum()

    @pytest.mark.usefixtures("real_views_carve_alone")
    def test_albedo_times_light_is_the_target(
        self, sequence: EndoscopicSequence, pseudo: PseudoViews, holes: np.ndarray
    ) -> None:
        holes[2] = False
        blind = replace(sequence, mask=np.zeros_like(sequence.mask))
        light = replace(
            tube_light(),
            spread=torch.tensor(0.4),
            cosine=torch.tensor(0.7),
            log_shoulder=torch.tensor(-0.3),
            log_specular=torch.tensor(0.05).log(),
            log_roughness=torch.tensor(0.3).log(),
        )
        # A slanted plane n x = d before the first camera: normals and depths are known.
        n, d = np.array([0.3, -0.2, 0.9]) / math.sqrt(0.94), 14.0
        K = pseudo.cameras.K[0]
        v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
        rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
        depth = np.repeat((d / (rays @ n))[None], 3, axis=0)
        new = hole_gaussians(
            wall_scene(light), blind, wall_views(pseudo, depth, holes), self.ROOM, thickness=0.1
        )
        assert new is not None
        means = new.means.double().numpy()
        pixels, z = projected(means, pseudo.cameras, 0)
        column, row = np.floor(pixels).astype(int).T
        albedo = 0.28209479177387814 * new.sh0[:, 0].double().numpy() + 0.5
        # The light's formula, in float64, at points in the camera frame
        points = rays[row, column] * z[:, None] / 15.0
        square = (points**2).sum(1)
        c, e, shoulder = math.exp(-2.0), 0.9, math.exp(-0.3)
        facing = ((points @ n) ** 2 / square + 0.04) / 1.04
        axis = np.maximum(points[:, 2] / np.sqrt(square), 0.1)
        gain = ((1 + c) / (square + c)) ** e * axis**0.4 * facing**0.35
        assert gain.min() > placing.MIN_GAIN
        # Highlights are part of the target, not of the albedo.
        lobe = (0.09 / (0.09 + 0.91 * (1 - (points @ n) ** 2 / square))) ** 2
        highlight = 0.05 * lobe * ((1 + c) / (square + c)) ** e * axis**0.4
        assert highlight.max() > 0.01
        signal = albedo * gain[:, None] + highlight[:, None]
        image = (1 + shoulder) * signal / (1 + shoulder * signal)
        tolerance = 100 * np.finfo(np.float32).eps
        # What a highlight leaves nothing of is held at a colour that can be learned.
        held = albedo < LEAST_COLOR * (1 + tolerance)
        assert held.mean() < 0.2
        target = pseudo.target[0][row, column]
        np.testing.assert_allclose(image[~held], target[~held], rtol=tolerance, atol=tolerance)
        np.testing.assert_allclose(albedo[held], LEAST_COLOR, rtol=tolerance)
        assert np.all(image[held] > target[held] - tolerance)

    @pytest.mark.usefixtures("real_views_carve_alone")
    @pytest.mark.parametrize("room", [-3, 0, 5, 50, 99, 100, 101, 173, 300])
    def test_at_most_room(self, sequence: EndoscopicSequence, pseudo: PseudoViews, room: int) -> None:
        blind = replace(sequence, mask=np.zeros_like(sequence.mask))
        everywhere = np.ones((3, HEIGHT, WIDTH), dtype=bool)
        views = wall_views(pseudo, np.full((3, HEIGHT, WIDTH), 20.0), everywhere)
        new = hole_gaussians(wall_scene(None), blind, views, room)
        if room <= 0:
            assert new is None
        elif room >= 100:
            assert new is not None
            assert room / 2 < len(new) <= room
        else:
            assert new is None or len(new) <= room

    def test_none_in_front_of_surface_that_a_virtual_view_shows(
        self,
        sequence: EndoscopicSequence,
        pseudo: PseudoViews,
        holes: np.ndarray,
    ) -> None:
        """A guess must hide neither known surface nor what another virtual view completes far behind it."""
        blind = replace(sequence, mask=np.zeros_like(sequence.mask))
        holes[1:] = False
        near = np.full(holes.shape, 6.0)
        every = hole_gaussians(wall_scene(None), blind, wall_views(pseudo, near, holes), self.ROOM)
        assert every is not None
        means = every.means.double().numpy()
        (pixels,), (z,) = pseudo.cameras[1].project(means)
        seen = pseudo.cameras[1].contains(pixels)
        assert 0 < seen.sum() < len(seen)
        nearest, farthest = z[seen].min(), z[seen].max()
        for alpha, uncertainty, shown_mm, hidden in (
            (1.0, 0.0, 1.2 * farthest, True),  # known surface behind the guesses
            (1.0, 1.0, 1.2 * farthest, False),  # solid, but nothing is known of it
            (0.0, 1.0, 1.5 * farthest, True),  # completed far behind
            (0.0, 1.0, 1.2 * nearest, False),  # completed a little behind: they may be the same surface
        ):
            views = wall_views(pseudo, near, holes)
            second = np.full(holes.shape[1:], shown_mm)
            views = replace(views, uncertainty=pseudo.uncertainty.copy())
            views.depth_mm[1], views.alpha[1], views.uncertainty[1] = second, alpha, uncertainty
            found = hole_gaussians(wall_scene(None), blind, views, self.ROOM)
            # The second view may bring points of its own.
            apart = np.inf if found is None else cKDTree(found.means.numpy()).query(every.means.numpy())[0]
            kept = bool(np.all(apart < 1e-3))
            assert kept != hidden, (alpha, uncertainty, shown_mm)

    def test_what_is_filled_by_now_is_no_hole_and_still_not_to_be_hidden(
        self, sequence: EndoscopicSequence, pseudo: PseudoViews, holes: np.ndarray
    ) -> None:
        blind = replace(sequence, mask=np.zeros_like(sequence.mask))
        holes[1:] = False
        near = np.full(holes.shape, 6.0)
        views = wall_views(pseudo, near, holes)
        every = hole_gaussians(wall_scene(None), blind, views, self.ROOM)
        assert every is not None
        filled = np.ones_like(views.alpha)
        assert hole_gaussians(wall_scene(None), blind, views, self.ROOM, alpha=filled) is None
        # A second view, a hole when it was restored: completed far behind, and filled by now.
        views = replace(views, uncertainty=np.ones_like(views.alpha))
        (_,), (z,) = pseudo.cameras[1].project(every.means.double().numpy())
        views.depth_mm[1], views.alpha[1] = 1.5 * z.max(), 0.0
        filled[0] = views.alpha[0]
        found = hole_gaussians(wall_scene(None), blind, views, self.ROOM, alpha=filled)
        assert found is not None
        for gaussians, some in ((every, True), (found, False)):
            (pixels,), _ = pseudo.cameras[1].project(gaussians.means.double().numpy())
            assert pseudo.cameras[1].contains(pixels).any() == some

    @pytest.mark.usefixtures("real_views_carve_alone")
    def test_none_far_from_all_known_surface(
        self, sequence: EndoscopicSequence, pseudo: PseudoViews, holes: np.ndarray
    ) -> None:
        blind = replace(sequence, mask=np.zeros_like(sequence.mask))
        scene = Scene(tube_gaussians(N_GAUSSIANS), None)
        depth = np.random.default_rng(0).uniform(2, 300, holes.shape)
        views = wall_views(pseudo, depth, holes)
        every = hole_gaussians(scene, blind, views, self.ROOM)
        new = hole_gaussians(scene, blind, views, self.ROOM, max_distance=6.0)
        assert every is not None
        assert new is not None
        assert 0 < len(new) < len(every)
        apart = torch.cdist(new.means, scene.gaussians.means).min(dim=1).values
        # Points of a cell are averaged, which may move them by its edge.
        assert apart.max() <= 6.0 + placing._typical_spacing(scene.gaussians)

    def test_none_nearer_to_a_camera_than_any_surface_that_was_seen(
        self, sequence: EndoscopicSequence, pseudo: PseudoViews, holes: np.ndarray
    ) -> None:
        # One near pixel in a thousand is no surface.
        seen_mm = np.full(holes.shape[1:], 30.0, dtype=np.float32)
        seen_mm[0, 0] = 0.5
        depth = np.repeat(seen_mm[None], len(sequence.rgb), axis=0)
        # Nothing carves: the real cameras stand where the first virtual one does, and look away from it.
        turned = pseudo.cameras.world_from_camera[:1].repeat(len(depth), axis=0)
        turned[:, :3, :3] = turned[:, :3, :3] @ np.diag([-1.0, 1.0, -1.0])
        first = replace(sequence, depth_mm=depth, mask=np.ones_like(sequence.mask), world_from_camera=turned)
        names = ("rendered", "restored", "target", "alpha", "depth_mm", "uncertainty", "pixel_confidence")
        names += ("image_confidence", "reference", "clip", "cameras")
        alone = replace(pseudo, **{name: getattr(pseudo, name)[:1] for name in names})
        every = np.count_nonzero(holes[0, ::2, ::2])
        # 0.7 * 30 mm = 21 mm along the ray: at 20 mm depth the corners alone are that far.
        for z, some, left_out in ((10.0, False, True), (20.0, True, True), (22.0, True, False)):
            views = wall_views(alone, np.full((1, *holes.shape[1:]), z), holes[:1])
            new = hole_gaussians(wall_scene(None), first, views, self.ROOM)
            assert (new is not None) == some
            if new is None:
                continue
            assert (len(new) < every) == left_out
            distance = np.linalg.norm(new.means.double().numpy() - alone.cameras.centers[0], axis=1)
            assert distance.min() >= 21 * (1 - 1e-5)

    def test_virtual_cameras_are_kept_clear_too(
        self, sequence: EndoscopicSequence, pseudo: PseudoViews, holes: np.ndarray
    ) -> None:
        depth = np.full((len(sequence.rgb), *holes.shape[1:]), 30.0, dtype=np.float32)
        # The real cameras stand far away, and look away.
        poses = pseudo.cameras.world_from_camera[:1].repeat(len(depth), axis=0)
        poses[:, :3, 3] -= 500 * poses[:, :3, 2]
        poses[:, :3, :3] = poses[:, :3, :3] @ np.diag([-1.0, 1.0, -1.0])
        mask = np.ones_like(sequence.mask)
        far = replace(sequence, depth_mm=depth, mask=mask, world_from_camera=poses)
        holes[1:] = False
        for z, some in ((5.0, False), (25.0, True)):
            views = wall_views(pseudo, np.full(holes.shape, z), holes)
            found = hole_gaussians(wall_scene(None), far, views, self.ROOM)
            assert (found is not None) == some

    def test_the_unit_of_length_does_not_matter(
        self, sequence: EndoscopicSequence, pseudo: PseudoViews, holes: np.ndarray
    ) -> None:
        """Metres, or whatever structure from motion found: a power of two changes no digit."""
        known = replace(sequence, mask=np.ones_like(sequence.mask))
        assert known.depth_mm is not None
        assert known.world_from_camera is not None
        known = replace(known, depth_mm=np.maximum(known.depth_mm, 40))
        depth = np.random.default_rng(0).uniform(20, 60, holes.shape)
        means = []
        for scale in (1.0, 2.0**-10):
            poses, virtual = known.world_from_camera.copy(), pseudo.cameras.world_from_camera.copy()
            for array in (poses, virtual):
                array[:, :3, 3] *= scale
            points = wall_scene(None).gaussians.means.double().numpy() * scale
            scene = Scene(
                Gaussians.from_points(points, np.full((50, 3), 0.5), np.full(50, 1e-3 * scale)), None
            )
            views = wall_views(pseudo, depth * scale, holes)
            new = hole_gaussians(
                scene,
                replace(known, world_from_camera=poses, depth_mm=known.depth_mm * np.float32(scale)),
                replace(views, cameras=replace(pseudo.cameras, world_from_camera=virtual)),
                self.ROOM,
                max_distance=200 * scale,
            )
            assert new is not None
            means.append(new.means / scale)
        assert 20 < len(means[0]) < np.count_nonzero(holes[:, ::2, ::2])
        torch.testing.assert_close(means[0], means[1], rtol=8 * torch.finfo(torch.float32).eps, atol=0)

    @pytest.mark.usefixtures("real_views_carve_alone")
    def test_of_far_holes_no_more_light_is_divided_out_than_a_twentieth(
        self, sequence: EndoscopicSequence, pseudo: PseudoViews, holes: np.ndarray
    ) -> None:
        """A dark pixel far away would become a Gaussian that glows from nearby."""
        holes[1:] = False
        blind = replace(sequence, mask=np.zeros_like(sequence.mask))
        target = np.full_like(pseudo.target, 0.02)
        views = replace(wall_views(pseudo, np.full(holes.shape, 3000.0), holes), target=target)
        light = tube_light()
        new = hole_gaussians(wall_scene(light), blind, views, self.ROOM)
        assert new is not None
        signal = light.invert_response(torch.full((3,), 0.02, dtype=torch.float64))
        albedo = 0.28209479177387814 * new.sh0[:, 0].double() + 0.5
        # Colours are kept about one half, so the rounding is that of numbers as large.
        tolerance = 4 * torch.finfo(torch.float32).eps
        torch.testing.assert_close(albedo, (signal / 0.05).expand_as(albedo), rtol=0, atol=tolerance)

    def test_nothing_to_fill(self, sequence: EndoscopicSequence, pseudo: PseudoViews) -> None:
        none = wall_views(pseudo, np.full((3, HEIGHT, WIDTH), 20.0), np.zeros((3, HEIGHT, WIDTH), dtype=bool))
        assert hole_gaussians(wall_scene(None), sequence, none, self.ROOM) is None

    @pytest.mark.usefixtures("real_views_carve_alone")
    def test_gaussians_that_lie_upon_each_other_do_not_make_new_ones_small(
        self,
        sequence: EndoscopicSequence,
        pseudo: PseudoViews,
        holes: np.ndarray,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        """As after a relocation: the nearest neighbour is a copy, at no distance."""
        monkeypatch.setattr(placing, "LEAST_SPACING_PX", 2.0)
        depth_mm = 10.0
        views = wall_views(pseudo, np.full((3, HEIGHT, WIDTH), depth_mm), holes)
        new = hole_gaussians(wall_scene(None), sequence, views, 10_000)
        assert new is not None
        footprint_mm = depth_mm / pseudo.cameras.K[0, 0, 0]
        radius = new.scales.exp().max(dim=1).values
        torch.testing.assert_close(radius, torch.full_like(radius, 1.4 * footprint_mm), rtol=1e-4, atol=0)

    @pytest.mark.usefixtures("real_views_carve_alone")
    def test_fewer_gaussians_for_want_of_room_close_the_surface_as_well(
        self, sequence: EndoscopicSequence, pseudo: PseudoViews
    ) -> None:
        blind = replace(sequence, mask=np.zeros_like(sequence.mask))
        everywhere = np.ones((3, HEIGHT, WIDTH), dtype=bool)
        views = wall_views(pseudo, np.full((3, HEIGHT, WIDTH), 20.0), everywhere)
        areas = []
        for room in (10_000, 100):
            new = hole_gaussians(wall_scene(None), blind, views, room)
            assert new is not None
            assert len(new) <= room
            areas.append(len(new) * float(new.scales.exp().max(dim=1).values.median()) ** 2)
        assert areas[1] == pytest.approx(areas[0], rel=0.01)
