"""Stacks of frames: what they hold, and where it lies."""

from __future__ import annotations

import errno
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest

from extrags import frame_stacks
from extrags.frame_stacks import FrameStack, empty_stack, frames_of, stacked

FRAMES = np.random.default_rng(0).normal(size=(5, 4, 6)).astype(np.float32)


@pytest.fixture(params=["in memory", "mapped"])
def mapped(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether every stack is a mapped file; temporary files lie in a folder of their own."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    if request.param == "mapped":
        monkeypatch.setattr(frame_stacks, "MAPPED_BYTES", 0)
    return bool(request.param == "mapped")


def test_an_empty_stack_is_zeros_where_it_should_lie(mapped: bool, tmp_path: Path) -> None:
    found = empty_stack((3, 2), bool)
    assert found.dtype == bool
    assert isinstance(found.base, np.memmap) == mapped
    assert not found.any()
    found[1] = True
    assert found.sum() == 2
    assert list(tmp_path.iterdir()) == []


def test_nothing_needs_no_file(mapped: bool) -> None:
    assert empty_stack((0, 4, 6), np.uint8).shape == (0, 4, 6)


@pytest.mark.usefixtures("mapped")
def test_frames_become_what_numpy_stacks() -> None:
    found = stacked(iter(FRAMES), len(FRAMES))
    assert found.dtype == FRAMES.dtype
    np.testing.assert_array_equal(found, FRAMES)


@pytest.mark.usefixtures("mapped")
def test_chosen_frames_are_a_copy() -> None:
    chosen = np.array([4, 0, 4])
    found = frames_of(FRAMES, chosen)
    np.testing.assert_array_equal(found, FRAMES[chosen])
    assert not np.shares_memory(found, FRAMES)


def test_frames_are_copied_when_they_are_taken_in() -> None:
    frame = np.ones((2, 2), dtype=np.uint8)
    stack = FrameStack(2)
    kept = stack.append(frame)
    frame[:] = 7
    stack.append(frame)
    assert np.shares_memory(kept, stack.array)
    assert int(kept.max()) == 1
    assert [int(image.max()) for image in stack] == [1, 7]


@pytest.mark.parametrize(
    ("shapes", "problem"),
    [
        ([(2, 2), (2, 3)], "frame 1 of 2"),
        ([(2, 2)] * 3, "further frame"),
        ([(2, 2)], "1 of 2 frames"),
    ],
)
def test_what_does_not_fit_is_refused(shapes: list[tuple[int, int]], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        stacked((np.zeros(shape) for shape in shapes), 2)


def test_a_file_is_as_large_as_its_stack_where_room_cannot_be_reserved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frame_stacks, "MAPPED_BYTES", 0)
    monkeypatch.delattr("os.posix_fallocate", raising=False)
    found = empty_stack((3, 1000, 500), np.uint8)
    found[:] = 3
    assert int(found.sum()) == 3 * found.size


def test_another_kind_of_numbers_is_refused() -> None:
    """Where numpy would take the wider one, half of the frames would be rounded."""
    with pytest.raises(ValueError, match="float64"):
        stacked(iter([np.zeros((2, 2), np.uint8), np.full((2, 2), 0.7)]), 2)


def test_a_file_system_that_reserves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_stacks, "MAPPED_BYTES", 0)

    def refuse(*_given: object) -> None:
        raise OSError(errno.EOPNOTSUPP, "not supported")

    monkeypatch.setattr("os.posix_fallocate", refuse, raising=False)
    true_write, sizes = os.pwrite, []

    def short(file: int, data: bytes, offset: int) -> int:
        sizes.append(true_write(file, data[:700_000], offset))
        return sizes[-1]

    monkeypatch.setattr("os.pwrite", short)
    found = empty_stack((3, 1000, 500), np.uint8)
    assert sum(sizes) == found.size
    assert len(sizes) > 2
