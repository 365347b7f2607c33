"""What one stage hands to the next: objects that know their place in an artefact and their form on disk."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar

__all__ = ["Storable"]


class Storable(ABC):
    """Can be written into an artefact (`Slot.save`) and read from one (`Store.load`)."""

    stored_as: ClassVar[str]
    """Name of its folder or file inside the artefact; `.` for what fills the whole of it."""

    @abstractmethod
    def save(self, path: Path) -> None:
        """Write to a folder or file."""

    @classmethod
    @abstractmethod
    def load(cls, path: Path) -> Any:
        """Read what `save` wrote."""
