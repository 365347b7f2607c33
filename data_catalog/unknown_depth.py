"""Values in depth files that stand for no depth."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from jaxtyping import Float

from extrags.known_depth import FARTHEST, is_background

__all__ = ["UnknownDepth"]

logger = logging.getLogger(__name__)


class UnknownDepth:
    """Sets what is no depth in the maps of a source to 0, counts it, and tells of it."""

    def __init__(self) -> None:
        self._unfinite: dict[Path, int] = {}
        self._background: dict[Path, int] = {}
        self._absent: list[str | int] = []

    def zeroed(self, depth: Float[np.ndarray, "h w"], file: Path) -> Float[np.ndarray, "h w"]:
        """A map with 0 where it is not finite, or a background.

        Args:
            depth: [h, w], as it lies on disk.
            file: named in the warning.
        """
        finite = np.isfinite(depth)
        if not finite.all():
            self._unfinite[file] = int((~finite).sum())
            depth = np.where(finite, depth, np.float32(0))
        background = is_background(depth)
        if background.any():
            self._background[file] = int(background.sum())
            depth = np.where(background, np.float32(0), depth)
        return depth

    def see_absent(self, frame: str | int) -> None:
        """Take note of a frame that has no map, where others have one."""
        self._absent.append(frame)

    def tell(self, frames: int, listing: Path) -> None:
        """Warn of what was found in all maps, and of frames that have none.

        Args:
            frames: how many there are.
            listing: the file that lists them.
        """
        if self._absent:
            logger.warning(
                "%s: %d of %d frames, %s first, have no depth, which is taken as unknown",
                listing,
                len(self._absent),
                frames,
                self._absent[0],
                extra={"topic": "depth coverage", "field": "depth"},
            )
        for counted, what in (
            (self._unfinite, "are NaN or infinite"),
            (self._background, f"are over {FARTHEST:g} times as far away as what is near in their image"),
        ):
            if counted:
                logger.warning(
                    "%s: %d depth values in %d of %d frames, this one first, %s, and taken as unknown",
                    next(iter(counted)),
                    sum(counted.values()),
                    len(counted),
                    frames,
                    what,
                )
