"""Profiles, the named combinations of settings: `quick`, `balanced` and `paper`."""

from __future__ import annotations

from typing import Literal

from extrags.config.baselines import UcNerfConfig
from extrags.config.coarse import CoarseConfig, DensifyConfig, OptimiserConfig
from extrags.config.exploration import ExploreConfig
from extrags.config.finetuning import FinetuneConfig
from extrags.config.restorer import EnhanceConfig
from extrags.config.stages import EvaluateConfig, IngestConfig, PipelineConfig
from extrags.errors import ConfigError

__all__ = ["DEFAULT_PROFILE", "PROFILES", "ProfileName", "profile_config"]

ProfileName = Literal["quick", "balanced", "paper"]

DEFAULT_PROFILE: ProfileName = "balanced"
"""Whose settings a run has that is given none, and a stage that is called alone without any."""

PROFILES: dict[str, PipelineConfig] = {
    # A preview in about three minutes on two cores.
    "quick": PipelineConfig(
        coarse=CoarseConfig(
            iterations=1500,
            max_points=24_000,
            sh_every=400,
            densify=DensifyConfig(max_gaussians=36_000),
            # The published learning rates are too small for a short run.
            optimiser=OptimiserConfig(means=3.2e-4, sh0=5e-3),
        ),
        uc_nerf=UcNerfConfig(
            iterations=400,
            source_views=3,
            fine_planes=6,
            samples_prior=8,
            rays=192,
            patches=4,
        ),
        explore=ExploreConfig(trajectories=12, length=10, rotation_deg=20.0, orbit_deg=20.0),
        enhance=EnhanceConfig(max_views=96),
        # Less room leaves little detail for what is new.
        finetune=FinetuneConfig(iterations=2000, rounds=2, growth=2.2),
    ),
    # The default: minutes to a quarter of an hour on two cores.
    "balanced": PipelineConfig(
        ingest=IngestConfig(size="source"),
        coarse=CoarseConfig(
            iterations=5000, max_points=50_000, sh_every=1000, densify=DensifyConfig(max_gaussians=75_000)
        ),
        enhance=EnhanceConfig(
            folds=3,
            fold_iterations=600,
            channels=(48, 96, 160),
            max_views=240,
        ),
        explore=ExploreConfig(rotation_deg=20.0, orbit_deg=20.0),
        finetune=FinetuneConfig(iterations=4000, rounds=2, growth=1.9),
        evaluate=EvaluateConfig(lpips_nets=("alex", "vgg")),
    ),
    # The paper's counts, at the full resolution of the source's frames.
    "paper": PipelineConfig(
        ingest=IngestConfig(size="central"),
        coarse=CoarseConfig(
            iterations=30_000,
            max_points=60_000,
            sh_degree=3,
            sh_every=1000,
            densify=DensifyConfig(max_gaussians=400_000, start_share=1 / 60, stop_share=0.5),
        ),
        # What is published of the counts; the widths are larger than for two cores, but not the original's.
        uc_nerf=UcNerfConfig(
            iterations=30_000,
            source_views=6,
            stereo_width=80,
            coarse_planes=48,
            samples_uniform=30,
            samples_prior=60,
            width=128,
            rays=2000,
            patches=50,
            learning_rate=6e-4,
        ),
        enhance=EnhanceConfig(
            folds=4,
            fold_iterations=2000,
            channels=(48, 96, 160),
            max_views=320,
            samples=4,
        ),
        finetune=FinetuneConfig(iterations=15_000, densify_share=0.6),
        evaluate=EvaluateConfig(lpips_nets=("alex", "vgg")),
        explore=ExploreConfig(render_width=160, max_expansions=200),
    ),
}


def profile_config(name: str) -> PipelineConfig:
    """Settings of a profile.

    Raises:
        ConfigError: for an unknown profile.
    """
    if name not in PROFILES:
        raise ConfigError(f"no profile {name!r}; known: {', '.join(PROFILES)}")
    return PROFILES[name]
