"""The split of sources that define none."""

from __future__ import annotations

from extrags.errors import SourceError
from extrags.splits import Split
from extrags.splits import every_nth as every_nth_of_any

__all__ = ["every_nth"]


def every_nth(frames: int, holdout_every: int, *, file: object = None) -> Split:
    """Hold out frames 0, n, 2n, ... (`extrags.splits.every_nth`) of a source, which has to have several.

    Raises:
        SourceError: fewer than two frames, so that nothing could train.
    """
    if frames < 2:
        raise SourceError(
            f"{frames} frame; expected at least two, one to train and one to hold out", file=file
        )
    return every_nth_of_any(frames, holdout_every)
