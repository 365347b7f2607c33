"""finetune: judges on left-out frames how much to keep, and optimises on real and restored views."""

from __future__ import annotations

from functools import partial

from extrags.config import CoarseConfig, EnhanceConfig, FinetuneConfig
from extrags.store import Ref, Slot
from tasks.coarse import HISTORY
from tasks.divergence import keep_last_finite_scene
from tasks.enhance import RESTORER
from tasks.stage import stage
from tasks.weights import Weights

__all__ = ["finetune", "finetuning_settings", "judge"]


def finetuning_settings(config: FinetuneConfig) -> FinetuneConfig:
    """The settings that `finetune` reads: those of the judge, which has judged, are not part of the key."""
    return config.model_copy(update={"judge": FinetuneConfig.model_fields["judge"].default})


# The weights' digest is in the key; where their file lies is not. Batches only bound the memory.
@stage("finetune-judge", version=34, ignore=("weights", "clips_per_batch"))
def judge(
    slot: Slot,
    scene: Ref,
    sequence: Ref,
    explore: Ref | None,
    restorer: Ref | None,
    config: FinetuneConfig,
    enhance: EnhanceConfig,
    coarse: CoarseConfig,
    weights_digest: str | None,
    weights: Weights,
    clips_per_batch: int | None = None,
    device: str = "cpu",
) -> None:
    """Decide how much of the fine-tuning to keep; writes `judgement.json`.

    Without exploration there are no virtual views, and real views alone are judged. Trials are optimised on
    the `device`.
    """
    from extrags.devices import chosen_device
    from extrags.exploration import Exploration
    from extrags.finetuning_judge import judge_finetuning
    from extrags.restoration.backends import load_enhancer
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence

    if clips_per_batch is not None:
        enhance = enhance.model_copy(update={"clips_per_batch": clips_per_batch})
    judgement = judge_finetuning(
        slot.load(Scene, scene).to(chosen_device(device, "device")),
        slot.load(EndoscopicSequence, sequence),
        () if explore is None else slot.load(Exploration, explore).trajectories,
        None if restorer is None else load_enhancer(slot.open(restorer) / RESTORER),
        config,
        enhance,
        coarse,
        measure=weights.perceptual_difference(),
    )
    slot.save(judgement)
    slot.counts["amount"] = judgement.amount
    slot.counts["holes_only"] = int(judgement.holes_only)


@stage("finetune", version=25)
def finetune(
    slot: Slot,
    scene: Ref,
    sequence: Ref,
    pseudo_views: Ref | None,
    config: FinetuneConfig,
    coarse: CoarseConfig,
    device: str = "cpu",
) -> None:
    """Fine-tune the coarse scene on the `device`; writes `scene/` and `history.json`.

    Without pseudo-views it trains on the real views alone: the control of a comparison of methods.
    """
    from extrags import training
    from extrags.devices import chosen_device
    from extrags.pseudo_views import PseudoViews
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence
    from extrags.training.frame_weights import FrameWeights

    # Of the coarse stage. Frames whose poses or colours it corrected are compared anew.
    known = (slot.open(scene) / FrameWeights.stored_as).exists()
    counts = slot.store.manifest(scene).counts
    corrected = bool(counts.get("refined_poses") or counts.get("corrected_colors"))
    weights = slot.load(FrameWeights, scene) if known and not corrected else None
    start, frames = slot.load(Scene, scene), slot.load(EndoscopicSequence, sequence)
    start = start.to(chosen_device(device, "device"))
    with keep_last_finite_scene(slot):
        # Loaded once a round, and dropped as soon as they are compact: no name holds the virtual views here.
        result = training.finetune(
            start,
            frames,
            None if pseudo_views is None else partial(slot.load, PseudoViews, pseudo_views),
            config,
            coarse,
            frame_weights=weights,
        )
    slot.save(result.scene)
    slot.save_json(HISTORY, result.history)
    slot.counts["n_gaussians"] = len(result.scene.gaussians)
