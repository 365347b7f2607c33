from __future__ import annotations

import gc
import inspect
import weakref
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from extrags.config import CoarseConfig, FinetuneConfig
from extrags.pseudo_views import PseudoViews
from extrags.raster import native
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training import finetuning
from extrags.training.finetuning import finetune
from extrags.training.optimise import TrainingResult
from extrags.training.reconstruction import coarse_schedule
from extrags.training.step import AutogradStep, NativeStep, Observation
from extrags.training.strategies import density_strategy
from extrags.training.views import View, in_steps, real_views
from extrags.training.virtual_views import virtual_views
from tests.extrags.training.plain_finetuning import masked
from tests.second_device import DEVICE, second_device

CONFIG = CoarseConfig()


def in_floats(view: View) -> View:
    """The same view as it was held before images were compact: everything in float32."""
    return replace(view, rgb=view.colors, weight=view.weights)


def plain_view(sequence: EndoscopicSequence, frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours, weights and depth of a frame, each as a float32 image of its own."""
    assert sequence.depth_mm is not None
    weight = sequence.supervised_mask(frame) & (sequence.rgb[frame] < 250).any(axis=-1)
    depth = np.where(sequence.mask[frame], sequence.depth_mm[frame], 0)
    return (
        sequence.rgb[frame].astype(np.float32) / 255,
        weight.astype(np.float32),
        depth.astype(np.float32),
    )


class TestRealViews:
    def test_images_are_those_of_the_frames_bit_by_bit(self, sequence: EndoscopicSequence) -> None:
        changed = masked(sequence)
        for view, frame in zip(real_views(changed, changed.train), changed.train, strict=True):
            rgb, weight, depth = plain_view(changed, int(frame))
            assert view.depth_mm is not None
            assert np.array_equal(view.colors.numpy(), rgb)
            assert np.array_equal(view.weights.numpy(), weight)
            assert np.array_equal(view.depth_mm.numpy(), depth)
            assert 0 < weight.mean() < 1

    def test_a_saturated_channel_tells_that_there_is_at_least_so_much(
        self, sequence: EndoscopicSequence
    ) -> None:
        rgb = sequence.rgb.clip(0, 249)
        rgb[sequence.train[0], 3:5, 4:9, 0] = 250
        rgb[sequence.train[0], 6, 4:9] = 255
        first, second = real_views(replace(sequence, rgb=rgb, specular=None), sequence.train[:2])
        assert first.saturated is not None
        assert np.array_equal(first.saturated.numpy(), rgb[sequence.train[0]] >= 250)
        assert bool((first.weights[3:5, 4:9] == 1).all())
        # White altogether: a wall that is too near, or a highlight.
        assert bool((first.weights[6, 4:9] == 0).all())
        assert second.saturated is None

    def test_a_pixel_takes_one_byte_besides_the_sequence(self, tube_sequence: EndoscopicSequence) -> None:
        frame = int(tube_sequence.train[0])
        assert tube_sequence.depth_mm is not None
        view = real_views(tube_sequence, tube_sequence.train)[0]
        assert view.depth_mm is not None
        assert view.rgb.data_ptr() == tube_sequence.rgb[frame].ctypes.data
        assert view.depth_mm.data_ptr() == tube_sequence.depth_mm[frame].ctypes.data
        assert view.weight.element_size() == 1

    def test_one_mask_of_all_frames_is_held_once(self, tube_sequence: EndoscopicSequence) -> None:
        mask = np.ones_like(tube_sequence.mask)
        mask[:, :3] = False
        mask[tube_sequence.train[-1], 3] = False
        views = real_views(replace(tube_sequence, mask=mask), tube_sequence.train)
        for view, frame in zip(views, tube_sequence.train, strict=True):
            assert view.shown is not None
            assert np.array_equal(view.shown.numpy(), mask[frame])
        held = {view.shown.data_ptr() for view in views if view.shown is not None}
        assert len(held) == 2
        assert len(views) > 2
        # Where all belongs to the picture nothing is held.
        plain = replace(tube_sequence, mask=np.ones_like(mask))
        assert all(view.shown is None for view in real_views(plain, plain.train))

    def test_frames_that_cannot_be_written_are_copied(self, sequence: EndoscopicSequence) -> None:
        fixed = sequence.rgb.copy()
        fixed.flags.writeable = False
        view = real_views(replace(sequence, rgb=fixed), sequence.train)[0]
        assert view.rgb.data_ptr() != fixed[sequence.train[0]].ctypes.data
        assert np.array_equal(view.rgb.numpy(), fixed[sequence.train[0]])

    @pytest.mark.parametrize("lit", [True, False])
    @pytest.mark.parametrize("kind", [NativeStep, AutogradStep])
    def test_loss_and_gradients_have_the_bits_of_float_images(
        self, scene: Scene, sequence: EndoscopicSequence, kind: type[NativeStep | AutogradStep], lit: bool
    ) -> None:
        if kind is NativeStep and native.native_isa() is None:
            pytest.skip("the native kernels are not built")
        start = scene if lit else Scene(scene.gaussians)
        changed = masked(sequence)
        view = real_views(changed, changed.train)[1]
        found, expected = (_differentiated(kind, start, item) for item in (view, in_floats(view)))
        assert found[0].loss == expected[0].loss
        assert found[1].keys() == expected[1].keys() != set()
        for name, gradient in expected[1].items():
            assert torch.equal(found[1][name], gradient), name
            assert bool(gradient.any()), name


def _differentiated(
    kind: type[NativeStep | AutogradStep], scene: Scene, view: View
) -> tuple[Observation, dict[str, torch.Tensor]]:
    schedule = coarse_schedule(CONFIG, 20.0, 15.0, "coarse")
    step = kind(scene, schedule)
    density = density_strategy(schedule.densify, 20.0, 30, len(scene.gaussians), seed=0)
    observation = step.differentiate(view, schedule.sh_every, density)
    if isinstance(step, NativeStep):
        assert step.direct is not None
        return observation, {
            name: gradient for name, gradient in step.direct.gradients.items() if name != "sh"
        } | {"sh0": step.direct.gradients["sh"][:, :1]}
    names = ("means", "quats", "scales", "opacities", "sh0")
    return observation, {name: _gradient(step.adam.parameters[name]) for name in names}


def _gradient(parameter: torch.Tensor) -> torch.Tensor:
    assert parameter.grad is not None
    return parameter.grad


class TestSteps:
    def test_every_step_is_found_and_decoded(self) -> None:
        steps = np.arange(256, dtype=np.uint8)
        values = steps.astype(np.float32) / np.float32(255)
        assert np.array_equal(in_steps(values).numpy(), steps)

    @pytest.mark.parametrize("value", [0.5, 1.7, -0.1, np.nan, np.nextafter(np.float32(1 / 255), 1)])
    def test_what_is_no_step_stays_as_it_is(self, value: float) -> None:
        values = np.array([0, value, 1], dtype=np.float32)
        assert in_steps(values).dtype == torch.float32
        assert np.array_equal(in_steps(values).numpy(), values, equal_nan=True)


class TestVirtualViews:
    @pytest.mark.parametrize("floor", [0.0, 0.1])
    def test_stored_ones_take_a_byte_per_value_and_have_the_same_bits(
        self, pseudo: PseudoViews, floor: float
    ) -> None:
        config = FinetuneConfig(confidence_floor=floor)
        below_one = replace(pseudo, pixel_confidence=pseudo.pixel_confidence.clip(0, 1)).quantised()
        for view, index in zip(virtual_views(below_one, config), (0, 2), strict=True):
            assert view.rgb.dtype == view.weight.dtype == torch.uint8
            assert np.array_equal(view.colors.numpy(), below_one.target[index])
            expected = np.maximum(below_one.pixel_confidence[index], floor).astype(np.float32)
            assert np.array_equal(view.weights.numpy(), expected)

    def test_weights_above_one_stay_floats(self, pseudo: PseudoViews) -> None:
        config = FinetuneConfig(confidence_floor=0.1)
        view = virtual_views(pseudo.quantised(), config)[0]
        assert view.weight.dtype == torch.float32
        assert np.array_equal(
            view.weights.numpy(), np.maximum(pseudo.quantised().pixel_confidence[0], np.float32(0.1))
        )

    def test_floats_are_dropped_while_the_scene_is_optimised(
        self,
        scene: Scene,
        sequence: EndoscopicSequence,
        pseudo: PseudoViews,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        made: list[weakref.ref[PseudoViews]] = []
        alive: list[bool] = []

        def stored() -> PseudoViews:
            views = pseudo.quantised()
            made.append(weakref.ref(views))
            return views

        def optimised(start: Scene, *_: object, **__: object) -> TrainingResult:
            gc.collect()
            alive.append(made[0]() is not None)
            return TrainingResult(start, [])

        monkeypatch.setattr(finetuning, "optimise", optimised)
        # A decorator would hold them: there is none but the checks of shapes, which tests alone have.
        assert wrappers(finetune) == wrappers(virtual_views)
        inspect.unwrap(finetune)(scene, sequence, stored(), FinetuneConfig(iterations=1))
        assert alive == [False]


def wrappers(function: Any) -> int:
    """How many decorators a function has."""
    return 1 + wrappers(function.__wrapped__) if hasattr(function, "__wrapped__") else 0


def test_views_decode_on_another_device(sequence: EndoscopicSequence) -> None:
    view = real_views(sequence, sequence.train)[0]
    with second_device():
        moved = view.to(DEVICE)
        assert moved.rgb.dtype == torch.uint8
        assert moved.colors.device == moved.weights.device == DEVICE
        assert torch.equal(moved.colors.cpu(), view.colors)
        assert torch.equal(moved.weights.cpu(), view.weights)
