"""The table: every part has rows that pass on a small effort, and faults put into parts are found."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from extrags.stress import ROWS, Effort, optimiser, run_rows, steps
from extrags.stress.inputs import lit_tube, random_lit_scene
from extrags.stress.optimiser import Drift, training_drift
from extrags.stress.rows import differs

PARTS = {
    "rasteriser",
    "unlit step",
    "lit step",
    "Adam",
    "densification",
    "training",
    "reconstruction",
    "TSDF",
    "carving",
    "poses",
    "lens",
    "warp",
    "filling",
    "restorer",
    "depth",
    "metrics",
    "rendering",
    "assessment",
    "exploration",
    "restored views",
    "fine-tuning",
    "judge",
    "evaluation",
    "pipeline",
}
QUICK = Effort(scenes=4, iterations=30, largest=1000)
CHOSEN = (
    "lit step/extreme*",
    "lit step/random scenes",
    "Adam",
    "densification",
    "training/*unlit",
    "poses/inverse",
    "lens/depth*",
    "filling",
    "metrics/known*",
    "rendering",
    "evaluation",
    "assessment",
    "carving/poses*",
    "lens/repeat*",
    "depth/exposure*",
)
"""Rows that take no second, of most parts; the others are run with the benchmark."""


def test_all_parts_have_rows_of_different_names() -> None:
    assert {row.part for row in ROWS} == PARTS
    assert len({row.name for row in ROWS}) == len(ROWS)


@pytest.mark.parametrize("case", steps.CASES)
def test_cases_of_the_training_step_are_the_same_each_time(case: str) -> None:
    first, second = ([scene for _, scene in steps.CASES[case](True)] for _ in range(2))
    assert differs([vars(scene) for scene in first], [vars(scene) for scene in second]) == 0


def test_quick_rows_pass() -> None:
    failed = [row for row in run_rows(ROWS, CHOSEN, QUICK) if not row["passed"]]
    assert failed == []


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_all_rows_pass() -> None:
    failed = [row for row in run_rows(ROWS) if not row["passed"]]
    assert failed == []


@pytest.mark.parametrize("name", ["scales", "light", "viewmat", "loss"])
def test_a_wrong_gradient_is_found(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    true = steps.native_step

    def wrong(scene: steps.LitScene) -> steps.Found:
        found = true(scene)
        return {**found, name: found[name] * 1.01}

    assert steps.over_allowed(lit_tube(60, 16, 12)) < 1
    monkeypatch.setattr(steps, "native_step", wrong)
    assert steps.over_allowed(lit_tube(60, 16, 12)) > 1


def test_scenes_are_those_of_their_seed() -> None:
    one, two, other = (random_lit_scene(seed) for seed in (5, 5, 6))
    assert torch.equal(one.parameters["means"], two.parameters["means"])
    assert one.parameters["means"].shape != other.parameters["means"].shape or not torch.equal(
        one.parameters["means"], other.parameters["means"]
    )


def test_drift_grows_from_rounding() -> None:
    drifts = training_drift(30, lit=True, points=4)
    assert [drift.iteration for drift in drifts] == sorted({drift.iteration for drift in drifts})
    assert drifts[0].float32_parameters < 1e-3
    assert all(np.isfinite([drift.loss, drift.float32_loss, drift.other_loss]).all() for drift in drifts)
    assert drifts[-1].loss < drifts[0].loss


@pytest.mark.parametrize(
    ("float32_loss", "other_loss", "passes"),
    [(0.009, 1e-6, True), (0.02, 1e-6, False), (0.05, 0.02, True), (0.5, 0.02, False)],
)
def test_drift_is_judged_by_the_spread_of_float64(
    monkeypatch: pytest.MonkeyPatch, float32_loss: float, other_loss: float, passes: bool
) -> None:
    drifts = (Drift(1, 1.0, 0.0, 0.0, 0.0, 0.0), Drift(9, 1.0, 0.1, 0.1, float32_loss, other_loss))
    monkeypatch.setattr(optimiser, "training_drift", lambda *_, **__: drifts)
    (row,) = run_rows(optimiser.ROWS, ["training/float32 to float64, lit"], Effort(iterations=9))
    assert row["passed"] == passes
