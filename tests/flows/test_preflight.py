"""A missing model is told before anything is reconstructed; a changed one is another artefact."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from extrags.config import EnhanceConfig
from extrags.errors import ConfigError, WeightsError
from extrags.metrics.lpips_weights import WEIGHTS_VARIABLE
from extrags.raster.native import usable_isas
from extrags.store import Ref, Store
from flows.benchmark import benchmark
from flows.cases import SequenceCase
from flows.cli import main
from flows.methods import METHODS
from flows.outcome import SequenceOutcome
from flows.outcome_records import outcome_records
from flows.preflight import preflight, preflight_cases
from flows.runners import DirectRunner, NotInStoreError, StoreRunner
from flows.sequence import reconstruct_sequence
from flows.settings import pipeline_config
from flows.wiring import run_sequence
from tasks.enhance import train
from tasks.stage import stage_key
from tasks.weights import restorer_digest
from tests.extrags.restoration.pretrained.fake_clone import write_clone
from tests.extrags.restoration.pretrained.tiny_pipelines import ADAPTERS
from tests.flows.tiny import SEQUENCE, tiny_config

pytestmark = pytest.mark.usefixtures("untouched_environment")

MISSING = {"enhance.pretrained_weights": "no/such.safetensors"}


@pytest.fixture
def run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """`extrags run` with settings: its exit code and its one sentence."""

    def command(*settings: str) -> tuple[int, str]:
        store = tmp_path / "store"
        given = [part for setting in settings for part in ("--set", setting)]
        code = main(["run", SEQUENCE, "--profile", "quick", "--store", str(store), *given])
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert not list((store / "artefacts").glob("*"))
        return code, said.removeprefix("extrags: ").strip()

    return command


class TestSentences:
    @pytest.mark.parametrize("backend", sorted(ADAPTERS))
    def test_models(
        self,
        backend: str,
        run: Callable[..., tuple[int, str]],
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        pytest.importorskip("diffusers", reason="needs extrags[diffusers]")
        import huggingface_hub.constants

        monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
        rule = ADAPTERS[backend].rule
        assert run(f"enhance.backend={backend}") == (
            1,
            f"the model {rule.usual_model} is neither a folder here nor in the local Hugging Face cache. "
            f"extrags downloads nothing by default. Get it once with `hf download {rule.usual_model}` "
            f"({rule.size}), or set enhance.pretrained.model to a folder where a {rule.pipeline} was saved "
            "(it holds model_index.json), or allow the download with "
            "enhance.pretrained.local_files_only=false.",
        )

    def test_checkpoints(self, run: Callable[..., tuple[int, str]]) -> None:
        assert run("enhance.backend=dynamicrafter") == (
            2,
            "enhance.backend=dynamicrafter needs enhance.checkpoint.root; set root (your clone of the "
            "model's code), config (its YAML file) and checkpoint (its weights)",
        )

    def test_weights_of_the_embedded_restorer(self, run: Callable[..., tuple[int, str]]) -> None:
        code, said = run("enhance.pretrained_weights=no/such.safetensors")
        assert code == 1
        assert said.startswith(
            "enhance.pretrained_weights=no/such.safetensors: there is no file no/such.safetensors; expected"
        )

    def test_weights_of_lpips(self, run: Callable[..., tuple[int, str]]) -> None:
        code, said = run("evaluate.lpips_weights=no/such.npz")
        assert code == 1
        assert "no/such.npz" in said

    def test_damaged_weights_of_lpips(
        self, run: Callable[..., tuple[int, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """They were found out when the scene was evaluated, after everything else."""
        damaged = tmp_path / "weights" / "lpips_alex_v0.1.npz"
        damaged.parent.mkdir()
        damaged.write_bytes(b"PK" + bytes(998))
        monkeypatch.setenv(WEIGHTS_VARIABLE, str(damaged.parent))
        for settings in ([], [f"evaluate.lpips_weights={damaged}"]):
            code, said = run(*settings)
            assert code == 1
            assert said.startswith(f"{damaged}: not a readable npz file")

    def test_an_instruction_set(self, tmp_path: Path) -> None:
        """In a process of its own: the kernels read the variable once."""
        command = "import sys; from flows.cli import main; sys.exit(main(sys.argv[1:]))"
        given = ["run", SEQUENCE, "--profile", "quick", "--until", "poses", "--store", str(tmp_path)]
        told = subprocess.run(
            [sys.executable, "-c", command, *given],
            capture_output=True,
            text=True,
            check=False,
            env={**os.environ, "EXTRAGS_ISA": "sse9"},
        )
        assert told.returncode == 2
        assert told.stderr == (
            "extrags: EXTRAGS_ISA: instruction set 'sse9' is not usable here, expected one of "
            f"{', '.join(usable_isas())}\n"
        )
        assert not list(tmp_path.glob("artefacts/*"))


class TestRecords:
    """What fails before its first stage is on record like any run that failed; wrong usage is no run."""

    @pytest.mark.parametrize(
        ("setting", "recorded"),
        [("enhance.pretrained_weights=no/such.safetensors", True), ("enhance.backend=dynamicrafter", False)],
    )
    def test_a_command(
        self, setting: str, recorded: bool, run: Callable[..., tuple[int, str]], tmp_path: Path
    ) -> None:
        _, said = run(setting)
        records = list(outcome_records(Store(tmp_path / "store")).values())
        assert [(item["sequence"], item["status"], item["reason"]) for item in records] == (
            [(SEQUENCE, "failed", said)] if recorded else []
        )

    @pytest.mark.parametrize("inner", [False, True])
    def test_a_flow(self, inner: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Inside a dataset, that one sees to it."""
        monkeypatch.setattr("flows.sequence.is_inner_run", lambda: inner)
        with pytest.raises(WeightsError, match="no/such"):
            reconstruct_sequence.fn(SEQUENCE, profile="quick", settings=MISSING, store=str(tmp_path))
        records = list(outcome_records(Store(tmp_path)).values())
        assert [item["stage"] for item in records] == ([] if inner else ["ingest"])
        assert all("no/such" in item["reason"] for item in records)


class TestWhatIsLookedFor:
    def test_nothing_that_the_run_does_not_reach(self) -> None:
        config = pipeline_config("quick", MISSING)
        preflight(config, "explore")
        preflight(config, "report", METHODS["coarse"].leave_out)
        for until in ("enhance", "report"):
            with pytest.raises(WeightsError, match="no/such"):
                preflight(config, until)

    def test_a_place_of_weights_that_is_not_there(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "nowhere"))
        config = pipeline_config("quick")
        for _ in range(2):
            preflight(config, "report")
        (told,) = [record for record in caplog.records if record.name == "flows.preflight"]
        assert told.levelname == "WARNING"
        assert re.search(r"names .*nowhere, which does not exist; .* with alex stay empty", told.getMessage())

    def test_no_weights_of_lpips_are_looked_for_before_they_are_needed(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        damaged = tmp_path / "mine.npz"
        damaged.write_bytes(b"PK")
        monkeypatch.setenv(WEIGHTS_VARIABLE, str(damaged))
        preflight(pipeline_config("quick"), "explore")
        with pytest.raises(WeightsError, match=r"mine\.npz: not a readable npz file"):
            preflight(pipeline_config("quick"), "report")

    @pytest.mark.usefixtures("prefect_server")
    def test_what_one_sequence_of_a_dataset_lacks_stops_no_other(self) -> None:
        def lacking(name: str) -> SequenceCase:
            return SequenceCase(name, profile="quick", settings=MISSING)

        sound = SequenceCase("phantom/1", profile="quick")
        preflight_cases([lacking("phantom/0"), sound], "report")
        preflight_cases([sound, lacking("phantom/0")], "report")
        with pytest.raises(WeightsError, match="no/such"):
            preflight_cases([lacking("phantom/0"), lacking("phantom/1")], "report")

    @pytest.mark.usefixtures("shared_data")
    def test_of_each_method_one_sequence_must_be_able_to_run(self) -> None:
        """The method needs weights of LPIPS as well, which are looked for first."""
        sound = SequenceCase("phantom/1", profile="quick")
        lacking = SequenceCase("phantom/0", profile="quick", settings=MISSING, method="exploregs")
        with pytest.raises(WeightsError, match="no/such"):
            preflight_cases([sound, lacking], "report")

    def test_a_benchmark_looks_before_its_first_run(self, tmp_path: Path) -> None:
        with pytest.raises(WeightsError, match="no/such"):
            benchmark(
                sequences=[SEQUENCE], methods=["coarse", "extrags"], settings=MISSING, store=str(tmp_path)
            )
        assert Store(str(tmp_path)).ls() == []


class TestKeys:
    def test_other_weights_are_another_restorer(
        self, finished: tuple[str, SequenceOutcome], tmp_path: Path
    ) -> None:
        store, _ = finished
        weights = tmp_path / "mine.safetensors"
        weights.with_suffix(".json").write_text("{}")
        config = tiny_config(enhance__pretrained_weights=str(weights))
        # The plan lists all settings: it is another one. What follows it up to the restorer is not.
        run_sequence(SEQUENCE, config, store, DirectRunner(store), until="explore")
        missing = []
        for content in (b"first", b"other"):
            weights.write_bytes(content)
            with pytest.raises(NotInStoreError) as caught:
                run_sequence(SEQUENCE, config, store, StoreRunner(store))
            missing += re.findall(r"enhance-train-v\S+", str(caught.value))
        assert len(set(missing)) == 2

    def test_a_changed_checkpoint_is_prepared_again(
        self, finished: tuple[str, SequenceOutcome], tmp_path: Path
    ) -> None:
        store, outcome = finished
        root = write_clone(tmp_path / "clone")
        config = EnhanceConfig.model_validate(
            {
                "backend": "dynamicrafter",
                "checkpoint": {
                    "root": str(root),
                    "config": "configs/inference.yaml",
                    "checkpoint": str(root / "enhancer.ckpt"),
                    "device": "cpu",
                },
            }
        )
        inputs: dict[str, Any] = {
            "scene": at(outcome, "coarse"),
            "sequence": at(outcome, "training"),
            "config": config,
            "coarse": tiny_config().coarse,
            "model_digest": restorer_digest(config),
        }
        first = train.fn(store=store, **inputs)
        assert Store(store).find(stage_key(train, inputs)) == first
        with (root / "lvdm" / "models" / "ddpm3d.py").open("a") as stream:
            stream.write("\n")
        # Whoever began before cannot store the new one under the old one's key.
        changed = {**inputs, "model_digest": restorer_digest(config)}
        assert Store(store).find(stage_key(train, changed)) is None
        Store(store).rm(stage_key(train, inputs))
        with pytest.raises(WeightsError, match="not the one this run began with"):
            train.fn(store=store, **inputs)
        assert train.fn(store=store, **changed).digest != first.digest

    def test_a_model_that_is_gone_fails_the_run_when_nobody_looked(
        self, finished: tuple[str, SequenceOutcome]
    ) -> None:
        store, _ = finished
        config = tiny_config(enhance__backend="dynamicrafter")
        outcome = run_sequence(SEQUENCE, config, store, DirectRunner(store))
        assert outcome.status == "failed"
        assert isinstance(outcome.error, ConfigError)


def at(outcome: SequenceOutcome, name: str) -> Ref:
    return Ref(uri=outcome.artefacts[name], digest=outcome.digests[name])
