"""The baseline UC-NeRF: stereo and volume rendering against plain references, and a tiny training."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from extrags.baselines.uc_nerf import rendering
from extrags.baselines.uc_nerf.field import (
    ConditionedField,
    Rays,
    blending_weights,
    composited,
    sample_depths,
)
from extrags.baselines.uc_nerf.scene import UcNerf, nearest_views
from extrags.baselines.uc_nerf.stereo import (
    PosedImages,
    StereoNetwork,
    depth_distribution,
    locally_normalised,
    plane_sweep,
    variance_cost,
)
from extrags.baselines.uc_nerf.training import (
    edge_aware_smoothness,
    photometric_consistency,
    scale_invariant_gradient,
    sparse_depths,
    train,
)
from extrags.cameras import transform_points, unproject_pixels
from extrags.config import UcNerfConfig
from extrags.errors import CaptureError, ConfigError
from extrags.events import Progress, subscribed
from extrags.radial_lens import RadialLens
from tests.extrags.baselines.slanted_plane import HEIGHT, WIDTH, cameras, seen, slanted_plane

TINY = UcNerfConfig(
    iterations=60,
    source_views=3,
    stereo_width=24,
    coarse_planes=16,
    fine_planes=4,
    samples_uniform=4,
    samples_prior=6,
    width=16,
    rays=96,
    patches=2,
    sparse_pixels=24,
    learning_rate=5e-3,
)
RANGE = (1 / 40.0, 1 / 10.0)


@pytest.fixture(scope="module")
def trained() -> UcNerf:
    return train(slanted_plane(), TINY).scene


class TestPlaneSweep:
    def test_against_a_plain_one(self) -> None:
        """Pixel by pixel in float64: unproject, move, project, interpolate."""
        views = cameras(np.array([[0.0, 0, 0], [2, 0.5, 0.2], [-1.5, 1, -0.4]]))
        generator = np.random.default_rng(0)
        features = generator.normal(size=(2, 2, HEIGHT, WIDTH))
        inverse = generator.uniform(*RANGE, size=(3, 4, 5))
        K = views.resized(5, 4).K[0]
        found, valid = plane_sweep(
            torch.from_numpy(features),
            torch.from_numpy(views.K[1:]),
            torch.from_numpy(views.viewmats[1:]),
            torch.from_numpy(K),
            torch.from_numpy(views.viewmats[0]),
            torch.from_numpy(inverse),
        )
        inside = 0
        for d, row, column in np.ndindex(inverse.shape):
            local = unproject_pixels(np.array([column + 0.5, row + 0.5]), K) / inverse[d, row, column]
            world = transform_points(views.world_from_camera[0], local)
            for n in range(2):
                (pixel,), _ = views[n + 1].project(world)
                sees = bool(views.contains(pixel))
                assert bool(valid[n, d, row, column]) == sees
                if not sees:
                    continue
                inside += 1
                u, v = pixel - 0.5
                low = np.floor([u, v]).astype(int)
                expected = np.zeros(2)
                for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
                    x, y = low[0] + i, low[1] + j
                    share = (1 - abs(u - x)) * (1 - abs(v - y))
                    expected += share * features[n, :, np.clip(y, 0, HEIGHT - 1), np.clip(x, 0, WIDTH - 1)]
                np.testing.assert_allclose(found[n, :, d, row, column].numpy(), expected, atol=1e-9)
        assert inside > 20

    def test_points_behind_a_view_are_not_seen_by_it(self) -> None:
        views = cameras(np.array([[0.0, 0, 0], [0, 0, 30]]))
        _, valid = plane_sweep(
            torch.ones(1, 1, 4, 4),
            torch.from_numpy(views.K[1:]).float(),
            torch.from_numpy(views.viewmats[1:]).float(),
            torch.from_numpy(views.K[0]).float(),
            torch.from_numpy(views.viewmats[0]).float(),
            torch.full((1, 4, 4), 1 / 20.0),
        )
        assert not valid.any()

    def test_variance_counts_the_views_that_see(self) -> None:
        warped = torch.tensor([1.0, 3.0, 100.0]).reshape(3, 1, 1, 1, 1)
        valid = torch.tensor([True, True, False]).reshape(3, 1, 1, 1)
        variance, share = variance_cost(warped, valid)
        assert float(variance) == pytest.approx(1.0)
        assert float(share) == pytest.approx(2 / 3)

    def test_distribution(self) -> None:
        probability = torch.tensor([0.5, 0.25, 0.25], dtype=torch.float64)
        inverse = torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)
        mean, deviation, entropy = depth_distribution(
            probability.log()[:, None, None], inverse[:, None, None]
        )
        assert float(mean) == pytest.approx(2.0)
        assert float(deviation) == pytest.approx(math.sqrt(0.5 + 1.0), rel=1e-6)
        assert float(entropy) == pytest.approx(1.5 * math.log(2) / math.log(3))

    def test_normalised_grey_is_invariant_to_gain_and_offset(self) -> None:
        image = torch.rand(1, 3, 20, 20, generator=torch.Generator().manual_seed(0))
        torch.testing.assert_close(
            locally_normalised(image), locally_normalised(0.5 * image + 0.2), atol=0.01, rtol=0.01
        )

    def test_windows_end_at_the_mask(self) -> None:
        image = torch.rand(1, 3, 20, 24)
        mask = torch.ones(1, 20, 24, dtype=torch.bool)
        mask[:, :, 10:] = False
        cut = locally_normalised(image[..., :10])
        found = locally_normalised(image, mask)
        torch.testing.assert_close(found[..., :10], cut, atol=1e-4, rtol=1e-4)
        assert not found[..., 10:].any()
        every = torch.ones_like(mask)
        torch.testing.assert_close(locally_normalised(image, every), locally_normalised(image))

    def test_untrained_stereo_finds_a_slanted_plane(self) -> None:
        """The hand-crafted cost alone; source views are darker the farther they are, as under a lamp."""
        views = cameras(np.array([[0.0, 0, 0], [2.5, 0, 0], [-2.5, 0.5, 0], [0, 2, 0], [0, -2, 0]]))
        rgb, z = seen(views)
        sources = views[[1, 2, 3, 4]]
        dimmed = rgb[1:] * np.array([1.0, 0.8, 0.6, 0.7])[:, None, None, None]
        network = StereoNetwork(TINY.model_copy(update={"coarse_planes": 32, "fine_planes": 8}))
        with torch.no_grad():
            encoded = network.encode(PosedImages.of((dimmed * 255).astype(np.uint8), sources))
            K, viewmat = torch.from_numpy(views.K[0]).float(), torch.from_numpy(views.viewmats[0]).float()
            prior = network(encoded, K, viewmat, RANGE, WIDTH, HEIGHT)
        inner = slice(6, -6), slice(6, -6)
        coarse_z = z[0, 0::2, 0::2] / 2 + z[0, 1::2, 1::2] / 2
        coarse = 1 / prior.coarse_inverse.numpy()
        fine = 1 / prior.inverse.numpy()
        assert np.median(np.abs(fine - z[0])[inner]) < 0.03 * np.median(z[0])
        # The plane is slanted: one depth for all would not do.
        constant = np.abs(z[0] - np.median(z[0]))[inner]
        assert np.median(np.abs(fine - z[0])[inner]) < 0.25 * np.median(constant)
        error = np.abs(coarse - coarse_z)[3:-3, 3:-3]
        assert np.median(np.abs(fine - z[0])[inner]) < np.median(error) + 1e-3
        assert ((prior.uncertainty >= 0) & (prior.uncertainty <= 1)).all()

    def test_without_overlap_stereo_is_uncertain(self) -> None:
        views = cameras(np.array([[0.0, 0, 0], [2.5, 0, 0], [-2.5, 0.5, 0], [500.0, 0, 0], [520.0, 0, 0]]))
        rgb, _ = seen(views)
        network = StereoNetwork(TINY)
        K, viewmat = torch.from_numpy(views.K[0]).float(), torch.from_numpy(views.viewmats[0]).float()
        found = []
        for chosen in ([1, 2], [3, 4]):
            encoded = network.encode(PosedImages.of((rgb[chosen] * 255).astype(np.uint8), views[chosen]))
            prior = network(encoded, K, viewmat, RANGE, WIDTH, HEIGHT).detached()
            found.append(float(prior.uncertainty.mean()))
        assert found[0] < 0.9 < 0.98 < found[1]


class TestVolumeRendering:
    def test_weights_against_a_plain_sum(self) -> None:
        generator = np.random.default_rng(1)
        density, lengths = generator.gamma(1.0, size=(6, 9)), generator.gamma(1.0, size=(6, 9))
        expected = np.zeros_like(density)
        for ray in range(6):
            left = 1.0
            for sample in range(9):
                alpha = 1 - math.exp(-density[ray, sample] * lengths[ray, sample])
                expected[ray, sample] = left * alpha
                left *= 1 - alpha
        found = blending_weights(torch.from_numpy(density), torch.from_numpy(lengths))
        np.testing.assert_allclose(found.numpy(), expected, atol=1e-12)

    def test_gradient(self) -> None:
        generator = torch.Generator().manual_seed(0)
        density, lengths = torch.rand(2, 3, 5, generator=generator, dtype=torch.float64)
        assert torch.autograd.gradcheck(blending_weights, (density.requires_grad_(), lengths))

    def test_a_wall_is_seen_where_it_is(self) -> None:
        z = torch.tensor([[10.0, 20.0, 30.0, 40.0]])
        rgb = torch.eye(4)[None, :, :3]
        found = composited(torch.tensor([[0.0, 0.0, 50.0, 0.0]]), rgb, z, torch.ones(1), 10.0)
        assert found.rgb is not None
        torch.testing.assert_close(found.rgb, torch.tensor([[0.0, 0.0, 1.0]]))
        assert (float(found.depth), float(found.median_depth)) == (30.0, 30.0)
        assert float(found.alpha) == pytest.approx(1.0)

    def test_samples_gather_round_a_certain_prior(self) -> None:
        inverse = torch.tensor([0.05, 0.05])
        z = sample_depths(inverse, torch.tensor([1e-4, 0.02]), RANGE, 4, 32)
        assert (z.diff(dim=1) >= 0).all()
        near = ((1 / z - 0.05).abs() < 0.004).float().mean(dim=1)
        assert near[0] > 0.85
        assert near[1] < 0.3
        assert ((z >= 10 - 1e-4) & (z <= 40 + 1e-4)).all()

    def test_drawn_samples_stay_in_their_strata(self) -> None:
        z = sample_depths(
            torch.full((50,), 0.05), torch.full((50,), 0.01), RANGE, 3, 1, torch.Generator().manual_seed(0)
        )
        assert (1 / z).min() >= RANGE[0] - 1e-6
        assert not torch.equal(z[0], z[1])


class TestField:
    def test_rays_are_those_of_the_cameras(self) -> None:
        from extrags.cameras import pixel_rays

        views = cameras(np.array([[0.0, 0, 0], [1, 2, 3]]))[1]
        K, viewmat = torch.from_numpy(views.K[0]), torch.from_numpy(views.viewmats[0])
        rays = Rays(torch.tensor([[3.5, 7.5]], dtype=torch.float64), K, viewmat, WIDTH, HEIGHT)
        np.testing.assert_allclose(rays.directions[0].numpy(), pixel_rays(views)[0, 7, 3], atol=1e-12)
        np.testing.assert_allclose(rays.center.numpy(), views.centers[0], atol=1e-12)

    def test_gradient_of_the_conditioned_field(self) -> None:
        """Central differences in float64, on parameters of each part.

        Not of the coarse level: the place of the fine hypotheses is taken from it without gradient.
        """
        torch.manual_seed(0)
        config = TINY.model_copy(update={"width": 8})
        views = cameras(np.array([[0.0, 0, 0], [2.5, 0, 0], [-2.5, 0.5, 0]]))
        rgb, _ = seen(views)
        stereo, field = StereoNetwork(config).double(), ConditionedField(config).double()
        images = PosedImages.of((rgb[1:] * 255).astype(np.uint8), views[[1, 2]])
        images = PosedImages(images.rgb.double(), images.K.double(), images.viewmats.double())
        K, viewmat = torch.from_numpy(views.K[0]), torch.from_numpy(views.viewmats[0])
        pixels = torch.tensor([[20.5, 11.5], [30.5, 25.5]], dtype=torch.float64)
        rays = Rays(pixels, K, viewmat, WIDTH, HEIGHT)
        z = torch.linspace(12, 35, 6, dtype=torch.float64).expand(2, -1)
        with torch.no_grad():
            for module in (field.adaptive, stereo.regularisers):
                for parameter in module.parameters():
                    parameter.add_(0.1 * torch.randn_like(parameter))

        def loss() -> torch.Tensor:
            encoded = stereo.encode(images)
            prior = stereo(encoded, K, viewmat, RANGE, WIDTH, HEIGHT)
            found = field(rays, z, encoded, prior, RANGE, torch.zeros(3).double(), 20.0)
            return found.rgb.square().sum() + found.depth.sum() / 20

        loss().backward()
        chosen = [
            field.trunk[0].weight, field.score[0].weight, field.own.bias, field.adaptive[2].bias,
            stereo.encoders[1][2].weight, stereo.regularisers[1].across.weight,
        ]  # fmt: skip
        for parameter in chosen:
            assert parameter.grad is not None
            place = int(parameter.grad.abs().argmax())
            flat = parameter.data.view(-1)
            kept, step, values = float(flat[place]), 1e-6, []
            for sign in (1, -1):
                flat[place] = kept + sign * step
                values.append(float(loss().detach()))
            flat[place] = kept
            expected = (values[0] - values[1]) / (2 * step)
            assert float(parameter.grad.view(-1)[place]) == pytest.approx(expected, rel=1e-4, abs=1e-8)
            assert expected != 0


class TestLosses:
    def test_consistency_is_least_at_the_true_depth(self) -> None:
        views = cameras(np.array([[0.0, 0, 0], [2.5, 0, 0], [-2.5, 0.5, 0]]))
        rgb, z = seen(views)
        images = PosedImages.of((rgb * 255).astype(np.uint8), views)
        inverse = torch.from_numpy(1 / z[0]).float()
        weight = torch.ones_like(inverse)
        losses = [
            float(photometric_consistency(images[[0]], images[[1, 2]], share * inverse, weight))
            for share in (0.85, 1.0, 1.15)
        ]
        assert losses[1] < 0.5 * min(losses[0], losses[2])

    def test_gradient_loss_ignores_scale_and_what_is_uncertain(self) -> None:
        depth = 10 + torch.rand(2, 6, 6, generator=torch.Generator().manual_seed(0))
        one = torch.ones_like(depth)
        assert float(scale_invariant_gradient(3 * depth, depth, one)) == pytest.approx(0, abs=1e-6)
        ramp = depth * torch.exp(0.1 * torch.arange(6.0))
        assert float(scale_invariant_gradient(ramp, depth, one)) == pytest.approx(0.1, rel=1e-3)
        assert float(scale_invariant_gradient(ramp, depth, 0 * one)) == 0

    def test_smoothness_spares_edges_of_the_image(self) -> None:
        step = torch.ones(6, 6)
        step[:, 3:] = 2.0
        edge = (step - 1).expand(3, -1, -1)
        assert float(edge_aware_smoothness(step, edge)) < 0.01 * float(
            edge_aware_smoothness(step, torch.zeros(3, 6, 6))
        )


class TestSparseDepth:
    def test_depth_is_used_at_a_few_corners_alone(self) -> None:
        sequence = slanted_plane()
        found = sparse_depths(sequence, sequence.train, 24)
        for item, frame in zip(found, sequence.train, strict=True):
            assert 4 <= len(item.z) <= 24
            column, row = item.pixels.astype(int).T
            assert sequence.depth_mm is not None
            np.testing.assert_allclose(item.z, sequence.depth_mm[frame][row, column])

    def test_points_behind_the_surface_are_dropped(self) -> None:
        sequence = slanted_plane()
        rays = unproject_pixels(np.random.default_rng(0).uniform(4, 36, size=(40, 2)), sequence.K[0])
        points = np.concatenate([20 * rays, 60 * rays])
        (found,) = sparse_depths(replace(sequence, points=points, depth_mm=None), np.array([3]), 24)
        assert len(found.z) >= 20
        assert found.z.max() < 40

    @pytest.mark.parametrize("source", ["depth", "points"])
    def test_a_frame_without_depth_ends_no_training(
        self, source: str, caplog: pytest.LogCaptureFixture
    ) -> None:
        sequence = slanted_plane()
        assert sequence.depth_mm is not None
        first, second = sequence.train[:2]
        mask, depth_mm = sequence.mask.copy(), sequence.depth_mm.copy()
        if source == "depth":
            depth_mm[first] = 0
            sequence = replace(sequence, depth_mm=depth_mm)
        else:
            rays = unproject_pixels(np.random.default_rng(0).uniform(4, 36, size=(40, 2)), sequence.K[0])
            mask[first] = False
            sequence = replace(sequence, points=20 * rays, depth_mm=None, mask=mask)
        with caplog.at_level("WARNING", logger="extrags.baselines.uc_nerf.training"):
            found = sparse_depths(sequence, sequence.train, 24)
        assert len(found[0].z) == 0
        assert len(found[1].z) >= 4
        assert f"in 1 of {len(sequence.train)} training frames" in caplog.text
        assert f"({sequence.frame_name(int(first))})" in caplog.text
        assert sequence.frame_name(int(second)) not in caplog.text
        if source == "depth":
            history = train(sequence, TINY.model_copy(update={"iterations": len(sequence.train)})).history
            assert all(np.isfinite(entry["loss"]) for entry in history)

    def test_depth_at_too_few_pixels_of_all_frames_is_an_error(self) -> None:
        sequence = slanted_plane()
        assert sequence.depth_mm is not None
        depth_mm = np.zeros_like(sequence.depth_mm)
        depth_mm[:, 20, 20] = 20
        with pytest.raises(CaptureError, match=r"none of \d+ training frames has 4 pixels of known depth"):
            sparse_depths(replace(sequence, depth_mm=depth_mm), sequence.train, 24)

    def test_cameras_alone_must_do(self, caplog: pytest.LogCaptureFixture) -> None:
        """Neither depth nor points: colours supervise, between depths that follow from the cameras."""
        sequence = replace(slanted_plane(), depth_mm=None)
        with caplog.at_level("WARNING", logger="extrags.baselines.uc_nerf.training"):
            result = train(sequence, TINY.model_copy(update={"iterations": 2}))
        assert "colours alone supervise" in caplog.text
        assert all(np.isfinite(entry["loss"]) for entry in result.history)
        far, near = result.scene.inverse_range
        assert 0 < far < 1 / result.scene.scale < near

    def test_one_place_is_an_error(self) -> None:
        sequence = slanted_plane()
        assert sequence.world_from_camera is not None
        still = np.repeat(sequence.world_from_camera[:1], len(sequence), axis=0)
        with pytest.raises(CaptureError, match="slanted/0: neither depth nor sparse points"):
            train(replace(sequence, depth_mm=None, world_from_camera=still), TINY)

    def test_two_frames_are_an_error(self) -> None:
        sequence = slanted_plane(frames=4, held_out=2)
        with pytest.raises(CaptureError, match="2 training frames"):
            train(sequence, TINY)


class TestTraining:
    def test_held_out_views_beat_a_constant_colour(self, trained: UcNerf) -> None:
        sequence = slanted_plane()
        views = rendering.render(trained, sequence)
        target = sequence.rgb[sequence.test] / 255
        error = np.square(views.rgb - target).mean()
        constant = np.square(target - target.mean(axis=(0, 1, 2))).mean()
        assert error < 0.25 * constant
        assert sequence.depth_mm is not None
        depth = sequence.depth_mm[sequence.test]
        assert np.corrcoef(views.depth_mm.ravel(), depth.ravel())[0, 1] > 0.6
        assert views.n_gaussians is None
        assert views.alpha.min() > 0.99

    def test_surface(self, trained: UcNerf) -> None:
        mesh = rendering.surface(trained, slanted_plane())
        assert mesh is not None
        assert len(mesh.triangles) > 100

    def test_a_training_frame_is_no_source_of_its_own(
        self, trained: UcNerf, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Its pixels change the views of other frames, and not its own colours and depth."""
        sequence = slanted_plane()
        frame, other = int(sequence.train[2]), int(sequence.train[3])
        rgb = trained.rgb.copy()
        rgb[2] = 255 - rgb[2]
        scenes = (trained, replace(trained, rgb=rgb))
        first, second = (rendering.render(scene, sequence, np.array([frame, other])) for scene in scenes)
        np.testing.assert_array_equal(first.rgb[0], second.rgb[0])
        assert np.abs(first.rgb[1] - second.rgb[1]).max() > 0

        fused: list[np.ndarray] = []
        monkeypatch.setattr(rendering, "surface_from_renders", lambda _, depth: fused.append(depth))
        for scene in scenes:
            rendering.surface(scene, sequence)
        np.testing.assert_array_equal(fused[0][frame], fused[1][frame])
        assert np.abs(fused[0][other] - fused[1][other]).max() > 0

    def test_frames_through_a_lens_are_refused(self) -> None:
        bent = replace(slanted_plane(), lens=RadialLens((-0.1, 0.0, 0.0, 0.0), 0.9))
        with pytest.raises(ConfigError, match=r"uc_nerf renders pinholes.*ingest\.lens=pinhole"):
            train(bent, TINY)

    def test_loading_gives_the_same_renders(self, trained: UcNerf, tmp_path: Path) -> None:
        trained.save(tmp_path / "uc_nerf")
        loaded = UcNerf.load(tmp_path / "uc_nerf")
        sequence = slanted_plane()
        views = [rendering.render(scene, sequence) for scene in (trained, loaded)]
        for name in ("rgb", "alpha", "depth_mm"):
            np.testing.assert_array_equal(getattr(views[0], name), getattr(views[1], name))

    def test_held_out_frames_are_never_looked_at(self) -> None:
        sequence = slanted_plane()
        blind = sequence.rgb.copy()
        blind[sequence.test] = 255
        config = TINY.model_copy(update={"iterations": 3})
        first, second = train(sequence, config), train(replace(sequence, rgb=blind), config)
        for one, other in zip(
            first.scene.network.parameters(), second.scene.network.parameters(), strict=True
        ):
            assert torch.equal(one, other)

    def test_pixels_outside_the_masks_have_no_influence(self) -> None:
        """Neither in training nor, as sources that colours are blended from, in rendering."""
        mask = np.zeros((len(slanted_plane()), HEIGHT, WIDTH), dtype=bool)
        mask[:, 4:-3, 5:-4] = True
        masked = replace(slanted_plane(), mask=mask)
        noise = np.random.default_rng(0).integers(0, 256, masked.rgb.shape, dtype=np.uint8)
        other = replace(masked, rgb=np.where(mask[..., None], masked.rgb, noise))
        config = TINY.model_copy(update={"iterations": 6})
        first, second = (
            rendering.render(train(sequence, config).scene, masked) for sequence in (masked, other)
        )
        np.testing.assert_array_equal(first.rgb, second.rgb)
        np.testing.assert_array_equal(first.depth_mm, second.depth_mm)
        whole = rendering.render(train(replace(masked, mask=np.ones_like(mask)), config).scene, masked)
        assert np.abs(whole.rgb - first.rgb).max() > 0

    def test_the_seed_alone_decides(self) -> None:
        sequence, found, events = slanted_plane(), [], []
        threads = torch.get_num_threads()
        for seed, count in ((0, 1), (0, 2), (1, 1)):
            torch.manual_seed(count)
            torch.set_num_threads(count)
            with subscribed(events.append):
                config = TINY.model_copy(update={"iterations": 3, "seed": seed})
                found.append(train(sequence, config))
        torch.set_num_threads(threads)
        assert found[0].history == found[1].history != found[2].history
        assert isinstance(events[0], Progress)
        assert (events[0].stage, events[0].total) == ("coarse", 3)

    def test_sources_are_the_most_similar_views(self) -> None:
        views = cameras(np.array([[0.0, 0, 0], [5, 0, 0], [1, 0, 0], [-3, 0, 0]]))
        assert nearest_views(views[0], views, 20.0).tolist() == [0, 2, 3, 1]
