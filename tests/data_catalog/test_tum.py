"""Trajectories in the layout of TUM's RGB-D benchmark."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from data_catalog import glance, read, resolve, source_fingerprint
from data_catalog.inspection import inspect
from data_catalog.readers.tum import _nearest
from extrags.config import IngestConfig
from extrags.errors import PoseError, SourceError, SourceNotFoundError
from tests.data_catalog.damage import line, removed, words
from tests.data_catalog.layouts import carried_error_mm
from tests.data_catalog.tum_fixture import write_tum


@pytest.fixture(scope="module")
def good(clip, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("tum") / "recording"
    write_tum(clip, folder)
    return folder


@pytest.fixture
def folder(good: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    return Path(shutil.copytree(good, tmp_path / "recording"))


def lines(file: Path, how: Callable[[list[str]], list[str]]) -> None:
    file.write_text("\n".join(how(file.read_text().splitlines())) + "\n")


class TestReading:
    def test_what_was_written_comes_back(self, good, clip) -> None:
        assert resolve(good).format == "tum"
        sequence = read(good)
        assert sequence.metric
        assert sequence.intrinsics == "given"
        np.testing.assert_array_equal(sequence.rgb, clip.rgb)
        np.testing.assert_allclose(sequence.K, clip.K)
        np.testing.assert_allclose(sequence.world_from_camera, clip.world_from_camera, atol=1e-5)
        assert sequence.depth_mm is not None
        # The format's steps are 0.2 mm.
        assert np.abs(sequence.depth_mm - clip.depth_mm).max() <= 0.11
        assert carried_error_mm(sequence) < 0.2
        assert {item.topic for item in inspect(good).findings} <= {"depth resolution"}

    def test_a_quaternion_is_x_y_z_w_of_the_camera_in_the_world(self, folder) -> None:
        """A quarter turn about the camera's own y: it then looks along the world's x."""
        half = f"{np.sqrt(0.5):.12f}"
        lines(
            folder / "groundtruth.txt",
            lambda rows: [
                f"{row.split()[0]} 0.1 0 {0.001 * k} 0 {half} 0 {half}" for k, row in enumerate(rows[1:])
            ],
        )
        removed("depth.txt")(folder)
        pose = read(folder).cameras.world_from_camera[3]
        np.testing.assert_allclose(pose[:3, 2], [1, 0, 0], atol=1e-9)
        np.testing.assert_allclose(pose[:3, 3], [100, 0, 3], atol=1e-9)

    def test_the_nearest_in_time_is_taken(self, folder, clip) -> None:
        """A tracker has more poses than there are frames, and begins before them."""

        def denser(rows: list[str]) -> list[str]:
            found = []
            for row in rows[1:]:
                time_s, *rest = row.split()
                # 11 ms from the frame instead of 8.
                found.append(" ".join([f"{float(time_s) - 0.019:.6f}", "9", "9", "9", *rest[3:]]))
                found.append(row)
            return found[::-1]

        lines(folder / "groundtruth.txt", denser)
        np.testing.assert_allclose(read(folder).world_from_camera, clip.world_from_camera, atol=1e-5)

    def test_no_two_frames_share_a_pose(self, folder) -> None:
        """Of a slow tracker, every second frame would have stood still."""
        lines(folder / "groundtruth.txt", lambda rows: rows[1::2])
        times = {row.split()[0]: row for row in (folder / "groundtruth.txt").read_text().splitlines()}
        config = IngestConfig(max_absent_share=0.6)
        sequence = read(folder, config)
        assert len(sequence) == len(times) == 5
        centres = sequence.cameras.centers
        assert len(np.unique(centres, axis=0)) == 5

    def test_frames_without_pose_or_depth_are_left_out_and_named(self, folder, caplog) -> None:
        lines(folder / "groundtruth.txt", lambda rows: rows[3:])
        lines(folder / "depth.txt", lambda rows: rows[:-1])
        assert len(read(folder)) == 7
        assert (
            "groundtruth.txt: nothing within 0.02 s of 2 of 10 frames in rgb.txt; left out: rgb/"
            in caplog.text
        )
        assert "depth.txt: nothing within 0.02 s of 1 of 8 frames" in caplog.text

    def test_images_that_are_absent_are_left_out_and_named(self, folder, caplog) -> None:
        sorted((folder / "rgb").iterdir())[4].unlink()
        sorted((folder / "depth").iterdir())[6].unlink()
        assert len(read(folder)) == 8
        assert "lists 10 frames; 1 of them are absent and left out" in caplog.text

    def test_depth_that_is_listed_and_absent_is_no_matter_of_clocks(self, folder, caplog) -> None:
        first, *others = sorted((folder / "depth").iterdir())
        first.unlink()
        read(folder)
        assert f"depth.txt: 1 of 10 listed files are not there: depth/{first.name}" in caplog.text
        for file in others:
            file.unlink()
        with pytest.raises(SourceNotFoundError, match=r"no such file, as all 10 that depth.txt lists"):
            read(folder)

    def test_frames_are_in_the_order_of_time(self, folder, clip) -> None:
        lines(folder / "rgb.txt", lambda rows: rows[::-1])
        np.testing.assert_array_equal(read(folder).rgb, clip.rgb)

    def test_without_poses_or_without_depth(self, folder, tmp_path) -> None:
        bare = Path(shutil.copytree(folder, tmp_path / "bare"))
        removed("groundtruth.txt")(bare)
        sequence = read(bare)
        assert sequence.world_from_camera is None
        assert sequence.depth_mm is not None
        removed("depth.txt")(folder)
        sequence = read(folder)
        assert sequence.depth_mm is None
        assert sequence.world_from_camera is not None

    @pytest.mark.parametrize(
        ("absent", "told"), [("depth.txt", True), ("groundtruth.txt", False), ("", False)]
    )
    def test_metres_that_nothing_tells_are_named(self, folder, caplog, absent, told) -> None:
        """Monocular SLAM writes this layout, too, in a unit of its own."""
        if absent:
            (folder / absent).unlink()
        read(folder)
        assert ("groundtruth.txt: lengths are taken for metres" in caplog.text) == told

    def test_a_calibration_file_instead_of_intrinsics(self, folder, tmp_path, clip) -> None:
        removed("intrinsics.json")(folder)
        with pytest.raises(
            SourceNotFoundError, match=r"intrinsics\.json, field K: .*\(ingest\.calibration\)"
        ):
            read(folder)
        K = clip.K[0] - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        (tmp_path / "scope.json").write_text(json.dumps({"camera_matrix": K.tolist()}))
        found = read(folder, IngestConfig(calibration=str(tmp_path / "scope.json")))
        assert found.intrinsics == "given"
        np.testing.assert_allclose(found.K, clip.K)

    def test_one_mask_holds_for_all(self, folder) -> None:
        white = np.full((77, 96), 255, np.uint8)
        white[:, :20] = 0
        Image.fromarray(white).save(folder / "mask.png")
        assert not read(folder).mask[:, :, :20].any()

    def test_everything_that_is_read_counts(self, folder) -> None:
        before = source_fingerprint(folder)
        assert len(before["files"]) == 2 * 10 + 4
        assert glance(folder) is not None
        lines(folder / "groundtruth.txt", lambda rows: [*rows, "# a remark more"])
        assert source_fingerprint(folder) != before

    def test_commas_tabs_and_marks_of_editors(self, folder, clip) -> None:
        file = folder / "groundtruth.txt"
        file.write_text(
            "\ufeff" + file.read_text().replace(" ", ",\t").replace("#,\t", "# "), encoding="utf-8"
        )
        np.testing.assert_allclose(read(folder).world_from_camera, clip.world_from_camera, atol=1e-5)


@pytest.mark.parametrize(("frames_hz", "poses_hz"), [(30, 30), (30, 100), (60, 60), (15, 200), (100, 30)])
@pytest.mark.parametrize("offset_s", [-0.015, -0.004, 0.0, 0.009])
def test_pairs_are_those_of_all_within_a_fiftieth_of_a_second(
    frames_hz: int, poses_hz: int, offset_s: float
) -> None:
    """As `associate.py` of the benchmark has it: of all pairs the nearest first, each in one alone."""
    generator = np.random.default_rng(frames_hz)

    def times(hz: int, start_s: float) -> list[float]:
        return (start_s + (np.arange(2 * hz) + generator.normal(0, 0.15, 2 * hz)) / hz).tolist()

    frames, poses = times(frames_hz, 1305031102.0), times(poses_hz, 1305031102.0 + offset_s)
    generator.shuffle(poses)
    pairs = sorted(
        (abs(other_s - time_s), time_s, index)
        for time_s in frames
        for index, other_s in enumerate(poses)
        if abs(other_s - time_s) <= 0.02
    )
    expected: dict[float, int] = {}
    for _, time_s, index in pairs:
        if time_s not in expected and index not in expected.values():
            expected[time_s] = index
    assert len(expected) > 0.4 * min(len(frames), len(poses))
    assert _nearest(frames, poses) == expected


def test_poses_of_no_time_near_have_no_frame() -> None:
    assert _nearest([1.0, 2.0], [1.021, 1.981]) == {2.0: 1}
    assert _nearest([1.0], []) == {}


def later(seconds: float) -> Callable[[Path], None]:
    def do(folder: Path) -> None:
        def moved(row: str) -> str:
            time_s, _, rest = row.partition(" ")
            return f"{float(time_s) + seconds:.6f} {rest}"

        lines(folder / "groundtruth.txt", lambda rows: [moved(row) for row in rows[1:]])

    return do


def other_depth(folder: Path) -> None:
    """A thousand to a metre, as of other cameras."""
    for file in (folder / "depth").iterdir():
        Image.fromarray((np.array(Image.open(file)) // 5).astype(np.uint16)).save(file)


def inverted(folder: Path) -> None:
    """World to camera."""
    from scipy.spatial.transform import Rotation

    def how(row: str) -> str:
        time_s, *numbers = row.split()
        turn = Rotation.from_quat([float(value) for value in numbers[3:]]).inv()
        centre = -turn.apply([float(value) for value in numbers[:3]])
        return " ".join([time_s, *(f"{value:.9f}" for value in (*centre, *turn.as_quat()))])

    lines(folder / "groundtruth.txt", lambda rows: [how(row) for row in rows[1:]])


DAMAGES: dict[str, tuple[Callable[[Path], object], type[SourceError], str]] = {
    "a word": (
        line("groundtruth.txt", 4, words({2: "x"})),
        SourceError,
        "line 5: found 'x'; expected a number",
    ),
    "not finite": (line("groundtruth.txt", 4, words({2: "nan"})), SourceError, "line 5: found 'nan'"),
    "a column less": (
        line("groundtruth.txt", 4, lambda row: row.rpartition(" ")[0]),
        PoseError,
        "line 5, field world_from_camera: found 7 numbers; expected 8: timestamp tx ty tz qx qy qz qw",
    ),
    "no rotation": (
        line("groundtruth.txt", 4, words({4: "3"})),
        PoseError,
        "line 5, field orientation: quaternion of length",
    ),
    "a time twice": (
        lambda folder: lines(folder / "groundtruth.txt", lambda rows: [*rows, rows[3]]),
        SourceError,
        "line 12, field timestamp: the time of line 4, too",
    ),
    "no poses": (
        lambda folder: lines(folder / "groundtruth.txt", lambda rows: rows[:1]),
        SourceError,
        "groundtruth.txt, field frames: the list is empty",
    ),
    "another clock": (
        later(3600),
        SourceError,
        "nothing within 0.02 s of 10 of 10 frames in rgb.txt, this one",
    ),
    "a frame twice": (
        lambda folder: lines(folder / "rgb.txt", lambda rows: [*rows, f"1{rows[3]}"]),
        SourceError,
        "field timestamp: the frame is listed twice",
    ),
    "a line without file": (
        line("rgb.txt", 2, lambda row: row.split()[0]),
        SourceError,
        "line 3: found 1 entries",
    ),
    "a file elsewhere": (
        line("rgb.txt", 2, words({1: "../../secret.png"})),
        SourceError,
        "line 3, field file: .* leads out of the folder",
    ),
    "depth of another format": (
        line("depth.txt", 2, words({1: "depth/1.exr"})),
        SourceError,
        "field depth: depth of this format is not read; expected PNG",
    ),
    "no text": (
        lambda folder: (folder / "rgb.txt").write_bytes(b"\xff\xfe\x00"),
        SourceError,
        "cannot be read as text",
    ),
    "another depth factor": (other_depth, SourceError, "multiplied by about (4.9|5|5.1)"),
    "world to camera": (inverted, PoseError, "world-to-camera"),
    "most images absent": (
        lambda folder: [file.unlink() for file in sorted((folder / "rgb").iterdir())[:6]],
        SourceNotFoundError,
        "lists 10 frames, and 6 of them are absent",
    ),
    "a cut picture": (
        lambda folder: sorted((folder / "depth").iterdir())[2].write_bytes(b"\x89PNG\r\n\x1a\n"),
        SourceError,
        "field depth",
    ),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_named(folder, name) -> None:
    do, kind, problem = DAMAGES[name]
    do(folder)
    with pytest.raises(kind, match=problem):
        read(folder)
