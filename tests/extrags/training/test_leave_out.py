"""Brief reconstructions are made as the scene was."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from extrags.config import CoarseConfig, LightConfig
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training import leave_out, reconstruct
from extrags.training.frame_weights import FrameWeights, frame_weights
from extrags.training.optimise import TrainingResult
from extrags.training.views import View
from tests.extrags.training.textured_plane import blurred_along_rows, changed, textured_plane

BRIEF = CoarseConfig(iterations=1, max_points=200)


@pytest.fixture(scope="module")
def blurred() -> EndoscopicSequence:
    """A plane; one of its frames is blurred."""
    plane = textured_plane()
    return changed(plane, 3, blurred_along_rows(plane.rgb[3], 9))


@pytest.fixture(scope="module")
def scene(blurred: EndoscopicSequence) -> Scene:
    return reconstruct(blurred, BRIEF).scene


def weights_of(
    scene: Scene,
    sequence: EndoscopicSequence,
    config: CoarseConfig,
    monkeypatch: pytest.MonkeyPatch,
    found: FrameWeights | None = None,
) -> dict[int, float]:
    """What each frame counts in a brief reconstruction without the first one."""
    weights: dict[int, float] = {}

    def looked_at(start: Scene, draw: Any, schedule: Any, **_more: Any) -> TrainingResult:
        for iteration in range(3 * len(sequence.train)):
            view: View = draw(iteration)
            weights[view.frame] = view.weight_factor
        return TrainingResult(start, [])

    monkeypatch.setattr(leave_out, "optimise", looked_at)
    kept = sequence.train[1:]
    leave_out.partial_scene(
        scene, sequence, config, kept, iterations=1, seed=0, stage="test", frame_weights=found
    )
    return {int(kept[place]): weight for place, weight in weights.items()}


def test_a_blurred_frame_counts_as_little_as_in_the_scene(
    scene: Scene, blurred: EndoscopicSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = frame_weights(blurred, blurred.train[1:])
    assert found is not None
    weights = weights_of(scene, blurred, BRIEF, monkeypatch)
    assert weights[3] < 0.7
    assert weights[3] == pytest.approx(found.weights[2])
    assert min(weight for frame, weight in weights.items() if frame != 3) == 1

    def never(*_given: object) -> None:
        pytest.fail("frames are compared again")

    monkeypatch.setattr("extrags.training.frame_weights.frame_weights", never)
    assert weights_of(scene, blurred, BRIEF, monkeypatch, found) == weights


@pytest.mark.parametrize("handling", ["ignore", "report"])
def test_where_frames_are_not_weighed_all_count_alike(
    scene: Scene, blurred: EndoscopicSequence, monkeypatch: pytest.MonkeyPatch, handling: str
) -> None:
    config = BRIEF.model_copy(update={"inconsistent_frames": handling})
    assert set(weights_of(scene, blurred, config, monkeypatch).values()) == {1.0}


def test_normals_count_where_they_did(
    scene: Scene, blurred: EndoscopicSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    terms = []

    def looked_at(start: Scene, draw: Any, schedule: Any, **_more: Any) -> TrainingResult:
        terms.append(schedule.normals)
        return TrainingResult(start, [])

    monkeypatch.setattr(leave_out, "optimise", looked_at)
    for weight in (0.0, 0.1):
        config = BRIEF.model_copy(update={"normal_weight": weight})
        leave_out.partial_scene(scene, blurred, config, np.arange(4), iterations=1, seed=0, stage="test")
    assert terms[0] is None
    assert terms[1] is not None


def test_they_start_from_pictures_of_one_exposure(
    blurred: EndoscopicSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = CoarseConfig(iterations=1, max_points=200, light=LightConfig(response=False))
    scene = reconstruct(blurred, config).scene
    assert scene.light is not None
    gains = np.exp(np.where(np.arange(len(blurred.train)) % 2 == 0, -0.3, 0.3))
    rgb = blurred.rgb.copy()
    for frame, gain in zip(blurred.train, gains, strict=True):
        rgb[frame] = (0.5 * gain * blurred.rgb[frame]).round()
    starts = []

    def looked_at(start: Scene, draw: Any, schedule: Any, **_more: Any) -> TrainingResult:
        starts.append(start.gaussians.sh0)
        return TrainingResult(start, [])

    monkeypatch.setattr(leave_out, "optimise", looked_at)
    even = (0.5 * blurred.rgb).round().astype(np.uint8)
    for pictures, exposures in ((even, np.ones_like(gains)), (rgb, gains)):
        light = replace(scene.light, log_exposure=torch.from_numpy(np.log(exposures)).float())
        leave_out.partial_scene(
            replace(scene, light=light), replace(blurred, rgb=pictures), config, blurred.train,
            iterations=1, seed=0, stage="test",
        )  # fmt: skip
    # Half a step of 8 bits, brightened by the darker half of these gains, in harmonics of degree 0.
    assert float((starts[0] - starts[1]).abs().max()) < 0.5 / 255 / (0.5 * np.exp(-0.3)) / 0.2821
