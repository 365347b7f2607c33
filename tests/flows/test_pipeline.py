"""`extrags.pipeline`: one set of rules for the run in memory and for the cached one, and the same results."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import extrags
from data_catalog.true_surface import true_surface
from extrags.errors import CaptureError, ConfigError
from extrags.exploration import Exploration
from extrags.pipeline import INDISPENSABLE, NEED_GAUSSIANS, NEEDS, STAGES
from extrags.pseudo_views import PseudoViews
from extrags.scene import Scene
from extrags.store import Store
from flows.methods import METHODS
from flows.outcome import SequenceOutcome
from flows.runners import DirectRunner, NotInStoreError, StoreRunner
from flows.wiring import run_sequence
from tests.flows.tiny import SEQUENCE, tiny_config


@pytest.fixture(scope="module")
def in_memory() -> extrags.Result:
    sequence = extrags.read(SEQUENCE, tiny_config().ingest)
    return extrags.run_pipeline(sequence, tiny_config(), true_surface=true_surface(sequence))


class TestAgreement:
    """What the tasks have cached is what plain calls give."""

    @pytest.mark.parametrize("part", ["coarse", "finetune"])
    def test_scenes(
        self, finished: tuple[str, SequenceOutcome], in_memory: extrags.Result, part: str
    ) -> None:
        root, outcome = finished
        cached = Store(root).load(Scene, outcome.refs[part])  # type: ignore[index]
        own = in_memory.coarse if part == "coarse" else in_memory.scene
        for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
            assert torch.equal(getattr(cached.gaussians, name), getattr(own.gaussians, name)), name

    def test_exploration_and_pseudo_views(
        self, finished: tuple[str, SequenceOutcome], in_memory: extrags.Result
    ) -> None:
        root, outcome = finished
        exploration = Store(root).load(Exploration, outcome.refs["explore"])
        assert in_memory.exploration is not None
        assert exploration.summary() == in_memory.exploration.summary()
        views = Store(root).load(PseudoViews, outcome.refs["enhance"])
        assert in_memory.pseudo_views is not None
        for name in ("rendered", "restored", "target", "depth_mm", "uncertainty", "pixel_confidence"):
            np.testing.assert_array_equal(getattr(views, name), getattr(in_memory.pseudo_views, name))

    def test_plan_and_metrics(self, finished: tuple[str, SequenceOutcome], in_memory: extrags.Result) -> None:
        _, outcome = finished
        assert in_memory.plan is not None
        assert outcome.plan == in_memory.plan.model_dump(mode="json")
        for which in ("coarse", "final"):
            assert json.loads(json.dumps(in_memory.evaluations[which].metrics)) == outcome.metrics[which]


@pytest.fixture(scope="module")
def uc_nerf(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, SequenceOutcome]:
    """A store in which the tiny sequence was reconstructed and evaluated with the baseline."""
    store = str(tmp_path_factory.mktemp("uc_nerf") / "store")
    config = tiny_config(uc_nerf__enabled=True)
    outcome = run_sequence(
        SEQUENCE, config, store, DirectRunner(store), leave_out=METHODS["uc-nerf"].leave_out
    )
    assert outcome.status == "ok", outcome.error
    return store, outcome


class TestUcNerf:
    """The baseline that brings a scene of its own: the same rules and results in memory and cached."""

    def test_in_memory_and_cached(self, uc_nerf: tuple[str, SequenceOutcome]) -> None:
        _, cached = uc_nerf
        config = tiny_config(uc_nerf__enabled=True)
        sequence = extrags.read(SEQUENCE, config.ingest)
        # Without `leave_out`: the pipeline knows by itself what needs Gaussians.
        result = extrags.run_pipeline(sequence, config, true_surface=true_surface(sequence))
        reasons = {row.stage: row.reason for row in cached.stages if row.state == "skipped"}
        assert reasons == result.skipped
        assert set(reasons) == {"poses", *NEED_GAUSSIANS}
        assert json.loads(json.dumps(result.evaluations["final"].metrics)) == cached.metrics["final"]
        assert cached.metrics["final"]["psnr"] > 10
        assert cached.metrics["final"]["surface"]["recall"] is not None
        with pytest.raises(CaptureError, match="there are no Gaussians"):
            _ = result.scene

    def test_settings_of_gaussians_do_not_concern_it(self, uc_nerf: tuple[str, SequenceOutcome]) -> None:
        store, cached = uc_nerf
        config = tiny_config(uc_nerf__enabled=True, coarse__iterations=7)
        again = run_sequence(SEQUENCE, config, store, StoreRunner(store), until="evaluate")
        assert {row.state for row in again.stages} == {"cached", "skipped"}
        assert again.digests["coarse"] == cached.digests["coarse"]
        with pytest.raises(NotInStoreError, match="uc-nerf-v"):
            run_sequence(SEQUENCE, config.with_seed(5), store, StoreRunner(store), until="evaluate")

    def test_the_page_says_why_stages_are_missing(self, uc_nerf: tuple[str, SequenceOutcome]) -> None:
        _, cached = uc_nerf
        assert cached.report is not None
        assert "radiance field" in Path(cached.report).read_text()


class TestRules:
    """Asked of both: why a stage is skipped does not depend on who runs it."""

    def reasons(self, tmp_path: Path, left_out: dict[str, str]) -> dict[str, str]:
        """Reasons by stage, the same from a run in memory and from a cached one."""
        config = tiny_config(enhance__backend="classical", coarse__iterations=20)
        outcome = run_sequence(
            SEQUENCE, config, str(tmp_path), DirectRunner(str(tmp_path)), until="finetune", leave_out=left_out
        )
        assert outcome.status == "ok", outcome.error
        sequence = extrags.read(SEQUENCE, config.ingest)
        result = extrags.run_pipeline(sequence, config, until="finetune", leave_out=left_out)
        cached = {row.stage: row.reason for row in outcome.stages if row.state == "skipped"}
        assert cached == result.skipped
        return cached

    def test_what_rests_on_a_left_out_stage_is_skipped_too(self, tmp_path: Path) -> None:
        assert self.reasons(tmp_path, {"freespace": "not wanted"}) == {
            "poses": "the source has poses",
            "freespace": "not wanted",
            "explore": "it needs the stage freespace, which was skipped",
            "enhance": "it needs the stage explore, which was skipped",
            "finetune": "there are no virtual views",
        }

    def test_without_enhance_fine_tuning_is_a_control(self, tmp_path: Path) -> None:
        left_out = dict.fromkeys(("surface", "freespace", "explore", "enhance"), "a control")
        assert set(self.reasons(tmp_path, left_out)) == {"poses", *left_out}

    @pytest.mark.parametrize("stage", sorted(INDISPENSABLE))
    def test_what_everything_rests_on_cannot_be_left_out(self, stage: str) -> None:
        sequence = extrags.read(SEQUENCE, tiny_config().ingest)
        with pytest.raises(ConfigError, match=f"the stage {stage} cannot be left out"):
            extrags.run_pipeline(sequence, leave_out={stage: "not wanted"})

    @pytest.mark.usefixtures("unchecked")
    def test_unknown_stages(self) -> None:
        sequence = extrags.read(SEQUENCE, tiny_config().ingest)
        with pytest.raises(ConfigError, match="no stage 'explor'; known: ingest"):
            extrags.run_pipeline(sequence, leave_out={"explor": "not wanted"})
        with pytest.raises(ConfigError, match="no stage 'everything'"):
            extrags.run_pipeline(sequence, until="everything")

    def test_needs_point_backwards(self) -> None:
        for stage, needed in NEEDS.items():
            assert STAGES.index(needed) < STAGES.index(stage)
