"""What tasks and flows do with stages agrees with the registry."""

from __future__ import annotations

from pathlib import Path

import pytest

from extrags.config import PipelineConfig
from extrags.stages import PAGES_OF_SEVERAL, REGISTRY, STAGES, all_tasks
from flows.commands.status import SHORT
from flows.methods import METHODS
from flows.outcome import NOT_COUNTED, SequenceOutcome
from flows.previews import PICTURES
from flows.store_status import FRAMES, SCENES
from tasks.progress import IN_PARALLEL
from tasks.report import REPORT_PARTS, _absent
from tests.flows.recorded_keys import KEPT, RecordedRun, recorded_run
from tests.flows.tiny import SEQUENCE
from tests.stage_inventory import stages as decorated

ELSEWHERE = {"refined-frames", "continued-coarse", "import-scene", "uc-nerf", "uc-nerf-render"}
"""Tasks that a usual run has no use for: of refined poses, other scenes and a baseline."""


def test_every_task_belongs_to_one_stage() -> None:
    """Or makes pages of several sequences."""
    assert sorted(decorated()) == sorted([*(task.name for task in all_tasks()), *PAGES_OF_SEVERAL])


@pytest.fixture
def outcome(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SequenceOutcome:
    """Of a run of all stages, of which nothing was really made."""
    (tmp_path / "lpips_alex_v0.1.npz").write_bytes(b"alex")
    monkeypatch.setenv("EXTRAGS_LPIPS_WEIGHTS", str(tmp_path))
    config = PipelineConfig().with_overrides(
        {
            "device": "cpu",
            "ingest.width": 64,
            "ingest.height": 51,
            "enhance.keyframes": 2,
            "evaluate.lpips_nets": ("alex",),
        }
    )
    return recorded_run(SEQUENCE, config, RecordedRun(has_poses=False, has_depth=False, judgement=KEPT))


def test_stages_run_their_own_tasks(outcome: SequenceOutcome) -> None:
    ran = {
        row.stage: {key.removeprefix("made-up/").rpartition("-v")[0] for key in row.made}
        for row in outcome.stages
    }
    assert tuple(ran) == STAGES
    shared = {task.name for task in all_tasks() if task.shared}
    for stage in REGISTRY:
        own = {task.name for task in stage.tasks}
        assert ran[stage.name] - shared == own - shared - ELSEWHERE


@pytest.mark.parametrize(("error", "estimated"), [(0.0, False), (0.05, True)])
def test_depth_is_estimated_beside_depth_that_frames_disagree_about(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: float, estimated: bool
) -> None:
    (tmp_path / "lpips_alex_v0.1.npz").write_bytes(b"alex")
    monkeypatch.setenv("EXTRAGS_LPIPS_WEIGHTS", str(tmp_path))
    config = PipelineConfig().with_overrides({"device": "cpu", "evaluate.lpips_nets": ("alex",)})
    recorded = RecordedRun(has_poses=True, has_depth=True, judgement=KEPT)
    recorded.counts["depth_error"] = error
    recorded_run(SEQUENCE, config, recorded)
    assert ("depth" in recorded.keys) == estimated
    # Later stages are given frames with the result.
    assert ("depth-frames" in recorded.keys) == estimated


def test_runs_keep_the_artefacts_of_their_stages(outcome: SequenceOutcome) -> None:
    described = [part for stage in REGISTRY for part in (*stage.page_parts, *stage.other_parts)]
    assert sorted(outcome.refs) == sorted(described)


def test_the_page_says_of_which_stages_it_lacks_parts() -> None:
    told = _absent(dict.fromkeys(STAGES, "not wanted"))
    assert set(told.values()) == {
        f"{stage.name} was skipped: not wanted" for stage in REGISTRY if stage.planned and stage.page_parts
    }


def test_columns_of_the_status_have_names_of_their_own() -> None:
    assert len({stage[:SHORT] for stage in STAGES}) == len(STAGES)


def test_what_tables_say_of_stages_and_tasks() -> None:
    """Written out once more: a registry that says otherwise changes all of this."""
    assert {"evaluate", "report"} == NOT_COUNTED
    assert {"explore-branch", "enhance-restore"} == IN_PARALLEL
    assert {"continued-coarse", "import-scene", "uc-nerf"} == SCENES
    assert {"training-frames", "depth-frames", "refined-frames"} == FRAMES
    assert set(PICTURES) == {"ingest", "coarse", "enhance", "finetune", "evaluate"}
    assert REPORT_PARTS == (
        "sequence", "depth", "coarse", "plan", "surface", "freespace", "explore", "enhance", "finetune",
        "renders_coarse", "renders_final", "renders_restored",
        "metrics_coarse", "metrics_final", "metrics_restored",
    )  # fmt: skip


def test_methods_leave_out_what_they_do_not_have() -> None:
    exploring = ["surface", "freespace", "explore", "enhance"]
    for method in ("coarse", "oracle", "3dgs", "gaussian-pancakes"):
        assert list(METHODS[method].leave_out) == [*exploring, "finetune"]
    assert list(METHODS["real-only"].leave_out) == exploring
    assert list(METHODS["uc-nerf"].leave_out) == ["assess", *exploring, "finetune"]
