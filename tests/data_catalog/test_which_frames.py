"""Which of the images and videos in a folder are read, and what is said of the others."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from data_catalog.catalog import read, resolve, source_fingerprint
from data_catalog.images import color_files, read_upright
from data_catalog.inspection import inspect
from data_catalog.readers import frames_folder
from extrags.config import IngestConfig
from extrags.errors import SourceError, SourceNotFoundError
from tests.data_catalog.footage_fixture import interlaced, write_video
from tests.data_catalog.test_content import moving_scene


def write_frames(folder: Path, count: int, *, first: int = 0) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(moving_scene(count, 48, 42), start=first):
        Image.fromarray(image).save(folder / f"{number:04d}.png")


class TestSeveralFolders:
    @pytest.mark.parametrize("below", ["images", "rgb"])
    def test_one_picture_beside_the_frames(self, tmp_path, below, caplog) -> None:
        """As the contact sheet that `data show` writes."""
        write_frames(tmp_path / below, 8)
        Image.new("RGB", (720, 640), (90, 40, 30)).save(tmp_path / "contact_sheet.png")
        assert read(tmp_path).rgb.shape == (8, 42, 48, 3)
        assert (
            f"images in the folder itself are not read (contact_sheet.png), only the 8 in {below}/"
            in caplog.text
        )

    def test_a_few_below_the_frames(self, tmp_path, caplog) -> None:
        write_frames(tmp_path, 8)
        write_frames(tmp_path / "images", 2, first=40)
        assert read(tmp_path).frame_names[0] == "0000"
        assert "images in images/ are not read (0040.png, 0041.png), only the 8 in the folder" in caplog.text

    def test_about_as_many_are_refused(self, tmp_path) -> None:
        write_frames(tmp_path / "images", 8)
        write_frames(tmp_path / "rgb", 5)
        with pytest.raises(SourceError, match=r"8 images in images/ and 5 images in rgb/; give the path"):
            read(tmp_path)
        assert len(read(tmp_path / "rgb")) == 5

    def test_of_one_folder_nothing_is_said(self, tmp_path, caplog) -> None:
        write_frames(tmp_path / "images", 4)
        read(tmp_path)
        assert "not read" not in caplog.text


class TestNotRecognised:
    def test_the_folder_that_holds_the_images_is_named(self, tmp_path) -> None:
        write_frames(tmp_path / "frames", 5)
        (tmp_path / "notes").mkdir()
        with pytest.raises(
            SourceNotFoundError,
            match=r"in this folder, but images in frames/ \(5\): give the path .* \(\.png, \.jpg, .*\.webp\)",
        ):
            resolve(tmp_path)

    def test_poses_beside_the_folder_to_give_are_named(self, tmp_path) -> None:
        """In the folder that the error names, nothing tells of them any more."""
        for name in ("color", "depth"):
            write_frames(tmp_path / name, 5)
        (tmp_path / "pose").mkdir()
        (tmp_path / "traj.txt").write_text("1 0 0 0\n")
        with pytest.raises(
            SourceNotFoundError,
            match=r"to read, which is read without depth/, pose/, traj\.txt; to have .*, give a poses\.json",
        ):
            resolve(tmp_path)

    def test_images_of_other_formats_are_named(self, tmp_path) -> None:
        for number in range(3):
            Image.new("RGB", (48, 42)).save(tmp_path / f"{number}.GIF")
        with pytest.raises(SourceNotFoundError, match=r"folder: 3 \.gif files, which are not read; expected"):
            resolve(tmp_path)

    def test_files_of_jpeg_xl_are_named(self, tmp_path) -> None:
        (tmp_path / "0.jxl").write_bytes(b"\xff\x0a")
        with pytest.raises(SourceNotFoundError, match=r"folder: 1 \.jxl files, which are not read; expected"):
            resolve(tmp_path)


class TestVideos:
    @pytest.fixture
    def exam(self, tmp_path: Path) -> Path:
        return write_video(tmp_path / "exam.avi", moving_scene(30, 64, 48, speed=2))

    def test_a_poster_beside_a_video(self, exam, caplog) -> None:
        write_frames(exam.parent, 1)
        assert resolve(exam.parent).format == "video"
        assert len(read(exam.parent)) > 4
        assert "exam.avi is read, and not the pictures beside it: 0000.png" in caplog.text

    def test_frames_below_a_video_are_refused(self, exam) -> None:
        """The video was read, and nothing said of the frames."""
        write_frames(exam.parent / "images", 8)
        with pytest.raises(
            SourceError, match=r"exam\.avi, and 8 images in images/; give the path of the one"
        ):
            read(exam.parent)
        assert len(read(exam.parent / "images")) == 8
        assert resolve(exam).format == "video"

    def test_frames_beside_a_video_are_read_and_it_is_named(self, exam, caplog) -> None:
        write_frames(exam.parent, 8)
        assert len(read(exam.parent)) == 8
        assert "8 images are read, and not exam.avi; give its path" in caplog.text

    @pytest.mark.parametrize(("count", "expected"), [(3, "video"), (4, "frames")])
    def test_how_many_pictures_beside_a_video_are_frames(self, exam, count, expected) -> None:
        write_frames(exam.parent, count)
        assert resolve(exam.parent).format == expected

    @pytest.mark.parametrize("below", ["", "images"])
    def test_a_link_to_nothing_beside_a_video_is_named(self, exam, below, caplog) -> None:
        """It is not read, and so its target is not missed."""
        (exam.parent / below).mkdir(exist_ok=True)
        (exam.parent / below / "poster.png").symlink_to(exam.parent / "gone.png")
        assert len(read(exam.parent)) > 4
        assert "exam.avi is read, and not the pictures beside it: poster.png" in caplog.text

    def test_a_poster_beside_several_videos(self, exam) -> None:
        exam.with_name("other.avi").write_bytes(exam.read_bytes())
        write_frames(exam.parent, 1)
        with pytest.raises(SourceError, match=r"2 videos in this folder: exam\.avi and other\.avi"):
            resolve(exam.parent)


class TestOrientation:
    """Of a camera that was turned, frames lay on their sides, and those of both ways were refused."""

    LEFT = 8
    """EXIF's word for pixels that viewers turn by 90 degrees against the clock."""

    def turned(self, folder: Path, *, every: int = 1) -> None:
        exif = Image.Exif()
        exif[274] = self.LEFT
        write_frames(folder, 8)
        for file in sorted(folder.glob("*.png"))[::every]:
            with Image.open(file) as image:
                stored = image.transpose(Image.Transpose.ROTATE_270)
            stored.save(file, exif=exif)

    @pytest.mark.parametrize("every", [1, 3])
    def test_frames_are_read_as_viewers_show_them(self, tmp_path, every, caplog) -> None:
        write_frames(tmp_path / "upright", 8)
        self.turned(tmp_path / "turned", every=every)
        upright, found = read(tmp_path / "upright"), read(tmp_path / "turned")
        np.testing.assert_array_equal(found.rgb, upright.rgb)
        np.testing.assert_array_equal(found.K, upright.K)
        told = [record.getMessage() for record in caplog.records if "EXIF" in record.getMessage()]
        assert len(told) == 1
        assert f"0000.png: {len(range(0, 8, every))} of 8 images, this one first, have an EXIF" in told[0]
        assert "read upright" in told[0]

    def test_what_lies_beside_them_is_of_the_upright_picture(self, tmp_path) -> None:
        self.turned(tmp_path)
        K = [[40, 0, 24], [0, 40, 21], [0, 0, 1]]
        (tmp_path / "intrinsics.json").write_text(json.dumps({"K": K, "width": 48, "height": 42}))
        Image.fromarray(np.full((42, 48), 255, np.uint8)).save(tmp_path / "mask.png")
        np.testing.assert_array_equal(read(tmp_path).K[0], K)
        (tmp_path / "intrinsics.json").write_text(json.dumps({"K": K, "width": 42, "height": 48}))
        with pytest.raises(SourceError, match=r"field width: .* 42 x 48 .*; found 48 x 42 once they are tur"):
            read(tmp_path)


def test_woven_frames_are_told(tmp_path) -> None:
    for number, image in enumerate(interlaced(moving_scene(8, 320, 240, speed=8))):
        Image.fromarray(image).save(tmp_path / f"{number}.png")
    assert any("interlaced: each image shows two moments" in note for note in inspect(tmp_path).notes)


def test_frames_of_one_moment_are_not(tmp_path) -> None:
    for number, image in enumerate(moving_scene(6, 320, 240, speed=8)):
        Image.fromarray(image).save(tmp_path / f"{number}.png")
    assert not any("interlaced" in note for note in inspect(tmp_path).notes)


def test_woven_frames_are_told_where_a_mask_is_given(tmp_path, caplog) -> None:
    for number, image in enumerate(interlaced(moving_scene(8, 320, 240, speed=8))):
        Image.fromarray(image).save(tmp_path / f"{number}.png")
    Image.new("L", (320, 240), 255).save(tmp_path / "mask.png")
    read(tmp_path)
    assert caplog.text.count("interlaced: each image shows two moments") == 1


def test_woven_frames_are_looked_for_among_those_that_are_kept(tmp_path, caplog) -> None:
    scene = moving_scene(2, 320, 240, speed=8)
    for number in range(30):
        kept_and_woven = number in (4, 12, 17, 25)
        Image.fromarray(interlaced(scene)[0] if kept_and_woven else scene[0]).save(tmp_path / f"{number}.png")
    read(tmp_path, IngestConfig(max_frames=8))
    assert "interlaced: each image shows two moments" in caplog.text


def test_each_frame_that_is_kept_is_decoded_once_and_no_other(tmp_path, monkeypatch) -> None:
    """Damage of a frame that is left out stopped the reading."""
    write_frames(tmp_path, 16)
    for number in range(1, 15):
        if number not in (5, 10):
            (tmp_path / f"{number:04d}.png").write_bytes(b"damaged")
    decoded = []

    def noted(file: Path, *, frame: object = None) -> np.ndarray:
        decoded.append(file.name)
        return read_upright(file, frame=frame)

    monkeypatch.setattr(frames_folder, "read_upright", noted)
    assert read(tmp_path, IngestConfig(max_frames=4)).frame_names == ("0000", "0005", "0010", "0015")
    assert decoded == ["0000.png", "0005.png", "0010.png", "0015.png"]


@pytest.mark.parametrize(("read_from", "elsewhere"), [("", "images"), ("images", ""), ("images", "rgb")])
def test_a_link_to_nothing_that_is_not_read_is_named(tmp_path, read_from, elsewhere, caplog) -> None:
    write_frames(tmp_path / read_from, 6)
    (tmp_path / elsewhere).mkdir(exist_ok=True)
    (tmp_path / elsewhere / "sheet.png").symlink_to(tmp_path / "gone.png")
    assert len(read(tmp_path)) == 6
    assert "are not read (sheet.png), only the 6" in caplog.text


def test_a_mask_that_is_a_link_to_nothing_is_refused(tmp_path) -> None:
    """Without it all pixels would be taken for tissue."""
    write_frames(tmp_path / "images", 6)
    (tmp_path / "mask.png").symlink_to(tmp_path / "gone.png")
    with pytest.raises(SourceNotFoundError, match=r"mask\.png: a link to .*gone\.png, which is not there"):
        read(tmp_path)


def test_a_link_to_nothing_is_refused(tmp_path) -> None:
    """It was left out, and the frames round it taken for neighbours."""
    write_frames(tmp_path, 6)
    (tmp_path / "0003.png").unlink()
    (tmp_path / "0003.png").symlink_to(tmp_path / "gone.png")
    with pytest.raises(SourceNotFoundError, match=r"0003\.png: a link to .*gone\.png, which is not there"):
        read(tmp_path)
    (tmp_path / "elsewhere.dat").write_bytes((tmp_path / "0002.png").read_bytes())
    (tmp_path / "0003.png").unlink()
    (tmp_path / "0003.png").symlink_to(tmp_path / "elsewhere.dat")
    assert len(color_files(tmp_path)) == 6
    assert np.array_equal(read(tmp_path).rgb[2], read(tmp_path).rgb[3])


def test_copies_that_windows_numbers_are_read_in_order(tmp_path) -> None:
    """The first was the last, and a warning asked to list what nobody lists."""
    write_frames(tmp_path, 9)
    before = source_fingerprint(tmp_path)
    assert "order" not in before
    for file in sorted(tmp_path.iterdir()):
        number = int(file.stem)
        file.rename(tmp_path / ("frame.png" if number == 0 else f"frame ({number + 1}).png"))
    assert read(tmp_path).frame_names == ("frame", *(f"frame ({k})" for k in range(2, 10)))
    assert not [finding for finding in inspect(tmp_path).findings if finding.topic == "order of frames"]
    assert source_fingerprint(tmp_path)["order"] == "without suffixes"


class TestDecimals:
    """Frames named by their times stood in the order 0, 0.1, 0.2, ..., 0.05."""

    @staticmethod
    def renamed(folder: Path, name: Callable[[int], str]) -> list[str]:
        names = [name(int(file.stem)) for file in sorted(folder.iterdir())]
        for file, new in zip(sorted(folder.iterdir()), names, strict=True):
            file.rename(folder / f"{new}.png")
        return names

    @pytest.mark.parametrize("pattern", ["{:g}", "t{:g}s"])
    def test_are_read_in_order(self, tmp_path, pattern) -> None:
        write_frames(tmp_path, 24)
        expected = read(tmp_path)
        assert "order" not in source_fingerprint(tmp_path)
        names = self.renamed(tmp_path, lambda number: pattern.format(number * 0.05))
        found = read(tmp_path)
        assert found.frame_names == tuple(names)
        np.testing.assert_array_equal(found.rgb, expected.rgb)
        assert source_fingerprint(tmp_path)["order"] == "decimals"
        assert not [f for f in inspect(tmp_path).findings if f.field == "frame names"]

    def test_of_both_cameras(self, tmp_path) -> None:
        for camera in ("left", "right"):
            write_frames(tmp_path / camera, 24)
            names = self.renamed(tmp_path / camera, lambda number: f"{number * 0.05:g}")
        images = frames_folder.READER.frames(tmp_path, IngestConfig())
        assert [frame.file.stem for frame in images.frames] == names
        assert source_fingerprint(tmp_path)["order"] == "decimals"

    def test_what_nothing_tells_is_a_finding(self, tmp_path) -> None:
        write_frames(tmp_path, 8)
        self.renamed(tmp_path, lambda number: f"1.{(2, 3, 7, 11, 25, 35, 112, 216)[number]}")
        (told,) = (f for f in inspect(tmp_path).findings if f.topic == "order of frames")
        assert "1.7.png is read before 1.11.png" in told.sentence


def test_pages_that_are_not_read_are_told(tmp_path, caplog) -> None:
    scene = [Image.fromarray(image) for image in moving_scene(6, 48, 42)]
    for number, image in enumerate(scene):
        image.save(tmp_path / f"{number}.tif", save_all=True, append_images=scene[:2])
    assert len(read(tmp_path)) == 6
    assert caplog.text.count("0.tif: 3 pictures in the file, as pages or an animation") == 1
