"""Frames that share geometry with others, and match none of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from extrags.config import DepthConfig
from extrags.depth.estimate import DepthEstimate, estimate_depth
from extrags.depth.frames import PosedFrames
from extrags.depth.shading import ShadingFit
from extrags.depth.stereo import StereoDepth, StereoSettings, multi_view_stereo
from extrags.depth.unmatched import UNKNOWN_SCALE_ERROR, scale_error, unmatched_frames
from extrags.sequence import EndoscopicSequence
from tests.extrags.depth.planes import tilted_plane
from tests.extrags.depth.withheld import true_training_depth, with_points, withheld_phantom

SETTINGS = DepthConfig(hypotheses=48, sources=4)
BAD = 4
SLOW = pytest.mark.slow


@pytest.fixture(scope="module")
def withheld() -> EndoscopicSequence:
    return with_points(withheld_phantom())


@pytest.fixture(scope="module")
def ordinary(withheld: EndoscopicSequence) -> DepthEstimate:
    return estimate_depth(withheld.training_part(), SETTINGS)


@pytest.mark.parametrize(
    "kind",
    ["black", pytest.param("red", marks=SLOW), pytest.param("noise", marks=SLOW), "mirrored"],
)
def test_a_picture_of_something_else_is_told_to_be_a_guess(
    kind: str, withheld: EndoscopicSequence, ordinary: DepthEstimate
) -> None:
    part = withheld.training_part()
    rgb = part.rgb.copy()
    rgb[BAD] = {
        "black": np.zeros_like(rgb[BAD]),
        "red": np.full_like(rgb[BAD], (180, 40, 30)),
        "noise": np.random.default_rng(0).integers(80, 160, rgb[BAD].shape, dtype=np.uint8),
        "mirrored": rgb[BAD, ::-1, ::-1],
    }[kind]
    found = estimate_depth(replace(part, rgb=rgb), SETTINGS)
    assert ordinary.report["frames_alone"] == 0
    assert found.report["frames_alone"] == 1
    truth = true_training_depth(withheld)
    known = (truth > 0) & part.mask
    off = np.abs(np.log(found.depth[BAD][known[BAD]] / truth[BAD][known[BAD]]))
    assert off.mean() < 2 * found.expected_error[BAD][known[BAD]].mean()
    assert found.expected_error[BAD][part.mask[BAD]].min() > 0.3
    # The others are told as before, but for having one source less.
    others = np.flatnonzero(np.arange(len(part)) != BAD)
    medians = [np.median(each.expected_error[others][part.mask[others]]) for each in (found, ordinary)]
    assert medians[0] < 1.5 * medians[1]


@pytest.fixture(scope="module")
def plane() -> tuple[PosedFrames, StereoDepth]:
    frames, depth = tilted_plane()
    sources = torch.tensor([[1, 2], [0, 2], [1, 3], [2, 4], [3, 2]])
    near, far = torch.full((5,), 0.8), torch.full((5,), 5.0)
    settings = StereoSettings(hypotheses=16, radius_px=2)
    return frames, multi_view_stereo(frames, sources, near, far, settings, monocular=1 / depth)


def test_depths_that_agree_by_chance_confirm_nothing(plane: tuple[PosedFrames, StereoDepth]) -> None:
    frames, stereo = plane
    ones = torch.ones_like(stereo.cost)
    alike = replace(stereo, agrees=ones, seen=ones, cost=0.2 * ones)
    assert not unmatched_frames(alike, frames.mask).any()
    unlike = alike.cost.clone()
    unlike[1] = 0.9
    apart = alike.agrees.clone()
    apart[3] = 0
    found = unmatched_frames(
        replace(alike, cost=unlike, agrees=apart, n_sources=torch.tensor([0, 2, 2, 2, 2])), frames.mask
    )
    assert found.tolist() == [True, True, False, True, False]
    assert unmatched_frames(alike, torch.zeros_like(frames.mask)).all()


def test_only_what_nothing_matches_has_an_error_of_its_scale(plane: tuple[PosedFrames, StereoDepth]) -> None:
    _, stereo = plane
    fit = ShadingFit(0.5, torch.tensor([0.0, 9.0, 0.1, 0.2, -7.0]), 0.3, 0.2, 1000)
    given = replace(stereo, n_sources=torch.tensor([2, 0, 2, 1, 2]), fits=[fit])
    found = scale_error(given, torch.tensor([False, True, False, False, True]))
    # As far as the intercepts of those differ that are matched; more where a frame has sources all the same.
    spread = float(np.std([0.0, 0.1, 0.2], ddof=1))
    torch.testing.assert_close(found, torch.tensor([0.0, spread, 0.0, 0.0, UNKNOWN_SCALE_ERROR]))


def test_without_any_fit_nothing_is_known_of_the_scale(plane: tuple[PosedFrames, StereoDepth]) -> None:
    _, stereo = plane
    none = ShadingFit(0.0, torch.zeros(5), float("inf"), float("inf"), 0)
    found = scale_error(replace(stereo, fits=[none]), torch.ones(5, dtype=torch.bool))
    torch.testing.assert_close(found, torch.full((5,), UNKNOWN_SCALE_ERROR))
