"""The coarse scene: Gaussians and light from real views."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int

from extrags.arguments import check_sequence_argument, check_settings_argument
from extrags.cameras import Cameras
from extrags.config import DEFAULT_PROFILE, PROFILES, CoarseConfig, DensifyConfig
from extrags.config.coarse import GLARE_TRIAL_SHARE
from extrags.errors import CaptureError, ConfigError
from extrags.facing import with_facing
from extrags.illumination import NearFieldLight
from extrags.scene import NEAR, SHALLOWEST, Scene
from extrags.sequence import EndoscopicSequence
from extrags.threads import one_torch_thread
from extrags.training.continuing import EarlierScene, continued_schedule, continued_start
from extrags.training.footprint import SmallestFootprint
from extrags.training.frame_colors import FrameColors, with_corrected_colors
from extrags.training.frame_weights import weighted_views
from extrags.training.normal_term import NormalTerm
from extrags.training.optimise import TrainingResult, optimise
from extrags.training.pose_refinement import TRIAL_UPDATES, PoseRefinement, with_refined_poses
from extrags.training.schedule import Schedule
from extrags.training.starting import median_depth, starting_gaussians, valid_pixels
from extrags.training.views import epochs

__all__ = [
    "as_reconstructed",
    "coarse_schedule",
    "reconstruct",
    "refines_poses",
    "scene_extent",
    "smallest_footprint",
]

logger = logging.getLogger(__name__)


@one_torch_thread()
def reconstruct(
    sequence: EndoscopicSequence,
    config: CoarseConfig | None = None,
    *,
    frames: Int[np.ndarray, "m"] | None = None,
    stage: str = "coarse",
    device: torch.device | str = "cpu",
    earlier: EarlierScene | None = None,
) -> TrainingResult:
    """Optimise Gaussians (and the near-field light) on training frames.

    Args:
        sequence: posed frames.
        config: budgets, rates and weights; None takes those of the profile `balanced`.
        frames: which frames to use; default: those of `config.train_on`, the split's training frames or,
            for the oracle, all of the split.
        stage: named in progress events.
        device: where it is optimised, and where the scene will be.
        earlier: a scene of some of the frames to go on from, for the iterations it names; None starts anew.

    Raises:
        TypeError: when `sequence` is none, such as a name.
        SourceError: when its arrays cannot be those of a recording (`extrags.sequence_checks.check_arrays`).
        CaptureError: with fewer than one frame, nothing to start from, or a unit of length too large for a
            scene without light.
        ConfigError: for other settings than those of the coarse scene, and where poses shall be refined
            (`refine_poses` is true) and there is an earlier scene, which belongs to other poses.
        ShapeError: for an earlier scene that does not fit (`extrags.training.continuing.continued_start`).
        DivergedError: when the optimisation does not stay finite.

    Returns:
        The scene; where poses were refined (`refines_poses`), `refined` holds those of `frames`, and where
        single frames have haze or another white balance, `colors` holds these: the scene belongs to frames
        that are corrected by both (`as_reconstructed`). Frames that are
        blurred or have moved are named in the log (`config.inconsistent_frames`).

    Source: the loss of 3DGS [ExtraGS, eq. 3] inside the mask, with inverse depth where it is known; see
    docs/references.md.
    """
    check_sequence_argument(sequence, "reconstruct")
    config = PROFILES[DEFAULT_PROFILE].coarse if config is None else config
    check_settings_argument(config, CoarseConfig, "reconstruct", 'extrags.PROFILES["quick"].coarse')
    if not sequence.training_depth_known:
        # The oracle is given held-out frames too, whose depth is for the evaluation alone.
        sequence = replace(sequence, depth_mm=None)
    default = sequence.train if config.train_on == "train" else sequence.split.frames
    chosen = default if frames is None else np.asarray(frames)
    if len(chosen) == 0:
        raise CaptureError(f"{sequence.name}: no training frames")
    depth = median_depth(sequence, chosen)
    if not config.light.enabled and depth < SHALLOWEST:
        raise CaptureError(
            f"{sequence.name}: the typical depth is {depth:.3g} units, too small without light, as "
            f"nothing nearer than {NEAR:g} is rendered; scale poses and depth up, or enable coarse.light"
        )
    start = _start(sequence, chosen, config, depth, earlier)
    views, weights = weighted_views(sequence, chosen, config)
    for statement in () if weights is None else weights.statements:
        logger.warning("%s: %s", sequence.name, statement)
    # Once, not in every iteration.
    views = [view.to(device) for view in views]
    schedule = coarse_schedule(config, scene_extent(sequence, chosen), depth, stage)
    if earlier is not None:
        schedule = continued_schedule(schedule, earlier.iterations)
    else:
        schedule = replace(
            schedule,
            glare_decided_at=int(GLARE_TRIAL_SHARE * schedule.iterations),
            colors_decided_at=config.color_trial(len(chosen)),
        )
    cameras = sequence.cameras[chosen]
    tried, corrected = config.refine_poses == "auto", earlier is None and refines_poses(sequence, config)
    if tried and not corrected and earlier is None and _poses_can_be_judged(sequence, config):
        logger.info(
            "%s: poses are taken as they are: %d frames are too many for %d iterations to tell whether they "
            "are off (coarse.refine_poses=auto)",
            sequence.name,
            len(sequence.train),
            config.iterations,
        )

    def optimised(schedule: Schedule) -> TrainingResult:
        order, poses = epochs(len(views), np.random.default_rng(config.seed)), None
        if config.normal_weight > 0:
            points = start.gaussians.means.numpy()
            schedule = replace(schedule, normals=NormalTerm.at(points, config, schedule.iterations))
        if corrected:
            poses = PoseRefinement(cameras, config.pose_refinement, depth, config.iterations, tried=tried)
        return optimise(
            start.to(device),
            lambda _: views[next(order)],
            schedule,
            poses=poses,
            footprint=smallest_footprint(config, cameras),
        )

    result = optimised(schedule)
    if schedule.colors_decided_at is not None and result.colors is None:
        result = optimised(replace(schedule, colors_decided_at=None))
    if (light := result.scene.light) is not None and bool((light.log_glare > -math.inf).any()):
        logger.info(
            "%s: veiling glare; black shows as %s",
            sequence.name,
            " ".join(f"{value:.2f}" for value in light.log_glare.exp().tolist()),
        )
    if result.colors is not None:
        _tell_colors(sequence, chosen, result.colors)
    if result.refined is not None and tried:
        logger.warning(
            "%s: the poses of training frames do not agree with their images; they are corrected by %.2g "
            "degrees and %.2g %s on average (coarse.refine_poses=auto)",
            sequence.name,
            result.refined.mean_turn_deg,
            result.refined.mean_shift,
            "mm" if sequence.metric else "units",
        )
    if config.one_sided:
        # Refined poses differ by far too little to change a side.
        result = replace(result, scene=with_facing(result.scene, [cameras]))
    return replace(result, frame_weights=weights)


def _tell_colors(sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"], colors: FrameColors) -> None:
    hazy = np.flatnonzero(colors.haze > 0)
    if len(hazy):
        logger.warning(
            "%s: %d of %d training frames, %s first, show a veil, as of smoke or a fogged lens (black shows "
            "as up to %.2f); it is taken away (coarse.light.frame_colors)",
            sequence.name,
            len(hazy),
            len(frames),
            sequence.frame_name(int(frames[hazy[0]])),
            colors.haze.max(),
        )
    if colors.log_balance.any():
        logger.warning(
            "%s: white balance differs between training frames, by %.0f %% (root mean square); it is evened "
            "out (coarse.light.frame_colors)",
            sequence.name,
            100 * np.sqrt(np.square(colors.log_balance).mean()),
        )


def as_reconstructed(sequence: EndoscopicSequence, result: TrainingResult) -> EndoscopicSequence:
    """The sequence that a scene belongs to: with the poses and colours that `reconstruct` has corrected.

    Args:
        sequence: whose training frames were reconstructed.
        result: what `reconstruct` returned.
    """
    if result.refined is not None:
        sequence = with_refined_poses(sequence, result.refined.world_from_camera)
    if result.colors is not None and result.scene.light is not None:
        sequence = with_corrected_colors(sequence, result.colors, result.scene.light.to("cpu"))
    return sequence


def _start(
    sequence: EndoscopicSequence,
    frames: Int[np.ndarray, "m"],
    config: CoarseConfig,
    depth: float,
    earlier: EarlierScene | None,
) -> Scene:
    """What the optimisation starts from: new Gaussians and light, or an earlier scene."""
    if earlier is not None:
        if config.refine_poses is True and refines_poses(sequence, config):
            raise ConfigError(
                f"{sequence.name}: poses are refined (coarse.refine_poses); the earlier scene belongs to "
                "others"
            )
        return continued_start(earlier, sequence, frames, config)
    light = NearFieldLight.initial(len(frames), depth, config.light) if config.light.enabled else None
    gaussians = starting_gaussians(
        sequence,
        frames,
        config.starting_points(valid_pixels(sequence, frames)),
        light=light,
        sh_degree=config.sh_degree,
        thickness=config.thickness,
        seed=config.seed,
    )
    return Scene(gaussians, light)


def smallest_footprint(config: CoarseConfig, cameras: Cameras) -> SmallestFootprint | None:
    """The lower bound on the size of Gaussians; None where the settings have none."""
    pixels = config.min_footprint_px
    return SmallestFootprint(cameras, pixels) if pixels > 0 else None


def refines_poses(sequence: EndoscopicSequence, config: CoarseConfig) -> bool:
    """Whether `reconstruct` corrects poses, as the settings say; for `auto`, whether it tries.

    Poses are refined once: those that came out of a reconstruction are left as they are. Nor does `auto` try
    where held-out frames are trained on; where depth was not measured, as to depth that is off, poses are
    fitted as far as good ones are not; or where there are so many frames that each pose would be moved less
    than `TRIAL_UPDATES` times before it is decided.
    """
    if config.refine_poses != "auto":
        return config.refine_poses and sequence.pose_source != "refined"
    refinement = config.pose_refinement
    iterations = (refinement.trial_share - refinement.start_share) * config.iterations
    return _poses_can_be_judged(sequence, config) and iterations >= TRIAL_UPDATES * len(sequence.train)


def _poses_can_be_judged(sequence: EndoscopicSequence, config: CoarseConfig) -> bool:
    """Whether corrections tell poses that are off, given enough iterations."""
    measured = sequence.depth_mm is not None and sequence.depth_error is None
    return measured and config.train_on == "train" and sequence.pose_source != "refined"


def coarse_schedule(
    config: CoarseConfig,
    extent: float,
    depth: float,
    stage: str,
    *,
    iterations: int | None = None,
    densify: DensifyConfig | None = None,
) -> Schedule:
    """The schedule of coarse reconstruction; fine-tuning changes two of its numbers."""
    return Schedule(
        stage=stage,
        iterations=config.iterations if iterations is None else iterations,
        extent=extent,
        optimiser=config.optimiser,
        light=config.light,
        densify=config.densify if densify is None else densify,
        dssim_weight=config.dssim_weight,
        depth_weight=config.depth_weight,
        depth_weight_final_share=config.depth_weight_final_share,
        depth_scale=depth,
        depth_huber_delta=config.depth_huber_delta if config.depth_loss == "huber" else None,
        sh_every=config.sh_every,
        seed=config.seed,
    )


def scene_extent(sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"]) -> float:
    """Length scale of positions: spread of the cameras, at least the median depth.

    3DGS takes the spread alone, which is nearly zero for a scope that hardly moves.
    """
    centers = sequence.cameras[frames].centers
    spread = 1.1 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    return max(spread, median_depth(sequence, frames))
