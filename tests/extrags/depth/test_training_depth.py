"""Estimated depth stays with training frames, and never passes for the truth."""

from __future__ import annotations

import numpy as np
import pytest

from extrags.depth.estimate import DepthEstimate
from extrags.depth.training_depth import with_training_depth
from extrags.errors import ShapeError
from extrags.sequence import EndoscopicSequence
from tests.extrags.depth.withheld import withheld_phantom


@pytest.fixture(scope="module")
def withheld() -> EndoscopicSequence:
    return withheld_phantom(4, width=24, height=20)


def made_up(frames: int, height: int, width: int) -> DepthEstimate:
    """An estimate with a depth of its own for each frame."""
    depth = np.broadcast_to(
        np.arange(1, frames + 1, dtype=np.float32)[:, None, None], (frames, height, width)
    )
    points = np.zeros((20, 3))
    return DepthEstimate(depth.copy(), 0.1 * depth, points, np.zeros((20, 3), np.uint8))


def test_the_training_part_has_it_and_no_truth(withheld: EndoscopicSequence) -> None:
    part = withheld.training_part()
    found = with_training_depth(part, made_up(4, 20, 24))
    assert found.depth_mm is not None
    assert found.depth_error is not None
    np.testing.assert_array_equal(found.depth_mm[:, 0, 0], [1, 2, 3, 4])
    assert found.points is not None
    assert found.training_depth_known
    assert found.true_depth_mm is None
    assert part.depth_mm is None


def test_held_out_frames_of_the_whole_have_none(withheld: EndoscopicSequence) -> None:
    found = with_training_depth(withheld, made_up(4, 20, 24))
    assert found.depth_mm is not None
    assert found.depth_error is not None
    np.testing.assert_array_equal(found.depth_mm[found.train][:, 0, 0], [1, 2, 3, 4])
    assert not found.depth_mm[found.test].any()
    assert not found.depth_error[found.test].any()
    # What was withheld is still the truth.
    np.testing.assert_array_equal(found.true_depth_mm, withheld.withheld_depth_mm)
    part = found.training_part()
    assert part.depth_error is not None
    np.testing.assert_array_equal(
        part.depth_error[:, 0, 0], np.float32(0.1) * np.arange(1, 5, dtype=np.float32)
    )


def test_another_number_of_frames_is_refused(withheld: EndoscopicSequence) -> None:
    with pytest.raises(ShapeError, match="3 depth maps for 4 training frames"):
        with_training_depth(withheld, made_up(3, 20, 24))
