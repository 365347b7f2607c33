"""Costs on record in a store, and the prediction of a run."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from extrags.config import PipelineConfig, profile_config
from extrags.errors import SourceNotFoundError
from extrags.run_costs import CostModel, Workload, packaged_model
from extrags.store import Store
from flows import run_costs
from flows.commands.plan import print_prediction
from flows.methods import METHODS, method_config
from flows.outcome import SequenceOutcome, StageRow
from flows.run_costs import RunPrediction, planned_work, predict_run, recorded_costs
from flows.runners import DirectRunner
from flows.wiring import run_sequence
from flows.workloads import expected_work, work_before_reading
from tests.flows.tiny import SEQUENCE, TINY

CONFIG: PipelineConfig = profile_config("quick").with_overrides(TINY)
UNTRAINED = CONFIG.with_overrides({"enhance.train_iterations": 0})
"""The restorer as it comes, of which the model knows."""


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Store:
    store = Store(tmp_path_factory.mktemp("costs"))
    outcome = run_sequence(SEQUENCE, CONFIG, store.root, DirectRunner(store.root), until="explore")
    assert outcome.status == "ok"
    assert all(row.processor_seconds is not None for row in outcome.stages if row.tasks)
    assert all(row.spent_seconds == pytest.approx(row.made_seconds) for row in outcome.stages)
    return store


def test_records_have_the_numbers_that_costs_depend_on(filled: Store) -> None:
    elapsed, processor = recorded_costs(filled, profile_config("balanced"))
    assert len(elapsed) == len(processor) > 5
    work, cost = next(item for item in processor if item[1].task == "coarse")
    numbers = work.numbers()
    assert (numbers["pixels"], numbers["frames"], numbers["iterations"]) == (48 * 40, 24, 120)
    assert cost.seconds > 0
    assert cost.peak_mib
    # The waves are part of the exploration.
    parts = filled.ls("explore*")
    (explore,) = [cost for _, cost in elapsed if cost.task == "explore"]
    assert explore.seconds == pytest.approx(sum(part.elapsed_s for part in parts), abs=0.01)


def test_the_history_of_a_store_tells_the_pace(filled: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_costs, "ENOUGH_SECONDS", 0.0)
    work = Workload(48 * 40, 24, 12, 12, CONFIG)
    model = CostModel({"coarse": {"one": 1.0}, "ingest": {"one": 1.0}}, {"coarse": {"one": 300.0}}, 0.01)
    found = predict_run(filled, work, {"ingest", "coarse", "report"}, model=model)
    assert (found.source, found.unknown, found.peak_mib) == ("history", ["report"], 300.0)
    _, processor = recorded_costs(filled, CONFIG)
    spent = sum(cost.seconds for _, cost in processor if cost.task in ("ingest", "coarse"))
    assert found.processor_seconds == pytest.approx(spent, rel=0.6)
    assert found.seconds is not None


def test_what_a_backend_takes_is_unknown_without_records_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_costs, "probe_seconds", lambda: 0.01)
    stages = {"coarse", "enhance", "finetune", "evaluate"}

    def predicted(stages: set[str] = stages, **settings: object) -> RunPrediction:
        changes = {name.replace("__", "."): value for name, value in settings.items()}
        config = UNTRAINED.with_overrides(changes)
        return predict_run(Store(tmp_path), Workload(48 * 40, 24, 12, 12, config), stages)

    assert predicted().unknown == []
    classical = predicted(enhance__backend="classical")
    assert classical.unknown == ["enhance", "finetune-judge", "evaluate-restore"]
    assert [row.stage for row in classical.stages] == ["coarse", "finetune", "evaluate"]
    assert predicted(enhance__train_iterations=9, enhance__steps=1).unknown == ["enhance-train"]
    assert predicted(finetune__keep_scene=True).unknown == ["finetune"]
    # A radiance field stands in the place of the scene, and of its renders.
    field = predicted({"coarse", "evaluate"}, uc_nerf__enabled=True)
    assert field.unknown == ["coarse", "evaluate-render"]
    # Where nothing is restored, a backend is neither here nor there.
    assert predicted(stages - {"enhance"}, enhance__backend="classical").unknown == []


def test_the_restorer_of_a_record_is_the_one_it_was_made_with(filled: Store) -> None:
    """What restores holds the settings it reads itself, which the restorer's are not among."""
    config = CONFIG.with_overrides({"enhance.backend": "classical"})
    outcome = run_sequence(SEQUENCE, config, filled.root, DirectRunner(filled.root), until="enhance")
    assert outcome.status == "ok"
    _, processor = recorded_costs(filled, UNTRAINED)
    backends = {cost.task: work.config.enhance.backend for work, cost in processor}
    assert backends["enhance"] == backends["enhance-train"] == "classical"
    pace = packaged_model().pace(processor, UNTRAINED)
    other = packaged_model().pace(processor, config)
    assert pace["evaluate-restore"] == pytest.approx(pace["evaluate"])
    assert pace["enhance"] == pytest.approx(pace["evaluate"])
    assert other["enhance"] != pace["enhance"]
    assert "evaluate-restore" not in other


def test_records_of_gaussians_tell_nothing_of_a_radiance_field(filled: Store) -> None:
    config = UNTRAINED.with_overrides({"uc_nerf.enabled": True})
    _, processor = recorded_costs(filled, config)
    pace = packaged_model().pace(processor, config)
    assert "coarse" not in pace
    assert "ingest" in pace


def test_without_history_a_probe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_costs, "probe_seconds", lambda: 0.03)
    model = CostModel({"ingest": {"frames": 2.0}}, {}, 0.01)
    work, stages = work_before_reading(SEQUENCE, CONFIG, {})
    assert work.pixels == 48 * 40
    assert "poses" not in stages
    assert "depth" not in stages
    found = predict_run(Store(tmp_path), work, {"ingest"}, model=model)
    assert (found.source, found.seconds) == ("probe", None)
    assert found.processor_seconds == pytest.approx(3 * 2 * 24)


def test_without_kernels_what_renders_is_at_the_pace_of_another_rasteriser(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run_costs, "probe_seconds", lambda: 1.0)
    monkeypatch.setattr(run_costs, "probed_rasteriser", lambda: "reference")
    model = CostModel({"ingest": {"frames": 2.0}, "coarse": {"one": 3.0}}, {}, 0.01)
    work, _ = work_before_reading(SEQUENCE, CONFIG, {})
    found = predict_run(Store(tmp_path), work, {"ingest", "coarse"}, model=model)
    assert [item.processor_seconds for item in found.stages] == pytest.approx([2 * 24, 100 * 3.0])
    print_prediction(found)
    assert "kernels are missing: rendering at the speed that a short probe of the reference" in "".join(
        capsys.readouterr().out
    )


class TestPlannedWork:
    def test_a_radiance_field_is_not_explored(self, filled: Store) -> None:
        (read,) = filled.ls("ingest*")
        found = filled.find(read.key)
        assert found is not None
        rows = [StageRow(stage, "skipped") for stage in ("poses", "depth", "assess")]
        outcome = SequenceOutcome(SEQUENCE, stages=rows, refs={"ingest": found})
        config = CONFIG.with_overrides({"uc_nerf.enabled": True})
        assert planned_work(filled, outcome, config)[1] == {"ingest", "coarse", "evaluate", "report"}


class TestWorkBeforeReading:
    def test_of_a_path_names_and_headers_tell(self, tmp_path: Path) -> None:
        for number in range(9):
            Image.new("RGB", (60, 50), (90, 60, 50)).save(tmp_path / f"{number}.png")
        # Nothing is read of the pictures.
        (tmp_path / "3.png").write_bytes((tmp_path / "3.png").read_bytes()[:60])
        work, stages = work_before_reading(str(tmp_path), CONFIG, {"depth"})
        assert (work.pixels, work.width) == (48 * 40, 48)
        assert (work.frames, work.train, work.test) == (9, 7, 2)
        assert "poses" in stages
        assert "depth" not in stages

    def test_stages_that_the_settings_do_without_are_not_among_them(self, tmp_path: Path) -> None:
        for number in range(9):
            Image.new("RGB", (60, 50), (90, 60, 50)).save(tmp_path / f"{number}.png")
        plain, leave_out = method_config("3dgs", "quick"), METHODS["3dgs"].leave_out
        _, stages = work_before_reading(str(tmp_path), plain, leave_out)
        assert stages == {"ingest", "poses", "coarse", "evaluate", "report"}
        _, stages = work_before_reading(str(tmp_path), CONFIG, ())
        assert {"depth", "assess", "finetune"} <= stages

    @pytest.mark.parametrize("keep", [True, False])
    def test_an_imported_scene_is_kept_where_it_is_to_be(self, keep: bool) -> None:
        config = CONFIG.with_overrides({"imported.scene": "their.ply", "imported.keep": keep})
        work, stages = work_before_reading(SEQUENCE, config, ())
        assert work.config.finetune.keep_scene is keep
        assert "coarse" not in stages
        assert not work_before_reading(SEQUENCE, CONFIG, ())[0].config.finetune.keep_scene

    def test_a_wrong_source_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(SourceNotFoundError, match="the folder is empty"):
            work_before_reading(str(tmp_path), CONFIG, ())
        assert expected_work(str(tmp_path), CONFIG) is None
