"""Held-out views as an animation: truth, coarse and final side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from extrags.errors import CaptureError
from extrags.report.encode import as_uint8
from extrags.report.inputs import ReportInputs

__all__ = ["write_animation"]

GAP_PX = 4
WEBP_QUALITY = 82


def write_animation(path: Path, inputs: ReportInputs, *, frames_per_second: float = 8.0) -> None:
    """Write an animated WebP of all held-out views: truth, coarse and, where there is one, final.

    Args:
        path: file to write; its name should end in `.webp`.
        inputs: with renders of at least one scene.
        frames_per_second: of the animation, which loops.

    Raises:
        CaptureError: when nothing was rendered.
    """
    from PIL import Image

    rendered = [as_uint8(renders.rgb) for renders in (inputs.coarse, inputs.final) if renders is not None]
    if not rendered or not len(inputs.frames):
        raise CaptureError(f"{inputs.name}: no held-out view was rendered, there is nothing to animate")
    truth = inputs.sequence.rgb[inputs.frames]
    gap = np.full((*truth.shape[:2], GAP_PX, 3), 255, dtype=np.uint8)
    parts = [truth]
    for stack in rendered:
        parts += [gap, stack]
    pictures = [Image.fromarray(picture) for picture in np.concatenate(parts, axis=2)]
    pictures[0].save(
        path,
        "WEBP",
        save_all=True,
        append_images=pictures[1:],
        duration=round(1000 / frames_per_second),
        loop=0,
        quality=WEBP_QUALITY,
    )
