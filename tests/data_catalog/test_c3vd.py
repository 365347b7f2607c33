"""Videos in the published layouts: what is read out of them, and what is refused."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from data_catalog.c3vd.coverage import read_coverage_mesh
from data_catalog.c3vd.video import Video
from data_catalog.catalog import (
    read,
    resolve,
    source_fingerprint,
)
from extrags.cameras import invert_poses
from extrags.config import IngestConfig
from extrags.errors import PoseError, SourceError, SourceNotFoundError
from tests.data_catalog.c3vd_fixture import (
    Written,
    reprojection_mm,
    rewrite_line,
    rewrite_pose,
    write_calibration,
    write_video,
)

SMALL = IngestConfig(width=45)
SCENE = "c3vdv2_sim/c9_transverse1_t3"


@pytest.fixture(scope="session")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Written:
    return write_video(tmp_path_factory.mktemp("c3vd") / "colon_v1", frames=12, first=0)


@pytest.fixture
def video(pristine: Written, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    return Path(shutil.copytree(pristine.folder, tmp_path / "colon_v1"))


class TestLayouts:
    def test_depth_by_other_names_is_told_of(self, video: Path, caplog: pytest.LogCaptureFixture) -> None:
        for file in (video / "depth").iterdir():
            file.rename(file.with_name(file.name.replace("_depth", "")))
        assert read(video, SMALL).depth_mm is None
        assert "depth is not read: no file in it is called NNNN_depth.tiff" in caplog.text

    def test_c3vdv2(self, pristine: Written) -> None:
        sequence = read(pristine.folder, SMALL)
        assert sequence.rgb.shape == (12, 36, 45, 3)
        assert sequence.metric
        assert sequence.mask.all()
        assert sequence.test.tolist() == [0, 8]
        np.testing.assert_allclose(sequence.world_from_camera, pristine.poses, atol=1e-7)
        assert sequence.truth["c3vd"]["recordings"]["colon_v1"]["pose_layout"] == "column-major"
        assert "c3vdv2" in sequence.truth["c3vd"]["recordings"]["colon_v1"]["camera"]
        median, agree = reprojection_mm(sequence, 3, 4)
        assert median < 0.03
        assert agree > 0.9

    def test_c3vd_with_unpadded_names(self, tmp_path) -> None:
        written = write_video(tmp_path / "tube_a", layout="c3vd", frames=4, first=8, padded=False)
        assert (written.folder / "9_color.png").is_file()
        assert (written.folder / "0009_depth.tiff").is_file()
        source = resolve(written.folder)
        assert source.format == "c3vd"
        sequence = read(source, SMALL)
        # As words, 10 and 11 would come before 8 and 9.
        assert sequence.frame_names == tuple(f"tube_a_{k:04d}" for k in (8, 9, 10, 11))
        np.testing.assert_allclose(sequence.world_from_camera, written.poses, atol=1e-7)
        assert sequence.truth["c3vd"]["recordings"]["tube_a"]["camera"] == "as published with c3vd"
        median, agree = reprojection_mm(sequence, 1, 2)
        assert median < 0.03
        assert agree > 0.9

    def test_the_lens_goes_by_the_name_of_a_known_video(self, pristine, tmp_path) -> None:
        for name, expected in (
            ("c0_cecum_t1_v1", "c3vd"),
            ("cecum_t1_a", "c3vd"),
            ("c1_cecum_t1_v1", "c3vdv2"),
        ):
            folder = Path(shutil.copytree(pristine.folder, tmp_path / name))
            assert Video.open(folder).calibration == f"as published with {expected}"

    def test_the_lens_that_is_chosen_is_part_of_the_fingerprint(self, pristine, tmp_path) -> None:
        folders = [
            Path(shutil.copytree(pristine.folder, tmp_path / name))
            for name in ("c1_cecum_t1_v1", "my_recording", "cecum_t1_a")
        ]
        named, plain, other = (source_fingerprint(folder) for folder in folders)
        assert named == plain
        assert other != plain
        assert other["files"] == plain["files"]
        for folder in folders:
            write_calibration(folder / "calibration.json", 270, 216)
        named, plain, other = (source_fingerprint(folder) for folder in folders)
        assert named == plain == other

    def test_row_major_poses_are_noticed(self, tmp_path) -> None:
        written = write_video(tmp_path / "rows", frames=3, row_major=True)
        opened = Video.open(written.folder)
        assert opened.layout == "row-major"
        np.testing.assert_allclose(opened.world_from_camera, written.poses, atol=1e-7)

    def test_a_pose_at_the_origin_reads_either_way(self, video) -> None:
        lines = (video / "pose.txt").read_text().splitlines()
        lines[0] = "1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1"
        (video / "pose.txt").write_text("\n".join(lines))
        opened = Video.open(video)
        assert opened.layout == "column-major"
        np.testing.assert_array_equal(opened.world_from_camera[0], np.eye(4))

    def test_calibration_file_wins(self, video) -> None:
        write_calibration(video / "calibration.json", 270, 216, a0=200.0)
        opened = Video.open(video)
        assert opened.calibration == "calibration.json"
        assert opened.camera.a0 == 200

    def test_depth_codes(self, pristine) -> None:
        opened = Video.open(pristine.folder)
        code = np.array(Image.open(opened.depth_files[2])).astype(float)
        depth = opened.depth_mm(2)
        assert (code == 65535).any() or (code == 0).any() or depth.min() > 0
        known = (code > 0) & (code < 65535)
        np.testing.assert_array_equal(depth > 0, known)
        np.testing.assert_allclose(depth[known], code[known] / 65535 * 100, rtol=1e-6)

    def test_clipped_and_unknown_depth_stay_unknown(self, video) -> None:
        for k in range(12):
            file = video / "depth" / f"{k:04d}_depth.tiff"
            code = np.array(Image.open(file))
            code[:, :20], code[:, 120:] = 0, 65535
            Image.fromarray(code).save(file)
        depth = read(video, SMALL).depth_mm
        assert depth.max() < 100
        assert (depth[:, 18, [0, 44]] == 0).all()
        assert (depth[:, 18, 22] > 0).all()

    def test_part_of_a_video(self, video, caplog) -> None:
        """The first frames of a longer video, with all of its poses."""
        for k in range(7, 12):
            (video / "rgb" / f"{k:04d}.png").unlink()
        with caplog.at_level(logging.WARNING):
            sequence = read(video, SMALL)
        assert len(sequence) == 7
        assert "12 poses, but frames 0 to 6 only" in caplog.text

    def test_without_depth(self, video, pristine) -> None:
        shutil.rmtree(video / "depth")
        sequence = read(video, SMALL)
        assert sequence.depth_mm is None
        assert sequence.observed is not None
        np.testing.assert_allclose(sequence.world_from_camera, pristine.poses, atol=1e-7)

    def test_a_dark_frame_round_the_picture_is_masked(self, video) -> None:
        x, y = np.meshgrid(np.arange(135) - 67, np.arange(108) - 54)
        for file in (video / "rgb").iterdir():
            picture = np.array(Image.open(file))
            picture[np.abs(x) + np.abs(y) > 82] = 2
            Image.fromarray(picture).save(file)
        sequence = read(video, SMALL)
        assert not sequence.mask[:, [0, 0, -1, -1], [0, -1, 0, -1]].any()
        assert 0.75 < sequence.mask.mean() < 0.95
        assert sequence.rgb[sequence.mask].min() > 30

    def test_size_and_field_of_view_follow_the_settings(self, pristine) -> None:
        sequence = read(pristine.folder, IngestConfig(downscale=3, field_of_view_deg=80.0, max_frames=4))
        assert sequence.rgb.shape == (4, 36, 45, 3)
        assert sequence.K[0, 0, 0] == pytest.approx(22.5 / np.tan(np.radians(40)))

    def test_no_poses_is_no_plain_folder(self, video) -> None:
        """Read as plain frames it would get a pinhole it does not have."""
        (video / "pose.txt").unlink()
        assert resolve(video).format == "c3vd"
        with pytest.raises(SourceNotFoundError, match=r"pose\.txt, field world_from_camera: no such file"):
            read(video)


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:400])


def as_8_bit(file: Path) -> None:
    Image.fromarray((np.array(Image.open(file)) >> 8).astype(np.uint8)).save(file)


def crop(file: Path) -> None:
    Image.fromarray(np.array(Image.open(file))[:-8]).save(file)


def edit_mesh(folder: Path, change) -> None:
    lines = (folder / "coverage_mesh.obj").read_text().splitlines()
    (folder / "coverage_mesh.obj").write_text("\n".join(change(lines)))


def replaced(text: str, by: str):
    """Change the first line of a mesh that begins with a text."""

    def change(lines: list[str]) -> list[str]:
        first = next(k for k, line in enumerate(lines) if line.startswith(text))
        return [*lines[:first], by, *lines[first + 1 :]]

    return change


DAMAGE = {
    "frame missing": (
        lambda v: (v / "rgb/0004.png").unlink(),
        SourceNotFoundError,
        ("rgb/0004.png", "4", "rgb", "frames before and after it are there"),
    ),
    "depth missing": (
        lambda v: (v / "depth/0004_depth.tiff").unlink(),
        SourceNotFoundError,
        ("depth/0004_depth.tiff", "4", "depth", "11 of 12 frames have one"),
    ),
    "two files of a frame": (
        lambda v: shutil.copy(v / "rgb/0003.png", v / "rgb/3.png"),
        SourceError,
        ("rgb/3.png", "3", "rgb", "0003.png and 3.png are the same frame"),
    ),
    "too few poses": (
        lambda v: (v / "pose.txt").write_text("\n".join((v / "pose.txt").read_text().splitlines()[:9])),
        PoseError,
        ("pose.txt", "9", "world_from_camera", "9 poses for 12 frames, and there is a frame 9"),
    ),
    "no pose at all": (
        lambda v: (v / "pose.txt").write_text("\n"),
        PoseError,
        ("pose.txt", None, "world_from_camera", "holds no pose"),
    ),
    "15 numbers": (
        lambda v: rewrite_line(v, 5, lambda line: line.rpartition(",")[0]),
        PoseError,
        ("pose.txt", "5", "world_from_camera", "15 numbers; expected 16"),
    ),
    "a word": (
        lambda v: rewrite_line(v, 5, lambda line: line.replace(",", ",lost,", 1)),
        PoseError,
        ("pose.txt", "5", "world_from_camera", "not a number"),
    ),
    "NaN": (
        lambda v: rewrite_pose(v, 6, lambda pose: pose * np.nan),
        PoseError,
        ("pose.txt", "6", "world_from_camera", "NaN or infinity"),
    ),
    "one pose transposed": (
        lambda v: rewrite_pose(v, 6, lambda pose: pose.T),
        PoseError,
        ("pose.txt", "6", "world_from_camera", "row after row here, and column after column"),
    ),
    "no bottom row": (
        lambda v: rewrite_pose(v, 6, lambda pose: pose + 0.1),
        PoseError,
        ("pose.txt", "6", "world_from_camera", "neither the last row"),
    ),
    "scaled": (
        lambda v: rewrite_pose(v, 6, lambda pose: pose * [[1.5], [1.5], [1.5], [1]]),
        PoseError,
        ("pose.txt", "6", "world_from_camera", "not a rotation: singular values"),
    ),
    "mirrored": (
        lambda v: rewrite_pose(v, 6, lambda pose: pose @ np.diag([-1.0, 1, 1, 1])),
        PoseError,
        ("pose.txt", "6", "world_from_camera", "mirrored"),
    ),
    "far away": (
        lambda v: rewrite_pose(v, 6, lambda pose: pose + np.array([[0.0, 0, 0, 9e4]] + 3 * [[0.0] * 4])),
        PoseError,
        ("pose.txt", "6", "world_from_camera", "expected millimetres, within 2 m"),
    ),
    "world to camera": (
        lambda v: [rewrite_pose(v, k, lambda pose: invert_poses(pose[None])[0]) for k in range(12)],
        PoseError,
        ("colon_v1", None, "world_from_camera", "read as world-to-camera"),
    ),
    "OpenGL axes": (
        lambda v: [rewrite_pose(v, k, lambda pose: pose @ np.diag([1.0, -1, -1, 1])) for k in range(12)],
        PoseError,
        ("colon_v1", None, "world_from_camera", "read as OpenGL axes"),
    ),
    "damaged image": (
        lambda v: truncate(v / "rgb/0007.png"),
        SourceError,
        ("rgb/0007.png", "7", "rgb", "damaged or truncated"),
    ),
    "damaged depth": (
        lambda v: truncate(v / "depth/0007_depth.tiff"),
        SourceError,
        ("depth/0007_depth.tiff", "7", "depth", "damaged or truncated"),
    ),
    "8-bit depth": (
        lambda v: as_8_bit(v / "depth/0002_depth.tiff"),
        SourceError,
        ("depth/0002_depth.tiff", "2", "depth", "converted to 8 bits"),
    ),
    "depth of another size": (
        lambda v: crop(v / "depth/0002_depth.tiff"),
        SourceError,
        ("depth/0002_depth.tiff", "2", "depth", "135 x 100 pixels; expected 135 x 108"),
    ),
    "image of another size": (
        lambda v: crop(v / "rgb/0002.png"),
        SourceError,
        ("rgb/0002.png", "2", "rgb", "135 x 100 pixels; expected 135 x 108"),
    ),
    "another proportion than the lens": (
        lambda v: write_calibration(v / "calibration.json", 640, 480),
        SourceError,
        ("rgb/0000.png", None, "calibration", "has another proportion"),
    ),
    "calibration is no JSON": (
        lambda v: (v / "calibration.json").write_text("{cx: 3"),
        SourceError,
        ("calibration.json", None, "calibration", "not readable as JSON"),
    ),
    "calibration without an entry": (
        lambda v: write_calibration(v / "calibration.json", 135, 108, a2=None),
        SourceError,
        ("calibration.json", None, "a2", "found None"),
    ),
    "flag 3": (
        lambda v: edit_mesh(v, replaced("f ", "f 1/3 2/3 3/3")),
        SourceError,
        ("coverage_mesh.obj", None, "vt", "face 0 has texture coordinate 3; expected 1 (observed) or 2"),
    ),
    "a square": (
        lambda v: edit_mesh(v, replaced("f ", "f 1/1 2/1 3/1 4/1")),
        SourceError,
        ("coverage_mesh.obj", None, "f", "expected three corners"),
    ),
    "vertex that is not there": (
        lambda v: edit_mesh(v, replaced("f ", "f 1/1 2/1 99999/1")),
        SourceError,
        ("coverage_mesh.obj", None, "f", "face 0 names vertex 99999 of 2880"),
    ),
    "no faces": (
        lambda v: edit_mesh(v, lambda lines: [line for line in lines if not line.startswith("f")]),
        SourceError,
        ("coverage_mesh.obj", None, "coverage", "2880 vertices and 0 faces"),
    ),
    "vertex without z": (
        lambda v: edit_mesh(v, replaced("v ", "v 1.0 2.0")),
        SourceError,
        ("coverage_mesh.obj", None, "v", "not three numbers"),
    ),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_refused_by_name(video: Path, damage: str) -> None:
    spoil, kind, (file, frame, field, sentence) = DAMAGE[damage]
    spoil(video)
    with pytest.raises(kind) as caught:
        read(video, SMALL)
    assert sentence in str(caught.value)
    assert str(caught.value.file).endswith(file)
    assert caught.value.frame == frame
    assert caught.value.field == field


class TestMesh:
    def test_flags_are_read_back(self, pristine) -> None:
        mesh = read_coverage_mesh(pristine.folder / "coverage_mesh.obj")
        np.testing.assert_array_equal(mesh.observed, pristine.observed)
        assert 0 < mesh.observed_share < 1
