"""The catalogue as a newcomer meets it: its front door, its datasets, and readers from outside."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import data_catalog
from data_catalog import FolderReader, PosedFrame, SourceFrames
from data_catalog.catalog import DATASETS
from data_catalog.dataset import Dataset
from data_catalog.folders import READERS, readers, register_reader
from data_catalog.specular import specular_masks
from extrags.config import IngestConfig
from extrags.errors import ConfigError, PoseError, SourceError
from extrags.lens import Lens


def test_every_name_of_the_front_door_is_there() -> None:
    for name in data_catalog.__all__:
        assert getattr(data_catalog, name) is not None
        assert name in dir(data_catalog)
    with pytest.raises(AttributeError, match="no attribute 'raed'"):
        data_catalog.raed  # noqa: B018


def test_the_front_door_loads_nothing_by_itself() -> None:
    code = (
        "import sys, data_catalog; print([name for name in sys.modules if name.startswith('data_catalog.')])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


class TestDatasets:
    def test_names_are_unique_and_sources_come_home(self) -> None:
        assert len({dataset.name for dataset in DATASETS}) == len(DATASETS)
        for dataset in DATASETS:
            assert isinstance(dataset, Dataset)
            for entry in dataset.entries():
                assert dataset.describe(entry.name) == entry
                if entry.available:
                    source = dataset.resolve(entry.name)
                    assert source is not None
                    assert (source.name, source.dataset, source.format) == (
                        entry.name,
                        dataset.name,
                        entry.format,
                    )

    def test_a_name_of_another_dataset_is_left_to_it(self) -> None:
        names = [next(iter(dataset.entries())).name for dataset in DATASETS]
        for dataset in DATASETS:
            told = [dataset.describe(name) is not None for name in names]
            assert sum(told) == 1

    def test_a_source_of_no_dataset(self) -> None:
        source = data_catalog.resolve("phantom/0").model_copy(update={"dataset": "attic"})
        with pytest.raises(
            ConfigError, match="no dataset 'attic'; known: folders, phantom, caverns, ct_colon, c3vd"
        ):
            data_catalog.read(source)

    def test_reading_marks_the_highlights(self) -> None:
        sequence = data_catalog.read("phantom/1@sparse", IngestConfig(width=64, max_frames=4))
        assert sequence.specular is not None
        assert sequence.specular.any()
        np.testing.assert_array_equal(sequence.specular, specular_masks(sequence.rgb, sequence.mask))


class TestReaders:
    def test_names_are_unique_and_sets_are_of_their_reader(self) -> None:
        assert len({reader.name for reader in READERS}) == len(READERS)
        for reader in READERS:
            assert reader.summary
            assert reader.conventions
            assert all(item.format == reader.name for item in reader.named_sets)


def survey_frames(folder: Path, config: IngestConfig) -> SourceFrames:
    """A layout of nobody: `survey.json` with one focal length and positions, looking along z."""
    file = folder / "survey.json"
    content = json.loads(file.read_text())
    frames = []
    for name, position in content["positions"].items():
        pose = np.eye(4)
        pose[:3, 3] = position
        lens = Lens("SIMPLE_PINHOLE", (content["focal_px"], 24.0, 20.0), 48, 40)
        frames.append(PosedFrame(name, folder / name, lens, pose * content.get("scale", 1.0)))
    return SourceFrames(frames, pose_file=file, metric=True)


SURVEY = FolderReader(
    name="survey",
    version=1,
    summary="survey.json",
    recognises=lambda folder: (folder / "survey.json").is_file(),
    files=lambda folder: sorted(folder.iterdir()),
    frames=survey_frames,
)


class TestFilesOfASequence:
    @pytest.mark.parametrize("file", ["poses.json", "rgb/0.png", "rgb/own/0.PNG"])
    def test_the_folder_is_named(self, file: str, tmp_path: Path) -> None:
        (tmp_path / "rgb" / "own").mkdir(parents=True)
        (tmp_path / "poses.json").write_text("{}")
        (tmp_path / file).touch()
        with pytest.raises(SourceError, match=f"give the folder {re.escape(str(tmp_path))}$"):
            data_catalog.resolve(tmp_path / file)

    def test_not_that_of_a_model_without_its_pictures(self, tmp_path: Path) -> None:
        model = tmp_path / "sparse" / "0"
        model.mkdir(parents=True)
        (tmp_path / "images").mkdir()
        for name in ("cameras", "images", "points3D"):
            (model / f"{name}.txt").touch()
        with pytest.raises(SourceError, match=f"give the folder {re.escape(str(tmp_path))}$"):
            data_catalog.resolve(model / "cameras.txt")

    def test_of_frames_without_poses_too(self, tmp_path: Path) -> None:
        Image.new("RGB", (8, 8)).save(tmp_path / "0.png")
        with pytest.raises(SourceError, match=f"give the folder {re.escape(str(tmp_path))}$"):
            data_catalog.resolve(tmp_path / "0.png")
        # Not of whatever else lies beside them.
        (tmp_path / "scene.spz").touch()
        with pytest.raises(SourceError, match=r"\(.dcm, .dicom\)$"):
            data_catalog.resolve(tmp_path / "scene.spz")


class TestRegistered:
    @pytest.fixture
    def folder(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        monkeypatch.setattr("data_catalog.folders._registered", [])
        register_reader(SURVEY)
        rng = np.random.default_rng(0)
        positions = {}
        for k in range(5):
            Image.fromarray(rng.integers(40, 200, (40, 48, 3), dtype=np.uint8)).save(tmp_path / f"{k}.png")
            positions[f"{k}.png"] = [float(k), 0.0, 0.0]
        (tmp_path / "survey.json").write_text(json.dumps({"focal_px": 30.0, "positions": positions}))
        return tmp_path

    def test_it_comes_before_those_of_the_catalogue(self, folder: Path) -> None:
        assert readers()[0] is SURVEY
        source = data_catalog.resolve(folder)
        assert (source.name, source.format, source.path) == (folder.name, "survey", str(folder.resolve()))
        assert data_catalog.source_fingerprint(folder)["files"][0][0] == "0.png"

    def test_everything_behind_it_is_done(self, folder: Path) -> None:
        sequence = data_catalog.read(folder, IngestConfig(downscale=2, max_frames=4, holdout_every=3))
        assert sequence.rgb.shape == (4, 20, 24, 3)
        assert sequence.frame_names == ("0", "1", "3", "4")
        assert sequence.test.tolist() == [0, 3]
        np.testing.assert_allclose(sequence.K[0], [[15, 0, 12], [0, 15, 10], [0, 0, 1]])
        np.testing.assert_array_equal(sequence.cameras.centers[:, 0], [0, 1, 3, 4])
        assert sequence.mask.all()
        assert sequence.specular is not None

    def test_its_mistakes_are_named(self, folder: Path) -> None:
        content = json.loads((folder / "survey.json").read_text())
        (folder / "survey.json").write_text(json.dumps({**content, "scale": 1.5}))
        with pytest.raises(PoseError, match=r"survey\.json, frame 0\.png, field world_from_camera"):
            data_catalog.read(folder)
        (folder / "survey.json").write_text(json.dumps({**content, "positions": {}}))
        with pytest.raises(SourceError, match="there is no frame"):
            data_catalog.read(folder)

    def test_poses_for_some_frames_only(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def one_without(place: Path, config: IngestConfig) -> SourceFrames:
            found = survey_frames(place, config)
            bare = PosedFrame("2.png", place / "2.png", found.frames[0].lens)
            return SourceFrames(
                [*found.frames[:2], bare, *found.frames[3:]], pose_file=found.pose_file, metric=True
            )

        half = FolderReader("half", 1, "half", SURVEY.recognises, SURVEY.files, one_without)
        monkeypatch.setattr("data_catalog.folders._registered", [half])
        with pytest.raises(SourceError, match=r"2\.png, field world_from_camera: .*for 4 of 5"):
            data_catalog.read(folder)

    def test_a_name_is_taken_once(self, folder: Path) -> None:
        with pytest.raises(ConfigError, match="there is a reader 'survey' already"):
            register_reader(SURVEY)
