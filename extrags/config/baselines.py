"""Settings of the baselines that bring a representation of their own instead of Gaussians."""

from __future__ import annotations

from pydantic import Field

from extrags.config.base import Seed, StageConfig

__all__ = ["UcNerfConfig"]


class UcNerfConfig(StageConfig):
    """UC-NeRF: a radiance field conditioned on multi-view stereo, the method `uc-nerf`."""

    enabled: bool = Field(False, description="reconstruct a radiance field instead of Gaussians")
    iterations: int = Field(1000, ge=1, description="optimisation steps, rays of one training frame each")
    source_views: int = Field(4, ge=2, le=16, description="nearest training frames a view is made from")
    stereo_width: int = Field(
        40,
        ge=8,
        le=512,
        description="width in pixels of the coarse cost volume; the fine one is twice as wide",
    )
    coarse_planes: int = Field(24, ge=4, le=256, description="depth hypotheses of the coarse cost volume")
    fine_planes: int = Field(8, ge=2, le=128, description="depth hypotheses of the fine cost volume")
    samples_uniform: int = Field(8, ge=2, le=512, description="samples of a ray over the whole depth range")
    samples_prior: int = Field(12, ge=1, le=512, description="samples of a ray round the prior depth")
    width: int = Field(64, ge=8, le=512, description="width of the field's hidden layers")
    rays: int = Field(256, ge=1, description="single rays of a step")
    patches: int = Field(8, ge=1, description="patches of rays of a step")
    patch_px: int = Field(6, ge=2, le=32, description="edge of a patch in pixels")
    sparse_pixels: int = Field(
        64, ge=4, description="pixels of a frame with known depth, where the source has no sparse points"
    )
    color_weight: float = Field(5.0, gt=0, description="of the mean squared colour error")
    sparse_depth_weight: float = Field(0.05, ge=0, description="of the rendered depth at the sparse pixels")
    stereo_weight: float = Field(
        0.05, ge=0, description="of the stereo depth's own losses, and of the rendered depth against it"
    )
    smoothness_weight: float = Field(0.05, ge=0, description="of the smoothness of the stereo depth")
    gradient_weight: float = Field(
        0.008, ge=0, description="of the scale-invariant gradient of rendered depth"
    )
    learning_rate: float = Field(2e-3, gt=0, description="at the start; falls to a twentieth as a cosine")
    seed: Seed = Field(0, description="seed of all random sampling")
