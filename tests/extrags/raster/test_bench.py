from __future__ import annotations

import json

import pytest

from extrags.errors import ConfigError
from extrags.raster import native
from extrags.raster.bench import BenchSize, bench_raster, bench_train

SMALL = [BenchSize(33, 20, 150)]


def test_raster_reports_times_and_errors() -> None:
    before = native.num_threads()
    result = bench_raster(SMALL, peers=["torch"], threads=[1, 2], rounds=2)
    assert native.num_threads() == before
    json.dumps(result)
    assert {"processor", "cores", "threads", "versions", "commit"} <= set(result["machine"])
    assert [(c["backend"], c["threads"]) for c in result["cases"]] == [
        ("native", 1),
        ("native", 2),
        ("torch", 1),
    ]
    for case in result["cases"]:
        assert (case["width"], case["height"], case["n_gaussians"]) == (33, 20, 150)
        assert case["ms"]["iteration"] >= case["ms"]["forward"] > 0
        assert case["error"]["image"] < 1e-5
        assert set(case["error"]["grads"]) == {"means", "quats", "scales", "opacities", "sh"}
        assert max(case["error"]["grads"].values()) < 1e-3


def test_train_reports_the_parts_and_the_floor() -> None:
    (case,) = bench_train(SMALL, peers=[], threads=[1], rounds=3)["cases"]
    assert {"project", "tiles", "loss", "tiles_backward", "project_backward", "adam"} <= set(case["parts_ms"])
    assert all(value > 0 for value in case["parts_ms"].values())
    assert 0 < case["roofline"]["share"] < 1


def test_unknown_peer() -> None:
    with pytest.raises(ConfigError, match="unknown peers warp"):
        bench_raster(SMALL, peers=["warp"])
