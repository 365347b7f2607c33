"""Objects in front of the surface, by what other frames see behind them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from extrags.carried_depth import CHECKED_FRAMES, CarriedDepth
from extrags.config import IngestConfig
from extrags.foreground_objects import LEAST_AREA, foreground_objects, without_foreground_objects
from extrags.observed_surface import observed_by_depth
from extrags.reading_corrections import with_corrections
from extrags.sequence import EndoscopicSequence
from tests.benchmarks.wrong_recordings import with_instrument
from tests.extrags.depth.withheld import recorded
from tests.extrags.test_measured_depth import displaced


@pytest.fixture(scope="module")
def exact() -> EndoscopicSequence:
    return recorded(10, 96, 72)


@pytest.fixture(scope="module")
def instrument(exact: EndoscopicSequence) -> tuple[EndoscopicSequence, np.ndarray]:
    return with_instrument(exact)


def found_in(sequence: EndoscopicSequence) -> dict[int, np.ndarray]:
    carried = CarriedDepth.of(sequence)
    assert carried is not None
    return foreground_objects(carried)


def test_an_instrument_is_found(instrument: tuple[EndoscopicSequence, np.ndarray]) -> None:
    sequence, shown = instrument
    found = found_in(sequence)
    # Nothing looks back to where the first frame stands.
    assert set(found) <= {0, 3, 6, 9}
    assert {3, 6, 9} <= set(found)
    for frame, pixels in found.items():
        assert pixels.shape == shown[frame].shape
        assert (pixels & shown[frame]).sum() > 0.9 * shown[frame].sum()
        # A pixel round it is masked with it.
        assert (pixels & ~shown[frame]).sum() < 0.5 * shown[frame].sum()


def test_one_in_every_frame_is_found_too(exact: EndoscopicSequence) -> None:
    sequence, shown = with_instrument(exact, every=1)
    found = found_in(sequence)
    assert len(found) >= 7
    covered = [(found[k] & shown[k]).sum() / shown[k].sum() for k in found]
    assert np.median(covered) > 0.8


def test_it_is_found_through_smooth_errors_of_depth(exact: EndoscopicSequence) -> None:
    sequence, shown = with_instrument(exact)
    assert sequence.depth_mm is not None
    factors = 1 + 0.03 * np.random.default_rng(1).normal(size=(len(sequence), 1, 1))
    found = found_in(replace(sequence, depth_mm=(sequence.depth_mm * factors).astype(np.float32)))
    assert {3, 6, 9} <= set(found)
    assert set(found) <= {0, 3, 6, 9}
    assert all((found[k] & shown[k]).sum() > 0.8 * shown[k].sum() for k in (3, 6, 9))


def test_surface_alone_is_no_object(exact: EndoscopicSequence) -> None:
    assert found_in(exact) == {}
    assert without_foreground_objects(exact, CarriedDepth.of(exact)) is exact
    assert without_foreground_objects(exact, None) is exact


def test_folds_are_none_where_poses_are_a_little_off(exact: EndoscopicSequence) -> None:
    assert found_in(displaced(exact, 1.0, 0.5)) == {}


def test_what_is_nearly_on_the_surface_is_none(exact: EndoscopicSequence) -> None:
    assert exact.depth_mm is not None
    depth = np.array(exact.depth_mm)
    depth[4, 20:50, 30:60] *= 0.95
    assert found_in(replace(exact, depth_mm=depth)) == {}


def test_specks_are_none(exact: EndoscopicSequence) -> None:
    assert exact.depth_mm is not None
    depth = np.array(exact.depth_mm)
    depth[4, 30:34, 40:43] *= 0.4
    assert LEAST_AREA * depth[4].size > 12
    assert found_in(replace(exact, depth_mm=depth)) == {}


def test_the_frames_are_masked(
    instrument: tuple[EndoscopicSequence, np.ndarray], caplog: pytest.LogCaptureFixture
) -> None:
    sequence, _ = instrument
    seen = observed_by_depth(sequence.cameras, sequence.mask, sequence.depth_mm, sequence.split)
    given = replace(sequence, observed=seen)
    found = with_corrections(given)
    assert found.depth_mm is not None
    assert sequence.depth_mm is not None
    for frame, pixels in found_in(sequence).items():
        assert not found.mask[frame][pixels].any()
        assert not found.depth_mm[frame][pixels].any()
        assert np.array_equal(found.mask[frame][~pixels], sequence.mask[frame][~pixels])
        assert np.array_equal(found.depth_mm[frame][~pixels], sequence.depth_mm[frame][~pixels])
    for frame in (1, 2, 10):
        assert np.array_equal(found.mask[frame], sequence.mask[frame])
    assert np.array_equal(found.rgb, sequence.rgb)
    assert "of 10 training frames, 000" in caplog.text
    assert "look through, as an instrument; it is masked (up to" in caplog.text
    assert found.observed is not None
    expected = observed_by_depth(found.cameras, found.mask, found.depth_mm, found.split)
    assert np.array_equal(found.observed, expected & seen)
    assert found.observed.sum() < seen.sum()


def test_on_request_they_are_not(instrument: tuple[EndoscopicSequence, np.ndarray]) -> None:
    sequence, _ = instrument
    found = with_corrections(sequence, IngestConfig(mask_foreground=False, depth_error=0.0))
    assert np.array_equal(found.mask, sequence.mask)


def test_where_all_seems_in_front_nothing_is_masked(
    exact: EndoscopicSequence, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("extrags.foreground_objects.MOST_FRAMES_AREA", 0.01)
    sequence, _ = with_instrument(exact, every=1)
    assert without_foreground_objects(sequence, CarriedDepth.of(sequence)) is sequence
    assert "more than instruments can; nothing is masked" in caplog.text


def test_of_many_frames_all_are_looked_at(exact: EndoscopicSequence, monkeypatch: pytest.MonkeyPatch) -> None:
    sequence, _ = with_instrument(exact, every=2)
    monkeypatch.setattr("extrags.foreground_objects.CHECKED_FRAMES", 4)
    monkeypatch.setattr("extrags.carried_depth.CHECKED_FRAMES", 4)
    assert len(sequence.train) < CHECKED_FRAMES
    monkeypatch.setattr("extrags.carried_depth.LEAST_PAIRS", 1)
    # Of these the sixth alone is among the four that tell whether there is anything.
    assert {4, 6, 8} <= set(found_in(sequence))
