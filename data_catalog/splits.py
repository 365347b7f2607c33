"""The split of sources that define none."""

from __future__ import annotations

import numpy as np

from extrags.errors import SourceError
from extrags.sequence import Split

__all__ = ["every_nth"]


def every_nth(frames: int, holdout_every: int, *, file: object = None) -> Split:
    """Hold out frames 0, n, 2n, ... in the order of the recording.

    Source: the convention (n = 8) of Barron et al., Mip-NeRF 360, CVPR 2022, and Kerbl et al., 3D Gaussian
    Splatting, 2023.

    Raises:
        SourceError: fewer than two frames, so that nothing could train.
    """
    if frames < 2:
        raise SourceError(
            f"{frames} frame; expected at least two, one to train and one to hold out", file=file
        )
    index = np.arange(frames)
    held_out = index % holdout_every == 0
    return Split(f"every{holdout_every}", index[~held_out], index[held_out])
