"""The methods that are compared: each is the pipeline with some settings pinned and some stages left out.

Everything a method does not pin is shared: data, split, initial points, number of iterations, limit on the
number of Gaussians, rasteriser, evaluation. A pinned setting defines the method: overrides do not change it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from extrags.config import PipelineConfig
from extrags.errors import ConfigError
from extrags.pipeline import NEED_GAUSSIANS, NO_GAUSSIANS
from flows.settings import pipeline_config

__all__ = [
    "METHODS",
    "THREE_DGS_SHARED",
    "Method",
    "MethodName",
    "check_not_pinned",
    "method_config",
    "profile_label",
    "three_dgs",
]

MethodName = Literal["extrags", "coarse", "3dgs", "classical", "real-only", "uc-nerf"]

EXPLORING = ("surface", "freespace", "explore", "enhance")

SCHEDULE_ITERATIONS = 30_000
"""Iterations of the published 3DGS schedule; its other counts are kept as shares of it."""

THREE_DGS_SHARED = frozenset(
    {
        "iterations",
        "max_points",
        "seed",
        "depth_weight_final_share",  # of a term whose weight is zero
        "densify.max_gaussians",
        "densify.prune_scale_share",
        "densify.reset_every",
        "densify.reset_pause",
        "densify.grow_scale2d",  # of a rule that is switched off
        "densify.prune_scale2d",
        "densify.noise",  # of the other strategy
        "pose_refinement.learning_rate",  # switched off
        "pose_refinement.learning_rate_final",
        "pose_refinement.prior",
        "pose_refinement.start_share",
        "densify.opacity_penalty",
        "densify.scale_penalty",
    }
)
"""Settings of the coarse stage that the baseline takes from the profile, like every other method. A test
checks that each setting is either listed here or pinned, so that a new setting cannot change the baseline
unnoticed."""


def three_dgs(config: PipelineConfig) -> dict[str, Any]:
    """Settings that make the coarse stage plain 3D Gaussian Splatting.

    Loss (1 - 0.2) L1 + 0.2 D-SSIM without any depth term; round Gaussians to start from; spherical
    harmonics of degree 3, raised one by one over the first tenth; densification from 1/60 to a half of the
    iterations; published learning rates; no light and no exposure. The published schedule has 30,000
    iterations: counts scale with `coarse.iterations`, so that a short run ends with a finished schedule.
    Kept from the profile, since it favours neither side: starting points, the cap on Gaussians, the extent
    of the scene (the larger of the cameras' spread and the median depth: a scope hardly moves), and opacity
    resets as every method has them (none by default: short schedules never close again what a reset opens).

    Source: Kerbl, Kopanas, Leimkuehler, Drettakis: 3D Gaussian Splatting for Real-Time Radiance Field
    Rendering, ACM TOG 2023, sections 5 and 6 and its published defaults.
    """
    iterations = config.coarse.iterations
    return {
        "coarse.sh_degree": 3,
        "coarse.sh_every": max(1, round(iterations * 1000 / SCHEDULE_ITERATIONS)),
        "coarse.dssim_weight": 0.2,
        "coarse.depth_weight": 0.0,
        "coarse.thickness": 1.0,
        "coarse.optimiser.means": 1.6e-4,
        "coarse.optimiser.means_final": 1.6e-6,
        "coarse.optimiser.sh0": 2.5e-3,
        "coarse.optimiser.shN": 1.25e-4,
        "coarse.optimiser.opacities": 0.05,
        "coarse.optimiser.scales": 5e-3,
        "coarse.optimiser.quats": 1e-3,
        "coarse.densify.enabled": True,
        "coarse.densify.strategy": "default",
        "coarse.densify.absgrad": False,
        "coarse.densify.refine_scale2d_stop_share": 0.0,
        "coarse.densify.start_share": 500 / SCHEDULE_ITERATIONS,
        "coarse.densify.stop_share": 15_000 / SCHEDULE_ITERATIONS,
        "coarse.densify.every": 100,
        "coarse.densify.gradient_threshold": 2e-4,
        "coarse.densify.prune_opacity": 0.005,
        "coarse.densify.split_scale_share": 0.01,
        "coarse.light.enabled": False,
        "coarse.refine_poses": False,
    }


def _classical(_: PipelineConfig) -> dict[str, Any]:
    return {"enhance.backend": "classical"}


def _uc_nerf(_: PipelineConfig) -> dict[str, Any]:
    return {"uc_nerf.enabled": True}


def _nothing(_: PipelineConfig) -> dict[str, Any]:
    return {}


@dataclass(frozen=True)
class Method:
    """One way to reconstruct a sequence.

    Args:
        summary: what it is, in words.
        pinned: settings that make it what it is, given all other settings.
        leave_out: stages it does not have, with the reason.
    """

    summary: str
    pinned: Callable[[PipelineConfig], dict[str, Any]] = _nothing
    leave_out: Mapping[str, str] = field(default_factory=dict)


METHODS: dict[str, Method] = {
    "extrags": Method("explored, restored by the diffusion, fine-tuned"),
    "coarse": Method(
        "the light-aware coarse scene alone",
        leave_out=dict.fromkeys([*EXPLORING, "finetune"], "the run measures the coarse scene"),
    ),
    "3dgs": Method(
        "plain 3D Gaussian Splatting: standard loss and schedule, SH 3, no light, no enhancement",
        three_dgs,
        dict.fromkeys([*EXPLORING, "finetune"], "plain 3DGS has no such stage"),
    ),
    "classical": Method("as extrags, with the classical fill instead of the diffusion", _classical),
    "real-only": Method(
        "fine-tuned on the real views alone: the control",
        leave_out=dict.fromkeys(EXPLORING, "the run is a control on real views alone"),
    ),
    "uc-nerf": Method(
        "UC-NeRF: radiance field conditioned on uncertainty-aware multi-view stereo",
        _uc_nerf,
        dict.fromkeys(NEED_GAUSSIANS, NO_GAUSSIANS),
    ),
}


def method_config(
    method: str, profile: str, settings: dict[str, Any] | None = None, seed: int | None = None
) -> PipelineConfig:
    """A profile with overrides, and with what the method pins on top.

    Raises:
        ConfigError: for an unknown method, profile or setting, or a value out of range.
    """
    config = pipeline_config(profile, settings, seed)
    return config.with_overrides(_known(method).pinned(config))


def check_not_pinned(method: str, settings: Mapping[str, Any]) -> None:
    """Check that overrides name no setting that the method pins, since they would have no effect.

    Not used by benchmarks: their overrides are for all methods, and apply to those that do not pin them.

    Raises:
        ConfigError: names the setting.
    """
    pinned = _known(method).pinned(PipelineConfig())
    for name in settings:
        if name in pinned:
            raise ConfigError(f"the method {method} sets {name} itself; leave it out, or take another method")


def profile_label(profile: str, method: str) -> str:
    """Label of the settings on pages: the profile, and the method unless it is the whole pipeline."""
    return profile if method == "extrags" else f"{profile}, method {method}"


def _known(method: str) -> Method:
    if method not in METHODS:
        raise ConfigError(f"no method {method!r}; known: {', '.join(METHODS)}")
    return METHODS[method]
