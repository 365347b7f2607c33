"""DICOM multi-frame files: read like videos."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from data_catalog.catalog import read, resolve, source_fingerprint
from data_catalog.footage import TimeSpan
from data_catalog.readers.dicom import open_dicom
from extrags.config import IngestConfig
from extrags.errors import MissingDependencyError, SourceError
from tests.data_catalog.footage_fixture import write_dicom, write_video
from tests.data_catalog.test_content import in_a_circle, moving_scene, rim, signed

SIZE = (160, 120)


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    return moving_scene(12, *SIZE, speed=4)


def decoded(file: Path) -> np.ndarray:
    return np.stack([frame.rgb for frame in open_dicom(file).frames(TimeSpan())])


class TestPixels:
    @pytest.mark.parametrize(
        ("colors", "jpeg", "tolerance"),
        [
            ("RGB", False, 0),
            ("YBR_FULL", False, 2),
            ("YBR_FULL_422", False, 16),
            ("YBR_FULL", True, 12),
            ("YBR_FULL_422", True, 12),
        ],
    )
    def test_colours(self, scene, tmp_path, colors, jpeg, tolerance) -> None:
        file = write_dicom(tmp_path / "a.dcm", scene[:3], colors=colors, jpeg=jpeg)
        difference = np.abs(decoded(file).astype(int) - scene[:3])
        assert np.percentile(difference, 95) <= tolerance

    def test_grey(self, scene, tmp_path) -> None:
        grey = scene[:3, :, :, 1]
        file = write_dicom(tmp_path / "a.dcm", grey, colors="MONOCHROME2")
        np.testing.assert_array_equal(decoded(file), np.repeat(grey[..., None], 3, axis=3))

    def test_of_more_bits_the_highest_eight(self, scene, tmp_path) -> None:
        grey = scene[:3, :, :, 1].astype(np.uint16) * 16 + 7
        file = write_dicom(tmp_path / "a.dcm", grey, colors="MONOCHROME2", bits=12)
        np.testing.assert_array_equal(decoded(file)[..., 0], scene[:3, :, :, 1])

    def test_a_video_stream_inside(self, scene, tmp_path) -> None:
        video = write_video(tmp_path / "a.mp4", scene, "mp4v")
        file = write_dicom(tmp_path / "a.dcm", scene, colors="YBR_PARTIAL_420", stream=video.read_bytes())
        video.unlink()
        footage = open_dicom(file)
        assert (footage.announced, footage.file) == (12, file)
        assert np.abs(decoded(file).astype(int) - scene).mean() < 6

    @pytest.mark.parametrize(
        ("elements", "last_s"),
        [
            ({"FrameTime": 50}, 0.55),
            ({"CineRate": 10}, 1.1),
            ({"FrameTime": 0, "CineRate": 10}, 1.1),
            ({"RecommendedDisplayFrameRate": 20}, 0.55),
            ({"FrameTimeVector": [0, *([100] * 10), 2000]}, 3.0),
            ({}, 0.44),
        ],
    )
    def test_timestamps(self, scene, tmp_path, elements, last_s) -> None:
        file = write_dicom(tmp_path / "a.dcm", scene, **elements)
        frames = list(open_dicom(file).frames(TimeSpan()))
        assert frames[0].time_s == 0
        assert frames[-1].time_s == pytest.approx(last_s)
        late = open_dicom(file).frames(TimeSpan(last_s - 1e-3))
        assert [frame.number for frame in late] == [11]

    @pytest.mark.parametrize(
        ("elements", "last_s", "told"),
        [
            ({"FrameTime": 50}, 0.55, []),
            ({}, 0.44, ["a.dcm has no timing: assuming 25 frames a second"]),
            (
                {"FrameTimeVector": [0, 100, 100]},
                0.44,
                ["FrameTimeVector has 3 entries for 12 frames", "has no timing: assuming 25"],
            ),
            (
                {"FrameTimeVector": [0, 100, 100], "FrameTime": 50},
                0.55,
                ["FrameTimeVector has 3 entries for 12 frames"],
            ),
        ],
    )
    def test_timing_that_is_assumed_is_told(self, scene, tmp_path, caplog, elements, last_s, told) -> None:
        footage = open_dicom(write_dicom(tmp_path / "a.dcm", scene, **elements))
        assert [frame.time_s for frame in footage.frames(TimeSpan())][-1] == pytest.approx(last_s)
        assert len(caplog.messages) == len(told)
        assert all(part in said for part, said in zip(told, caplog.messages, strict=True))

    def test_pixel_aspect(self, scene, tmp_path) -> None:
        file = write_dicom(tmp_path / "a.dcm", scene, PixelAspectRatio=[11, 12])
        K = read(file, IngestConfig(max_frames=4)).K[0]
        assert K[1, 1] == pytest.approx(K[0, 0] * 12 / 11)


class TestReading:
    def test_like_a_video(self, tmp_path) -> None:
        circle = rim(80, 60, 56)
        scene = signed(in_a_circle(moving_scene(30, *SIZE, speed=3), circle))
        file = write_dicom(tmp_path / "exam.dcm", scene)
        for place in (file, tmp_path):
            assert resolve(place).format == "dicom"
        assert resolve(file).name == "exam"
        sequence = read(file, IngestConfig(crop_surround=False))
        assert len(sequence) >= 20
        assert sequence.world_from_camera is None
        assert sequence.intrinsics == "guessed"
        for name, image in zip(sequence.frame_names, sequence.rgb, strict=True):
            np.testing.assert_array_equal(image, scene[int(name)])
        assert not sequence.mask[0][~circle.mask(*SIZE)].any()
        assert sequence.mask[0].mean() > 0.6 * circle.mask(*SIZE).mean()

    def test_without_a_suffix(self, scene, tmp_path) -> None:
        file = write_dicom(tmp_path / "IM000001", scene)
        assert resolve(file).format == "dicom"
        assert source_fingerprint(file)["files"][0][0] == "source"

    def test_nothing_of_the_patient_is_read(self, scene, tmp_path, caplog) -> None:
        file = write_dicom(tmp_path / "a.dcm", scene)
        with caplog.at_level("DEBUG"):
            sequence = read(file, IngestConfig(max_frames=4))
        assert "Doe" not in caplog.text
        assert "Doe" not in repr(sequence.truth)


class TestRefused:
    def test_a_single_frame(self, scene, tmp_path) -> None:
        file = write_dicom(tmp_path / "a.dcm", scene[:1])
        with pytest.raises(
            SourceError, match=r"a\.dcm, field NumberOfFrames: a single frame.*folder of pict"
        ):
            read(file)

    def test_other_colours(self, scene, tmp_path) -> None:
        file = write_dicom(tmp_path / "a.dcm", scene[..., 0], colors="MONOCHROME2")
        content = file.read_bytes().replace(b"MONOCHROME2 ", b"PALETTE COL ")
        file.write_bytes(content)
        with pytest.raises(
            SourceError, match="field PhotometricInterpretation: PALETTE COL is not understood"
        ):
            read(file)

    def test_a_compression_that_nothing_here_decodes(self, scene, tmp_path) -> None:
        file = write_dicom(tmp_path / "a.dcm", scene, jpeg=True, colors="YBR_FULL")
        # JPEG-LS, of the same length as JPEG baseline.
        file.write_bytes(file.read_bytes().replace(b"1.2.840.10008.1.2.4.50", b"1.2.840.10008.1.2.4.80"))
        with pytest.raises(SourceError, match=r"a\.dcm.*Unable to decompress"):
            read(file)

    @pytest.mark.parametrize("share", [0.02, 0.5, 0.9])
    @pytest.mark.parametrize("jpeg", [False, True])
    def test_a_truncated_file(self, scene, tmp_path, share, jpeg) -> None:
        file = write_dicom(tmp_path / "a.dcm", scene, jpeg=jpeg, colors="YBR_FULL" if jpeg else "RGB")
        file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
        with pytest.raises(SourceError, match=r"a\.dcm"):
            read(file)

    @pytest.mark.parametrize(
        ("elements", "message"),
        [
            ({"FrameTime": -40}, "field FrameTime: -40 ms for a frame; expected a positive number"),
            ({"CineRate": -25}, "field CineRate: -25 frames a second"),
            (
                {"FrameTimeVector": [0, *([40] * 10), -2000]},
                "frame 11, field FrameTimeVector: -2000 ms since",
            ),
        ],
    )
    def test_times_that_go_back(self, scene, tmp_path, elements, message) -> None:
        file = write_dicom(tmp_path / "a.dcm", scene, **elements)
        with pytest.raises(SourceError, match=rf"a\.dcm, {message}"):
            open_dicom(file)

    @pytest.mark.parametrize(
        ("side", "message"), [(65535, "pixels, too large: more than"), (9000, "in .* bytes: the")]
    )
    def test_frames_that_the_file_cannot_hold(self, scene, tmp_path, side, message) -> None:
        file = write_dicom(tmp_path / "a.dcm", scene, Rows=side, Columns=side)
        with pytest.raises(SourceError, match=rf"a\.dcm, field Rows: frames of {side} x .*{message}"):
            open_dicom(file)

    def test_what_unpacks_to_any_size(self, scene, tmp_path) -> None:
        from pydicom import dcmread
        from pydicom.uid import DeflatedExplicitVRLittleEndian

        file = write_dicom(tmp_path / "a.dcm", scene)
        dataset = dcmread(file)
        dataset.file_meta.TransferSyntaxUID = DeflatedExplicitVRLittleEndian
        dataset.save_as(file, enforce_file_format=True)
        with pytest.raises(SourceError, match=r"a\.dcm, field TransferSyntaxUID: a deflated file"):
            open_dicom(file)

    def test_no_dicom_file(self, tmp_path) -> None:
        file = tmp_path / "a.dcm"
        file.write_bytes(b"something else" * 30)
        with pytest.raises(SourceError, match=r"a\.dcm: no DICOM file"):
            read(file)

    def test_without_pydicom(self, scene, tmp_path, monkeypatch) -> None:
        file = write_dicom(tmp_path / "a.dcm", scene)
        for name in [name for name in sys.modules if name.split(".")[0] == "pydicom"]:
            monkeypatch.delitem(sys.modules, name)
        monkeypatch.setattr("data_catalog.readers.dicom.find_spec", lambda name: None)
        with pytest.raises(MissingDependencyError, match=r"pip install -e '\.\[dicom\]'"):
            read(file)


class TestJpeg2000:
    """Whose transform of colours is undone where the frames are decoded."""

    @pytest.mark.parametrize(
        ("colors", "lossless", "tolerance"), [("YBR_RCT", True, 0), ("RGB", True, 0), ("YBR_ICT", False, 12)]
    )
    def test_colours(self, scene, tmp_path, colors, lossless, tolerance) -> None:
        from pydicom.uid import JPEG2000, JPEG2000Lossless

        syntax = JPEG2000Lossless if lossless else JPEG2000
        scene = np.ascontiguousarray(scene[:3] * [1.0, 0.6, 0.4] + [0, 10, 30]).astype(np.uint8)  # coloured
        coded = [jpeg2000(image, lossless=lossless) for image in scene]
        file = write_compressed(tmp_path / "a.dcm", scene, coded, str(syntax), colors)
        for numbers in (None, [0, 2], [1]):
            wanted = range(len(scene)) if numbers is None else numbers
            found = list(open_dicom(file).frames(TimeSpan(), numbers))
            assert [frame.number for frame in found] == list(wanted)
            for frame in found:
                apart = np.abs(frame.rgb.astype(int) - scene[frame.number])
                assert apart.max() <= tolerance


def jpeg2000(image: np.ndarray, *, lossless: bool) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(
        buffer,
        "JPEG2000",
        no_jp2=True,
        mct=1,
        irreversible=not lossless,
        quality_mode="rates",
        quality_layers=[0 if lossless else 2],
    )
    return buffer.getvalue()


def write_compressed(file: Path, frames: np.ndarray, coded: list[bytes], syntax: str, colors: str) -> Path:
    """A multi-frame file with frames that were compressed elsewhere."""
    from pydicom import dcmread
    from pydicom.encaps import encapsulate
    from pydicom.uid import UID

    write_dicom(file, frames, colors="YBR_FULL", jpeg=True)
    dataset = dcmread(file)
    dataset.file_meta.TransferSyntaxUID = UID(syntax)
    dataset.PhotometricInterpretation = colors
    dataset.PixelData = encapsulate(coded)
    dataset["PixelData"].is_undefined_length = True
    dataset.save_as(file, enforce_file_format=True)
    return file
