"""Base class of the objects that stages exchange through artefacts."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar

__all__ = ["Storable"]


class Storable(ABC):
    """An object that can be written to an artefact (`Slot.save`) and read from one (`Store.load`)."""

    stored_as: ClassVar[str]
    """Name of its file or directory in the artefact; `.` if it is the whole artefact."""

    kept_when_loaded: ClassVar[bool] = False
    """Whether a process keeps the last ones it has loaded for who asks again; nobody may write into them."""

    @abstractmethod
    def save(self, path: Path) -> None:
        """Write to a folder or file."""

    @classmethod
    @abstractmethod
    def load(cls, path: Path) -> Any:
        """Read what `save` wrote."""
