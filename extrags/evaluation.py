"""Rendering of a scene's held-out views, and their evaluation by the protocol in `extrags.metrics`."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Int

from extrags.errors import ShapeError
from extrags.events import Progress, emit
from extrags.facing import one_sided_rendering
from extrags.frame_stacks import FrameStack
from extrags.metrics.lpips import LpipsByNet, available_lpips
from extrags.metrics.protocol import EvaluationResult, RenderedViews, evaluate_views
from extrags.metrics.surface import TrueSurface, evaluate_surface, scene_surface
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.surface import Mesh
from extrags.threads import one_torch_thread

__all__ = ["evaluate", "evaluate_renders", "render"]


@one_torch_thread()
def render(
    scene: Scene,
    sequence: EndoscopicSequence,
    frames: Int[np.ndarray, "v"] | None = None,
    *,
    train_on: Literal["train", "all"] = "train",
) -> RenderedViews:
    """Render frames of a sequence by the rules of the evaluation protocol.

    Training frames are rendered at their own exposure; held-out frames of a recording with training frames
    at one that these tell (`NearFieldLight.interpolated_exposures`); frames of other recordings at the mean
    exposure. What a view sees from behind stands behind all else, where the scene knows its sides
    (`extrags.facing.one_sided_rendering`).

    Args:
        scene: the scene, rendered where it is.
        sequence: posed frames in the scene's world.
        frames: indices of the frames; None takes the held-out ones.
        train_on: which frames the scene was made from (`coarse.train_on`). The oracle's scene was made from
            all of them, so that its held-out frames are at the exposures it has learned for them: the
            ceiling is one of geometry, colour and exposure together.

    Returns:
        Colour, alpha and expected z-depth of each view, at the size of the sequence.
    """
    frames = np.asarray(sequence.test if frames is None else frames)
    gains = None
    if scene.light is not None:
        trained = sequence.train if train_on == "train" else sequence.split.frames
        gains = scene.light.interpolated_exposures(frames, trained, sequence.recording)
    # Held-out views may be hundreds, of full size.
    rgb, alpha, depth = (FrameStack(len(frames)) for _ in range(3))
    with torch.no_grad():
        for done, frame in enumerate(frames, start=1):
            exposure = None if gains is None else gains[done - 1 : done]
            rendering = one_sided_rendering(scene, sequence.cameras[int(frame)], exposure=exposure)
            rgb.append(rendering.rgb[0].cpu().numpy())
            alpha.append(rendering.alpha[0].cpu().numpy())
            depth.append(rendering.depth[0].cpu().numpy())
            emit(Progress("render", done, len(frames)))
    return RenderedViews(rgb.array, alpha.array, depth.array, len(scene.gaussians))


def evaluate_renders(
    renders: RenderedViews,
    sequence: EndoscopicSequence,
    *,
    mesh: Mesh | None = None,
    true_surface: TrueSurface | None = None,
    lpips: LpipsByNet | None = None,
    per_view: list[dict[str, Any]] | None = None,
    device: torch.device | str = "cpu",
) -> EvaluationResult:
    """Metrics of rendered held-out views, and of the surface where ground truth is known.

    Args:
        renders: of the held-out frames, in their order.
        sequence: the sequence of these frames.
        mesh: the scene's surface (`extrags.metrics.surface.scene_surface`); None where it has none.
        true_surface: ground truth of the surface; None omits the surface metrics.
        lpips: LPIPS by backbone; None searches for the weights of the backbones of the profile `balanced`.
        per_view: as `extrags.metrics.protocol.evaluate_views` takes it.
        device: where colours are compared.

    Raises:
        ShapeError: when renders and frames differ in number or size.
        NonFiniteError: for NaN or infinity in the renders; names the frame.
    """
    surface = None if true_surface is None else evaluate_surface(mesh, true_surface, sequence)
    return evaluate_views(
        renders,
        sequence,
        sequence.test,
        available_lpips() if lpips is None else lpips,
        surface=surface,
        surface_reason="the sequence has no true depth"
        if sequence.true_depth_mm is None
        else "no true surface given",
        per_view=per_view,
        device=device,
    )


@one_torch_thread()
def evaluate(
    scene: Scene,
    sequence: EndoscopicSequence,
    *,
    true_surface: TrueSurface | None = None,
    lpips: LpipsByNet | None = None,
) -> EvaluationResult:
    """Render the held-out views of a scene and compute their metrics (`render`, `evaluate_renders`).

    Args:
        scene: the scene.
        sequence: posed frames, including the held-out ones.
        true_surface: ground truth of the surface; None omits the surface metrics.
        lpips: LPIPS by backbone; None searches for the weights of the backbones of the profile `balanced`.

    Raises:
        ShapeError: when there is no held-out frame.
    """
    if not len(sequence.test):
        raise ShapeError(f"{sequence.name}: split.test is empty: there is no held-out frame to evaluate on")
    mesh = None if true_surface is None else scene_surface(scene, sequence)
    return evaluate_renders(
        render(scene, sequence),
        sequence,
        mesh=mesh,
        true_surface=true_surface,
        lpips=lpips,
    )
