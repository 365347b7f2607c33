"""Pages of runs whose frames are one artefact: each has the name of its own sequence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from extrags.config import PipelineConfig
from extrags.metrics.protocol import RenderedViews
from extrags.sequence import EndoscopicSequence, Split
from extrags.store import Ref, Store
from tasks.benchmark import benchmark_report
from tasks.evaluate import METRICS_FILE
from tasks.report import PAGE, report

SIZE = (40, 48)
RUNS = [
    {"method": method, "profile": "quick", "sequence": "second/scan", "setting": None, "seed": 0}
    for method in ("3dgs", "extrags")
]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path)


@pytest.fixture
def frames(store: Store) -> Ref:
    """Frames that were read from a folder called `first`."""
    K = np.tile(np.array([[30.0, 0, 24], [0, 30.0, 20], [0, 0, 1]]), (3, 1, 1))
    rgb, mask = np.full((3, *SIZE, 3), 90, np.uint8), np.ones((3, *SIZE), bool)
    split = Split("every", np.array([0, 2]), np.array([1]))
    with store.slot(stage="ingest", version=1, key="ingest-v1-frames") as slot:
        slot.save(EndoscopicSequence("first", rgb, K, mask, split))
    return slot.ref


def test_a_page_has_the_name_of_its_own_sequence(store: Store, frames: Ref) -> None:
    made = report.fn(
        store=store.root,
        name="second",
        parts={"sequence": frames},
        skipped={},
        config=PipelineConfig(),
        profile="quick",
        without_pose=(0, 0),
        rows=[],
    )
    page = (store.open(made) / PAGE).read_text()
    assert "<title>second" in page
    assert "<h1>second" in page


def test_pictures_of_a_benchmark_have_the_name_of_their_own_run(store: Store, frames: Ref) -> None:
    figures = {"metrics": {"psnr": 20.0}, "per_view": [{"frame": 1, "psnr": 20.0}], "protocol": 1}
    zeros = np.zeros((1, *SIZE), np.float32)
    with store.slot(stage="evaluate", version=1, key="evaluate-v1-figures") as slot:
        slot.save(RenderedViews(np.full((1, *SIZE, 3), 0.4, np.float32), zeros + 1, zeros, 10))
        slot.save_json(METRICS_FILE, figures)
    made = benchmark_report.fn(
        store=store.root,
        name="benchmark",
        baseline="3dgs",
        methods={"3dgs": "the baseline", "extrags": "the whole"},
        runs=RUNS,
        metrics={"0": slot.ref, "1": slot.ref},
        failures={},
        pictures=[{"baseline": "0", "contender": "1", "label": "seed 0"}],
        sequences={"0": frames, "1": frames},
        renders={"0": slot.ref, "1": slot.ref},
        views=1,
        rows=[{"seconds": 1.0, "peak_mib": None, "stages": []}] * 2,
        history={},
    )
    page = (store.open(made) / PAGE).read_text()
    assert "second/scan, seed 0" in page
    assert "first, seed 0" not in page
