"""The registry against the protocol, and a metric of one's own in everything that shows metrics."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from torch import Tensor

from extrags.config import LpipsNet, PipelineConfig
from extrags.errors import ConfigError, NonFiniteError, ShapeError
from extrags.in_memory_pipeline import run_pipeline
from extrags.metrics import protocol
from extrags.metrics.comparison import compare_runs, figure_of
from extrags.metrics.image import means_in_regions
from extrags.metrics.photometric import photometric_values, try_added_metrics
from extrags.metrics.protocol import EvaluationResult, RenderedViews, evaluate_views
from extrags.metrics.registry import (
    Metric,
    added_metrics,
    figures,
    metric_named,
    metrics,
    register_metric,
    unregister_metric,
)
from extrags.metrics.surface import SurfaceErrors, SurfaceResult
from extrags.report.benchmark import BenchmarkInputs, build_benchmark_report
from extrags.report.dataset import DatasetRow, build_dataset_report
from extrags.sequence import EndoscopicSequence, Split
from flows.outcome import SequenceOutcome
from flows.preflight import preflight
from flows.tables import benchmark_markdown, sequence_markdown

TEST = np.array([1, 3])
OFFSET = 16 / 255


def absolute_error(render: Tensor, target: Tensor) -> Tensor:
    return (render - target).abs().mean(-1)


TOY = Metric(
    "toy_error",
    "Toy error",
    higher_is_better=False,
    measure=means_in_regions(absolute_error),
    description="What the toy says of itself.",
)


WRONG = [
    ({"all": [float("nan")] * 2}, NonFiniteError, "all: a value is NaN or infinite"),
    ({"all": [0.1]}, ShapeError, "all: 1 values for 2 images"),
    ({"all": ["0.1", "0.2"]}, ShapeError, "all holds '0.1', str; expected numbers or None"),
    ({"all": "ab"}, ShapeError, "all is str; expected a list of one number, or None, per image"),
    ({"all": 0.1}, ShapeError, "all is float; expected a list of one number, or None, per image"),
    ({"all": torch.zeros(2, 2)}, ShapeError, "all holds [0.0, 0.0], list; expected numbers or None"),
    (
        {"valid": [0.1] * 2},
        ShapeError,
        "measure gives no values of all, found valid; expected for each region",
    ),
    ({}, ShapeError, "measure gives no values of all, found none; expected for each region"),
    (None, ShapeError, "measure gives NoneType; expected a dict, for each region one number per image"),
]


@pytest.fixture
def toy() -> Iterator[Metric]:
    register_metric(TOY)
    yield TOY
    unregister_metric("toy_error")


@pytest.fixture
def sequence() -> EndoscopicSequence:
    mask = np.ones((5, 48, 64), dtype=bool)
    mask[:, :, :8] = False
    observed = np.zeros_like(mask)
    observed[:, :, :40] = True
    return EndoscopicSequence(
        name="made/up@here",
        rgb=np.random.default_rng(0).integers(40, 200, (5, 48, 64, 3), dtype=np.uint8),
        K=np.tile(np.eye(3), (5, 1, 1)),
        mask=mask,
        split=Split("here", np.array([0, 2, 4]), TEST),
        depth_mm=np.full((5, 48, 64), 20.0, dtype=np.float32),
        observed=observed,
    )


def evaluated(sequence: EndoscopicSequence, offset: float) -> EvaluationResult:
    """Renders that are wrong by an offset where training frames saw the surface."""
    rgb = (
        sequence.rgb[TEST].astype(np.float32) / 255 + np.float32(offset) * sequence.observed[TEST, ..., None]
    )
    renders = RenderedViews(rgb, np.ones(rgb.shape[:-1], np.float32), sequence.depth_mm[TEST], 7)
    errors = SurfaceErrors(0.4, 0.2, 0.5, 0.3, 0.9, 0.8, 0.85)
    surface = SurfaceResult(errors, replace(errors, recall=0.1), 0.6, 0.7, 1.0, "mesh")
    return evaluate_views(renders, sequence, TEST, {"alex": "no file"}, surface=surface)


class TestRegistry:
    def test_every_figure_stands_in_the_tree_of_the_protocol(self, sequence: EndoscopicSequence) -> None:
        tree = evaluated(sequence, OFFSET).metrics
        for figure in figures():
            if not figure.key.startswith("lpips"):
                assert figure_of(tree, figure.name) is not None, figure.name
        assert len({figure.name for figure in figures()}) == len(figures())

    def test_every_key_is_described_in_the_protocol(self) -> None:
        words = (Path(protocol.__file__).parent / "PROTOCOL.md").read_text()
        for metric in metrics():
            assert f"`{metric.key}`" in words, metric.key

    def test_pages_describe_what_they_show(self) -> None:
        for metric in metrics():
            if "tiles" in metric.shown:
                assert metric.description or metric.network, metric.key

    def test_every_network_of_lpips_is_a_metric(self) -> None:
        assert {metric.lpips_net for metric in metrics() if metric.lpips_net} == set(get_args(LpipsNet))

    def test_functions_of_the_photometric_metrics_are_there(self) -> None:
        render, target = torch.full((2, 16, 16, 3), 0.6), torch.full((2, 16, 16, 3), 0.5)
        half = torch.zeros(2, 16, 16, dtype=torch.bool)
        half[0, 4:] = True
        found = photometric_values(
            render, target, {"half": half}, metrics("photometric"), {"alex": "no file"}
        )["half"]
        assert {"psnr", "ssim", "lpips_alex", "flip"} <= set(found)
        for metric in metrics("photometric"):
            if metric.measure is not None:
                assert found[metric.key][0] is not None, metric.key
                assert found[metric.key][1] is None, metric.key
        assert found["psnr"] == [pytest.approx(20, abs=1e-3), None]
        assert found["lpips_alex"] == [None, None]

    def test_loads_no_torch(self) -> None:
        program = "import sys, flows.tables as t; t.figure('psnr', 1.0); assert 'torch' not in sys.modules"
        subprocess.run([sys.executable, "-c", program], check=True, cwd=Path(__file__).parents[3])


class TestOwnMetric:
    def test_is_measured_in_every_group_of_pixels(self, sequence: EndoscopicSequence, toy: Metric) -> None:
        result = evaluated(sequence, OFFSET)
        assert figure_of(result.metrics, "observed.toy_error") == pytest.approx(OFFSET, abs=1e-6)
        assert figure_of(result.metrics, "unobserved.toy_error") == pytest.approx(0, abs=1e-6)
        assert figure_of(result.metrics, "toy_error") == pytest.approx(OFFSET * 32 / 56, abs=1e-6)
        assert figure_of(result.metrics, "whole.toy_error") == pytest.approx(OFFSET * 40 / 64, abs=1e-6)
        assert 0 < result.metrics["aligned"]["toy_error"] < 2 * OFFSET
        assert [view["observed"]["toy_error"] for view in result.per_view] == pytest.approx(
            [OFFSET] * 2, abs=1e-6
        )
        assert list(result.metrics)[:4] == ["psnr", "ssim", "lpips_alex", "flip"]
        json.dumps(result.to_json(), allow_nan=False)

    def test_is_shown_in_tables_comparison_and_pages(self, sequence: EndoscopicSequence, toy: Metric) -> None:
        trees = {
            method: evaluated(sequence, offset).metrics
            for method, offset in (("3dgs", OFFSET), ("coarse", OFFSET / 2))
        }
        runs = [run(method, tree) for method, tree in trees.items()]
        (row,) = compare_runs(runs, "3dgs")["paired_sequences"]
        assert row["figures"]["observed.toy_error"]["mean"] == pytest.approx(-OFFSET / 2, abs=1e-6)
        assert row["figures"]["observed.toy_error"]["better"] == 1
        outcome = SequenceOutcome("made/up", metrics={"coarse": trees["3dgs"], "final": trees["coarse"]})
        for table in (sequence_markdown(outcome), benchmark_markdown(runs, "3dgs")):
            assert "| toy_error |" in table
            assert f"{trees['coarse']['toy_error']:.4f}" in table
        pages = (
            build_benchmark_report(BenchmarkInputs("x", runs, "3dgs", dict.fromkeys(trees, "a method"))),
            build_dataset_report(
                [DatasetRow("made/up", "completed", 1.0, trees["3dgs"], trees["coarse"])], name="x"
            ),
        )
        for page in pages:
            assert "Toy error" in page.split("How the numbers are taken")[0]
            assert "What the toy says of itself." in page.split("How the numbers are taken")[1]

    def test_a_figure_of_one_group_of_pixels_stands_in_tables(
        self, sequence: EndoscopicSequence, toy: Metric
    ) -> None:
        unregister_metric("toy_error")
        register_metric(replace(toy, shown={**toy.shown, "tables": ("observed",)}))
        tree = evaluated(sequence, OFFSET).metrics
        outcome = SequenceOutcome("made/up", metrics={"coarse": tree, "final": tree})
        for table in (sequence_markdown(outcome), benchmark_markdown([run("3dgs", tree)], "3dgs")):
            (head,) = [line for line in table.splitlines() if "observed.toy_error" in line][-1:]
            row = table.splitlines()[table.splitlines().index(head) + 2]
            place = head.split("|").index(" observed.toy_error ")
            assert row.split("|")[place].strip() == f"{tree['observed']['toy_error']:.4f}"

    def test_is_part_of_the_key_of_cached_results(self, toy: Metric) -> None:
        assert added_metrics() == ["toy_error@1"]
        unregister_metric("toy_error")
        assert added_metrics() == []
        register_metric(replace(toy, version=2))
        assert added_metrics() == ["toy_error@2"]

    def test_without_a_value_there_is_a_reason(self, sequence: EndoscopicSequence) -> None:
        def blind(
            render: Tensor, target: Tensor, regions: dict[str, Tensor]
        ) -> dict[str, list[float | None]]:
            return {name: [None] * len(render) for name in regions}

        register_metric(replace(TOY, measure=blind))
        try:
            result = evaluated(sequence, OFFSET)
        finally:
            unregister_metric("toy_error")
        assert result.metrics["toy_error"] is None
        assert result.reasons["toy_error"] == "no view has a value"

    @pytest.mark.parametrize(("given", "error", "said"), WRONG)
    def test_what_no_result_may_hold_is_refused(
        self, given: object, error: type[Exception], said: str, unchecked: None
    ) -> None:
        metric = replace(TOY, measure=lambda *_: given)
        images, everything = torch.zeros(2, 8, 8, 3), torch.ones(2, 8, 8, dtype=torch.bool)
        with pytest.raises(error, match=re.escape(f"metric toy_error: {said}")):
            photometric_values(images, images, {"all": everything}, [metric], None)

    @pytest.mark.parametrize("given", [[1, None], (0.25, np.float32(0.5)), torch.tensor([0.25, 0.5])])
    def test_values_are_plain_numbers(self, given: Any, unchecked: None) -> None:
        metric = replace(TOY, measure=lambda *_: {"all": given})
        images, everything = torch.zeros(2, 8, 8, 3), torch.ones(2, 8, 8, dtype=torch.bool)
        found = photometric_values(images, images, {"all": everything}, [metric], None)["all"]["toy_error"]
        assert found == [1.0, None] if isinstance(given, list) else found == [0.25, 0.5]
        assert {type(value) for value in found} <= {float, type(None)}

    def test_is_tried_before_a_run(
        self, sequence: EndoscopicSequence, toy: Metric, unchecked: None, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        # Its frames are no recording.
        monkeypatch.setattr("extrags.arguments.check_arrays", lambda *_: None)
        try_added_metrics()
        for measure, said in (
            (lambda *_: {}, "metric toy_error: measure gives no values of valid, observed, unobserved"),
            (lambda *_: 1 / 0, "ZeroDivisionError: division by zero"),
        ):
            unregister_metric("toy_error")
            register_metric(replace(TOY, measure=measure))
            pattern = "metric toy_error fails on two made-up pairs .*: " + re.escape(said)
            for attempt in (
                try_added_metrics,
                lambda: preflight(PipelineConfig(), "report"),
                lambda: run_pipeline(sequence, PipelineConfig()),
            ):
                with pytest.raises(ConfigError, match=pattern):
                    attempt()
            # Where nothing is measured, nothing is tried.
            run_pipeline(sequence, PipelineConfig(), until="ingest")
            preflight(PipelineConfig(), "report", leave_out={"evaluate": "not wanted here"})
            preflight(PipelineConfig(), "coarse")

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"key": "psnr"}, "psnr: the key is taken"),
            ({"key": "observed"}, "observed: the key is taken"),
            ({"key": "frame"}, "frame: the key is taken"),
            ({"key": "name"}, "name: the key is taken"),
            ({"measure": None}, "only photometric metrics with a `measure`"),
            ({"kind": "depth"}, "only photometric metrics with a `measure`"),
            ({"key": "My metric"}, "a key is lower case"),
            ({"shown": {"nowhere": ("",)}}, "no place 'nowhere' to show it; known: tables"),
            ({"shown": {"tables": ("surface",)}}, "a photometric metric has"),
            ({"groups": ("", "observd")}, "groups .*observd.*; a photometric metric has"),
        ],
    )
    def test_what_makes_no_sense_is_refused(
        self, change: dict[str, Any], message: str, unchecked: None
    ) -> None:
        with pytest.raises(ConfigError, match=message):
            register_metric(replace(TOY, **change))
        assert added_metrics() == []

    def test_the_protocols_metrics_stay(self) -> None:
        with pytest.raises(ConfigError, match="belongs to the protocol"):
            unregister_metric("psnr")
        with pytest.raises(ConfigError, match="no metric 'toy_error'; known: psnr, ssim"):
            metric_named("toy_error")


def run(method: str, tree: dict[str, Any]) -> dict[str, Any]:
    return {
        "method": method,
        "profile": "quick",
        "sequence": "made/up",
        "setting": "here",
        "seed": 0,
        "seconds": 1.0,
        "peak_mib": None,
        "metrics": tree,
        "held_out_trained_on": False,
        "error": "",
    }
