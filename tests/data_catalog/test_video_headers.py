"""What a video's header says of its pictures: how many there are, and which way up they are shown."""

from __future__ import annotations

import logging
import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from data_catalog.footage import TimeSpan
from data_catalog.readers.video import VideoFile
from extrags.errors import SourceError
from tests.data_catalog.footage_fixture import write_coded
from tests.data_catalog.test_content import moving_scene

ONE = 1 << 16
WIDTH, HEIGHT, COUNT = 64, 48, 20
"""0.8 s at 25 frames a second."""


def decoded(file: Path) -> list[np.ndarray]:
    return [frame.rgb for frame in VideoFile(file).frames(TimeSpan())]


def write_with_sound(file: Path, sound_s: float, *, start_s: float = 0.0, sound_start_s: float = 0.0) -> Path:
    """Pictures with silence beside them."""
    rate, block = 48000, 1152
    with av.open(str(file), "w") as container:
        pictures = container.add_stream("mjpeg" if file.suffix == ".mkv" else "mpeg2video", rate=25)
        pictures.width, pictures.height = WIDTH, HEIGHT
        pictures.pix_fmt = "yuvj420p" if file.suffix == ".mkv" else "yuv420p"
        sound = container.add_stream("mp2", rate=rate, layout="mono")
        packets = []
        for number, image in enumerate(moving_scene(COUNT, WIDTH, HEIGHT)):
            picture = av.VideoFrame.from_ndarray(image)
            picture.pts = number + round(25 * start_s)
            packets += pictures.encode(picture)
        for at in range(0, int(sound_s * rate), block):
            silence = av.AudioFrame.from_ndarray(np.zeros((1, block), np.int16), format="s16", layout="mono")
            silence.sample_rate, silence.time_base = rate, Fraction(1, rate)
            silence.pts = at + int(sound_start_s * rate)
            packets += sound.encode(silence)
        packets += [*pictures.encode(), *sound.encode()]
        for packet in sorted(packets, key=lambda packet: packet.dts * packet.time_base):
            container.mux(packet)
    return file


class TestSoundThatIsLonger:
    @pytest.mark.parametrize("name", ["a.mkv", "a.ts", "a.mpg"])
    @pytest.mark.parametrize("sound_s", [1.2, 3.0])
    def test_a_whole_file_is_read(self, tmp_path, name, sound_s) -> None:
        file = write_with_sound(tmp_path / name, sound_s)
        assert len(decoded(file)) == COUNT
        # Of MPEG program streams the timestamps tell of a few frames fewer.
        assert 0 < VideoFile(file).announced <= COUNT

    def test_it_began_before_the_pictures(self, tmp_path) -> None:
        file = write_with_sound(tmp_path / "a.mkv", 5.0, start_s=10.0, sound_start_s=9.0)
        assert VideoFile(file).announced == len(decoded(file)) == COUNT

    @pytest.mark.parametrize("share", [0.1, 0.2])
    def test_a_truncated_one_is_refused(self, tmp_path, share) -> None:
        file = write_with_sound(tmp_path / "a.mkv", 3.0)
        file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
        with pytest.raises(SourceError, match=r"20 frames announced, .* decoded: the video is truncated"):
            decoded(file)

    def test_nothing_tells_of_the_pictures(self, tmp_path) -> None:
        """Programs need not write the tags of Matroska; one duration is then that of all streams."""
        file = write_with_sound(tmp_path / "a.mkv", 3.0)
        content = file.read_bytes()
        assert content.count(b"DURATION") == 2
        file.write_bytes(content.replace(b"DURATION", b"REMARKED"))
        assert VideoFile(file).announced == 0
        assert len(decoded(file)) == COUNT

    @pytest.mark.parametrize("name", ["DURATION-eng", "duration"])
    def test_other_spellings_of_the_tag(self, tmp_path, name) -> None:
        """As of a program that names the language of what it writes."""
        file = write_with_sound(tmp_path / "a.mkv", 3.0)
        with av.open(str(file)) as given:
            container, (stream, *_) = given, given.streams.video
            assert stream.metadata["DURATION"] == "00:00:00.800000000"
            found = duration_of(container, stream, {name: stream.metadata["DURATION"]})
        assert found == pytest.approx(0.8)

    def test_a_tag_that_is_no_time(self, tmp_path) -> None:
        file = write_with_sound(tmp_path / "a.mkv", 3.0)
        with av.open(str(file)) as given:
            assert duration_of(given, given.streams.video[0], {"DURATION": "long"}) == 0


def duration_of(container, stream, metadata: dict[str, str]) -> float:
    """As of a stream with other tags."""
    from types import SimpleNamespace

    from data_catalog.readers.video_header import duration_of_pictures_s

    like = SimpleNamespace(duration=stream.duration, metadata=metadata, index=stream.index)
    return duration_of_pictures_s(container, like, 0.0)


class TestOrientation:
    @pytest.mark.parametrize(
        ("matrix", "shown", "told"),
        [
            ((ONE, 0, 0, ONE), lambda image: image, ""),
            ((0, ONE, -ONE, 0), lambda image: np.rot90(image, -1), "turned by 90 degrees"),
            ((0, -ONE, ONE, 0), np.rot90, "turned by 270 degrees"),
            ((-ONE, 0, 0, -ONE), lambda image: np.rot90(image, 2), "turned by 180 degrees"),
            ((-ONE, 0, 0, ONE), lambda image: image[:, ::-1], "mirrored, left and right exchanged"),
            ((ONE, 0, 0, -ONE), lambda image: image[::-1], "mirrored, top and bottom exchanged"),
            ((0, ONE, ONE, 0), lambda image: image.swapaxes(0, 1), "mirrored, with rows as columns"),
            ((0, -ONE, -ONE, 0), lambda image: np.rot90(image, 2).swapaxes(0, 1), "mirrored, with rows"),
        ],
    )
    def test_as_players_show_it(self, tmp_path, caplog, matrix, shown, told) -> None:
        """FFmpeg's autorotate turns and mirrors by the same matrices."""
        plain = write_coded(tmp_path / "plain.mp4", moving_scene(3, WIDTH, HEIGHT), "mpeg4")
        content = plain.read_bytes()
        at = content.index(b"tkhd") + 4 + 40
        a, b, c, d = matrix
        stored = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
        (tmp_path / "a.mp4").write_bytes(content[:at] + stored + content[at + len(stored) :])
        with caplog.at_level(logging.INFO):
            video = VideoFile(tmp_path / "a.mp4")
        assert told in caplog.text
        for found, given in zip(decoded(tmp_path / "a.mp4"), decoded(plain), strict=True):
            np.testing.assert_array_equal(found, shown(given))
            assert video.size == (found.shape[1], found.shape[0])


def test_frames_that_would_fill_the_memory(tmp_path: Path) -> None:
    file = tmp_path / "a.y4m"
    file.write_bytes(b"YUV4MPEG2 W16000 H16000 F25:1 Ip A1:1 C420\nFRAME\n" + bytes(1000))
    with pytest.raises(SourceError, match=r"a\.y4m: frames of 16000 x 16000 pixels, too large: more than"):
        VideoFile(file)
