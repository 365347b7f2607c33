"""Haze and white balance of single frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from extrags.config import CoarseConfig, DensifyConfig, LightConfig, PipelineConfig
from extrags.errors import ShapeError
from extrags.illumination import NearFieldLight
from extrags.raster.light import ROW_LENGTH
from extrags.run_costs import Workload
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training import TrainingResult, as_reconstructed, reconstruct, reconstruction
from extrags.training.frame_colors import (
    BALANCE_PRIOR,
    FrameColorFit,
    FrameColors,
    colored,
    with_corrected_colors,
)
from extrags.training.optimise import optimise
from extrags.training.step import AutogradStep, NativeStep
from extrags.training.strategies import density_strategy
from extrags.training.views import real_views
from tests.extrags.training.shaken_tube import relative_error, shaken_scene, step_schedule


def light(glare: float = 0.1) -> NearFieldLight:
    given = NearFieldLight.initial(4, 12.0, LightConfig())
    return replace(given, log_glare=torch.full((3,), glare).log())


def fitted() -> FrameColorFit:
    fit, generator = FrameColorFit(4), np.random.default_rng(1)
    for _ in range(20):
        for frame in range(4):
            # Frame 2 is hazy.
            mean = np.array([-1 if frame == 2 else 1, 1, 0, -1])
            fit.step(generator.normal(mean, size=(4, 4)).astype(np.float32), frame)
    return fit


@pytest.mark.parametrize("glare", [0.0, 0.1])
def test_gradients_are_those_of_autograd(glare: float) -> None:
    fit, given = fitted(), light(glare)
    row = given.camera_light(given.exposure(1)[None]).packed()[0].requires_grad_()
    gradient = np.random.default_rng(4).normal(size=ROW_LENGTH).astype(np.float32)
    leaf = fit.leaf()
    lit = replace(given.camera_light(torch.ones(1)), exposure=row[None, :3], glare=row[13:16])
    shown = colored(lit, leaf, 2)
    plain = row.detach().numpy()
    applied = fit.applied(plain, 2)
    np.testing.assert_allclose(applied[:3], shown.exposure[0].detach(), rtol=1e-6)
    np.testing.assert_allclose(applied[13:16], shown.glare.detach(), rtol=1e-6)
    loss = shown.exposure[0] @ torch.from_numpy(gradient[:3])
    loss = loss + shown.glare @ torch.from_numpy(gradient[13:16])
    prior = BALANCE_PRIOR * leaf[:, 1:].square().mean()
    assert fit.prior() == pytest.approx(float(prior.detach()), rel=1e-6)
    (loss + prior).backward()
    before, own = fit.carried_back(gradient, plain, 2)
    assert row.grad is not None
    assert leaf.grad is not None
    np.testing.assert_allclose(own, leaf.grad.numpy(), rtol=1e-5, atol=1e-7)
    which = [0, 1, 2, 13, 14, 15]
    np.testing.assert_allclose(before[which], row.grad.numpy()[which], rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(before[3:13], gradient[3:13])


def test_what_there_is_hardly_any_of_goes_for_good() -> None:
    fit = fitted()
    fit.decide()
    found = fit.found()
    assert found is not None
    assert np.flatnonzero(found.haze).tolist() == [2]
    fit.step(np.full((4, 4), -1, np.float32), 0)
    again = fit.found()
    assert again is not None
    assert again.haze[0] == 0
    steady = FrameColorFit(4)
    steady.decide()
    assert steady.found() is None


def test_haze_and_balance_are_undone(tmp_path: Path) -> None:
    given = light()
    clear = np.random.default_rng(2).uniform(0.2, 0.8, (6, 8, 3)).astype(np.float32)
    colors = FrameColors(np.array([0.0, 0.3]), np.array([[0, 0, 0], [0.1, 0.0, -0.1]]))
    signal = given.invert_response(torch.from_numpy(clear)) * torch.tensor([0.1, 0.0, -0.1]).exp()
    seen = (given.apply_response(signal).square() + 0.3**2).sqrt()
    seen_rgb = (255 * seen).round().to(torch.uint8).numpy()
    colors.save(tmp_path / "colors")
    read = FrameColors.load(tmp_path / "colors")
    np.testing.assert_array_equal(read.haze, colors.haze)
    # Half a level of the hazy picture is one to one and a half of a dark clear one.
    assert np.abs(read.developed(seen_rgb, 1, given) / 255.0 - clear).max() < 2 / 255
    same = read.developed(seen_rgb, 0, given)
    assert np.abs(same.astype(int) - seen_rgb).max() <= 1


def test_training_frames_alone_are_corrected(tube_sequence: EndoscopicSequence) -> None:
    colors = FrameColors(np.full(4, 0.2), np.zeros((4, 3)))
    found = with_corrected_colors(tube_sequence, colors, light())
    changed = [bool((a != b).any()) for a, b in zip(found.rgb, tube_sequence.rgb, strict=True)]
    assert changed == [True, True, False, True, True, False]
    with pytest.raises(ShapeError, match="3 frames for 4"):
        with_corrected_colors(tube_sequence, FrameColors(np.zeros(3), np.zeros((3, 3))), light())


def test_both_steps_learn_the_same(tube_sequence: EndoscopicSequence) -> None:
    views = real_views(tube_sequence, tube_sequence.train)
    schedule = step_schedule(colors_decided_at=5)
    scene = shaken_scene(lit=True)
    steps = [NativeStep(scene, schedule), AutogradStep(scene, schedule)]
    for step in steps:
        density = density_strategy(schedule.densify, 20.0, 30, len(scene.gaussians), seed=0)
        for iteration in range(8):
            step.update(step.differentiate(views[iteration % 4], iteration, density), iteration)
    own, other = (step.colors.leaf().detach() for step in steps if step.colors is not None)
    assert float((own - FrameColorFit(6).leaf().detach()).abs().max()) > 0.01
    assert relative_error(own, other) < 1e-3


def hazy(sequence: EndoscopicSequence) -> EndoscopicSequence:
    rgb = np.array(sequence.rgb)
    rgb[1] = np.rint(np.sqrt(0.6 * (rgb[1] / 255.0) ** 2 + 0.3**2) * 255)
    return replace(sequence, rgb=rgb)


def test_a_hazy_frame_is_found_and_cleared(
    tube_sequence: EndoscopicSequence, caplog: pytest.LogCaptureFixture
) -> None:
    config = CoarseConfig(
        iterations=300, max_points=800, densify=DensifyConfig(enabled=False), one_sided=False
    )
    found = reconstruct(hazy(tube_sequence), config)
    assert found.corrects_frames
    assert found.colors is not None
    assert np.flatnonzero(found.colors.haze).tolist() == [1]
    assert found.colors.haze[1] == pytest.approx(0.3, abs=0.06)
    assert "1 of 4 training frames, 0001 first, show a veil" in caplog.text
    cleared = as_reconstructed(hazy(tube_sequence), found)
    dark = tube_sequence.rgb[1] < 60
    assert dark.any()
    assert np.abs(cleared.rgb[1][dark].astype(int) - 0.77 * tube_sequence.rgb[1][dark]).mean() < 12


def test_clear_frames_give_what_they_gave(tube_sequence: EndoscopicSequence) -> None:
    config = CoarseConfig(iterations=280, max_points=100, densify=DensifyConfig(enabled=False))
    off = config.model_copy(update={"light": LightConfig(frame_colors=False)})
    found, expected = (reconstruct(tube_sequence, settings) for settings in (config, off))
    assert found.colors is None
    assert torch.equal(found.scene.gaussians.means, expected.scene.gaussians.means)
    assert found.history == expected.history


@pytest.mark.parametrize(
    ("change", "rounds"),
    [
        # Numbered from 0, and the one after which it is decided is done.
        ({}, [43, 280]),
        # There is nothing to learn them with, and nothing to begin anew.
        ({"light": LightConfig(enabled=False)}, [280]),
        ({"light": LightConfig(frame_colors=False)}, [280]),
    ],
    ids=["learned", "without light", "switched off"],
)
def test_the_iterations_that_costs_count_are_done(
    tube_sequence: EndoscopicSequence,
    monkeypatch: pytest.MonkeyPatch,
    change: dict[str, object],
    rounds: list[int],
) -> None:
    config = CoarseConfig(iterations=280, max_points=100, densify=DensifyConfig(enabled=False))
    config, drawn = config.model_copy(update=change), []

    def counted(start: Scene, draw: Any, schedule: Any, **more: Any) -> TrainingResult:
        drawn.append(0)

        def one(iteration: int) -> Any:
            drawn[-1] += 1
            return draw(iteration)

        return optimise(start, one, schedule, **more)

    monkeypatch.setattr(reconstruction, "optimise", counted)
    assert reconstruct(tube_sequence, config).colors is None
    assert drawn == rounds
    work = Workload(20_480, 8, 4, 4, PipelineConfig(coarse=config))
    assert work.numbers()["iterations"] == sum(drawn)


@pytest.mark.parametrize(
    "change",
    [
        {"light": LightConfig(frame_colors=False)},
        {"train_on": "all"},
        # Too few iterations for so many frames.
        {"iterations": 90},
    ],
    ids=["switched off", "oracle", "few iterations"],
)
def test_it_is_not_learned(tube_sequence: EndoscopicSequence, change: dict[str, object]) -> None:
    config = CoarseConfig(iterations=280, max_points=100, densify=DensifyConfig(enabled=False))
    found = reconstruct(hazy(tube_sequence), config.model_copy(update=change))
    assert found.colors is None
