"""A source whose depth is withheld: the stage depth in memory and cached, and what later stages are given."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import extrags
from data_catalog.true_surface import true_surface
from extrags.depth.estimate import DepthEstimate
from extrags.errors import ConfigError, WeightsError
from extrags.in_memory_pipeline import InMemoryPipeline
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, Split
from extrags.store import Store
from flows.methods import METHODS, method_config
from flows.outcome import SequenceOutcome
from flows.preflight import preflight
from flows.runners import DirectRunner, NotInStoreError, StoreRunner
from flows.wiring import run_sequence
from tests.extrags.depth.tiny_monocular import save_depth_anything
from tests.flows.tiny import SEQUENCE, tiny_config

WITHHELD = tiny_config(
    ingest__withhold_depth=True,
    ingest__max_frames=16,
    depth__hypotheses=16,
    depth__sources=3,
    coarse__iterations=20,
)
ALONE = METHODS["coarse"].leave_out


@pytest.fixture(scope="module")
def run(little_work: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, SequenceOutcome]:
    """A store in which depth was estimated, and a coarse scene made with it and evaluated."""
    store = str(tmp_path_factory.mktemp("depth") / "store")
    outcome = run_sequence(SEQUENCE, WITHHELD, store, DirectRunner(store), leave_out=ALONE)
    assert outcome.status == "ok", outcome.error
    return store, outcome


def test_it_stands_between_poses_and_coarse(run: tuple[str, SequenceOutcome]) -> None:
    store, outcome = run
    states = {row.stage: row.state for row in outcome.stages}
    assert list(states)[:4] == ["ingest", "poses", "depth", "coarse"]
    assert (states["poses"], states["depth"]) == ("skipped", "ran")
    estimate = Store(store).load(DepthEstimate, outcome.refs["depth"])
    row = outcome.row("depth")
    assert row is not None
    assert row.reason == estimate.summary
    counts = Store(store).manifest(outcome.refs["depth"]).counts
    assert counts["n_points"] == len(estimate.points)
    for name in ("median_expected_error", "agreeing_share", "points_from"):
        assert counts[name] == estimate.report[name]
    assert Store(store).manifest(outcome.refs["coarse"]).counts["random_start"] == 0


def test_training_frames_alone_have_it(run: tuple[str, SequenceOutcome]) -> None:
    store, outcome = run
    estimate = Store(store).load(DepthEstimate, outcome.refs["depth"])
    training = Store(store).load(EndoscopicSequence, outcome.refs["training"])
    np.testing.assert_array_equal(training.depth_mm, estimate.depth)
    np.testing.assert_array_equal(training.depth_error, estimate.expected_error)
    whole = Store(store).load(EndoscopicSequence, outcome.refs["sequence"])
    assert whole.depth_error is None
    assert not whole.training_depth_known


def test_in_memory_it_is_the_same(run: tuple[str, SequenceOutcome]) -> None:
    store, outcome = run
    sequence = extrags.read(SEQUENCE, WITHHELD.ingest)
    result = extrags.run_pipeline(sequence, WITHHELD, leave_out=ALONE, true_surface=true_surface(sequence))
    assert result.skipped == {row.stage: row.reason for row in outcome.stages if row.state == "skipped"}
    assert result.depth is not None
    cached = Store(store).load(DepthEstimate, outcome.refs["depth"])
    np.testing.assert_array_equal(result.depth.depth, cached.depth)
    assert json.loads(json.dumps(result.evaluations["coarse"].metrics)) == outcome.metrics["coarse"]
    # The truth it is compared with is the source's.
    assert outcome.metrics["coarse"]["depth_absrel"] is not None
    assert result.sequence.depth_error is None


def test_what_another_run_needs_anew(run: tuple[str, SequenceOutcome]) -> None:
    store, outcome = run

    def again(**settings: object) -> SequenceOutcome:
        config = WITHHELD.with_overrides({name.replace("__", "."): value for name, value in settings.items()})
        return run_sequence(SEQUENCE, config, store, StoreRunner(store), until="depth")

    for same in (again(coarse__iterations=7), again(poses__fallback="never")):
        assert same.refs["depth"] == outcome.refs["depth"]
    for changed in ({"depth__hypotheses": 17}, {"poses__n_features": 500}, {"depth__completion": "none"}):
        with pytest.raises(NotInStoreError, match="depth-v"):
            again(**changed)


def test_changed_weights_are_another_depth(
    run: tuple[str, SequenceOutcome], monkeypatch: pytest.MonkeyPatch
) -> None:
    store, _ = run
    monkeypatch.setattr("extrags.depth.weights.completion_digest", lambda setting: f"other {setting}")
    with pytest.raises(NotInStoreError, match="depth-v"):
        run_sequence(SEQUENCE, WITHHELD, store, StoreRunner(store), until="depth")


def test_refined_poses_keep_it(run: tuple[str, SequenceOutcome]) -> None:
    store, first = run
    config = WITHHELD.with_overrides({"coarse.refine_poses": True})
    outcome = run_sequence(SEQUENCE, config, store, DirectRunner(store), until="coarse")
    assert outcome.refs["depth"] == first.refs["depth"]
    training = Store(store).load(EndoscopicSequence, outcome.refs["training"])
    assert training.pose_source == "refined"
    assert training.depth_error is not None
    assert training.training_depth_known
    assert Store(store).load(EndoscopicSequence, outcome.refs["sequence"]).depth_error is None


def test_the_oracle_has_that_of_training_frames(run: tuple[str, SequenceOutcome]) -> None:
    store, first = run
    config = WITHHELD.with_overrides({"coarse.train_on": "all"})
    left_out = METHODS["oracle"].leave_out
    outcome = run_sequence(SEQUENCE, config, store, DirectRunner(store), until="coarse", leave_out=left_out)
    assert outcome.status == "ok", outcome.error
    assert outcome.refs["depth"] == first.refs["depth"]
    cached = Store(store).load(Scene, outcome.refs["coarse"])
    sequence = extrags.read(SEQUENCE, config.ingest)
    own = extrags.run_pipeline(sequence, config, until="coarse", leave_out=left_out).coarse
    assert torch.equal(cached.gaussians.means, own.gaussians.means)


def test_the_page_says_that_it_is_estimated(run: tuple[str, SequenceOutcome]) -> None:
    _, outcome = run
    assert outcome.report is not None
    page = Path(outcome.report).read_text()
    assert 'id="estimated-depth"' in page
    assert "estimated from the images of the training frames, not measured" in page
    assert "True depth, withheld" in page


class TestWeights:
    def test_a_missing_file_is_told_before_the_run(self) -> None:
        config = tiny_config(depth__completion="no/such.safetensors")
        with pytest.raises(WeightsError, match=r"depth\.completion=no/such\.safetensors"):
            preflight(config, "coarse")
        preflight(config, "poses")
        preflight(config.with_overrides({"depth.enabled": False}), "coarse")

    def test_and_fails_the_stage_when_nobody_looked(self, run: tuple[str, SequenceOutcome]) -> None:
        store, _ = run
        config = WITHHELD.with_overrides({"depth.completion": "no/such.safetensors"})
        outcome = run_sequence(SEQUENCE, config, store, DirectRunner(store), until="coarse")
        row = outcome.row("depth")
        assert row is not None
        assert (outcome.status, row.state) == ("failed", "failed")
        assert isinstance(outcome.error, WeightsError)


class TestMonocular:
    def test_a_missing_folder_is_told_before_the_run(self) -> None:
        pytest.importorskip("transformers", reason="transformers is not installed")
        config = tiny_config(depth__monocular="no/such/folder")
        with pytest.raises(WeightsError, match=r"depth\.monocular=no/such/folder"):
            preflight(config, "coarse")
        preflight(config, "poses")

    def test_a_changed_model_is_another_depth_and_a_moved_one_the_same(
        self, run: tuple[str, SequenceOutcome], tmp_path: Path
    ) -> None:
        pytest.importorskip("transformers", reason="transformers is not installed")
        store, plain = run
        first, second = tmp_path / "first", tmp_path / "second"
        save_depth_anything(first)

        def outcome(folder: Path, runner: DirectRunner | StoreRunner) -> SequenceOutcome:
            config = WITHHELD.with_overrides({"depth.monocular": str(folder)})
            return run_sequence(SEQUENCE, config, store, runner, until="depth")

        with_it = outcome(first, DirectRunner(store))
        assert with_it.status == "ok", with_it.error
        assert with_it.refs["depth"] != plain.refs["depth"]
        assert Store(store).load(DepthEstimate, with_it.refs["depth"]).report["monocular"]
        first.rename(second)
        assert outcome(second, StoreRunner(store)).refs["depth"] == with_it.refs["depth"]
        (second / "another.txt").write_text("changed")
        with pytest.raises(NotInStoreError, match="depth-v"):
            outcome(second, StoreRunner(store))


class TestDevice:
    def test_cuda_that_is_not_there_is_told_before_the_run(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("torch.cuda.is_available", lambda: False)
        config = tiny_config(depth__device="cuda")
        with pytest.raises(ConfigError, match=r"depth\.device=cuda"):
            preflight(config, "coarse")
        preflight(config, "poses")


class TestSkipped:
    @pytest.mark.parametrize("method", ["3dgs", "paper", "paper-no-illum-fold", "exploregs"])
    def test_published_methods_do_without(self, method: str) -> None:
        assert not method_config(method, "quick").depth.enabled

    @pytest.mark.parametrize("method", ["extrags", "coarse", "oracle", "classical", "gaussian-pancakes"])
    def test_others_have_it(self, method: str) -> None:
        assert method_config(method, "quick").depth.enabled

    def test_switched_off(self, tmp_path: Path) -> None:
        config = WITHHELD.with_overrides({"depth.enabled": False})
        root = str(tmp_path)
        outcome = run_sequence(SEQUENCE, config, root, DirectRunner(root), until="coarse")
        row = outcome.row("depth")
        assert row is not None
        assert row.reason == "the settings do without it (depth.enabled)"
        training = Store(root).load(EndoscopicSequence, outcome.refs["training"])
        assert training.depth_mm is None

    def test_a_single_training_frame(self) -> None:
        sequence = extrags.read(SEQUENCE, WITHHELD.ingest)
        one = replace(sequence, split=Split("one", sequence.train[:1], sequence.test))
        assert (
            InMemoryPipeline(one, WITHHELD).reason_to_skip("depth")
            == "a single training frame has no other to be matched with"
        )
        # Depth that is there is never estimated, whatever the settings say.
        given = extrags.read(SEQUENCE, tiny_config(ingest__max_frames=16).ingest)
        off = WITHHELD.with_overrides({"depth.enabled": False})
        assert InMemoryPipeline(given, off).reason_to_skip("depth") == "the source has depth"
