"""Frames of another light, by what features of both show."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

from extrags.config import IngestConfig
from extrags.reading_corrections import with_corrections
from extrags.sequence import EndoscopicSequence
from extrags.splits import Split
from extrags.switched_light import _mixing, light_switch, with_matched_light
from tests.benchmarks.wrong_recordings import WRONG
from tests.extrags.depth.withheld import recorded

RARE = [4, 5, 6, 7]
"""Of twelve frames, those of the middle third."""


@pytest.fixture(scope="module")
def white() -> EndoscopicSequence:
    """Without poses and depth, which nothing here asks for."""
    sequence = recorded(12, 160, 128)
    return replace(sequence, world_from_camera=None, depth_mm=None, metric=False)


@pytest.fixture(scope="module")
def switched(white: EndoscopicSequence) -> EndoscopicSequence:
    return WRONG["narrow band"](white)


def difference(first: EndoscopicSequence, second: EndoscopicSequence, frame: int) -> float:
    """Root mean square of 255, inside the mask."""
    shown = [np.asarray(sequence.rgb[frame], float)[first.mask[frame]] for sequence in (first, second)]
    return float(np.sqrt(np.square(shown[0] - shown[1]).mean()))


def test_frames_of_another_light_are_found(switched: EndoscopicSequence) -> None:
    found = light_switch(switched)
    assert found is not None
    assert found.frames.tolist() == RARE
    assert found.matches > 200
    assert found.left < 0.4 * found.difference


def test_they_get_the_colours_of_the_others(
    white: EndoscopicSequence, switched: EndoscopicSequence, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, logger="extrags"):
        matched = with_matched_light(switched)
    (record,) = caplog.records
    assert "4 of 12 training frames, 0004 first" in record.getMessage()
    assert record.__dict__["field"] == "rgb"
    for frame in RARE:
        # Most of the red is lost, and what is left of it carries the noise of 8 bits.
        assert difference(matched, white, frame) < 0.45 * difference(switched, white, frame)
    others = np.setdiff1d(np.arange(len(white)), RARE)
    np.testing.assert_array_equal(matched.rgb[others], white.rgb[others])
    np.testing.assert_array_equal(matched.split.test, white.split.test)
    # Once matched there is nothing more to match.
    assert with_matched_light(matched) is matched


def test_more_frames_decide_what_light_the_others_get(switched: EndoscopicSequence) -> None:
    kept = replace(switched, split=Split("most", np.arange(3, 10), np.array([12])))
    found = light_switch(kept)
    assert found is not None
    # Of seven frames three are of white light, and so is the one that is held out.
    assert found.frames.tolist() == [3, 8, 9, 12]
    matched = with_matched_light(kept)
    # It is the only one that is held out, and stays.
    assert matched.split.test.tolist() == [12]
    np.testing.assert_array_equal(matched.rgb[12], kept.rgb[12])
    assert difference(matched, kept, 3) > 5


@pytest.mark.parametrize("first", [0, 4])
def test_of_as_many_of_both_white_light_stays(switched: EndoscopicSequence, first: int) -> None:
    kept = replace(switched, split=Split("half", np.arange(first, first + 8), np.array([12])))
    found = light_switch(kept)
    assert found is not None
    assert found.frames.tolist() == RARE


def test_frames_that_show_no_colour_are_of_no_light(switched: EndoscopicSequence) -> None:
    rgb = np.array(switched.rgb)
    rgb[9] = 3
    rgb[0] = np.where(rgb[0] > 100, 255, 0)
    mask = np.array(switched.mask)
    mask[12] = False
    found = light_switch(replace(switched, rgb=rgb, mask=mask))
    assert found is not None
    assert found.frames.tolist() == RARE


def test_held_out_frames_of_the_rarer_light_are_left_out(switched: EndoscopicSequence) -> None:
    train = np.setdiff1d(np.arange(12), [5])
    kept = replace(switched, split=Split("held out", train, np.array([5, 12])))
    matched = with_matched_light(kept)
    assert matched.split.test.tolist() == [12]
    np.testing.assert_array_equal(matched.split.train, train)
    # What is held out is never changed.
    np.testing.assert_array_equal(matched.rgb[5], kept.rgb[5])


def test_frames_of_one_light_stay(white: EndoscopicSequence) -> None:
    assert with_matched_light(white) is white
    # One color for all frames is no switch, however strange.
    everywhere = np.asarray(white.rgb)[..., [1, 2, 2]]
    assert light_switch(replace(white, rgb=everywhere)) is None


def test_other_tissue_is_no_other_light(white: EndoscopicSequence) -> None:
    # Frames that show something else in other colours: no feature of theirs tells that light has changed.
    rgb = np.array(white.rgb)
    noise = np.random.default_rng(0).integers(0, 80, (len(RARE), *rgb.shape[1:3], 1))
    rgb[RARE] = noise * np.array([1.0, 1.2, 1.3])
    assert light_switch(replace(white, rgb=rgb)) is None


def test_haze_is_no_other_light(white: EndoscopicSequence) -> None:
    # Smoke in a third of the frames, or in all others.
    for hazy in (RARE, np.setdiff1d(np.arange(12), RARE)):
        rgb = np.array(white.rgb)
        rgb[hazy] = np.rint(255 * (0.65 * (rgb[hazy] / 255.0) ** 2.2 + 0.1) ** (1 / 2.2))
        veiled = replace(white, rgb=rgb)
        assert light_switch(veiled) is None


def test_recordings_side_by_side_tell_nothing(switched: EndoscopicSequence) -> None:
    # No frame of one light follows on one of the other within a recording.
    recording = np.zeros(len(switched), np.int64)
    recording[RARE] = 1
    assert light_switch(replace(switched, recording=recording)) is None


def test_large_frames_are_matched_at_a_smaller_size(switched: EndoscopicSequence) -> None:
    large = replace(
        switched,
        rgb=np.repeat(np.repeat(switched.rgb, 5, axis=1), 5, axis=2),
        mask=np.repeat(np.repeat(switched.mask, 5, axis=1), 5, axis=2),
        specular=None,
    )
    found = light_switch(large)
    assert found is not None
    assert found.frames.tolist() == RARE


def test_colours_that_are_mixed_exactly_have_a_map() -> None:
    colors = np.random.default_rng(0).uniform(0.2, 0.8, (100, 3))
    np.testing.assert_allclose(_mixing(colors, colors), np.eye(3), atol=0.01)


def test_two_frames_are_too_few(switched: EndoscopicSequence) -> None:
    assert light_switch(replace(switched, split=Split("two", np.array([3, 4]), np.array([12])))) is None


def test_a_setting_leaves_them(switched: EndoscopicSequence) -> None:
    assert with_corrections(switched, IngestConfig(match_light=False)) is switched
    assert light_switch(with_corrections(switched)) is None
