"""From the size that depth is estimated at to that of the frames."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from extrags.config import DepthConfig
from extrags.depth import estimate
from extrags.depth.stereo import StereoDepth
from tests.extrags.depth.withheld import with_points, withheld_phantom


def test_pixels_at_the_rim_take_nothing_from_outside() -> None:
    """Outside the mask the small depth is anything."""
    sequence = with_points(withheld_phantom(2)).training_part()
    height, width = sequence.height, sequence.width
    v, u = np.mgrid[:height, :width] + 0.5
    disc = np.hypot(u - width / 2, v - height / 2) < 0.45 * min(height, width)
    sequence = replace(sequence, mask=np.tile(disc, (len(sequence), 1, 1)))
    small = torch.from_numpy(disc[: height // 4 * 4, : width // 4 * 4].astype(np.float32))[None, None]
    known = torch.nn.functional.avg_pool2d(small, 4)[0] == 1
    known = known.expand(len(sequence), -1, -1)
    log_depth = torch.where(known, 1.0, 9.0)
    error = torch.where(known, 0.05, 0.5)
    depth, expected = estimate._at_full_size(sequence, known, log_depth, error)
    np.testing.assert_allclose(depth[sequence.mask], np.exp(1), rtol=1e-5)
    np.testing.assert_allclose(expected[sequence.mask], 0.05, rtol=1e-5)
    assert not depth[~sequence.mask].any()


@pytest.mark.parametrize("shading", [True, False])
def test_without_shading_light_tells_the_network_nothing(
    monkeypatch: pytest.MonkeyPatch, shading: bool
) -> None:
    shown = []
    inputs = estimate.completion_inputs

    def looked_at(frames: estimate.PosedFrames, stereo: StereoDepth) -> Any:
        shown.append(stereo.prior_scatter)
        return inputs(frames, stereo)

    monkeypatch.setattr(estimate, "completion_inputs", looked_at)
    sequence = with_points(withheld_phantom(5, width=64, height=48)).training_part()
    estimate.estimate_depth(sequence, DepthConfig(hypotheses=24, sources=3, shading=shading))
    assert shown
    assert all(bool(torch.isfinite(scatter).all()) == shading for scatter in shown)


def test_a_mask_that_is_too_fine_for_the_smaller_size_leaves_no_frame_without_depth(
    caplog: pytest.LogCaptureFixture,
) -> None:
    sequence = with_points(withheld_phantom(5, width=64, height=48)).training_part()
    masks = np.array(sequence.mask)
    masks[1] &= np.arange(64) % 3 == 0
    striped = replace(sequence, mask=masks)
    settings = DepthConfig(hypotheses=24, sources=3, max_width=32)
    whole, found = (estimate.estimate_depth(given, settings) for given in (sequence, striped))
    assert "masks of 1 of 5 frames" in caplog.text
    ratio = found.depth[1][masks[1]] / whole.depth[1][masks[1]]
    assert 0.9 < np.median(ratio) < 1.1
    assert not found.depth[1][~masks[1]].any()
