"""Videos: which frames are taken, what is masked, what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from data_catalog.catalog import read, resolve, source_fingerprint
from data_catalog.readers.video import choose_frames, survey
from extrags.config import IngestConfig
from extrags.errors import SourceError
from extrags.events import Progress, subscribed
from tests.data_catalog.test_content import in_a_circle, moving_scene, rim

SIZE = (320, 180)


def write_video(file: Path, frames: np.ndarray, code: str = "FFV1") -> Path:
    """Lossless by default."""
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*code), 25, (frames.shape[2], frames.shape[1]))
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()
    return file


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    """60 frames: 20 moving, 20 standing still, 20 moving; every third one blurred; round picture."""
    scene = moving_scene(61, *SIZE, speed=3)
    order = [*range(20), *([20] * 20), *range(20, 40)]
    frames = np.stack([scene[k] for k in order])
    for k in range(0, 60, 3):
        frames[k] = cv2.GaussianBlur(frames[k], (0, 0), 3)
    frames = in_a_circle(frames, rim(160, 90, 84))
    return write_video(tmp_path_factory.mktemp("video") / "exam.avi", frames)


class TestChoice:
    def test_sharp_frames_of_what_moves(self, video) -> None:
        sequence = read(video)
        numbers = np.array([int(name) for name in sequence.frame_names])
        assert 20 <= len(numbers) <= 26
        assert (numbers % 3 != 0).mean() > 0.8
        # Twenty frames of the same view: at most two are taken, at its beginning and its end.
        assert ((numbers >= 20) & (numbers < 40)).sum() <= 2
        assert sequence.world_from_camera is None
        assert sequence.metric is False

    def test_the_frames_are_those_of_the_video(self, video) -> None:
        sequence = read(video)
        reader = cv2.VideoCapture(str(video))
        frames = []
        while True:
            there, image = reader.read()
            if not there:
                break
            frames.append(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
        for name, image in zip(sequence.frame_names, sequence.rgb, strict=True):
            np.testing.assert_array_equal(image, frames[int(name)])

    def test_at_most_so_many(self, video) -> None:
        assert len(read(video, IngestConfig(max_frames=6))) == 6

    def test_equal_steps_of_motion(self) -> None:
        path = np.cumsum([0.0] + [0.01] * 50 + [0.05] * 10)
        steps = np.diff(path[choose_frames(path, np.ones(61), 200)])
        assert steps.max() < 0.11
        assert steps.min() > 0.02

    def test_the_sharpest_of_each_step(self) -> None:
        sharpness = np.tile([1.0, 5.0, 2.0], 20)
        chosen = choose_frames(np.arange(60) * 0.01, sharpness, 200)
        assert (sharpness[chosen] == 5).mean() >= 0.8

    def test_measured_motion_is_the_motion(self, tmp_path) -> None:
        file = write_video(tmp_path / "a.avi", moving_scene(10, *SIZE, speed=8))
        found = survey(file)
        np.testing.assert_allclose(np.diff(found.path), 8 / 320, rtol=0.15)
        assert (found.width, found.height) == SIZE

    def test_noise_does_not_add_up(self, tmp_path) -> None:
        """A scope that stands still for ten seconds under sensor noise and trembling has not moved."""
        rng = np.random.default_rng(0)
        scene = moving_scene(3, *SIZE, speed=1)
        frames = scene[rng.integers(0, 2, 250)] + rng.normal(0, 6, (250, 180, 320, 1))
        file = write_video(tmp_path / "a.avi", np.clip(frames, 0, 255).astype(np.uint8))
        assert survey(file).path[-1] < 0.01

    def test_a_small_motion_is_used_whole(self, tmp_path) -> None:
        file = write_video(tmp_path / "a.avi", moving_scene(40, *SIZE, speed=1))
        assert len(read(file)) >= 20

    def test_same_bits_twice(self, video) -> None:
        first, second = read(video), read(video)
        np.testing.assert_array_equal(first.rgb, second.rgb)
        np.testing.assert_array_equal(first.mask, second.mask)


class TestReading:
    def test_the_round_picture_is_masked(self, video) -> None:
        mask = read(video).mask[0]
        expected = rim(160, 90, 84).mask(*SIZE)
        assert not mask[~expected].any()
        assert mask.sum() > 0.9 * expected.sum()

    def test_files_beside_it(self, video, tmp_path) -> None:
        file = tmp_path / "exam.avi"
        file.write_bytes(video.read_bytes())
        (tmp_path / "intrinsics.json").write_text(json.dumps({"field_of_view_deg": 60}))
        mask = np.zeros((180, 320), np.uint8)
        mask[20:160, 60:260] = 255
        cv2.imwrite(str(tmp_path / "mask.png"), mask)
        for place in (file, tmp_path):
            assert resolve(place).format == "video"
            sequence = read(place, IngestConfig(max_frames=4))
            assert sequence.K[0, 0, 0] == pytest.approx(160 / np.tan(np.radians(30)))
            np.testing.assert_array_equal(sequence.mask[0], mask > 0)

    def test_name_and_fingerprint(self, video, tmp_path) -> None:
        assert resolve(video).name == "exam"
        moved = tmp_path / "other.avi"
        moved.write_bytes(video.read_bytes())
        assert source_fingerprint(moved) == source_fingerprint(video)
        moved.write_bytes(video.read_bytes() + b"0")
        assert source_fingerprint(moved) != source_fingerprint(video)

    def test_progress(self, video) -> None:
        seen: list[Progress] = []
        with subscribed(lambda event: seen.append(event) if isinstance(event, Progress) else None):
            read(video, IngestConfig(max_frames=5))
        assert seen[-1].done == seen[-1].total == 65
        assert len(seen) > 5

    def test_a_compressed_video(self, tmp_path) -> None:
        file = write_video(tmp_path / "a.mp4", moving_scene(20, *SIZE, speed=6), "mp4v")
        assert len(read(file)) > 6


class TestRefused:
    def test_a_scope_that_stands_still(self, tmp_path) -> None:
        file = write_video(tmp_path / "still.avi", np.repeat(moving_scene(1, *SIZE), 12, axis=0))
        with pytest.raises(SourceError, match=r"still\.avi, field motion: the picture moves by 0\.0%"):
            read(file)

    @pytest.mark.parametrize("share", [0.0, 0.3, 0.7])
    def test_a_truncated_file(self, video, tmp_path, share) -> None:
        file = tmp_path / "cut.avi"
        file.write_bytes(video.read_bytes()[: int(share * video.stat().st_size)])
        with pytest.raises(SourceError, match=r"cut\.avi.*(cannot be opened|truncated|not a single frame)"):
            read(file)
