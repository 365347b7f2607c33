"""`extrags import`: a scene from elsewhere through the stages after the coarse one."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from extrags.config import PipelineConfig
from extrags.gaussians import Gaussians
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.splat_files import bake_recorded_light, write_compressed_ply, write_sog, write_spz
from extrags.store import Store
from flows.cli import main
from flows.outcome import SequenceOutcome
from flows.run_costs import planned_work
from flows.runners import DirectRunner
from flows.wiring import run_sequence
from tests.flows.tiny import SEQUENCE, TINY, tiny_config

pytestmark = pytest.mark.usefixtures("untouched_environment")

Finished = tuple[str, SequenceOutcome]


@pytest.fixture(scope="module")
def theirs(finished: Finished, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The coarse scene of another run, as its makers would hand it over."""
    store, outcome = Store(finished[0]), finished[1]
    scene = store.load(Scene, outcome.refs["coarse"])
    frames = store.load(EndoscopicSequence, outcome.refs["sequence"])
    file = tmp_path_factory.mktemp("theirs") / "scene.spz"
    write_spz(bake_recorded_light(scene, frames.training_cameras), file)
    return file


def config_arguments() -> list[str]:
    return [part for name, value in TINY.items() for part in ("--set", f"{name}={json.dumps(value)}")]


def config_of(file: Path, **more: Any) -> PipelineConfig:
    return tiny_config(imported__scene=str(file), **more)


def imported(store: str, file: Path, until: Any = "coarse", **more: Any) -> SequenceOutcome:
    return run_sequence(SEQUENCE, config_of(file, **more), store, DirectRunner(store), until=until)


def test_all_stages_go_on_from_it(finished: Finished, theirs: Path) -> None:
    store = finished[0]
    # Restorer and judge are not what this is about.
    outcome = imported(
        store, theirs, "finetune", enhance__backend="classical", finetune__judge__enabled=False
    )
    assert outcome.error is None
    assert [item.stage for item in outcome.stages if item.state == "skipped"] == ["poses", "depth"]
    row = outcome.row("coarse")
    assert row is not None
    assert "imported from scene.spz" in row.reason
    assert "held-out frames" in row.reason
    manifest = Store(store).manifest(outcome.refs["coarse"])
    assert manifest.stage == "import-scene"
    assert manifest.config["scale"] == 1.0
    assert len(manifest.config["digest"]) == 32
    final = Store(store).load(Scene, outcome.refs["finetune"])
    assert final.light is None
    assert len(final.gaussians) >= int(manifest.counts["n_gaussians"] or 0)


def test_the_file_counts_by_its_content(finished: Finished, theirs: Path, tmp_path: Path) -> None:
    store = finished[0]
    first = imported(store, theirs)
    moved = tmp_path / "renamed"
    shutil.copy(theirs, moved)
    again = imported(store, moved)
    assert again.refs["coarse"] == first.refs["coarse"]
    row = again.row("coarse")
    assert row is not None
    assert row.state == "cached"
    scene = Store(store).load(Scene, first.refs["coarse"])
    write_spz(scene.gaussians.subset(torch.arange(len(scene.gaussians) - 1)), moved)
    other = imported(store, moved)
    assert other.refs["coarse"] != first.refs["coarse"]


def test_a_plan_knows_what_it_makes_of_the_settings(finished: Finished, theirs: Path) -> None:
    """The costs of fine-tuning are those of a scene that is kept as it is."""
    store, config = Store(finished[0]), config_of(theirs)
    work, stages = planned_work(store, imported(store.root, theirs), config)
    assert work.config.finetune.keep_scene
    assert work.config.coarse.densify.max_gaussians >= config.coarse.densify.max_gaussians
    assert "finetune" in stages
    assert "coarse" not in stages


def test_what_a_kept_scene_costs_is_not_known(
    theirs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["plan", SEQUENCE, *config_arguments(), "--store", str(tmp_path), "--imported.scene", str(theirs)]
    assert main([*given, "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    for prediction in (found["predicted"], found["without_plan"]):
        assert "finetune" in prediction["unknown"]
        assert not {"coarse", "finetune"}.intersection(row["stage"] for row in prediction["stages"])
    assert main([*given, "--before", "--json", "-"]) == 0
    assert "finetune" in json.loads(capsys.readouterr().out)["predicted"]["unknown"]


def test_another_unit_fails_the_stage_and_says_so(finished: Finished, theirs: Path) -> None:
    outcome = imported(finished[0], theirs, imported__scale=0.001)
    assert outcome.status == "failed"
    assert "imported.scale" in str(outcome.error)


class TestCommand:
    def test_what_is_in_the_store_is_found(
        self, finished: Finished, theirs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        store = finished[0]
        imported(store, theirs)
        settings = config_arguments()
        arguments = ["--sequence", SEQUENCE, "--profile", "quick", "--store", store, *settings]
        result = tmp_path / "out.json"
        assert main(["import", str(theirs), *arguments, "--until", "coarse", "--json", str(result)]) == 0
        (sequence,) = json.loads(result.read_text())["sequences"]
        (stage,) = [row for row in sequence["stages"] if row["stage"] == "coarse"]
        assert stage["state"] == "cached"
        assert "imported from scene.spz" in stage["reason"]
        target = tmp_path / "again.ply"
        again = ["export", SEQUENCE, "--scene", "coarse", *arguments[2:], "-o", str(target)]
        assert main([*again, "--imported.scene", str(theirs)]) == 0
        assert "without light" in capsys.readouterr().out

    @pytest.mark.parametrize("first", [SEQUENCE, "{folder}"])
    @pytest.mark.parametrize("second", ["none.ply", "{file}"])
    def test_file_and_sequence_reversed(
        self, first: str, second: str, theirs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        first, second = (part.format(file=theirs, folder=tmp_path) for part in (first, second))
        assert main(["import", first, "--sequence", second, "--store", str(tmp_path / "store")]) == 2
        said = capsys.readouterr().err
        assert f"are reversed; expected extrags import {second} --sequence {first}" in said

    def test_with_the_cameras_of_a_colmap_folder(
        self, finished: Finished, theirs: Path, tmp_path: Path
    ) -> None:
        """As others hand over what they have trained from."""
        folder, settings = tmp_path / "workspace", config_arguments()
        exported = ["export", SEQUENCE, "--profile", "quick", "--store", finished[0], *settings]
        assert main([*exported, "--to", "colmap", "-o", str(folder)]) == 0
        store = str(tmp_path / "store")
        config = config_of(theirs)
        outcome = run_sequence(str(folder), config, store, DirectRunner(store), until="coarse")
        assert outcome.error is None
        counts = Store(store).manifest(outcome.refs["coarse"]).counts
        assert float(counts["training_psnr"] or 0) > 15
        assert float(counts["seen_share"] or 0) > 0.9

    @pytest.mark.parametrize(
        ("arguments", "code", "message"),
        [
            (["none.ply"], 1, "no such file"),
            (["{folder}/a.sog"], 1, "a zip archive, as SOG files are: neither is read; export the scene as"),
            (["{folder}/a.ply"], 1, "a compressed PLY, which is not read: export the scene as PLY or SPZ"),
            (["{file}", "--imported.scene", "b.ply"], 2, "set twice"),
            (["{file}", "--units", "2", "--imported.scale", "3"], 2, "set twice"),
            (["{file}", "--scene-scale", "2", "--imported.scale", "3"], 2, "set twice"),
            (["{file}", "--units", "0"], 2, "imported.scale is 0"),
            (["{file}", "--coarse.refine_poses", "true"], 2, "cannot be set beside it"),
            (["{file}", "--method", "uc-nerf"], 2, "cannot be set beside it"),
        ],
    )
    def test_wrong_usage(
        self,
        arguments: list[str],
        code: int,
        message: str,
        theirs: Path,
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        few = Gaussians.from_points(np.eye(3), np.zeros((3, 3)), np.ones(3))
        write_sog(few, tmp_path / "a.sog")
        write_compressed_ply(few, tmp_path / "a.ply")
        given = [part.format(file=theirs, folder=tmp_path) for part in arguments]
        store = str(tmp_path / "store")
        assert main(["import", *given, "--sequence", SEQUENCE, "--store", store]) == code
        said = capsys.readouterr().err
        assert message in said
        assert "Traceback" not in said


def test_frames_without_poses_are_refused_before_they_are_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A video was read and its frames chosen before the run said so."""

    def started(**_: object) -> None:
        pytest.fail("a flow was started")

    monkeypatch.setattr("flows.dataset.reconstruct_dataset", started)
    frames = tmp_path / "frames"
    frames.mkdir()
    for number in range(8):
        Image.new("RGB", (48, 40), (90, 10 * number, 30)).save(frames / f"{number:04d}.png")
    scene = tmp_path / "scene.ply"
    scene.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float opacity\nend_header\n")
    results = tmp_path / "results.json"
    arguments = ["--store", str(tmp_path / "store"), "--json", str(results)]
    assert main(["import", str(scene), "--sequence", str(frames), *arguments]) == 1
    assert "failed in poses" in capsys.readouterr().err
    (found,) = json.loads(results.read_text())["sequences"]
    states = {row["stage"]: (row["state"], row["reason"]) for row in found["stages"]}
    assert states["ingest"] == ("skipped", "poses failed")
    assert states["poses"][0] == "failed"
    assert "an imported scene needs the cameras it was made with" in states["poses"][1]
