"""Input of the restorer: observations of a virtual view, and the base image derived from them.

`Layers` are the raw observations of a view: what the scene renders there, how far it can be trusted, and
what real views say. They are what pairs keep and what augmentation cuts holes into. `condition` turns
them into the network's channels and its base image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrags.cameras import Cameras, pixel_rays
from extrags.config import ReferenceChoice
from extrags.errors import ShapeError
from extrags.metrics.filters import filter_separable, gaussian_weights
from extrags.scene import Scene
from extrags.threads import in_threads
from extrags.thresholds import HOLE_ALPHA
from extrags.view_synthesis.filling import completed_depth, push_pull
from extrags.view_synthesis.references import SEEN_WEIGHT, LightTransfer, ReferenceViews
from extrags.view_synthesis.warp import warp_references

__all__ = [
    "CONDITION_CHANNELS",
    "INVENTED_CHANNELS",
    "LAYER_CHANNELS",
    "Conditioning",
    "Layers",
    "condition",
    "feathered",
    "filled_depth",
    "known_share",
    "observe_views",
]

_SLICES = {
    "rendered": slice(0, 3),
    "alpha": slice(3, 4),
    "depth_mm": slice(4, 5),
    "spread": slice(5, 6),
    "uncertainty": slice(6, 7),
    "nearest": slice(7, 10),
    "nearest_weight": slice(10, 11),
    "blend": slice(11, 14),
    "blend_weight": slice(14, 15),
    "log_ratio": slice(15, 16),
    "ray_length": slice(16, 17),
    "invented": slice(17, 20),
    "invented_weight": slice(20, 21),
}
LAYER_CHANNELS = 21
CONDITION_CHANNELS = 20
INVENTED_CHANNELS = 4
"""Further channels of a network that is told apart what was invented from what real views saw."""

COLOR_CENTER = 0.35
COLOR_SCALE = 0.45
"""Colours reach the network as (colour - center) / scale: near zero mean and unit deviation."""

SPREAD_LIMIT = 0.3
"""Relative depth spread within a pixel at which nothing of its colour is trusted."""
NEW_ANGLE_RAD = 0.9
"""Angle to the nearest training ray at which a Gaussian's colour is worth 1/e."""
FALLOFF_LIMIT = 20.0
"""Filled colours are not brightened or darkened beyond this factor of the light's reference."""


@dataclass(frozen=True)
class Layers:
    """Raw observations of V virtual views.

    Args:
        data: [V, 21, H, W]: `rendered` (3; black behind), `alpha`, `depth_mm` (0 where nothing was hit),
            `spread` (relative deviation of depth within a pixel), `uncertainty`, `nearest` (3) and its
            weight, `blend` (3) and its weight, `log_ratio` of distances, `ray_length` (distance per
            z-depth), `invented` (3; what restored keyframes show of surfaces that nothing else knows) and
            its weight, zero where there is none.

    Raises:
        ShapeError: for another number of channels.
    """

    data: Float[Tensor, "v c h w"]

    def __post_init__(self) -> None:
        if self.data.ndim != 4 or self.data.shape[1] != LAYER_CHANNELS:
            raise ShapeError(f"layers need [V, {LAYER_CHANNELS}, H, W], found {tuple(self.data.shape)}")

    def __len__(self) -> int:
        return int(self.data.shape[0])

    def __getitem__(self, index: int | slice | list[int] | Int[np.ndarray, "n"]) -> Layers:
        """Select views; an integer keeps the batch axis."""
        chosen = np.atleast_1d(np.arange(len(self))[index])
        return Layers(self.data[torch.from_numpy(chosen)])

    def get(self, name: str) -> Float[Tensor, "v c h w"]:
        """A layer by name, as a view into the data."""
        return self.data[:, _SLICES[name]]

    @staticmethod
    def of(**layers: Tensor) -> Layers:
        """Layers from named parts.

        Raises:
            ShapeError: when a part is missing.
        """
        missing = sorted(set(_SLICES) - set(layers))
        if missing:
            raise ShapeError(f"layers miss {', '.join(missing)}")
        return Layers(torch.cat([layers[name] for name in _SLICES], dim=1))


@dataclass(frozen=True)
class Conditioning:
    """Network input and starting image of V views.

    Args:
        channels: [V, 20, H, W]; [V, 24, H, W] with invented references apart.
        base: blend of real views where they see the surface, else the rendering, else what keyframes have
            invented, holes filled; in [0, 1], [V, 3, H, W].
        depth_mm: z-depth without gaps, [V, 1, H, W].
    """

    channels: Float[Tensor, "v c h w"]
    base: Float[Tensor, "v 3 h w"]
    depth_mm: Float[Tensor, "v 1 h w"]


@dataclass(frozen=True)
class Observation:
    """Layers of views together with the references they were given.

    Args:
        layers: raw observations.
        reference: index (among the references) of the first reference of each view, [V].
        seen: which Gaussians each view sees, [V, N].
    """

    layers: Layers
    reference: Int[Tensor, "v"]
    seen: Tensor


def observe_views(
    scene: Scene,
    references: ReferenceViews,
    cameras: Cameras,
    *,
    count: int,
    reference: ReferenceChoice = "covisibility",
    exposure: Float[Tensor, "v"] | None = None,
) -> Observation:
    """Render virtual views and carry real ones into them.

    Two rasterisations per view: colour with depth, then what is known about each Gaussian from this
    direction and distance together with the square of its depth. Colours of Gaussians that training views
    hardly determine are drawn towards their neighbours' (`extrags.view_synthesis.shrinkage`).

    Args:
        scene: the reconstruction.
        references: real views of this scene.
        cameras: the virtual views.
        count: references blended per view.
        reference: which of them comes first, as `warp_references`.
        exposure: gain of each view; None is 1.
    """
    # Blending weights and median depth come from the native kernels.
    scene = scene.to("cpu")
    shown = references.shown(scene)

    def observe(view: int) -> Observation:
        gain = None if exposure is None else exposure[[view]]
        return _observe_one(scene, shown, references, cameras[view], count, reference, gain)

    parts = in_threads(observe, range(len(cameras)))
    return Observation(
        Layers(torch.cat([part.layers.data for part in parts])),
        torch.cat([part.reference for part in parts]),
        torch.cat([part.seen for part in parts]),
    )


def _observe_one(
    scene: Scene,
    shown: Scene,
    references: ReferenceViews,
    camera: Cameras,
    count: int,
    reference: ReferenceChoice,
    exposure: Float[Tensor, "1"] | None,
) -> Observation:
    scale = references.transfer.scale_mm
    with torch.no_grad():
        rendering = shown.render(camera, exposure=exposure, visibility=True, median_depth=True)
        if rendering.visibility_max is None or rendering.median_depth is None:
            raise ShapeError("the rasteriser returned neither visibility nor median depth")
        alpha = rendering.alpha[:, None]
        expected = rendering.depth[:, None]
        median = rendering.median_depth[:, None]
        # The expected depth floats between a fold and what is behind it, the median sits on one of them.
        depth = torch.where((median > 0) & (alpha > HOLE_ALPHA), median, expected)
        depth = torch.where(alpha > 0.02, depth, torch.zeros(()))
        complete = completed_depth(depth, alpha, scale)
        warped = warp_references(
            references, camera, complete, count=count, reference=reference, exposure=exposure
        )
        known, spread = _known_and_spread(scene, references, camera, warped.chosen[0], alpha, expected)
        ray_length = torch.from_numpy(np.linalg.norm(pixel_rays(camera), axis=-1).astype(np.float32)[:, None])
    layers = Layers.of(
        rendered=rendering.rgb.permute(0, 3, 1, 2).clamp(0, 1),
        alpha=alpha,
        depth_mm=depth,
        spread=spread,
        uncertainty=(1 - known * (1 - spread / SPREAD_LIMIT).clamp_min(0)).clamp(0, 1),
        nearest=warped.nearest,
        nearest_weight=warped.nearest_weight,
        blend=warped.blend * (warped.blend_weight > 0),
        blend_weight=feathered(warped.blend_weight),
        log_ratio=warped.log_ratio * (warped.blend_weight > 0),
        ray_length=ray_length,
        invented=torch.zeros_like(warped.blend),
        invented_weight=torch.zeros_like(alpha),
    )
    return Observation(layers, warped.reference, rendering.visibility_max > SEEN_WEIGHT)


def _known_and_spread(
    scene: Scene,
    references: ReferenceViews,
    camera: Cameras,
    chosen: Int[Tensor, "k"],
    alpha: Float[Tensor, "1 1 h w"],
    expected: Float[Tensor, "1 1 h w"],
) -> tuple[Float[Tensor, "1 1 h w"], Float[Tensor, "1 1 h w"]]:
    r"""How much of each pixel the real views have confirmed, and how far its depths scatter.

    A Gaussian is known from a virtual view as far as some reference saw it from a near direction and from
    no farther away: :math:`\max_r s_{rn} \, e^{-(\theta / \theta_0)^2} \min(1, d_v / d_r)`. Blended like a
    colour this gives a share of the pixel that also falls with its opacity.
    """
    means = scene.gaussians.means
    center = torch.from_numpy(camera.centers[0].astype(np.float32))
    towards = means - center
    distance = towards.norm(dim=-1).clamp_min(1e-9)
    away = means[None] - references.centers[chosen][:, None]
    seen_from = away.norm(dim=-1).clamp_min(1e-9)
    cosine = torch.einsum("kni,ni->kn", away, towards) / (seen_from * distance)
    angle = torch.arccos(cosine.clamp(-1, 1))
    worth = torch.exp(-(angle / NEW_ANGLE_RAD).square()) * (distance / seen_from).clamp(max=1)
    known = (worth * references.seen[chosen]).max(dim=0).values
    viewmat = torch.from_numpy(camera.viewmats[0].astype(np.float32))
    scale = references.transfer.scale_mm
    z = (means @ viewmat[2, :3] + viewmat[2, 3]) / scale
    blended, _ = scene.render_attributes(camera, torch.stack([known, z.square()], dim=-1))
    blended = blended[:, None]
    share = blended[..., 0].clamp(0, 1)
    mean = expected / scale
    second = blended[..., 1] / alpha.clamp_min(1e-6)
    variance = (second - mean.square()).clamp_min(0)
    spread = variance.sqrt() / mean.clamp_min(1e-6)
    return share, torch.where(alpha > 0.02, spread, torch.zeros(())).clamp(0, 1)


def condition(layers: Layers, transfer: LightTransfer, *, folded: bool = True) -> Conditioning:
    """Channels and base image from raw layers.

    Gaps are filled with the light divided out, so that a filled surface gets darker with its distance as
    its surroundings do.

    Args:
        layers: raw observations, possibly with holes cut into them.
        transfer: how brightness changes with distance.
        folded: invented references appear as a blend of real views would, for a network that knows no
            others. False gives the blend of real views alone, and `INVENTED_CHANNELS` more channels.
    """
    depth = filled_depth(layers, transfer.scale_mm)
    falloff = transfer.falloff(depth * layers.get("ray_length"), 1 / layers.get("ray_length"))
    falloff = falloff.clamp(1 / FALLOFF_LIMIT, FALLOFF_LIMIT)
    weight = layers.get("blend_weight")
    known, invented_weight = known_share(layers), layers.get("invented_weight")
    color = weight * layers.get("blend") + (1 - weight) * layers.get("rendered")
    # Without an invented reference these sums add zero: every bit stays.
    color = color + invented_weight * layers.get("invented")
    known = known + invented_weight
    # However faint the evidence is, it has a colour of its own.
    solid = _within_range(color / known.clamp_min(torch.finfo(known.dtype).tiny))
    base = _within_range(
        transfer.apply_response(push_pull(transfer.invert_response(solid, 1) / falloff, known) * falloff, 1)
    )
    blend = _normalised(layers.get("blend")) * weight
    invented = _normalised(layers.get("invented")) * invented_weight
    channels = [
        _normalised(layers.get("rendered")),
        layers.get("alpha"),
        (depth / transfer.scale_mm).log(),
        layers.get("spread") / SPREAD_LIMIT,
        layers.get("uncertainty"),
        _normalised(layers.get("nearest")) * layers.get("nearest_weight"),
        layers.get("nearest_weight"),
        blend + invented if folded else blend,
        weight + invented_weight if folded else weight,
        layers.get("log_ratio"),
        falloff.log(),
        _normalised(base),
    ]
    if not folded:
        channels += [invented, invented_weight]
    return Conditioning(torch.cat(channels, dim=1), base, depth)


def known_share(layers: Layers) -> Float[Tensor, "v 1 h w"]:
    """How far real views or the rendering give the colour of a pixel, in [0, 1]."""
    weight = layers.get("blend_weight")
    return weight + (1 - weight) * layers.get("alpha")


def filled_depth(layers: Layers, scale_mm: float) -> Float[Tensor, "v 1 h w"]:
    """z-depth without gaps: where only a keyframe knows the surface, it is as sure as its colour.

    Args:
        layers: raw observations.
        scale_mm: depth of a view of which nothing is known.
    """
    sure = torch.maximum(layers.get("alpha"), layers.get("invented_weight"))
    return completed_depth(layers.get("depth_mm"), sure, scale_mm)


def _within_range(color: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Too bright colours darkened with their hue kept; clipping each channel would bleach them."""
    return color.clamp_min(0) / color.amax(dim=1, keepdim=True).clamp_min(1)


def feathered(weight: Float[Tensor, "n 1 h w"]) -> Float[Tensor, "n 1 h w"]:
    """Weight that falls smoothly towards its gaps, and never exceeds what it was."""
    window = gaussian_weights(1.0, 3)
    return torch.minimum(weight, filter_separable(weight, window, window).clamp_min(0))


def _normalised(color: Tensor) -> Tensor:
    return (color - COLOR_CENTER) / COLOR_SCALE
