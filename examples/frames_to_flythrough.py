"""From one's own frames to a fly-through: images or a video become a scene, and a GIF from inside.

    python examples/frames_to_flythrough.py my_video.mp4 flythrough.gif

Without poses in the source, COLMAP estimates them first. Everything that `extrags data list` and the page on
sources name is read.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import extrags


def reconstructed(source: str, config: extrags.PipelineConfig) -> tuple[extrags.Scene, extrags.Cameras]:
    """The coarse scene of a source, and the cameras of its training frames."""
    sequence = extrags.read(source, config.ingest)
    if sequence.world_from_camera is None:
        estimate = extrags.estimate_poses(sequence, config.poses)
        sequence = extrags.with_estimated_poses(sequence, estimate)
    found = extrags.reconstruct(sequence, config.coarse)
    # Poses that did not agree with the images, and haze, are corrected.
    sequence = extrags.as_reconstructed(sequence, found)
    return found.scene, sequence.training_cameras


def flythrough(
    scene: extrags.Scene, cameras: extrags.Cameras, gif: Path, *, views_between: int = 5
) -> list[Image.Image]:
    """Render the way along the cameras, with views between them, and write it as a GIF."""
    frames = []
    for camera in cameras.interpolated(views_between):
        with torch.no_grad():
            rgb = scene.render(camera).rgb[0].clamp(0, 1).numpy()
        frames.append(Image.fromarray(np.rint(rgb * 255).astype(np.uint8)))
    frames[0].save(gif, save_all=True, append_images=frames[1:], duration=80, loop=0)
    return frames


if __name__ == "__main__":
    if len(sys.argv) != 3 or not sys.argv[2].lower().endswith(".gif"):
        sys.exit(__doc__)
    target = Path(sys.argv[2])
    target.parent.mkdir(parents=True, exist_ok=True)  # not after all the work
    flythrough(*reconstructed(sys.argv[1], extrags.PROFILES["quick"]), target)
