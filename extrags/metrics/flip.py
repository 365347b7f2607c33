"""LDR-FLIP: perceived difference between two images that are shown alternately; needs no weights.

Source: Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström, Fairchild: FLIP: A Difference Evaluator
for Alternating Images, Proc. ACM Comput. Graph. Interact. Tech. 3(2), 2020. The section numbers below
are the paper's.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.errors import ConfigError, ShapeError
from extrags.metrics.filters import filter_figures, gaussian_weights
from extrags.metrics.image import channels_first, mean_of_known, means_in_regions, means_per_image

__all__ = ["PIXELS_PER_DEGREE", "flip", "flip_in_regions", "flip_map"]

PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * math.pi / 180
"""The paper's default viewer: 0.7 m from a 0.7 m wide display of 3840 pixels, 67 px per degree."""

# Section 4.1.1, table 1: contrast sensitivity as sums of Gaussians a sqrt(pi/b) exp(-pi^2 x^2 / b),
# x in degrees, for the achromatic, red-green and blue-yellow channel.
_SENSITIVITY: tuple[tuple[tuple[float, float], ...], ...] = (
    ((1.0, 0.0047),),
    ((1.0, 0.0053),),
    ((34.1, 0.04), (13.5, 0.025)),
)
_COLOR_EXPONENT = 0.7  # q_c, section 4.1.3
_COLOR_KNEE = 0.4  # p_c
_COLOR_KNEE_VALUE = 0.95  # p_t
_FEATURE_WIDTH_DEG = 0.082  # w, section 4.2
_FEATURE_EXPONENT = 0.5  # q_f

# CIE 1931 chromaticities of the sRGB primaries and of its white, D65 (IEC 61966-2-1).
_PRIMARIES_XY = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
_WHITE_XY = (0.3127, 0.3290)
_LAB_THRESHOLD = (6 / 29) ** 3


def flip(
    render: Float[Tensor, "*b h w 3"],
    target: Float[Tensor, "*b h w 3"],
    mask: Bool[Tensor, "*b h w"] | None = None,
    *,
    pixels_per_degree: float = PIXELS_PER_DEGREE,
) -> float | None:
    """Mean FLIP error, mean over the images of the mean inside the mask; see `flip_map`.

    Returns:
        A value in [0, 1], or None when no image has a pixel that counts.
    """
    error = flip_map(render, target, pixels_per_degree=pixels_per_degree)
    return mean_of_known(means_per_image(error, mask))


def flip_map(
    render: Float[Tensor, "*b h w 3"],
    target: Float[Tensor, "*b h w 3"],
    *,
    pixels_per_degree: float = PIXELS_PER_DEGREE,
) -> Float[Tensor, "*b h w"]:
    """FLIP error of each pixel, in [0, 1]; 0 where the images look the same.

    Args:
        render: sRGB-encoded images in [0, 1]; values outside are clamped.
        target: sRGB-encoded images in [0, 1].
        pixels_per_degree: resolution for the viewer, in pixels per degree of visual angle.

    Raises:
        ShapeError: when the images differ in shape.
        ConfigError: for a resolution that is not positive.
    """
    from kornia.color import rgb_to_linear_rgb

    if render.shape != target.shape or render.shape[-1:] != (3,):
        raise ShapeError(
            f"FLIP compares images [..., H, W, 3]; found {tuple(render.shape)} and {tuple(target.shape)}"
        )
    if not pixels_per_degree > 0:
        raise ConfigError(f"pixels_per_degree must be positive, found {pixels_per_degree}")
    batch = render.shape[:-1]
    first, second = (
        _opponent_from_linear(rgb_to_linear_rgb(channels_first(image).clamp(0, 1)))
        for image in (render, target)
    )
    color = _color_difference(first, second, pixels_per_degree)
    feature = _feature_difference(first[:, 0], second[:, 0], pixels_per_degree)
    # Section 4.3; 0 ** 0 is 1 in torch, but equal colours are no error whatever the features say.
    return torch.where(color > 0, color ** (1 - feature), 0.0).reshape(batch)


flip_in_regions = means_in_regions(flip_map)
"""FLIP of each image inside each region; see `flip`."""


def _color_difference(
    first: Float[Tensor, "n 3 h w"], second: Float[Tensor, "n 3 h w"], pixels_per_degree: float
) -> Float[Tensor, "n h w"]:
    first, second = (
        _hunt_adjusted_lab(_linear_from_opponent(_sensitivity_filtered(image, pixels_per_degree)).clamp(0, 1))
        for image in (first, second)
    )
    difference = _hyab(first, second) ** _COLOR_EXPONENT
    largest = _max_color_difference()
    knee = _COLOR_KNEE * largest
    return torch.where(
        difference < knee,
        _COLOR_KNEE_VALUE / knee * difference,
        _COLOR_KNEE_VALUE + (difference - knee) / (largest - knee) * (1 - _COLOR_KNEE_VALUE),
    ).clamp(0, 1)


def _sensitivity_filtered(
    opponent: Float[Tensor, "n 3 h w"], pixels_per_degree: float
) -> Float[Tensor, "n 3 h w"]:
    widest = max(b for terms in _SENSITIVITY for _, b in terms)
    radius = math.ceil(3 * math.sqrt(widest / (2 * math.pi**2)) * pixels_per_degree)
    channels = []
    for channel, terms in enumerate(_SENSITIVITY):
        blurred = torch.zeros_like(opponent[:, channel])
        total = 0.0
        for a, b in terms:
            sigma = math.sqrt(b / (2 * math.pi**2)) * pixels_per_degree
            # The weight of this Gaussian within the sampled sum, before the sum is normalised to one.
            mass = sum(math.exp(-0.5 * (offset / sigma) ** 2) for offset in range(-radius, radius + 1))
            share = a * math.sqrt(math.pi / b) * mass**2
            weights = gaussian_weights(sigma, radius)
            blurred = blurred + share * filter_figures(opponent[:, channel], weights, weights, "replicate")
            total += share
        channels.append(blurred / total)
    return torch.stack(channels, dim=1)


def _feature_difference(
    first: Float[Tensor, "n h w"], second: Float[Tensor, "n h w"], pixels_per_degree: float
) -> Float[Tensor, "n h w"]:
    # Section 4.2: edges and points on the achromatic channel brought to [0, 1].
    strengths = [_feature_strengths((image + 16) / 116, pixels_per_degree) for image in (first, second)]
    edges = (strengths[0][0] - strengths[1][0]).abs()
    points = (strengths[0][1] - strengths[1][1]).abs()
    return (torch.maximum(edges, points) / math.sqrt(2)).clamp(0, 1) ** _FEATURE_EXPONENT


def _feature_strengths(
    achromatic: Float[Tensor, "n h w"], pixels_per_degree: float
) -> tuple[Float[Tensor, "n h w"], Float[Tensor, "n h w"]]:
    smooth, slope, bump = _feature_weights(pixels_per_degree)

    def strength(detector: tuple[float, ...]) -> Tensor:
        along_x = filter_figures(achromatic, detector, smooth, "replicate")
        along_y = filter_figures(achromatic, smooth, detector, "replicate")
        return torch.hypot(along_x, along_y)

    return strength(slope), strength(bump)


@lru_cache(maxsize=8)
def _feature_weights(
    pixels_per_degree: float,
) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    sigma = 0.5 * _FEATURE_WIDTH_DEG * pixels_per_degree
    radius = math.ceil(3 * sigma)
    x = torch.arange(-radius, radius + 1, dtype=torch.float64)
    gaussian = torch.exp(-0.5 * (x / sigma).square())
    slope = -x * gaussian
    bump = ((x / sigma).square() - 1) * gaussian
    # Positive weights sum to 1 and negative ones to -1. The kernels are a detector times a positive
    # Gaussian, so that the normalisation of the plane splits into those of the two rows.
    scaled = [
        torch.where(kernel > 0, kernel / kernel.clamp_min(0).sum(), -kernel / kernel.clamp_max(0).sum())
        for kernel in (slope, bump)
    ]
    return (
        gaussian_weights(sigma, radius),
        tuple(scaled[0].tolist()),
        tuple(scaled[1].tolist()),
    )


def _hyab(first: Float[Tensor, "n 3 *s"], second: Float[Tensor, "n 3 *s"]) -> Float[Tensor, "n *s"]:
    # City-block in lightness, Euclidean in the plane of hue and chroma (section 4.1.2).
    difference = first - second
    return difference[:, 0].abs() + torch.hypot(difference[:, 1], difference[:, 2])


@lru_cache(maxsize=1)
def _max_color_difference() -> float:
    # The largest HyAB distance within sRGB is between green and blue (section 4.1.3).
    green, blue = torch.tensor([[[0.0, 1.0, 0.0]], [[0.0, 0.0, 1.0]]], dtype=torch.float64)[..., None, None]
    distance = float(_hyab(_hunt_adjusted_lab(green), _hunt_adjusted_lab(blue)))
    return math.pow(distance, _COLOR_EXPONENT)


def _hunt_adjusted_lab(linear: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    relative = _mixed(linear, _xyz_from_linear() / _white_xyz()[:, None])
    response = torch.where(
        relative > _LAB_THRESHOLD,
        relative.clamp_min(_LAB_THRESHOLD) ** (1 / 3),
        relative / (3 * (6 / 29) ** 2) + 4 / 29,
    )
    lightness = 116 * response[:, 1] - 16
    # Hunt effect: colours look less colourful in the dark.
    chroma = 0.01 * lightness
    a = 500 * (response[:, 0] - response[:, 1]) * chroma
    b = 200 * (response[:, 1] - response[:, 2]) * chroma
    return torch.stack([lightness, a, b], dim=1)


def _opponent_from_linear(linear: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    # YCxCz, CIELAB without its cube root, so that filtering is linear in light (section 4.1.1).
    offset = linear.new_tensor([-16.0, 0.0, 0.0])[:, None, None]
    return _mixed(linear, _opponent_matrix()) + offset


def _linear_from_opponent(opponent: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    offset = opponent.new_tensor([16.0, 0.0, 0.0])[:, None, None]
    return _mixed(opponent + offset, torch.linalg.inv(_opponent_matrix()))


@lru_cache(maxsize=1)
@torch.inference_mode(False)
def _opponent_matrix() -> Float[Tensor, "3 3"]:
    opponent_from_relative = torch.tensor(
        [[0.0, 116.0, 0.0], [500.0, -500.0, 0.0], [0.0, 200.0, -200.0]], dtype=torch.float64
    )
    return opponent_from_relative @ (_xyz_from_linear() / _white_xyz()[:, None])


@lru_cache(maxsize=1)
@torch.inference_mode(False)
def _xyz_from_linear() -> Float[Tensor, "3 3"]:
    primaries = torch.tensor([[x / y, 1.0, (1 - x - y) / y] for x, y in _PRIMARIES_XY], dtype=torch.float64).T
    luminances: Tensor = torch.linalg.solve(primaries, _white_xyz())
    return primaries * luminances


def _white_xyz() -> Float[Tensor, "3"]:
    x, y = _WHITE_XY
    return torch.tensor([x / y, 1.0, (1 - x - y) / y], dtype=torch.float64)


def _mixed(channels: Float[Tensor, "n 3 h w"], matrix: Float[Tensor, "3 3"]) -> Float[Tensor, "n 3 h w"]:
    n, _, height, width = channels.shape
    return (matrix.to(channels) @ channels.reshape(n, 3, -1)).reshape(n, 3, height, width)
