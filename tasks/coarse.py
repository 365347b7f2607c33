"""coarse: Gaussians and light from the training views."""

from __future__ import annotations

import json

from extrags.config import CoarseConfig
from extrags.store import Ref, Slot
from tasks.divergence import keeping_last_good
from tasks.stage import stage

__all__ = ["coarse"]


@stage("coarse", version=2)
def coarse(slot: Slot, sequence: Ref, config: CoarseConfig) -> None:
    """Optimise the coarse scene; writes `scene/` and `history.json`."""
    from extrags.sequence import Sequence
    from extrags.training import reconstruct

    with keeping_last_good(slot):
        result = reconstruct(Sequence.load(slot.open(sequence) / "sequence"), config)
    result.scene.save(slot.path / "scene")
    (slot.path / "history.json").write_text(json.dumps(result.history))
    slot.counts["n_gaussians"] = len(result.scene.gaussians)
