"""Held-out views restored after rendering: what the final scene shows, mended in the image.

A scene of Gaussians averages what was restored in many virtual views: guesses that do not agree come out
blurred, and Gaussians placed by a guessed depth stand wrong. A view restored by itself has neither fault, but
tells a story of its own where nothing was seen. Here the two are put together: the coarse scene's view is
restored, and mixed with that of the final scene, which all views share. Texture belongs to places in space
and is the same in all views.

Source: a restorer that is applied to the final renders as well is an idea of [Difix2025], see
docs/references.md; what is restored and mixed here differs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.config import EnhanceConfig
from extrags.errors import ShapeError
from extrags.events import Progress, emit
from extrags.metrics.filters import filter_separable, gaussian_weights
from extrags.metrics.protocol import RenderedViews
from extrags.restoration.benchmark.evaluation import held_out_clips
from extrags.restoration.classical import ClassicalEnhancer
from extrags.restoration.protocol import Clip, Enhancer
from extrags.restoration.surface_texture import (
    UNCONFIRMED_FROM,
    UNCONFIRMED_TO,
    SurfaceTexture,
)
from extrags.restoration.training_data.augmentation import unconfirmed
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.threads import one_torch_thread
from extrags.view_synthesis.conditioning import condition
from extrags.view_synthesis.gather import gather_references

__all__ = ["restored_renders"]

FINAL_SHARE = 0.4
"""Of the final scene's view; the rest is the restored one. Their errors have little in common, so that the
mean of both is nearer to the truth than either."""
FEATHER_SIGMA_PX, FEATHER_RADIUS_PX = 2.0, 6


@one_torch_thread()
def restored_renders(
    coarse: Scene,
    renders: RenderedViews,
    sequence: EndoscopicSequence,
    training: EndoscopicSequence,
    enhancer: Enhancer,
    config: EnhanceConfig,
    *,
    textured: bool = True,
) -> RenderedViews:
    """Restore rendered held-out views.

    Where the restorer only blends and fills (`classical`, which also stands in for one that the leave-out
    frames speak against), what the scene knows stays as it is rendered.

    Args:
        coarse: the scene that the restorer was made for.
        renders: held-out views of the final scene, at the exposure of the protocol.
        sequence: posed frames in the scene's world, held-out ones included.
        training: its training frames, with the depth that the scene was made with.
        enhancer: the scene's restorer.
        config: the number of references, and the seed.
        textured: whether what is invented gets texture of the scene's own frames.

    Returns:
        The same views with other colours; opacity and depth are those of the final scene.

    Raises:
        ShapeError: when there is not one render for each held-out frame.
        CaptureError: without any held-out frame.
    """
    if len(renders) != len(sequence.test):
        raise ShapeError(f"{len(renders)} renders of {len(sequence.test)} held-out frames")
    references = gather_references(coarse, training, training.train)
    texture = SurfaceTexture.of_references(references, seed=config.seed) if textured else None
    clips = held_out_clips(coarse, references, sequence, sequence.test, count=config.references)
    keeps_known = isinstance(enhancer, ClassicalEnhancer)
    restored, done = [], 0
    for clip in clips:
        final = replace(
            renders,
            rgb=renders.rgb[done : done + len(clip)],
            alpha=renders.alpha[done : done + len(clip)],
            depth_mm=renders.depth_mm[done : done + len(clip)],
        )
        restored.append(_restored(clip, final, enhancer, texture, keeps_known=keeps_known))
        done += len(clip)
        emit(Progress("restore renders", done, len(renders)))
    return replace(renders, rgb=np.concatenate(restored))


def _restored(
    clip: Clip, final: RenderedViews, enhancer: Enhancer, texture: SurfaceTexture | None, *, keeps_known: bool
) -> Float[np.ndarray, "t h w 3"]:
    restoration = enhancer.restore(clip)
    rgb = torch.from_numpy(restoration.rgb).permute(0, 3, 1, 2)
    rendered = torch.from_numpy(final.rgb).permute(0, 3, 1, 2).clamp(0, 1)
    window = gaussian_weights(FEATHER_SIGMA_PX, FEATHER_RADIUS_PX)
    to_invent = unconfirmed(clip.layers)
    span = UNCONFIRMED_TO - UNCONFIRMED_FROM
    invented = filter_separable(((to_invent - UNCONFIRMED_FROM) / span).clamp(0, 1), window, window)
    # A hole of the final scene has no colour that could be met.
    solid = torch.from_numpy(final.alpha)[:, None].clamp(0, 1)
    share = FINAL_SHARE * solid
    if keeps_known:
        share = torch.maximum(share, (1 - invented) * solid)
    mixed = (1 - share) * rgb + share * rendered
    if texture is not None:
        mixed = texture.applied(mixed, clip.cameras, _depth(clip, restoration.depth_mm), to_invent[:, 0])
    return np.ascontiguousarray(mixed.permute(0, 2, 3, 1).numpy())


def _depth(clip: Clip, completed: Float[np.ndarray, "t h w"] | None) -> Float[Tensor, "t h w"]:
    """z-depth without gaps: the restorer's, or that of smooth filling."""
    if completed is not None:
        return torch.from_numpy(completed)
    return condition(clip.layers, clip.transfer).depth_mm[:, 0]
