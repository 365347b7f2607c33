"""Settings of the reconstruction from training frames: light, optimiser, densification, poses."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from extrags.config.base import Seed, StageConfig

__all__ = [
    "GLARE_TRIAL_SHARE",
    "CoarseConfig",
    "DensifyConfig",
    "LightConfig",
    "OptimiserConfig",
    "PoseRefinementConfig",
]

LEAST_POINTS = 100
"""Starting points that a reconstruction has however few its pixels are."""

GLARE_TRIAL_SHARE = 0.4
"""Of the iterations, after which it is decided whether there is any glare: it is found early."""

COLOR_TRIAL_SHARE = 0.15
"""The same for haze and white balance of single frames, where that is enough for so many frames."""

COLOR_TRIAL_UPDATES = 10
"""Of each frame before it is decided about its haze and white balance: after fewer, what was learned says
more of their number than of the frames."""


class LightConfig(StageConfig):
    """Near-field light fixed to the camera, and the camera response."""

    enabled: bool = Field(True, description="False: colours do not depend on the distance")
    falloff: bool = Field(True, description="learn exponent and softening of the fall-off with distance")
    spread: bool = Field(True, description="learn how much less the lamp shines to the side")
    cosine: bool = Field(True, description="learn how much darker a surface is that turns away")
    response: bool = Field(True, description="learn the shoulder of the camera's response")
    specular: bool = Field(
        True, description="learn strength and roughness of the highlights of a wet surface"
    )
    glare: bool = Field(
        True, description="learn what lens and tube scatter over the whole image, one value per colour"
    )
    exposure: bool = Field(True, description="learn a gain per training frame")
    offset: bool = Field(True, description="learn where the lamp stands beside the lens")
    exponent: float = Field(
        0.6,
        gt=0,
        description="starting exponent e of gain / (c + r^2)^e; about 1 / 2.2 after a display tone curve",
    )
    learning_rate: float = Field(0.04, gt=0, description="of the global light parameters")
    specular_learning_rate: float = Field(
        0.005,
        gt=0,
        description="of strength and roughness of the highlights; faster, they take their shape from a few",
    )
    offset_learning_rate: float = Field(
        0.001, gt=0, description="of the lamp's place beside the lens, in median training depths"
    )
    offset_prior: float = Field(
        0.002,
        ge=0,
        description="weight of the lamp's distance from the lens, in median training depths: without, "
        "tissue that is darker on one side moves the lamp",
    )
    glare_kept_from: float = Field(
        0.055,
        ge=0,
        le=1,
        description="glare is kept where black is at least this bright, in the mean of the colours; less is "
        "also found where there is no glare, and distorts the fall-off",
    )
    frame_colors: bool = Field(
        True,
        description="learn haze and white balance of single frames, and take away what there is of them",
    )
    exposure_learning_rate: float = Field(0.005, gt=0, description="of the exposure per frame")
    exposure_prior: float = Field(
        0.1,
        ge=0,
        description="weight that holds log-exposures near their mean of zero; at 1 hardly any automatic "
        "exposure is learned",
    )


class OptimiserConfig(StageConfig):
    """Learning rates of the Gaussians; positions are relative to the scene's extent."""

    means: float = Field(1.6e-4, gt=0, description="positions at the start, times the extent")
    means_final: float = Field(1.6e-6, gt=0, description="positions at the end, times the extent")
    sh0: float = Field(2.5e-3, gt=0, description="base colours (degree 0 of the spherical harmonics)")
    shN: float = Field(1.25e-4, gt=0, description="higher degrees of the spherical harmonics")
    opacities: float = Field(0.05, gt=0, description="opacities, as logits")
    scales: float = Field(5e-3, gt=0, description="axis lengths, as logarithms")
    quats: float = Field(1e-3, gt=0, description="rotations, as quaternions")
    decay_after: int | None = Field(
        1500,
        ge=1,
        description="from this iteration on all rates but those of positions, the light's too, fall as "
        "1 / iteration^1.5; null: they stay, as in 3DGS",
    )


class DensifyConfig(StageConfig):
    """When Gaussians are cloned, split and pruned."""

    enabled: bool = Field(True, description="False: the number of Gaussians stays")
    start_share: float = Field(0.1, ge=0, le=1, description="from this share of the iterations")
    stop_share: float = Field(0.6, ge=0, le=1, description="until this share of the iterations")
    every: int = Field(100, ge=1, description="iterations between two rounds")
    gradient_threshold: float = Field(
        2e-4, gt=0, description="mean 2D-position gradient (in half image widths) that densifies"
    )
    prune_opacity: float = Field(0.005, ge=0, lt=1, description="fainter Gaussians are removed")
    max_gaussians: int = Field(60_000, ge=100, description="no growth beyond this")
    split_scale_share: float = Field(
        0.01, gt=0, description="larger than this share of the extent: split, else clone"
    )
    strategy: Literal["default", "mcmc"] = Field(
        "default", description="default: clone, split, prune; mcmc: relocate dead Gaussians, add noise"
    )
    absgrad: bool = Field(
        False,
        description="sum absolute gradients over pixels (AbsGS); wants a threshold about 4 times higher",
    )
    prune_scale_share: float = Field(
        0.25, gt=0, description="Gaussians larger than this share of the extent are removed"
    )
    refine_scale2d_stop_share: float = Field(
        0.0, ge=0, le=1, description="until this share of the iterations sizes in the image count too"
    )
    grow_scale2d: float = Field(
        0.05, gt=0, description="radius, as a share of the longer image side, that is split"
    )
    prune_scale2d: float = Field(
        0.15, gt=0, description="radius, as a share of the longer image side, that is removed"
    )
    reset_every: int = Field(
        0, ge=0, description="iterations between resets of all opacities; 0: never, see DefaultStrategy"
    )
    reset_pause: int = Field(0, ge=0, description="no rounds in so many iterations after a reset")
    noise: float = Field(5e5, ge=0, description="mcmc: noise, times the position learning rate")
    opacity_penalty: float = Field(0.01, ge=0, description="mcmc: weight of the mean opacity in the loss")
    scale_penalty: float = Field(
        0.01, ge=0, description="mcmc: weight of the mean scale, in extents, in the loss"
    )

    @model_validator(mode="after")
    def _a_reset_has_an_opacity(self) -> Self:
        # A reset caps opacities at twice the threshold of pruning, as a logit.
        resets = self.enabled and self.strategy == "default" and self.reset_every > 0
        if resets and not 0 < self.prune_opacity < 0.5:
            raise ValueError(
                f"prune_opacity is {self.prune_opacity} and reset_every {self.reset_every}; expected a "
                "prune_opacity above 0 and below 0.5 where opacities are reset, to twice that"
            )
        return self


class PoseRefinementConfig(StageConfig):
    """How poses of training frames are corrected while the Gaussians are optimised."""

    start_share: float = Field(
        0.05, ge=0, lt=1, description="from this share of the iterations; before it Gaussians settle"
    )
    learning_rate: float = Field(
        2e-3, gt=0, description="of the corrections: radians, and lengths in median depths"
    )
    learning_rate_final: float = Field(1e-4, gt=0, description="the same at the end; log-linear in between")
    prior: float = Field(
        3e-4,
        ge=0,
        description="weight of the mean squared correction, in degrees and hundredths of the depth",
    )
    trial_share: float = Field(
        0.4,
        gt=0,
        le=1,
        description="refine_poses=auto: share of the iterations after which it is decided; poses whose "
        "corrections are not kept are for the rest what they were",
    )
    kept_from_deg: float = Field(
        0.45,
        ge=0,
        description="refine_poses=auto: mean correction from which on it is kept; turn and shift together, "
        "the shift as the angle under which it is seen at the median depth",
    )
    kept_from_px: float = Field(
        0.6, ge=0, description="refine_poses=auto: the same in pixels; both bounds have to be reached"
    )


class CoarseConfig(StageConfig):
    """Gaussians from the training views."""

    iterations: int = Field(3000, ge=1, description="optimisation steps, one view each")
    sh_degree: int = Field(1, ge=0, le=3, description="degree of the spherical harmonics")
    sh_every: int = Field(500, ge=1, description="iterations between two raises of the degree")
    dssim_weight: float = Field(0.2, ge=0, le=1, description="lambda of the photometric loss")
    depth_weight: float = Field(
        0.1, ge=0, description="weight of the inverse-depth term, relative to the median depth"
    )
    depth_weight_final_share: float = Field(
        0.5, ge=0, le=1, description="the term decays to this share, log-linearly"
    )
    depth_loss: Literal["inverse", "huber"] = Field(
        "inverse",
        description="inverse: mean absolute difference of inverse depths; huber: Huber loss of depths, in "
        "median depths",
    )
    depth_huber_delta: float = Field(
        0.2, gt=0, description="huber: depths that differ by more, in median depths, count linearly"
    )
    normal_weight: float = Field(
        0.0,
        ge=0,
        description="weight of the normal term: the shortest axis of a Gaussian along the normal of the "
        "nearest starting point; 0: no such term",
    )
    normal_start_share: float = Field(
        1 / 30, ge=0, lt=1, description="from this share of the iterations the normal term is active"
    )
    normal_every: int = Field(2, ge=1, description="iterations from one use of the normal term to the next")
    one_sided: bool = Field(
        True,
        description="held-out views of the coarse and the final scene show Gaussians that they see from "
        "behind only where there is nothing else",
    )
    train_on: Literal["train", "all"] = Field(
        "train",
        description="all: held-out frames are trained on too. The method oracle alone does this, as a "
        "ceiling; its figures say nothing about views that were not seen",
    )
    max_points: int = Field(12_000, ge=10, description="starting points at most")
    pixels_per_point: int = Field(
        16,
        ge=1,
        description="starting points are fewer than `max_points` where there are not so many valid pixels of "
        "training frames for each: closer points follow single pixels",
    )
    thickness: float = Field(
        0.1,
        gt=0,
        le=1,
        description="starting Gaussians are discs on the surface, so thick against their radius; 1: round",
    )
    min_footprint_px: float = Field(
        0.4,
        ge=0,
        le=4,
        description="standard deviation, in pixels of the training view that resolves it best, below which "
        "the two larger axes of a Gaussian do not shrink; 0: no bound, as in 3DGS",
    )
    inconsistent_frames: Literal["ignore", "report", "weight"] = Field(
        "weight",
        description="training frames that are blurred, or show tissue that has moved: report: named in log, "
        "artefact and report; weight: blurred ones count less as well. Looked for where depth is known, by "
        "comparison with the frames that see the same surface",
    )
    optimiser: OptimiserConfig = OptimiserConfig()
    densify: DensifyConfig = DensifyConfig()
    light: LightConfig = LightConfig()
    refine_poses: bool | Literal["auto"] = Field(
        "auto",
        description="correct the poses of training frames as well; auto: tried where depth was measured, "
        "and kept where corrections are larger than good poses get (pose_refinement.kept_from_deg)",
    )
    pose_refinement: PoseRefinementConfig = PoseRefinementConfig()
    seed: Seed = Field(0, description="seed of all random sampling")

    @model_validator(mode="after")
    def _trial_follows_start(self) -> Self:
        refinement = self.pose_refinement
        if self.refine_poses == "auto" and refinement.trial_share <= refinement.start_share:
            raise ValueError(
                f"pose_refinement.trial_share is {refinement.trial_share:g}; with refine_poses=auto poses "
                f"are corrected from start_share, {refinement.start_share:g}, on"
            )
        return self

    def color_trial(self, frames: int) -> int | None:
        """How long haze and white balance of single frames are learned before it is decided about them.

        Where there are none, which is usual, the scene begins anew, since the light has fitted itself to
        them: the iterations until then come on top of all others.

        Args:
            frames: number of training frames.

        Returns:
            The iteration after which it is decided; None where they are not learned, as of so many frames
            that glare, which is learned with them, would have to be decided about before.
        """
        if not (self.light.enabled and self.light.frame_colors and self.train_on == "train"):
            return None
        decided = max(int(COLOR_TRIAL_SHARE * self.iterations), COLOR_TRIAL_UPDATES * frames)
        return decided if decided <= int(GLARE_TRIAL_SHARE * self.iterations) else None

    def starting_points(self, pixels: int) -> int:
        """How many points a reconstruction starts from at most.

        Args:
            pixels: valid ones of all training frames.
        """
        return min(self.max_points, max(LEAST_POINTS, pixels // self.pixels_per_point))
