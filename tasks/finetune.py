"""finetune: optimises the coarse scene on real and restored views."""

from __future__ import annotations

from extrags.config import CoarseConfig, FinetuneConfig
from extrags.store import Ref, Slot
from tasks.coarse import HISTORY
from tasks.divergence import keep_last_finite_scene
from tasks.stage import stage

__all__ = ["finetune"]


@stage("finetune", version=4)
def finetune(
    slot: Slot,
    scene: Ref,
    sequence: Ref,
    pseudo_views: Ref | None,
    config: FinetuneConfig,
    coarse: CoarseConfig,
) -> None:
    """Fine-tune the coarse scene; writes `scene/` and `history.json`.

    Without pseudo-views it trains on the real views alone: the control of a comparison of methods.
    """
    from extrags import training
    from extrags.pseudo_views import PseudoViews
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence

    views = None if pseudo_views is None else slot.load(PseudoViews, pseudo_views)
    start, frames = slot.load(Scene, scene), slot.load(EndoscopicSequence, sequence)
    with keep_last_finite_scene(slot):
        result = training.finetune(start, frames, views, config, coarse)
    slot.save(result.scene)
    slot.save_json(HISTORY, result.history)
    slot.counts["n_gaussians"] = len(result.scene.gaussians)
