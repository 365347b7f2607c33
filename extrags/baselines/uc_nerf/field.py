"""The radiance field: density and colour of samples, conditioned on stereo and on the source views."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from extrags.baselines.uc_nerf.stereo import (
    FEATURES,
    DepthPrior,
    EncodedViews,
    image_grid,
    inside_mask,
    projection_to_views,
)
from extrags.config import UcNerfConfig

__all__ = ["ConditionedField", "RayColors", "Rays", "blending_weights", "composited", "sample_depths"]

POSITION_OCTAVES = 6
DIRECTION_OCTAVES = 2
HIDDEN = 32
"""What the density network tells the colour networks of a sample."""
MIN_DEVIATION_SHARE = 0.02
"""Samples spread at least so far round the prior depth, as a share of it: stereo can be too sure."""
_SCORE_WIDTH = 24
_ADAPTIVE_WIDTH = 32


@dataclass(frozen=True)
class Rays:
    """Pixels of one view.

    Args:
        pixels: positions (u, v), pixel centres at +0.5, [R, 2].
        K: intrinsics of the view, [3, 3].
        viewmat: camera from world, [4, 4].
        width: image width in pixels.
        height: image height in pixels.
    """

    pixels: Float[Tensor, "r 2"]
    K: Float[Tensor, "3 3"]
    viewmat: Float[Tensor, "4 4"]
    width: int
    height: int

    @property
    def directions(self) -> Float[Tensor, "r 3"]:
        """World-space rays with unit z in the camera frame."""
        x = (self.pixels[:, 0] - self.K[0, 2]) / self.K[0, 0]
        y = (self.pixels[:, 1] - self.K[1, 2]) / self.K[1, 1]
        return torch.stack([x, y, torch.ones_like(x)], dim=-1) @ self.viewmat[:3, :3]

    @property
    def center(self) -> Float[Tensor, "3"]:
        """The camera centre in world coordinates."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def sampled(self, maps: Float[Tensor, "k h w"]) -> Float[Tensor, "k r"]:
        """Maps of the view, at any size, interpolated at the pixels."""
        grid = self.pixels * self.pixels.new_tensor([2 / self.width, 2 / self.height]) - 1
        found = functional.grid_sample(
            maps[None], grid[None, None], padding_mode="border", align_corners=False
        )
        return found[0, :, 0]


@dataclass(frozen=True)
class RayColors:
    """What volume rendering gives for rays.

    Args:
        rgb: colours, [R, 3]; without any if they were not asked for.
        alpha: sum of the blending weights, [R].
        depth: expected z-depth, [R].
        median_depth: z-depth at which half of the light is gone, [R].
    """

    rgb: Float[Tensor, "r 3"] | None
    alpha: Float[Tensor, "r"]
    depth: Float[Tensor, "r"]
    median_depth: Float[Tensor, "r"]


def sample_depths(
    inverse: Float[Tensor, "r"],
    deviation: Float[Tensor, "r"],
    inverse_range: tuple[float, float],
    uniform: int,
    prior: int,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "r s"]:
    """z-depths of the samples of rays: some over the whole range, most round the prior, sorted.

    Both sets are stratified: the first uniformly in inverse depth, the second over the quantiles of a normal
    distribution with the prior's mean and standard deviation.

    Args:
        inverse: expected inverse depth.
        deviation: its standard deviation.
        inverse_range: inverse z-depth of the far and the near end.
        uniform: samples over the whole range.
        prior: samples round the prior.
        generator: draws within the strata; None takes their centres.
    """
    far, near = inverse_range

    def strata(count: int) -> Tensor:
        start = torch.arange(count, dtype=inverse.dtype)
        if generator is None:
            return ((start + 0.5) / count).expand(len(inverse), -1)
        return (start + torch.rand(len(inverse), count, generator=generator, dtype=inverse.dtype)) / count

    spread = torch.maximum(deviation, MIN_DEVIATION_SHARE * inverse)
    quantiles = torch.special.ndtri(strata(prior).clamp(0.005, 0.995))
    around = inverse[:, None] + spread[:, None] * quantiles
    everywhere = far + (near - far) * strata(uniform)
    sampled = torch.cat([everywhere, around], dim=1).clamp(far, near)
    return 1 / sampled.sort(dim=1, descending=True).values


def blending_weights(density: Float[Tensor, "r s"], lengths: Float[Tensor, "r s"]) -> Float[Tensor, "r s"]:
    """Weights of samples along rays: transmittance times alpha.

    Args:
        density: at the samples, per unit of length.
        lengths: of the interval each sample stands for.

    Source: Mildenhall et al.: NeRF: Representing Scenes as Neural Radiance Fields for View Synthesis, ECCV
    2020, eq. 3.
    """
    optical = density * lengths
    before = torch.cumsum(optical, dim=1) - optical
    return torch.exp(-before) * -torch.expm1(-optical)


def composited(
    density: Float[Tensor, "r s"],
    rgb: Float[Tensor, "r s 3"] | None,
    z: Float[Tensor, "r s"],
    ray_lengths: Float[Tensor, "r"],
    scale: float,
) -> RayColors:
    """Volume rendering of samples at z-depths; the last sample extends to infinity.

    Args:
        density: at the samples, per `scale`.
        rgb: colours of the samples.
        z: z-depths of the samples, ascending.
        ray_lengths: length of the ray per unit of z-depth.
        scale: length unit of the density, in world units.
    """
    steps = torch.cat([z.diff(dim=1), torch.full_like(z[:, :1], 1e3 * scale)], dim=1)
    weights = blending_weights(density, steps * ray_lengths[:, None] / scale)
    alpha = weights.sum(dim=1)
    passed = weights.cumsum(dim=1)
    crossing = (passed < 0.5 * alpha[:, None]).sum(dim=1).clamp_max(z.shape[1] - 1)
    depth = (weights * z).sum(dim=1) / alpha.clamp_min(1e-10)
    median = z.gather(1, crossing[:, None])[:, 0]
    return RayColors(
        None if rgb is None else (weights[..., None] * rgb).sum(dim=1), alpha, depth, median.detach()
    )


class ConditionedField(nn.Module):
    """Density and colour from position, stereo volume, prior depth, and the source views at the sample.

    Colour has two branches. The base branch blends the colours that the source views show at the sample,
    and one colour of the field itself for what no view shows, with learned weights. The adaptive branch
    corrects the result by gain and offset, given the direction and the uncertainty of the stereo: source
    views disagree in brightness wherever the lamp moved.
    """

    def __init__(self, config: UcNerfConfig) -> None:
        super().__init__()
        position = 3 * (1 + 2 * POSITION_OCTAVES)
        direction = 3 * (1 + 2 * DIRECTION_OCTAVES)
        # Mean and variance of colours and features, share of views, volume, prior, position.
        trunk = 2 * (3 + FEATURES) + 1 + FEATURES + 3 + position
        self.trunk = nn.Sequential(
            nn.Linear(trunk, config.width),
            nn.ReLU(),
            nn.Linear(config.width, config.width),
            nn.ReLU(),
            nn.Linear(config.width, 2 + HIDDEN),
        )
        self.score = nn.Sequential(
            nn.Linear(HIDDEN + 3 + FEATURES + 4, _SCORE_WIDTH), nn.ReLU(), nn.Linear(_SCORE_WIDTH, 1)
        )
        self.own = nn.Linear(HIDDEN + direction, 3)
        correction = nn.Linear(_ADAPTIVE_WIDTH, 6)
        nn.init.zeros_(correction.weight)
        nn.init.zeros_(correction.bias)
        self.adaptive = nn.Sequential(
            nn.Linear(HIDDEN + direction + 4, _ADAPTIVE_WIDTH), nn.ReLU(), correction
        )

    def forward(
        self,
        rays: Rays,
        z: Float[Tensor, "r s"],
        views: EncodedViews,
        prior: DepthPrior,
        inverse_range: tuple[float, float],
        center: Float[Tensor, "3"],
        scale: float,
        *,
        color: bool = True,
    ) -> RayColors:
        """Render rays.

        Args:
            rays: of the target view.
            z: z-depths of the samples, ascending.
            views: the source views.
            prior: stereo depth of the target view.
            inverse_range: inverse z-depths between which the stereo volume lies.
            center: origin of the position encoding, in world units.
            scale: its unit, and that of the density: the median depth.
            color: False: depth and alpha alone.
        """
        directions = rays.directions
        points = rays.center + z[..., None] * directions[:, None]
        unit = functional.normalize(directions, dim=1)
        sources, valid = self._source_samples(rays, z, views)
        weight = valid[..., None].to(z.dtype)
        count = weight.sum(dim=0).clamp_min(1)
        mean = (sources * weight).sum(dim=0) / count
        variance = ((sources - mean).square() * weight).sum(dim=0) / count
        inverse, deviation, uncertainty = rays.sampled(
            torch.stack([prior.inverse, prior.deviation, prior.uncertainty])
        )
        spread = torch.maximum(deviation, MIN_DEVIATION_SHARE * inverse)
        offset = ((1 / z - inverse[:, None]) / spread[:, None]).clamp(-8, 8)
        uncertainty = uncertainty[:, None].expand_as(z)
        about_prior = torch.stack(
            [torch.exp(-0.5 * offset.square()), torch.tanh(offset), uncertainty], dim=-1
        )
        volume = self._volume_samples(rays, z, prior, inverse_range)
        position = _encoded((points - center) / scale, POSITION_OCTAVES)
        seen = weight.mean(dim=0)
        out = self.trunk(torch.cat([mean, variance, seen, volume, about_prior, position], dim=-1))
        density, own_score, hidden = functional.softplus(out[..., 0]), out[..., 1], out[..., 2:]
        rgb = None
        if color:
            direction = _encoded(unit, DIRECTION_OCTAVES)[:, None].expand(-1, z.shape[1], -1)
            base = self._base(hidden, own_score, direction, sources, valid, points, unit, views)
            told = torch.cat([hidden, direction, uncertainty[..., None], base], dim=-1)
            gain, shift = self.adaptive(told).split(3, dim=-1)
            rgb = base * gain.exp() + shift
        return composited(density, rgb, z, directions.norm(dim=1), scale)

    def _source_samples(self, rays: Rays, z: Tensor, views: EncodedViews) -> tuple[Tensor, Tensor]:
        """Colours and features of the source views at the samples, [N, R, S, 3 + F], and who sees them."""
        images = views.images
        A, b = projection_to_views(rays.K, rays.viewmat, images.K, images.viewmats)
        pixels = functional.pad(rays.pixels, (0, 1), value=1.0)
        homogeneous = (pixels @ A.mT)[:, :, None] * z[..., None] + b[:, None, None]
        grid, valid = image_grid(homogeneous, images.rgb.shape[-1], images.rgb.shape[-2])
        found = [
            functional.grid_sample(image, grid, padding_mode="border", align_corners=False)
            for image in (images.rgb, views.fine[:, 1:])
        ]
        return torch.cat(found, dim=1).movedim(1, -1), inside_mask(valid, grid, images.mask)

    def _volume_samples(
        self, rays: Rays, z: Tensor, prior: DepthPrior, inverse_range: tuple[float, float]
    ) -> Tensor:
        far, near = inverse_range
        planes = prior.volume.shape[1]
        # Hypotheses lie at the centres of the first and the last voxel.
        across = (1 / z - far) / (near - far) * (planes - 1) + 0.5
        image = rays.pixels[:, None] * rays.pixels.new_tensor([2 / rays.width, 2 / rays.height]) - 1
        grid = torch.cat([image.expand(*z.shape, 2), (across * 2 / planes - 1)[..., None]], dim=-1)
        found = functional.grid_sample(
            prior.volume[None], grid[None, None], padding_mode="border", align_corners=False
        )
        return found[0, :, 0].movedim(0, -1)

    def _base(
        self,
        hidden: Tensor,
        own_score: Tensor,
        direction: Tensor,
        sources: Tensor,
        valid: Tensor,
        points: Tensor,
        unit: Tensor,
        views: EncodedViews,
    ) -> Tensor:
        viewmats = views.images.viewmats
        centers = -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]
        from_sources = functional.normalize(points - centers[:, None, None], dim=-1)
        cosine = (from_sources * unit[:, None]).sum(dim=-1, keepdim=True)
        turned = torch.cat([unit[:, None] - from_sources, cosine], dim=-1)
        told = torch.cat([hidden.expand(len(sources), *hidden.shape), sources, turned], dim=-1)
        scores = self.score(told)[..., 0].masked_fill(~valid, -math.inf)
        shares = torch.softmax(torch.cat([scores, own_score[None]]), dim=0)
        own = torch.sigmoid(self.own(torch.cat([hidden, direction], dim=-1)))
        return torch.einsum("nrs,nrsc->rsc", shares[:-1], sources[..., :3]) + shares[-1, ..., None] * own


def _encoded(values: Tensor, octaves: int) -> Tensor:
    """Values, and their sines and cosines at doubling frequencies [Mildenhall et al. 2020, eq. 4]."""
    phases = values[..., None] * (math.pi * 2.0 ** torch.arange(octaves, dtype=values.dtype) / 2)
    return torch.cat([values, phases.sin().flatten(-2), phases.cos().flatten(-2)], dim=-1)
