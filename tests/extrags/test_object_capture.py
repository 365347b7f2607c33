"""A capture of an object without depth and points goes through the whole pipeline."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data_catalog import read
from extrags.pipeline import run_pipeline
from tests.extrags.object_capture import write_object_capture
from tests.flows.tiny import tiny_config


def test_to_the_end(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = tmp_path / "bricks"
    write_object_capture(folder)
    config = tiny_config(
        ingest__width=None, ingest__height=None, ingest__max_frames=None, enhance__synthetic_views=0
    )
    frames = read(folder, config.ingest)
    assert (len(frames), frames.width, frames.height) == (12, 64, 48)
    assert frames.points is None
    assert frames.depth_mm is None
    assert not frames.metric
    with caplog.at_level("WARNING"):
        result = run_pipeline(frames, config)
    assert "starts from random points" in caplog.text
    assert "round the point they look at" in caplog.text
    assert set(result.skipped) == {"poses"}
    assert result.plan is not None
    assert result.freespace is not None
    assert result.exploration is not None
    assert result.judgement is not None
    for which in ("coarse", "final"):
        assert np.isfinite(result.evaluations[which].metrics["psnr"])
        assert result.evaluations[which].metrics["depth_absrel"] is None


def test_the_radiance_field_as_well(tmp_path: Path) -> None:
    folder = tmp_path / "bricks"
    write_object_capture(folder, views=6)
    config = tiny_config(
        ingest__width=None, ingest__height=None, ingest__max_frames=None, uc_nerf__enabled=True
    )
    result = run_pipeline(read(folder, config.ingest), config)
    assert np.isfinite(result.evaluations["final"].metrics["psnr"])
