"""enhance: the restorer is trained, clips are restored in batches, pseudo-observations are joined."""

from __future__ import annotations

from extrags.config import CoarseConfig, EnhanceConfig
from extrags.errors import WeightsError
from extrags.store import Ref, Slot
from tasks.stage import stage
from tasks.weights import Weights, restorer_digest

__all__ = ["assemble", "restore", "train"]


# The model's digest is in the key: with another model in the same place, this is another restorer.
@stage("enhance-train", version=3)
def train(
    slot: Slot,
    scene: Ref,
    sequence: Ref,
    config: EnhanceConfig,
    coarse: CoarseConfig,
    model_digest: str | None,
) -> None:
    """Train the scene's restorer on its own pairs, or prepare a pretrained one; writes `restorer/`."""
    from extrags.restoration.backends import train_enhancer
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence

    if restorer_digest(config) != model_digest:
        raise WeightsError(
            f"the model of enhance.backend={config.backend} is not the one this run began with: it changed "
            "meanwhile, or this worker sees other files; run again"
        )
    enhancer = train_enhancer(
        Scene.load(slot.open(scene) / "scene"),
        EndoscopicSequence.load(slot.open(sequence) / "sequence"),
        config,
        coarse,
    )
    enhancer.save(slot.path / "restorer")


# The weights' digest is in the key; where their file lies is not.
@stage("enhance-restore", version=3, ignore=("weights",))
def restore(
    slot: Slot,
    scene: Ref,
    sequence: Ref,
    explore: Ref,
    restorer: Ref,
    batch: int,
    config: EnhanceConfig,
    weights_digest: str | None,
    weights: Weights,
) -> None:
    """Render, restore and weigh one batch of trajectories; writes `pseudo/`."""
    from extrags.confidence import PerceptualDifference
    from extrags.exploration import Exploration
    from extrags.metrics.lpips import Lpips
    from extrags.restoration.backends import load_enhancer
    from extrags.restoration.clips import choose_views, make_pseudo_observations
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence
    from extrags.view_synthesis.references import ReferenceViews

    coarse = Scene.load(slot.open(scene) / "scene")
    posed = EndoscopicSequence.load(slot.open(sequence) / "sequence")
    trajectories = Exploration.load(slot.open(explore)).trajectories
    views = choose_views([len(cameras) for cameras in trajectories], config.max_views)
    first = batch * config.clips_per_batch
    chosen = range(first, min(first + config.clips_per_batch, len(trajectories)))
    lpips = None if weights.path is None else Lpips.load(weights.path, net=weights.net)
    observations = make_pseudo_observations(
        coarse,
        ReferenceViews.gather(coarse, posed, posed.train),
        [trajectories[index][views[index]] for index in chosen],
        load_enhancer(slot.open(restorer) / "restorer"),
        PerceptualDifference(lpips, weights.reason),
        count=config.references,
        first_index=first,
    )
    observations.save(slot.path / "pseudo")
    slot.counts["views"] = len(observations)


@stage("enhance", version=2)
def assemble(slot: Slot, parts: list[Ref]) -> None:
    """Join the batches; writes `pseudo/`."""
    from extrags.pseudo_views import PseudoViews

    observations = PseudoViews.concatenated([PseudoViews.load(slot.open(part) / "pseudo") for part in parts])
    observations.save(slot.path / "pseudo")
    slot.counts.update(views=len(observations), changed_share=round(observations.changed_share, 4))
