"""The test of held-out frames against the depth of training frames."""

from __future__ import annotations

import numpy as np

from extrags.cameras import Cameras
from extrags.events import Event, Progress, subscribed
from extrags.observed_surface import observed_from_depth


def test_it_tells_how_far_it_is() -> None:
    K = np.tile([[20.0, 0, 8], [0, 20.0, 6], [0, 0, 1]], (6, 1, 1))
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = np.arange(6)
    told: list[Event] = []
    with subscribed(told.append):
        depth = np.full((6, 12, 16), 10, np.float32)
        seen = observed_from_depth(Cameras(K, poses, 16, 12), depth, np.arange(3), np.arange(3, 6))
    assert told == [Progress("ingest", done, 3) for done in (1, 2, 3)]
    assert seen[3].any()
    assert not seen[:3].any()
