"""`data list|show|check` and `export --to colmap|transforms` as a user runs them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from data_catalog.catalog import read
from data_catalog.inspection import Inspection, inspect
from data_catalog.phantom.config import PhantomConfig
from data_catalog.phantom.recording import record
from data_catalog.readers.colmap_model import write_colmap
from extrags.config import IngestConfig, PipelineConfig
from extrags.sequence import EndoscopicSequence
from extrags.store import Store
from flows.cli import main
from flows.methods import method_config
from flows.runners import DirectRunner
from flows.wiring import run_sequence
from tests.documented_json import undocumented, undocumented_items
from tests.flows.tiny import SEQUENCE, TINY

pytestmark = pytest.mark.usefixtures("untouched_environment")

SMALL = ["--set", "ingest.width=48", "--set", "ingest.max_frames=8"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A folder with two recordings, depth and poses: quicker to read than a phantom is to render."""
    config = PhantomConfig(
        scene=5, width=64, height=51, train_every=25, test_frames=4, shadows=False, supersample=1
    )
    folder = tmp_path_factory.mktemp("scene") / "colon"
    write_colmap(record(config, "phantom/5"), folder)
    return str(folder)


REFINING = {**TINY, "ingest.max_frames": 8, "coarse.refine_poses": True, "coarse.iterations": 60}
# So many iterations that refine_poses=auto tries; nothing is run.
TRYING = {**TINY, "ingest.max_frames": 8, "coarse.iterations": 1000}


def arguments_of(settings: dict[str, Any]) -> list[str]:
    return ["--profile", "quick"] + [
        part for name, value in settings.items() for part in ("--set", f"{name}={json.dumps(value)}")
    ]


REFINING_ARGUMENTS, TRYING_ARGUMENTS = arguments_of(REFINING), arguments_of(TRYING)


@pytest.fixture(scope="module")
def refined(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, PipelineConfig, EndoscopicSequence]:
    """A store in which poses were refined, the settings of that run, and its frames."""
    store = str(tmp_path_factory.mktemp("refined") / "store")
    config = method_config("extrags", "quick", REFINING)
    outcome = run_sequence(SEQUENCE, config, store, DirectRunner(store), until="coarse")
    return store, config, Store(store).load(EndoscopicSequence, outcome.refs["sequence"])


class TestList:
    def test_everything_with_what_is_known(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["data", "list"]) == 0
        said = capsys.readouterr().out
        assert "phantom/0@sparse" in said
        assert "sinus/hopkins" in said
        assert "of them can be read here" in said

    def test_filters(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["data", "list", "phantom", "--here", "--json", "-"]) == 0
        listed = json.loads(capsys.readouterr().out)
        assert listed
        assert undocumented_items(listed, "a-catalogue-entry") == []
        assert all(item["name"].startswith("phantom/") and item["available"] for item in listed)
        assert main(["data", "list", "s*/*", "--json", "-"]) == 0
        listed = json.loads(capsys.readouterr().out)
        assert undocumented_items(listed, "a-catalogue-entry") == []
        assert {item["name"] for item in listed} >= {"sinus/hopkins", "simcol3d/s1"}

    def test_what_is_given_by_name_alone(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["data", "list", "phantom/77@covered", "--json", "-"]) == 0
        assert [item["name"] for item in json.loads(capsys.readouterr().out)] == ["phantom/77@covered"]

    def test_nothing_that_matches(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["data", "list", "phantom/*@covered", "--json", "-"]) == 0
        said = capsys.readouterr()
        assert json.loads(said.out) == []
        assert "nothing in the list matches phantom/*@covered; did you mean" in said.err
        assert "others are given by their whole name" in said.err


class TestShow:
    def test_measured_and_pictured(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        picture = tmp_path / "sheet.png"
        arguments = ["data", "show", "phantom/5@sparse", *SMALL, "--picture", str(picture), "--json", "-"]
        assert main(arguments) == 0
        shown = json.loads(capsys.readouterr().out)
        assert undocumented(shown, "data-show") == []
        assert shown["frames"] == 48
        assert shown["measured"]["frames"] == 8
        assert shown["measured"]["has_depth"] is True
        assert np.array(Image.open(picture)).shape[2] == 3

    def test_a_folder_as_json(self, scene: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["data", "show", scene, "--json", "-"]) == 0
        shown = json.loads(capsys.readouterr().out)
        assert undocumented(shown, "data-show") == []
        assert shown["paths"] == [scene]

    def test_at_the_size_of_a_profile(self, shared_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
        """As a run of that profile reads it."""
        widths = []
        for profile in ("quick", "balanced"):
            assert main(["data", "show", "simcol3d/s1", "--profile", profile, "--json", "-"]) == 0
            widths.append(json.loads(capsys.readouterr().out)["measured"]["width"])
        assert widths[0] == widths[1] // 2

    def test_a_folder_as_a_table(self, scene: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["data", "show", scene]) == 0
        said = capsys.readouterr().out
        assert "specular_share" in said
        assert "colmap" in said
        assert "['" not in said

    def test_without_the_data(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.setattr("data_catalog.named_folders.data_roots", lambda: [tmp_path])
        assert main(["data", "show", "sinus/hopkins", "--json", "-"]) == 0
        shown = json.loads(capsys.readouterr().out)
        assert undocumented(shown, "data-show") == []
        assert shown["available"] is False
        assert shown["measured"] is None
        assert main(["data", "show", "sinus/hopkins", "--picture", str(tmp_path / "x.png")]) == 1
        assert "EXTRAGS_DATA" in capsys.readouterr().err


class TestCheck:
    def test_right_and_wrong(self, scene: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["data", "check", scene]) == 0
        assert "nothing is wrong" in capsys.readouterr().out
        (tmp_path / "empty").mkdir()
        assert main(["data", "check", scene, str(tmp_path / "empty")]) == 1
        said = capsys.readouterr().out
        assert "nothing is wrong" in said
        assert "the folder is empty" in said

    def test_each_is_told_once_it_is_read(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Of several long recordings nothing was said before the last of them was read."""
        told = []

        def heard(name: str, config: IngestConfig) -> Inspection:
            told.append(capsys.readouterr().out)
            return inspect(name, config)

        monkeypatch.setattr("data_catalog.inspection.inspect", heard)
        folders = [tmp_path / name for name in ("first", "second")]
        for folder in folders:
            folder.mkdir()
        assert main(["data", "check", *map(str, folders)]) == 1
        assert told[0] == ""
        assert "first: 1 problem" in told[1]
        assert "second: 1 problem" in capsys.readouterr().out

    def test_as_json(self, scene: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        (tmp_path / "poses.json").write_text("{")
        assert main(["data", "check", str(tmp_path), scene, "--json", "-"]) == 1
        inspections = json.loads(capsys.readouterr().out)
        assert undocumented_items(inspections, "an-inspection") == []
        found, right = inspections
        assert right["ok"] is True
        assert right["facts"]["has_depth"] is True
        assert found["ok"] is False
        (finding,) = found["findings"]
        assert finding["kind"] == "error"
        assert finding["file"].endswith("poses.json")
        assert "not readable as JSON" in finding["sentence"]

    def test_one_that_cannot_be_read_hides_no_other(
        self, scene: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """Settings may be wrong for one source alone, and names may be misspelt."""
        for number in range(4):
            Image.new("RGB", (40, 32), (200, 90, 60)).save(tmp_path / f"{number}.png")
        given = [str(tmp_path), "phantm/1@sparse", scene, "nothing/here"]
        assert main(["data", "check", *given, "--json", "-", *SMALL]) == 2
        said = capsys.readouterr()
        small, right = json.loads(said.out)
        (finding,) = small["findings"]
        assert finding["file"] == str(tmp_path)
        assert "is larger than the source's 40 x 32" in finding["sentence"]
        assert right["facts"]["width"] == 48
        assert "phantm/1@sparse" in said.err
        assert "; no sequence 'nothing/here'" in said.err

    def test_unknown_name_is_wrong_usage(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["data", "check", "phantm/1@sparse"]) == 2
        assert "Did you mean" in capsys.readouterr().err


class TestExport:
    @pytest.mark.parametrize("to", ["colmap", "colmap-text", "transforms"])
    def test_what_is_written_is_read_back(
        self, to: str, scene: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        target = tmp_path / "scene"
        assert main(["export", scene, "--to", to, "--out", str(target)]) == 0
        given, back = read(scene), read(target)
        assert f"{len(given)} frames with poses" in capsys.readouterr().out
        assert back.frame_names == given.frame_names
        np.testing.assert_array_equal(back.rgb, given.rgb)
        np.testing.assert_array_equal(back.test, given.test)
        np.testing.assert_array_equal(back.recording, given.recording)
        np.testing.assert_allclose(back.world_from_camera, given.world_from_camera, atol=1e-12)
        assert back.metric
        assert back.points is not None
        assert len(back.points) > 500
        assert main(["data", "check", str(target)]) == 0

    def test_nothing_is_written_over(
        self, scene: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (tmp_path / "precious.txt").write_text("x")
        assert main(["export", scene, "--to", "colmap", "--out", str(tmp_path)]) == 2
        assert "is not an empty folder" in capsys.readouterr().err
        assert [file.name for file in tmp_path.iterdir()] == ["precious.txt"]

    def test_a_source_without_poses_needs_its_run(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        rng = np.random.default_rng(0)
        folder = tmp_path / "frames"
        folder.mkdir()
        for k in range(3):
            Image.fromarray(rng.integers(30, 220, (40, 48, 3)).astype(np.uint8)).save(folder / f"{k}.png")
        arguments = ["export", str(folder), "--to", "colmap", "--out", str(tmp_path / "scene")]
        assert main([*arguments, "--store", str(tmp_path / "store")]) == 1
        assert "run it first" in capsys.readouterr().err

    def test_poses_that_a_run_might_correct_are_those_of_the_source_without_one(
        self, tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        target = tmp_path / "scene"
        trying = [*TRYING_ARGUMENTS, "--store", str(tmp_path / "store")]
        assert main(["export", SEQUENCE, "--to", "transforms", "--out", str(target), *trying]) == 0
        assert "poses are those of the source, which a run might correct" in caplog.text
        given = read(SEQUENCE, method_config("extrags", "quick", TRYING).ingest)
        found, expected = (np.sort(frames.cameras.centers[:, 2]) for frames in (read(target), given))
        np.testing.assert_allclose(found, expected, atol=1e-9)

    @pytest.mark.parametrize("to", ["colmap", "transforms"])
    def test_poses_are_those_the_scene_was_made_with(
        self,
        to: str,
        refined: tuple[str, PipelineConfig, EndoscopicSequence],
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        """The source has poses; those that the run has refined are written, not the source's."""
        store, config, used = refined
        target = tmp_path / "scene"

        def export(store: str) -> int:
            return main(
                ["export", SEQUENCE, "--to", to, "--out", str(target), "--store", store, *REFINING_ARGUMENTS]
            )

        assert export(str(tmp_path / "store")) == 1
        assert "run it first" in capsys.readouterr().err
        assert export(store) == 0, capsys.readouterr().err
        given = read(SEQUENCE, config.ingest)
        written = read(target)
        np.testing.assert_allclose(written.K, used.K, atol=1e-10)

        def differences(frames: EndoscopicSequence) -> np.ndarray:
            """To the nearest pose written; names give frames another order."""
            there, own = written.world_from_camera, frames.world_from_camera
            assert there is not None
            assert own is not None
            return np.asarray(np.abs(there[None] - own[:, None]).max(axis=(2, 3)).min(axis=1))

        assert differences(used).max() < 1e-9
        assert differences(given)[given.train].min() > 1e-5
