"""poses: camera poses by COLMAP, for sources without them."""

from __future__ import annotations

import json

from extrags.config import PosesConfig
from extrags.store import Ref, Slot
from tasks.stage import stage

__all__ = ["poses"]


@stage("poses", version=1)
def poses(slot: Slot, sequence: Ref, config: PosesConfig) -> None:
    """Find poses; writes `sequence/` without the frames that could not be registered, and `poses.json`."""
    from extrags.poses import estimate_poses, with_estimated_poses
    from extrags.sequence import Sequence

    unposed = Sequence.load(slot.open(sequence) / "sequence")
    estimate = estimate_poses(unposed, config)
    posed = with_estimated_poses(unposed, estimate)
    posed.save(slot.path / "sequence")
    account = {
        "registered": [bool(found) for found in estimate.registered],
        "mean_reprojection_px": estimate.mean_reprojection_px,
        **estimate.account,
    }
    (slot.path / "poses.json").write_text(json.dumps(account, indent=1))
    slot.counts.update(
        frames=len(posed),
        train=len(posed.train),
        test=len(posed.test),
        dropped=len(unposed) - len(posed),
        mean_reprojection_px=float(estimate.mean_reprojection_px),
    )
