"""`extrags.pipeline`: one set of rules for the run in memory and for the cached one, and the same results."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import extrags
from data_catalog.true_surface import true_surface
from extrags.assessment import measure
from extrags.config import ExploreConfig
from extrags.errors import CaptureError, ConfigError
from extrags.exploration import Exploration
from extrags.in_memory_pipeline import InMemoryPipeline
from extrags.pipeline import HELD_OUT_TRAINED_ON, needs_plan
from extrags.poses import PoseEstimate
from extrags.pseudo_views import PseudoViews
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.store import Store
from flows.methods import METHODS, ON_GAUSSIANS
from flows.outcome import SequenceOutcome
from flows.runners import DirectRunner, NotInStoreError, StoreRunner
from flows.wiring import run_sequence
from tests.flows.tiny import GIVEN, SEQUENCE, FramesRead, tiny_config


@pytest.fixture(scope="module")
def in_memory() -> extrags.Result:
    sequence = extrags.read(SEQUENCE, tiny_config().ingest)
    return extrags.run_pipeline(sequence, tiny_config(), true_surface=true_surface(sequence))


NO_PLAN = "no stage of this run depends on the plan"


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

    def test_frames_are_decoded_once_and_written_into_by_no_stage(
        self, finished: tuple[str, SequenceOutcome], frames_read: FramesRead
    ) -> None:
        """A dozen stages read the training frames, and those that evaluate all frames."""
        assert [len(frames) for frames in frames_read.frames] == [24, 10]
        for frames, as_read in zip(frames_read.frames, frames_read.as_read, strict=True):
            assert {"rgb", "mask", "depth_mm", "K", "world_from_camera"} <= as_read.keys()
            for name, image in as_read.items():
                np.testing.assert_array_equal(getattr(frames, name), image, err_msg=name)

    def test_plan_and_metrics(self, finished: tuple[str, SequenceOutcome], in_memory: extrags.Result) -> None:
        _, outcome = finished
        assert in_memory.plan is not None
        assert outcome.plan == in_memory.plan.model_dump(mode="json")
        for which in ("coarse", "final", "restored"):
            assert json.loads(json.dumps(in_memory.evaluations[which].metrics)) == outcome.metrics[which]
        assert outcome.metrics["restored"]["psnr"] != outcome.metrics["final"]["psnr"]

    def test_views_are_not_restored_where_nobody_wants_it(
        self, finished: tuple[str, SequenceOutcome]
    ) -> None:
        store, _ = finished
        config = tiny_config(evaluate__restored="none")
        again = run_sequence(SEQUENCE, config, store, StoreRunner(store), until="evaluate")
        assert {row.state for row in again.stages} == {"cached", "skipped"}
        assert set(again.metrics) == {"coarse", "final"}
        assert "renders_restored" not in again.refs


# Its renders take most of the time, and go by frames.
UC_NERF = tiny_config(uc_nerf__enabled=True, ingest__max_frames=10)


@pytest.fixture(scope="module")
def uc_nerf(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, SequenceOutcome]:
    """A store in which the tiny sequence was reconstructed and evaluated with the baseline."""
    store = str(tmp_path_factory.mktemp("uc_nerf") / "store")
    outcome = run_sequence(
        SEQUENCE, UC_NERF, store, DirectRunner(store), leave_out=METHODS["uc-nerf"].leave_out
    )
    assert outcome.status == "ok", outcome.error
    return store, outcome


class TestUcNerf:
    """The baseline that brings a scene of its own: the same rules and results in memory and cached."""

    def test_in_memory_and_cached(self, uc_nerf: tuple[str, SequenceOutcome]) -> None:
        _, cached = uc_nerf
        sequence = extrags.read(SEQUENCE, UC_NERF.ingest)
        # Without `leave_out`: the pipeline knows by itself what needs Gaussians.
        result = extrags.run_pipeline(sequence, UC_NERF, true_surface=true_surface(sequence))
        reasons = {row.stage: row.reason for row in cached.stages if row.state == "skipped"}
        assert reasons == result.skipped
        assert set(reasons) == {*GIVEN, *ON_GAUSSIANS}
        assert json.loads(json.dumps(result.evaluations["final"].metrics)) == cached.metrics["final"]
        assert cached.metrics["final"]["psnr"] > 10
        assert cached.metrics["final"]["surface"]["recall"] is not None
        with pytest.raises(CaptureError, match="there are no Gaussians"):
            _ = result.scene

    def test_settings_of_gaussians_do_not_concern_it(self, uc_nerf: tuple[str, SequenceOutcome]) -> None:
        store, cached = uc_nerf
        config = UC_NERF.with_overrides({"coarse.iterations": 7})
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

    def reasons(self, tmp_path: Path, left_out: dict[str, str], **settings: object) -> dict[str, str]:
        """Reasons by stage, the same from a run in memory and from a cached one."""
        config = tiny_config(enhance__backend="classical", coarse__iterations=20, **settings)
        outcome = run_sequence(
            SEQUENCE, config, str(tmp_path), DirectRunner(str(tmp_path)), until="finetune", leave_out=left_out
        )
        assert outcome.status == "ok", outcome.error
        sequence = extrags.read(SEQUENCE, config.ingest)
        result = extrags.run_pipeline(sequence, config, until="finetune", leave_out=left_out)
        cached = {row.stage: row.reason for row in outcome.stages if row.state == "skipped"}
        assert cached == result.skipped
        assert ("finetune" in outcome.refs) == (result.finetuning is not None)
        return cached

    def test_what_rests_on_a_left_out_stage_is_skipped_too(self, tmp_path: Path) -> None:
        assert self.reasons(tmp_path, {"freespace": "not wanted"}) == {
            **GIVEN,
            "assess": NO_PLAN,
            "freespace": "not wanted",
            "explore": "it needs the stage freespace, which was skipped",
            "enhance": "it needs the stage explore, which was skipped",
            "finetune": "there are no virtual views",
        }

    def test_without_enhance_fine_tuning_is_a_control(self, tmp_path: Path) -> None:
        left_out = dict.fromkeys(("surface", "freespace", "explore", "enhance"), "a control")
        reasons = self.reasons(tmp_path, left_out)
        assert set(reasons) == {*GIVEN, "assess", *left_out}
        assert reasons["assess"] == NO_PLAN

    def test_a_scene_that_lacks_nothing_is_fine_tuned_on_real_views(self, tmp_path: Path) -> None:
        reasons = self.reasons(tmp_path, {}, assess__force=False, assess__min_hole_share=1.0)
        assert set(reasons) == {*GIVEN, "surface", "freespace", "explore", "enhance"}

    def test_who_pays_for_the_assessment(self) -> None:
        """The plan skips stages of whole runs, and sets the budgets of those that explore."""
        needing = {method for method, found in METHODS.items() if needs_plan(found.leave_out)}
        assert needing == {"extrags", "classical"}
        assert needs_plan({"finetune": "not wanted"})
        assert needs_plan({"enhance": "not wanted"})

    def test_the_assessment_measures_as_the_run_explores(self, tmp_path: Path) -> None:
        config = tiny_config(
            coarse__iterations=20,
            explore__directions=8,
            explore__visible_weight=0.2,
            explore__render_width=24,
        )
        store = Store(str(tmp_path))
        outcome = run_sequence(SEQUENCE, config, str(tmp_path), DirectRunner(str(tmp_path)), until="assess")
        assert outcome.plan is not None
        result = extrags.run_pipeline(extrags.read(SEQUENCE, config.ingest), config, until="assess")
        assert result.plan is not None
        scene = store.load(Scene, outcome.refs["coarse"])
        frames = store.load(EndoscopicSequence, outcome.refs["training"])
        own = measure(scene, frames, config.assess, config.explore.coverage)
        default = measure(scene, frames, config.assess, ExploreConfig().coverage)
        assert own["coverage_share"] != pytest.approx(default["coverage_share"], rel=0.05)
        assert outcome.plan["measurements"] == result.plan.measurements == own

    def test_held_out_frames_without_a_pose_are_no_absent_ones(self, in_memory: extrags.Result) -> None:
        sequence = in_memory.sequence
        run = InMemoryPipeline(sequence, tiny_config())
        assert run.reason_to_skip("evaluate") is None
        run.result.sequence = sequence.training_part()
        assert run.frames_without_pose() == (0, len(sequence.test))
        assert run.reason_to_skip("evaluate") == (
            f"no pose was found for any of the {len(sequence.test)} held-out frames"
        )
        none_given = InMemoryPipeline(sequence.training_part(), tiny_config())
        assert none_given.reason_to_skip("evaluate") == "the sequence has no held-out frames"

    def test_what_is_observed_is_what_registered_frames_saw(
        self, in_memory: extrags.Result, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        sequence = in_memory.sequence
        registered = np.ones(len(sequence), dtype=bool)
        registered[sequence.train[2:]] = False
        estimate = PoseEstimate(
            method="colmap",
            world_from_camera=np.where(registered[:, None, None], sequence.cameras.world_from_camera, np.nan),
            registered=registered,
            points=np.zeros((0, 3), np.float32),
            points_rgb=np.zeros((0, 3), np.uint8),
            mean_reprojection_px=1.0,
            metric=True,
            report={},
        )
        monkeypatch.setattr("extrags.poses.estimate_poses", lambda *_: estimate)
        run = InMemoryPipeline(sequence, tiny_config())
        run.poses()
        left = run.result.sequence
        assert run.frames_without_pose() == (len(sequence.train) - 2, 0)
        assert sequence.observed is not None
        assert left.observed is not None
        assert left.observed[left.test].sum() < sequence.observed[sequence.test].sum()

    def test_nothing_rests_on_a_scene_that_has_seen_held_out_frames(self) -> None:
        sequence = extrags.read(SEQUENCE, tiny_config().ingest)
        seen = tiny_config(coarse__train_on="all", coarse__iterations=2)
        with pytest.raises(ConfigError, match="and surface, freespace, explore, enhance, finetune would"):
            extrags.run_pipeline(sequence, seen)
        with pytest.raises(ConfigError, match="and finetune would; the method oracle"):
            extrags.run_pipeline(sequence, seen, leave_out=METHODS["real-only"].leave_out)
        refined = seen.with_overrides({"coarse.refine_poses": True})
        with pytest.raises(ConfigError, match=r"and coarse\.refine_poses would"):
            extrags.run_pipeline(sequence, refined, leave_out=METHODS["oracle"].leave_out)

    @pytest.mark.parametrize("stage", ["coarse", "ingest"])
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


class TestOracle:
    """Held-out frames are trained on, and whoever reads the figures is told."""

    settings = tiny_config(coarse__train_on="all", coarse__iterations=40)

    def test_held_out_frames_reach_the_oracle_alone(self) -> None:
        sequence = extrags.read(SEQUENCE, self.settings.ingest)
        rgb = sequence.rgb.copy()
        rgb[sequence.test] = 255 - rgb[sequence.test]
        other = replace(sequence, rgb=rgb)
        leave_out = METHODS["oracle"].leave_out
        means = {}
        for method in ("oracle", "coarse"):
            config = self.settings if method == "oracle" else tiny_config(coarse__iterations=40)
            for name, frames in (("given", sequence), ("changed", other)):
                found = extrags.run_pipeline(frames, config, until="coarse", leave_out=leave_out)
                means[method, name] = found.coarse.gaussians.means
        assert torch.equal(means["coarse", "given"], means["coarse", "changed"])
        assert not torch.equal(means["oracle", "given"], means["oracle", "changed"])

    def test_the_run_says_so_and_agrees_with_the_one_in_memory(self, tmp_path: Path) -> None:
        leave_out = METHODS["oracle"].leave_out
        root = str(tmp_path)
        outcome = run_sequence(
            SEQUENCE, self.settings, root, DirectRunner(root), until="evaluate", leave_out=leave_out
        )
        assert outcome.status == "ok", outcome.error
        row = outcome.row("coarse")
        assert row is not None
        assert row.reason == HELD_OUT_TRAINED_ON
        store = Store(root)
        sequence = store.load(EndoscopicSequence, outcome.refs["sequence"])
        counts = store.manifest(outcome.refs["coarse"]).counts
        assert counts["held_out_frames_trained_on"] == len(sequence.test) > 0
        # Later stages would get the training frames alone.
        assert len(store.load(EndoscopicSequence, outcome.refs["training"])) == len(sequence.train)
        result = extrags.run_pipeline(
            sequence, self.settings, leave_out=leave_out, true_surface=true_surface(sequence)
        )
        assert json.loads(json.dumps(result.evaluations["final"].metrics)) == outcome.metrics["final"]

    def test_held_out_frames_are_shown_at_the_exposure_it_learned(self) -> None:
        sequence = extrags.read(SEQUENCE, self.settings.ingest)
        scene = extrags.reconstruct(sequence, self.settings.coarse).scene
        assert scene.light is not None
        logs = torch.linspace(-0.5, 0.5, len(sequence))
        lit = replace(scene, light=replace(scene.light, log_exposure=logs))
        frame = int(sequence.test[len(sequence.test) // 2])
        own = extrags.render(lit, sequence, np.array([frame]), train_on="all").rgb[0]
        expected = lit.render(sequence.cameras[frame], exposure=lit.light.exposures()[frame][None])  # type: ignore[union-attr]
        np.testing.assert_allclose(own, expected.rgb[0].detach().numpy(), atol=1e-6)
