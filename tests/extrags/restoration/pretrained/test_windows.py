from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from extrags.errors import ConfigError, ShapeError
from extrags.restoration.pretrained.windows import (
    Span,
    cross_faded,
    padded_to,
    plan_windows,
    valid_frame_count,
)


class TestPlanWindows:
    @given(count=st.integers(1, 80), length=st.integers(2, 20), overlap=st.integers(0, 8))
    def test_windows_cover_the_clip_and_overlap(self, count: int, length: int, overlap: int) -> None:
        if overlap >= length:
            return
        spans = plan_windows(count, length, overlap)
        assert spans[0].start == 0
        assert spans[-1].stop == count
        assert all(len(span) == min(length, count) for span in spans)
        for before, after in pairwise(spans):
            assert before.start < after.start
            assert before.stop - after.start >= overlap

    def test_a_short_clip_is_one_window(self) -> None:
        assert plan_windows(5, 16, 4) == [Span(0, 5)]

    def test_an_overlap_without_progress_is_refused(self) -> None:
        with pytest.raises(ConfigError, match="cannot overlap"):
            plan_windows(30, 8, 8)

    def test_an_empty_clip_is_refused(self) -> None:
        with pytest.raises(ShapeError):
            plan_windows(0, 8, 2)


class TestValidFrameCount:
    @given(needed=st.integers(1, 200), step=st.sampled_from([1, 4, 8]))
    def test_is_the_smallest_that_fits(self, needed: int, step: int) -> None:
        count = valid_frame_count(needed, step)
        assert count >= needed
        assert (count - 1) % step == 0
        assert count - step < needed

    def test_padding_repeats_the_last_frame(self) -> None:
        frames = np.arange(3.0)[:, None]
        assert padded_to(frames, 5)[:, 0].tolist() == [0, 1, 2, 2, 2]
        assert padded_to(frames, 2) is frames


class TestCrossFaded:
    @given(count=st.integers(1, 40), length=st.integers(2, 12), overlap=st.integers(0, 6))
    def test_what_windows_agree_on_stays(self, count: int, length: int, overlap: int) -> None:
        if overlap >= length:
            return
        clip = np.random.default_rng(count).random((count, 2, 3, 3)).astype(np.float32)
        spans = plan_windows(count, length, overlap)
        joined = cross_faded(spans, [clip[span.start : span.stop] for span in spans], overlap)
        assert np.abs(joined - clip).max() < 1e-6

    def test_the_fade_is_linear(self) -> None:
        spans = [Span(0, 6), Span(3, 9)]
        parts = [np.zeros((6, 1, 1, 3), np.float32), np.ones((6, 1, 1, 3), np.float32)]
        joined = cross_faded(spans, parts, 3)[:, 0, 0, 0]
        assert joined.tolist() == pytest.approx([0, 0, 0, 0.25, 0.5, 0.75, 1, 1, 1])

    def test_lost_frames_are_noticed(self) -> None:
        with pytest.raises(ShapeError, match="5 frames"):
            cross_faded([Span(0, 6)], [np.zeros((5, 1, 1, 3), np.float32)], 2)
