"""Messages between the caller and COLMAP's process: files in a scratch folder."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["PoseJob", "PoseJobResult"]


@dataclass(frozen=True)
class PoseJob:
    """Input of the process; arrays as in `extrags.sequence.EndoscopicSequence`.

    Args:
        rgb: uint8, [F, H, W, 3].
        mask: pixels features may come from, [F, H, W].
        K: [F, 3, 3].
        recording: [F].
        train: indices of frames the map is made of.
        test: indices of frames registered afterwards.
        settings: fields of `PosesConfig`.
        unknown_lens: whether `K`, then the same for all frames, is a guess and the lens is to be estimated.
    """

    rgb: np.ndarray
    mask: np.ndarray
    K: np.ndarray
    recording: np.ndarray
    train: np.ndarray
    test: np.ndarray
    settings: dict[str, Any]
    unknown_lens: bool = False

    def save(self, folder: Path) -> None:
        """Write the job."""
        np.savez(
            folder / "job.npz",
            rgb=self.rgb,
            mask=self.mask,
            K=self.K,
            recording=self.recording,
            train=self.train,
            test=self.test,
        )
        content = {"settings": self.settings, "unknown_lens": self.unknown_lens}
        (folder / "job.json").write_text(json.dumps(content))

    @classmethod
    def load(cls, folder: Path) -> PoseJob:
        """Read the job."""
        with np.load(folder / "job.npz") as arrays:
            return cls(**dict(arrays.items()), **json.loads((folder / "job.json").read_text()))


@dataclass(frozen=True)
class PoseJobResult:
    """Output of the process, in COLMAP's unit.

    Args:
        world_from_camera: [F, 4, 4], NaN for frames without a pose.
        points: [P, 3] float64.
        points_rgb: [P, 3] uint8.
        observed_frame: [O], training frames only.
        observed_point: [O], index into `points`.
        observed_px: [O, 2].
        report: counts, ready for JSON.
    """

    world_from_camera: np.ndarray
    points: np.ndarray
    points_rgb: np.ndarray
    observed_frame: np.ndarray
    observed_point: np.ndarray
    observed_px: np.ndarray
    report: dict[str, Any]

    def save(self, folder: Path) -> None:
        """Write the result."""
        np.savez(
            folder / "result.npz",
            world_from_camera=self.world_from_camera,
            points=self.points,
            points_rgb=self.points_rgb,
            observed_frame=self.observed_frame,
            observed_point=self.observed_point,
            observed_px=self.observed_px,
        )
        # Written last: its presence says that the result is whole.
        (folder / "result.json").write_text(json.dumps(self.report))

    @classmethod
    def load(cls, folder: Path) -> PoseJobResult:
        """Read the result."""
        with np.load(folder / "result.npz") as arrays:
            return cls(**dict(arrays.items()), report=json.loads((folder / "result.json").read_text()))
