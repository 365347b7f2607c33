from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import torch

from extrags.errors import ShapeError
from extrags.evaluation import evaluate, render
from extrags.scene import Scene
from tests.extrags.lit_tube import Tube


def test_without_held_out_frames_there_is_nothing_to_evaluate_on(tube: Tube) -> None:
    split = replace(tube.sequence.split, test=np.zeros(0, dtype=np.int64))
    with pytest.raises(ShapeError, match=r"split.test is empty"):
        evaluate(tube.scene, replace(tube.sequence, split=split))


@pytest.mark.parametrize("train_on", ["train", "all"])
def test_held_out_frames_are_shown_at_the_exposure_that_is_known_of_them(
    tube: Tube, train_on: Literal["train", "all"]
) -> None:
    """That of the last training frame, which they come after; where all were trained on, their own."""
    sequence = tube.sequence
    assert tube.scene.light is not None
    count = len(sequence.train) if train_on == "train" else len(sequence)
    light = replace(tube.scene.light, log_exposure=torch.linspace(-0.4, 0.4, count))
    scene = Scene(tube.scene.gaussians, light)
    found = render(scene, sequence, train_on=train_on)
    frames = np.minimum(sequence.test, count - 1)
    with torch.no_grad():
        expected = scene.render(sequence.cameras[sequence.test], exposure=light.exposures()[frames])
    np.testing.assert_allclose(found.rgb, expected.rgb.numpy(), atol=1e-6)
