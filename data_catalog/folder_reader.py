"""What a reader of one layout on disk tells the catalogue."""

from __future__ import annotations

import logging
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data_catalog.dataset import Descriptor, file_digests
from data_catalog.pose_conventions import OPENCV, PoseConvention
from data_catalog.posed_frames import SourceFrames, assembled, chosen_frames, planned_sampling
from extrags.config import IngestConfig
from extrags.errors import ExtragsError, SourceError
from extrags.sequence import EndoscopicSequence

__all__ = ["FolderReader", "Glance", "understood"]


@dataclass(frozen=True)
class Glance:
    """What can be told of a sequence before a picture is read.

    Args:
        width: of its frames, in pixels; with `ingest.size` = detail before they are shrunk to their detail,
            which only pictures tell.
        height: of its frames, in pixels.
        train: number of training frames; of footage, at most.
        test: number of held-out frames; of footage, at most.
        has_poses: whether the source has camera poses.
        has_depth: whether it has depth.
        looked_at: of footage, pictures that the frames are chosen among, each of which is decoded twice; 0
            where the header does not say, and for other sources.
        passed_over: pictures before the part of footage that is read, decoded twice and not looked at.
        source_pixels: of a picture of footage, of stereo footage of one view; 0 for other sources.
    """

    width: int
    height: int
    train: int
    test: int
    has_poses: bool
    has_depth: bool
    looked_at: int = 0
    passed_over: int = 0
    source_pixels: int = 0


class _Unheard(logging.Filter, threading.local):
    """Keeps back what readers say in threads that only look: it is said when they read."""

    looking = False

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether a record passes."""
        return not self.looking


_unheard_filter = _Unheard()


@contextmanager
def _unheard() -> Iterator[None]:
    """Readers warn of nothing in this thread."""
    for name, found in list(logging.root.manager.loggerDict.items()):
        if name.partition(".")[0] == "data_catalog" and isinstance(found, logging.Logger):
            found.addFilter(_unheard_filter)
    _unheard_filter.looking = True
    try:
        yield
    finally:
        _unheard_filter.looking = False


@contextmanager
def understood(place: Path) -> Iterator[None]:
    """Readers name what they find wrong; what nobody thought of is a `SourceError`, too, with its cause.

    Faults of disks and networks stay what they are: they may pass.
    """
    try:
        yield
    except ExtragsError:
        raise
    except (
        ArithmeticError,
        AssertionError,
        AttributeError,
        LookupError,
        MemoryError,
        RecursionError,
        TypeError,
        ValueError,
        struct.error,
    ) as error:
        problem = f"its content is not understood ({type(error).__name__}: {error})"
        raise SourceError(problem, file=place) from error


LensChange = Callable[[SourceFrames], SourceFrames]
"""Gives a source other lenses, such as those of a calibration file."""


def _as_stated(source: SourceFrames) -> SourceFrames:
    return source


@dataclass(frozen=True)
class FolderReader:
    """One way in which a sequence lies in a folder (or is a file).

    Args:
        name: identifier, part of cache keys.
        version: raised by hand when the same files are read into other arrays; part of cache keys.
        summary: one line that describes the layout, for messages.
        recognises: whether a path holds this layout, from file names (of a file without suffix, from its
            first bytes).
        files: every file that `frames` and its result may look at, as a sorted list.
        frames: what there is, poses in OpenCV axes (x right, y down, z forward), camera to world. Thinning,
            split, masks, undistortion, resizing and checks are done behind it. Raises `SourceError` naming
            file, frame and field.
        conventions: axes and units on disk, in one line.
        poses: how files of this layout hold poses, in whose words wrong ones are told.
        depth_unit: in which unit files of this layout hold depth, as a clause for errors about it; empty
            where that is the unit of the poses as they stand there.
        notes: what reading has to find out about this folder, as sentences; raises what `frames` raises.
        named_sets: sequences of the catalogue in this layout, each a folder below a data root.
        known_name: the catalogue's name for a folder, where it has one; None goes by `named_sets`.
        chosen: what `frames` goes by that is in none of these files, such as a camera that the folder's name
            tells, as plain JSON; part of cache keys. None, or nothing in it, where there is nothing.
        outline: as `frames`, from headers alone, for sources of which `frames` decodes pictures; nothing is
            read of what it gives. None where `frames` is as quick.
        is_footage: whether frames have times, of which `ingest.start_s` and `ingest.end_s` choose a part; the
            reader also chooses among them.
    """

    name: str
    version: int
    summary: str
    recognises: Callable[[Path], bool]
    files: Callable[[Path], list[Path]]
    frames: Callable[[Path, IngestConfig], SourceFrames]
    conventions: str = ""
    poses: PoseConvention = OPENCV
    depth_unit: str = ""
    notes: Callable[[Path], tuple[str, ...]] | None = None
    named_sets: tuple[Descriptor, ...] = ()
    known_name: Callable[[Path], str | None] | None = None
    chosen: Callable[[Path], dict[str, Any]] | None = None
    outline: Callable[[Path, IngestConfig], SourceFrames] | None = None
    is_footage: bool = False

    def read(
        self, place: Path, config: IngestConfig, name: str, lenses: LensChange = _as_stated
    ) -> EndoscopicSequence:
        """The sequence in a folder, under a name, with its own or other lenses.

        Raises:
            SourceError: a file is wrong; names file, frame and field.
            ConfigError: a size that the source cannot give.
        """
        with understood(place):
            return assembled(lenses(self.frames(place, config)), config, name)

    def glance(self, place: Path, config: IngestConfig, lenses: LensChange = _as_stated) -> Glance:
        """What `read` will give, without reading any picture, and without its warnings.

        Only pictures tell what `ingest.size` = detail comes to: the size is then the one it starts from.

        Raises:
            SourceError: what can be seen to be wrong so.
            ConfigError: a size that the source cannot give.
        """
        with understood(place), _unheard():
            source = lenses((self.outline or self.frames)(place, config))
            kept, split, world_from_camera = chosen_frames(source, config)
            sampling = planned_sampling(source, kept[0], config)
        return Glance(
            width=sampling.width,
            height=sampling.height,
            train=len(split.train),
            test=len(split.test),
            has_poses=world_from_camera is not None,
            has_depth=any(frame.depth_file is not None for frame in kept),
            looked_at=source.looked_at if self.is_footage else 0,
            passed_over=source.passed_over,
            source_pixels=kept[0].lens.width * kept[0].lens.height if self.is_footage else 0,
        )

    def fingerprint(self, place: Path) -> dict[str, Any]:
        """What a folder or file contributes to a cache key.

        Returns:
            Name and version of the reader, content of each file it looks at, and what it chooses that is in
            none of them.

        Raises:
            SourceError: not readable as a sequence.
        """
        with understood(place):
            return self._fingerprint(place)

    def _fingerprint(self, place: Path) -> dict[str, Any]:
        root = place if place.is_dir() else place.parent
        # Of a single file the content counts, not what it is called.
        listed = [
            (f"source{file.suffix}" if file == place else file.relative_to(root).as_posix(), file)
            for file in self.files(place)
        ]
        chosen = {} if self.chosen is None else self.chosen(place)
        return {"format": self.name, "version": self.version, "files": file_digests(listed), **chosen}

    def name_of(self, place: Path) -> str:
        """What the catalogue calls a folder or file: a set's name where it is one, else its own."""
        resolved = place.resolve()
        known = (
            self.known_name(resolved)
            if self.known_name is not None
            else next((item.name for item in self.named_sets if item.folder == resolved.name), None)
        )
        return known or (place.stem if place.is_file() else resolved.name)
