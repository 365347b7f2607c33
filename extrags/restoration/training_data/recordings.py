"""Recordings to pretrain on: a posed sequence whose held-out frames are clips of views to restore."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt8

from extrags.cameras import Cameras
from extrags.errors import ShapeError
from extrags.sequence import EndoscopicSequence, Split

__all__ = ["PretrainingRecording"]


@dataclass(frozen=True)
class PretrainingRecording:
    """A recording and its clips.

    Args:
        sequence: training frames as a camera shows them; the held-out frames are the views to restore,
            without noise and at the mean exposure. Poses and depth are exact.
        clip: which clip each held-out frame belongs to, in the order of `sequence.test`; the views of a
            clip follow each other.
        kind: what was recorded.
        z_depth_mm: the true z-depth of any view of what was recorded, at pixel centres; infinite where a ray
            meets nothing.
        photograph: any view of it as the views to restore are: 8 bits, without noise, at the mean exposure.

    Raises:
        ShapeError: when there is not one clip number for each held-out frame.
    """

    sequence: EndoscopicSequence
    clip: Int[np.ndarray, "t"]
    kind: str
    z_depth_mm: Callable[[Cameras], Float[np.ndarray, "h w"]]
    photograph: Callable[[Cameras], UInt8[np.ndarray, "h w 3"]]

    def __post_init__(self) -> None:
        if len(self.clip) != len(self.sequence.test):
            raise ShapeError(
                f"{self.sequence.name}: {len(self.clip)} clip numbers for {len(self.sequence.test)} views"
            )

    def with_views(self, views: list[Cameras]) -> PretrainingRecording:
        """The recording with further views to restore, which come last.

        Args:
            views: of each further clip, at least one.
        """
        cameras = Cameras.concatenated(views)
        own, count = self.sequence, len(self.sequence.rgb)
        assert own.world_from_camera is not None
        assert own.depth_mm is not None
        depth = np.stack([self.z_depth_mm(cameras[view]) for view in range(len(cameras))])
        seen = np.isfinite(depth)
        further = np.arange(count, count + len(cameras))
        numbers = np.repeat(np.arange(len(views)), [len(part) for part in views])
        sequence = replace(
            own,
            rgb=np.concatenate([own.rgb, [self.photograph(cameras[view]) for view in range(len(cameras))]]),
            K=np.concatenate([own.K, cameras.K]),
            mask=np.concatenate([own.mask, seen]),
            split=Split(own.split.name, own.train, np.concatenate([own.test, further]), own.split.version),
            world_from_camera=np.concatenate([own.world_from_camera, cameras.world_from_camera]),
            depth_mm=np.concatenate([own.depth_mm, np.where(seen, depth, 0).astype(np.float32)]),
            recording=np.zeros(count + len(cameras), dtype=np.int64),
            frame_names=(*map(own.frame_name, range(count)), *(f"e_{number:04d}" for number in further)),
            truth={},
        )
        return replace(
            self, sequence=sequence, clip=np.concatenate([self.clip, numbers + self.clip.max(initial=-1) + 1])
        )
