"""The true surface is made once for all scenes that are evaluated on the same frames."""

from __future__ import annotations

import gc
from dataclasses import replace

import pytest

import data_catalog.true_surface
from data_catalog import read
from data_catalog.true_surface import true_surface
from extrags.config import IngestConfig
from extrags.sequence import EndoscopicSequence


def frames_without_geometry() -> EndoscopicSequence:
    read_frames = read("phantom/0@sparse", IngestConfig(width=40, height=32, max_frames=12))
    return replace(read_frames, truth={})


def test_it_is_made_once_for_the_same_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[EndoscopicSequence] = []
    fuse = data_catalog.true_surface.surface_from_depth

    def noted(sequence: EndoscopicSequence) -> object:
        made.append(sequence)
        return fuse(sequence)

    monkeypatch.setattr(data_catalog.true_surface, "surface_from_depth", noted)
    frames = frames_without_geometry()
    found = true_surface(frames)
    assert found is not None
    assert true_surface(frames) is found
    assert len(made) == 1
    # Equal frames may be others; only the same object is known to be the same.
    other = replace(frames, metric=not frames.metric)
    assert true_surface(other) is not found
    assert len(made) == 2


def test_nothing_is_kept_of_frames_that_are_gone() -> None:
    frames = frames_without_geometry()
    true_surface(frames)
    assert data_catalog.true_surface._last
    del frames
    gc.collect()
    assert data_catalog.true_surface._last == []
