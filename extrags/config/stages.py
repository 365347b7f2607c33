"""Settings of the stages: one frozen model each, and `PipelineConfig` that joins them.

Lengths that depend on the scene are given relative to it (to a depth quantile, say), so that the same
settings serve a colon in millimetres and a COLMAP model in arbitrary units. Budgets are counted in
iterations, never in seconds: a result must not depend on how busy the machine was.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field, ValidationError, field_validator

from extrags.config.base import StageConfig
from extrags.config.baselines import UcNerfConfig
from extrags.config.depth import DepthConfig
from extrags.config.poses import PosesConfig
from extrags.config.restorer import EnhanceConfig
from extrags.config.settings import settings_of, unknown_setting
from extrags.thresholds import HOLE_ALPHA

__all__ = [
    "AssessConfig",
    "CoarseConfig",
    "CoverageConfig",
    "DensifyConfig",
    "EvaluateConfig",
    "ExploreConfig",
    "FinetuneConfig",
    "FreespaceConfig",
    "IngestConfig",
    "JudgeConfig",
    "LightConfig",
    "LpipsNet",
    "OptimiserConfig",
    "PipelineConfig",
    "PoseRefinementConfig",
    "ReportConfig",
    "SurfaceConfig",
    "Visibility",
]


class IngestConfig(StageConfig):
    """Reading of a source into an `EndoscopicSequence`."""

    width: int | None = Field(
        None, ge=16, le=4096, description="image width in pixels; None keeps the source's own"
    )
    height: int | None = Field(None, ge=16, le=4096, description="image height in pixels")
    downscale: int | None = Field(
        None,
        ge=1,
        le=16,
        description="divide the source's size by this; None: the source's usual divisor (sinus 4, "
        "simcol3d 2, C3VD to a width of 225, others 1); ignored when width is set",
    )
    holdout_every: int = Field(
        8, ge=2, description="hold out every n-th frame where the source defines no split"
    )
    max_frames: int | None = Field(None, ge=2, description="read at most so many frames")
    max_absent_share: float = Field(
        0.5,
        ge=0,
        lt=1,
        description="frames that a list of poses names and that are absent are left out with a warning; the "
        "source is refused where more than this share is absent",
    )
    withhold_depth: bool = Field(
        False,
        description="training frames keep no depth; held-out frames keep theirs for the evaluation alone. "
        "Points of a source that has depth go with it",
    )
    scale_mm_per_unit: float | None = Field(
        None,
        gt=0,
        le=1e6,
        description="millimetres per unit of the source's poses, where their unit is arbitrary; None: it "
        "stays arbitrary",
    )
    start_s: float = Field(
        0.0, ge=0, description="of a video or DICOM file: read from here on, in seconds by its timestamps"
    )
    end_s: float | None = Field(
        None, gt=0, description="of a video or DICOM file: read up to here, in seconds; None: to its end"
    )
    field_of_view_deg: float | None = Field(
        None,
        ge=20,
        le=150,
        description="horizontal field of view of the pinhole that distorted sources are resampled to; None: "
        "the source's usual one (C3VD and C3VDv2 100; others: that of their central resolution)",
    )
    calibration: str | None = Field(
        None,
        min_length=1,
        description="calibration file of the endoscope, for sources that state no intrinsics: OpenCV (YAML "
        "or XML), Kalibr (camchain), Scaramuzza (calib_results.txt); its content counts in cache keys, not "
        "its path",
    )


class LightConfig(StageConfig):
    """Near-field light fixed to the camera, and the camera response."""

    enabled: bool = Field(True, description="False: colours do not depend on the distance")
    falloff: bool = Field(True, description="learn exponent and softening of the fall-off with distance")
    spread: bool = Field(True, description="learn how much less the lamp shines to the side")
    cosine: bool = Field(True, description="learn how much darker a surface is that turns away")
    response: bool = Field(True, description="learn the shoulder of the camera's response")
    exposure: bool = Field(True, description="learn a gain per training frame")
    offset: bool = Field(
        False, description="learn where the lamp stands beside the lens; did not pay where it was measured"
    )
    exponent: float = Field(
        0.6,
        gt=0,
        description="starting exponent e of gain / (c + r^2)^e; about 1 / 2.2 after a display tone curve",
    )
    learning_rate: float = Field(0.04, gt=0, description="of the global light parameters")
    exposure_learning_rate: float = Field(0.005, gt=0, description="of the exposure per frame")
    exposure_prior: float = Field(
        1.0, ge=0, description="weight that holds log-exposures near their mean of zero"
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
    train_on: Literal["train", "all"] = Field(
        "train",
        description="all: held-out frames are trained on too. The method oracle alone does this, as a "
        "ceiling; its figures say nothing about views that were not seen",
    )
    max_points: int = Field(12_000, ge=10, description="starting points at most")
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
        False,
        description="correct the poses of training frames as well; auto: where COLMAP estimated them. Pays "
        "where poses are off by pixels; where they are good it costs held-out views a few tenths of a dB",
    )
    pose_refinement: PoseRefinementConfig = PoseRefinementConfig()
    seed: int = Field(0, ge=0, description="seed of all random sampling")


class AssessConfig(StageConfig):
    """Assessment of the coarse scene, and the plan of the later stages."""

    probe_views: int = Field(24, ge=1, description="views in the fan round the training views")
    probe_offset: float = Field(0.35, gt=0, description="sideways offset of a probe, in median depths")
    probe_turn_deg: float = Field(35.0, ge=0, description="turn of a probe")
    hole_alpha: float = Field(HOLE_ALPHA, gt=0, lt=1, description="a pixel below this alpha is a hole")
    min_hole_share: float = Field(
        0.002,
        ge=0,
        le=1,
        description="explore only when holes and poorly seen pixels exceed this share",
    )
    min_directions: int = Field(
        2, ge=1, description="a Gaussian seen from fewer direction bins counts as poorly seen"
    )
    full_budget_share: float = Field(
        0.25, gt=0, le=1, description="share of lacking pixels from which the whole budget is used"
    )
    force: bool = Field(False, description="run every stage whatever the measurements say")
    seed: int = Field(0, ge=0, description="seed of all random sampling")


class SurfaceConfig(StageConfig):
    """TSDF fusion of rendered depth."""

    voxel_share: float = Field(
        1 / 96, gt=0, lt=1, description="voxel edge as a share of the 95 % depth quantile"
    )
    truncation_voxels: float = Field(5.0, gt=1, description="truncation in voxels")
    min_alpha: float = Field(0.5, gt=0, lt=1, description="depth counts only above this alpha")
    depth_quantile: float = Field(0.98, gt=0.5, le=1, description="farther depth is not fused")
    min_cluster_triangles: int = Field(50, ge=1, description="smaller pieces are removed")
    max_width: int = Field(320, ge=16, description="wider images are rendered at this width")


class FreespaceConfig(StageConfig):
    """Occupancy and clearance."""

    grid_size: int = Field(64, ge=8, le=256, description="S: voxels per axis")
    top_views: int = Field(3, ge=1, description="visibility = mean of so many best views")
    occupied_below: float = Field(0.5, gt=0, lt=1, description="tau of the paper")
    margin_share: float = Field(
        0.05, ge=0, description="padding of the bounding volume, as a share of its largest side"
    )
    min_alpha: float = Field(
        0.5, gt=0, lt=1, description="a ray that ends below this alpha hit nothing and proves nothing"
    )
    wall_voxels: float = Field(
        2.0, gt=0, description="unseen voxels this near to the mesh are occupied, farther ones unknown"
    )
    render_width: int = Field(160, ge=16, description="width of the renders in pixels")
    max_views: int = Field(
        64,
        ge=1,
        le=64,
        description="training views that are rendered; of more, the most different ones",
    )
    passage_share: float = Field(
        0.15,
        ge=0,
        description="free space that a ball of this radius, in median rendered depths, cannot reach from the "
        "training cameras is unknown: it lies behind a hole in the wall; 0 asks for a connection alone",
    )


Visibility = Literal["blending", "frustum"]
"""When a view sees a Gaussian."""


class CoverageConfig(StageConfig):
    """Coverage: which Gaussians were seen from which directions."""

    directions: int = Field(32, ge=4, le=32, description="D: equal-area direction bins")
    visible_weight: float = Field(
        0.02, gt=0, lt=1, description="a Gaussian is seen when its largest T * alpha exceeds this"
    )
    visibility: Visibility = Field(
        "blending", description="blending: by visible_weight; frustum: every Gaussian inside the image"
    )
    render_width: int = Field(80, ge=16, description="width of the renders in pixels")

    @property
    def options(self) -> dict[str, Any]:
        """The arguments of `extrags.exploration.coverage.rendered_pairs`."""
        return {
            "visible_weight": self.visible_weight,
            "n_directions": self.directions,
            "visibility": self.visibility,
        }


class ExploreConfig(StageConfig):
    """The search for virtual trajectories."""

    trajectories: int = Field(20, ge=1, description="N_Tr: starts at most")
    length: int = Field(16, ge=2, description="L: views per trajectory, the start included")
    directions: int = Field(32, ge=4, le=32, description="D: equal-area direction bins")
    step_share: float = Field(0.2, gt=0, description="length of a translation, in median rendered depths")
    rotation_deg: float = Field(10.0, gt=0, le=90, description="angle of a turn about the camera itself")
    orbit_deg: float = Field(10.0, gt=0, le=90, description="angle of a turn about the point in view")
    safety_share: float = Field(0.15, ge=0, description="smallest clearance, in median rendered depths")
    visible_weight: float = Field(
        0.02, gt=0, lt=1, description="a Gaussian is seen when its largest T * alpha exceeds this"
    )
    visibility: Visibility = Field(
        "blending",
        description="blending: a Gaussian is seen by its weight in the image, so not behind a fold; frustum: "
        "wherever it projects into the image, as the published code",
    )
    max_hole_share: float = Field(
        0.75,
        gt=0,
        le=1,
        description="a candidate with a larger share of empty pixels is rejected; one without any surface "
        "always is",
    )
    max_saturated_share: float = Field(
        0.2,
        gt=0,
        le=1,
        description="a candidate is rejected when the light that rides on the camera overexposes more",
    )
    score: Literal["error", "pairs"] = Field(
        "error",
        description="what a view is worth. error: error it takes from views off the trajectory, by the "
        "pixels in which they show surface that is missing or was seen with fewer pixels; pairs: newly "
        "covered (Gaussian, direction) pairs, as in the paper",
    )
    probe_views: int = Field(
        512, ge=1, description="score=error: views off the trajectory by which error is measured"
    )
    probe_shift: float = Field(
        1.5, ge=0, description="score=error: largest shift of a probe, in median rendered depths"
    )
    probe_turn_deg: float = Field(180.0, ge=0, le=180, description="score=error: largest turn of a probe")
    sufficient_resolution: float = Field(
        0.4,
        gt=0,
        description="score=error: surface is seen well enough with this share of the pixels that a view off "
        "the trajectory has of it",
    )
    hole_error: float = Field(
        0.24, ge=0, description="score=error: error of an empty pixel that restoring takes away, of 1"
    )
    unresolved_error: float = Field(
        0.08, ge=0, description="score=error: the same of a pixel of surface that was not resolved at all"
    )
    destinations: bool = Field(
        True, description="score=error: propose straight ways to probes besides the fourteen moves"
    )
    min_view_gain: float = Field(
        4e-5,
        ge=0,
        description="score=error: stop when a trajectory takes less error than this, for each of its views, "
        "from views off the trajectory",
    )
    max_training_views: int = Field(
        256, ge=1, description="coverage is measured at so many training views, spread evenly"
    )
    hole_weight: float = Field(
        4.0,
        ge=0,
        description="score=pairs: worth of a voxel where a view through a hole leaves known space, in voxels "
        "of known surface: missing surface has no Gaussians to be covered; 0 is the paper's rule",
    )
    darkness_weight: float = Field(
        0.0, ge=0, description="lambda_l of the illumination weight; 0.5 in the paper; 0 switches it off"
    )
    fold_angle_deg: float = Field(
        25.0,
        gt=0,
        description="tau_R, on the net rotation over the last fold_steps moves: two turns by 20 degrees in "
        "the same direction exceed 25, three by 10 do",
    )
    fold_steps: int = Field(
        3, ge=1, description="moves the net rotation is taken over; 1 is the paper's inter-step rule"
    )
    fold_penalty: float = Field(1.0, gt=0, le=1, description="eta; 0.6 in the paper; 1 switches the term off")
    top_candidates: int = Field(
        14,
        ge=1,
        le=14,
        description="best candidates of an expansion that are kept: the next view, and the rest for the "
        "queue; the paper's code keeps 3",
    )
    max_expansions: int = Field(
        60, ge=1, description="budget of expansions per trajectory; the paper has none: take a large number"
    )
    wave: int = Field(
        3,
        ge=1,
        description="branches that grow from one coverage snapshot; with 1 each trajectory sees the coverage "
        "of all before it, as in the paper",
    )
    wave_kept_share: float = Field(
        0.8,
        ge=0,
        le=1,
        description="a branch to which the others of its wave leave a smaller share of its worth is not "
        "accepted, and grows again",
    )
    min_gain_share: float = Field(
        0.002,
        ge=0,
        description="score=pairs: stop when what a trajectory adds is worth less than this share of all "
        "pairs; 0: when it adds nothing",
    )
    render_width: int = Field(80, ge=16, description="width of the scoring renders in pixels")
    seed: int = Field(0, ge=0, description="seed of the probes")

    @property
    def coverage(self) -> CoverageConfig:
        """The settings of coverage measurement, which `assess` uses as well."""
        return CoverageConfig(
            directions=self.directions,
            visible_weight=self.visible_weight,
            visibility=self.visibility,
            render_width=self.render_width,
        )


class JudgeConfig(StageConfig):
    """Leave-out test of the fine-tuning: how much of it to keep."""

    enabled: bool = Field(True, description="False: fine-tuning is kept whatever it does to real views")
    leave_out_every: int = Field(
        5, ge=2, description="one in so many training frames is left out of the trial scene, in short runs"
    )
    iterations_share: float = Field(
        0.4, gt=0, le=1, description="share of the iterations of both stages that a trial has"
    )
    views: int = Field(32, ge=1, description="virtual views restored for the trials")
    max_width: int = Field(160, ge=16, description="wider frames are downscaled for the trials")
    max_loss_db: float = Field(
        0.1, ge=0, description="mean PSNR that left-out frames may lose against the coarse scene"
    )


class FinetuneConfig(StageConfig):
    """Fine-tuning on real and restored views."""

    iterations: int = Field(2000, ge=1, description="optimisation steps, one view each")
    densify_share: float = Field(0.6, ge=0, le=1, description="densification ends at this share")
    pseudo_share: float = Field(
        0.5, ge=0, lt=1, description="share of virtual views among the steps, at the start"
    )
    pseudo_share_final: float = Field(0.0, ge=0, lt=1, description="the same at the end; linear in between")
    pseudo_weight: float = Field(
        3.0,
        gt=0,
        description="weight of all virtual views: U_img alone is about 0.2 in a tube, which "
        "would let the real views overrule what the virtual ones add",
    )
    pseudo_depth: bool = Field(
        True, description="restored depth supervises where the scene knows nothing of a pixel"
    )
    loss: Literal["weighted_mean", "weighted_sum", "paper"] = Field(
        "weighted_mean",
        description="colour terms of a virtual view. weighted_mean: L1 and D-SSIM weighted by U_pixel, over "
        "its sum, so that only its pattern counts; weighted_sum: the same over the number of pixels, so that "
        "its magnitude counts; paper: over the number of pixels, D-SSIM without weights",
    )
    dssim_weight: float | None = Field(
        None, ge=0, le=1, description="lambda in fine-tuning; None: coarse.dssim_weight"
    )
    photometric_weight: float = Field(
        1.0,
        gt=0,
        description="factor of (1 - lambda) L1 + lambda (1 - SSIM) / 2 of all views; 3 with lambda = 2/3 is "
        "L1 + (1 - SSIM)",
    )
    depth_weight: float | None = Field(
        None, ge=0, description="weight of the inverse-depth term; None: coarse.depth_weight"
    )
    growth: float = Field(
        2.0,
        ge=1,
        description="limit on the number of Gaussians, seeds and densification together, times "
        "coarse.densify.max_gaussians",
    )
    seed_holes: bool = Field(
        True, description="place new Gaussians where the restored view has surface and none is"
    )
    keep_known: bool = Field(
        True, description="u * restored + (1 - u) * rendered instead of the restored image alone"
    )
    confidence_floor: float = Field(
        0.1, ge=0, le=1, description="smallest pixel-level weight, so that no pixel drifts freely"
    )
    image_confidence: bool = Field(
        True, description="weight virtual views by U_img; without it all have the same, the mean"
    )
    judge: JudgeConfig = JudgeConfig()
    seed: int = Field(0, ge=0, description="seed of all random sampling")


LpipsNet = Literal["alex", "vgg", "squeeze"]
"""Backbones of LPIPS."""


class EvaluateConfig(StageConfig):
    """Held-out views and their metrics."""

    lpips_nets: tuple[LpipsNet, ...] = Field(
        ("alex",),
        min_length=1,
        description="backbones LPIPS is measured with; the first also gives the pixel confidence of restored "
        "views. VGG, the backbone papers report, takes sixteen times as long as AlexNet",
    )
    lpips_weights: str | None = Field(
        None,
        description="npz file with LPIPS weights, or the folder that holds one for each backbone; None looks "
        "in the usual places",
    )

    @field_validator("lpips_nets")
    @classmethod
    def _once_each(cls, nets: tuple[LpipsNet, ...]) -> tuple[LpipsNet, ...]:
        if len(set(nets)) < len(nets):
            raise ValueError("a backbone is there twice")
        return nets


class ReportConfig(StageConfig):
    """The HTML page."""

    held_out_views: int = Field(6, ge=1, description="held-out views shown")
    virtual_views: int = Field(8, ge=1, description="virtual views shown")


class PipelineConfig(StageConfig):
    """All stages of one run."""

    ingest: IngestConfig = IngestConfig()
    poses: PosesConfig = PosesConfig()
    depth: DepthConfig = DepthConfig()
    coarse: CoarseConfig = CoarseConfig()
    uc_nerf: UcNerfConfig = UcNerfConfig()
    assess: AssessConfig = AssessConfig()
    surface: SurfaceConfig = SurfaceConfig()
    freespace: FreespaceConfig = FreespaceConfig()
    explore: ExploreConfig = ExploreConfig()
    enhance: EnhanceConfig = EnhanceConfig()
    finetune: FinetuneConfig = FinetuneConfig()
    evaluate: EvaluateConfig = EvaluateConfig()
    report: ReportConfig = ReportConfig()

    def with_seed(self, seed: int) -> PipelineConfig:
        """The same settings with every stage's seed set."""
        seeded = {
            name: value.model_copy(update={"seed": seed})
            for name, value in self
            if "seed" in type(value).model_fields
        }
        return self.model_copy(update=seeded)

    def with_overrides(self, overrides: Mapping[str, Any]) -> PipelineConfig:
        """Apply `{"coarse.iterations": 500}`-like settings.

        Raises:
            ConfigError: for an unknown name (with the nearest known one) or a value out of range.
        """
        known = settings_of(PipelineConfig)
        tree = self.model_dump()
        for name, value in overrides.items():
            if name not in known:
                raise unknown_setting(name, known)
            *parents, leaf = name.split(".")
            node = tree
            for parent in parents:
                node = node[parent]
            node[leaf] = value
        try:
            return PipelineConfig.model_validate(tree)
        except ValidationError as error:
            first = error.errors()[0]
            # A place ends with the member of a union or of a tuple that was tried.
            place = ".".join(str(part) for part in first["loc"])
            wrong = next(name for name in known if f"{place}.".startswith(f"{name}."))
            # `with_seed` does not validate: what is wrong may have been there before.
            raise known[wrong].refused(repr(overrides.get(wrong, first["input"]))) from error
