"""What a finding is: one thing that is wrong with a source, or looks so."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict

__all__ = ["Finding", "warning"]


class Finding(BaseModel):
    """One thing that is wrong with a source, or looks so."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["error", "warning"]
    """An error stops a run; a warning makes its result worse or questionable."""
    topic: str
    """What it is about, in a word or two."""
    sentence: str
    """What was found, what was expected, what to do."""
    file: str | None = None
    frame: str | None = None
    field: str | None = None

    def __str__(self) -> str:
        where = [
            f"{label} {value}"
            for label, value in (("file", self.file), ("frame", self.frame), ("field", self.field))
            if value is not None
        ]
        return f"{', '.join(where)}: {self.sentence}" if where else self.sentence


def warning(topic: str, sentence: str, *, frame: str | None = None, field: str | None = None) -> Finding:
    """A finding that makes a result worse or questionable."""
    return Finding(kind="warning", topic=topic, sentence=sentence, frame=frame, field=field)
