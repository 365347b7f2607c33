from __future__ import annotations

import json

import pytest
import torch

from extrags.errors import ConfigError
from extrags.raster import native
from extrags.raster.bench import STANDARD_SIZES, BenchSize, bench_raster, bench_scene, bench_train
from extrags.raster.peers import errors, exact_gradients, gradients

SMALL = [BenchSize(33, 20, 150)]
GROUPS = {"means", "quats", "scales", "opacities", "sh"}


def test_raster_reports_times_and_errors() -> None:
    before = native.num_threads(), torch.get_num_threads()
    result = bench_raster(SMALL, peers=["torch", "reference"], threads=[1, 2], rounds=2)
    assert (native.num_threads(), torch.get_num_threads()) == before
    json.dumps(result, allow_nan=False)
    assert {"processor", "cores", "threads", "versions", "commit"} <= set(result["machine"])
    assert [(c["backend"], c["threads"]) for c in result["cases"]] == [
        ("native", 1),
        ("native", 2),
        ("torch", 1),
        ("torch", 2),
        ("reference", 1),
    ]
    for case in result["cases"]:
        assert (case["width"], case["height"], case["n_gaussians"]) == (33, 20, 150)
        assert case["ms"]["iteration"] >= case["ms"]["forward"] > 0
        assert case["spread_ms"][0] <= case["ms"]["iteration"] <= case["spread_ms"][1]
        assert case["times_native"] > 0
        assert case["error"]["image"] < 1e-5
        assert set(case["error"]["grads"]) == GROUPS
        assert max(case["error"]["grads"].values()) < 1e-3
    exact = result["cases"][-1]["error"]
    assert max(exact["image"], *exact["grads"].values()) < 1e-12


def test_train_reports_the_parts_and_the_floor() -> None:
    result = bench_train(SMALL, peers=["torch"], threads=[1], rounds=3)
    case, torch_case = result["cases"]
    parts = {"project", "tiles", "loss", "tiles_backward", "project_backward", "adam", "rest"}
    assert set(case["parts_ms"]) == parts
    assert all(value > 0 for value in case["parts_ms"].values())
    assert 0 < case["roofline"]["share"] < 1
    assert case["roofline"]["floor_ms"] == max(
        case["roofline"]["arithmetic_ms"], case["roofline"]["memory_ms"]
    )
    assert "error" not in case
    assert "roofline" not in torch_case
    assert torch_case["ms"]["adam"] > 0
    assert torch_case["ms"]["loss"] > 0


def test_slow_peers_run_less_often() -> None:
    result = bench_raster(SMALL, peers=["torch", "reference"], rounds=9, with_error=False)
    assert [case["rounds"] for case in result["cases"]] == [9, 5, 2]


def test_errors_are_relative_and_by_name() -> None:
    scene = bench_scene(SMALL[0])
    exact = exact_gradients(scene)
    found = gradients("native", scene)
    found["sh"] = found["sh"] * 1.5
    wrong = errors(found, exact)
    assert wrong["grads"]["sh"] == pytest.approx(0.5, rel=1e-3)
    assert wrong["grads"]["means"] < 1e-3


def test_the_scene_is_what_it_is() -> None:
    size = STANDARD_SIZES[0]
    assert (size.width, size.height, size.n_gaussians) == (160, 128, 10_000)
    first, second = bench_scene(SMALL[0]), bench_scene(SMALL[0])
    assert all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"peers": ["warp"]}, "unknown peers warp; expected native, direct, torch"),
        ({"rounds": 0}, "start at 1, got 0"),
        ({"threads": [0]}, "start at 1, got 0"),
        ({"sizes": [BenchSize(16, 0, 10)]}, "start at 1, got 0"),
    ],
)
def test_what_cannot_be_measured(changes: dict, message: str) -> None:  # type: ignore[type-arg]
    with pytest.raises(ConfigError, match=message):
        bench_raster(**{"sizes": SMALL, **changes})


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_gsplat_needs_cuda() -> None:
    with pytest.raises(ConfigError, match="needs a CUDA device"):
        bench_raster(SMALL, peers=["gsplat"])
