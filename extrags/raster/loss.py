r"""L1 + SSIM loss with its gradient in one pass.

For an image x, a target y, per-pixel weights m of the L1 term and s of the SSIM term, and a normalisation Z
in pixels,

.. math:: L = \frac{1}{3 Z} \sum_p \Bigl( (1 - \lambda) \, m_p \sum_c |x - y|
        + \lambda \, s_p \sum_c (1 - \mathrm{SSIM}_{pc}) / 2 \Bigr).

Where nothing else is said s = m and :math:`Z = \sum_p m_p`, which makes L a weighted mean: a factor common to
all weights then cancels. Any other Z, such as the number of valid pixels, keeps the magnitude of the weights.

The SSIM map is that of Wang et al. 2004: 11 x 11 Gaussian window of sigma 1.5 px, zero padding,
C1 = 0.01^2, C2 = 0.03^2 for a data range of one. It is computed on the unweighted images; the weights apply
to the map only. Where Z is the sum of weights and all of these are zero, the loss is zero.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import huber_loss

from extrags.errors import ConfigError, ShapeError
from extrags.raster import native
from extrags.thresholds import HOLE_ALPHA

__all__ = [
    "depth_loss",
    "huber_depth_gradient",
    "huber_depth_loss",
    "inverse_depth_loss",
    "l1_ssim_loss",
    "l1_ssim_loss_reference",
]

SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
WINDOW_RADIUS_PX = 5
WINDOW_SIGMA_PX = 1.5


def l1_ssim_loss(
    image: Float[Tensor, "*c h w 3"],
    target: Float[Tensor, "*c h w 3"],
    *,
    dssim_weight: float = 0.2,
    mask: Float[Tensor, "*c h w"] | None = None,
    ssim_mask: Float[Tensor, "*c h w"] | None = None,
    normalisation: float | None = None,
) -> Float[Tensor, ""]:
    """Weighted (1 - dssim_weight) L1 + dssim_weight (1 - SSIM) / 2; see the module for the formula.

    float32 CPU tensors go through the native kernel, which computes loss and gradient in one pass;
    everything else through `l1_ssim_loss_reference`. Only `image` gets a gradient.

    Args:
        image: rendered colour in [0, 1].
        target: ground-truth colour in [0, 1].
        dssim_weight: lambda, in [0, 1].
        mask: weights per pixel, not negative; None weights all pixels equally.
        ssim_mask: weights of the SSIM term where they are others; None takes `mask` for both terms.
        normalisation: Z, in pixels, over the whole batch; None is the sum of `mask`, a weighted mean.

    Returns:
        The loss.

    Raises:
        ShapeError: when shapes or dtypes do not fit together.
        ConfigError: when the normalisation is not positive.

    Source: Kerbl et al. 2023, eq. 7; Wang et al., Image quality assessment, TIP 2004.
    """
    _check(image, target, mask, ssim_mask, normalisation)
    plain = image.device.type == "cpu" and image.dtype == torch.float32
    if plain and native.native_isa() is not None:
        return native.l1_ssim_loss_native(image, target, dssim_weight, mask, ssim_mask, normalisation)
    return l1_ssim_loss_reference(
        image,
        target,
        dssim_weight=dssim_weight,
        mask=mask,
        ssim_mask=ssim_mask,
        normalisation=normalisation,
    )


def l1_ssim_loss_reference(
    image: Float[Tensor, "*c h w 3"],
    target: Float[Tensor, "*c h w 3"],
    *,
    dssim_weight: float = 0.2,
    mask: Float[Tensor, "*c h w"] | None = None,
    ssim_mask: Float[Tensor, "*c h w"] | None = None,
    normalisation: float | None = None,
) -> Float[Tensor, ""]:
    """Reference implementation of `l1_ssim_loss` in plain torch, for any floating-point dtype."""
    _check(image, target, mask, ssim_mask, normalisation)
    target = target.detach()
    height, width = image.shape[-3:-1]
    weights = torch.ones_like(image[..., 0]) if mask is None else mask.detach()
    total = 3 * (float(weights.sum()) if normalisation is None else normalisation)
    x = image.reshape(-1, height, width, 3).permute(0, 3, 1, 2)
    y = target.reshape(-1, height, width, 3).permute(0, 3, 1, 2)
    l1_weights = weights.reshape(-1, 1, height, width)
    ssim_weights = l1_weights if ssim_mask is None else ssim_mask.detach().reshape(-1, 1, height, width)
    l1 = (1 - dssim_weight) * l1_weights * (x - y).abs()
    dssim = dssim_weight * ssim_weights * (1 - _ssim_map(x, y)) / 2
    everything: Tensor = (l1 + dssim).sum()
    return everything / total if total != 0 else everything * 0


def inverse_depth_loss(
    depth: Float[Tensor, "*c h w"],
    alpha: Float[Tensor, "*c h w"],
    target: Float[Tensor, "*c h w"],
    *,
    scale: float,
    confidence: Float[Tensor, "*c h w"] | None = None,
) -> Float[Tensor, ""]:
    """Mean absolute difference of inverse depths, in units of the inverse of a typical depth.

    The mean is over pixels with both a rendered surface and a target depth. The native kernel of the same
    name computes it together with its gradient; see `extrags.raster.direct`.

    Args:
        depth: rendered z-depth in world units; only this argument gets a gradient.
        alpha: rendered opacity; pixels at `HOLE_ALPHA` or below are ignored.
        target: z-depth of the ground truth in world units, 0 where unknown.
        scale: the typical depth, in world units.
        confidence: factor of each pixel's difference, in [0, 1]; None is one. The mean stays one over pixels,
            so that an image of which little is sure has little weight.

    Returns:
        The loss; zero if no pixel can be compared.
    """
    valid = (target > 0) & (alpha.detach() > HOLE_ALPHA) & (depth.detach() > 1e-3 * scale)
    if not bool(valid.any()):
        return depth.sum() * 0
    difference = (scale / depth[valid] - scale / target.detach()[valid]).abs()
    return (difference if confidence is None else difference * confidence[valid]).mean()


def huber_depth_loss(
    depth: Float[Tensor, "*c h w"],
    alpha: Float[Tensor, "*c h w"],
    target: Float[Tensor, "*c h w"],
    *,
    scale: float,
    delta: float,
    confidence: Float[Tensor, "*c h w"] | None = None,
) -> Float[Tensor, ""]:
    r"""Mean Huber loss of depth differences in units of a typical depth.

    With x the difference, the loss is :math:`x^2 / 2` up to `delta` and :math:`\delta (|x| - \delta / 2)`
    beyond. The mean is over pixels with both a rendered surface and a target depth.

    Args:
        depth: rendered z-depth in world units; only this argument gets a gradient.
        alpha: rendered opacity; pixels at `HOLE_ALPHA` or below are ignored.
        target: z-depth of the ground truth in world units, 0 where unknown.
        scale: the typical depth, in world units.
        delta: where the loss becomes linear, in typical depths.
        confidence: factor of each pixel's loss, in [0, 1]; None is one.

    Returns:
        The loss; zero if no pixel can be compared.

    Source: Bonilla et al., Gaussian Pancakes, MICCAI 2024 (see docs/references.md). Its delta of 0.2 is in
    the units of its SLAM system; to measure it in typical depths, so that it means the same in every scene,
    is our interpretation.
    """
    valid = (target > 0) & (alpha.detach() > HOLE_ALPHA)
    if not bool(valid.any()):
        return depth.sum() * 0
    compared = depth[valid] / scale, target.detach()[valid] / scale
    if confidence is None:
        return huber_loss(*compared, delta=delta)
    return (huber_loss(*compared, delta=delta, reduction="none") * confidence[valid]).mean()


def huber_depth_gradient(
    depth: Float[np.ndarray, "h w"],
    alpha: Float[np.ndarray, "h w"],
    target: Float[np.ndarray, "h w"],
    gradient: Float[np.ndarray, "h w"],
    *,
    scale: float,
    delta: float,
    weight: float,
    confidence: Float[np.ndarray, "h w"] | None = None,
) -> tuple[float, int]:
    """`huber_depth_loss` times a weight, with its gradient, without autograd.

    Args:
        depth: as in `huber_depth_loss`, like the next four.
        alpha: rendered opacity.
        target: z-depth of the ground truth.
        gradient: filled with the derivatives by `depth`.
        scale: the typical depth.
        delta: where the loss becomes linear.
        weight: of the loss.
        confidence: factor of each pixel's loss; None is one.

    Returns:
        The weighted loss, and the number of pixels compared.
    """
    valid = (target > 0) & (alpha > HOLE_ALPHA)
    count = int(valid.sum())
    if count == 0:
        gradient[...] = 0
        return 0.0, 0
    difference = np.where(valid, depth - target, 0) / np.float32(scale)
    slope = np.clip(difference, -delta, delta)
    # slope * (difference - slope / 2) is x^2 / 2 where nothing is clipped, delta (|x| - delta / 2) elsewhere.
    per_pixel = slope * (difference - slope / 2)
    if confidence is not None:
        # What is not compared may have any confidence, NaN too.
        confidence = np.where(valid, confidence, 0)
        per_pixel, slope = per_pixel * confidence, slope * confidence
    loss = float(per_pixel.sum(dtype=np.float64)) / count
    np.multiply(slope, np.float32(weight / (count * scale)), out=gradient)
    return weight * loss, count


def depth_loss(
    depth: Float[Tensor, "*c h w"],
    alpha: Float[Tensor, "*c h w"],
    target: Float[Tensor, "*c h w"],
    *,
    scale: float,
    huber_delta: float | None,
    confidence: Float[Tensor, "*c h w"] | None = None,
) -> Float[Tensor, ""]:
    """`huber_depth_loss`, or `inverse_depth_loss` where `huber_delta` is None; see there."""
    if huber_delta is None:
        return inverse_depth_loss(depth, alpha, target, scale=scale, confidence=confidence)
    return huber_depth_loss(depth, alpha, target, scale=scale, delta=huber_delta, confidence=confidence)


def _ssim_map(x: Tensor, y: Tensor) -> Tensor:
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = window_means(x, y)
    variance_x = mean_xx - mean_x * mean_x
    variance_y = mean_yy - mean_y * mean_y
    covariance = mean_xy - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + SSIM_C1) / (mean_x * mean_x + mean_y * mean_y + SSIM_C1)
    return luminance * (2 * covariance + SSIM_C2) / (variance_x + variance_y + SSIM_C2)


def window_means(x: Float[Tensor, "n 3 h w"], y: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, ...]:
    """Of x, y, x x, y y and x y inside the window of SSIM, zeros outside the images, each [N, 3, H, W]."""
    from kornia.filters import filter2d_separable, get_gaussian_kernel1d

    taps = get_gaussian_kernel1d(
        2 * WINDOW_RADIUS_PX + 1, WINDOW_SIGMA_PX, dtype=torch.float64, device=x.device
    ).to(x.dtype)
    moments = torch.cat([x, y, x * x, y * y, x * y], dim=1)
    return tuple(filter2d_separable(moments, taps, taps, border_type="constant").split(3, dim=1))


def _check(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None,
    ssim_mask: Tensor | None,
    normalisation: float | None,
) -> None:
    if image.ndim not in (3, 4) or image.shape[-1] != 3:
        raise ShapeError(f"image has shape {tuple(image.shape)}, expected ([C,] H, W, 3)")
    if target.shape != image.shape or target.dtype != image.dtype:
        raise ShapeError(
            f"target is {target.dtype} {tuple(target.shape)}, image is {image.dtype} {tuple(image.shape)}"
        )
    for name, weights in (("mask", mask), ("ssim_mask", ssim_mask)):
        if weights is not None and (weights.shape != image.shape[:-1] or weights.dtype != image.dtype):
            raise ShapeError(
                f"{name} is {weights.dtype} {tuple(weights.shape)}, expected {image.dtype} "
                f"{tuple(image.shape[:-1])}"
            )
    check_normalisation(normalisation)


def check_normalisation(normalisation: float | None) -> None:
    """Check what weighted sums are divided by; None is fine.

    Raises:
        ConfigError: when it is not positive.
    """
    if normalisation is not None and not normalisation > 0:
        raise ConfigError(f"normalisation is {normalisation}, expected a positive number of pixels")
