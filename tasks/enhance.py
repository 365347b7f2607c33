"""enhance: trains the restorer, restores keyframes, then clips in batches, and concatenates these.

`keyframes` restores a few views one after the other; every batch of clips follows them, and no other batch.
"""

from __future__ import annotations

from extrags.config import CaptionConfig, CoarseConfig, EnhanceConfig
from extrags.errors import WeightsError
from extrags.store import Ref, Slot
from tasks.stage import stage
from tasks.weights import Weights, restorer_digest

__all__ = [
    "assemble",
    "judging_settings",
    "keyed_settings",
    "keyframe_settings",
    "keyframes",
    "restore",
    "restoring_settings",
    "train",
]

RESTORER = "restorer"


_OF_RESTORATION = frozenset(
    {"clips_per_batch", "iou", "max_views", "max_width", "pixel_confidence", "reference", "references"}
)
"""Settings that the stage `enhance-restore` reads itself; all others work through the restorer."""

_OF_KEYFRAMES = frozenset({"keyframes", "max_views", "max_width", "reference", "references"})
"""Settings that the stage `enhance-keyframes` reads itself."""

_OF_EMBEDDED = frozenset(
    {
        "backend",
        "batch",
        "channels",
        "crop",
        "depth_from_image",
        "fold_iterations",
        "folds",
        "judge",
        "judge_pairs",
        "learning_rate",
        "max_width",
        "precision",
        "reference",
        "references",
        "samples",
        "scene_learning_rate",
        "seamless_cloning",
        "seed",
        "steps",
        "synthetic_views",
        "train_iterations",
    }
)

_OF_TRAINING: dict[str, frozenset[str]] = {
    "embedded": _OF_EMBEDDED,
    "classical": frozenset({"backend"}),
    **dict.fromkeys(
        ("wan-vace", "stable-video", "ltx", "sd-img2img", "sd-inpaint"),
        frozenset({"backend", "seed", "caption", "pretrained"}),
    ),
    "dynamicrafter": frozenset({"backend", "seed", "caption", "checkpoint"}),
}
"""Settings that the stage `enhance-train` reads, by backend; of another program's backend, all."""

_OF_ASKING = ("file", "retries", "retry_wait_s", "timeout_s")
"""Settings of captions that decide how they are got, not what they are; the file counts by its content."""


def keyed_settings(config: EnhanceConfig) -> EnhanceConfig:
    """The settings as they are part of the key of `train`: those its backend reads, others at their defaults.

    What `auto` leaves to the machine is settled: bfloat16 and float32, a device and a processor give
    different views, and under `auto` one key would hold for all of them. Weights and captions count by their
    content; where a pretrained model or a clone lies is counted, since the restorer refers to it.
    """
    from extrags.devices import chosen_device
    from extrags.restoration.diffusion.backend import EMBEDDED
    from extrags.restoration.diffusion.precision import chosen_precision

    counted = _OF_TRAINING.get(config.backend, frozenset(EnhanceConfig.model_fields) - {"pretrained_weights"})
    config = _only(config, counted)
    caption = {name: CaptionConfig.model_fields[name].default for name in _OF_ASKING}
    settled: dict[str, object] = {"caption": config.caption.model_copy(update=caption)}
    if config.backend == EMBEDDED.name:
        settled["precision"] = chosen_precision(config)
    # Of a backend of another program nobody knows which of these it reads.
    for name, part in (("pretrained", config.pretrained), ("checkpoint", config.checkpoint)):
        if name in counted and part.device == "auto":
            device = chosen_device("auto", f"enhance.{name}.device").type
            settled[name] = part.model_copy(update={"device": device})
    return config.model_copy(update=settled)


def restoring_settings(config: EnhanceConfig) -> EnhanceConfig:
    """The settings that `restore` reads, all others at their defaults: the restorer stands for these."""
    return _only(config, _OF_RESTORATION)


def keyframe_settings(config: EnhanceConfig) -> EnhanceConfig:
    """The settings that `keyframes` reads, all others at their defaults."""
    return _only(config, _OF_KEYFRAMES)


def judging_settings(config: EnhanceConfig) -> EnhanceConfig:
    """The settings that the judge of the fine-tuning restores with: it has a number of views of its own."""
    return _only(config, (_OF_RESTORATION | _OF_KEYFRAMES) - {"clips_per_batch", "max_views"})


def _only(config: EnhanceConfig, names: frozenset[str]) -> EnhanceConfig:
    return EnhanceConfig().model_copy(update={name: getattr(config, name) for name in names})


# The model's digest is in the key: with another model in the same place, this is another restorer.
@stage("enhance-train", version=33, ignore=("given",))
def train(
    slot: Slot,
    scene: Ref,
    sequence: Ref,
    config: EnhanceConfig,
    coarse: CoarseConfig,
    model_digest: str | None,
    given: EnhanceConfig | None = None,
    device: str = "cpu",
) -> None:
    """Train the scene's restorer on its own pairs, or prepare a pretrained one; writes `restorer/`.

    Args:
        slot: the artefact to write.
        scene: the coarse scene.
        sequence: the training frames.
        config: from `keyed_settings`.
        coarse: settings of leave-out reconstructions.
        model_digest: content of weights and captions.
        given: the settings of the run, which say where these lie and how captions are asked for.
        device: of leave-out reconstructions, for a backend that makes some.
    """
    from extrags.devices import chosen_device
    from extrags.restoration.backends import train_enhancer
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence

    if given is not None:
        caption = {name: getattr(given.caption, name) for name in _OF_ASKING}
        config = config.model_copy(
            update={
                "pretrained_weights": given.pretrained_weights,
                "caption": config.caption.model_copy(update=caption),
            }
        )
    if restorer_digest(config) != model_digest:
        raise WeightsError(
            f"the model of enhance.backend={config.backend} is not the one this run began with: it changed "
            "meanwhile, or this worker sees other files; run again"
        )
    frames = slot.load(EndoscopicSequence, sequence)
    shown = slot.load(Scene, scene).to(chosen_device(device, "device"))
    train_enhancer(shown, frames, config, coarse).save(slot.path / RESTORER)


@stage("enhance-keyframes", version=14)
def keyframes(
    slot: Slot, scene: Ref, sequence: Ref, explore: Ref, restorer: Ref, config: EnhanceConfig
) -> None:
    """Choose and restore the views that all batches follow; writes `keyframes/`.

    There are none where nothing is missing, or the restorer does not follow any.
    """
    from extrags.exploration import Exploration
    from extrags.restoration.backends import load_enhancer
    from extrags.restoration.trajectories import restore_keyframes
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence

    found = restore_keyframes(
        slot.load(Scene, scene),
        slot.load(EndoscopicSequence, sequence),
        slot.load(Exploration, explore).trajectories,
        load_enhancer(slot.open(restorer) / RESTORER),
        config,
    )
    slot.save(found)
    slot.counts["views"] = len(found)


# The weights' digest is in the key; where their file lies is not.
@stage("enhance-restore", version=18, ignore=("weights",))
def restore(
    slot: Slot,
    scene: Ref,
    sequence: Ref,
    explore: Ref,
    restorer: Ref,
    keyframes: Ref | None,
    batch: int,
    config: EnhanceConfig,
    weights_digest: str | None,
    weights: Weights,
) -> None:
    """Render and restore one batch of trajectories and compute its confidences; writes `pseudo/`.

    Without keyframes, every view is restored alone.
    """
    from extrags.exploration import Exploration
    from extrags.restoration.backends import load_enhancer
    from extrags.restoration.keyframes import Keyframes
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
        keyframes=None if keyframes is None else slot.load(Keyframes, keyframes),
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
