"""poses: estimates camera poses, for sources without them."""

from __future__ import annotations

from extrags.config import PosesConfig
from extrags.store import Ref, Slot
from tasks.stage import stage

__all__ = ["estimating_settings", "poses"]


def estimating_settings(config: PosesConfig) -> PosesConfig:
    """The settings that `poses` reads; whether poses are estimated at all is no part of the key."""
    return config.model_copy(update={"replace_given": False})


@stage("poses", version=7)
def poses(slot: Slot, sequence: Ref, config: PosesConfig) -> None:
    """Estimate poses; writes `sequence/` without the frames that could not be registered, and `poses.json`.

    Poses of the source are not used for the estimate. If there are any, the errors of the estimate relative
    to them are in `poses.json` under `against_given`; what is known of a lens that nobody stated, under
    `calibration`.
    """
    from extrags.poses import estimate_poses, with_estimated_poses
    from extrags.sequence import EndoscopicSequence

    unposed = slot.load(EndoscopicSequence, sequence)
    estimate = estimate_poses(unposed, config)
    posed = with_estimated_poses(unposed, estimate)
    slot.save(posed)
    slot.save_json("poses.json", estimate.to_json(unposed), indent=1)
    slot.counts.update(
        frames=len(posed),
        train=len(posed.train),
        test=len(posed.test),
        dropped=len(unposed) - len(posed),
        has_depth=int(posed.training_depth_known),
        method=estimate.method,
        scale=posed.scale_words,
        summary=estimate.summary,
        mean_reprojection_px=estimate.mean_reprojection_px,
        intrinsics=posed.intrinsics,
        focal_px=float(posed.K[0, 0, 0]),
        focal_std_px=posed.focal_std_px,
    )
