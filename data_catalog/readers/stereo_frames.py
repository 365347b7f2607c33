"""Plain frames of both cameras of a stereo endoscope: those of one are read.

They lie in one folder, with a word or a letter in their names for the camera, or in two folders that are
called so, or in pictures that hold both views (`data_catalog.stereo` says how they are told). Named pairs
whose pictures do not agree are refused, since they may be two recordings; a picture whose halves do not agree
is one view.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from data_catalog.images import image_entries, read_upright, spread, upright_size
from data_catalog.readers.beside_frames import is_of_another_kind, listed_files
from data_catalog.stereo import (
    AGREES,
    BothViews,
    agreeing_share,
    pairs_by_name,
    possible_views,
    tell_camera,
)
from extrags.errors import SourceError
from extrags.provenance import StereoCamera

__all__ = ["FramesOfCamera", "StereoFolders", "frames_of_camera", "stereo_folders", "views_in_pictures"]

logger = logging.getLogger(__name__)

_FEWEST_PAIRS = 2
_PAIRED_SHARE = 0.5
"""Of the pictures in a folder, so many have to be of a camera by their names."""
_CLEARLY_MORE = 2
_LOOKED_AT = 8


@dataclass(frozen=True)
class StereoFolders:
    """Two folders that are called after a left and a right camera."""

    left: Path
    right: Path

    def of(self, camera: StereoCamera) -> Path:
        """That of a camera."""
        return self.left if camera == "left" else self.right

    def __str__(self) -> str:
        return f"{self.left.name}/ and {self.right.name}/"


@dataclass(frozen=True)
class FramesOfCamera:
    """Frames to read.

    Args:
        place: that they were found in.
        files: of the camera.
        camera: whose they are, where there are pairs.
        all_files: these and those of the other camera.
        pairs: frames of both cameras, the left one first; none where there is one camera.
        left_out: frames of no camera.
    """

    place: Path | StereoFolders
    files: list[Path]
    camera: StereoCamera
    all_files: list[Path]
    pairs: list[tuple[Path, Path]] = field(default_factory=list)
    left_out: tuple[Path, ...] = ()

    def check_and_tell(self) -> None:
        """Look whether pairs show the same, and say whose frames are read.

        Raises:
            SourceError: they do not.
        """
        if not self.pairs:
            return
        folders = isinstance(self.place, StereoFolders)
        source = self.place.left.parent if isinstance(self.place, StereoFolders) else self.place
        share = agreeing_share(_pictures(self.pairs))
        if share < AGREES:
            raise SourceError(
                f"by their names pictures of both cameras of a stereo endoscope, as {self._pair_in_words()}, "
                f"but {share:.0%} of the pairs that were looked at show the same place, where those of a "
                "stereo endoscope do. Of two recordings, as of two sides, give each a folder of its own, and "
                "the path of the one to read",
                file=source,
                field="rgb",
            )
        told = f"told by the names of the {'folders' if folders else 'files'}"
        tell_camera(source, told, self.camera, f"{len(self.files)} as {listed_files(self.files[:1])}")
        if self.left_out:
            logger.warning(
                "%s: %d pictures are left out, by their names of neither camera (%s)",
                source,
                len(self.left_out),
                listed_files(self.left_out),
                extra={"topic": "not read", "field": "files"},
            )

    def _pair_in_words(self) -> str:
        first, second = self.pairs[0]
        if first.parent == second.parent:
            return f"{first.name} and {second.name}"
        return f"{first.parent.name}/{first.name} and {second.parent.name}/{second.name}"


def stereo_folders(place: Path) -> list[StereoFolders]:
    """Folders with pictures in a folder, two that are called after a left and a right camera each.

    Folders of depth, masks and the like are none.
    """
    folders = [
        at for at in sorted(place.iterdir()) if at.is_dir() and not is_of_another_kind(at.name) and _holds(at)
    ]
    found = pairs_by_name(folders)
    return [] if found is None else [StereoFolders(*pair) for pair in found.pairs]


def _holds(folder: Path) -> bool:
    try:
        return any(not is_of_another_kind(file.stem) for file in image_entries(folder))
    except PermissionError:
        # What may not be looked into is not meant.
        return False


def frames_of_camera(place: Path | StereoFolders, files: list[Path], camera: StereoCamera) -> FramesOfCamera:
    """The frames of one camera; all where nothing tells of two.

    Args:
        place: they were found in.
        files: all that were found.
        camera: whose to take.

    Raises:
        SourceError: their names give frames to both cameras, or a good part to none.
    """
    if isinstance(place, StereoFolders):
        chosen = [file for file in files if file.parent == place.of(camera)]
        return FramesOfCamera(place, chosen, camera, files, _by_number(place, files))
    found = pairs_by_name(files)
    paired = 0 if found is None else len(found.left) + len(found.right)
    if found is None or len(found.pairs) < _FEWEST_PAIRS or paired < _PAIRED_SHARE * len(files):
        return FramesOfCamera(place, files, camera, files)
    again = pairs_by_name(found.of(camera))
    unclear = found.contradictory or (None if again is None else again.pairs[0][0])
    if unclear is not None:
        raise SourceError(
            "its name may be that of a left and of a right camera; give the frames of each camera a folder "
            "of their own, and the path of the one to read",
            file=unclear,
            field="rgb",
        )
    chosen = list(found.of(camera))
    if _CLEARLY_MORE * len(found.others) > len(chosen):
        raise SourceError(
            f"{len(found.left)} pictures of a left camera by their names, {len(found.right)} of a right one, "
            f"and {len(found.others)} of neither ({listed_files(found.others)}); move away what is not to be "
            "read",
            file=place,
            field="rgb",
        )
    of_both = [file for file in files if file not in set(found.others)]
    return FramesOfCamera(place, chosen, camera, of_both, list(found.pairs), found.others)


def _by_number(place: StereoFolders, files: list[Path]) -> list[tuple[Path, Path]]:
    """Frames of two folders with the same numbers in their names, else in their order."""
    left, right = ([file for file in files if file.parent == at] for at in (place.left, place.right))
    numbered = {_numbers(file): file for file in right}
    pairs = [(file, numbered[_numbers(file)]) for file in left if _numbers(file) in numbered]
    return pairs if len(pairs) >= _FEWEST_PAIRS else list(zip(left, right, strict=False))


def _numbers(file: Path) -> tuple[str, ...]:
    # Zeros in front say nothing, unless they stand behind a point: 0.05 and 0.5 are two moments.
    found = re.findall(r"((?<=\d)\.)?(\d+)", file.stem)
    return tuple(digits if point else digits.lstrip("0") for point, digits in found)


def _pictures(pairs: list[tuple[Path, Path]]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for k in spread(len(pairs), _LOOKED_AT):
        first, second = pairs[k]
        yield read_upright(first, frame=first.name), read_upright(second, frame=second.name)


def views_in_pictures(files: list[Path], camera: StereoCamera) -> BothViews | None:
    """Where the view of a camera lies in pictures that hold both; None where they hold one.

    Args:
        files: all of one size.
        camera: whose view to take.

    Raises:
        SourceError: a picture that is damaged.
    """
    folder = files[0].parent
    size = upright_size(files[0], frame=files[0].name)
    views = possible_views(f"{folder.name} {files[0].stem}", *size, camera)
    if views is None:
        return None
    pictures = (read_upright(files[k], frame=files[k].name) for k in spread(len(files), _LOOKED_AT))
    return views if views.is_told(folder, agreeing_share(views.both(pictures))) else None
