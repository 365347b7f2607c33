"""Held-out views of a scene, rendered once, and what the evaluation protocol says of them."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Int

from extrags.confidence import PerceptualDifference
from extrags.events import Progress, emit
from extrags.metrics.protocol import EvaluationResult, RenderedViews, evaluate_views
from extrags.metrics.surface import TrueSurface, evaluate_surface, scene_surface
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.surface import Mesh

__all__ = ["evaluate", "evaluate_renders", "render"]


def render(
    scene: Scene, sequence: EndoscopicSequence, frames: Int[np.ndarray, "v"] | None = None
) -> RenderedViews:
    """Render frames of a sequence as the evaluation protocol wants them.

    Training frames are shown at their own exposure; held-out frames of a recording that was trained on at
    the exposure interpolated between their neighbours; frames of another recording at the mean.

    Args:
        scene: the scene.
        sequence: posed frames in the scene's world.
        frames: which of them; None takes the held-out ones.

    Returns:
        Colour, alpha and depth of each view.
    """
    frames = np.asarray(sequence.test if frames is None else frames)
    gains = None
    if scene.light is not None:
        gains = scene.light.interpolated_exposures(frames, sequence.train, sequence.recording)
    rgb, alpha, depth = [], [], []
    with torch.no_grad():
        for done, frame in enumerate(frames, start=1):
            exposure = None if gains is None else gains[done - 1 : done]
            rendering = scene.render(sequence.cameras[int(frame)], exposure=exposure)
            rgb.append(rendering.rgb[0].numpy())
            alpha.append(rendering.alpha[0].numpy())
            depth.append(rendering.depth[0].numpy())
            emit(Progress("render", done, len(frames)))
    return RenderedViews(np.stack(rgb), np.stack(alpha), np.stack(depth), len(scene.gaussians))


def evaluate_renders(
    renders: RenderedViews,
    sequence: EndoscopicSequence,
    *,
    mesh: Mesh | None = None,
    true_surface: TrueSurface | None = None,
    measure: PerceptualDifference | None = None,
) -> EvaluationResult:
    """Metrics of rendered held-out views, and of the surface where the true one is known.

    Args:
        renders: of the held-out frames, in their order.
        sequence: with those frames.
        mesh: the scene's surface (`extrags.metrics.surface.scene_surface`); None where it has none.
        true_surface: what it is held against; None leaves the surface figures out.
        measure: LPIPS, or why there is none; None takes it where its weights can be found.

    Raises:
        ShapeError: when renders and frames do not fit each other.
        NonFiniteError: for NaN or infinity in the renders; names the frame.
    """
    measure = PerceptualDifference.available() if measure is None else measure
    surface = None if true_surface is None else evaluate_surface(mesh, true_surface, sequence)
    return evaluate_views(
        renders,
        sequence,
        sequence.test,
        measure.lpips,
        lpips_reason=measure.reason,
        surface=surface,
        surface_reason="the sequence has no true depth"
        if sequence.depth_mm is None
        else "no true surface given",
    )


def evaluate(
    scene: Scene,
    sequence: EndoscopicSequence,
    *,
    true_surface: TrueSurface | None = None,
    measure: PerceptualDifference | None = None,
) -> EvaluationResult:
    """`render` the held-out views of a scene, and `evaluate_renders`.

    Args:
        scene: the scene.
        sequence: posed frames, the held-out ones among them.
        true_surface: as in `evaluate_renders`.
        measure: LPIPS, or why there is none; None takes it where its weights can be found.

    Raises:
        ShapeError: when there is no held-out frame.
    """
    mesh = None if true_surface is None else scene_surface(scene, sequence)
    return evaluate_renders(
        render(scene, sequence),
        sequence,
        mesh=mesh,
        true_surface=true_surface,
        measure=measure,
    )
