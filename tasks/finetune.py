"""finetune: real and restored views together."""

from __future__ import annotations

import json

from extrags.config import CoarseConfig, FinetuneConfig
from extrags.store import Ref, Slot
from tasks.divergence import keeping_last_good
from tasks.stage import stage

__all__ = ["finetune"]


@stage("finetune", version=3)
def finetune(
    slot: Slot,
    scene: Ref,
    sequence: Ref,
    pseudo: Ref | None,
    config: FinetuneConfig,
    coarse: CoarseConfig,
) -> None:
    """Fine-tune the coarse scene; writes `scene/` and `history.json`.

    Without pseudo-observations only the real views count: the control of a comparison.
    """
    from extrags.pseudo_views import PseudoViews
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence
    from extrags.training import finetune as optimise_further

    observations = None if pseudo is None else PseudoViews.load(slot.open(pseudo) / "pseudo")
    with keeping_last_good(slot):
        result = optimise_further(
            Scene.load(slot.open(scene) / "scene"),
            EndoscopicSequence.load(slot.open(sequence) / "sequence"),
            observations,
            config,
            coarse,
        )
    result.scene.save(slot.path / "scene")
    (slot.path / "history.json").write_text(json.dumps(result.history))
    slot.counts["n_gaussians"] = len(result.scene.gaussians)
