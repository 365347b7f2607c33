"""Real views carried into virtual ones: by geometry, with the light's fall-off compensated.

The light rides on the camera, so a surface is darker from far away. What a real view saw of a point
tells the virtual view's colour only after the brightness ratio of the two distances is applied;
without it, references do more harm than good.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from extrags.cameras import Cameras, pixel_rays, pose_distances
from extrags.config import ReferenceChoice
from extrags.metrics.filters import filter_separable, gaussian_weights
from extrags.view_synthesis.references import LightTransfer, ReferenceViews

__all__ = [
    "Warped",
    "covisibility",
    "depth_normals",
    "fit_falloff_exponent",
    "seen_by_others",
    "warp_references",
]

AGREEMENT = 0.05
"""Relative depth difference at which the weight of a real view has fallen to a third; at 1.73 times that it
is zero."""
LATTICE_PX = 8
"""Co-visibility is judged on one pixel in this many, along each axis."""
FITTED_LATTICE_PX = 3
"""The fall-off of brightness is fitted to one pixel in this many, along each axis."""
DISTANCE_TOLERANCE = 0.2
"""Absolute log ratio of distances at which the quality of a reference falls to 1/e."""
ANGLE_TOLERANCE_RAD = 0.3
"""Angle between two viewing rays at which the quality of a reference falls to 1/e."""
GOOD_QUALITY = 0.02
"""Reference quality from which the blend replaces the rendering completely."""
HIGHLIGHT_STEP = 0.12
"""Excess brightness at which the weight of a sample, taken for a highlight, falls to 1/e."""
FAINT = 1e-3
"""Votes below it are raised together before they are squared: a mean is one however faint its samples."""
BRIGHTNESS_LIMIT = 8.0
"""Larger brightness ratios amplify noise more than they inform."""
EXPONENT_RANGE = (0.0, 3.0)
NORMAL_SIGMA_PX = 1.5
NORMAL_RADIUS_PX = 4
"""Depth is smoothed so much before normals are taken from it."""


@dataclass(frozen=True)
class Warped:
    """Real views as seen from V virtual ones.

    Args:
        nearest: the first reference, light-compensated, zero where it has no information, [V, 3, H, W].
        nearest_weight: how far it can be trusted, [V, 1, H, W].
        blend: weighted mean of the best references, zero where none has information, [V, 3, H, W].
        blend_weight: feathered trust in the blend, [V, 1, H, W].
        log_ratio: log of (distance from the references / distance from the virtual view), [V, 1, H, W].
        reference: index of the first reference among the `ReferenceViews`, [V].
        chosen: indices of the blended references, `reference` first, [V, K].
    """

    nearest: Float[Tensor, "v 3 h w"]
    nearest_weight: Float[Tensor, "v 1 h w"]
    blend: Float[Tensor, "v 3 h w"]
    blend_weight: Float[Tensor, "v 1 h w"]
    log_ratio: Float[Tensor, "v 1 h w"]
    reference: Int[Tensor, "v"]
    chosen: Int[Tensor, "v k"]


@dataclass(frozen=True)
class _Seen:
    """Samples of world points in K references."""

    rgb: Float[Tensor, "k 3 p"]
    weight: Float[Tensor, "k p"]
    quality: Float[Tensor, "k p"]
    distance: Float[Tensor, "k p"]


@dataclass(frozen=True)
class _Surface:
    """Points of a view's pixels with their normals, along the world's axes, and how the lens sees them.

    Args:
        center: of the lens, float64: points are relative to it, since far from the origin of the world
            float32 has no digits for what is near.
        points: [P, 3].
        distance: from the lens.
        direction: from it, unit.
        normal: unit.
        rotation: from the world's axes to the camera's.
    """

    center: Float[np.ndarray, "3"]
    points: Float[Tensor, "p 3"]
    distance: Float[Tensor, "p"]
    direction: Float[Tensor, "p 3"]
    normal: Float[Tensor, "p 3"]
    rotation: Float[Tensor, "3 3"]


def warp_references(
    references: ReferenceViews,
    cameras: Cameras,
    depth_mm: Float[Tensor, "v 1 h w"],
    *,
    count: int,
    reference: ReferenceChoice = "covisibility",
    exposure: Float[Tensor, "v"] | None = None,
    good_quality: float = GOOD_QUALITY,
    depth_tolerance: float = AGREEMENT,
) -> Warped:
    """Carry the `count` most co-visible references into each virtual view.

    With `reference="nearest"` the nearest by pose (`extrags.cameras.pose_distances`, in the references'
    typical distance) comes first, whatever it saw: it is then `nearest` and `reference`, and one of the
    blend; the others are the most co-visible as before.

    Args:
        references: real views with depth, exposure and the scene's light.
        cameras: the virtual views.
        depth_mm: their z-depth without gaps.
        count: references blended per view.
        reference: which of them comes first.
        exposure: gain of each virtual view; None is 1, the mean of the training frames.
        good_quality: likeness of distance and direction from which a reference is trusted completely.
        depth_tolerance: relative depth difference at which the weight of a reference falls to 1/e.

    Source: v_nn of [ExtraGS, eq. 18] with `nearest`, see docs/references.md.
    """
    scores = covisibility(references, cameras, depth_mm, depth_tolerance)
    if reference == "nearest":
        apart = pose_distances(cameras, references.cameras, references.transfer.scale_mm)
        scores[torch.arange(len(cameras)), torch.from_numpy(apart.argmin(axis=1))] = torch.inf
    chosen = torch.argsort(scores, dim=1, descending=True, stable=True)[:, : min(count, len(references))]
    gain = torch.ones(len(cameras)) if exposure is None else exposure
    parts = [
        _warp_one(
            references,
            cameras[view],
            depth_mm[view],
            chosen[view],
            gain[view],
            good_quality,
            depth_tolerance,
        )
        for view in range(len(cameras))
    ]
    nearest, nearest_weight, blend, blend_weight, log_ratio = (
        torch.stack(group) for group in zip(*parts, strict=True)
    )
    return Warped(nearest, nearest_weight, blend, blend_weight, log_ratio, chosen[:, 0], chosen)


def covisibility(
    references: ReferenceViews,
    cameras: Cameras,
    depth_mm: Float[Tensor, "v 1 h w"],
    depth_tolerance: float = AGREEMENT,
) -> Float[Tensor, "v r"]:
    """How much of each virtual view each reference has seen well, in [0, 1].

    The mean over a lattice of pixels of depth agreement, inside-the-image trust, and likeness of
    distance and direction.
    """
    everything = torch.arange(len(references))
    rows = []
    for view in range(len(cameras)):
        seen = _look_up(
            references, everything, _surface(cameras[view], depth_mm[view], LATTICE_PX), depth_tolerance
        )
        rows.append((seen.weight * seen.quality).mean(dim=1))
    return torch.stack(rows)


def _warp_one(
    references: ReferenceViews,
    camera: Cameras,
    depth_mm: Float[Tensor, "1 h w"],
    chosen: Int[Tensor, "k"],
    gain: Float[Tensor, ""],
    good_quality: float,
    depth_tolerance: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    size = depth_mm.shape[-2:]
    here = _surface(camera, depth_mm, 1)
    seen = _look_up(references, chosen, here, depth_tolerance)
    rgb = _relit(references, chosen, here, seen, gain)
    trust = seen.weight * (seen.quality / good_quality).clamp(max=1)
    # Squared, because the mean of many views is blurred: the good ones shall dominate.
    votes = _above_rounding(seen.weight * seen.quality).square()
    luminance = rgb.mean(dim=1)
    first = _weighted(luminance, votes)
    votes = votes * torch.exp(-((luminance - first).clamp_min(0) / HIGHLIGHT_STEP).square())
    blend = _weighted(rgb, votes[:, None])
    log_ratio = _weighted((seen.distance / here.distance).log(), votes)
    shaped = (
        rgb[0] * (trust[:1] > 0),
        trust[:1],
        blend,
        trust.max(dim=0, keepdim=True).values,
        log_ratio[None],
    )
    nearest, nearest_weight, blended, blend_weight, ratios = (part.reshape(-1, *size) for part in shaped)
    return nearest, nearest_weight, blended, blend_weight, ratios


def _relit(
    references: ReferenceViews, chosen: Int[Tensor, "k"], here: _Surface, seen: _Seen, gain: Float[Tensor, ""]
) -> Float[Tensor, "k 3 p"]:
    """Colours of other views, as bright as this one shows them."""
    transfer = references.transfer
    centers = references.cameras.centers[chosen.numpy()] - here.center
    shifts = torch.from_numpy(centers.astype(np.float32))
    own = transfer.falloff(*_from_lamp(here, here.rotation[None], torch.zeros(1, 3), transfer.lamp_position))
    theirs = transfer.falloff(
        *_from_lamp(here, references.viewmats[chosen, :3, :3], shifts, transfer.lamp_position)
    )
    ratio = own / theirs * (gain / references.exposure[chosen])[:, None]
    ratio = ratio.clamp(1 / BRIGHTNESS_LIMIT, BRIGHTNESS_LIMIT)
    rgb = transfer.apply_response(transfer.invert_response(seen.rgb, 1) * ratio[:, None], 1)
    # Too bright for the sensor: darkened as a whole, so that the hue stays.
    return rgb / rgb.amax(dim=1, keepdim=True).clamp_min(1)


def _from_lamp(
    surface: _Surface,
    rotation: Float[Tensor, "k 3 3"],
    centers: Float[Tensor, "k 3"],
    lamp: Float[Tensor, "3"],
) -> tuple[Float[Tensor, "k p"], Float[Tensor, "k p"], Float[Tensor, "k p"]]:
    """Distance of a surface from the lamps of K cameras, and cosines of the light to axis and normal.

    Args:
        surface: points and normals.
        rotation: from the world's axes to the cameras'.
        centers: of their lenses, relative to that of the surface's own view.
        lamp: beside the lens, in camera axes and world units.
    """
    away = surface.points - (centers + lamp @ rotation)[:, None]
    distance = away.norm(dim=-1).clamp_min(1e-9)
    axis_cosine = torch.einsum("kpi,ki->kp", away, rotation[:, 2]) / distance
    return distance, axis_cosine, (away * surface.normal).sum(dim=-1) / distance


def seen_by_others(
    views: ReferenceViews,
    camera: Cameras,
    depth_mm: Float[Tensor, "1 h w"],
    chosen: Int[Tensor, "k"],
    *,
    gain: Float[Tensor, ""],
    depth_tolerance: float,
) -> tuple[Float[Tensor, "k 3 h w"], Float[Tensor, "k h w"]]:
    """What chosen views show of a view's surface, as bright as it would, one by one.

    Args:
        views: any views with depth and trust.
        camera: the view.
        depth_mm: its z-depth without gaps.
        chosen: indices of the others.
        gain: exposure of the view.
        depth_tolerance: relative depth difference at which a weight falls to 1/e.

    Returns:
        Colours, and weights: trust times agreement of depth times likeness of distance and direction.
    """
    size = depth_mm.shape[-2:]
    here = _surface(camera, depth_mm, 1)
    seen = _look_up(views, chosen, here, depth_tolerance)
    rgb = _relit(views, chosen, here, seen, gain)
    return rgb.reshape(-1, 3, *size), (seen.weight * seen.quality).reshape(-1, *size)


def _weighted(values: Tensor, votes: Tensor) -> Tensor:
    return (values * votes).sum(dim=0) / votes.sum(dim=0).clamp_min(1e-12)


def _above_rounding(votes: Float[Tensor, "k p"]) -> Float[Tensor, "k p"]:
    """The same proportions; faint ones are raised to where their squares still give a mean."""
    most = votes.amax(dim=0)
    return votes / torch.where((most > 0) & (most < FAINT), most, torch.ones(()))


def _surface(camera: Cameras, depth_mm: Float[Tensor, "1 h w"], stride: int) -> _Surface:
    down, along = (_lattice(size, stride) for size in (camera.height, camera.width))
    rays = torch.from_numpy(pixel_rays(camera)[0, down, along].astype(np.float32))
    offsets = (rays * depth_mm[0, down, along, None]).reshape(-1, 3)
    distance = offsets.norm(dim=-1).clamp_min(1e-9)
    normal = depth_normals(_camera_rays(camera), depth_mm)[down, along].reshape(-1, 3)
    rotation = torch.from_numpy(camera.viewmats[0, :3, :3].astype(np.float32))
    direction = offsets / distance[:, None]
    return _Surface(camera.centers[0], offsets, distance, direction, normal, rotation)


def _lattice(size: int, stride: int) -> slice:
    """One pixel in `stride` along an axis; the middle one of an axis that is too short for that."""
    offset = stride // 2
    return slice(offset if offset < size else (size - 1) // 2, None, stride)


def depth_normals(rays: Float[Tensor, "h w 3"], depth_mm: Float[Tensor, "1 h w"]) -> Float[Tensor, "h w 3"]:
    """Unit normals of the surface that a depth map without gaps describes, in the rays' frame.

    Differences over a few pixels: what a lamp shades is the wall, not the roughness of a rendered depth. They
    are exact on planes, up to the border of the image; along an axis with a single pixel the surface is taken
    to face the camera.

    Args:
        rays: of each pixel, at unit z-depth.
        depth_mm: z-depth.

    Returns:
        Normals that point away from the camera.
    """
    window = gaussian_weights(NORMAL_SIGMA_PX, NORMAL_RADIUS_PX)
    inverse = 1 / depth_mm[0].clamp_min(1e-9)
    # Of a plane it is linear along rows and columns. Beside a step the line may fall below zero.
    inverse = filter_separable(inverse, window, window, "linear").clamp(inverse.min(), inverse.max())
    points = rays / inverse[..., None]
    along, down = _differences(points, 1), _differences(points, 0)
    if points.shape[1] == 1:
        along = torch.linalg.cross(down, rays)
    if points.shape[0] == 1:
        down = torch.linalg.cross(rays, along)
    normal = torch.linalg.cross(along, down) if points.shape[:2] != (1, 1) else rays
    unit: Tensor = normal / normal.norm(dim=-1, keepdim=True).clamp_min(1e-20)
    return unit


def _differences(points: Float[Tensor, "h w 3"], axis: int) -> Float[Tensor, "h w 3"]:
    """Differences per two pixels, of second order at the border too; zero along an axis with one pixel."""
    size = points.shape[axis]
    if size == 1:
        return torch.zeros_like(points)
    (slope,) = torch.gradient(points, dim=axis, edge_order=2 if size > 2 else 1)
    return 2 * slope


def _camera_rays(camera: Cameras) -> Float[Tensor, "h w 3"]:
    """Rays of a single camera in the world's frame, at unit z-depth."""
    return torch.from_numpy(pixel_rays(camera)[0].astype(np.float32))


def _look_up(
    references: ReferenceViews,
    chosen: Int[Tensor, "k"],
    surface: _Surface,
    depth_tolerance: float = AGREEMENT,
) -> _Seen:
    """Colour and trust of a surface in the chosen references."""
    points = surface.points
    index = chosen.numpy()
    rotation = references.viewmats[chosen, :3, :3]
    centers = torch.from_numpy((references.cameras.centers[index] - surface.center).astype(np.float32))
    K = references.K[chosen]
    shift = torch.einsum("kij,kj->ki", rotation, centers)
    local = torch.einsum("kij,pj->kpi", rotation, points) - shift[:, None]
    z = local[..., 2]
    in_front = z > 1e-6
    safe = torch.where(in_front, z, torch.ones(()))
    u = local[..., 0] / safe * K[:, 0, 0, None] + K[:, 0, 2, None]
    v = local[..., 1] / safe * K[:, 1, 1, None] + K[:, 1, 2, None]
    width, height = references.cameras.width, references.cameras.height
    # Pixel centres at +0.5 and align_corners=False are the same convention.
    grid = torch.stack([2 * u / width - 1, 2 * v / height - 1], dim=-1)[:, None].clamp(-4, 4)
    # Without a copy where all are asked for in their order.
    everything = np.array_equal(index, np.arange(len(references)))
    image = references.packed if everything else references.packed[chosen]
    sampled = functional.grid_sample(image, grid, mode="bilinear", align_corners=False)[:, :, 0]
    # The inverse depth is linear across a plane; between a fold and what it hides it agrees with neither.
    known = sampled[:, 5] > 0.999
    inverse = torch.where(known, sampled[:, 4], torch.ones(()))
    difference = (z * inverse - 1).abs()
    agreement = torch.exp(-(difference / depth_tolerance).square())
    agreement = ((agreement - 0.05) / 0.95).clamp_min(0)
    weight = torch.where(in_front & known, agreement * sampled[:, 3], torch.zeros(()))
    away = points - centers[:, None]
    seen_from = away.norm(dim=-1).clamp_min(1e-9)
    cosine = ((away / seen_from[..., None]) * surface.direction).sum(dim=-1).clamp(-1, 1)
    quality = torch.exp(
        -(seen_from / surface.distance).log().abs() / DISTANCE_TOLERANCE
        - (torch.arccos(cosine) / ANGLE_TOLERANCE_RAD).square()
    )
    return _Seen(sampled[:, :3], weight, quality, seen_from)


def fit_falloff_exponent(references: ReferenceViews, *, pairs: int = 24) -> float:
    """Exponent a of `brightness ~ distance^-a` from co-visible pixels of the real views themselves.

    For scenes without a light model. A robust line through log-brightness ratio against log-distance
    ratio: iteratively reweighted least squares with Huber's weights, each pair of views with an offset of
    its own for its exposure.

    Args:
        references: real views; their `transfer` is not used.
        pairs: how many neighbouring pairs are looked at.

    Returns:
        The exponent, within 0 and 3; 0 when the views show no common surface at different distances.
    """
    count = len(references)
    if count < 2:
        return 0.0
    slopes: list[Tensor] = []
    size = references.cameras.height, references.cameras.width
    down, along = (_lattice(pixels, FITTED_LATTICE_PX) for pixels in size)
    for first in np.unique(np.linspace(0, count - 2, min(pairs, count - 1)).round().astype(int)):
        seconds = [s for s in (first + 1, first + 3) if s < count]
        camera = references.cameras[[int(first)]]
        inverse = references.packed[first, 4:5]
        depth = torch.where(inverse > 0, 1 / inverse.clamp_min(1e-12), torch.zeros(()))
        surface = _surface(camera, depth, FITTED_LATTICE_PX)
        own = references.packed[first, :3, down, along].reshape(3, -1).mean(dim=0)
        trusted = references.packed[first, 3, down, along].reshape(-1)
        for second in seconds:
            seen = _look_up(references, torch.tensor([second]), surface)
            other = seen.rgb[0].mean(dim=0)
            good = _informative(own, other, trusted * seen.weight[0])
            if int(good.sum()) < 30:
                continue
            x = (seen.distance[0][good] / surface.distance[good]).log()
            y = (own[good] / other[good]).log()
            slopes.append(torch.stack([x - x.median(), y - y.median()]))
    if not slopes:
        return 0.0
    x, y = torch.cat(slopes, dim=1).double()
    if float(x.square().mean()) < 1e-5:
        return 0.0
    weight = torch.ones_like(x)
    slope = torch.zeros((), dtype=torch.float64)
    for _ in range(20):
        slope = (weight * x * y).sum() / (weight * x * x).sum().clamp_min(1e-12)
        residual = (y - slope * x).abs()
        threshold = 1.5 * residual.median().clamp_min(1e-6)
        weight = (threshold / residual.clamp_min(1e-12)).clamp(max=1)
    return float(slope.clamp(*EXPONENT_RANGE))


def _informative(own: Tensor, other: Tensor, trust: Tensor) -> Bool[Tensor, "p"]:
    """Pixels that are neither dark (noise) nor bright (highlights, saturation) in either view."""
    well_lit = (own > 0.08) & (own < 0.9) & (other > 0.08) & (other < 0.9)
    return well_lit & (trust > 0.3)


def with_fitted_transfer(references: ReferenceViews) -> ReferenceViews:
    """References whose brightness ratio is fitted to them, for scenes without a light model."""
    exponent = fit_falloff_exponent(references)
    return references.with_transfer(LightTransfer(None, exponent, references.transfer.scale_mm))
