"""Size of the work that a sequence is."""

from __future__ import annotations

import pytest

from extrags.config import PipelineConfig
from extrags.run_costs import Workload, packaged_model, stage_seconds
from flows.commands.plan import print_detail
from flows.run_costs import RunPrediction, StageCost
from flows.workloads import at_detail_size


def test_frames_of_the_size_that_keeps_their_detail_cost_less() -> None:
    whole = Workload(675 * 540, 40, 20, 20, PipelineConfig(), width=675)
    reduced = at_detail_size(whole, {"detail_width": 450, "detail_height": 360})
    assert reduced is not None
    assert (reduced.pixels, reduced.width, reduced.frames) == (450 * 360, 450, 40)
    model = packaged_model()
    for stage in ("coarse", "finetune", "evaluate"):
        assert stage_seconds(model, stage, reduced) < 0.75 * stage_seconds(model, stage, whole)


def test_frames_that_hold_all_their_detail_are_the_same_work() -> None:
    whole = Workload(675 * 540, 40, 20, 20, PipelineConfig(), width=675)
    assert at_detail_size(whole, {"detail_width": 675, "detail_height": 540}) is None


def test_a_plan_says_what_smaller_frames_would_take(capsys: pytest.CaptureFixture[str]) -> None:
    predicted, reduced = (
        RunPrediction([StageCost("coarse", seconds, None, None)], "probe", 0) for seconds in (200.4, 79.6)
    )
    print_detail("no more detail than 450 x 360 px hold", predicted, reduced)
    said = capsys.readouterr().out
    assert "frames hold no more detail than 450 x 360 px hold: --ingest.size detail" in said
    assert "80 s of processor time in place of 200" in said
