"""What a kind of source on disk must tell the catalogue, and the kinds there are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from extrags.config import IngestConfig
from extrags.sequence import EndoscopicSequence

__all__ = ["FolderFormat", "folder_formats"]


@dataclass(frozen=True)
class FolderFormat:
    """One way in which a sequence lies in a folder.

    Args:
        name: identifier, part of cache keys.
        version: raised by hand when the same files are read into other arrays; part of cache keys.
        summary: one line for messages.
        recognises: whether a folder holds this format, from file names only.
        files: every file that `read` may look at, as a sorted list.
        read: the folder, the settings and the sequence's name to a checked `EndoscopicSequence`.
        conventions: axes and units on disk, in one line.
        notes: what reading has to find out about this folder, as sentences; raises what `read` raises.
    """

    name: str
    version: int
    summary: str
    recognises: Callable[[Path], bool]
    files: Callable[[Path], list[Path]]
    read: Callable[[Path, IngestConfig, str], EndoscopicSequence]
    conventions: str = ""
    notes: Callable[[Path], tuple[str, ...]] | None = None


def folder_formats() -> tuple[FolderFormat, ...]:
    """All formats, the most specific first: a folder is read by the first that recognises it."""
    from data_catalog import (
        colmap_model,
        endonerf,
        frames_folder,
        posed_folder,
        simcol,
        sinus,
        transforms_json,
        video,
    )
    from data_catalog.c3vd import reader as c3vd

    return (
        posed_folder.FORMAT,
        sinus.FORMAT,
        simcol.FORMAT,
        c3vd.FORMAT,
        transforms_json.FORMAT,
        endonerf.FORMAT,
        colmap_model.FORMAT,
        video.FORMAT,
        frames_folder.FORMAT,
    )
