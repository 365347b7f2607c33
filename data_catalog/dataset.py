"""What a dataset is to the catalogue: names, sources, and how a source becomes a sequence."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from pydantic import BaseModel, ConfigDict

from extrags.config import IngestConfig
from extrags.file_digests import size_and_digest
from extrags.sequence import EndoscopicSequence

__all__ = ["Dataset", "Descriptor", "Source", "file_digests"]


class Descriptor(BaseModel):
    """What there is to know about a sequence before it is read."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    """`DATASET/SEQUENCE[@SETTING]`."""
    description: str
    frames: int
    """Number of frames, all recordings together."""
    width: int
    """Of the source, in pixels, before any downscaling."""
    height: int
    length_unit: str
    """What a length of 1 in the `EndoscopicSequence` means."""
    axes: str
    """Camera and world axes on disk, and what is done to them."""
    has_depth: bool
    has_poses: bool
    split: str
    """Which frames are held out."""
    licence: str
    format: str
    """The name of a procedural family (`phantom`, `caverns`, `ct_colon`) or of a folder reader."""
    segment: str | None = None
    """Part of the colon, where the dataset has parts."""
    texture: str | None = None
    """Texture of the segment, where there are several."""
    videos: tuple[str, ...] = ()
    """Which videos of the scene are used; the one that trains comes first."""
    folder: str | None = None
    """Folder below a data root; None where no files are needed, or those of several videos are (`videos`)."""
    available: bool = True
    """Whether it can be read on this machine now."""


class Source(BaseModel):
    """A sequence that can be read: found by one dataset, which alone knows what its name stands for."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    """As in messages, reports and tables."""
    dataset: str
    """Name of the `Dataset` that reads it."""
    format: str
    """The name of a procedural family (`phantom`, `caverns`, `ct_colon`) or of a folder reader."""
    paths: tuple[str, ...] = ()
    """Folders or the file on disk; of several recordings the one that trains comes first."""

    @property
    def path(self) -> str | None:
        """The first of the paths; None where no files are needed."""
        return self.paths[0] if self.paths else None


@runtime_checkable
class Dataset(Protocol):
    """One kind of source. `data_catalog.catalog.DATASETS` lists all of them."""

    @property
    def name(self) -> str:
        """Stands in `Source.dataset`."""

    @property
    def spelling(self) -> str:
        """How its sequences are called, for messages."""

    def entries(self) -> Iterable[Descriptor]:
        """The sequences to list; of endless ones the first few."""

    def describe(self, name: str) -> Descriptor | None:
        """The descriptor of a name, listed or not; None for a name of another dataset.

        Raises:
            UnknownSequenceError: a name of this dataset that does not exist.
        """

    def resolve(self, name_or_path: str) -> Source | None:
        """What a user named; None where it belongs to another dataset.

        Raises:
            UnknownSequenceError: a name of this dataset that does not exist.
            SourceNotFoundError: a known name whose files are not on this machine.
            SourceError: a path that holds no sequence.
        """

    def fingerprint(self, source: Source, config: IngestConfig) -> dict[str, Any]:
        """What the source contributes to a cache key, as plain JSON: its content, never where it lies.

        Raises:
            SourceError: files are missing, or not readable as a sequence.
        """

    def read(self, source: Source, config: IngestConfig) -> EndoscopicSequence:
        """Read it; `data_catalog.read` checks the result and marks its highlights.

        Raises:
            SourceError: a file is wrong; names file, frame and field.
            ConfigError: settings that this source cannot be read with.
        """


def file_digests(listed: Iterable[tuple[str, Path]]) -> list[list[Any]]:
    """Name, size in bytes and BLAKE2b digest of each file, as JSON gives them back.

    Files that have not changed since this process digested them are not read again
    (`extrags.file_digests.size_and_digest`).

    Args:
        listed: files, each with a name that does not depend on where it lies.
    """
    return [[name, *size_and_digest(file)] for name, file in listed]
