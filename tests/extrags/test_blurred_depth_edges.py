"""Blurred edges of depth, by what other frames see behind the points in the air."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from extrags.blurred_depth_edges import REACH, ramps, without_blurred_depth_edges
from extrags.carried_depth import CarriedDepth
from extrags.config import IngestConfig
from extrags.depth_votes import depth_votes
from extrags.reading_corrections import with_corrections
from extrags.sequence import EndoscopicSequence
from tests.benchmarks.wrong_recordings import WRONG, with_instrument
from tests.extrags.depth.withheld import recorded
from tests.extrags.test_measured_depth import displaced


@pytest.fixture(scope="module")
def exact() -> EndoscopicSequence:
    return recorded(10, 160, 128)


def with_blur(sequence: EndoscopicSequence, spread_px: float = 1.5) -> EndoscopicSequence:
    assert sequence.depth_mm is not None
    blurred = np.stack([cv2.GaussianBlur(depth, (0, 0), spread_px) for depth in sequence.depth_mm])
    return replace(sequence, depth_mm=np.where(sequence.depth_mm > 0, blurred, 0).astype(np.float32))


def found_in(sequence: EndoscopicSequence) -> EndoscopicSequence:
    return without_blurred_depth_edges(sequence, CarriedDepth.of(sequence))


def test_depth_between_surfaces_is_left_out(
    exact: EndoscopicSequence, caplog: pytest.LogCaptureFixture
) -> None:
    blurred = with_blur(exact)
    found = found_in(blurred)
    assert exact.depth_mm is not None
    assert blurred.depth_mm is not None
    assert found.depth_mm is not None
    train = exact.train
    off = np.abs(np.log(blurred.depth_mm[train] / exact.depth_mm[train])) > 0.1
    left_out = (found.depth_mm[train] == 0) & (blurred.depth_mm[train] > 0)
    assert off.mean() > 0.002
    assert (off & left_out).sum() > 0.6 * off.sum()
    assert left_out.mean() < 0.1
    kept = ~left_out
    assert np.array_equal(found.depth_mm[train][kept], blurred.depth_mm[train][kept])
    held_out = np.setdiff1d(np.arange(len(exact)), train)
    assert np.array_equal(found.depth_mm[held_out], blurred.depth_mm[held_out])
    assert np.array_equal(found.rgb, blurred.rgb)
    assert np.array_equal(found.mask, blurred.mask)
    assert "edges of depth are blurred: other frames look through" in caplog.text


def test_sharp_edges_stay(exact: EndoscopicSequence) -> None:
    assert found_in(exact) is exact
    assert without_blurred_depth_edges(exact, None) is exact


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_poses_that_are_off_are_no_blur(exact: EndoscopicSequence, factor: float) -> None:
    wrong = displaced(exact, factor, 0.5 * factor)
    assert found_in(wrong) is wrong


@pytest.mark.parametrize("change", ["smooth", "frames", "noise", "instruments"])
def test_other_errors_are_no_blur(exact: EndoscopicSequence, change: str) -> None:
    found = WRONG[change](exact)
    assert found_in(found) is found


def test_an_instrument_in_blurred_depth_is_masked_as_one(
    exact: EndoscopicSequence, caplog: pytest.LogCaptureFixture
) -> None:
    sequence, shown = with_instrument(exact)
    found = with_corrections(with_blur(sequence))
    masked = sequence.mask & ~found.mask
    in_sight = [k for k in np.flatnonzero(shown.any((1, 2))) if k != sequence.train[0]]
    assert (masked & shown)[in_sight].sum() > 0.7 * shown[in_sight].sum()
    assert "as an instrument" in caplog.text
    assert "edges of depth are blurred" in caplog.text


def test_blur_alone_is_no_instrument(exact: EndoscopicSequence, caplog: pytest.LogCaptureFixture) -> None:
    found = with_corrections(with_blur(exact))
    assert "edges of depth are blurred" in caplog.text
    assert "as an instrument" not in caplog.text
    assert np.array_equal(found.mask, exact.mask)


def test_on_request_depth_stays_as_it_is(exact: EndoscopicSequence) -> None:
    blurred = with_blur(exact)
    found = with_corrections(blurred, IngestConfig(depth_error=0.0))
    assert found.depth_mm is not None
    assert blurred.depth_mm is not None
    assert np.array_equal(found.depth_mm, blurred.depth_mm)


def step(width: int = 40, height: int = 30) -> np.ndarray:
    depth = np.full((height, width), 10.0)
    depth[:, width // 2 :] = 20.0
    return depth


def test_a_ramp_lies_between_two_level_surfaces() -> None:
    assert not ramps(step()).any()
    blurred = cv2.GaussianBlur(step(), (0, 0), 1.0)
    found = ramps(blurred)
    between = (np.log(blurred / 10) > 0.05) & (np.log(20 / blurred) > 0.05)
    assert found[between].all()
    assert not found[np.abs(np.log(blurred / 10)) < 0.03].any()
    assert np.array_equal(ramps(blurred.T), found.T)


def test_a_slope_is_no_ramp() -> None:
    assert not ramps(np.tile(10 * np.exp(0.03 * np.arange(40)), (30, 1))).any()


def test_unknown_depth_ends_a_ramp() -> None:
    blurred = cv2.GaussianBlur(step(), (0, 0), 1.0)
    blurred[:, 8:17] = 0
    assert not ramps(blurred).any()
    assert not ramps(np.zeros((30, 40))).any()


@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (2 * REACH, 2 * REACH)])
def test_small_pictures_have_few(shape: tuple[int, int]) -> None:
    assert not ramps(np.ones(shape)).any()


def test_votes_of_a_point_in_the_air(exact: EndoscopicSequence) -> None:
    carried = CarriedDepth.of(exact)
    assert carried is not None
    assert exact.depth_mm is not None
    others = carried.sources(np.array([4]))[4]
    pixels = np.array([60, 60, 20]), np.array([80, 30, 100])
    on_surface = depth_votes(carried, 4, others, pixels, 0.05, 0.3)
    assert not on_surface.looks_through.any()
    assert (on_surface.supports > 0).any()
    depth = np.array(exact.depth_mm)
    depth[exact.train[4]] *= 0.5
    near = CarriedDepth.of(replace(exact, depth_mm=depth))
    assert near is not None
    in_the_air = depth_votes(near, 4, others, pixels, 0.05, 0.3)
    seen = in_the_air.looks_through > 0
    assert seen.any()
    assert (in_the_air.clearly[seen] > 0).all()
    assert not in_the_air.supports[seen].any()
