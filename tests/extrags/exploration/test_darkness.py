from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from extrags.cameras import Cameras, look_at, pixel_rays
from extrags.config import LightConfig
from extrags.exploration.darkness import dark_direction, illumination_weight, lit_luminance
from extrags.illumination import NearFieldLight

from .tube import make_tube

WIDTH, HEIGHT = 80, 64
PLAIN = LightConfig(exponent=0.8, spread=False, cosine=False, response=False, glare=False)
CAMERA = Cameras(np.array([[[40.0, 0, 40], [0, 40.0, 32], [0, 0, 1]]]), np.eye(4)[None], WIDTH, HEIGHT)
ROWS, COLUMNS = np.meshgrid(np.arange(HEIGHT), np.arange(WIDTH), indexing="ij")
DISTANCE_PER_DEPTH = np.linalg.norm(pixel_rays(CAMERA)[0], axis=-1)


def pixel_of(ray: np.ndarray, camera: Cameras = CAMERA) -> tuple[float, float]:
    local = camera.world_from_camera[0, :3, :3].T @ ray
    projected = camera.K[0] @ (local / local[2])
    return float(projected[0]), float(projected[1])


def disc(column: float, row: float, radius: float) -> np.ndarray:
    return np.hypot(COLUMNS - column, ROWS - row) < radius


def grey(values: np.ndarray) -> np.ndarray:
    return np.repeat(values[..., None], 3, axis=2).astype(np.float32)


class TestDarkDirection:
    @pytest.mark.parametrize("centre", [(25, 40), (60, 15), (40, 32)])
    def test_hits_a_dark_lumen(self, centre):
        noise = np.random.default_rng(0).normal(0, 0.02, (HEIGHT, WIDTH))
        image = np.where(disc(*centre, 8), 0.15, 0.5) + noise
        ray = dark_direction(CAMERA, grey(image), np.ones_like(image), np.full_like(image, 30.0), None)
        column, row = pixel_of(ray)
        assert np.hypot(column - centre[0], row - centre[1]) < 4

    def test_hits_the_unlit_end_of_a_rendered_tube(self):
        tube = make_tube(width=WIDTH, height=HEIGHT, n_views=1, view_arc=(0.9, 0.9), light=True)
        gaussians = tube.scene.gaussians
        # The far end was never lit: its albedo is learned too dark.
        at_end = torch.atan2(gaussians.means[:, 1], gaussians.means[:, 0]) > 1.7
        gaussians.sh0[at_end] = (0.08 - 0.5) / 0.28209479177387814
        rendering = tube.scene.render(tube.cameras)
        ray = dark_direction(
            tube.cameras,
            rendering.rgb[0].numpy(),
            rendering.alpha[0].numpy(),
            rendering.depth[0].numpy(),
            tube.scene.light,
        )
        center = tube.cameras.centers[0]
        toward = gaussians.means[at_end].numpy().mean(axis=0) - center
        assert ray @ (toward / np.linalg.norm(toward)) > np.cos(np.radians(20))

    def test_a_border_is_not_dark(self):
        rng = np.random.default_rng(1)
        hits = []
        for _ in range(200):
            image = 0.5 + rng.normal(0, 0.3, (HEIGHT, WIDTH))
            ray = dark_direction(CAMERA, grey(image), np.ones_like(image), np.full_like(image, 30.0), None)
            if ray.any():
                hits.append(pixel_of(ray))
        assert not any(c < 4 or c > WIDTH - 4 or r < 4 or r > HEIGHT - 4 for c, r in hits)

    def test_a_hole_is_not_dark(self):
        hole = disc(20, 20, 10)
        image = np.where(hole, 0.0, np.where(disc(58, 40, 8), 0.2, 0.5))
        ray = dark_direction(CAMERA, grey(image), np.where(hole, 0.1, 1.0), np.full_like(image, 30.0), None)
        column, row = pixel_of(ray)
        assert np.hypot(column - 58, row - 40) < 4

    @pytest.mark.parametrize("with_light", [True, False])
    def test_far_is_not_dark(self, with_light):
        light = NearFieldLight.initial(1, 30.0, PLAIN) if with_light else None
        depth = np.where(COLUMNS < 40, 20.0, 80.0)
        # Everything of one albedo, seen through inverse-square light, but for one spot.
        falloff = NearFieldLight.initial(1, 30.0, PLAIN)
        lit = falloff.falloff(torch.from_numpy(depth * DISTANCE_PER_DEPTH)).numpy()
        image = 0.5 * lit * np.where(disc(20, 30, 8), 0.3, 1.0)
        assert image[30, 20] > image[30, 60], "the spot is near and still brighter than what is far"
        ray = dark_direction(CAMERA, grey(image), np.ones_like(image), depth, light)
        column, row = pixel_of(ray)
        assert np.hypot(column - 20, row - 30) < 5

    def test_dark_is_told_by_the_median_of_the_view(self) -> None:
        """A highlight, which raises the mean alone, makes nothing else dark."""
        image = np.where(COLUMNS < 28, 1.5, 0.5)
        image[disc(60, 30, 8)] = 0.4
        flat = 30.0 / DISTANCE_PER_DEPTH
        ray = dark_direction(CAMERA, grey(image), np.ones_like(image), flat, None)
        np.testing.assert_array_equal(ray, 0)
        image[disc(60, 30, 8)] = 0.3
        ray = dark_direction(CAMERA, grey(image), np.ones_like(image), flat, None)
        column, row = pixel_of(ray)
        assert np.hypot(column - 60, row - 30) < 5

    def test_an_even_view_favours_nothing(self):
        image = np.full((HEIGHT, WIDTH), 0.5)
        ray = dark_direction(CAMERA, grey(image), np.ones_like(image), np.full_like(image, 30.0), None)
        np.testing.assert_array_equal(ray, 0)

    def test_an_empty_view_favours_nothing(self):
        empty = np.zeros((HEIGHT, WIDTH))
        np.testing.assert_array_equal(dark_direction(CAMERA, grey(empty), empty, empty, None), 0)

    def test_a_light_is_divided_out_exactly(self):
        light = NearFieldLight.initial(1, 30.0, PLAIN)
        depth = np.linspace(10, 90, WIDTH)[None].repeat(HEIGHT, axis=0)
        image = 0.4 * light.falloff(torch.from_numpy(depth * DISTANCE_PER_DEPTH)).numpy()
        lit = lit_luminance(CAMERA, grey(image).astype(np.float64), depth, depth > 0, light)
        np.testing.assert_allclose(lit, 0.4, rtol=1e-5)

    def test_a_lamp_beside_the_lens_makes_no_side_dark(self) -> None:
        light = replace(NearFieldLight.initial(1, 30.0, PLAIN), offset=torch.tensor([0.2, -0.1, 0.0]))
        pose = look_at(np.array([3.0, 1.0, 2.0]), np.array([9.0, -4.0, 20.0]), np.array([0.3, -1.0, 0.0]))
        camera = Cameras(CAMERA.K, pose[None], WIDTH, HEIGHT)
        depth = np.linspace(10, 90, WIDTH)[None].repeat(HEIGHT, axis=0)
        points = pixel_rays(CAMERA)[0] * depth[..., None]
        from_lamp = np.linalg.norm(points - [6.0, -3.0, 0.0], axis=-1)
        image = 0.4 * light.falloff(torch.from_numpy(from_lamp)).numpy()
        lit = lit_luminance(camera, grey(image).astype(np.float64), depth, depth > 0, light)
        np.testing.assert_allclose(lit, 0.4, rtol=1e-5)

    def test_spread_and_response_of_a_light_are_undone_too(self) -> None:
        """Against the light's formulas, written out; channels are weighed as in Rec. 709."""
        light = NearFieldLight(
            torch.tensor(-1.5),
            torch.tensor(0.9).log(),
            torch.zeros(1),
            25.0,
            spread=torch.tensor(0.8),
            log_shoulder=torch.tensor(-0.4),
            log_glare=torch.full((3,), 0.05).log(),
        )
        depth = np.random.default_rng(0).uniform(20, 60, (HEIGHT, WIDTH))
        distance, shoulder, softening = depth * DISTANCE_PER_DEPTH, np.exp(-0.4), np.exp(-1.5)
        gain = ((1 + softening) / ((distance / 25) ** 2 + softening)) ** 0.9 * DISTANCE_PER_DEPTH**-0.8
        signal = 0.6 * gain
        image = np.hypot((1 + shoulder) * signal / (1 + shoulder * signal), 0.05)
        colour = np.array([1.3, 0.9, 1.1])
        colour /= colour @ [0.2126, 0.7152, 0.0722]
        # What is overexposed is as bright as an image can be.
        brighter, signal = image.copy(), signal.copy()
        clear = np.sqrt(1 - 0.05**2)
        brighter[5, 7], signal[5, 7] = 1.7, clear / (1 + shoulder * (1 - clear))
        lit = lit_luminance(CAMERA, brighter[..., None] * colour, depth, depth > 0, light) * gain / signal
        # The light's parameters are of single precision.
        np.testing.assert_allclose(lit, 1.0, rtol=20 * np.finfo(np.float32).eps)

    @pytest.mark.parametrize(
        ("slope", "divided"), [(-1.3, -1.3), (-2.0, -2.0), (-3.5, -2.0), (0.0, 0.0), (0.7, 0.0)]
    )
    def test_without_a_light_what_falls_off_like_one_is_divided_out(
        self, slope: float, divided: float
    ) -> None:
        """By a power of the distance, no steeper than light can fall, and never one that rises."""
        generator = np.random.default_rng(1)
        depth = generator.uniform(20, 60, (HEIGHT, WIDTH))
        distance = depth * DISTANCE_PER_DEPTH
        image = 0.4 * (distance / 40) ** slope
        # Neither holes nor what is black tell anything of the light.
        valid = ~disc(20, 20, 9)
        usable = valid & ~disc(55, 40, 9)
        image[~valid], depth[~valid] = 7.0, 3.0
        image[valid & ~usable] = 1e-4
        lit = lit_luminance(CAMERA, np.repeat(image[..., None], 3, axis=2), depth, valid, None)
        mean = np.exp(np.log(distance[usable]).mean())
        expected = np.where(valid, image / (distance / mean) ** divided, 0)
        np.testing.assert_allclose(lit, expected, rtol=1e-10)

    @pytest.mark.parametrize("unit", [1.0, 2.0**-10])
    @pytest.mark.parametrize("seed", range(4))
    def test_the_patch_is_that_of_a_search_through_all(self, seed: int, unit: float) -> None:
        generator = np.random.default_rng(seed)
        width, height = 34, 21
        K = np.array([[[17.0, 0, 15.5], [0, 18.0, 11.2], [0, 0, 1]]])
        pose = look_at(np.array([1.0, 2, 3]), generator.normal(size=3), np.array([0.0, 1, 0]))
        camera = Cameras(K, pose[None], width, height)
        # Without a fall-off that could be fitted: every surface is equally far.
        depth = unit * 30 / np.linalg.norm(pixel_rays(camera)[0], axis=-1)
        image = generator.uniform(0.3, 0.7, (height, width))
        image[4:9, 6:13] *= 0.3
        image[12:19, 20:26] *= 0.25
        alpha = np.where(generator.random((height, width)) < 0.3, 0.2, 1.0)
        alpha[11:16, 19:25] = 0.2
        # 34 * 15 / 160 is 3.2 px: 3 px.
        means = {}
        for row in range(1, height - 1):
            for column in range(1, width - 1):
                patch = slice(row - 1, row + 2), slice(column - 1, column + 2)
                solid = alpha[patch] == 1
                if solid.sum() >= 4.5:
                    means[row, column] = image[patch][solid].mean()
        row, column = min(means, key=means.__getitem__)
        assert means[row, column] < 0.7 * np.median(image[alpha == 1])
        ray = dark_direction(camera, np.repeat(image[..., None], 3, axis=2), alpha, depth, None)
        assert np.linalg.norm(ray) == pytest.approx(1)
        assert pixel_of(ray, camera) == pytest.approx((column + 0.5, row + 0.5), abs=1e-9)


class TestIlluminationWeight:
    def test_is_the_papers_formula_for_displacements(self):
        current = look_at(np.array([1.0, 2, 3]), np.array([4.0, 0, 1]), np.array([0.0, 1, 0]))
        dark = np.array([0.6, 0.0, 0.8])
        candidates = np.stack([current, current, current])
        candidates[0, :3, 3] += 2.0 * dark
        candidates[1, :3, 3] -= 2.0 * dark
        candidates[2, :3, 3] += [0.0, 0.0, 3.0]
        weight = illumination_weight(dark, current, candidates, 0.5)
        np.testing.assert_allclose(weight, [1.5, 1.0, 1.4])

    def test_turning_towards_the_dark_counts(self):
        from extrags.exploration.primitives import PRIMITIVES, apply_primitives, primitive_motions

        candidates = apply_primitives(np.eye(4), primitive_motions(1.0, 10.0, 10.0, 5.0))
        dark = np.array([0.6, 0.0, 0.8])
        weight = dict(zip(PRIMITIVES, illumination_weight(dark, np.eye(4), candidates, 0.5), strict=True))
        assert weight["turn_right"] > 1.2
        assert weight["turn_left"] == pytest.approx(1.0)

    def test_no_dark_direction_weighs_nothing(self):
        candidates = np.stack([np.eye(4)] * 3)
        candidates[1, 0, 3] = 1
        np.testing.assert_array_equal(illumination_weight(np.zeros(3), np.eye(4), candidates, 0.5), 1)
