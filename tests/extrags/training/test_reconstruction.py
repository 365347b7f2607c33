from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from extrags.config import CoarseConfig, DensifyConfig, LightConfig
from extrags.errors import CaptureError, DivergedError
from extrags.events import Event, Progress, subscribed
from extrags.illumination import NearFieldLight
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, Split
from extrags.training import TrainingResult, reconstruct
from extrags.training.optimise import optimise
from extrags.training.reconstruction import coarse_schedule
from extrags.training.schedule import Schedule
from extrags.training.step import AutogradStep, NativeStep, Observation, TrainingStep
from extrags.training.views import View, real_views

MakeStep = Callable[[Scene, Schedule], TrainingStep]

QUIET = DensifyConfig(enabled=False)


def psnr_of(scene: Scene, sequence: EndoscopicSequence, frames: np.ndarray) -> float:
    with torch.no_grad():
        rgb = scene.render(sequence.cameras[frames]).rgb
    target = torch.from_numpy(sequence.rgb[frames].astype(np.float32) / 255)
    return float(-10 * (rgb - target).square().mean().log10())


@pytest.fixture(scope="module")
def result(tube_sequence: EndoscopicSequence) -> TrainingResult:
    return reconstruct(tube_sequence, CoarseConfig(iterations=250, max_points=600, densify=QUIET))


class TestReconstruct:
    def test_training_views_are_matched(
        self, tube_sequence: EndoscopicSequence, result: TrainingResult
    ) -> None:
        assert psnr_of(result.scene, tube_sequence, tube_sequence.train) > 28
        assert result.history[-1]["loss"] < 0.3 * result.history[0]["loss"]

    def test_held_out_views_gain_from_the_light(
        self, tube_sequence: EndoscopicSequence, result: TrainingResult
    ) -> None:
        unlit = CoarseConfig(iterations=250, max_points=600, densify=QUIET, light=LightConfig(enabled=False))
        plain = reconstruct(tube_sequence, unlit)
        test = tube_sequence.test
        gain = psnr_of(result.scene, tube_sequence, test) - psnr_of(plain.scene, tube_sequence, test)
        assert gain > 0.5

    def test_same_input_same_bits(self, tube_sequence: EndoscopicSequence) -> None:
        config = CoarseConfig(iterations=40, max_points=300)
        first, second = (reconstruct(tube_sequence, config).scene for _ in range(2))
        for name, value in first.gaussians.parameters().items():
            assert torch.equal(value, second.gaussians.parameters()[name]), name

    def test_held_out_frames_change_nothing(self, tube_sequence: EndoscopicSequence) -> None:
        config = CoarseConfig(iterations=20, max_points=300)
        rgb = tube_sequence.rgb.copy()
        rgb[tube_sequence.test] = 0
        first = reconstruct(tube_sequence, config).scene.gaussians
        second = reconstruct(replace(tube_sequence, rgb=rgb), config).scene.gaussians
        assert torch.equal(first.sh0, second.sh0)

    def test_exposures_are_told_apart(self, tube_sequence: EndoscopicSequence) -> None:
        rgb = tube_sequence.rgb.astype(np.float32)
        rgb[tube_sequence.train[0]] *= 0.8
        dimmed = replace(tube_sequence, rgb=rgb.round().astype(np.uint8))
        config = CoarseConfig(
            iterations=300, max_points=600, densify=QUIET,
            light=LightConfig(exposure_learning_rate=0.02, exposure_prior=0.001),
        )  # fmt: skip

        def first_to_third(sequence: EndoscopicSequence) -> float:
            light = reconstruct(sequence, config).scene.light
            assert light is not None
            return float(light.exposure(0) / light.exposure(2))

        # Against the undimmed frames: few views leave exposure and albedo some play either way.
        assert first_to_third(dimmed) / first_to_third(tube_sequence) == pytest.approx(0.8, abs=0.08)

    def test_an_automatic_exposure_is_learned(self, tube_sequence: EndoscopicSequence) -> None:
        """By the default settings, in the iterations of a brief profile, most of it."""
        rgb = tube_sequence.rgb.astype(np.float32)
        rgb[tube_sequence.train[0]] *= 0.7
        dimmed = replace(tube_sequence, rgb=rgb.round().astype(np.uint8))
        config = CoarseConfig(iterations=300, max_points=600)

        def first_to_third(sequence: EndoscopicSequence) -> float:
            light = reconstruct(sequence, config).scene.light
            assert light is not None
            return float(light.exposure(0) / light.exposure(2))

        assert 0.65 < first_to_third(dimmed) / first_to_third(tube_sequence) < 0.85

    def test_progress_is_told(self, tube_sequence: EndoscopicSequence) -> None:
        seen: list[Event] = []
        with subscribed(seen.append):
            reconstruct(tube_sequence, CoarseConfig(iterations=60, max_points=100), stage="fold")
        last = seen[-1]
        assert isinstance(last, Progress)
        assert (last.stage, last.done, last.total) == ("fold", 60, 60)
        assert set(last.values) == {"iteration", "loss", "psnr", "n_gaussians"}

    def test_no_frames(self, tube_sequence: EndoscopicSequence) -> None:
        empty = Split("none", np.array([], dtype=np.int64), np.arange(6))
        with pytest.raises(CaptureError, match="no training frames"):
            reconstruct(replace(tube_sequence, split=empty), CoarseConfig())

    def test_a_diverging_loss_names_iteration_and_group(self, tube_sequence: EndoscopicSequence) -> None:
        result = reconstruct(tube_sequence, CoarseConfig(iterations=1, max_points=100))
        views = real_views(tube_sequence, tube_sequence.train)
        poisoned = replace(views[0], rgb=torch.full_like(views[0].colors, float("nan")))

        def draw(iteration: int) -> View:
            return poisoned if iteration == 3 else views[0]

        schedule = coarse_schedule(CoarseConfig(iterations=10), 20.0, 15.0, "coarse")
        with pytest.raises(DivergedError, match=r"coarse.*iteration 3") as caught:
            optimise(result.scene, draw, schedule)
        kept = caught.value.last_good
        assert isinstance(kept, Scene)
        assert all(bool(torch.isfinite(value).all()) for value in kept.gaussians.parameters().values())

    @pytest.mark.parametrize("make_step", [NativeStep, AutogradStep])
    @pytest.mark.parametrize("group", ["means", "scales", "light"])
    @pytest.mark.parametrize("iterations", [3, 10])
    def test_a_parameter_that_leaves_float32_diverges(
        self, tube_sequence: EndoscopicSequence, iterations: int, group: str, make_step: MakeStep
    ) -> None:
        """Between two steps, or by the last one."""

        class Leaving:
            def __init__(self, scene: Scene, schedule: Schedule) -> None:
                self._step = make_step(scene, schedule)
                self.adam, self.differentiate = self._step.adam, self._step.differentiate

            @property
            def light(self) -> NearFieldLight | None:
                return self._step.light

            def update(self, observation: Observation, iteration: int) -> None:
                self._step.update(observation, iteration)
                if iteration == 2:
                    with torch.no_grad():
                        if group == "light":
                            assert self.light is not None
                            self.light.log_softening.fill_(100.0)
                        else:
                            self.adam.parameters[group][3, 1] = 100.0 if group == "scales" else float("nan")

        start = reconstruct(tube_sequence, CoarseConfig(iterations=1, max_points=100)).scene
        view = real_views(tube_sequence, tube_sequence.train)[0]
        schedule = coarse_schedule(CoarseConfig(iterations=iterations), 20.0, 15.0, "coarse")
        message = rf"coarse.*iteration 3 \(parameter group {group}\)"
        with pytest.raises(DivergedError, match=message) as caught:
            optimise(start, lambda _: view, schedule, make_step=Leaving)
        kept = caught.value.last_good
        assert isinstance(kept, Scene)
        with torch.no_grad():
            assert bool(kept.render(view.camera).rgb.isfinite().all())


def test_a_unit_too_large_for_the_near_plane_is_refused_without_light(
    tube_sequence: EndoscopicSequence,
) -> None:
    assert tube_sequence.depth_mm is not None
    assert tube_sequence.world_from_camera is not None
    poses = tube_sequence.world_from_camera.copy()
    poses[:, :3, 3] *= 1e-3
    small = replace(
        tube_sequence, world_from_camera=poses, depth_mm=tube_sequence.depth_mm * np.float32(1e-3)
    )
    with pytest.raises(CaptureError, match=r"the typical depth is 0\.0.* or enable coarse\.light"):
        reconstruct(small, CoarseConfig(iterations=5, light=LightConfig(enabled=False)))


@pytest.mark.parametrize(("per_point", "most"), [(1, 600), (16, 600), (64, None)])
def test_starting_points_are_no_more_than_the_pixels_allow(
    tube_sequence: EndoscopicSequence, per_point: int, most: int | None
) -> None:
    config = CoarseConfig(iterations=1, max_points=600, pixels_per_point=per_point, densify=QUIET)
    pixels = int(tube_sequence.mask[tube_sequence.train].sum())
    most = pixels // 64 if most is None else most
    count = len(reconstruct(tube_sequence, config).scene.gaussians)
    assert 0.7 * most < count <= most
