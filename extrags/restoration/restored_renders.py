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
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrags.config import EnhanceConfig
from extrags.config.stages import Finish
from extrags.errors import ShapeError
from extrags.events import Progress, emit
from extrags.frame_stacks import FrameStack, frames_of, stacked
from extrags.lens import Undistortion, distortion_of_pinhole
from extrags.metrics.filters import filter_separable, gaussian_weights
from extrags.metrics.protocol import RenderedViews
from extrags.radial_lens import WIDE_FIELD_DEG
from extrags.restoration.agreement import agreed_views, feathered_invented_share
from extrags.restoration.benchmark.evaluation import iterate_held_out_clips
from extrags.restoration.classical import ClassicalEnhancer
from extrags.restoration.diffusion.precision import chosen_precision
from extrags.restoration.protocol import Clip, Enhancer
from extrags.restoration.refinement.refiner import textured_views
from extrags.restoration.refinement.weights import bundled_refiner
from extrags.restoration.surface_texture import SurfaceTexture
from extrags.restoration.training_data.augmentation import unconfirmed
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.threads import one_torch_thread
from extrags.thresholds import HOLE_ALPHA
from extrags.view_synthesis.conditioning import condition
from extrags.view_synthesis.gather import gather_references

__all__ = ["RESTORED_SHARE", "restored_renders", "share_where_known"]

logger = logging.getLogger(__name__)

RESTORED_SHARE = 0.6
"""Of the restored view; the rest is the final scene's. Their errors have little in common, so that the mean
of both is nearer to the truth than either."""
KNOWN_SHARE = 0.5
"""Pixels that are invented to less than this share tell how much of the restored view serves where the scene
knows the surface."""
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
    known_share: float | None = None,
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
        known_share: of the restored view where the scene knows the surface, from `share_where_known`; None
            takes that of invented pixels, `RESTORED_SHARE`.

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
        return _through_pinholes(
            coarse, renders, sequence, training, enhancer, config, finish=finish, known_share=known_share
        )
    known_share = RESTORED_SHARE if known_share is None else known_share
    if known_share < RESTORED_SHARE and not isinstance(enhancer, ClassicalEnhancer):
        logger.info(
            "where the scene knows the surface, views take %.2f of what is restored in place of %.2f: "
            "left-out frames show no more to gain",
            known_share,
            RESTORED_SHARE,
        )
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
        view = _RestoredClip.of_clip(clip, _part_of(renders, part), enhancer)
        mixed = view.mixed(0.0 if keeps_known else known_share)
        if not keeps_known:
            mixed = mixed + view.agreement(mixed)
        if texture is not None:
            mixed = textured_views(
                texture, refiner, mixed, cameras, _enlarged(view.depth_mm, view.size), view.enlarged_to_invent
            )
        mixed = mixed.clamp(0, 1)
        for view in mixed.permute(0, 2, 3, 1).numpy():
            restored.append(view)
        done += len(clip)
        emit(Progress("restore renders", done, len(renders)))
    return replace(renders, rgb=restored.array)


def share_where_known(
    trials: Iterable[tuple[Scene, RenderedViews, EndoscopicSequence]],
    enhancer: Enhancer,
    config: EnhanceConfig,
) -> float | None:
    """How much of the restored view to take where the scene knows the surface, as left-out frames tell.

    `RESTORED_SHARE`, unless these frames are worse off with it than with the final scene's views alone: what
    is known well is only blurred by a network. Then the share with which mixtures of both are nearest to the
    frames, by least squares over the pixels that are not invented. A smaller harm is no evidence, nor is a
    smaller gain: left-out frames lie near the path, where less of what restoration changes pays than far off.

    Args:
        trials: of each, a coarse scene without some frames, the views of these by its fine-tuned scene (at
            the exposure of the protocol), and the frames, with those that are left out as the held-out ones.
        enhancer: the scene's restorer.
        config: the number of references and the working width.

    Returns:
        The share; None where the restorer only blends and fills, which leaves known pixels alone in any case,
        and without any such pixel.
    """
    if isinstance(enhancer, ClassicalEnhancer):
        return None
    met = changes = 0.0
    for coarse, renders, sequence in trials:
        if sequence.lens is not None:
            renders, sequence = _flattened(renders, sequence)[0], sequence.as_pinhole(WIDE_FIELD_DEG)
        small = sequence.at_most_width(config.working_width(sequence.width))
        references = gather_references(coarse, small, small.train)
        clips = iterate_held_out_clips(coarse, references, small, sequence.test, count=config.references)
        done = 0
        for clip in clips:
            part = slice(done, done + len(clip))
            frames = sequence.test[part]
            view = _RestoredClip.of_clip(clip, _part_of(renders, part), enhancer)
            truth = torch.from_numpy(frames_of(sequence.rgb, frames)).permute(0, 3, 1, 2).float() / 255
            known = torch.from_numpy(frames_of(sequence.mask, frames))[:, None] & (
                view.invented < KNOWN_SHARE
            )
            weight = (1 - view.invented) * known
            change = view.restored - view.rendered
            met += float((weight * change * (truth - view.rendered)).double().sum())
            changes += float((weight * change.square()).double().sum())
            done += len(clip)
    if changes == 0:
        return None
    nearest = met / changes
    # Squared errors are a parabola of the share: at twice the nearest one they are what they are at none.
    return RESTORED_SHARE if 2 * nearest >= RESTORED_SHARE else max(nearest, 0.0)


def _part_of(renders: RenderedViews, part: slice) -> RenderedViews:
    return RenderedViews(renders.rgb[part], renders.alpha[part], renders.depth_mm[part], renders.n_gaussians)


def _flattened(
    renders: RenderedViews, sequence: EndoscopicSequence
) -> tuple[RenderedViews, list[Undistortion]]:
    """Views through a lens as wide pinholes, and how each was resampled."""
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
    return flat, plans


def _through_pinholes(
    coarse: Scene,
    renders: RenderedViews,
    sequence: EndoscopicSequence,
    training: EndoscopicSequence,
    enhancer: Enhancer,
    config: EnhanceConfig,
    *,
    finish: Finish,
    known_share: float | None,
) -> RenderedViews:
    """Views through a lens, restored as wide pinholes: what restoration changes there is carried back.

    What a pinhole does not show, and what restoration leaves alone, stays as it was rendered.
    """
    lens = sequence.lens
    assert lens is not None
    flat, plans = _flattened(renders, sequence)
    restored = restored_renders(
        coarse,
        flat,
        sequence.as_pinhole(WIDE_FIELD_DEG),
        training.as_pinhole(),
        enhancer,
        config,
        finish=finish,
        known_share=known_share,
    )
    changed = FrameStack(len(plans))
    for index, plan in enumerate(plans):
        back = distortion_of_pinhole(
            sequence.K[sequence.test[index]], lens, plan.K, sequence.width, sequence.height
        )
        change = np.where(plan.valid[..., None], restored.rgb[index] - flat.rgb[index], 0)
        changed.append((renders.rgb[index] + back.image(change)).astype(np.float32))
    return replace(renders, rgb=changed.array)


@dataclass(frozen=True)
class _RestoredClip:
    """Views of a clip, restored at its size and brought to that of the final scene's views.

    Args:
        clip: as it was restored.
        rendered: the final scene's views, [T, 3, H, W].
        solid: their opacity, [T, 1, H, W].
        restored: the coarse scene's views, restored, [T, 3, H, W].
        invented: share of each pixel that is invented, without seams, [T, 1, H, W].
        to_invent: the same at the clip's size and with seams, [T, 1, h, w].
        depth_mm: of the surface that is looked for, [T, 1, h, w].
    """

    clip: Clip
    rendered: Float[Tensor, "t 3 h0 w0"]
    solid: Float[Tensor, "t 1 h0 w0"]
    restored: Float[Tensor, "t 3 h0 w0"]
    invented: Float[Tensor, "t 1 h0 w0"]
    to_invent: Float[Tensor, "t 1 h w"]
    depth_mm: Float[Tensor, "t 1 h w"]

    @classmethod
    def of_clip(cls, clip: Clip, final: RenderedViews, enhancer: Enhancer) -> _RestoredClip:
        """Restore a clip of the coarse scene's views, of which `final` are those of the final scene."""
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
        invented = _enlarged(feathered_invented_share(to_invent), size)
        restored = _enlarged(colors, size)
        if colors.shape[-2:] != size:
            # Where the scene knows the surface, its own detail stays; restoration changes what is coarser.
            change = _enlarged(colors - _shrunk(rendered, colors.shape[-2:]), size)
            restored = invented * restored + (1 - invented) * (rendered + change)
        depth_mm = _mean_depth(depth, torch.from_numpy(final.depth_mm)[:, None], solid)
        return cls(clip, rendered, solid, restored, invented, to_invent, depth_mm)

    @property
    def size(self) -> torch.Size:
        """Height and width of the final scene's views."""
        return self.rendered.shape[-2:]

    @property
    def enlarged_to_invent(self) -> Float[Tensor, "t 1 h0 w0"]:
        """What is to be invented, at that size."""
        return _enlarged(self.to_invent, self.size)

    def mixed(self, known_share: float) -> Float[Tensor, "t 3 h0 w0"]:
        """Both views: `RESTORED_SHARE` of the restored one where it is invented, `known_share` elsewhere."""
        final_share = ((1 - known_share) * (1 - self.invented)).clamp_min(1 - RESTORED_SHARE)
        # A hole of the final scene has no colour that could be met.
        share = final_share * self.solid
        return (1 - share) * self.restored + share * self.rendered

    def agreement(self, rgb: Float[Tensor, "t 3 h0 w0"]) -> Float[Tensor, "t 3 h0 w0"]:
        """What is to be added for the views to agree: coarse, and found at the clip's size."""
        clip = self.clip
        small = _shrunk(rgb, self.to_invent.shape[-2:])
        agreed = agreed_views(
            small, self.depth_mm, self.to_invent, clip.cameras, clip.exposure, clip.transfer
        )
        return _enlarged(agreed - small, self.size)


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
