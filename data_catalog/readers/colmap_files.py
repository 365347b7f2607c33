"""COLMAP's model files, binary and text, in and out.

A model is three files: `cameras`, `images` and `points3D`, all `.bin` or all `.txt`. Poses on disk are
camera-from-world, quaternion (w, x, y, z) and translation, in OpenCV axes; pixel centres lie at +0.5. They
become `world_from_camera` here and nothing else is turned. Numbers are written with all their digits.

Source: https://colmap.github.io/format.html.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from data_catalog.rotations import quaternion_rotation
from extrags.cameras import compose, invert_poses
from extrags.errors import PoseError, SourceError, SourceNotFoundError
from extrags.lens import LENS_PARAMETERS, Lens

__all__ = ["ColmapImage", "ColmapModel", "read_image_names", "read_model", "write_model"]

_PANORAMA = "EQUIRECTANGULAR"
_MODEL_NAMES = dict(enumerate([*LENS_PARAMETERS, _PANORAMA]))
"""COLMAP numbers its models in this order."""
_MODEL_IDS = {name: number for number, name in _MODEL_NAMES.items()}
_NO_POINT = -1
_LARGEST = 2**63 - 1


@dataclass(frozen=True)
class ColmapImage:
    """One registered image.

    Args:
        name: path below the image folder.
        camera: key of its lens.
        world_from_camera: its pose.
        observed_px: keypoints in pixels, [M, 2].
        observed_point: index into the model's points of each keypoint, -1 for none, [M].
    """

    name: str
    camera: int
    world_from_camera: Float[np.ndarray, "4 4"]
    observed_px: Float[np.ndarray, "m 2"]
    observed_point: Int[np.ndarray, "m"]


@dataclass(frozen=True)
class ColmapModel:
    """A sparse model.

    Args:
        lenses: by camera number.
        images: in the order of the file.
        points: [P, 3].
        points_rgb: [P, 3].
    """

    lenses: dict[int, Lens]
    images: list[ColmapImage]
    points: Float[np.ndarray, "p 3"]
    points_rgb: UInt8[np.ndarray, "p 3"]


def read_model(folder: Path) -> ColmapModel:
    """Read a model; binary files are preferred where both kinds lie there, as COLMAP does.

    Raises:
        SourceNotFoundError: one of the three files is missing.
        SourceError: a file is damaged; names what was read last.
        PoseError: a quaternion that is none.
    """
    suffix = ".bin" if (folder / "images.bin").is_file() else ".txt"
    files = [folder / f"{name}{suffix}" for name in ("cameras", "images", "points3D")]
    for file in files:
        if not file.is_file():
            raise SourceNotFoundError(
                f"no such file; a COLMAP model is cameras{suffix}, images{suffix} and points3D{suffix}",
                file=file,
            )
    if suffix == ".bin":
        lenses, rows = _binary_cameras(files[0]), _binary_images(files[1])
        identifiers, points, colors = _binary_points(files[2])
    else:
        lenses, rows = _text_cameras(files[0]), _text_images(files[1])
        identifiers, points, colors = _text_points(files[2])
    order = np.argsort(identifiers)
    images = []
    for name, camera, quaternion, translation, pixels, observed in rows:
        if camera not in lenses:
            raise SourceError(
                f"refers to camera {camera}, which {files[0].name} does not hold",
                file=files[1],
                frame=name,
                field="camera_id",
            )
        images.append(
            ColmapImage(
                name=name,
                camera=camera,
                world_from_camera=_pose(quaternion, translation, files[1], name),
                observed_px=pixels,
                observed_point=_positions(observed, identifiers, order, files[1], name),
            )
        )
    if not images:
        raise SourceError("the model holds no registered image", file=files[1])
    seen: set[str] = set()
    for image in images:
        if image.name in seen:
            raise SourceError("the image is listed twice", file=files[1], frame=image.name, field="name")
        seen.add(image.name)
    return ColmapModel(lenses, images, points, colors)


def read_image_names(folder: Path) -> list[str]:
    """Names of the registered images, in the order of the file; points and cameras are not looked at.

    Raises:
        SourceError: the list of images is damaged.
    """
    binary, text = folder / "images.bin", folder / "images.txt"
    return [name for name, *_ in (_binary_images(binary) if binary.is_file() else _text_images(text))]


def write_model(model: ColmapModel, folder: Path, *, binary: bool = True) -> None:
    """Write the three files.

    Args:
        model: cameras, images and points; tracks follow from the images' observations.
        folder: made if need be.
        binary: False writes text.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tracks: list[list[tuple[int, int]]] = [[] for _ in range(len(model.points))]
    for number, image in enumerate(model.images, start=1):
        for index, point in enumerate(image.observed_point.tolist()):
            if point >= 0:
                tracks[point].append((number, index))
    if binary:
        _write_binary(model, tracks, folder)
    else:
        _write_text(model, tracks, folder)


_ImageRow = tuple[
    str, int, tuple[float, ...], tuple[float, ...], Float[np.ndarray, "m 2"], Int[np.ndarray, "m"]
]


def _pose(
    quaternion: tuple[float, ...], translation: tuple[float, ...], file: Path, frame: str
) -> Float[np.ndarray, "4 4"]:
    w, x, y, z = quaternion
    rotation = quaternion_rotation([x, y, z, w], file=file, frame=frame)
    if not np.isfinite(translation).all():
        raise PoseError(
            f"the translation is {list(translation)}; expected three finite numbers",
            file=file,
            frame=frame,
            field="translation",
        )
    return np.asarray(invert_poses(compose(rotation, np.array(translation))[None])[0])


def _positions(
    observed: Int[np.ndarray, "m"],
    identifiers: Int[np.ndarray, "p"],
    order: Int[np.ndarray, "p"],
    file: Path,
    frame: str,
) -> Int[np.ndarray, "m"]:
    """Identifiers of points to positions in the list of points."""
    result = np.full(observed.shape, _NO_POINT, dtype=np.int64)
    known = observed >= 0
    if not known.any():
        return result
    place = np.searchsorted(identifiers[order], observed[known])
    found = order[np.minimum(place, max(len(order) - 1, 0))] if len(order) else np.zeros(0, dtype=np.int64)
    if not len(order) or not np.array_equal(identifiers[found], observed[known]):
        raise SourceError(
            "observes a point that points3D does not hold; the three files are of different models",
            file=file,
            frame=frame,
            field="point3D_id",
        )
    result[known] = found
    return result


class _Stream:
    """Little-endian numbers of a file, one after the other; says where the file ends too early."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.bytes = file.read_bytes()
        self.at = 0

    def take(self, layout: str, what: str) -> tuple[Any, ...]:
        size = struct.calcsize("<" + layout)
        self._need(size, what)
        values = struct.unpack_from("<" + layout, self.bytes, self.at)
        self.at += size
        return values

    def count(self, what: str, smallest: int) -> int:
        """A number of records, each of at least so many bytes."""
        (value,) = self.take("Q", f"number of {what}")
        self._need(int(value) * smallest, what)
        return int(value)

    def records(self, kind: np.dtype, count: int, what: str) -> np.ndarray:
        self._need(kind.itemsize * count, what)
        found = np.frombuffer(self.bytes, kind, count, self.at)
        self.at += kind.itemsize * count
        return found

    def text(self, what: str) -> str:
        end = self.bytes.find(b"\0", self.at)
        if end < 0:
            raise self._truncated(what)
        found = self.bytes[self.at : end].decode("utf-8", errors="replace")
        self.at = end + 1
        return found

    def _need(self, size: int, what: str) -> None:
        if self.at + size > len(self.bytes):
            raise self._truncated(what)

    def _truncated(self, what: str) -> SourceError:
        return SourceError(
            f"the file ends inside {what}: {len(self.bytes)} bytes are not enough; "
            "it is truncated or not COLMAP's binary format",
            file=self.file,
        )


def _binary_cameras(file: Path) -> dict[int, Lens]:
    stream = _Stream(file)
    lenses = {}
    for _ in range(stream.count("cameras", 24)):
        number, model, width, height = (int(value) for value in stream.take("IiQQ", "a camera"))
        name = _MODEL_NAMES.get(model, f"number {model}")
        parameters = stream.take(f"{len(LENS_PARAMETERS.get(name, ()))}d", f"camera {number}")
        lenses[number] = _lens(name, parameters, width, height, file, number)
    return lenses


def _lens(name: str, parameters: tuple[float, ...], width: int, height: int, file: Path, number: int) -> Lens:
    if name == _PANORAMA:
        raise SourceError(
            f"the camera model {name} is a panorama, which shows what lies behind the camera too; expected "
            "images of one direction, as COLMAP's scripts for panoramas render them",
            file=file,
            frame=f"camera {number}",
            field="camera_model",
        )
    try:
        return Lens(name, parameters, width, height)
    except SourceError as error:
        raise SourceError(error.problem, file=file, frame=f"camera {number}", field=error.field) from error


_POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])


def _binary_images(file: Path) -> Iterator[_ImageRow]:
    stream = _Stream(file)
    for index in range(stream.count("images", 73)):
        values = stream.take("I7dI", f"image {index + 1}")
        name = stream.text(f"the name of image {index + 1}")
        observed = stream.records(
            _POINT2D, stream.count(f"observations of {name}", 24), f"observations of {name}"
        )
        yield (
            name,
            int(values[8]),
            tuple(float(value) for value in values[1:5]),
            tuple(float(value) for value in values[5:8]),
            observed["xy"].astype(np.float64).reshape(-1, 2),
            observed["point"].astype(np.int64),
        )


def _binary_points(
    file: Path,
) -> tuple[Int[np.ndarray, "p"], Float[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    stream = _Stream(file)
    count = stream.count("points", 51)
    identifiers = np.zeros(count, dtype=np.int64)
    points, colors = np.zeros((count, 3)), np.zeros((count, 3), dtype=np.uint8)
    for index in range(count):
        values = stream.take("Q3d3BdQ", f"point {index + 1}")
        if values[0] > _LARGEST:
            raise SourceError(f"point {index + 1}: {values[0]} is no identifier", file=file)
        identifiers[index], points[index], colors[index] = values[0], values[1:4], values[4:7]
        stream.records(np.dtype("<u4"), 2 * int(values[8]), f"the track of point {index + 1}")
    return identifiers, points, colors


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    try:
        # Editors on Windows put a mark at the beginning.
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise SourceError(f"not a text file: {error}", file=file) from error
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.startswith("#"):
            yield number, line


def _text_cameras(file: Path) -> dict[int, Lens]:
    lenses = {}
    for number, line in _lines(file):
        words = line.split()
        if not words:
            continue
        try:
            camera, width, height = int(words[0]), int(words[2]), int(words[3])
            parameters = tuple(float(word) for word in words[4:])
        except (ValueError, IndexError) as error:
            raise SourceError(
                f"line {number}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS, found {line[:80]!r}",
                file=file,
            ) from error
        lenses[camera] = _lens(words[1], parameters, width, height, file, camera)
    return lenses


def _text_images(file: Path) -> Iterator[_ImageRow]:
    lines = _lines(file)
    for number, line in lines:
        # Two lines an image, of which the second may be empty. COLMAP passes over those before the first.
        if not line.strip():
            continue
        words = line.split(maxsplit=9)
        try:
            values = [float(word) for word in words[1:8]]
            camera, name = int(words[8]), words[9].strip()
        except (ValueError, IndexError) as error:
            raise SourceError(
                f"line {number}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, found {line[:80]!r}; "
                "each image has two lines, the second may be empty",
                file=file,
            ) from error
        second, rest = next(lines, (number, ""))
        try:
            numbers = np.array(rest.split(), dtype=np.float64).reshape(-1, 3)
        except ValueError as error:
            raise SourceError(
                f"line {second}: expected X Y POINT3D_ID for each keypoint", file=file, frame=name
            ) from error
        yield (
            name,
            camera,
            tuple(values[:4]),
            tuple(values[4:]),
            numbers[:, :2].copy(),
            numbers[:, 2].astype(np.int64),
        )


def _text_points(
    file: Path,
) -> tuple[Int[np.ndarray, "p"], Float[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    identifiers, points, colors = [], [], []
    for number, line in _lines(file):
        words = line.split(maxsplit=8)
        if not words:
            continue
        try:
            identifiers.append(int(words[0]))
            points.append([float(word) for word in words[1:4]])
            colors.append([int(word) for word in words[4:7]])
            if len(points[-1]) != 3 or len(colors[-1]) != 3:
                raise ValueError(line)
            if not (0 <= identifiers[-1] <= _LARGEST and all(0 <= value <= 255 for value in colors[-1])):
                raise ValueError(line)
        except ValueError as error:
            raise SourceError(
                f"line {number}: expected POINT3D_ID X Y Z R G B ERROR TRACK, found {line[:80]!r}", file=file
            ) from error
    return (
        np.array(identifiers, dtype=np.int64),
        np.array(points, dtype=np.float64).reshape(-1, 3),
        np.array(colors, dtype=np.uint8).reshape(-1, 3),
    )


def _quaternion_and_translation(
    pose: Float[np.ndarray, "4 4"],
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    from scipy.spatial.transform import Rotation

    inverse = invert_poses(pose[None])[0]
    x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat(canonical=True)
    return (float(w), float(x), float(y), float(z)), tuple(float(value) for value in inverse[:3, 3])


def _write_binary(model: ColmapModel, tracks: list[list[tuple[int, int]]], folder: Path) -> None:
    with (folder / "cameras.bin").open("wb") as stream:
        stream.write(struct.pack("<Q", len(model.lenses)))
        for number, lens in model.lenses.items():
            stream.write(struct.pack("<IiQQ", number, _MODEL_IDS[lens.model], lens.width, lens.height))
            stream.write(struct.pack(f"<{len(lens.parameters)}d", *lens.parameters))
    with (folder / "images.bin").open("wb") as stream:
        stream.write(struct.pack("<Q", len(model.images)))
        for number, image in enumerate(model.images, start=1):
            quaternion, translation = _quaternion_and_translation(image.world_from_camera)
            stream.write(struct.pack("<I7dI", number, *quaternion, *translation, image.camera))
            stream.write(image.name.encode() + b"\0")
            rows = np.zeros(len(image.observed_point), dtype=_POINT2D)
            rows["xy"] = image.observed_px
            rows["point"] = np.where(image.observed_point >= 0, image.observed_point + 1, _NO_POINT)
            stream.write(struct.pack("<Q", len(rows)) + rows.tobytes())
    with (folder / "points3D.bin").open("wb") as stream:
        stream.write(struct.pack("<Q", len(model.points)))
        for index, track in enumerate(tracks):
            xyz = (float(value) for value in model.points[index])
            rgb = (int(value) for value in model.points_rgb[index])
            stream.write(struct.pack("<Q3d3BdQ", index + 1, *xyz, *rgb, -1.0, len(track)))
            stream.write(np.array(track, dtype="<u4").tobytes())


def _write_text(model: ColmapModel, tracks: list[list[tuple[int, int]]], folder: Path) -> None:
    def joined(*values: float | int | str) -> str:
        return " ".join(value if isinstance(value, str) else repr(value) for value in values)

    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for number, lens in model.lenses.items():
        lines.append(joined(number, lens.model, lens.width, lens.height, *map(float, lens.parameters)))
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")

    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for number, image in enumerate(model.images, start=1):
        quaternion, translation = _quaternion_and_translation(image.world_from_camera)
        lines.append(joined(number, *quaternion, *translation, image.camera, image.name))
        lines.append(
            joined(
                *(
                    value
                    for (u, v), point in zip(
                        image.observed_px.tolist(), image.observed_point.tolist(), strict=True
                    )
                    for value in (u, v, point + 1 if point >= 0 else _NO_POINT)
                )
            )
        )
    (folder / "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")

    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for index, track in enumerate(tracks):
        xyz, rgb = model.points[index].tolist(), model.points_rgb[index].tolist()
        lines.append(joined(index + 1, *xyz, *rgb, -1.0, *(value for pair in track for value in pair)))
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
