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

import itertools
import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from extrags.config import EnhanceConfig
from extrags.config.stages import Finish
from extrags.depth.hidden import shrunk
from extrags.errors import ShapeError
from extrags.events import MetricRecorded, Progress, emit
from extrags.frame_stacks import FrameStack, frames_of, stacked
from extrags.lens import Undistortion, distortion_of_pinhole
from extrags.metrics.filters import filter_separable, gaussian_weights
from extrags.metrics.protocol import RenderedViews
from extrags.radial_lens import WIDE_FIELD_DEG
from extrags.restoration.agreement import agreed_views, feathered_invented_share
from extrags.restoration.benchmark.evaluation import iterate_held_out_clips
from extrags.restoration.diffusion.precision import chosen_precision
from extrags.restoration.protocol import Clip, Enhancer, among_kept, keeps_known, restore_clip
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

__all__ = ["RESTORED_SHARE", "RestoredShares", "restored_renders", "restored_shares"]

logger = logging.getLogger(__name__)

RESTORED_SHARE = 0.6
"""Of the restored view; the rest is the final scene's. Their errors have little in common, so that the mean
of both is nearer to the truth than either."""
MOSTLY = 0.5
"""Pixels that are invented to more than this share tell how much of the restored view serves where it is
invented, all others how much where the scene knows the surface."""
TOLERATED_LOSS_DB = 2.0
"""Left-out frames lie near the path, where a scene knows best: on two phantoms held-out views gained a
decibel where left-out frames told of neither gain nor loss, and whole views .2 of one where they told of a
loss of 2.2."""
CERTAIN_LOSS_DB = 3.0
"""From here on left-out frames decide alone; between both the shares pass gradually, since a seed changes
what such frames tell by some tenths of a decibel."""
LEAST_PIXELS = 500
"""Fewer pixels of a kind tell nothing."""
DEPTH_SMOOTHING_SHARE = 0.02
"""Standard deviation of the window that the ratio of both depths is smoothed with, per width of a view."""
LARGEST_LOG_RATIO = 1.0
"""Depths that differ by more are not both of the surface that is looked for."""
FADING_SHARE = 0.5
"""Where the final scene has a surface in less of the window, its depth counts the less."""
LEAST_SHARE = 1e-3
"""A shrunk pixel that has less of the final scene's surface has none."""


@dataclass(frozen=True)
class RestoredShares:
    """How much of a restored view is taken; the rest is the final scene's.

    Args:
        known: where the scene knows the surface.
        invented: elsewhere, as far as the final scene has a surface there.
    """

    known: float = RESTORED_SHARE
    invented: float = RESTORED_SHARE

    def __str__(self) -> str:
        return (
            f"{self.known:.2f} of what is restored where the scene knows the surface, {self.invented:.2f} "
            f"where it is invented ({RESTORED_SHARE:g} unless left-out frames lose by it)"
        )


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
    shares: RestoredShares | None = None,
) -> RenderedViews:
    """Restore rendered held-out views.

    Where the restorer keeps what is known (`keeps_known`: `classical`, and one that clones seamlessly, which
    stand in where the leave-out frames speak against a network), what the scene knows stays as it is
    rendered, views do not follow their neighbours, and no network refines: what one invents is wrong there.
    Views are restored at `enhance.max_width` at most, as virtual views are.

    Args:
        coarse: the scene that the restorer was made for.
        renders: held-out views of the final scene, at the exposure of the protocol.
        sequence: posed frames in the scene's world, held-out ones included.
        training: its training frames, with the depth that the scene was made with.
        enhancer: the scene's restorer.
        config: the number of references, the working width, the seed, and the refiner's precision.
        finish: what is done to invented colours: `textured` lays texture of the scene's own frames onto them,
            `refined` gives both to the refiner of the package, unless the restorer keeps what is known.
        shares: how much of the restored views to take, from `restored_shares`; None takes `RESTORED_SHARE`.

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
            coarse, renders, sequence, training, enhancer, config, finish=finish, shares=shares
        )
    shares = RestoredShares() if shares is None else shares
    width = config.working_width(sequence.width)
    small, training = sequence.at_most_width(width), training.at_most_width(width)
    references = gather_references(coarse, training, training.train)
    texture = None if finish == "smooth" else SurfaceTexture.of_references(references, seed=config.seed)
    refiner, keeping = None, keeps_known(enhancer)
    if keeping:
        shares = RestoredShares(known=0.0)
    elif shares != RestoredShares():
        logger.info("restored views: %s", shares)
    if finish == "refined" and keeping:
        logger.info("restored views are not refined: the restorer keeps what is known, as on unlike scenes")
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
        mixed, to_invent = view.mixed(shares), view.still_to_invent(shares)
        if not keeping:
            mixed = mixed + view.agreement(mixed, to_invent)
        if texture is not None:
            full_size_depth_mm, invented = (
                _enlarged(image, view.size) for image in (view.depth_mm, to_invent)
            )
            mixed = textured_views(texture, refiner, mixed, cameras, full_size_depth_mm, invented)
        mixed = mixed.clamp(0, 1)
        for image in mixed.permute(0, 2, 3, 1).numpy():
            restored.append(image)
        done += len(clip)
        emit(Progress("restore renders", done, len(renders)))
    return replace(renders, rgb=restored.array)


def restored_shares(
    trials: Iterable[tuple[Scene, RenderedViews, EndoscopicSequence]],
    enhancer: Enhancer,
    config: EnhanceConfig,
    *,
    error_share: float = 1.0,
    kept: Iterable[Int[np.ndarray, "k"]] | None = None,
) -> RestoredShares | None:
    """How much of the restored views to take, as left-out frames tell.

    `RESTORED_SHARE`, unless known pixels lose more than `TOLERATED_LOSS_DB` by it against the final scene's
    views alone: what is known well is only blurred by a network. From `CERTAIN_LOSS_DB` on it is the share
    with which mixtures of both are nearest to the frames, by least squares, and between both losses it passes
    from one to the other; and the same is asked of invented pixels. These alone decide nothing: left-out
    frames have few of them, and squared errors prefer what is smooth there.

    Frames are restored as they are mixed, without agreement and texture, and at the size of the trials.

    Args:
        trials: of each, a coarse scene without some frames, the views of these by its fine-tuned scene (at
            the exposure of the protocol), and the frames, with those that are left out as the held-out ones.
        enhancer: the scene's restorer.
        config: the number of references and the working width.
        error_share: squared error of the whole scene as a share of the trials', which are brief: of so much
            the errors of their views are taken.
        kept: of each trial, the positions of its training frames among those that the restorer was made from;
            None where they are the same.

    Returns:
        The shares; None where the restorer leaves known pixels alone anyway.
    """
    if keeps_known(enhancer):
        return None
    known, invented = _Errors(), _Errors()
    restorers = itertools.repeat(enhancer) if kept is None else (among_kept(enhancer, own) for own in kept)
    for (coarse, renders, sequence), restorer in zip(trials, restorers, strict=kept is not None):
        if sequence.lens is not None:
            training, renders = sequence.as_pinhole(), _flattened(renders, sequence)[0]
            sequence = sequence.as_pinhole(WIDE_FIELD_DEG)
        else:
            training = sequence
        width = config.working_width(sequence.width)
        small, training = sequence.at_most_width(width), training.at_most_width(width)
        references = gather_references(coarse, training, training.train)
        clips = iterate_held_out_clips(coarse, references, small, sequence.test, count=config.references)
        done = 0
        for clip in clips:
            part = slice(done, done + len(clip))
            frames = sequence.test[part]
            view = _RestoredClip.of_clip(clip, _part_of(renders, part), restorer)
            truth = torch.from_numpy(frames_of(sequence.rgb, frames)).permute(0, 3, 1, 2).float() / 255
            solid = view.solid * torch.from_numpy(frames_of(sequence.mask, frames))[:, None]
            mostly = view.invented > MOSTLY
            known.add(view, truth, solid * (1 - view.invented) * ~mostly)
            invented.add(view, truth, solid * view.invented * mostly)
            done += len(clip)
    of_known, certainty = known.share("known", error_share)
    if certainty == 0:
        return RestoredShares()
    of_invented, _ = invented.share("invented", error_share)
    return RestoredShares(of_known, RESTORED_SHARE + certainty * (of_invented - RESTORED_SHARE))


@dataclass
class _Errors:
    """Weighted sums of squared errors of the final scene's views and of restored ones, and of the product."""

    pixels: float = 0.0
    rendered: float = 0.0
    restored: float = 0.0
    product: float = 0.0

    def add(
        self, view: _RestoredClip, truth: Float[Tensor, "t 3 h0 w0"], weight: Float[Tensor, "t 1 h0 w0"]
    ) -> None:
        """Count the pixels of a clip by their weight."""
        rendered, restored = view.rendered - truth, view.restored - truth
        self.pixels += float(weight.sum())
        self.rendered += float((weight * rendered.square()).double().sum())
        self.restored += float((weight * restored.square()).double().sum())
        self.product += float((weight * rendered * restored).double().sum())

    def share(self, kind: str, error_share: float) -> tuple[float, float]:
        """Of the restored view, for pixels of this kind, and how much left-out frames decide it.

        See `restored_shares`.
        """
        rendered, product = error_share * self.rendered, math.sqrt(error_share) * self.product
        if self.pixels < LEAST_PIXELS:
            return RESTORED_SHARE, 0.0
        if rendered == 0:
            # Nothing is nearer than what is right.
            return (0.0, 1.0) if self.restored > 0 else (RESTORED_SHARE, 0.0)
        own = 1 - RESTORED_SHARE
        mixed = own**2 * rendered + RESTORED_SHARE**2 * self.restored + 2 * own * RESTORED_SHARE * product
        loss_db = 10 * math.log10(max(mixed / rendered, LEAST_SHARE))
        emit(MetricRecorded("finetune", f"{kind}_loss_db", loss_db))
        certainty = (loss_db - TOLERATED_LOSS_DB) / (CERTAIN_LOSS_DB - TOLERATED_LOSS_DB)
        certainty = min(max(certainty, 0.0), 1.0)
        if certainty == 0:
            return RESTORED_SHARE, 0.0
        nearest = (rendered - product) / (rendered + self.restored - 2 * product)
        share = min(max(nearest, 0.0), RESTORED_SHARE)
        return RESTORED_SHARE + certainty * (share - RESTORED_SHARE), certainty


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
    shares: RestoredShares | None,
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
        shares=shares,
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
        restoration = restore_clip(enhancer, clip)
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
            change = _enlarged(colors - shrunk(rendered, colors.shape[-2:]), size)
            restored = invented * restored + (1 - invented) * (rendered + change)
        depth_mm = _mean_depth(depth, torch.from_numpy(final.depth_mm)[:, None], solid)
        return cls(clip, rendered, solid, restored, invented, to_invent, depth_mm)

    @property
    def size(self) -> torch.Size:
        """Height and width of the final scene's views."""
        return self.rendered.shape[-2:]

    def mixed(self, shares: RestoredShares) -> Float[Tensor, "t 3 h0 w0"]:
        """Both views, the restored one by its shares."""
        most = max(shares.known, shares.invented)
        least_of_final = 1 - most + (most - shares.invented) * self.invented
        final_share = torch.maximum((1 - shares.known) * (1 - self.invented), least_of_final)
        # A hole of the final scene has no colour that could be met.
        share = final_share * self.solid
        return (1 - share) * self.restored + share * self.rendered

    def still_to_invent(self, shares: RestoredShares) -> Float[Tensor, "t 1 h w"]:
        """What is to be invented: the less, the smaller the share of it; at none only the scene's holes."""
        solid = shrunk(self.solid, self.to_invent.shape[-2:])
        return self.to_invent * (1 - (1 - shares.invented / RESTORED_SHARE) * solid)

    def agreement(
        self, rgb: Float[Tensor, "t 3 h0 w0"], to_invent: Float[Tensor, "t 1 h w"]
    ) -> Float[Tensor, "t 3 h0 w0"]:
        """What is to be added for the views to agree: coarse, and found at the clip's size."""
        clip = self.clip
        small = shrunk(rgb, to_invent.shape[-2:])
        agreed = agreed_views(small, self.depth_mm, to_invent, clip.cameras, clip.exposure, clip.transfer)
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
    share = shrunk(known, size)
    mean_mm = shrunk(final_mm * known, size) / share.clamp_min(LEAST_SHARE)
    ratio = torch.where(share > LEAST_SHARE, mean_mm / restored_mm, torch.ones(()))
    change = ratio.clamp_min(1e-9).log().clamp(-LARGEST_LOG_RATIO, LARGEST_LOG_RATIO)
    sigma = DEPTH_SMOOTHING_SHARE * size[-1]
    window = gaussian_weights(sigma, math.ceil(3 * sigma))
    smooth = filter_separable(change * share, window, window)
    # Not divided by less: inside a hole of the final scene the change fades out, without a step.
    smooth = smooth / filter_separable(share, window, window).clamp_min(FADING_SHARE)
    return restored_mm * (0.5 * smooth).exp()


def _enlarged(image: Float[Tensor, "t c h0 w0"], size: torch.Size) -> Float[Tensor, "t c h w"]:
    if image.shape[-2:] == size:
        return image
    return functional.interpolate(image, size, mode="bilinear", align_corners=False)
