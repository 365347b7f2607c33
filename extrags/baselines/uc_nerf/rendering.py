"""Held-out views and surface of the baseline, by the rules of the evaluation protocol."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from extrags.baselines.uc_nerf.scene import UcNerf
from extrags.events import Progress, emit
from extrags.frame_stacks import empty_stack
from extrags.metrics.protocol import RenderedViews
from extrags.metrics.surface import PROTOCOL_FUSION, surface_from_renders
from extrags.sequence import EndoscopicSequence
from extrags.surface import Mesh

__all__ = ["render", "surface"]


def render(
    scene: UcNerf, sequence: EndoscopicSequence, frames: Int[np.ndarray, "v"] | None = None
) -> RenderedViews:
    """Render frames of a sequence, each from other frames than itself; the system knows no exposure.

    Args:
        scene: the trained baseline.
        sequence: posed frames, those it was trained on with the same split; only cameras are used.
        frames: indices of the frames; None takes the held-out ones.

    Returns:
        Colour, alpha and expected z-depth of each view, at the size of the sequence.
    """
    frames = np.asarray(sequence.test if frames is None else frames)
    shape = (len(frames), sequence.height, sequence.width)
    rgb, alpha, depth = (empty_stack(size, np.float32) for size in ((*shape, 3), shape, shape))
    encoded, sources = scene.encoded(), _sources(sequence)
    for place, frame in enumerate(frames):
        found = scene.render(sequence.cameras[int(frame)], encoded, leave_out=sources.get(int(frame)))
        assert found.rgb is not None
        rgb[place] = found.rgb.clamp(0, 1).reshape(*shape[1:], 3)
        alpha[place], depth[place] = found.alpha.reshape(shape[1:]), found.depth.reshape(shape[1:])
        emit(Progress("render", place + 1, len(frames)))
    return RenderedViews(rgb, alpha, depth, None)


def surface(scene: UcNerf, sequence: EndoscopicSequence) -> Mesh | None:
    """The surface by the rules of the protocol (`extrags.metrics.surface`); None when there is none.

    The depth of a training frame is rendered as that of a held-out one is: from other frames.

    Args:
        scene: the trained baseline.
        sequence: provides the training and held-out cameras.
    """
    frames = np.unique(np.concatenate([sequence.train, sequence.test]))
    cameras = sequence.cameras[frames].at_most_width(PROTOCOL_FUSION.max_width)
    depth = empty_stack((len(cameras), cameras.height, cameras.width), np.float32)
    encoded, sources = scene.encoded(), _sources(sequence)
    for place, frame in enumerate(frames):
        found = scene.render(cameras[place], encoded, color=False, leave_out=sources.get(int(frame)))
        depth[place] = found.median_depth.where(found.alpha >= PROTOCOL_FUSION.min_alpha, 0.0).reshape(
            depth[place].shape
        )
        emit(Progress("surface", place + 1, len(cameras)))
    return surface_from_renders(cameras, depth)


def _sources(sequence: EndoscopicSequence) -> dict[int, int]:
    """Of each training frame, its place among the frames that the baseline keeps."""
    return {int(frame): place for place, frame in enumerate(sequence.train)}
