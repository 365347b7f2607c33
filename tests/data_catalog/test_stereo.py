"""Frames and videos of both cameras of a stereo endoscope: one is read, and which is said."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from data_catalog import glance, read, resolve, source_fingerprint
from data_catalog.inspection import facts, inspect
from data_catalog.stereo import BothViews, agreeing_share, pairs_by_name, possible_views
from extrags.config import IngestConfig
from extrags.errors import ConfigError, SourceError
from extrags.sequence import EndoscopicSequence
from tests.data_catalog.footage_fixture import write_dicom, write_video
from tests.data_catalog.test_content import moving_scene

WIDTH, HEIGHT, DISPARITY = 96, 78, 6
RIGHT = IngestConfig(stereo_camera="right")

Views = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def views() -> Views:
    """What a left and a right camera see of a plane, [F, h, w, 3] each."""
    wide = moving_scene(20, WIDTH + DISPARITY, HEIGHT, speed=2)
    return wide[:, :, DISPARITY:], wide[:, :, :-DISPARITY]


@pytest.fixture(scope="module")
def elsewhere(views: Views) -> np.ndarray:
    """As many pictures of another place."""
    return np.ascontiguousarray(255 - views[1][:, ::-1, ::-1])


def write(folder: Path, name: str, images: np.ndarray, *, first: int = 0) -> None:
    for number, image in enumerate(images, start=first):
        file = folder / name.format(number)
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(file)


def stereo_findings(place: Path, config: IngestConfig | None = None) -> list[str]:
    return [finding.sentence for finding in inspect(place, config).findings if finding.topic == "stereo"]


class TestNames:
    @pytest.mark.parametrize(
        ("left", "right"),
        [
            ("left_{:04d}.png", "right_{:04d}.png"),
            ("{:04d}_left.png", "{:04d}_right.png"),
            ("frame_{:d}_l.jpg", "frame_{:d}_r.jpg"),
            ("{:04d}L.png", "{:04d}R.png"),
            ("L{:04d}.png", "R{:04d}.png"),
            ("imgL_{:d}.bmp", "imgR_{:d}.bmp"),
            ("leftImage{:03d}.png", "rightImage{:03d}.png"),
            ("Left-{:d}.PNG", "Right-{:d}.png"),
            ("left_colon_left_{:d}.png", "left_colon_right_{:d}.png"),
        ],
    )
    def test_pairs(self, left, right) -> None:
        files = [Path(name.format(k)) for k in (1, 2, 9, 10) for name in (left, right)]
        found = pairs_by_name([*files[:-1], Path("overview.png")])
        assert found is not None
        assert found.left == tuple(files[::2])
        # The last one has lost its counterpart.
        assert found.right == tuple(files[1:-1:2])
        assert found.others == (Path("overview.png"),)
        assert found.pairs == tuple(zip(files[:-2:2], files[1:-1:2], strict=True))
        assert found.contradictory is None

    @pytest.mark.parametrize(
        "names",
        [
            ("left_1.png", "left_2.png"),
            ("leftover_1.png", "rightover_1.png"),
            ("model_1.png", "moder_1.png"),
            ("left_1.png", "right_2.png"),
            ("0001.png", "0001_right.png"),
        ],
    )
    def test_no_pairs(self, names) -> None:
        assert pairs_by_name([Path(name) for name in names]) is None

    def test_a_name_of_both(self) -> None:
        names = ["left_l_1", "left_r_1", "right_l_1", "right_r_1"]
        found = pairs_by_name([Path(f"{name}.png") for name in names])
        assert found is not None
        assert found.contradictory == Path("left_r_1.png")

    @pytest.mark.parametrize(
        ("name", "size", "expected"),
        [
            ("exam", (1920, 1080), None),
            ("exam", (1280, 1024), None),
            ("exam", (3840, 1080), "the left half"),
            ("exam", (1280, 2048), "the upper half"),
            ("exam_SBS", (1920, 1080), "the left half"),
            ("exam side-by-side", (1920, 1080), "the left half"),
            ("exam_top_bottom", (1920, 1080), "the upper half"),
            ("sbsx", (1920, 1080), None),
        ],
    )
    def test_pictures_that_may_hold_both(self, name, size, expected) -> None:
        found = possible_views(name, *size, "left")
        assert (None if found is None else str(found)) == expected

    def test_what_was_squeezed(self) -> None:
        beside, above = (BothViews(beside, "left", named=True) for beside in (True, False))
        assert beside.pixel_aspect(1920, 1080) == 2
        assert beside.pixel_aspect(2560, 1024) == 1
        assert above.pixel_aspect(1920, 1080) == 0.5
        assert above.pixel_aspect(1280, 2048) == 1
        assert BothViews(beside=True, camera="left", named=False).pixel_aspect(1920, 1080) == 1


class TestAgreement:
    def test_of_one_place_and_of_another(self, views, elsewhere) -> None:
        assert agreeing_share(zip(*views, strict=True)) == 1
        assert agreeing_share(zip(views[0], elsewhere, strict=True)) < 0.3

    def test_what_shows_nothing_does_not_count(self, views, elsewhere) -> None:
        dark = np.zeros_like(views[0][:4])
        assert agreeing_share(zip(dark, dark, strict=True)) == 0
        mixed = np.concatenate([dark, elsewhere[:2]])
        assert agreeing_share(zip(np.concatenate([dark, views[0][:2]]), mixed, strict=True)) == 0

    def test_halves_of_single_pictures(self, clip: EndoscopicSequence) -> None:
        for beside in (True, False):
            halves = BothViews(beside, "left", named=False)
            assert agreeing_share(halves.both(clip.rgb)) < 0.1


IN_ONE_FOLDER = [
    ("left_{:04d}.png", "right_{:04d}.png"),
    ("{:04d}_left.png", "{:04d}_right.png"),
    ("images/{:04d}_l.png", "images/{:04d}_r.png"),
    ("rgb/{:04d}L.png", "rgb/{:04d}R.png"),
]
IN_TWO_FOLDERS = [
    ("left/{:04d}.png", "right/{:04d}.png"),
    ("images/Left/{:04d}.png", "images/Right/{:04d}.png"),
    ("left_frames/frame{:03d}.png", "right_frames/frame{:03d}.png"),
    ("left/left_{:d}.png", "right/right_{:d}.png"),
]


class TestFrames:
    @pytest.mark.parametrize(("left", "right"), IN_ONE_FOLDER + IN_TWO_FOLDERS)
    def test_those_of_one_camera_are_read(self, tmp_path, views, left, right) -> None:
        """Both were read as one recording: a frame trained where its twin was held out."""
        write(tmp_path, left, views[0][:6])
        write(tmp_path, right, views[1][:6])
        for config, camera, shown in ((IngestConfig(), "left", views[0]), (RIGHT, "right", views[1])):
            sequence = read(tmp_path, config)
            assert np.array_equal(sequence.rgb, shown[:6])
            assert sequence.stereo_camera == camera
            assert facts(sequence)["stereo_camera"] == camera
            found = glance(tmp_path, config)
            assert found is not None
            assert found.train + found.test == 6
            (sentence,) = stereo_findings(tmp_path, config)
            assert f"those of the {camera} camera are read, 6 as " in sentence
            assert "ingest.stereo_camera" in sentence

    def test_it_counts_in_cache_keys(self, tmp_path, views) -> None:
        write(tmp_path, "left_{:d}.png", views[0][:4])
        write(tmp_path, "right_{:d}.png", views[1][:4])
        left, right = source_fingerprint(tmp_path), source_fingerprint(tmp_path, RIGHT)
        assert right == {**left, "stereo_camera": "right"}

    def test_it_is_kept(self, tmp_path, views) -> None:
        write(tmp_path / "source", "left_{:d}.png", views[0][:4])
        write(tmp_path / "source", "right_{:d}.png", views[1][:4])
        sequence = read(tmp_path / "source", RIGHT)
        sequence.save(tmp_path / "stored")
        assert EndoscopicSequence.load(tmp_path / "stored").stereo_camera == "right"

    def test_frames_without_counterpart_belong_to_their_camera(self, tmp_path, views, caplog) -> None:
        write(tmp_path, "left_{:d}.png", views[0][:10])
        write(tmp_path, "right_{:d}.png", views[1][3:9], first=3)
        Image.new("RGB", (40, 40), (90, 40, 30)).save(tmp_path / "overview.png")
        assert len(read(tmp_path)) == 10
        assert "1 pictures are left out, by their names of neither camera (overview.png)" in caplog.text
        assert len(read(tmp_path, RIGHT)) == 6

    def test_two_recordings_are_refused(self, tmp_path, views, elsewhere) -> None:
        """As of the left and the right colon."""
        write(tmp_path, "left_colon_{:d}.png", views[0][:8])
        write(tmp_path, "right_colon_{:d}.png", elsewhere[:8])
        with pytest.raises(SourceError, match=r"as left_colon_0.png and right_colon_0.png, but 0% of the"):
            read(tmp_path)

    def test_two_folders_of_two_recordings_are_refused(self, tmp_path, views, elsewhere) -> None:
        write(tmp_path, "left/{:d}.png", views[0][:8])
        write(tmp_path, "right/{:d}.png", elsewhere[:8])
        with pytest.raises(SourceError, match=r"as left/0.png and right/0.png, but 0% of the pairs"):
            read(tmp_path)
        assert read(tmp_path / "right").stereo_camera is None

    def test_a_series_of_neither_is_refused(self, tmp_path, views) -> None:
        for name, shown in (("left_{:d}.png", views[0]), ("right_{:d}.png", views[1])):
            write(tmp_path, name, shown[:6])
        write(tmp_path, "{:d}.png", views[0][:4])
        with pytest.raises(
            SourceError, match=r"6 pictures of a left camera.*, 6 of a right one, and 4 of nei"
        ):
            read(tmp_path)

    def test_a_name_of_both_cameras_is_refused(self, tmp_path, views) -> None:
        for side in ("left", "right"):
            for camera, shown in zip("lr", views, strict=True):
                write(tmp_path, f"{side}_{camera}_{{:d}}.png", shown[:3])
        with pytest.raises(SourceError, match="may be that of a left and of a right camera"):
            read(tmp_path)

    def test_frames_of_one_camera_stay(self, tmp_path, views) -> None:
        write(tmp_path, "left_{:d}.png", views[0][:8])
        sequence = read(tmp_path)
        assert sequence.stereo_camera is None
        assert len(sequence) == 8
        assert stereo_findings(tmp_path) == []
        assert "stereo_camera" not in facts(sequence)

    def test_a_pair_among_other_frames_is_none(self, tmp_path, views) -> None:
        write(tmp_path, "{:04d}.png", views[0][:8])
        write(tmp_path, "left_{:d}.png", views[0][8:10])
        write(tmp_path, "right_{:d}.png", views[1][8:10])
        assert len(read(tmp_path)) == 12

    def test_frames_beside_two_folders_are_refused(self, tmp_path, views) -> None:
        write(tmp_path, "left/{:d}.png", views[0][:8])
        write(tmp_path, "right/{:d}.png", views[1][:8])
        write(tmp_path, "rgb/{:d}.png", views[0][:8])
        with pytest.raises(
            SourceError, match=r"8 images in rgb/ and 16 images in left/ and right/; give the"
        ):
            read(tmp_path)

    def test_folders_of_masks_are_no_cameras(self, tmp_path, views) -> None:
        write(tmp_path, "left/{:d}.png", views[0][:8])
        write(tmp_path, "right/{:d}.png", views[1][:8])
        for name in ("left_masks/{:d}.png", "right_masks/{:d}.png"):
            write(tmp_path, name, views[0][:8])
        assert len(read(tmp_path)) == 8

    @pytest.mark.parametrize("camera", ["left", "right"])
    @pytest.mark.parametrize("axis", [2, 1], ids=["side by side", "above each other"])
    def test_pictures_that_hold_both(self, tmp_path, views, camera, axis) -> None:
        write(tmp_path, "{:04d}.png", np.concatenate([view[:8] for view in views], axis=axis))
        config = IngestConfig(stereo_camera=camera)
        sequence = read(tmp_path, config)
        assert np.array_equal(sequence.rgb, views[camera == "right"][:8])
        assert sequence.stereo_camera == camera
        assert sequence.K[0, 0, 2] == WIDTH / 2
        (sentence,) = stereo_findings(tmp_path, config)
        assert f"told by its size and by halves that show the same place; those of the {camera}" in sentence

    def test_a_wide_picture_of_one_camera_stays_whole(self, tmp_path, views, elsewhere) -> None:
        wide = np.concatenate([views[0][:8], elsewhere[:8]], axis=2)
        write(tmp_path / "plain", "{:04d}.png", wide)
        assert read(tmp_path / "plain").width == 2 * WIDTH
        assert stereo_findings(tmp_path / "plain") == []
        write(tmp_path / "named", "{:04d}_sbs.png", wide)
        assert read(tmp_path / "named").width == 2 * WIDTH
        (sentence,) = stereo_findings(tmp_path / "named")
        assert "their halves do not show the same place; they are read whole" in sentence

    def test_views_that_were_squeezed(self, tmp_path, views) -> None:
        squeezed = np.concatenate([view[:8, :, ::2] for view in views], axis=2)
        write(tmp_path, "{:04d}_sbs.png", squeezed)
        sequence = read(tmp_path)
        assert (sequence.width, sequence.height) == (WIDTH // 2, HEIGHT)
        assert sequence.K[0, 1, 1] == pytest.approx(2 * sequence.K[0, 0, 0])


class TestFootage:
    @pytest.mark.parametrize(("camera", "which"), [("left", 0), ("right", 1)])
    def test_two_files(self, tmp_path, views, camera, which) -> None:
        for name, view in zip(("exam_left", "exam_right"), views, strict=True):
            write_video(tmp_path / f"{name}.avi", np.ascontiguousarray(view))
        config = IngestConfig(stereo_camera=camera)
        sequence = read(tmp_path, config)
        assert sequence.stereo_camera == camera
        shown = [int(name) for name in sequence.frame_names]
        assert np.abs(sequence.rgb.astype(int) - views[which][shown]).max() <= 2
        (sentence,) = stereo_findings(tmp_path, config)
        assert f"those of the {camera} camera are read, exam_{camera}.avi, and not" in sentence
        found = glance(tmp_path, config)
        assert found is not None
        assert (found.width, found.height) == (WIDTH, HEIGHT)
        assert len(source_fingerprint(tmp_path, config)["files"]) == 2
        # The path of one is that one alone.
        assert read(tmp_path / "exam_right.avi").stereo_camera is None

    @pytest.mark.parametrize(
        ("spoilt", "problem"),
        [
            (lambda view, other: other, "0% of the frames that were looked at show the same place"),
            (lambda view, other: view[:12], "20 and 12 frames"),
            (lambda view, other: np.ascontiguousarray(view[:, :64]), "96 x 78 and 96 x 64 pixels"),
        ],
    )
    def test_two_files_that_do_not_agree(
        self,
        tmp_path: Path,
        views: Views,
        elsewhere: np.ndarray,
        spoilt: Callable[[np.ndarray, np.ndarray], np.ndarray],
        problem: str,
    ) -> None:
        write_video(tmp_path / "left.avi", np.ascontiguousarray(views[0]))
        write_video(tmp_path / "right.avi", spoilt(np.ascontiguousarray(views[1]), elsewhere))
        with pytest.raises(SourceError, match=f"do not agree: {problem}; give the path of the one"):
            read(tmp_path)

    @pytest.mark.parametrize("axis", [2, 1], ids=["side by side", "above each other"])
    def test_one_file_that_holds_both(self, tmp_path, views, axis) -> None:
        """Pairs of views were taken for one picture by one lens."""
        file = write_video(tmp_path / "exam.avi", np.concatenate(views, axis=axis))
        for config, which in ((IngestConfig(), 0), (RIGHT, 1)):
            sequence = read(file, config)
            shown = [int(name) for name in sequence.frame_names]
            assert np.abs(sequence.rgb.astype(int) - views[which][shown]).max() <= 2
            assert sequence.stereo_camera == config.stereo_camera
            found = glance(file, config)
            assert found is not None
            assert (found.width, found.height) == (WIDTH, HEIGHT)
            assert len(stereo_findings(file, config)) == 1

    def test_a_part_that_begins_in_the_dark(self, tmp_path, views) -> None:
        both = np.concatenate(views, axis=2)
        both[:4] = 0
        assert read(write_video(tmp_path / "exam.avi", both)).width == WIDTH

    def test_two_dicom_files(self, tmp_path, views) -> None:
        for name, view in zip(("left", "right"), views, strict=True):
            write_dicom(tmp_path / f"{name}.dcm", np.ascontiguousarray(view), FrameTime=40)
        sequence = read(tmp_path, RIGHT)
        assert sequence.stereo_camera == "right"
        shown = [int(name) for name in sequence.frame_names]
        assert np.array_equal(sequence.rgb, views[1][shown])


class TestOneCamera:
    def test_the_right_one_of_frames_of_one_camera_is_refused(self, tmp_path, views) -> None:
        write(tmp_path, "{:04d}.png", views[0][:8])
        for look in (read, glance):
            with pytest.raises(
                ConfigError, match=r"stereo_camera is right, but nothing tells that .* of two"
            ):
                look(tmp_path, RIGHT)

    @pytest.mark.parametrize("name", ["phantom/0", "posed"])
    def test_nor_is_there_one_of_other_sources(self, posed_folder, name) -> None:
        source = resolve(posed_folder if name == "posed" else name)
        with pytest.raises(ConfigError, match="stereo_camera is right, but nothing tells"):
            read(source, RIGHT)


def test_nothing_is_said_while_looking(tmp_path, views, caplog) -> None:
    write(tmp_path, "left_{:d}.png", views[0][:4])
    write(tmp_path, "right_{:d}.png", views[1][:4])
    with caplog.at_level(logging.INFO):
        glance(tmp_path)
    assert caplog.text == ""
