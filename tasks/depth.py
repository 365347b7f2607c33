"""depth: depth of the training frames from these alone, for sources without it."""

from __future__ import annotations

from extrags.config import DepthConfig, PosesConfig
from extrags.depth.weights import BUNDLED
from extrags.errors import WeightsError
from extrags.store import Ref, Slot
from tasks.stage import stage
from tasks.weights import depth_completion_digest, depth_monocular_digest

__all__ = ["depth", "depth_frames", "keyed_settings", "triangulation_settings"]

TRIANGULATION = frozenset(
    {
        "max_width",
        "n_features",
        "peak_threshold",
        "edge_threshold",
        "sequential_overlap",
        "exhaustive_below",
        "seed",
    }
)
"""Settings of the poses stage that triangulation with known poses uses."""


def triangulation_settings(config: PosesConfig) -> PosesConfig:
    """The settings that triangulation uses, all others at their defaults: these are not part of the key."""
    return PosesConfig(**config.model_dump(include=set(TRIANGULATION)))


def keyed_settings(config: DepthConfig) -> DepthConfig:
    """The settings as they are part of the key: with a device, and without the places of weights and models.

    A device and a processor give depths that differ by rounding: under `auto` the key would hold for either,
    so that it is settled where the key is made. cuda stays what it is where there is none: what was made on
    another machine can be read.
    """
    from extrags.devices import chosen_device

    device = chosen_device("auto", "depth.device").type if config.device == "auto" else config.device
    return config.model_copy(update={"device": device, "monocular": None, "completion": BUNDLED})


# The digests stand for the content of weights; the task finds them by the settings again.
@stage("depth", version=8, ignore=("monocular", "completion"))
def depth(
    slot: Slot,
    sequence: Ref,
    config: DepthConfig,
    features: PosesConfig,
    weights_digest: str | None,
    monocular_digest: str | None,
    monocular: str | None = None,
    completion: str = BUNDLED,
) -> None:
    """Estimate the depth of the training frames; writes `depth/`.

    Args:
        slot: the artefact to write.
        sequence: the training frames alone, with poses.
        config: what to use, from `keyed_settings`.
        features: settings of features and matching, from `triangulation_settings`.
        weights_digest: content of the completion network's weights; None without them.
        monocular_digest: content of the monocular network's folder.
        monocular: that folder; None without.
        completion: weights of the completion network, as in the settings.
    """
    from extrags.depth.estimate import estimate_depth
    from extrags.sequence import EndoscopicSequence

    if depth_monocular_digest(monocular) != monocular_digest:
        raise WeightsError(
            f"the model of depth.monocular={monocular} is not the one this run began with: it changed "
            "meanwhile, or this worker sees other files; run again"
        )
    config = config.model_copy(update={"monocular": monocular, "completion": completion})
    if depth_completion_digest(config) != weights_digest:
        raise WeightsError(
            f"the weights of depth.completion={completion} are not those this run began with: they changed "
            "meanwhile, or this worker sees other files; run again"
        )
    frames = slot.load(EndoscopicSequence, sequence)
    estimate = estimate_depth(frames, config, features)
    slot.save(estimate)
    slot.counts.update(
        frames=len(frames),
        summary=estimate.summary,
        n_points=estimate.report["n_points"],
        points_from=estimate.report["points_from"],
        median_expected_error=estimate.report["median_expected_error"],
        agreeing_share=estimate.report["agreeing_share"],
    )


@stage("depth-frames", version=1)
def depth_frames(slot: Slot, sequence: Ref, depth: Ref) -> None:
    """Frames with the estimated depth of the training frames; writes `sequence/`."""
    from extrags.depth.estimate import DepthEstimate
    from extrags.depth.training_depth import with_training_depth
    from extrags.sequence import EndoscopicSequence

    frames = slot.load(EndoscopicSequence, sequence)
    found = with_training_depth(frames, slot.load(DepthEstimate, depth))
    slot.save(found)
    slot.counts.update(frames=len(found), train=len(found.train), test=len(found.test))
