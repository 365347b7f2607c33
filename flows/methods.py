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
from extrags.pipeline import HELD_OUT_TRAINED_ON, NO_GAUSSIANS
from extrags.stages import REGISTRY, leading_to
from flows.settings import pipeline_config

__all__ = [
    "METHODS",
    "PAPER_SHARED",
    "THREE_DGS_SHARED",
    "Method",
    "MethodName",
    "check_not_pinned",
    "gaussian_pancakes",
    "method_config",
    "paper",
    "pinned_settings",
    "profile_label",
    "three_dgs",
]

MethodName = Literal[
    "extrags",
    "paper",
    "paper-no-illum-fold",
    "exploregs",
    "coarse",
    "oracle",
    "3dgs",
    "gaussian-pancakes",
    "classical",
    "real-only",
    "uc-nerf",
]

EXPLORING: tuple[str, ...] = leading_to("enhance")
"""Stages of methods that explore."""
AFTER_COARSE: tuple[str, ...] = tuple(stage.name for stage in REGISTRY if stage.planned)
"""Stages of methods that go on from the coarse scene."""
ON_GAUSSIANS: tuple[str, ...] = tuple(stage.name for stage in REGISTRY if stage.needs_gaussians)

PAPER_HAS_NO_PLAN = "the paper's pipeline runs every stage with its whole budget"

SCHEDULE_ITERATIONS = 30_000
"""Iterations of the published 3DGS schedule; its other counts are kept as shares of it."""

THREE_DGS_SHARED = frozenset(
    {
        "iterations",
        "max_points",
        "pixels_per_point",
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
        "pose_refinement.trial_share",
        "pose_refinement.kept_from_deg",
        "pose_refinement.kept_from_px",
        "pose_refinement.start_share",
        "densify.opacity_penalty",
        "densify.scale_penalty",
        "depth_loss",  # of a term whose weight is zero
        "depth_huber_delta",
        "normal_start_share",  # of a term whose weight is zero
        "normal_every",
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
        "coarse.normal_weight": 0.0,
        "coarse.train_on": "train",
        "coarse.thickness": 1.0,
        "coarse.optimiser.means": 1.6e-4,
        "coarse.optimiser.means_final": 1.6e-6,
        "coarse.optimiser.sh0": 2.5e-3,
        "coarse.optimiser.shN": 1.25e-4,
        "coarse.optimiser.opacities": 0.05,
        "coarse.optimiser.scales": 5e-3,
        "coarse.optimiser.quats": 1e-3,
        "coarse.optimiser.decay_after": None,
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
        "coarse.min_footprint_px": 0.0,
        "coarse.inconsistent_frames": "ignore",
        "coarse.one_sided": False,
        "coarse.refine_poses": False,
    }


def _three_dgs_method(config: PipelineConfig) -> dict[str, Any]:
    """Plain 3DGS starts from sparse points, or at random, where a source has no depth: none is estimated."""
    return {**three_dgs(config), "depth.enabled": False}


def gaussian_pancakes(config: PipelineConfig) -> dict[str, Any]:
    """Settings that make the coarse stage Gaussian Pancakes: plain 3DGS held to depth and surface normals.

    To the photometric loss of `three_dgs` it adds 0.2 times a Huber loss of rendered depth and, from
    1/30 of the iterations on and at every second one, 0.2 times 1 - |cos| between a Gaussian's shortest axis
    and the normal of the nearest starting point. Densification ends at 4,000 of 30,000 iterations, from where
    the set of Gaussians is fixed.

    What differs from the published system, and why:

    * The published one takes depth, poses and points from a SLAM system that is not available. Here
      they are the sequence's, as for every method; the stage `depth` stands for the SLAM system's depth
      where a source has none.
    * Its Huber delta of 0.2 is in that system's units. Here it is 0.2 median depths
      (`extrags.raster.loss.huber_depth_loss`), so that scenes in millimetres and in arbitrary units are
      treated alike: an interpretation. Pixels without known depth or without a rendered surface are left out.
    * Normals are those of planes through 12 neighbours of a starting point.
    * Opacities are reset as in `three_dgs`: not at all by default, instead of every 3,000 iterations.

    Source: Bonilla et al.: Gaussian Pancakes, MICCAI 2024, and its published defaults.
    """
    return {
        **three_dgs(config),
        "coarse.densify.stop_share": 4000 / SCHEDULE_ITERATIONS,
        "coarse.depth_loss": "huber",
        "coarse.depth_weight": 0.2,
        "coarse.depth_weight_final_share": 1.0,
        "coarse.depth_huber_delta": 0.2,
        "coarse.normal_weight": 0.2,
        "coarse.normal_start_share": 1000 / SCHEDULE_ITERATIONS,
        "coarse.normal_every": 2,
    }


PAPER_SHARED = frozenset(
    {
        # Budgets.
        "explore.trajectories",
        "explore.length",
        "explore.render_width",
        "finetune.iterations",
        "finetune.growth",
        # The published code gives lengths by other rules, in units of its grid.
        "explore.step_share",
        "explore.safety_share",
        "explore.visible_weight",
        # Of the score by error, which it does not use.
        "explore.starts",
        "explore.start_spacing",
        "explore.probe_views",
        "explore.probe_shift",
        "explore.probe_turn_deg",
        "explore.sufficient_resolution",
        "explore.hole_error",
        "explore.unresolved_error",
        "explore.destinations",
        "explore.min_view_gain",
        "finetune.known_share",  # of further rounds, which it has not
        "finetune.invented_share",
        "finetune.seed",
        "finetune.judge.iterations_share",  # switched off
        "finetune.judge.leave_out_every",
        "finetune.judge.max_loss_db",
        "finetune.judge.max_width",
        "finetune.judge.views",
    }
)
"""Settings of exploration and fine-tuning that `paper` takes from the profile. A test checks that each one is
either listed here or pinned."""


def paper(config: PipelineConfig) -> dict[str, Any]:
    """Settings that make the pipeline the paper's; docs/paper.md lists where it still differs, and why.

    It estimates no depth: the paper starts from the points of structure from motion.

    Numbers that the paper does not give are those of its published code. Budgets are the profile's:
    those of profile `paper` are the paper's own.

    Source: [ExtraGS, eq. 3] (coarse scene), [ExtraGS, eq. 7 to 16] (exploration) and [ExtraGS, eq. 17 to 25]
    (restoration and fine-tuning).
    """
    return {
        **three_dgs(config),
        "depth.enabled": False,
        "freespace.top_views": 3,
        "freespace.occupied_below": 0.5,
        "explore.directions": 32,
        "explore.visibility": "blending",
        "explore.rotation_deg": 10.0,
        "explore.orbit_deg": 10.0,
        "explore.score": "pairs",
        "explore.hole_weight": 0.0,
        "explore.darkness_weight": 0.5,
        "explore.fold_steps": 1,
        "explore.fold_angle_deg": 20.0,
        "explore.fold_penalty": 0.6,
        "explore.top_candidates": 3,
        "explore.wave": 1,
        "explore.wave_kept_share": 0.0,
        "explore.min_gain_share": 0.0,
        "explore.max_training_views": 100_000,
        "explore.max_hole_share": 0.5,
        "explore.max_saturated_share": 1.0,
        "explore.max_expansions": 10_000,
        "enhance.references": 1,
        "enhance.reference": "nearest",
        "enhance.iou": "reference",
        "enhance.keyframes": 0,
        "enhance.max_width": None,
        "enhance.pixel_confidence": "raw",
        "finetune.loss": "paper",
        # With these two the colour terms are L1 + (1 - SSIM).
        "finetune.dssim_weight": 2 / 3,
        "finetune.photometric_weight": 3.0,
        "finetune.depth_weight": 0.0,
        "finetune.densify_share": 0.6,
        "finetune.pseudo_share": 0.5,
        "finetune.pseudo_share_final": 0.5,
        "finetune.pseudo_weight": 1.0,
        "finetune.pseudo_depth": False,
        "finetune.seed_holes": False,
        "finetune.keep_known": False,
        "finetune.keep_scene": False,
        "finetune.holes_only": False,
        "finetune.confidence_floor": 0.0,
        "finetune.image_confidence": True,
        "finetune.light_cooldown_share": 0.0,
        "finetune.rounds": 1,
        "finetune.judge.enabled": False,
        "evaluate.restored": "none",
    }


def _paper_without_illumination_and_fold(config: PipelineConfig) -> dict[str, Any]:
    return {**paper(config), "explore.darkness_weight": 0.0, "explore.fold_penalty": 1.0}


def _exploregs(config: PipelineConfig) -> dict[str, Any]:
    """ExploreGS, in what its published code has that the paper's text changes.

    Source: Kim et al.: ExploreGS, 2025, and its published code.
    """
    return {
        **_paper_without_illumination_and_fold(config),
        "explore.visibility": "frustum",
        "enhance.iou": "union",
    }


def _oracle(_: PipelineConfig) -> dict[str, Any]:
    """The coarse stage of `extrags`, shown held-out frames too.

    Pixels, depth and exposure of the frames it is evaluated on are known to it; the number of iterations is
    that of the other methods. Refined poses of held-out frames would leave the evaluation's.
    """
    return {"coarse.train_on": "all", "coarse.refine_poses": False}


def _classical(_: PipelineConfig) -> dict[str, Any]:
    return {"enhance.backend": "classical"}


def _uc_nerf(_: PipelineConfig) -> dict[str, Any]:
    return {"uc_nerf.enabled": True}


def _real_only(_: PipelineConfig) -> dict[str, Any]:
    # A control differs in the virtual views alone.
    return {"finetune.judge.enabled": False, "finetune.light_cooldown_share": 0.0}


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
    "paper": Method("the paper's pipeline, equation by equation", paper, {"assess": PAPER_HAS_NO_PLAN}),
    "paper-no-illum-fold": Method(
        "the paper's ablation: paper without illumination weight (its fold penalty never applies)",
        _paper_without_illumination_and_fold,
        {"assess": PAPER_HAS_NO_PLAN},
    ),
    "exploregs": Method(
        "ExploreGS: frustum coverage, no illumination or fold term, G-IOU over the union",
        _exploregs,
        {"assess": PAPER_HAS_NO_PLAN},
    ),
    "coarse": Method(
        "the light-aware coarse scene alone",
        leave_out=dict.fromkeys(AFTER_COARSE, "the run measures the coarse scene"),
    ),
    "oracle": Method(
        "a ceiling, no method: the coarse scene of extrags made from held-out frames too",
        _oracle,
        dict.fromkeys(AFTER_COARSE, "nothing may rest on a scene that has seen held-out frames"),
    ),
    "3dgs": Method(
        "plain 3D Gaussian Splatting: standard loss and schedule, SH 3, no light, no enhancement",
        _three_dgs_method,
        dict.fromkeys(AFTER_COARSE, "plain 3DGS has no such stage"),
    ),
    "gaussian-pancakes": Method(
        "Gaussian Pancakes: plain 3DGS held to depth and surface normals, densified early only",
        gaussian_pancakes,
        dict.fromkeys(AFTER_COARSE, "Gaussian Pancakes has no such stage"),
    ),
    "classical": Method("as extrags, with the classical fill instead of the diffusion", _classical),
    "real-only": Method(
        "fine-tuned on the real views alone: the control",
        _real_only,
        dict.fromkeys(EXPLORING, "the run is a control on real views alone"),
    ),
    "uc-nerf": Method(
        "UC-NeRF: radiance field conditioned on uncertainty-aware multi-view stereo",
        _uc_nerf,
        dict.fromkeys(ON_GAUSSIANS, NO_GAUSSIANS),
    ),
}


def method_config(
    method: str, profile: str, settings: dict[str, Any] | None = None, seed: int | None = None
) -> PipelineConfig:
    """A profile with overrides, and with what the method pins on top.

    Raises:
        ConfigError: for an unknown method, profile or setting, or a value out of range; for
            `coarse.train_on`, which is the oracle's alone.
    """
    if "coarse.train_on" in (settings or {}):
        # Not ignored like other pinned settings: figures of a run that has seen held-out frames, or only
        # seems to, must not pass for another method's.
        check_not_pinned(method, {"coarse.train_on": None})
    config = pipeline_config(profile, settings, seed)
    return config.with_overrides(_pinned(method, config))


def check_not_pinned(method: str, settings: Mapping[str, Any]) -> None:
    """Check that overrides name no setting that the method pins, since they would have no effect.

    Not used by benchmarks: their overrides are for all methods, and apply to those that do not pin them.

    Raises:
        ConfigError: names the setting.
    """
    pinned = pinned_settings(method)
    for name in settings:
        if name in pinned:
            raise ConfigError(f"the method {method} sets {name} itself; leave it out, or take another method")


def pinned_settings(method: str) -> frozenset[str]:
    """Names of the settings that a method sets itself.

    Raises:
        ConfigError: for an unknown method.
    """
    return frozenset(_pinned(method, PipelineConfig()))


def profile_label(profile: str, method: str) -> str:
    """Label of the settings on pages: the profile, and the method unless it is the whole pipeline."""
    if method == "oracle":
        return f"{profile}, {HELD_OUT_TRAINED_ON}"
    return profile if method == "extrags" else f"{profile}, method {method}"


def _pinned(method: str, config: PipelineConfig) -> dict[str, Any]:
    """Which frames are trained on is part of every method."""
    return {"coarse.train_on": "train", **_known(method).pinned(config)}


def _known(method: str) -> Method:
    if method not in METHODS:
        raise ConfigError(f"no method {method!r}; known: {', '.join(METHODS)}")
    return METHODS[method]
