"""Times of frames in footage: recordings that were joined, and pauses of the recorder."""

from __future__ import annotations

import numpy as np
import pytest

from data_catalog.catalog import read
from data_catalog.footage import TimeSpan
from data_catalog.readers.video import VideoFile, _Clock
from data_catalog.survey import Survey
from extrags.config import IngestConfig
from tests.data_catalog.footage_fixture import write_coded
from tests.data_catalog.test_content import moving_scene

SIZE = (160, 96)


def surveyed(times_s: list[float], shots: list[int]) -> Survey:
    count = len(times_s)
    return Survey(
        width=320,
        height=240,
        numbers=np.arange(count),
        times_s=np.array(times_s),
        path=np.arange(count) * 0.1,
        sharpness=np.ones(count),
        shots=np.array(shots),
        combed=np.zeros(count, bool),
        comb_looked=np.ones(count, bool),
    )


class TestShots:
    def test_a_pause_of_the_recorder_makes_no_shot_longer(self) -> None:
        times_s = [*(np.arange(5) * 0.04), *(60 + np.arange(20) * 0.04)]
        found = surveyed(times_s, [0] * 5 + [1] * 20)
        assert [shot.duration_s for shot in found.all_shots()] == pytest.approx([0.2, 0.8])
        assert found.longest_shot().first == 5

    def test_a_shot_of_one_frame_lasts_as_long_as_most(self) -> None:
        found = surveyed([0.0, 0.1, 0.2, 5.0, 5.05, 5.15, 5.25], [0, 0, 0, 1, 2, 2, 2])
        assert [shot.duration_s for shot in found.all_shots()] == pytest.approx([0.3, 0.05, 0.3])

    def test_a_single_frame(self) -> None:
        assert [shot.duration_s for shot in surveyed([3.0], [0]).all_shots()] == [0]


class TestClock:
    @pytest.mark.parametrize(
        ("told_s", "times_s", "is_broken"),
        [
            ([5.0, 5.1, 5.2, 5.0, 5.1], [0, 0.1, 0.2, 0.2, 0.2], False),
            ([5.0, 5.1, 65.1, 65.2], [0, 0.1, 60.1, 60.2], False),
            ([5.0, 5.1, 1.0, 1.1, 1.2], [0, 0.1, 0.2, 0.3, 0.4], True),
            ([5.0, 5.1, 95343.0, 95343.1], [0, 0.1, 0.2, 0.3], True),
            # One timestamp that is damaged.
            ([5.0, 5.1, 90000.0, 5.3, 5.4], [0, 0.1, 0.2, 0.3, 0.4], True),
            ([None, None, None], [0, 0.1, 0.2], False),
        ],
        ids=["out of order", "a pause", "back", "another clock", "a single one", "none"],
    )
    def test_times_never_fall(self, told_s, times_s, is_broken) -> None:
        clock = _Clock(5.0, 10.0)
        assert [clock.time_s(number, told) for number, told in enumerate(told_s)] == pytest.approx(times_s)
        assert clock.is_broken == is_broken


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, ...]:
    """Transport streams: one of 20 frames from time 0 and from time 100 s on, one of 30 from time 0 on."""
    folder = tmp_path_factory.mktemp("parts")
    first, second = moving_scene(20, *SIZE, speed=3), 255 - moving_scene(30, *SIZE, speed=3)[:, ::-1]
    return tuple(
        write_coded(folder / "part.ts", scene, "mpeg2video", start_s=start_s).read_bytes()
        for scene, start_s in ((first, 0), (first, 100), (second, 0))
    )


class TestJoined:
    """Byte by byte, as with `cat`."""

    def test_times_count_on(self, parts, tmp_path, caplog) -> None:
        file = tmp_path / "joined.ts"
        file.write_bytes(parts[0] + parts[2])
        video = VideoFile(file)
        for _ in range(2):
            times_s = [frame.time_s for frame in video.frames(TimeSpan())]
            assert times_s == pytest.approx(np.arange(50) / 25, abs=1e-3)
        assert caplog.text.count("the timestamps of frame 20 do not continue from those before") == 1
        later = [frame.number for frame in video.frames(TimeSpan(1.0, 1.4))]
        assert later == list(range(25, 35))

    def test_the_longer_part_is_read(self, parts, tmp_path) -> None:
        file = tmp_path / "joined.ts"
        file.write_bytes(parts[0] + parts[2])
        assert min(int(name) for name in read(file, IngestConfig(max_frames=6)).frame_names) >= 20

    def test_frames_announced_between_two_clocks_are_no_more_than_the_file_can_hold(
        self, parts, tmp_path
    ) -> None:
        """FFmpeg takes the second part to be 26 hours later."""
        file = tmp_path / "joined.ts"
        file.write_bytes(parts[1] + parts[2])
        video = VideoFile(file)
        times_s = [frame.time_s for frame in video.frames(TimeSpan())]
        assert times_s == pytest.approx(np.arange(50) / 25, abs=1e-3)
        assert video.announced <= file.stat().st_size / 188
