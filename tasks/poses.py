"""poses: estimates camera poses, for sources without them."""

from __future__ import annotations

from dataclasses import replace

from extrags.config import IngestConfig, PosesConfig
from extrags.store import Ref, Slot
from tasks.stage import stage

__all__ = ["estimating_settings", "lens_settings", "poses"]


def estimating_settings(config: PosesConfig) -> PosesConfig:
    """The settings that `poses` reads; whether poses are estimated at all is no part of the key."""
    return config.model_copy(update={"replace_given": False})


def lens_settings(config: IngestConfig) -> IngestConfig:
    """The settings of reading that say what becomes of depth, masks, colours, and of a distorting lens."""
    kept = ["depth_error", "correct_calibration", "mask_foreground", "match_light"]
    if config.lens != "pinhole" or config.field_of_view_deg is not None:
        # Sizes are those of a pinhole that is wider than the lens's centre.
        kept += ["lens", "field_of_view_deg", "size", "width", "downscale"]
    return IngestConfig(**{name: getattr(config, name) for name in kept})


@stage("poses", version=16)
def poses(slot: Slot, sequence: Ref, config: PosesConfig, ingest: IngestConfig | None = None) -> None:
    """Estimate poses; writes `sequence/` without the frames that could not be registered, and `poses.json`.

    Poses of the source are not used for the estimate. If there are any, the errors of the estimate relative
    to them are in `poses.json` under `against_given`; what is known of a lens that nobody stated, under
    `calibration`.

    Args:
        slot: the artefact to write.
        sequence: the frames.
        config: from `estimating_settings`.
        ingest: from `lens_settings`; None takes the defaults.
    """
    from extrags.poses import (
        check_lens_use,
        estimate_poses,
        observed_by_those_left,
        with_estimated_poses,
    )
    from extrags.sequence import EndoscopicSequence

    unposed = slot.load(EndoscopicSequence, sequence)
    if ingest is not None and unposed.intrinsics == "guessed":
        check_lens_use(ingest)  # what would be refused after the estimate
    estimate = estimate_poses(unposed, config)
    told = replace(unposed, observed=observed_by_those_left(unposed, estimate.registered))
    posed = with_estimated_poses(told, estimate, ingest)
    slot.save(posed)
    slot.save_json("poses.json", estimate.to_json(unposed), indent=1)
    slot.counts.update(
        frames=len(posed),
        train=len(posed.train),
        test=len(posed.test),
        dropped=len(unposed) - len(posed),
        has_depth=int(posed.training_depth_known),
        depth_error=posed.median_depth_error,
        method=estimate.method,
        scale=posed.scale_words,
        summary=estimate.summary,
        mean_reprojection_px=estimate.mean_reprojection_px,
        intrinsics=posed.intrinsics,
        focal_px=float(posed.K[0, 0, 0]),
        focal_std_px=posed.focal_std_px,
    )
