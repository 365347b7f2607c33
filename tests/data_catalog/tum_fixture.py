"""Sequences written in the layout of TUM's RGB-D benchmark."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from extrags.sequence import EndoscopicSequence

START_S = 1305031102.175304
"""Of a recording of the benchmark."""
STEP_S = 0.04


def write_tum(sequence: EndoscopicSequence, folder: Path, *, late_s: float = 0.004) -> None:
    """Colours, depth and poses, each by a clock that is a little late against the one before.

    Args:
        sequence: with poses and depth, in millimetres.
        folder: gets the lists and the images.
        late_s: of depth against colours, and of poses against depth.
    """
    assert sequence.depth_mm is not None
    lists: dict[str, list[str]] = {name: ["# a remark"] for name in ("rgb", "depth", "groundtruth")}
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for k, pose in enumerate(sequence.cameras.world_from_camera):
        times_s = [START_S + STEP_S * k + late_s * order for order in range(3)]
        depth = np.round(sequence.depth_mm[k] * 5).astype(np.uint16)
        for name, time_s, picture in zip(("rgb", "depth"), times_s, (sequence.rgb[k], depth), strict=False):
            Image.fromarray(picture).save(folder / name / f"{time_s:.6f}.png")
            lists[name].append(f"{time_s:.6f} {name}/{time_s:.6f}.png")
        numbers = [*(pose[:3, 3] / 1000), *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        lists["groundtruth"].append(" ".join([f"{times_s[2]:.6f}", *(f"{value:.9f}" for value in numbers)]))
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    (folder / "intrinsics.json").write_text(json.dumps({"K": sequence.K[0].tolist()}))
