"""poses: camera poses, for sources without them."""

from __future__ import annotations

import json

from extrags.config import PosesConfig
from extrags.store import Ref, Slot
from tasks.stage import stage

__all__ = ["poses"]


@stage("poses", version=2)
def poses(slot: Slot, sequence: Ref, config: PosesConfig) -> None:
    """Find poses; writes `sequence/` without the frames that could not be registered, and `poses.json`.

    Where the source has poses as well, they are not looked at until the estimate stands; its errors against
    them are in `poses.json` under `against_given`.
    """
    from extrags.poses import errors_against_given, estimate_poses, with_estimated_poses
    from extrags.sequence import EndoscopicSequence

    unposed = EndoscopicSequence.load(slot.open(sequence) / "sequence")
    estimate = estimate_poses(unposed, config)
    posed = with_estimated_poses(unposed, estimate)
    posed.save(slot.path / "sequence")
    metric = estimate.metric and unposed.metric
    report = {
        "method": estimate.method,
        "summary": estimate.summary,
        "registered": [bool(found) for found in estimate.registered],
        "mean_reprojection_px": estimate.mean_reprojection_px,
        "against_given": errors_against_given(unposed, estimate.world_from_camera, metric=metric),
        **estimate.report,
    }
    (slot.path / "poses.json").write_text(json.dumps(report, indent=1))
    slot.counts.update(
        frames=len(posed),
        train=len(posed.train),
        test=len(posed.test),
        dropped=len(unposed) - len(posed),
        method=estimate.method,
        summary=estimate.summary,
        mean_reprojection_px=estimate.mean_reprojection_px,
    )
