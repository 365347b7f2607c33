"""What is told of a source before it is read is what reading it gives."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from data_catalog import Glance, glance, read
from extrags.config import IngestConfig
from extrags.errors import ConfigError, SourceError, SourceNotFoundError
from extrags.sequence import EndoscopicSequence
from tests.data_catalog.footage_fixture import turned, write_coded, write_dicom, write_video
from tests.data_catalog.test_content import moving_scene


def told(sequence: EndoscopicSequence) -> Glance:
    return Glance(
        width=sequence.width,
        height=sequence.height,
        train=len(sequence.train),
        test=len(sequence.test),
        has_poses=sequence.world_from_camera is not None,
        has_depth=sequence.depth_mm is not None,
    )


@pytest.fixture
def plain_frames(tmp_path: Path) -> Path:
    for number in range(9):
        Image.new("RGB", (64, 48), (90, 60, 50 + number)).save(tmp_path / f"{number}.png")
    return tmp_path


def fisheye(folder: Path) -> Path:
    """A calibration file of a fisheye for images of 64 x 48 pixels."""
    file = folder / "lens.json"
    content = {
        "camera_matrix": [[26.0, 0, 32], [0, 26.0, 24], [0, 0, 1]],
        "distortion_model": "fisheye",
        "distortion_coefficients": [0.02, 0, 0, 0],
        "image_width": 64,
        "image_height": 48,
    }
    file.write_text(json.dumps(content))
    return file


class TestFolders:
    @pytest.mark.parametrize(
        "settings", [{}, {"max_frames": 4}, {"downscale": 2}, {"holdout_every": 2}, {"width": 48}]
    )
    def test_posed_frames(self, posed_folder: Path, settings: dict[str, int]) -> None:
        config = IngestConfig.model_validate(settings)
        assert glance(posed_folder, config) == told(read(posed_folder, config))

    @pytest.mark.parametrize("name", ["sinus_hopkins", "simcol3d_s1", "c3vdv2_sim/c9_transverse1_t3_v1"])
    def test_data_of_others(self, shared_data: Path, name: str) -> None:
        config = IngestConfig(size="thumbnail")
        assert glance(shared_data / name, config) == told(read(shared_data / name, config))

    def test_no_picture_is_read(self, plain_frames: Path) -> None:
        cut = plain_frames / "3.png"
        cut.write_bytes(cut.read_bytes()[:60])
        assert glance(plain_frames) == Glance(64, 48, train=7, test=2, has_poses=False, has_depth=False)
        with pytest.raises(SourceError, match="damaged or truncated"):
            read(plain_frames)

    @pytest.mark.parametrize("settings", [{}, {"size": "central", "field_of_view_deg": 130}, {"width": 32}])
    def test_with_a_calibration_file(self, plain_frames: Path, settings: dict[str, Any]) -> None:
        """A wide field of view enlarges the pinhole of the lens that is stated there."""
        config = IngestConfig.model_validate({**settings, "calibration": str(fisheye(plain_frames))})
        found = glance(plain_frames, config)
        assert found == told(read(plain_frames, config))
        assert found is not None
        assert (found.width > 64) == ("size" in settings)

    def test_what_a_lens_cannot_give_is_refused(self, plain_frames: Path) -> None:
        calibration = str(fisheye(plain_frames))
        config = IngestConfig(calibration=calibration, lens="native", field_of_view_deg=120)
        for function in (glance, read):
            with pytest.raises(ConfigError, match=r"ingest\.lens=native keeps the lens's own field"):
                function(plain_frames, config)
            with pytest.raises(ConfigError, match="states its intrinsics itself"):
                function("phantom/1@sparse", IngestConfig(calibration=calibration))

    def test_what_a_reader_warns_of_is_said_when_it_reads(
        self, plain_frames: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        with caplog.at_level(logging.INFO):
            glance(plain_frames)
            assert caplog.messages == []
            read(plain_frames)
        assert any("assuming a horizontal field of view" in message for message in caplog.messages)

    def test_what_is_wrong_without_looking_is_said(self, plain_frames: Path, tmp_path: Path) -> None:
        for number in range(1, 9):
            (plain_frames / f"{number}.png").unlink()
        with pytest.raises(SourceError, match="1 frame; expected at least two"):
            glance(plain_frames)
        (plain_frames / "0.png").unlink()
        with pytest.raises(SourceNotFoundError, match="the folder is empty"):
            glance(plain_frames)

    def test_a_unit_of_poses_that_are_not_there_is_refused(self, plain_frames: Path) -> None:
        """A recording was read to its end before this was said."""
        for looked in (glance, read):
            with pytest.raises(
                ConfigError, match=r"scale_mm_per_unit is the unit of the source's poses, and"
            ):
                looked(plain_frames, IngestConfig(scale_mm_per_unit=20))

    def test_a_unit_of_poses_that_are(self, posed_folder: Path) -> None:
        assert glance(posed_folder, IngestConfig(scale_mm_per_unit=20)) is not None


class TestFootage:
    def test_a_short_video(self, tmp_path: Path) -> None:
        file = write_video(tmp_path / "a.avi", moving_scene(12, 160, 90, speed=6))
        found = glance(file, IngestConfig(width=80))
        footage = {"looked_at": 12, "source_pixels": 160 * 90}
        assert found == Glance(80, 45, train=10, test=2, has_poses=False, has_depth=False, **footage)
        # Of those that hardly move some are left out.
        chosen = read(file, IngestConfig(width=80))
        assert (chosen.width, chosen.height) == (found.width, found.height)
        assert len(chosen) <= found.train + found.test

    def test_no_more_frames_than_are_chosen(self, tmp_path: Path) -> None:
        file = write_video(tmp_path / "a.avi", moving_scene(12, 160, 90, speed=6))
        found = glance(file, IngestConfig(max_frames=8))
        assert found is not None
        assert (found.train, found.test) == (7, 1)

    def test_one_that_is_turned(self, tmp_path: Path) -> None:
        file = write_coded(tmp_path / "a.mp4", moving_scene(8, 160, 96, speed=6), "libx264", crf="10")
        file.write_bytes(turned(file.read_bytes(), 96))
        found = glance(file)
        assert found is not None
        assert (found.width, found.height) == (96, 160)
        assert (read(file).width, read(file).height) == (96, 160)

    def test_dicom(self, tmp_path: Path) -> None:
        pytest.importorskip("pydicom")
        file = write_dicom(tmp_path / "a.dcm", moving_scene(8, 160, 96, speed=6))
        found = glance(file)
        footage = {"looked_at": 8, "source_pixels": 160 * 96}
        assert found == Glance(160, 96, train=7, test=1, has_poses=False, has_depth=False, **footage)

    @pytest.mark.parametrize("kind", ["video", "dicom"])
    def test_a_part(self, tmp_path: Path, kind: str) -> None:
        """Frames before it are decoded, and not looked at; 25 a second."""
        scene = moving_scene(50, 160, 96, speed=6)
        if kind == "video":
            file = write_video(tmp_path / "a.avi", scene)
        else:
            pytest.importorskip("pydicom")
            file = write_dicom(tmp_path / "a.dcm", scene, FrameTime=40)
        found = glance(file, IngestConfig(start_s=0.8, end_s=1.2))
        assert found is not None
        assert (found.passed_over, found.looked_at) == (20, 10)
        assert found.train + found.test == 10
        whole = glance(file, IngestConfig(start_s=0.8))
        assert whole is not None
        assert (whole.passed_over, whole.looked_at) == (20, 30)

    def test_no_video(self, tmp_path: Path) -> None:
        (tmp_path / "a.mp4").write_text("hello")
        with pytest.raises(SourceError, match="cannot be opened as a video"):
            glance(tmp_path / "a.mp4")


def test_the_catalogue_tells_of_its_own() -> None:
    assert glance("phantom/1@sparse") is None
