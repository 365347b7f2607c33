"""Camera paths as they are flown, or from view to view, sampled at a frame rate."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from extrags.cameras import Cameras
from extrags.errors import ConfigError
from extrags.export import CameraPath

__all__ = ["PathRecorder"]

_LONGEST_S = 3600.0
_REST_S = 0.25
"""After so long without a new view the camera stood still in between."""
_STEP_S = 0.05
"""How long the first movement after a rest takes."""


class PathRecorder:
    """Views with the times between them, from which a path at any frame rate is made."""

    def __init__(self) -> None:
        self._views: list[Cameras] = []
        self._times: list[float] = []

    def __len__(self) -> int:
        return len(self._views)

    @property
    def seconds(self) -> float:
        """From the first view to the last."""
        return self._times[-1] if self._times else 0.0

    def clear(self) -> None:
        """Forget all views."""
        self._views, self._times = [], []

    def add(self, camera: Cameras, after_s: float, *, rests: bool = False) -> None:
        """One more view.

        Args:
            camera: one camera of any size; one with a lens is recorded as a pinhole, since camera paths
                have none.
            after_s: since the view before, above 0; of no account for the first view.
            rests: whether, when that was long, the camera stood still and moved at the end alone. Otherwise
                it glides all the time.

        Raises:
            ConfigError: for a time that is none, or when the path would last more than an hour.
        """
        if len(camera) != 1:
            raise ConfigError(f"a view is that of one camera, not of {len(camera)}")
        camera = camera.as_pinholes()
        if not self._views:
            self._views, self._times = [camera], [0.0]
            return
        if not 0 < after_s < np.inf:
            raise ConfigError(f"a view {after_s:g} s after the one before; expected more than 0")
        if self.seconds + after_s > _LONGEST_S:
            raise ConfigError(f"the path is longer than {_LONGEST_S / 60:g} minutes")
        at = self.seconds + after_s
        if rests and after_s > _REST_S:
            self._views.append(self._views[-1])
            self._times.append(at - _STEP_S)
        self._views.append(camera)
        self._times.append(at)

    def path(self, width: int, height: int, *, fps: float = 24.0) -> CameraPath:
        """Cameras at equal intervals from the first view on, the last one at or just before the last view.

        Centres and intrinsics are interpolated linearly, orientations along the shortest rotation. A view of
        another aspect keeps its vertical field of view.

        Args:
            width: of the path's images in pixels.
            height: of the path's images in pixels.
            fps: cameras per second.

        Raises:
            ConfigError: when nothing was recorded, or for a rate that is none.
        """
        from scipy.spatial.transform import Rotation, Slerp

        if not self._views:
            raise ConfigError("no view was recorded")
        if not 0.1 <= fps <= 1000:
            raise ConfigError(f"{fps:g} frames per second; expected 0.1 to 1000")
        K = np.stack([_resized(view, width, height) for view in self._views])
        poses = np.concatenate([view.world_from_camera for view in self._views])
        if len(poses) == 1:
            return CameraPath(Cameras(K, poses, width, height), fps)
        known = np.asarray(self._times)
        # A rounding error must not lose the last view.
        at = np.minimum(np.arange(int(self.seconds * fps + 1e-6) + 1) / fps, known[-1])
        before = np.clip(np.searchsorted(known, at, side="right") - 1, 0, len(known) - 2)
        share = (at - known[before]) / (known[before + 1] - known[before])
        made = np.tile(np.eye(4), (len(at), 1, 1))
        made[:, :3, :3] = Slerp(known, Rotation.from_matrix(poses[:, :3, :3]))(at).as_matrix()
        made[:, :3, 3] = _between(poses[:, :3, 3], before, share[:, None])
        return CameraPath(Cameras(_between(K, before, share[:, None, None]), made, width, height), fps)


def _between(values: np.ndarray, before: np.ndarray, share: np.ndarray) -> np.ndarray:
    return np.asarray((1 - share) * values[before] + share * values[before + 1])


def _resized(camera: Cameras, width: int, height: int) -> Float[np.ndarray, "3 3"]:
    scale = height / camera.height
    K = camera.K[0].copy()
    K[:2, :2] *= scale
    K[0, 2] = width / 2 + (K[0, 2] - camera.width / 2) * scale
    K[1, 2] *= scale
    return np.asarray(K)
