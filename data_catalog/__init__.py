"""What datasets there are, and how each is read into an `extrags.sequence.EndoscopicSequence`.

The front door: `read`, `resolve`, `describe`, `glance`, `list_sequences`, `source_fingerprint`, `Source`,
`Descriptor`, `Glance`, `FolderReader`, `PosedFrame`, `SourceFrames`, `register_reader`. Each is loaded when
it is first asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from extrags.lazy_names import lazy_names

if TYPE_CHECKING:
    from data_catalog.catalog import describe, glance, list_sequences, read, resolve, source_fingerprint
    from data_catalog.dataset import Descriptor, Source
    from data_catalog.folder_reader import FolderReader, Glance
    from data_catalog.folders import register_reader
    from data_catalog.posed_frames import PosedFrame, SourceFrames

__all__ = [
    "Descriptor",
    "FolderReader",
    "Glance",
    "PosedFrame",
    "Source",
    "SourceFrames",
    "describe",
    "glance",
    "list_sequences",
    "read",
    "register_reader",
    "resolve",
    "source_fingerprint",
]

_MODULES = {
    "Descriptor": "dataset",
    "FolderReader": "folder_reader",
    "Glance": "folder_reader",
    "PosedFrame": "posed_frames",
    "Source": "dataset",
    "SourceFrames": "posed_frames",
    "describe": "catalog",
    "glance": "catalog",
    "list_sequences": "catalog",
    "read": "catalog",
    "register_reader": "folders",
    "resolve": "catalog",
    "source_fingerprint": "catalog",
}

__getattr__ = lazy_names(__name__, _MODULES)


def __dir__() -> list[str]:
    return sorted(__all__)
