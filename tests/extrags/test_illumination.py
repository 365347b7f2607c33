from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from extrags.config import LightConfig
from extrags.errors import DamagedArtefactError, ShapeError
from extrags.illumination import NearFieldLight
from extrags.zarr_io import new_group, write_array


def light() -> NearFieldLight:
    return NearFieldLight(
        torch.tensor(-1.5), torch.tensor(0.7).log(), torch.tensor([0.1, -0.2, 0.4]), 25.0
    )  # fmt: skip


class TestNearFieldLight:
    def test_round_trip_keeps_scalars_scalar(self, tmp_path: Path) -> None:
        light().save(tmp_path / "light")
        loaded = NearFieldLight.load(tmp_path / "light")
        for name, value in light().parameters().items():
            assert torch.equal(loaded.parameters()[name], value), name
            assert loaded.parameters()[name].shape == value.shape
        assert loaded.reference_distance == 25.0

    def test_gauge_is_fixed(self) -> None:
        assert float(light().falloff(torch.tensor(25.0))) == pytest.approx(1)
        log_exposures = torch.stack([light().exposure(frame) for frame in range(3)]).log()
        assert float(log_exposures.mean()) == pytest.approx(0, abs=1e-6)
        assert float(light().exposure(None)) == 1

    def test_formula_in_float64(self) -> None:
        c, e = torch.tensor(-1.5).exp().double(), 0.7
        distance = torch.tensor([2.0, 10.0, 60.0], dtype=torch.float64)
        expected = ((1 + c) / ((distance / 25) ** 2 + c)) ** e
        torch.testing.assert_close(light().falloff(distance.float()).double(), expected, rtol=1e-5, atol=0)

    def test_farther_is_darker_and_far_away_it_is_a_power_law(self) -> None:
        far = torch.tensor([5e3, 1e4])
        first, second = light().falloff(far)
        assert float(second / first) == pytest.approx(2 ** (-2 * 0.7), rel=1e-3)
        distance = torch.linspace(0, 100, 50)
        assert bool((light().falloff(distance).diff() < 0).all())

    def test_switched_off_parts_start_without_effect(self) -> None:
        off = ("falloff", "spread", "cosine", "response", "specular", "glare")
        dark = NearFieldLight.initial(2, 25.0, LightConfig(**dict.fromkeys(off, False)))
        points = torch.tensor([[0.0, 0.0, 3.0], [30.0, 5.0, 40.0]])
        normals = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
        torch.testing.assert_close(dark.gain(points, normals), torch.ones(2))
        assert torch.equal(dark.apply_response(points), points)
        assert torch.equal(dark.specular_gain(points, normals), torch.zeros(2))

    @pytest.mark.parametrize("missing", ["log_specular", "log_glare", "spread"])
    def test_of_what_is_stored_only_what_came_later_may_be_missing(
        self, missing: str, tmp_path: Path
    ) -> None:
        """Lights of before there were highlights, or glare, have none."""
        with new_group(tmp_path / "light") as group:
            for name, value in NearFieldLight.initial(2, 25.0).parameters().items():
                if name not in (missing, "log_roughness"):
                    write_array(group, name, value.numpy())
            group.attrs["reference_distance"] = 25.0
        if missing == "spread":
            with pytest.raises(DamagedArtefactError, match="spread"):
                NearFieldLight.load(tmp_path / "light")
        else:
            loaded = NearFieldLight.load(tmp_path / "light").parameters()[missing]
            assert bool((loaded == -torch.inf).all())

    def test_albedo_is_what_the_light_and_the_response_leave(self) -> None:
        start = NearFieldLight.initial(1, 25.0)
        albedo = torch.tensor([[0.2, 0.4, 0.6], [0.9, 0.5, 0.1]])
        points = torch.tensor([[4.0, -3.0, 20.0], [0.0, 10.0, 60.0]])
        normals = torch.nn.functional.normalize(torch.tensor([[0.3, 0.2, -1.0], [0.0, -1.0, 0.3]]), dim=-1)
        highlights = start.specular_gain(points, normals)
        assert float(highlights.max()) > 1e-3
        seen = start.apply_response(albedo * start.gain(points, normals)[:, None] + highlights[:, None])
        torch.testing.assert_close(start.albedo(seen, points, normals), albedo)

    @pytest.mark.parametrize("axis", [-1, 1])
    def test_glare_lies_over_the_image_and_is_taken_away(self, axis: int) -> None:
        veiled = replace(
            NearFieldLight.initial(1, 25.0),
            log_glare=torch.tensor([0.1, 0.03, 0.05], dtype=torch.float64).log(),
        )
        signal = torch.rand(2, 4, 3, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        signal = signal.movedim(2, axis)
        image = veiled.apply_response(signal, axis)
        torch.testing.assert_close(veiled.invert_response(image, axis), signal)
        black = veiled.apply_response(torch.zeros_like(signal), axis).movedim(axis, -1)
        assert bool((black[..., 0] > black[..., 2]).all())
        assert bool((black[..., 2] > black[..., 1]).all())
        # What is darker than the glare sends nothing.
        assert bool((veiled.invert_response(torch.zeros_like(signal), axis) == 0).all())

    def test_falloff_is_the_gain_of_surfaces_that_face_the_lens(self) -> None:
        start = NearFieldLight.initial(1, 25.0)
        points = torch.tensor([[4.0, -3.0, 20.0], [0.0, 10.0, 60.0]])
        distance = points.norm(dim=-1)
        torch.testing.assert_close(start.falloff(distance, points[:, 2] / distance), start.gain(points))

    def test_walls_that_slant_and_rays_off_the_axis_are_darker_by_their_powers(self) -> None:
        near = torch.tensor([25.0, 25.0, 25.0])
        slanting = replace(light(), cosine=torch.tensor(0.8))
        facing = torch.tensor([1.0, -0.5, 0.2])
        expected = ((facing.square() + 0.04) / 1.04) ** 0.4
        torch.testing.assert_close(slanting.falloff(near, None, facing), expected)
        spread = replace(light(), spread=torch.tensor(2.0))
        cosine = torch.tensor([1.0, 0.8, 0.05])
        torch.testing.assert_close(spread.falloff(near, cosine), cosine.clamp_min(0.1) ** 2)

    def test_exposures_follow_frames_in_whatever_order_they_were_trained(self) -> None:
        train = np.array([6, 0, 2])
        own = light().exposures().log()
        gains = light().interpolated_exposures(np.array([1, 4]), train).log()
        torch.testing.assert_close(gains, torch.stack([(own[1] + own[2]) / 2, (own[2] + own[0]) / 2]))

    def test_exposures_of_another_recording_do_not_count(self) -> None:
        train, recording = np.array([0, 2, 4]), np.array([0, 0, 0, 1, 1, 1])
        own = light().exposures()
        gains = light().interpolated_exposures(np.array([1, 3, 5]), train, recording)
        between = (own[0].log() + own[1].log()) / 2
        torch.testing.assert_close(gains, torch.stack([between.exp(), own[2], own[2]]))

    def test_exposures_within_the_second_recording_follow_its_own_frames(self) -> None:
        train, recording = np.array([8, 0, 2, 6]), np.repeat([0, 1], 5)
        lamp = replace(light(), log_exposure=torch.tensor([0.4, -0.2, 0.1, -0.5]))
        own = lamp.exposures().log()
        frames = np.array([1, 4, 5, 7, 9])
        expected = [(own[1] + own[2]) / 2, own[2], own[3], (own[3] + own[0]) / 2, own[0]]
        gains = lamp.interpolated_exposures(frames, train, recording).log()
        torch.testing.assert_close(gains, torch.stack(expected))

    def test_a_highlight_brighter_than_the_picture_leaves_no_albedo(self) -> None:
        start = NearFieldLight.initial(1, 25.0)
        points, normals = torch.tensor([[0.0, 0.0, 20.0]]), torch.tensor([[0.0, 0.0, -1.0]])
        seen = start.apply_response(0.5 * start.specular_gain(points, normals)[:, None].expand(1, 3))
        assert seen.min() > 1e-4
        assert start.albedo(seen, points, normals).abs().max() == 0

    def test_exposure_of_held_out_frames(self) -> None:
        """Interpolated inside a recording that was trained on, the mean elsewhere."""
        train = np.array([0, 2, 6])
        recording = np.array([0, 0, 0, 0, 0, 0, 0, 1, 1])
        gains = light().interpolated_exposures(np.array([1, 4, 7, 8]), train, recording)
        own = light().exposures().log()
        expected = torch.stack([(own[0] + own[1]) / 2, (own[1] + own[2]) / 2, own[0] * 0, own[0] * 0])
        torch.testing.assert_close(gains.log(), expected)
        torch.testing.assert_close(light().interpolated_exposures(train, train), light().exposures())

    def test_exposures_that_scatter_are_averaged(self) -> None:
        train = np.delete(np.arange(120), np.arange(2, 120, 4))
        scatter = 0.05 * np.random.default_rng(0).normal(size=len(train))
        lamp = replace(light(), log_exposure=torch.from_numpy((scatter - scatter.mean()).astype(np.float32)))
        frames = np.arange(2, 120, 4)
        between = lamp.interpolated_exposures(frames, train).log()
        interpolated = np.interp(frames, train, scatter - scatter.mean())
        assert between.square().mean().sqrt() < 0.6 * np.sqrt(np.mean(interpolated**2))
        torch.testing.assert_close(lamp.interpolated_exposures(train, train), lamp.exposures())

    def test_exposures_that_drift_are_followed_through_their_scatter(self) -> None:
        train = np.delete(np.arange(120), np.arange(2, 120, 4))
        drift = 0.3 * np.sin(np.arange(120) / 15)
        drift -= drift[train].mean()
        scatter = 0.05 * np.random.default_rng(1).normal(size=len(train))
        scatter -= scatter.mean()
        lamp = replace(light(), log_exposure=torch.from_numpy((drift[train] + scatter).astype(np.float32)))
        frames = np.arange(2, 120, 4)
        error = lamp.interpolated_exposures(frames, train).log().numpy() - drift[frames]
        interpolated = np.interp(frames, train, drift[train] + scatter) - drift[frames]
        assert np.sqrt(np.mean(error**2)) < 0.7 * np.sqrt(np.mean(interpolated**2))

    @pytest.mark.parametrize("values", [np.sin(np.arange(30) / 2), np.repeat([-0.3, 0.3], 15)])
    def test_exposures_that_change_smoothly_or_at_once_are_interpolated(self, values: np.ndarray) -> None:
        train = np.arange(0, 60, 2)
        lamp = replace(light(), log_exposure=torch.from_numpy((values - values.mean()).astype(np.float32)))
        frames = np.arange(1, 60, 6)
        expected = np.interp(frames, train, values - values.mean())
        np.testing.assert_allclose(lamp.interpolated_exposures(frames, train).log(), expected, atol=1e-6)

    def test_a_frame_in_a_long_pause_has_the_exposure_of_the_nearest(self) -> None:
        train = np.concatenate([np.arange(0, 40, 2), np.arange(20_000, 20_040, 2)])
        scatter = 0.02 * np.random.default_rng(2).normal(size=40)
        values = np.repeat([-0.4, 0.4], 20) + scatter - scatter.mean()
        lamp = replace(light(), log_exposure=torch.from_numpy(values.astype(np.float32)))
        gains = lamp.interpolated_exposures(np.array([15, 60, 19_000, 20_011]), train).log()
        assert gains[:2].max() < -0.3
        assert gains[2:].min() > 0.3

    def test_exposures_of_other_frames_are_refused(self) -> None:
        exposures = len(light().log_exposure)
        train = np.arange(exposures + 1)
        with pytest.raises(
            ShapeError, match=f"log_exposure has {exposures} exposures, there are {exposures + 1}"
        ):
            light().interpolated_exposures(train, train)
