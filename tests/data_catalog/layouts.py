"""Sequences written in the layouts of other projects, and a measure of whether they came back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from extrags.cameras import invert_poses
from extrags.config import IngestConfig
from extrags.sequence import EndoscopicSequence, Split

AS_STORED = IngestConfig(correct_calibration=False, mask_foreground=False, depth_error=0)
"""For tests of what belongs together, and not of depth that poses contradict, as rounded or made-up depth
does: what would be corrected of it is not looked for, which takes several times as long as reading."""


def first_frames(sequence: EndoscopicSequence, count: int) -> EndoscopicSequence:
    """The first frames, the very first of them held out."""
    kept = np.arange(count)
    return replace(
        sequence,
        rgb=sequence.rgb[kept],
        K=sequence.K[kept],
        mask=sequence.mask[kept],
        depth_mm=None if sequence.depth_mm is None else sequence.depth_mm[kept],
        world_from_camera=None if sequence.world_from_camera is None else sequence.world_from_camera[kept],
        recording=None,
        frame_names=tuple(f"{index:04d}" for index in range(count)),
        observed=None,
        split=Split("first", kept[1:], kept[:1]),
        truth={},
    )


def carried_error_mm(sequence: EndoscopicSequence) -> float:
    """Depth of frame i carried into frame j and compared there: median over neighbouring frames, in mm."""
    assert sequence.depth_mm is not None
    cameras = sequence.cameras
    errors = []
    v, u = np.mgrid[2 : sequence.height : 4, 2 : sequence.width : 4]
    v, u = v.ravel(), u.ravel()
    for i in range(len(sequence) - 1):
        j = i + 1
        z = sequence.depth_mm[i][v, u].astype(np.float64)
        known = z > 0
        K = cameras.K[i]
        local = np.stack([(u + 0.5 - K[0, 2]) / K[0, 0], (v + 0.5 - K[1, 2]) / K[1, 1], np.ones(len(z))]) * z
        relative = invert_poses(cameras.world_from_camera[j][None])[0] @ cameras.world_from_camera[i]
        x, y, depth = relative[:3, :3] @ local[:, known] + relative[:3, 3:]
        K = cameras.K[j]
        column = np.floor(K[0, 0] * x / depth + K[0, 2]).astype(int)
        row = np.floor(K[1, 1] * y / depth + K[1, 2]).astype(int)
        inside = (
            (depth > 0) & (column >= 0) & (column < sequence.width) & (row >= 0) & (row < sequence.height)
        )
        found = sequence.depth_mm[j][row[inside], column[inside]]
        errors.append(np.abs(depth[inside] - found)[found > 0])
    return float(np.median(np.concatenate(errors)))


def same_frames(first: EndoscopicSequence, second: EndoscopicSequence, *, atol: float) -> None:
    """Everything an exporter promises to keep: of images what the mask shows."""
    np.testing.assert_array_equal(first.mask, second.mask)
    np.testing.assert_array_equal(first.rgb[first.mask], second.rgb[second.mask])
    np.testing.assert_allclose(first.K, second.K, rtol=0, atol=atol)
    np.testing.assert_allclose(
        first.cameras.world_from_camera, second.cameras.world_from_camera, rtol=0, atol=atol
    )
    assert first.frame_names == second.frame_names
    assert first.metric == second.metric
    np.testing.assert_array_equal(first.train, second.train)
    np.testing.assert_array_equal(first.test, second.test)


def with_tool(sequence: EndoscopicSequence) -> tuple[EndoscopicSequence, np.ndarray]:
    """The sequence with a grey instrument in every frame, and where it is."""
    rgb, tool = sequence.rgb.copy(), np.zeros(sequence.mask.shape, dtype=bool)
    for k in range(len(sequence)):
        tool[k, 40:60, : 30 + 2 * k] = True
        rgb[k][tool[k]] = 120 + 5 * (k % 3)
    return replace(sequence, rgb=rgb), tool


def write_endonerf(
    sequence: EndoscopicSequence, folder: Path, masks: np.ndarray | None = None, *, mask_folder: str = "masks"
) -> None:
    """EndoNeRF's layout: LLFF axes (down, right, backward), depth as 16-bit PNG, masks as given."""
    assert sequence.depth_mm is not None
    poses = sequence.cameras.world_from_camera
    rows = []
    for k in range(len(sequence)):
        right, down, forward = poses[k, :3, :3].T
        hwf = [sequence.height, sequence.width, sequence.K[k, 0, 0]]
        matrix = np.column_stack([down, right, -forward, poses[k, :3, 3], hwf])
        depth = sequence.depth_mm[k]
        rows.append([*matrix.ravel(), depth.min(), depth.max()])
        for name, picture in (
            ("images", sequence.rgb[k]),
            ("depth", np.round(depth).astype(np.uint16)),
            (mask_folder, None if masks is None else (masks[k] * 255).astype(np.uint8)),
        ):
            if picture is not None:
                (folder / name).mkdir(parents=True, exist_ok=True)
                Image.fromarray(picture).save(folder / name / f"frame-{k:06d}.png")
    np.save(folder / "poses_bounds.npy", np.array(rows))
