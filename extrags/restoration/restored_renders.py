"""Held-out views restored after rendering: what the final scene shows, mended in the image.

A scene of Gaussians averages what was restored in many virtual views: guesses that do not agree come out
blurred, and Gaussians placed by a guessed depth stand wrong. A view restored by itself has neither fault, but
tells a story of its own where nothing was seen. Here the two are put together: the coarse scene's view is
restored, and mixed with that of the final scene, which all views share; neighbouring views agree on what
they have invented; and texture belongs to places in space and is the same in all views.

Source: a restorer that is applied to the final renders as well is an idea of [Difix2025], see
docs/references.md; what is restored and mixed here differs.
"""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrags.cameras import Cameras
from extrags.config import EnhanceConfig
from extrags.config.stages import Finish
from extrags.errors import ShapeError
from extrags.events import Progress, emit
from extrags.frame_stacks import FrameStack, stacked
from extrags.lens import Undistortion, distortion_of_pinhole
from extrags.metrics.filters import filter_separable, gaussian_weights
from extrags.metrics.protocol import RenderedViews
from extrags.radial_lens import WIDE_FIELD_DEG
from extrags.restoration.agreement import agreed_views, feathered_invented_share
from extrags.restoration.benchmark.evaluation import iterate_held_out_clips
from extrags.restoration.classical import ClassicalEnhancer
from extrags.restoration.diffusion.precision import chosen_precision
from extrags.restoration.protocol import Clip, Enhancer
from extrags.restoration.refinement.refiner import Refiner, textured_views
from extrags.restoration.refinement.weights import bundled_refiner
from extrags.restoration.surface_texture import SurfaceTexture
from extrags.restoration.training_data.augmentation import unconfirmed
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.threads import one_torch_thread
from extrags.thresholds import HOLE_ALPHA
from extrags.view_synthesis.conditioning import condition
from extrags.view_synthesis.gather import gather_references

__all__ = ["restored_renders"]

logger = logging.getLogger(__name__)

FINAL_SHARE = 0.4
"""Of the final scene's view; the rest is the restored one. Their errors have little in common, so that the
mean of both is nearer to the truth than either."""
DEPTH_SMOOTHING_SHARE = 0.02
"""Standard deviation of the window that the ratio of both depths is smoothed with, per width of a view."""
LARGEST_LOG_RATIO = 1.0
"""Depths that differ by more are not both of the surface that is looked for."""
FADING_SHARE = 0.5
"""Where the final scene has a surface in less of the window, its depth counts the less."""
LEAST_SHARE = 1e-3
"""A shrunk pixel that has less of the final scene's surface has none."""


@one_torch_thread()
def restored_renders(
    coarse: Scene,
    renders: RenderedViews,
    sequence: EndoscopicSequence,
    training: EndoscopicSequence,
    enhancer: Enhancer,
    config: EnhanceConfig,
    *,
    finish: Finish = "refined",
) -> RenderedViews:
    """Restore rendered held-out views.

    Where the restorer only blends and fills (`classical`, which also stands in for one that the leave-out
    frames speak against), what the scene knows stays as it is rendered, views do not follow their neighbours,
    and no network refines: what one invents is wrong there. Views are restored at `enhance.max_width` at
    most, as virtual views are.

    Args:
        coarse: the scene that the restorer was made for.
        renders: held-out views of the final scene, at the exposure of the protocol.
        sequence: posed frames in the scene's world, held-out ones included.
        training: its training frames, with the depth that the scene was made with.
        enhancer: the scene's restorer.
        config: the number of references, the working width, the seed, and the refiner's precision.
        finish: what is done to invented colours: `textured` lays texture of the scene's own frames onto them,
            `refined` gives both to the refiner of the package, unless the restorer only blends and fills.

    Returns:
        The same views with other colours; opacity and depth are those of the final scene.

    Raises:
        ShapeError: when there is not one render for each held-out frame.
        CaptureError: without any held-out frame.
        WeightsError: when the refiner's weights are not there.
    """
    if len(renders) != len(sequence.test):
        raise ShapeError(f"{len(renders)} renders of {len(sequence.test)} held-out frames")
    if sequence.lens is not None:
        return _through_pinholes(coarse, renders, sequence, training, enhancer, config, finish=finish)
    width = config.working_width(sequence.width)
    small, training = sequence.at_most_width(width), training.at_most_width(width)
    references = gather_references(coarse, training, training.train)
    texture = None if finish == "smooth" else SurfaceTexture.of_references(references, seed=config.seed)
    refiner, keeps_known = None, isinstance(enhancer, ClassicalEnhancer)
    if finish == "refined" and keeps_known:
        logger.info("restored views are not refined: the restorer only blends and fills")
    elif finish == "refined":
        refiner = bundled_refiner(half_precision=chosen_precision(config) == "bfloat16")
    if finish != "smooth" and texture is None:
        logger.warning("no frame shows the surface closely enough: restored views stay without texture")
    clips = iterate_held_out_clips(coarse, references, small, sequence.test, count=config.references)
    restored, done = FrameStack(len(renders)), 0
    for clip in clips:
        part = slice(done, done + len(clip))
        cameras = sequence.cameras[sequence.test[part]]
        final = RenderedViews(
            renders.rgb[part], renders.alpha[part], renders.depth_mm[part], renders.n_gaussians
        )
        mixed = _mixed(clip, cameras, final, enhancer, texture, refiner, keeps_known=keeps_known)
        for view in mixed.permute(0, 2, 3, 1).numpy():
            restored.append(view)
        done += len(clip)
        emit(Progress("restore renders", done, len(renders)))
    return replace(renders, rgb=restored.array)


def _through_pinholes(
    coarse: Scene,
    renders: RenderedViews,
    sequence: EndoscopicSequence,
    training: EndoscopicSequence,
    enhancer: Enhancer,
    config: EnhanceConfig,
    *,
    finish: Finish,
) -> RenderedViews:
    """Views through a lens, restored as wide pinholes: what restoration changes there is carried back.

    What a pinhole does not show, and what restoration leaves alone, stays as it was rendered.
    """
    lens = sequence.lens
    assert lens is not None
    width, height = sequence.width, sequence.height
    plans = [
        Undistortion.of_radial(K, lens, width, height, WIDE_FIELD_DEG) for K in sequence.K[sequence.test]
    ]

    def flattened(images: np.ndarray) -> np.ndarray:
        found = (plan.image(image) for plan, image in zip(plans, images, strict=True))
        return stacked(found, len(plans))

    depths = (plan.depth(depth) for plan, depth in zip(plans, renders.depth_mm, strict=True))
    flat = RenderedViews(
        flattened(renders.rgb), flattened(renders.alpha), stacked(depths, len(plans)), renders.n_gaussians
    )
    restored = restored_renders(
        coarse,
        flat,
        sequence.as_pinhole(WIDE_FIELD_DEG),
        training.as_pinhole(),
        enhancer,
        config,
        finish=finish,
    )
    changed = FrameStack(len(plans))
    for index, plan in enumerate(plans):
        back = distortion_of_pinhole(sequence.K[sequence.test[index]], lens, plan.K, width, height)
        change = np.where(plan.valid[..., None], restored.rgb[index] - flat.rgb[index], 0)
        changed.append((renders.rgb[index] + back.image(change)).astype(np.float32))
    return replace(renders, rgb=changed.array)


def _mixed(
    clip: Clip,
    cameras: Cameras,
    final: RenderedViews,
    enhancer: Enhancer,
    texture: SurfaceTexture | None,
    refiner: Refiner | None,
    *,
    keeps_known: bool,
) -> Float[Tensor, "t 3 h w"]:
    rendered = torch.from_numpy(final.rgb).permute(0, 3, 1, 2).clamp(0, 1)
    solid = torch.from_numpy(final.alpha)[:, None].clamp(0, 1)
    restoration = enhancer.restore(clip)
    colors = torch.from_numpy(restoration.rgb).permute(0, 3, 1, 2)
    to_invent = unconfirmed(clip.layers)
    depth = (
        condition(clip.layers, clip.transfer).depth_mm
        if restoration.depth_mm is None
        else torch.from_numpy(restoration.depth_mm)[:, None]
    )
    size = rendered.shape[-2:]
    depth = _mean_depth(depth, torch.from_numpy(final.depth_mm)[:, None], solid)
    invented = _enlarged(feathered_invented_share(to_invent), size)
    restored = _enlarged(colors, size)
    if colors.shape[-2:] != size:
        # Where the scene knows the surface, its own detail stays, and restoration changes what is coarser.
        change = _enlarged(colors - _shrunk(rendered, colors.shape[-2:]), size)
        restored = invented * restored + (1 - invented) * (rendered + change)
    # A hole of the final scene has no colour that could be met.
    share = FINAL_SHARE * solid
    if keeps_known:
        share = torch.maximum(share, (1 - invented) * solid)
    mixed = (1 - share) * restored + share * rendered
    if not keeps_known:
        mixed = mixed + _agreement(clip, mixed, depth, to_invent)
    if texture is not None:
        full_size_depth_mm = _enlarged(depth, size)
        mixed = textured_views(
            texture, refiner, mixed, cameras, full_size_depth_mm, _enlarged(to_invent, size)
        )
    return mixed.clamp(0, 1)


def _agreement(
    clip: Clip,
    rgb: Float[Tensor, "t 3 h w"],
    depth_mm: Float[Tensor, "t 1 h0 w0"],
    to_invent: Float[Tensor, "t 1 h0 w0"],
) -> Float[Tensor, "t 3 h w"]:
    """What is to be added for the views of a clip to agree: coarse, and found at the clip's size."""
    size = to_invent.shape[-2:]
    small = _shrunk(rgb, size)
    agreed = agreed_views(small, depth_mm, to_invent, clip.cameras, clip.exposure, clip.transfer)
    return _enlarged(agreed - small, rgb.shape[-2:])


def _mean_depth(
    restored_mm: Float[Tensor, "t 1 h w"],
    final_mm: Float[Tensor, "t 1 h0 w0"],
    solid: Float[Tensor, "t 1 h0 w0"],
) -> Float[Tensor, "t 1 h w"]:
    """The geometric mean of both depths where the final scene has a surface, that of the view elsewhere.

    The errors of a view that was completed alone and of a scene that many views were fused in have little in
    common. Their ratio is smoothed: a rendered depth is rough, which shows in texture that is laid onto it.
    """
    size = restored_mm.shape[-2:]
    known = ((solid > HOLE_ALPHA) & (final_mm > 0)).to(restored_mm.dtype)
    share = _shrunk(known, size)
    mean_mm = _shrunk(final_mm * known, size) / share.clamp_min(LEAST_SHARE)
    ratio = torch.where(share > LEAST_SHARE, mean_mm / restored_mm, torch.ones(()))
    change = ratio.clamp_min(1e-9).log().clamp(-LARGEST_LOG_RATIO, LARGEST_LOG_RATIO)
    sigma = DEPTH_SMOOTHING_SHARE * size[-1]
    window = gaussian_weights(sigma, math.ceil(3 * sigma))
    smooth = filter_separable(change * share, window, window)
    # Not divided by less: inside a hole of the final scene the change fades out, without a step.
    smooth = smooth / filter_separable(share, window, window).clamp_min(FADING_SHARE)
    return restored_mm * (0.5 * smooth).exp()


def _shrunk(image: Float[Tensor, "t c h0 w0"], size: torch.Size) -> Float[Tensor, "t c h w"]:
    return image if image.shape[-2:] == size else functional.interpolate(image, size, mode="area")


def _enlarged(image: Float[Tensor, "t c h0 w0"], size: torch.Size) -> Float[Tensor, "t c h w"]:
    if image.shape[-2:] == size:
        return image
    return functional.interpolate(image, size, mode="bilinear", align_corners=False)
