"""Costs on record in a store, and the prediction of a run."""

from __future__ import annotations

import inspect
import json
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

import pytest
from PIL import Image
from prefect import Task

import tasks
from extrags import placement
from extrags.config import PipelineConfig, profile_config
from extrags.cores import processor_name
from extrags.errors import SourceNotFoundError
from extrags.raster import native_isa
from extrags.run_costs import CostModel, Workload, packaged_model
from extrags.stages import STAGES, modelled_tasks
from extrags.store import MANIFEST, Store
from flows import run_costs
from flows.commands.plan import print_prediction
from flows.methods import METHODS, method_config
from flows.outcome import SequenceOutcome, StageRow
from flows.run_costs import RunPrediction, planned_work, predict_run, recorded_costs
from flows.runners import DirectRunner
from flows.wiring import run_sequence
from flows.workloads import expected_work, work_before_reading
from tests.data_catalog.footage_fixture import write_video
from tests.data_catalog.test_content import moving_scene
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
    # SEQUENCE is a phantom, in every record that rests on its frames.
    assert all(work.drawn for work, _ in processor)
    # The waves are part of the exploration.
    parts = filled.ls("explore*")
    (explore,) = [cost for _, cost in elapsed if cost.task == "explore"]
    assert explore.seconds == pytest.approx(sum(part.elapsed_s for part in parts), abs=0.01)


def test_records_of_a_video_say_how_much_of_it_was_looked_at(tmp_path: Path) -> None:
    file = write_video(tmp_path / "exam.avi", moving_scene(40, 160, 96, speed=6))
    store = Store(tmp_path / "store")
    config = CONFIG.with_overrides({"ingest.max_frames": 8, "ingest.width": 80, "ingest.height": None})
    outcome = run_sequence(str(file), config, store.root, DirectRunner(store.root), until="ingest")
    assert outcome.status == "ok"

    def of_ingest() -> list[Workload]:
        return [work for work, cost in recorded_costs(store, CONFIG)[1] if cost.task == "ingest"]

    (work,) = of_ingest()
    assert (work.looked_at, work.passed_over, work.source_pixels) == (40, 0, 160 * 96)
    # Earlier versions did not say; reading a video then seems to take many times as long as its frames.
    (place,) = [path for path in Path(store.root).rglob(MANIFEST) if '"looked_at"' in path.read_text()]
    manifest = json.loads(place.read_text())
    del manifest["counts"]["looked_at"]
    place.write_text(json.dumps(manifest))
    assert of_ingest() == []


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


class TestMachines:
    """A store may be shared by machines, and a machine have a GPU."""

    @staticmethod
    def made_elsewhere(
        store: Store, monkeypatch: pytest.MonkeyPatch, counts: dict[str, object | None]
    ) -> None:
        """What the store holds, as if its manifests told this of the machine; None: nothing."""
        changed = [
            manifest.model_copy(
                update={
                    "counts": {
                        name: value
                        for name, value in {**manifest.counts, **counts}.items()
                        if value is not None
                    }
                }
            )
            for manifest in store.ls()
        ]
        monkeypatch.setattr(Store, "ls", lambda *_: changed)

    def test_manifests_tell_where_they_were_made(self, filled: Store) -> None:
        for manifest in filled.ls("coarse*"):
            assert manifest.counts["processor"] == processor_name()
            assert manifest.counts["isa"] == native_isa()
            assert manifest.counts["device"] == "cpu"

    @pytest.mark.parametrize("other", [{"processor": "another"}, {"isa": "sse2"}, {"device": "another GPU"}])
    def test_records_of_other_machines_do_not_count(
        self, filled: Store, monkeypatch: pytest.MonkeyPatch, other: dict[str, object | None]
    ) -> None:
        self.made_elsewhere(filled, monkeypatch, other)
        assert recorded_costs(filled, CONFIG) == ([], [])
        assert recorded_costs(filled, CONFIG, of_this_machine=False)[0]

    def test_records_without_a_machine_count_where_all_are_such(
        self, filled: Store, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        told = filled.ls()
        number = len(recorded_costs(filled, CONFIG)[0])
        self.made_elsewhere(filled, monkeypatch, dict.fromkeys(("processor", "isa", "device")))
        assert len(recorded_costs(filled, CONFIG)[0]) == number
        untold = filled.ls()
        # One that tells is enough for the others to be of who knows which machine.
        mixed = [one if one.stage == "coarse" else other for one, other in zip(told, untold, strict=True)]
        monkeypatch.setattr(Store, "ls", lambda *_: mixed)
        assert {cost.task for _, cost in recorded_costs(filled, CONFIG)[0]} == {"coarse"}

    def test_what_a_gpu_takes_is_not_known(
        self, filled: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(run_costs, "probe_seconds", lambda: 0.01)
        monkeypatch.setattr(run_costs, "ENOUGH_SECONDS", 0.0)
        stages = {"ingest", "depth", "coarse", "surface", "finetune", "evaluate"}
        for store in (filled, Store(tmp_path)):
            for given in ({"device": "cuda"}, {"device": "cpu", "depth.device": "cuda"}):
                work = Workload(48 * 40, 24, 12, 12, UNTRAINED.with_overrides(given))
                found = predict_run(store, work, stages)
                assert "depth" in found.unknown
                assert {"ingest", "surface"} <= {item.stage for item in found.stages}
                assert {"coarse", "finetune"}.isdisjoint(found.unknown) == (given["device"] == "cpu")
            on_processor = Workload(48 * 40, 24, 12, 12, UNTRAINED.with_overrides({"device": "cpu"}))
            assert predict_run(store, on_processor, stages).unknown == []

    def test_auto_is_what_the_machine_has(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(run_costs, "probe_seconds", lambda: 0.01)
        monkeypatch.setattr(placement, "_reason_against_cuda", lambda _: "")
        work = Workload(48 * 40, 24, 12, 12, UNTRAINED)
        assert predict_run(Store(tmp_path), work, {"ingest", "coarse"}).unknown == ["coarse"]

    def test_records_of_this_gpu_tell_of_it(self, filled: Store, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(run_costs, "ENOUGH_SECONDS", 0.0)
        monkeypatch.setattr("extrags.devices.device_name", lambda kind: "fast" if kind == "cuda" else kind)
        on_gpu = [
            manifest.model_copy(
                update={
                    "counts": {**manifest.counts, "device": "fast", "processor_s": 50.0},
                    "config": {**manifest.config, "device": "cuda"},
                }
            )
            if manifest.stage == "coarse"
            else manifest
            for manifest in filled.ls()
        ]
        monkeypatch.setattr(Store, "ls", lambda *_: on_gpu)
        (work,) = (work for work, cost in recorded_costs(filled, UNTRAINED)[1] if cost.task == "coarse")
        assert work.config.device == "cuda"

        def coarse(device: str) -> float:
            config = work.config.with_overrides({"device": device})
            found = predict_run(filled, replace(work, config=config), {"coarse"})
            return found.processor_seconds

        assert coarse("cuda") == pytest.approx(50)
        assert coarse("cpu") < 10

    def test_the_tasks_that_run_on_the_device_are_those_that_are_given_one(self) -> None:
        given = set()
        for module in iter_modules(tasks.__path__):
            for task in vars(import_module(f"tasks.{module.name}")).values():
                if (
                    isinstance(task, Task)
                    and "device" in inspect.signature(inspect.unwrap(task.fn)).parameters
                ):
                    given.add(task.name)
        modelled = {task: cost for stage in STAGES for task, cost in modelled_tasks(stage).items()}
        assert {task for task, cost in modelled.items() if cost.on_device} == given & set(modelled)


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
