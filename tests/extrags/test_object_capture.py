"""A capture of an object without depth and points goes through the whole pipeline."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data_catalog import read
from extrags.config import IngestConfig
from extrags.errors import ConfigError
from extrags.in_memory_pipeline import run_pipeline
from tests.extrags.object_capture import write_object_capture
from tests.flows.tiny import tiny_config

SIZE_OF_SOURCE = {"ingest__width": None, "ingest__height": None, "ingest__max_frames": None}


def test_to_the_end(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = tmp_path / "bricks"
    write_object_capture(folder)
    config = tiny_config(**SIZE_OF_SOURCE, enhance__synthetic_views=0, depth__hypotheses=24)
    frames = read(folder, config.ingest)
    assert (len(frames), frames.width, frames.height) == (12, 64, 48)
    assert frames.points is None
    assert frames.depth_mm is None
    assert not frames.metric
    with caplog.at_level("WARNING"):
        result = run_pipeline(frames, config)
    assert "starts from random points" not in caplog.text
    assert set(result.skipped) == {"poses"}
    assert result.depth is not None
    # Estimated depth is never in the sequence that the evaluation reads.
    assert result.sequence.depth_mm is None
    assert result.plan is not None
    assert result.freespace is not None
    assert result.exploration is not None
    assert result.judgement is not None
    for which in ("coarse", "final"):
        assert np.isfinite(result.evaluations[which].metrics["psnr"])
        assert result.evaluations[which].metrics["depth_absrel"] is None


def test_without_estimated_depth_it_starts_at_random(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "bricks"
    write_object_capture(folder)
    config = tiny_config(**SIZE_OF_SOURCE, depth__enabled=False, coarse__iterations=5)
    with caplog.at_level("WARNING"):
        result = run_pipeline(read(folder, config.ingest), config, until="coarse")
    assert "starts from random points" in caplog.text
    assert "round the point they look at" in caplog.text
    assert result.skipped["depth"] == "the settings do without it (depth.enabled)"


def test_the_radiance_field_as_well(tmp_path: Path) -> None:
    folder = tmp_path / "bricks"
    write_object_capture(folder, views=6)
    config = tiny_config(**SIZE_OF_SOURCE, uc_nerf__enabled=True)
    result = run_pipeline(read(folder, config.ingest), config)
    assert np.isfinite(result.evaluations["final"].metrics["psnr"])
    assert result.skipped["depth"] == "the radiance field has a stereo of its own"


def test_a_scale_makes_it_metric(tmp_path: Path) -> None:
    folder = tmp_path / "bricks"
    write_object_capture(folder, views=4)
    given, scaled = read(folder), read(folder, IngestConfig(scale_mm_per_unit=12.5))
    assert (given.metric, given.scale_words) == (False, "arbitrary scale")
    assert (scaled.metric, scaled.scale_words) == (True, "millimetres from the scale given")
    np.testing.assert_allclose(scaled.cameras.centers, 12.5 * given.cameras.centers)
    with pytest.raises(ConfigError, match="the source's lengths are millimetres"):
        read("phantom/0@sparse", IngestConfig(width=16, height=16, max_frames=4, scale_mm_per_unit=2.0))
    for image in (folder / "images").iterdir():
        image.rename(folder / image.name)
    (folder / "transforms.json").unlink()
    with pytest.raises(ConfigError, match=r"poses\.working_distance_mm makes estimated poses metric"):
        read(folder, IngestConfig(scale_mm_per_unit=2.0))
