"""Reader of trajectories in the layout of the TUM RGB-D benchmark, which simulators and SLAM programs export.

::

    my_sequence/
        rgb.txt                 timestamp and file of each colour image, one to a line
        depth.txt               the same of depth images; optional beside groundtruth.txt
        groundtruth.txt         timestamp, tx ty tz, qx qy qz qw; optional beside depth.txt
        intrinsics.json         of a pinhole, as beside plain frames; or `ingest.calibration`
        mask.png                optional: white is tissue

Timestamps are seconds; lines that begin with `#` are remarks. Poses are those of the colour camera in
OpenCV's axes, camera to world, in metres; depth is z-depth in PNG files of 16 bits and the colour camera's
pixels, 5000 to a metre, 0 where unknown. Lengths become millimetres.

A frame gets the pose and the depth nearest in time, at most 0.02 s away, each of which belongs to one frame
at most, the nearest pairs first; of poses and depth at more than 100 Hz only the two before and the two after
the frame. Frames that lack one of them, as before the tracker began, are left out with a warning, and so are
images that are listed and absent; where these are more than `ingest.max_absent_share`, the source is refused.
Frames are in the order of time. Trajectories of SLAM with a single camera, whose unit is arbitrary, are taken
for metres; where no depth is there to contradict it, the log says so.

Source: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012, and "File formats"
and `associate.py` of its web page.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from data_catalog.folder_reader import FolderReader
from data_catalog.images import image_size, read_depth
from data_catalog.inside import inside
from data_catalog.posed_frames import PosedFrame, SourceFrames
from data_catalog.readers.beside_frames import tell_about_folders
from data_catalog.readers.frame_list import present_frames
from data_catalog.readers.frames_folder import (
    INTRINSICS_FILE,
    MASK_FILE,
    mask_beside,
    read_intrinsics,
    stated_intrinsics,
    states_angle_alone,
)
from data_catalog.rotations import quaternion_rotation
from extrags.cameras import compose
from extrags.config import IngestConfig
from extrags.errors import PoseError, SourceError, SourceNotFoundError
from extrags.lens import Lens

__all__ = ["READER"]

logger = logging.getLogger(__name__)

_COLOUR, _DEPTH, _POSES = "rgb.txt", "depth.txt", "groundtruth.txt"
_DEPTH_SUFFIX = ".png"
_FARTHEST_S = 0.02
_DEPTH_PER_MM = 5.0
_MM_PER_M = 1000.0
_POSE_NUMBERS = 8
_NEIGHBOURS = 2
_NAMED = 3


@dataclass(frozen=True)
class _Listed:
    """A file and its time, as a line of a list has them."""

    time_s: float
    name: str
    file: Path


def _recognises(folder: Path) -> bool:
    return (folder / _COLOUR).is_file() and any((folder / name).is_file() for name in (_DEPTH, _POSES))


def _files(folder: Path) -> list[Path]:
    lists = [folder / name for name in (_COLOUR, _DEPTH, _POSES, INTRINSICS_FILE, MASK_FILE)]
    listed = [item.file for name in (_COLOUR, _DEPTH) for item in _list(folder, name)]
    return sorted({file for file in (*lists, *listed) if file.is_file()})


def _frames(folder: Path, config: IngestConfig) -> SourceFrames:
    colours, depths = _list(folder, _COLOUR), _list(folder, _DEPTH)
    times_s, poses = _trajectory(folder)
    present = present_frames(
        {item.name: item.file for item in colours}, config.max_absent_share, listing=folder / _COLOUR
    )
    colours = [item for item in colours if item.name in present]
    here = [item for item in depths if item.file.is_file()]
    _tell_of_absent(depths, here, folder / _DEPTH)
    at_s = [item.time_s for item in colours]
    pose_of, depth_of = _nearest(at_s, times_s), _nearest(at_s, [item.time_s for item in here])
    for name, found in ((_POSES, pose_of if len(poses) else None), (_DEPTH, depth_of if depths else None)):
        if found is not None:
            colours = _with_partner(colours, found, folder / name, config.max_absent_share)
    width, height = image_size(colours[0].file, frame=colours[0].name)
    if len(poses) and config.calibration is None and not (folder / INTRINSICS_FILE).is_file():
        raise SourceNotFoundError(
            "no such file; expected the intrinsics of the frames whose poses are given, as K in pixels, or a "
            "calibration file (ingest.calibration)",
            file=folder / INTRINSICS_FILE,
            field="K",
        )
    K = read_intrinsics(
        folder, width, height, is_used=config.calibration is None, images=colours[0].file.parent
    )
    lens, mask_file = Lens.pinhole(K, width, height), mask_beside(folder)
    if len(poses) and not depths:
        logger.warning(
            "%s: lengths are taken for metres, and there is no depth that would contradict it. A trajectory "
            'of a single camera has no unit: give it as poses.json with "length_unit": "arbitrary"',
            folder / _POSES,
        )
    if mask_file is None:
        tell_about_folders(folder, "mask", f"one {MASK_FILE} holds for all frames")
    return SourceFrames(
        frames=[
            PosedFrame(
                name=item.name,
                file=item.file,
                lens=lens,
                world_from_camera=poses[pose_of[item.time_s]] if len(poses) else None,
                depth_file=here[depth_of[item.time_s]].file if depths else None,
                mask_file=mask_file,
            )
            for item in colours
        ],
        pose_file=folder / (_POSES if len(poses) else _COLOUR),
        metric=True,
        read_depth=_depth_mm,
        intrinsics=stated_intrinsics(folder, config),
        angle_alone=states_angle_alone(folder, config),
    )


READER = FolderReader(
    name="tum",
    version=3,
    summary=f"{_COLOUR} with {_POSES} or {_DEPTH} of TUM's RGB-D layout, described in "
    "data_catalog/readers/tum.py",
    recognises=_recognises,
    files=_files,
    frames=_frames,
    conventions="OpenCV camera axes, camera to world, m; depth 5000 to a metre; mm on reading",
    depth_unit="in this layout a level of a depth file is 1/5000 m",
)


def _rows(file: Path) -> list[tuple[int, list[str]]]:
    """Lines with their numbers, less remarks, cut at blanks, tabs and commas.

    Raises:
        SourceError: no text, or nothing in it.
    """
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise SourceError(f"cannot be read as text: {error}", file=file) from error
    rows = [(number, line.replace(",", " ").split()) for number, line in enumerate(lines, start=1)]
    found = [(number, row) for number, row in rows if row and not row[0].startswith("#")]
    if not found:
        raise SourceError("the list is empty", file=file, field="frames")
    return found


def _list(folder: Path, name: str) -> list[_Listed]:
    """Files by time, in the order of time; none where there is no such list.

    Raises:
        SourceError: a line is none, or a time or a file stands there twice.
    """
    file = folder / name
    if not file.is_file():
        return []
    found = []
    for number, row in _rows(file):
        if len(row) != 2:
            raise SourceError(
                f"found {len(row)} entries; expected a timestamp and a file",
                file=file,
                frame=f"line {number}",
            )
        place = inside(folder, row[1], file=file, frame=f"line {number}", field="file")
        relative = place.relative_to(folder).as_posix()
        found.append(_Listed(_number(row[0], file, number), relative, place))
    for what in ("time_s", "name"):
        seen: set[object] = set()
        for item in found:
            if getattr(item, what) in seen:
                problem = (
                    "the time of another frame, too" if what == "time_s" else "the frame is listed twice"
                )
                raise SourceError(problem, file=file, frame=item.name, field="timestamp")
            seen.add(getattr(item, what))
    if name == _DEPTH:
        for item in found:
            if item.file.suffix.lower() != _DEPTH_SUFFIX:
                raise SourceError(
                    "depth of this format is not read; expected PNG files of 16 bits, 5000 to a metre",
                    file=file,
                    frame=item.name,
                    field="depth",
                )
    return sorted(found, key=lambda item: item.time_s)


def _trajectory(folder: Path) -> tuple[list[float], Float[np.ndarray, "p 4 4"]]:
    """Times and poses, OpenCV axes, camera to world, in millimetres; none without the file.

    Raises:
        PoseError: a line is no pose.
        SourceError: two poses of one time, or no text.
    """
    file = folder / _POSES
    if not file.is_file():
        return [], np.zeros((0, 4, 4))
    times_s: dict[float, int] = {}
    poses = []
    for number, row in _rows(file):
        if len(row) != _POSE_NUMBERS:
            raise PoseError(
                f"found {len(row)} numbers; expected {_POSE_NUMBERS}: timestamp tx ty tz qx qy qz qw",
                file=file,
                frame=f"line {number}",
                field="world_from_camera",
            )
        time_s, *values = (_number(text, file, number) for text in row)
        if time_s in times_s:
            raise SourceError(
                f"the time of line {times_s[time_s]}, too",
                file=file,
                frame=f"line {number}",
                field="timestamp",
            )
        times_s[time_s] = number
        rotation = quaternion_rotation(values[3:], file=file, frame=f"line {number}")
        poses.append(compose(rotation, np.array(values[:3]) * _MM_PER_M))
    return list(times_s), np.stack(poses)


def _number(text: str, file: Path, line: int) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise SourceError(f"found {text[:40]!r}; expected a number", file=file, frame=f"line {line}")
    return value


def _nearest(times_s: Sequence[float], others_s: Sequence[float]) -> dict[float, int]:
    """Of each time the index of another near it, where there is one; each belongs to one time at most."""
    order = np.argsort(others_s, kind="stable")
    ordered = np.asarray(others_s, dtype=np.float64)[order]
    candidates = []
    for time_s in times_s:
        place = int(np.searchsorted(ordered, time_s))
        for k in range(max(0, place - _NEIGHBOURS), min(len(ordered), place + _NEIGHBOURS)):
            apart = abs(float(ordered[k]) - time_s)
            if apart <= _FARTHEST_S:
                candidates.append((apart, time_s, int(order[k])))
    found: dict[float, int] = {}
    taken: set[int] = set()
    for _, time_s, index in sorted(candidates):
        if time_s not in found and index not in taken:
            found[time_s] = index
            taken.add(index)
    return found


def _tell_of_absent(listed: list[_Listed], here: list[_Listed], listing: Path) -> None:
    """Warn of listed files that are not there.

    Raises:
        SourceNotFoundError: none is.
    """
    present = {item.name for item in here}
    absent = [item for item in listed if item.name not in present]
    if listed and not here:
        raise SourceNotFoundError(
            f"no such file, as all {len(listed)} that {listing.name} lists",
            file=absent[0].file,
            field="depth",
        )
    if absent:
        more = f" and {len(absent) - _NAMED} more" if len(absent) > _NAMED else ""
        names = ", ".join(item.name for item in absent[:_NAMED])
        logger.warning(
            "%s: %d of %d listed files are not there: %s%s", listing, len(absent), len(listed), names, more
        )


def _with_partner(
    colours: list[_Listed], partners: dict[float, int], listing: Path, max_absent_share: float
) -> list[_Listed]:
    """The frames that have one; of the others a warning tells.

    Raises:
        SourceError: too many have none, or all.
    """
    lacking = [item.name for item in colours if item.time_s not in partners]
    if not lacking:
        return colours
    problem = f"nothing within {_FARTHEST_S:g} s of {len(lacking)} of {len(colours)} frames in {_COLOUR}"
    if len(lacking) == len(colours) or len(lacking) > max_absent_share * len(colours):
        raise SourceError(
            f"{problem}, this one first; at most {max_absent_share:.0%} may lack it "
            "(ingest.max_absent_share). Expected timestamps in seconds, of one clock",
            file=listing,
            frame=lacking[0],
            field="timestamp",
        )
    more = f" and {len(lacking) - _NAMED} more" if len(lacking) > _NAMED else ""
    logger.warning("%s: %s; left out: %s%s", listing, problem, ", ".join(lacking[:_NAMED]), more)
    return [item for item in colours if item.time_s in partners]


def _depth_mm(file: Path, frame: str | int) -> Float[np.ndarray, "h w"]:
    return np.asarray(read_depth(file, frame=frame) / _DEPTH_PER_MM, dtype=np.float32)
