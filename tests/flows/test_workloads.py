"""Size of the work that a sequence is."""

from __future__ import annotations

from extrags.config import PipelineConfig
from extrags.run_costs import Workload, packaged_model, stage_seconds
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
