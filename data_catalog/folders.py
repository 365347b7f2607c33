"""Folders, videos and DICOM files as a dataset: what a reader recognises, and the named sets readers know.

To add a reader: one module in `data_catalog/readers` with a `READER`, and one line in `READERS`. A reader of
another package is handed to `register_reader`.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from data_catalog.c3vd import reader as c3vd
from data_catalog.calibration_files import with_calibration_file
from data_catalog.dataset import Descriptor, Source
from data_catalog.folder_reader import FolderReader, Glance
from data_catalog.footage import DICOM_SUFFIXES, VIDEO_SUFFIXES, files_of_kind
from data_catalog.images import image_entries
from data_catalog.named_folders import find_folder, not_on_this_machine
from data_catalog.posed_frames import SourceFrames
from data_catalog.readers import (
    colmap_model,
    dicom,
    endonerf,
    frames_folder,
    posed_folder,
    simcol,
    sinus,
    transforms_json,
    tum,
    video,
)
from data_catalog.readers.beside_frames import what_would_be_lost
from extrags.config import IngestConfig
from extrags.errors import ConfigError, SourceError, SourceNotFoundError
from extrags.frame_names import COLOR_SUFFIXES, natural_key
from extrags.sequence import EndoscopicSequence
from extrags.user_paths import expanded

__all__ = ["READERS", "FolderDataset", "find_reader", "readers", "register_reader"]

READERS: tuple[FolderReader, ...] = (
    posed_folder.READER,
    sinus.READER,
    simcol.READER,
    c3vd.READER,
    transforms_json.READER,
    endonerf.READER,
    tum.READER,
    colmap_model.READER,
    video.READER,
    dicom.READER,
    frames_folder.READER,
)
"""The most specific first: a folder is read by the first that recognises it."""

_registered: list[FolderReader] = []
_OTHER_IMAGES = (
    *(".gif", ".jp2", ".j2k", ".avif", ".heic", ".heif", ".exr", ".hdr", ".pgm", ".ppm", ".pnm", ".tga"),
    *(".jxl", ".dng", ".npy", ".npz"),
)
"""Images that are not read as frames."""
_FOLDERS_ABOVE = 3
"""So far above a file its sequence is looked for: `sparse/0/cameras.bin`."""
_NAMED_FILES = 5
"""So many of the files between which a user has to choose are named."""


def readers() -> tuple[FolderReader, ...]:
    """All readers in the order they are asked: registered ones, then `READERS`."""
    return (*_registered, *READERS)


def register_reader(reader: FolderReader) -> None:
    """Add a reader from outside; it is asked before those of the catalogue.

    It is known in this process only: workers that read sources register it too.

    Raises:
        ConfigError: a reader of that name exists already.
    """
    if find_reader(reader.name) is not None:
        raise ConfigError(f"there is a reader {reader.name!r} already; give the new one another name")
    _registered.append(reader)


def find_reader(name: str) -> FolderReader | None:
    """The reader of a name, or None."""
    return next((reader for reader in readers() if reader.name == name), None)


class FolderDataset:
    """Any folder, video or DICOM file, and named sets below a data root."""

    name = "folders"

    @property
    def spelling(self) -> str:
        """How its named sets are called."""
        return ", ".join(item.name for item in _named_sets())

    def entries(self) -> Iterator[Descriptor]:
        """The named sets."""
        for item in _named_sets():
            there = find_folder([str(item.folder)]) is not None
            yield item.model_copy(update={"available": there})

    def describe(self, name: str) -> Descriptor | None:
        """The descriptor of a named set, by its name or its folder's."""
        return next((item for item in self.entries() if name in (item.name, item.folder)), None)

    def resolve(self, name_or_path: str) -> Source | None:
        """A path that exists, else a named set by its name or its folder's."""
        path = expanded(name_or_path)
        if path.exists():
            return self._source(path, _recognised(path))
        item = self.describe(name_or_path)
        if item is None:
            return None
        folder = find_folder([str(item.folder)])
        if folder is None:
            raise not_on_this_machine(item.name, str(item.folder), "its path")
        return Source(name=item.name, dataset=self.name, format=item.format, paths=(str(folder),))

    def fingerprint(self, source: Source, config: IngestConfig) -> dict[str, Any]:
        """Reader, and content of each file it looks at."""
        return _reader(source).fingerprint(Path(source.paths[0]))

    def glance(self, source: Source, config: IngestConfig) -> Glance:
        """What its reader tells without reading pictures."""
        return _reader(source).glance(Path(source.paths[0]), config, _lenses(config))

    def read(self, source: Source, config: IngestConfig) -> EndoscopicSequence:
        """Whatever its reader makes of it, with the lens of `config.calibration` where that is given."""
        return _reader(source).read(Path(source.paths[0]), config, source.name, _lenses(config))

    def _source(self, path: Path, reader: FolderReader) -> Source:
        return Source(
            name=reader.name_of(path),
            dataset=self.name,
            format=reader.name,
            paths=(str(path.resolve()),),
        )


def _lenses(config: IngestConfig) -> Callable[[SourceFrames], SourceFrames]:
    """Gives a source the lens of the calibration file that the settings name, if they do."""

    def changed(source: SourceFrames) -> SourceFrames:
        if config.calibration is None:
            return source
        return with_calibration_file(source, expanded(config.calibration))

    return changed


def _named_sets() -> tuple[Descriptor, ...]:
    return tuple(item for reader in readers() for item in reader.named_sets)


def _folder_to_give(file: Path) -> str:
    """Names the folder whose picture, model or `transforms.json` was given; empty where there is none."""
    if not file.is_file():
        return ""
    above = list(file.absolute().parents)[:_FOLDERS_ABOVE]
    plain = (video.READER, dicom.READER, frames_folder.READER)
    posed = tuple(reader for reader in readers() if reader not in plain)
    # From above: folders of pictures, and of a COLMAP model, lie within the one that is read.
    searched = [(folder, posed) for folder in reversed(above)]
    if file.suffix.lower() in COLOR_SUFFIXES:
        searched += [(folder, (frames_folder.READER,)) for folder in above]
    for folder, kind in searched:
        if any(reader.recognises(folder) for reader in kind):
            return f"; give the folder {folder}"
    return ""


def _recognised(path: Path) -> FolderReader:
    for reader in readers():
        if reader.recognises(path):
            return reader
    if not path.is_dir():
        raise SourceError(
            "this is a file; expected a folder that holds a sequence, a video "
            f"({', '.join(VIDEO_SUFFIXES)}) or a DICOM file ({', '.join(DICOM_SUFFIXES)})"
            f"{_folder_to_give(path)}",
            file=path,
        )
    for kind, suffixes in (("videos", VIDEO_SUFFIXES), ("DICOM files", DICOM_SUFFIXES)):
        found = files_of_kind(path, suffixes)
        if len(found) > 1:
            raise SourceError(
                f"{len(found)} {kind} in this folder: {_listed(found)}; give the path of the one to read",
                file=path,
            )
    if not any(path.iterdir()):
        raise SourceNotFoundError(
            "the folder is empty; expected images, a video, or frames with their poses", file=path
        )
    # Those of the catalogue are described where the message says; others nowhere else.
    more = "".join(f", {reader.name} ({reader.summary})" for reader in _registered)
    kinds = ", ".join(COLOR_SUFFIXES)
    raise SourceNotFoundError(
        f"no sequence recognised in this folder{_what_is_there(path)}; expected images ({kinds}) in it, "
        "in images/ or in rgb/, a video, a DICOM file, a COLMAP model, "
        f"transforms.json, poses.json, C3VD, SimCol3D, EndoNeRF, TUM or the sinus set{more} (the layout of "
        "each: docs/sources.md)",
        file=path,
    )


def _what_is_there(path: Path) -> str:
    """What a user may have meant in a folder that no reader recognises, as the rest of a clause."""
    below = sorted((place for place in path.iterdir() if place.is_dir()), key=lambda at: natural_key(at.name))
    # What may not be looked into holds nothing to name.
    counted = [(len(image_entries(at)) if os.access(at, os.R_OK | os.X_OK) else 0, at.name) for at in below]
    holding = [f"{name}/ ({count})" for count, name in counted if count]
    if holding:
        more = f" and {len(holding) - _NAMED_FILES} more" if len(holding) > _NAMED_FILES else ""
        return (
            f", but images in {', '.join(holding[:_NAMED_FILES])}{more}: give the path of the folder to read"
            f"{what_would_be_lost(path)}"
        )
    others = Counter(file.suffix.lower() for file in path.iterdir() if file.suffix.lower() in _OTHER_IMAGES)
    if others:
        told = " and ".join(f"{count} {suffix} files" for suffix, count in others.most_common())
        return f": {told}, which are not read"
    return ""


def _listed(files: list[Path]) -> str:
    names = [file.name for file in files[:_NAMED_FILES]]
    more = [f"{len(files) - len(names)} more"] if len(files) > len(names) else []
    *first, last = names + more
    return f"{', '.join(first)} and {last}"


def _reader(source: Source) -> FolderReader:
    reader = find_reader(source.format)
    if reader is None:
        known = ", ".join(item.name for item in readers())
        raise ConfigError(f"no reader for the format {source.format!r}; known: {known}")
    return reader
