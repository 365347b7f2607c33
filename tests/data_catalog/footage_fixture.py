"""Small videos and DICOM files of the kinds that endoscopes and their recorders give."""

from __future__ import annotations

import io
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

_BOXES_OF_BOXES = (b"moov", b"trak", b"mdia", b"minf", b"stbl")


def write_video(file: Path, frames: np.ndarray, code: str = "FFV1") -> Path:
    """Lossless by default."""
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*code), 25, (frames.shape[2], frames.shape[1]))
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()
    return file


def write_coded(file: Path, frames: np.ndarray, codec: str, *, start_s: float = 0.0, **options: str) -> Path:
    """In the container that the suffix says, by one of FFmpeg's encoders, from a time on."""
    import av

    later = {"output_ts_offset": str(start_s)} if start_s else {}
    with av.open(str(file), "w", container_options=later) as container:
        stream = container.add_stream(codec, rate=25, options={"b": "8000000", **options})
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for image in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image)))
        container.mux(stream.encode())
    return file


def write_streams(file: Path, streams: Sequence[np.ndarray], *, cover_first: bool = False) -> Path:
    """Several streams of pictures in one file; the first a cover where that is asked for."""
    import av
    from av.stream import Disposition

    with av.open(str(file), "w") as container:
        coded = []
        for frames in streams:
            stream = container.add_stream("mjpeg", rate=25)
            stream.height, stream.width = frames.shape[1:3]
            stream.pix_fmt = "yuvj420p"
            coded.append(stream)
        if cover_first:
            coded[0].disposition = Disposition.attached_pic
        for frames, stream in zip(streams, coded, strict=True):
            for image in frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image)))
            container.mux(stream.encode())
    return file


def write_flagged(file: Path, woven: np.ndarray) -> Path:
    """MPEG-2 whose header says that it is interlaced, as recorders write it."""
    return write_coded(file, woven, "mpeg2video", flags="+ildct+ilme")


def write_late(file: Path, frames: np.ndarray, start_s: float) -> Path:
    """Matroska or WebM whose first frame is not at time 0, as cuts and recordings with sound have it."""
    import av

    with av.open(str(file), "w") as container:
        stream = container.add_stream("libvpx" if file.suffix == ".webm" else "mjpeg", rate=25)
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv420p" if file.suffix == ".webm" else "yuvj420p"
        for number, image in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(image)
            frame.pts = number + round(25 * start_s)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return file


def write_cut_out(file: Path, frames: np.ndarray, hidden: int) -> Path:
    """MP4 that was cut out of a longer one without coding it anew.

    The first so many frames are stored, since others rest on their key frame, and an edit list hides them.
    """
    import av

    with av.open(str(file), "w", container_options={"avoid_negative_ts": "disabled"}) as container:
        stream = container.add_stream("mpeg4", rate=25, options={"g": "600", "b": "4000000"})
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv420p"

        def mux(packets: Sequence[Any]) -> None:
            for packet in packets:
                earlier = round(hidden / 25 / float(packet.time_base))
                packet.pts, packet.dts = packet.pts - earlier, packet.dts - earlier
                container.mux(packet)

        for image in frames:
            mux(stream.encode(av.VideoFrame.from_ndarray(image)))
        mux(stream.encode())
    return file


def write_ten_bit(file: Path, frames: np.ndarray, *, pixel_aspect: str = "1:1") -> Path:
    """YUV4MPEG2 with 10 bits a channel and halved chroma, limited range."""
    height, width = frames.shape[1:3]
    header = f"YUV4MPEG2 W{width} H{height} F25:1 Ip A{pixel_aspect} C420p10\n"
    with file.open("wb") as stream:
        stream.write(header.encode())
        for frame in frames:
            red, green, blue = np.moveaxis(frame.astype(float) / 255, -1, 0)
            luma = 0.299 * red + 0.587 * green + 0.114 * blue
            planes = [64 + 876 * luma]
            for color, scale in ((blue, 1.772), (red, 1.402)):
                chroma = 512 + 896 * (color - luma) / scale
                planes.append(chroma.reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3)))
            stream.write(b"FRAME\n")
            stream.writelines(np.rint(plane).astype("<u2").tobytes() for plane in planes)
    return file


def retimed(mp4: bytes, steps: Sequence[int]) -> bytes:
    """An MP4 with another duration for each frame, in units of its clock (512 are 40 ms)."""

    def walked(block: bytes) -> bytes:
        out, at = b"", 0
        while at < len(block):
            size, kind = struct.unpack(">I4s", block[at : at + 8])
            body = block[at + 8 : at + size]
            at += size
            if kind == b"edts":
                continue
            if kind in _BOXES_OF_BOXES:
                body = walked(body)
            if kind == b"stts":
                entries = [struct.pack(">II", 1, step) for step in steps]
                body = struct.pack(">II", 0, len(steps)) + b"".join(entries)
            if kind == b"mdhd":
                body = body[:16] + struct.pack(">I", sum(steps)) + body[20:]
            out += struct.pack(">I4s", len(body) + 8, kind) + body
        return out

    return walked(mp4)


def turned(mp4: bytes, height: int) -> bytes:
    """An MP4 that says that it is to be shown a quarter turn clockwise."""
    at = mp4.index(b"tkhd") + 4 + 40
    matrix = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, height << 16, 0, 1 << 30)
    return mp4[:at] + matrix + mp4[at + len(matrix) :]


def interlaced(scene: np.ndarray) -> np.ndarray:
    """Each two pictures woven into one, line by line."""
    woven = scene[::2].copy()
    woven[:, 1::2] = scene[1::2, 1::2]
    return woven


def write_dicom(
    file: Path,
    frames: np.ndarray,
    *,
    colors: str = "RGB",
    jpeg: bool = False,
    stream: bytes | None = None,
    bits: int = 8,
    **elements: Any,
) -> Path:
    """A multi-frame file of the ultrasound kind, the oldest for endoscopy.

    Args:
        file: to write.
        frames: [F, h, w, 3], or grey [F, h, w].
        colors: photometric interpretation; the values are converted.
        jpeg: compressed frame by frame; else as they are.
        stream: a whole video in place of frames.
        bits: stored of 8 or 16.
        elements: more of them.
    """
    from pydicom.dataset import Dataset, FileMetaDataset
    from pydicom.encaps import encapsulate
    from pydicom.uid import MPEG4HP41, ExplicitVRLittleEndian, JPEGBaseline8Bit, generate_uid

    dataset = Dataset()
    dataset.file_meta = FileMetaDataset()
    syntax = MPEG4HP41 if stream else JPEGBaseline8Bit if jpeg else ExplicitVRLittleEndian
    dataset.file_meta.TransferSyntaxUID = syntax
    dataset.SOPClassUID = dataset.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.3.1"
    dataset.SOPInstanceUID = dataset.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    dataset.PatientName = "Doe^Jane"
    dataset.NumberOfFrames, dataset.Rows, dataset.Columns = frames.shape[:3]
    dataset.SamplesPerPixel = 3 if frames.ndim == 4 else 1
    dataset.PhotometricInterpretation = colors
    dataset.BitsStored = bits
    dataset.BitsAllocated = 8 if bits <= 8 else 16
    dataset.HighBit = bits - 1
    dataset.PixelRepresentation = 0
    if frames.ndim == 4:
        dataset.PlanarConfiguration = 0
    for name, value in elements.items():
        setattr(dataset, name, value)
    if stream is not None:
        dataset.PixelData = encapsulate([stream])
    elif jpeg:
        dataset.PixelData = encapsulate([_jpeg(frame) for frame in frames])
    else:
        values = frames if colors in ("RGB", "MONOCHROME2") else np.stack([_ybr(frame) for frame in frames])
        if colors == "YBR_FULL_422":
            values = np.stack(
                [values[:, :, ::2, 0], values[:, :, 1::2, 0], values[:, :, ::2, 1], values[:, :, ::2, 2]], -1
            )
        dataset.PixelData = values.astype("<u2" if bits > 8 else np.uint8).tobytes()
    if dataset.file_meta.TransferSyntaxUID.is_encapsulated:
        dataset["PixelData"].VR = "OB"
        dataset["PixelData"].is_undefined_length = True
    dataset.save_as(file, enforce_file_format=True)
    return file


def _ybr(rgb: np.ndarray) -> np.ndarray:
    luma_red_blue = cv2.cvtColor(rgb, cv2.COLOR_RGB2YCrCb)
    return luma_red_blue[..., [0, 2, 1]]


def _jpeg(rgb: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, "JPEG", quality=95, subsampling=0)
    return buffer.getvalue()
