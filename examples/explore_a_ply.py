"""Explore a scene that another program reconstructed: a PLY of Gaussians, and its cameras.

    python examples/explore_a_ply.py scene.ply transforms_folder/ views/

Writes what the virtual views see, and prints what each trajectory adds.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import extrags


def explore_ply(ply: Path, source: str, folder: Path, config: extrags.PipelineConfig) -> extrags.Exploration:
    """Find virtual trajectories in a scene, and write the last view of each.

    Args:
        ply: Gaussians as any 3DGS program writes them.
        source: where the cameras stand: COLMAP model, transforms.json, or any other source with poses.
        folder: where the images go.
        config: settings; `surface`, `freespace` and `explore` count.
    """
    scene = extrags.Scene(extrags.Gaussians.read_ply(ply))
    sequence = extrags.read(source, config.ingest)
    cameras, masks = sequence.training_cameras, sequence.training_masks
    mesh = extrags.fuse_surface(scene, cameras, config.surface, masks=masks)
    space = extrags.carve(scene, mesh, cameras, config.freespace, masks=masks)
    found = extrags.explore(scene, sequence, config.explore, freespace=space)
    folder.mkdir(parents=True, exist_ok=True)
    for index, (cameras, gain) in enumerate(zip(found.trajectories, found.gains, strict=True)):
        print(f"trajectory {index}: {len(cameras) - 1} virtual views, {gain} new (Gaussian, direction) pairs")
        with torch.no_grad():
            rgb = scene.render(cameras[len(cameras) - 1]).rgb[0].clamp(0, 1).numpy()
        Image.fromarray(np.rint(rgb * 255).astype(np.uint8)).save(folder / f"trajectory_{index:02d}.png")
    return found


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    explore_ply(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]), extrags.PROFILES["quick"])
