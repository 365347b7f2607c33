"""Reader and writer of COLMAP workspaces: a sparse model with its images.

::

    my_scene/
        sparse/0/{cameras,images,points3D}.bin      or .txt; also sparse/, colmap/sparse/0/, beside images/;
                                                    of dense/sparse/, all that follows lies in dense/
        images/NAME                                 as named in the model; also rgb/, or the folder itself
        masks/NAME.png                              optional: COLMAP's camera masks, white is tissue; also
                                                    without NAME's suffix, and with that of any image
        stereo/depth_maps/NAME.geometric.bin        optional: COLMAP's depth maps, z-depth in the model's unit
        train_list.txt, test_list.txt               optional: frames by name, one to a line; those in neither
                                                    of two lists are left out
        length_unit.txt                             optional: `mm`; otherwise the scale is arbitrary

COLMAP's poses are camera-from-world in OpenCV axes with pixel centres at +0.5; they are inverted once on
reading and nothing else is turned or scaled. Every model of `extrags.lens` is understood; images of
distorted cameras are resampled to a pinhole, those of pinhole cameras are taken as they are. Of several
models (`sparse/0`, `sparse/1`, ...) the one with the most images is read. The sparse points become the
starting points; those that are not finite are left out, with a warning. Images that the model does not name
have no pose and are left out, which the log says; so it does of frames without a mask where others have one.
Frames without a mask are tissue throughout.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8

from data_catalog.calibration_files import LENS_OF_POSES
from data_catalog.folder_reader import FolderReader
from data_catalog.images import save_images
from data_catalog.inside import inside, with_slashes
from data_catalog.pose_conventions import PoseConvention
from data_catalog.posed_frames import PosedFrame, SourceFrames
from data_catalog.readers.beside_frames import tell_about_folders
from data_catalog.readers.colmap_files import (
    ColmapImage,
    ColmapModel,
    read_image_names,
    read_model,
    write_model,
)
from data_catalog.readers.frame_list import FilesBeside, listed_split, present_frames, warn_of_unmasked
from data_catalog.readers.sparse_points import finite_points
from extrags.cameras import pixel_rays
from extrags.config import IngestConfig
from extrags.errors import SourceError, SourceNotFoundError
from extrags.frame_names import (
    COLOR_SUFFIXES,
    NameOrder,
    natural_key,
    order_for_fingerprint,
    tell_about_order,
)
from extrags.lens import Lens
from extrags.sequence import EndoscopicSequence
from extrags.unusable_frames import of_split

__all__ = ["READER", "model_folder", "points_of", "read_depth_map", "write_colmap", "write_depth_map"]

logger = logging.getLogger(__name__)

LENGTH_UNIT_FILE = "length_unit.txt"
_PLACES = ("sparse", "colmap/sparse", "colmap", "dense/sparse", ".")
_DEPTH_KINDS = ("geometric", "photometric")
_FOLDERS_ABOVE = 3
"""Of a model at most: colmap/sparse/0."""
_NO_OBSERVATIONS = np.zeros((0, 2)), np.zeros(0, dtype=np.int64)


def model_folder(folder: Path) -> Path | None:
    """The model to read: the one with the most images among those in the usual places; None without any."""
    found = []
    for place in _PLACES:
        base = folder / place
        if not base.is_dir():
            continue
        inside = [sub for sub in base.iterdir() if sub.is_dir() and sub.name.isdigit()]
        candidates = [base, *sorted(inside, key=lambda sub: int(sub.name))]
        found += [place for place in candidates if _is_model(place)]
        if found:
            break
    # Ties go to the first, which is the lowest number.
    return max(found, key=_image_count, default=None)


def _is_model(folder: Path) -> bool:
    return any(
        (folder / f"cameras.{suffix}").is_file() and (folder / f"images.{suffix}").is_file()
        for suffix in ("bin", "txt")
    )


def _image_count(folder: Path) -> int:
    file = folder / "images.bin"
    if file.is_file():
        with file.open("rb") as stream:
            return int.from_bytes(stream.read(8), "little")
    lines = (folder / "images.txt").read_text(encoding="utf-8-sig", errors="replace").splitlines()
    return sum(not line.startswith("#") for line in lines) // 2


def _recognises(folder: Path) -> bool:
    return folder.is_dir() and model_folder(folder) is not None


def _workspace(folder: Path, model: Path) -> Path:
    """Where images, masks, depth and lists of a model lie: those of undistorted cameras are in dense/."""
    dense = folder / "dense"
    return dense if model.is_relative_to(dense) else folder


def _image_root(folder: Path, names: list[str]) -> Path:
    places = [folder / "images", folder / "rgb", folder]
    existing = [place for place in places if place.is_dir()]
    return max(existing, key=lambda place: sum(_lies_in(place, name) for name in names[:20]))


def _lies_in(place: Path, name: str) -> bool:
    # An absolute name is the same file whatever folder it is looked for in.
    root = os.path.abspath(place)
    file = os.path.normpath(os.path.join(root, with_slashes(place, name, file=place)))
    return file.startswith(os.path.join(root, "")) and os.path.isfile(file)


@dataclass(frozen=True)
class _ImageFiles:
    """What lies on disk for an image of the model.

    Args:
        name: its path below the folder of the images.
        color: the image, which may be absent.
        mask: None where there is none.
        depth: None where there is none.
    """

    name: str
    color: Path
    mask: Path | None
    depth: Path | None


def _located(folder: Path, names: list[str], pose_file: Path) -> tuple[Path, dict[str, _ImageFiles]]:
    """The folder of the images, and the files of each, by its name in the model.

    Raises:
        SourceError: a name leads out of the folder, or two mean one file.
    """
    for name in names:
        inside(folder, name, file=pose_file, frame=name, field="name")
    root = _image_root(folder, names)
    masks = FilesBeside(folder / "masks")
    found: dict[str, _ImageFiles] = {}
    seen: set[Path] = set()
    for name in names:
        color = inside(root, name, file=pose_file, frame=name, field="name")
        if color in seen:
            raise SourceError("the image is listed twice", file=pose_file, frame=name, field="name")
        seen.add(color)
        # Joined to another folder, an absolute name would lead back to the image itself.
        below = color.relative_to(root)
        found[name] = _ImageFiles(
            name=below.as_posix(),
            color=color,
            mask=masks.find(dict.fromkeys((below, below.parent / below.stem)), COLOR_SUFFIXES),
            depth=_depth_file(folder, below.as_posix()),
        )
    return root, found


def _check_images_are_not_above(folder: Path, files: Mapping[str, Path]) -> None:
    """Refuse the folder of a model by itself, such as sparse/0, where a folder above it has the images.

    Raises:
        SourceNotFoundError: names the folder to give.
    """
    if any(file.is_file() for file in files.values()):
        return
    for above in list(folder.absolute().parents)[:_FOLDERS_ABOVE]:
        model = model_folder(above) if os.access(above, os.R_OK | os.X_OK) else None
        if model is None:
            continue
        root = _image_root(_workspace(above, model), list(files))
        if any(_lies_in(root, name) for name in files):
            raise SourceNotFoundError(
                f"this is the model alone, without its {len(files)} images; give the folder {above}, which "
                "holds them",
                file=folder,
            )


def _pose_file(model: Path) -> Path:
    return next(file for file in (model / "images.bin", model / "images.txt") if file.is_file())


def _files(folder: Path) -> list[Path]:
    model = model_folder(folder)
    if model is None:
        return []
    folder = _workspace(folder, model)
    fixed = [folder / name for name in (LENGTH_UNIT_FILE, "train_list.txt", "test_list.txt")]
    fixed += [
        model / f"{name}.{suffix}" for name in ("cameras", "images", "points3D") for suffix in ("bin", "txt")
    ]
    _, located = _located(folder, read_image_names(model), _pose_file(model))
    of_images = [(item.color, item.mask, item.depth) for item in located.values() if item.color.is_file()]
    listed = [*fixed, *(file for files in of_images for file in files if file is not None)]
    return sorted({file for file in listed if file.is_file()})


def _chosen(folder: Path) -> dict[str, Any]:
    model = model_folder(folder)
    return {} if model is None else order_for_fingerprint(read_image_names(model))


def _frames(folder: Path, config: IngestConfig) -> SourceFrames:
    place = model_folder(folder)
    if place is None:
        raise SourceNotFoundError("no COLMAP model in this folder", file=folder)
    folder = _workspace(folder, place)
    model, pose_file = read_model(place), _pose_file(place)
    order = NameOrder(image.name for image in model.images)
    listed = sorted(model.images, key=lambda image: order.key(image.name))
    tell_about_order(folder, order)
    root, located = _located(folder, [image.name for image in listed], pose_file)
    _tell_about_unposed(root, {item.name for item in located.values()})
    files = {name: item.color for name, item in located.items()}
    _check_images_are_not_above(folder, files)
    present = present_frames(files, config.max_absent_share, listing=pose_file)
    splits = _splits(folder, listed)
    images = [image for image in listed if image.name in present and (not splits or image.name in splits)]
    used = [located[image.name] for image in images]
    _tell_what_is_lacking(folder, used)
    folders = [str(Path(item.name).parent) for item in used]
    recordings = sorted(set(folders), key=natural_key)
    frames = [
        PosedFrame(
            name=item.name,
            file=item.color,
            lens=model.lenses[image.camera],
            world_from_camera=image.world_from_camera,
            mask_file=item.mask,
            depth_file=item.depth,
            recording=recordings.index(parent),
            split=splits.get(image.name),
        )
        for image, item, parent in zip(images, used, folders, strict=True)
    ]
    points, points_rgb = finite_points(model.points, model.points_rgb, pose_file.with_stem("points3D"))
    return SourceFrames(
        frames,
        pose_file=pose_file,
        metric=_is_metric(folder),
        intrinsics_file=pose_file.with_stem("cameras"),
        lens_stays=LENS_OF_POSES,
        read_depth=lambda file, frame: read_depth_map(file, frame=frame),
        points=points,
        points_rgb=points_rgb,
    )


READER = FolderReader(
    name="colmap",
    version=9,
    summary="a COLMAP model in sparse/0/ with images/, described in data_catalog/readers/colmap_model.py",
    recognises=_recognises,
    files=_files,
    frames=_frames,
    conventions="COLMAP poses (camera from world, OpenCV axes, inverted on reading), pixel "
    "centres at +0.5; arbitrary unit unless length_unit.txt says mm",
    chosen=_chosen,
    poses=PoseConvention(world_to_camera=True),
)


def write_colmap(
    sequence: EndoscopicSequence,
    folder: Path,
    *,
    binary: bool = True,
    points: Float[np.ndarray, "p 3"] | None = None,
    points_rgb: UInt8[np.ndarray, "p 3"] | None = None,
) -> None:
    """Write a posed sequence as the workspace described above.

    Cameras become PINHOLE, one for each K. Numbers keep all their digits, so that a model that is read back
    differs by rounding only. Depth goes to `stereo/depth_maps`. Frames of neither part of the split, which
    other programs would train on, are not written.

    Args:
        sequence: with poses.
        folder: made if need be; `sparse/0`, `images`, `masks` and `stereo/depth_maps` are written into it.
        binary: False writes a text model.
        points: sparse points in world coordinates; None takes the sequence's own.
        points_rgb: their colours; grey where None.

    Raises:
        ShapeError: while the sequence has no poses.
        SourceError: a frame's name has a line break, or leads out of the folder.
    """
    sequence = of_split(sequence)
    cameras = sequence.cameras
    for index in range(len(sequence)):
        if any(letter in sequence.frame_name(index) for letter in "\r\n"):
            raise SourceError(
                f"{sequence.frame_name(index)!r} has a line break, and a workspace lists names line by line; "
                "rename the frame",
                file=folder,
                frame=index,
                field="name",
            )
    if points is None:
        points, points_rgb = sequence.points, sequence.points_rgb
    names = save_images(sequence, folder)
    distinct, group = np.unique(cameras.K[:, [0, 1, 0, 1], [0, 1, 2, 2]], axis=0, return_inverse=True)
    lenses = {
        number: Lens("PINHOLE", tuple(float(value) for value in row), sequence.width, sequence.height)
        if sequence.lens is None
        else Lens.fisheye(cameras.K[group == number - 1][0], sequence.lens, sequence.width, sequence.height)
        for number, row in enumerate(distinct, start=1)
    }
    located = np.zeros((0, 3)) if points is None else np.asarray(points, dtype=np.float64)
    colored = np.full((len(located), 3), 128, dtype=np.uint8) if points_rgb is None else points_rgb
    pixels, seen = _NO_OBSERVATIONS
    model = ColmapModel(
        lenses,
        [
            ColmapImage(image, int(group[index]) + 1, cameras.world_from_camera[index], pixels, seen)
            for index, image in enumerate(names)
        ],
        located,
        colored,
    )
    write_model(model, folder / "sparse" / "0", binary=binary)
    for index, image in enumerate(names):
        if sequence.depth_mm is not None:
            write_depth_map(
                folder / "stereo" / "depth_maps" / f"{image}.geometric.bin", sequence.depth_mm[index]
            )
    for split, indices in (("train", sequence.train), ("test", sequence.test)):
        listed = "".join(f"{names[int(index)]}\n" for index in indices)
        (folder / f"{split}_list.txt").write_text(listed, encoding="utf-8")
    if sequence.metric:
        (folder / LENGTH_UNIT_FILE).write_text("mm\n", encoding="utf-8")


def points_of(
    sequence: EndoscopicSequence, at_most: int = 20_000
) -> tuple[Float[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]] | None:
    """Points to hand over with a sequence: its own, else its training frames' depth on a grid.

    Args:
        sequence: with poses.
        at_most: number of points taken from depth.

    Returns:
        Positions in world coordinates and colours, or None where the source has neither.
    """
    if sequence.points is not None:
        grey = np.full(sequence.points.shape, 128, dtype=np.uint8)
        return sequence.points, grey if sequence.points_rgb is None else sequence.points_rgb
    if sequence.depth_mm is None:
        return None
    cameras = sequence.cameras
    pixels = len(sequence.train) * sequence.height * sequence.width
    stride = max(1, int(np.ceil(np.sqrt(pixels / at_most))))
    grid = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    located, colored = [], []
    for index in sequence.train.tolist():
        depth = sequence.depth_mm[index][grid]
        known = (depth > 0) & sequence.mask[index][grid]
        rays = pixel_rays(cameras[index])[0][grid][known]
        located.append(cameras.centers[index] + rays * depth[known][:, None].astype(np.float64))
        colored.append(sequence.rgb[index][grid][known])
    return np.concatenate(located), np.concatenate(colored)


def read_depth_map(file: Path, *, frame: object = None) -> Float[np.ndarray, "h w"]:
    """Read COLMAP's dense map: `width&height&channels&`, then float32 row by row.

    Raises:
        SourceError: the header is none, or values are missing.
    """
    content = file.read_bytes()
    parts = content[:64].split(b"&", 3)
    try:
        width, height, channels = (int(part) for part in parts[:3])
    except ValueError as error:
        raise SourceError(
            "expected a header `width&height&1&`, as COLMAP writes it", file=file, frame=frame, field="depth"
        ) from error
    start = sum(len(part) + 1 for part in parts[:3])
    if channels != 1 or len(content) - start != 4 * width * height:
        raise SourceError(
            f"{len(content) - start} bytes of values; expected {4 * width * height} for {width} x {height} "
            f"pixels of one channel (found {channels})",
            file=file,
            frame=frame,
            field="depth",
        )
    return np.frombuffer(content, "<f4", width * height, start).reshape(height, width).astype(np.float32)


def write_depth_map(file: Path, depth: Float[np.ndarray, "h w"]) -> None:
    """Write what `read_depth_map` reads."""
    file.parent.mkdir(parents=True, exist_ok=True)
    header = f"{depth.shape[1]}&{depth.shape[0]}&1&".encode()
    file.write_bytes(header + np.ascontiguousarray(depth, dtype="<f4").tobytes())


def _depth_file(folder: Path, name: str) -> Path | None:
    places = (folder / "stereo" / "depth_maps" / f"{name}.{kind}.bin" for kind in _DEPTH_KINDS)
    return next((file for file in places if file.is_file()), None)


def _is_metric(folder: Path) -> bool:
    file = folder / LENGTH_UNIT_FILE
    if not file.is_file():
        return False
    # Editors on Windows put a mark at the beginning.
    unit = file.read_text(encoding="utf-8-sig", errors="replace").strip()
    if unit not in ("mm", "arbitrary"):
        raise SourceError(
            f"{unit!r} is no length unit known here; expected mm or arbitrary", file=file, field="length_unit"
        )
    return unit == "mm"


def _splits(folder: Path, images: list[ColmapImage]) -> dict[str, Literal["train", "test"]]:
    known = {image.name for image in images}
    file = folder / "test_list.txt"
    training, held_out = _listed(folder / "train_list.txt", known), _listed(file, known)
    unknown = sorted((held_out or set()) - known, key=natural_key)
    if unknown:
        raise SourceError(
            f"{len(unknown)} of {len(held_out or ())} held-out images have no pose in the model; take them "
            "out of the list or register them",
            file=file,
            frame=unknown[0],
            field="split",
        )
    # The list may name more than the model holds.
    return listed_split(known, training & known if training else None, held_out, file=file)


def _listed(file: Path, known: set[str]) -> set[str] | None:
    """Names in a list, one to a line; None where there is no such file.

    Args:
        file: with or without the mark that editors on Windows put at the beginning.
        known: names in the model. Blanks about a name are left out, unless it has them there, and the
            separators of Windows are those of this system.
    """
    if not file.is_file():
        return None
    try:
        lines = file.read_text(encoding="utf-8-sig").split("\n")
    except UnicodeDecodeError as error:
        raise SourceError(f"not a text file: {error}", file=file, field="split") from error
    by_slashes = {name.replace("\\", "/"): name for name in known}

    def named(line: str) -> str:
        for spelled in (line, line.strip()):
            if spelled in known:
                return spelled
        return by_slashes.get(line.strip().replace("\\", "/"), line.strip())

    return {named(line) for line in lines} - {""}


def _tell_about_unposed(root: Path, posed: set[str]) -> None:
    present = {
        file.relative_to(root).as_posix()
        for file in root.rglob("*")
        if file.suffix.lower() in COLOR_SUFFIXES and file.is_file()
    }
    unposed = sorted(present - posed, key=natural_key)
    if unposed and root.name in ("images", "rgb"):
        logger.warning(
            "%d of %d images have no pose in the COLMAP model and are left out; the first is %s",
            len(unposed),
            len(present),
            unposed[0],
        )


def _tell_what_is_lacking(folder: Path, frames: list[_ImageFiles]) -> None:
    if (folder / "masks").is_dir():
        warn_of_unmasked(folder / "masks", {item.name: item.mask for item in frames})
    else:
        tell_about_folders(folder, "mask", "masks are looked for in masks/")
    if all(item.depth is None for item in frames):
        tell_about_folders(folder, "depth", "depth is looked for in stereo/depth_maps/")
