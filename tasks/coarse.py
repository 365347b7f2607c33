"""coarse: Gaussians and light from the training views."""

from __future__ import annotations

import json

from extrags.config import CoarseConfig
from extrags.store import Ref, Slot
from tasks.divergence import keeping_last_good
from tasks.stage import stage

__all__ = ["REFINED_POSES", "coarse", "refined_frames"]

REFINED_POSES = "refined_poses.npy"


@stage("coarse", version=2)
def coarse(slot: Slot, sequence: Ref, config: CoarseConfig) -> None:
    """Optimise the coarse scene; writes `scene/` and `history.json`.

    Where poses were refined (`refined_poses` in the counts), also those of the training frames, which the
    scene belongs to: `refined_poses.npy`, `world_from_camera` [M, 4, 4].
    """
    import numpy as np

    from extrags.sequence import EndoscopicSequence
    from extrags.training import reconstruct

    with keeping_last_good(slot):
        result = reconstruct(EndoscopicSequence.load(slot.open(sequence) / "sequence"), config)
    result.scene.save(slot.path / "scene")
    (slot.path / "history.json").write_text(json.dumps(result.history))
    slot.counts["n_gaussians"] = len(result.scene.gaussians)
    slot.counts["refined_poses"] = int(result.refined is not None)
    if result.refined is not None:
        np.save(slot.path / REFINED_POSES, result.refined.world_from_camera)
        slot.counts["refined_mean_shift"] = result.refined.mean_shift
        slot.counts["refined_mean_turn_deg"] = result.refined.mean_turn_deg


@stage("refined-frames", version=1)
def refined_frames(slot: Slot, sequence: Ref, coarse: Ref) -> None:
    """The whole sequence with the poses the coarse scene belongs to; writes `sequence/`."""
    import numpy as np

    from extrags.sequence import EndoscopicSequence
    from extrags.training.pose_refinement import with_refined_poses

    with (slot.open(coarse) / REFINED_POSES).open("rb") as file:
        refined = np.load(file)
    whole = with_refined_poses(EndoscopicSequence.load(slot.open(sequence) / "sequence"), refined)
    whole.save(slot.path / "sequence")
    slot.counts.update(frames=len(whole), train=len(whole.train), test=len(whole.test))
