"""enhance: trains the restorer, restores clips in batches, and concatenates the pseudo-observations."""

from __future__ import annotations

from extrags.config import CoarseConfig, EnhanceConfig
from extrags.errors import WeightsError
from extrags.store import Ref, Slot
from tasks.stage import stage
from tasks.weights import Weights, restorer_digest

__all__ = ["assemble", "keyed_settings", "restore", "train"]

RESTORER = "restorer"


def keyed_settings(config: EnhanceConfig) -> EnhanceConfig:
    """The settings as they are part of the key: what `auto` leaves to the machine is settled.

    bfloat16 and float32, a device and a processor give different views: under `auto` one key would hold for
    all of them. Settings that the backend does not read stay as they are, so that machines share its views.
    """
    from extrags.devices import chosen_device
    from extrags.restoration.diffusion.embedded import EmbeddedEnhancer, chosen_precision

    if config.backend == EmbeddedEnhancer.name:
        return config.model_copy(update={"precision": chosen_precision(config)})
    if config.backend == "classical":
        return config
    # Of a backend of another program nobody knows which of these it reads.
    settled = {}
    for name, part in (("pretrained", config.pretrained), ("checkpoint", config.checkpoint)):
        if part.device == "auto":
            device = chosen_device("auto", f"enhance.{name}.device").type
            settled[name] = part.model_copy(update={"device": device})
    return config.model_copy(update=settled)


# The model's digest is in the key: with another model in the same place, this is another restorer.
@stage("enhance-train", version=6)
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
    frames = slot.load(EndoscopicSequence, sequence)
    train_enhancer(slot.load(Scene, scene), frames, config, coarse).save(slot.path / RESTORER)


# The weights' digest is in the key; where their file lies is not.
@stage("enhance-restore", version=5, ignore=("weights",))
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
    """Render and restore one batch of trajectories and compute its confidences; writes `pseudo/`."""
    from extrags.exploration import Exploration
    from extrags.restoration.backends import load_enhancer
    from extrags.restoration.trajectories import restore_batch
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence

    views = restore_batch(
        slot.load(Scene, scene),
        slot.load(EndoscopicSequence, sequence),
        slot.load(Exploration, explore).trajectories,
        load_enhancer(slot.open(restorer) / RESTORER),
        config,
        batch,
        weights.perceptual_difference(),
    )
    slot.save(views)
    slot.counts["views"] = len(views)


@stage("enhance", version=2)
def assemble(slot: Slot, parts: list[Ref]) -> None:
    """Concatenate the batches; writes `pseudo/`."""
    from extrags.pseudo_views import PseudoViews

    views = PseudoViews.concatenated([slot.load(PseudoViews, part) for part in parts])
    slot.save(views)
    slot.counts.update(views=len(views), changed_share=round(views.changed_share, 4))
