"""Which frames train and which are held out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from extrags.array_shapes import check_array

__all__ = ["Split", "every_nth"]


@dataclass(frozen=True, slots=True)
class Split:
    """Training and held-out frames; always defined by a manifest, never by file names.

    Args:
        name: e.g. `sparse`, `distanced`, `every8`.
        train: indices of frames the reconstruction may see.
        test: indices of held-out frames. An empty array may be of any type, as `np.array([])` is of floats.
        version: version of the rule behind the name; raised by hand when the rule changes.

    Raises:
        ShapeError: when the indices are no arrays of integers, such as `np.array([0, 2])`.
    """

    name: str
    train: Int[np.ndarray, "n_train"]
    test: Int[np.ndarray, "n_test"]
    version: int = 1

    def __post_init__(self) -> None:
        for part, indices in (("train", self.train), ("test", self.test)):
            if isinstance(indices, np.ndarray) and indices.shape == (0,):
                indices = indices.astype(np.int64)
                object.__setattr__(self, part, indices)
            check_array(indices, f"split {self.name}: {part}", (None,), np.integer)

    @property
    def frames(self) -> Int[np.ndarray, "n"]:
        """All frames of either part, in order; those that show nothing, say, are in neither."""
        return np.union1d(self.train, self.test)


def every_nth(frames: int, holdout_every: int) -> Split:
    """Hold out frames 0, n, 2n, ... in the order of the recording; of one frame, which trains, none.

    Source: the convention (n = 8) of Barron et al., Mip-NeRF 360, CVPR 2022, and Kerbl et al., 3D Gaussian
    Splatting, 2023.

    Args:
        frames: how many there are.
        holdout_every: n, 1 or more; with 1 every frame is held out.

    Returns:
        The split named `every<n>`.
    """
    index = np.arange(frames)
    held_out = (index % holdout_every == 0) & (frames > 1)
    return Split(f"every{holdout_every}", index[~held_out], index[held_out])
