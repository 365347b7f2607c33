"""Virtual views among the steps of fine-tuning: when one is drawn, and what it is compared with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float

from extrags.config import FinetuneConfig
from extrags.frame_stacks import FrameStack
from extrags.pseudo_views import PseudoViews
from extrags.scene import Scene
from extrags.thresholds import HOLE_ALPHA
from extrags.training.views import View, in_steps

__all__ = ["shown_again", "virtual_steps", "virtual_views"]

UNKNOWN = 0.5
"""Uncertainty of a pixel from which its restored depth supervises."""

_ROUNDING = 1e-14
"""Of a sum of shares, relative."""


def virtual_steps(config: FinetuneConfig, *, any_virtual: bool = True) -> Bool[np.ndarray, "i"]:
    """Which iterations draw a virtual view: evenly spread, with a share that falls linearly.

    Args:
        config: number of iterations, and the share of virtual views at the start and at the end.
        any_virtual: False where there is no virtual view to draw.
    """
    if not any_virtual:
        return np.zeros(config.iterations, dtype=bool)
    share = np.linspace(config.pseudo_share, config.pseudo_share_final, config.iterations)
    # The sum of all shares so far. Rounding must not leave one that is a whole number just below it.
    behind = np.arange(1, config.iterations + 1) * (share[0] + share) / 2
    return np.asarray(np.diff(np.floor(behind * (1 + _ROUNDING)), prepend=0) > 0)


def virtual_views(pseudo_views: PseudoViews, config: FinetuneConfig) -> list[View]:
    """Pseudo-observations as views, with both levels of confidence as weights.

    Args:
        pseudo_views: restored virtual views; those of image-level confidence zero are left out.
        config: which form the loss has (see `finetune`), and what weights and targets are made of.
    """
    views = []
    cameras = pseudo_views.cameras
    # Virtual cameras have no mask: every pixel is valid.
    normalisation = None if config.loss == "weighted_mean" else float(cameras.height * cameras.width)
    ssim_weight = torch.ones(cameras.height, cameras.width) if config.loss == "paper" else None
    # Completed depth supervises only where the scene has no reliable surface.
    weights = config.pseudo_weight * pseudo_views.image_confidence
    used = np.flatnonzero(weights > 0)
    if not config.image_confidence:
        weights = np.full_like(weights, weights[used].mean() if len(used) else 0)
    for index in used.tolist():
        target = pseudo_views.target[index] if config.keep_known else pseudo_views.restored[index]
        confidence = in_steps(pseudo_views.pixel_confidence[index])
        depth = None
        if config.pseudo_depth:
            unknown = pseudo_views.uncertainty[index] > UNKNOWN
            depth = torch.from_numpy(np.where(unknown, pseudo_views.depth_mm[index], 0).astype(np.float32))
        if confidence.dtype != torch.uint8:
            confidence = confidence.clamp(min=config.confidence_floor)
        views.append(
            View(
                camera=cameras[index],
                rgb=in_steps(target),
                weight=confidence,
                least_weight=config.confidence_floor,
                depth_mm=depth,
                frame=None,
                loss_weight=float(weights[index]),
                ssim_weight=ssim_weight,
                normalisation=normalisation,
            )
        )
    return views


def shown_again(
    pseudo_views: PseudoViews, scene: Scene, config: FinetuneConfig
) -> tuple[PseudoViews, Float[np.ndarray, "v h w"]]:
    """Virtual views as targets of a further round: restored ones mixed with what the scene has become.

    Views restored one by one are guesses that do not agree; the scene is what they have agreed on, and blurs
    them. With c and a the scene's colour (before black, as it was trained to meet its targets) and opacity,
    and the share s of the restored view, `finetune.known_share` where the uncertainty is 0 and
    `finetune.invented_share` where it is 1, the target is `(1 - t) restored + t c` with `t = (1 - s) a`.
    Where the scene has a surface, its depth is the target's.

    Source: targets that are renewed from the scene are an idea of [Difix2025], see docs/references.md, where
    they are restored anew; here nothing is.

    Args:
        pseudo_views: as they were restored.
        scene: after the round before.
        config: the shares.

    Returns:
        The views with other colours (in [0, 1], in the steps of 1/255 in which images are stored) and depths
        (in world units), and the scene's opacity in them, [V, H, W].
    """
    rgb, alpha, depth_mm = (FrameStack(len(pseudo_views)) for _ in range(3))
    for index in range(len(pseudo_views)):
        with torch.no_grad():
            rendering = scene.render(pseudo_views.cameras[index])
        shown, opacity, distance = (
            image[0].cpu().numpy() for image in (rendering.rgb, rendering.alpha, rendering.depth)
        )
        uncertainty = pseudo_views.uncertainty[index]
        share = config.known_share + (config.invented_share - config.known_share) * uncertainty
        # A hole has no colour that could be met.
        of_scene = ((1 - share) * opacity)[..., None]
        mixed = (1 - of_scene) * pseudo_views.restored[index] + of_scene * shown
        solid = (opacity > HOLE_ALPHA) & (distance > 0)
        rgb.append(np.rint(mixed.clip(0, 1) * 255).astype(np.float32) / np.float32(255))
        alpha.append(opacity)
        depth_mm.append(np.where(solid, distance, pseudo_views.depth_mm[index]).astype(np.float32))
    changed = replace(pseudo_views, target=rgb.array, restored=rgb.array, depth_mm=depth_mm.array)
    return changed, alpha.array
