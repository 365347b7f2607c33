"""Videos: which frames are taken, what is masked, what is refused."""

from __future__ import annotations

import json
import weakref
from collections.abc import Collection
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from data_catalog.catalog import read, resolve, source_fingerprint
from data_catalog.footage import FootageFrame, TimeSpan
from data_catalog.readers.footage_frames import footage_frames
from data_catalog.readers.video import VideoFile, _colors
from data_catalog.survey import Survey, choose_frames, survey
from extrags.config import IngestConfig
from extrags.errors import ConfigError, SourceError
from extrags.events import Progress, subscribed
from extrags.sequence import EndoscopicSequence
from tests.data_catalog.footage_fixture import (
    interlaced,
    retimed,
    turned,
    write_coded,
    write_cut_out,
    write_flagged,
    write_late,
    write_streams,
    write_ten_bit,
    write_video,
)
from tests.data_catalog.test_content import in_a_circle, moving_scene, rim

SIZE = (160, 90)
"""Half as large as the video of a round picture: of most files the content does not matter."""
LARGE = (320, 180)


def surveyed(file: Path) -> Survey:
    return survey(VideoFile(file).frames(TimeSpan()), file=file)


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    """60 frames: 20 moving, 20 standing still, 20 moving; every third one blurred; round picture."""
    scene = moving_scene(61, *LARGE, speed=3)
    order = [*range(20), *([20] * 20), *range(20, 40)]
    frames = np.stack([scene[k] for k in order])
    for k in range(0, 60, 3):
        frames[k] = cv2.GaussianBlur(frames[k], (0, 0), 3)
    frames = in_a_circle(frames, rim(160, 90, 84))
    return write_video(tmp_path_factory.mktemp("video") / "exam.avi", frames)


@pytest.fixture(scope="module")
def sequence(video: Path) -> EndoscopicSequence:
    """The video, read once with its surround; nobody writes into it."""
    return read(video, IngestConfig(crop_surround=False))


class TestIntrinsics:
    def test_a_guess_follows_the_round_picture(self, sequence) -> None:
        assert sequence.intrinsics == "guessed"
        # 90 degrees over the circle of 84 pixels, less its blurred rim.
        np.testing.assert_allclose(sequence.K[:, 0, 0], 84, atol=4)
        np.testing.assert_allclose(sequence.K[:, :2, 2], np.tile([160, 90], (len(sequence), 1)), atol=1.5)

    def test_stated_beside_the_video(self, tmp_path) -> None:
        file = write_video(tmp_path / "a.avi", moving_scene(12, *SIZE, speed=3))
        (tmp_path / "intrinsics.json").write_text(json.dumps({"field_of_view_deg": 80}))
        sequence = read(file)
        assert sequence.intrinsics == "given"
        assert sequence.K[0, 0, 0] == pytest.approx(80 / np.tan(np.radians(40)))

    @pytest.mark.parametrize("stated", [None, {"field_of_view_deg": 80}, {"fx": 90, "k1": -0.3}])
    def test_a_calibration_file_takes_the_place_of_the_guess_and_of_what_is_stated(
        self, tmp_path, caplog, stated
    ) -> None:
        file = write_video(tmp_path / "a.avi", moving_scene(12, *SIZE, speed=3))
        if stated is not None:
            (tmp_path / "intrinsics.json").write_text(json.dumps(stated))
        with caplog.at_level("WARNING"):
            sequence = read(file, IngestConfig(calibration=str(calibration_file(tmp_path))))
        assert sequence.intrinsics == "given"
        np.testing.assert_allclose(sequence.K[:, 0, 0], 105)
        assert "assuming a horizontal field of view" not in caplog.text


class TestColours:
    """Of files that name their matrix of colours, and of those that do not."""

    @pytest.mark.parametrize(
        ("size", "matrix", "named"),
        [
            ((1280, 720), 1, True),
            ((1280, 720), 5, True),
            ((720, 576), 1, True),
            ((1280, 720), 1, False),
            ((720, 576), 5, False),
        ],
    )
    def test_what_was_written_is_read(self, tmp_path, size, matrix, named) -> None:
        file = tmp_path / "a.mp4"
        color = np.array((200, 80, 60), np.uint8)
        with av.open(str(file), "w") as container:
            stream = container.add_stream("libx264", rate=25, options={"crf": "5"})
            stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
            if named:
                stream.codec_context.colorspace, stream.codec_context.color_range = matrix, 1
            picture = av.VideoFrame.from_ndarray(np.full((*size[::-1], 3), color), format="rgb24")
            coded = picture.reformat(format="yuv420p", dst_colorspace=matrix, dst_color_range=1)
            for packet in [*stream.encode(coded), *stream.encode(None)]:
                container.mux(packet)
        (found,) = VideoFile(file).frames(TimeSpan())
        # Eight bits of luminance and chrominance.
        assert np.abs(found.rgb.astype(int) - color).max() <= 3

    @pytest.mark.parametrize("color_range", [1, 2], ids=["limited", "full"])
    @pytest.mark.parametrize(("pixel_format", "step"), [("yuv420p", 1), ("yuv422p", 1), ("yuv420p10le", 4)])
    def test_greys_are_rounded_to_the_nearest(self, color_range, pixel_format, step) -> None:
        """FFmpeg's own choice makes limited ranges up to 1/255 too dark, and those of 10 bits 2/255."""
        levels = range(16, 236)
        found = [_colors(grey(level * step, 128 * step, pixel_format, color_range)) for level in levels]
        told = np.array(levels) if color_range == 2 else 255 * (np.array(levels) - 16) / 219
        assert np.abs(np.array(found) - told[:, None, None, None]).max() <= 0.51

    @pytest.mark.parametrize("color_range", [1, 2], ids=["limited", "full"])
    def test_colours_are_not_darkened(self, color_range) -> None:
        scene = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (120, 160, 3)), (0, 0), 2)
        # BT.709 by hand: FFmpeg's own way there rounds as badly as that back.
        red, green, blue = np.moveaxis(scene, -1, 0)
        luminance = 0.2126 * red + 0.7152 * green + 0.0722 * blue
        chrominances = [(blue - luminance) / 1.8556, (red - luminance) / 1.5748]
        scales, floor = ((219 / 255, 224 / 255), 16) if color_range == 1 else ((1, 1), 0)
        planes = [luminance * scales[0] + floor, *(part * scales[1] + 128 for part in chrominances)]
        frame = av.VideoFrame(160, 120, "yuv420p")
        for plane, values in zip(frame.planes, planes, strict=True):
            small = cv2.resize(values, (plane.width, plane.height), interpolation=cv2.INTER_AREA)
            padded = np.pad(small, ((0, 0), (0, plane.line_size - plane.width)))
            plane.update(np.rint(padded).astype(np.uint8).tobytes())
        frame.color_range, frame.colorspace = color_range, 1
        error = _colors(frame) - scene
        assert np.abs(error.mean(axis=(0, 1))).max() < 0.1


def grey(luminance: int, chrominance: int, pixel_format: str, color_range: int) -> av.VideoFrame:
    frame = av.VideoFrame(96, 16, pixel_format)
    kind = np.dtype(np.uint16 if pixel_format.endswith("10le") else np.uint8)
    for plane, value in zip(frame.planes, (luminance, chrominance, chrominance), strict=True):
        plane.update(np.full(plane.buffer_size // kind.itemsize, value, kind).tobytes())
    frame.color_range, frame.colorspace = color_range, 1
    return frame


def calibration_file(folder: Path) -> Path:
    file = folder / "camchain.yaml"
    file.write_text(
        "cam0:\n  camera_model: pinhole\n  distortion_model: radtan\n"
        "  distortion_coeffs: [-0.1, 0.01, 0, 0]\n  intrinsics: [105, 105, 79.5, 44.5]\n"
        "  resolution: [160, 90]\n"
    )
    return file


class TestChoice:
    def test_sharp_frames_of_what_moves(self, sequence) -> None:
        numbers = np.array([int(name) for name in sequence.frame_names])
        assert 20 <= len(numbers) <= 26
        assert (numbers % 3 != 0).mean() > 0.8
        # Twenty frames of the same view: at most two are taken, at its beginning and its end.
        assert ((numbers >= 20) & (numbers < 40)).sum() <= 2
        assert sequence.world_from_camera is None
        assert sequence.metric is False

    def test_the_frames_are_those_of_the_video(self, video, sequence) -> None:
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
        file = write_video(tmp_path / "a.avi", moving_scene(10, *SIZE, speed=4))
        found = surveyed(file)
        np.testing.assert_allclose(np.diff(found.path), 4 / 160, rtol=0.15)
        assert (found.width, found.height) == SIZE

    def test_noise_does_not_add_up(self) -> None:
        """A scope that stands still for five seconds under sensor noise and trembling has not moved."""
        rng = np.random.default_rng(0)
        scene = moving_scene(3, *LARGE, speed=1)
        frames = scene[rng.integers(0, 2, 125)] + rng.normal(0, 6, (125, 180, 320, 1))
        images = np.clip(frames, 0, 255).astype(np.uint8)
        seen = [FootageFrame(number, number / 25, image) for number, image in enumerate(images)]
        assert survey(seen, file=Path("a.avi")).path[-1] < 0.01

    def test_a_small_motion_is_used_whole(self, tmp_path) -> None:
        file = write_video(tmp_path / "a.avi", moving_scene(40, *LARGE, speed=1))
        assert len(read(file)) >= 20

    def test_same_bits_twice(self, video, sequence) -> None:
        first, second = sequence, read(video, IngestConfig(crop_surround=False))
        np.testing.assert_array_equal(first.rgb, second.rgb)
        np.testing.assert_array_equal(first.mask, second.mask)


class TestReading:
    def test_the_round_picture_is_masked(self, sequence) -> None:
        mask = sequence.mask[0]
        expected = rim(160, 90, 84).mask(*LARGE)
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
            sequence = read(place, IngestConfig(max_frames=4, crop_surround=False))
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
        read_frames = [event for event in seen if event.total == 65]
        assert read_frames[-1].done == 65
        assert [event.done for event in read_frames] == [61, 62, 63, 64, 65]

    def test_a_compressed_video(self, tmp_path) -> None:
        file = write_video(tmp_path / "a.mp4", moving_scene(20, *SIZE, speed=3), "mp4v")
        assert len(read(file)) > 6


class TestKindsOfFiles:
    """What endoscopes and their recorders give."""

    def test_interlaced(self, tmp_path, caplog) -> None:
        scene = moving_scene(60, 160, 240, speed=2)
        file = write_video(tmp_path / "a.avi", interlaced(scene))
        with caplog.at_level("WARNING"):
            sequence = read(file)
        assert "a.avi: interlaced" in caplog.text
        for name, image in zip(sequence.frame_names, sequence.rgb, strict=True):
            # Of one moment: its lines are those of the first of the two pictures.
            np.testing.assert_array_equal(image[::2], scene[2 * int(name)][::2])
            assert np.abs(image[1::2].astype(int) - scene[2 * int(name)][1::2]).mean() < 4

    def test_flagged_as_interlaced(self, tmp_path, caplog) -> None:
        """OpenCV decodes such files to empty pictures."""
        scene = moving_scene(40, 160, 240, speed=2)
        file = write_flagged(tmp_path / "a.mpg", interlaced(scene))
        with caplog.at_level("WARNING"):
            sequence = read(file, IngestConfig(max_frames=6))
        assert "a.mpg: interlaced" in caplog.text
        for name, image in zip(sequence.frame_names, sequence.rgb, strict=True):
            assert np.abs(image.astype(int) - scene[2 * int(name)]).mean() < 12

    def test_not_interlaced(self, tmp_path, caplog) -> None:
        with caplog.at_level("WARNING"):
            read(write_video(tmp_path / "a.avi", moving_scene(30, 160, 240, speed=3)))
        assert "a.avi: interlaced" not in caplog.text

    def test_ten_bits(self, tmp_path) -> None:
        scene = moving_scene(12, *SIZE, speed=3)
        sequence = read(write_ten_bit(tmp_path / "a.y4m", scene))
        for name, image in zip(sequence.frame_names, sequence.rgb, strict=True):
            assert image.dtype == np.uint8
            assert np.abs(image.astype(int) - scene[int(name)]).mean() < 6

    @pytest.mark.parametrize(
        ("suffix", "codec"),
        [
            (".ts", "libx264"),
            (".m2ts", "libx264"),
            (".MTS", "libx264"),
            (".vob", "mpeg2video"),
            (".m2v", "mpeg2video"),
            (".3gp", "mpeg4"),
            (".asf", "msmpeg4"),
            (".flv", "flv"),
        ],
    )
    def test_containers(self, tmp_path, suffix, codec) -> None:
        scene = moving_scene(12, *SIZE, speed=3)
        sequence = read(write_coded(tmp_path / f"a{suffix}", scene, codec))
        assert len(sequence) >= 4
        for name, image in zip(sequence.frame_names, sequence.rgb, strict=True):
            assert np.abs(image.astype(int) - scene[int(name)]).mean() < 8

    def test_pixels_that_are_not_square(self, tmp_path) -> None:
        file = write_ten_bit(tmp_path / "a.y4m", moving_scene(12, *LARGE, speed=6), pixel_aspect="16:15")
        sequence = read(file)
        K = sequence.K[0]
        assert K[0, 0] == pytest.approx(160)
        assert K[1, 1] == pytest.approx(160 * 16 / 15)
        square = sequence.with_square_pixels()
        assert (square.width, square.height) == (320, 169)
        assert square.K[0, 1, 1] == pytest.approx(160, rel=0.002)

    def test_a_rotation_in_the_container(self, tmp_path) -> None:
        scene = moving_scene(12, *SIZE, speed=3)
        plain = write_video(tmp_path / "a.mp4", scene, "mp4v")
        upright = tmp_path / "upright.mp4"
        upright.write_bytes(turned(plain.read_bytes(), SIZE[1]))
        before, after = read(plain), read(upright)
        assert after.rgb.shape[1:3] == SIZE
        assert after.K[0, 0, 2] == SIZE[1] / 2
        shared = sorted(set(before.frame_names) & set(after.frame_names))
        assert shared
        for name in shared:
            first, second = (item.rgb[item.frame_names.index(name)] for item in (before, after))
            np.testing.assert_array_equal(second, np.rot90(first, -1))

    def test_a_frame_rate_that_varies(self, tmp_path, caplog) -> None:
        """Forty frames in four seconds, then twenty in twenty: timestamps tell which part is the longer."""
        first, second = moving_scene(40, *SIZE, speed=2), 255 - moving_scene(61, *SIZE, speed=2)[41:, ::-1]
        plain = write_video(tmp_path / "plain.mp4", np.concatenate([first, second]), "mp4v")
        file = tmp_path / "a.mp4"
        file.write_bytes(retimed(plain.read_bytes(), [1280] * 40 + [12800] * 20))
        times = [frame.time_s for frame in VideoFile(file).frames(TimeSpan())]
        np.testing.assert_allclose(times, [*(0.1 * np.arange(40)), *(4 + np.arange(20))], atol=1e-3)
        with caplog.at_level("INFO"):
            numbers = [int(name) for name in read(file).frame_names]
        assert min(numbers) >= 40
        assert "the frame rate varies, from 0.1 to 1 s a frame" in caplog.text
        assert max(int(name) for name in read(plain).frame_names) < 40

    def test_a_part_of_it(self, tmp_path) -> None:
        file = write_video(tmp_path / "a.avi", moving_scene(50, *SIZE, speed=2))
        numbers = [int(name) for name in read(file, IngestConfig(start_s=0.4, end_s=1.2)).frame_names]
        assert min(numbers) >= 10
        assert max(numbers) < 30
        with pytest.raises(SourceError, match=r"no frame from 60 to 70 s \(ingest.start_s, ingest.end_s\)"):
            read(file, IngestConfig(start_s=60, end_s=70))
        with pytest.raises(SourceError, match=r"no frame from 100 s on .*; the last frame is at 1\.96 s"):
            read(file, IngestConfig(start_s=100))
        with pytest.raises(ConfigError, match=r"ingest\.end_s = 2 is not after ingest\.start_s = 3"):
            read(file, IngestConfig(start_s=3, end_s=2))


@pytest.fixture(scope="module")
def cut(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A title, 40 frames of one place with a flash in their midst, and 25 of another."""
    title = np.full((50, SIZE[1], SIZE[0], 3), 20, np.uint8)
    for image in title:
        cv2.putText(image, "EXAM 12", (30, 50), cv2.FONT_HERSHEY_SIMPLEX, 0.75, (255, 255, 255), 2)
    first = moving_scene(40, *SIZE, speed=2)
    first[20:22] = 250
    second = 255 - moving_scene(65, *SIZE, speed=2)[40:, ::-1]
    return write_video(tmp_path_factory.mktemp("cut") / "a.avi", np.concatenate([title, first, second]))


class TestShots:
    def test_the_longest_that_moves_is_read(self, cut, caplog) -> None:
        with caplog.at_level("WARNING"):
            numbers = [int(name) for name in read(cut).frame_names]
        assert min(numbers) >= 50
        assert max(numbers) < 90
        # The flash neither ends the shot nor is chosen.
        assert max(numbers) >= 85
        assert not {70, 71} & set(numbers)
        assert "cut into 3 shots; the longest that moves is read, 2.0 to 3.6 s" in caplog.text
        assert "0.0 to 2.0 s" in caplog.text

    def test_another_is_taken_by_its_time(self, cut) -> None:
        numbers = [int(name) for name in read(cut, IngestConfig(start_s=3.6)).frame_names]
        assert min(numbers) >= 90

    def test_a_quick_move_is_no_cut(self, tmp_path) -> None:
        found = surveyed(write_video(tmp_path / "a.avi", moving_scene(20, *SIZE, speed=20)))
        assert len(found.all_shots()) == 1

    def test_memory_does_not_grow_with_the_length(self, tmp_path) -> None:
        """Frames that are alive at the same time, over both passes."""
        scene = moving_scene(200, 64, 48, speed=1)
        alive: weakref.WeakSet[FootageFrame] = weakref.WeakSet()
        most = 0

        class Long:
            file = tmp_path / "long"
            announced = 420
            size = (64, 48)
            pixel_aspect = 1.0

            def counted_until(self, end_s: float) -> int:
                return round(min(self.announced, 25 * end_s))

            def frames(self, span: TimeSpan, numbers: Collection[int] | None = None):
                nonlocal most
                for number in range(self.announced):
                    if numbers is None or number in numbers:
                        back_and_forth = abs((number + 200) % 398 - 199)
                        frame = FootageFrame(number, number / 25, scene[back_and_forth].copy())
                        alive.add(frame)
                        most = max(most, len(alive))
                        yield frame
                        del frame

        source = footage_frames(Long(), IngestConfig())
        assert len(source.frames) == 200
        for frame in source.frames:
            source.read_color(frame)
        assert most <= 3


class TestStreams:
    def test_a_cover_is_no_video(self, tmp_path, caplog) -> None:
        """Nor is it a second camera."""
        scene = moving_scene(12, *SIZE, speed=3)
        file = write_streams(tmp_path / "a.mp4", [scene[:1] // 2, scene], cover_first=True)
        assert len(read(file)) > 6
        assert "streams of pictures" not in caplog.text

    def test_a_second_camera_is_told_of(self, tmp_path, caplog) -> None:
        scene = moving_scene(12, *SIZE, speed=3)
        file = write_streams(tmp_path / "a.mkv", [scene, scene[::-1]])
        assert len(read(file)) > 6
        assert "a.mkv: 2 streams of pictures, as of two cameras; the first is read" in caplog.text


class TestRefused:
    @pytest.mark.parametrize("config", [IngestConfig(), IngestConfig(end_s=0.01)])
    def test_a_single_frame_does_not_stand_still(self, tmp_path, config) -> None:
        count = 1 if config.end_s is None else 12
        file = write_video(tmp_path / "one.avi", moving_scene(count, *SIZE, speed=3))
        with pytest.raises(SourceError, match=r"one\.avi, field frames: one frame alone, in the file or in"):
            read(file, config)

    def test_a_scope_that_stands_still(self, tmp_path) -> None:
        file = write_video(tmp_path / "still.avi", np.repeat(moving_scene(1, *SIZE), 12, axis=0))
        with pytest.raises(SourceError, match=r"still\.avi, field motion: the picture moves by 0\.0%"):
            read(file)

    @pytest.mark.parametrize("start_s", [0.0, 0.4, 100.0])
    @pytest.mark.parametrize("name", ["late.mkv", "late.webm"])
    def test_a_whole_video_that_starts_late_is_not(self, tmp_path, name, start_s) -> None:
        """The duration in its header includes the time before the first frame."""
        file = VideoFile(write_late(tmp_path / name, moving_scene(20, 64, 48), start_s))
        frames = list(file.frames(TimeSpan()))
        assert file.announced == len(frames) == 20
        assert [frame.time_s for frame in frames] == pytest.approx(np.arange(20) / 25, abs=2e-3)

    def test_a_whole_video_that_hides_its_beginning_is_not(self, tmp_path) -> None:
        """The header counts frames that are not shown."""
        file = VideoFile(write_cut_out(tmp_path / "part.mp4", moving_scene(40, 64, 48), 20))
        frames = list(file.frames(TimeSpan()))
        assert file.announced == len(frames) == 20
        assert [frame.time_s for frame in frames] == pytest.approx(np.arange(20) / 25, abs=2e-3)

    @pytest.mark.parametrize("start_s", [0.0, 100.0])
    def test_a_truncated_one_that_starts_late(self, tmp_path, start_s) -> None:
        whole = write_late(tmp_path / "late.mkv", moving_scene(60, 64, 48), start_s)
        whole.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
        with pytest.raises(SourceError, match=r"late\.mkv.*(truncated|cannot be opened)"):
            list(VideoFile(whole).frames(TimeSpan()))

    def test_sound_alone(self, tmp_path) -> None:
        with av.open(str(tmp_path / "voice.mp4"), "w") as container:
            stream = container.add_stream("aac", rate=44100, layout="mono")
            frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            frame.sample_rate = 44100
            container.mux(stream.encode(frame))
            container.mux(stream.encode())
        with pytest.raises(SourceError, match=r"voice\.mp4: no stream of pictures in it"):
            read(tmp_path / "voice.mp4")

    @pytest.mark.parametrize("share", [0.0, 0.3, 0.7])
    def test_a_truncated_file(self, video, tmp_path, share) -> None:
        file = tmp_path / "cut.avi"
        file.write_bytes(video.read_bytes()[: int(share * video.stat().st_size)])
        with pytest.raises(SourceError, match=r"cut\.avi.*(cannot be opened|truncated|not a single frame)"):
            read(file)
