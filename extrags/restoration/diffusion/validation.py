"""Scores of the embedded restorer on pairs with a known truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.metrics.image import SSIM_WINDOW_PX, psnr_per_image, ssim_map
from extrags.restoration.clips import as_images, as_planes, keep_known
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.rectified_flow import Sampled
from extrags.restoration.training_data.pairs import Pairs
from extrags.threads import in_threads
from extrags.thresholds import HOLE_ALPHA
from extrags.view_synthesis.conditioning import condition
from extrags.view_synthesis.references import LightTransfer

__all__ = ["RestoredPairs", "restored_pairs", "scores_of", "validation_pairs", "validation_scores"]


@dataclass(frozen=True)
class RestoredPairs:
    """Pairs and what a restorer makes of them.

    Args:
        pairs: N of them, with the truth.
        rgb: restored colours, [N, 3, H, W].
        error: their expected error, not calibrated, [N, 1, H, W].
        name: the restorer with its number of steps.
    """

    pairs: Pairs
    rgb: Float[Tensor, "n 3 h w"]
    error: Float[Tensor, "n 1 h w"]
    name: str


def restored_pairs(
    enhancer: EmbeddedEnhancer, pairs: Pairs, transfer: LightTransfer, steps: int | None = None
) -> RestoredPairs:
    """Restore pairs, each as a view of its own.

    Args:
        enhancer: trained.
        pairs: all of these are restored.
        transfer: how brightness changes with distance.
        steps: of the sampler; None takes the restorer's.
    """
    steps = enhancer.steps if steps is None else steps

    def restored(view: int) -> Sampled:
        noise = enhancer.noise(pairs.size, view, 0)
        return enhancer.restored_layers(pairs.layers[view], transfer, noise, steps=steps)

    views = in_threads(restored, range(len(pairs)))
    rgb, error = torch.cat([view.rgb for view in views]), torch.cat([view.error for view in views])
    return RestoredPairs(pairs, rgb, error, f"embedded_{steps}")


def validation_scores(
    enhancer: EmbeddedEnhancer, pairs: Pairs, transfer: LightTransfer, candidates: tuple[int, ...]
) -> dict[str, dict[str, float]]:
    """PSNR and SSIM inside the mask on the validation pairs; on all pairs where there are none.

    Where leave-out pairs are among the validation pairs, synthetic ones are not counted: their artefacts are
    not those of an optimised scene.

    Args:
        enhancer: trained.
        pairs: all pairs.
        transfer: how brightness changes with distance.
        candidates: numbers of sampling steps.

    Returns:
        Of `none` (the rendering), `classical` (blend and fill) and `embedded_N`: `{psnr, psnr_kept}`,
        `psnr_kept` with the rendering put back where it is certain, as for the fine-tuning; `ssim` where the
        pairs are large enough for its window; and `psnr_hole` where a validation pair has pixels of alpha
        below one half.
    """
    chosen = validation_pairs(pairs) or pairs
    return scores_of([restored_pairs(enhancer, chosen, transfer, steps) for steps in candidates], transfer)


def scores_of(restored: list[RestoredPairs], transfer: LightTransfer) -> dict[str, dict[str, float]]:
    """As `validation_scores`, of pairs that have been restored.

    Args:
        restored: of the same pairs, at least one.
        transfer: how brightness changes with distance.
    """
    pairs = restored[0].pairs
    with torch.no_grad():
        conditioning = condition(pairs.layers, transfer)
    images = {"none": pairs.layers.get("rendered").clamp(0, 1), "classical": conditioning.base}
    images |= {each.name: each.rgb for each in restored}
    return {name: _score(image, pairs) for name, image in images.items()}


def validation_pairs(pairs: Pairs) -> Pairs | None:
    """Validation pairs with valid pixels, the leave-out ones alone where there are any; None without any."""
    telling = pairs.validation & (pairs.weight > 0).any(dim=(1, 2, 3)).numpy()
    chosen = np.flatnonzero(telling & ~pairs.synthetic)
    if len(chosen) == 0:
        chosen = np.flatnonzero(telling)
    return pairs.subset(chosen) if len(chosen) else None


def _mean_psnr(
    render: Float[Tensor, "n h w 3"], target: Float[Tensor, "n h w 3"], mask: Bool[Tensor, "n h w"]
) -> float:
    return float(np.mean([value for value in psnr_per_image(render, target, mask) if value is not None]))


def _with_known(render: Float[Tensor, "n h w 3"], pairs: Pairs) -> Float[Tensor, "n h w 3"]:
    rendered = as_images(pairs.layers.get("rendered").clamp(0, 1))
    kept, _ = keep_known(rendered, render.numpy(), as_planes(pairs.layers.get("uncertainty")))
    return torch.from_numpy(kept)


def _score(image: Float[Tensor, "n 3 h w"], pairs: Pairs) -> dict[str, float]:
    render = image.permute(0, 2, 3, 1)
    target = pairs.target.permute(0, 2, 3, 1)
    mask = pairs.weight[:, 0] > 0
    hole = mask & (pairs.layers.get("alpha")[:, 0] < HOLE_ALPHA)
    score = {
        "psnr": _mean_psnr(render, target, mask),
        "psnr_kept": _mean_psnr(_with_known(render, pairs), target, mask),
    }
    # Frames of a narrow band are large enough for it, and not any more at the width they are restored at.
    if min(pairs.size) > SSIM_WINDOW_PX // 2:
        score["ssim"] = float(ssim_map(render, target, figures=False)[mask].mean())
    if bool(hole.any()):
        error = (render - target)[hole].square().mean()
        score["psnr_hole"] = float(-10 * error.clamp_min(1e-10).log10())
    return score
