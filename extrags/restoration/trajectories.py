"""Restoration of whole trajectories, in batches that are independent of each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from extrags.cameras import Cameras
from extrags.confidence import PerceptualDifference
from extrags.config import CoarseConfig, EnhanceConfig
from extrags.pseudo_views import PseudoViews
from extrags.restoration.backends import train_enhancer
from extrags.restoration.clips import choose_views, make_pseudo_observations
from extrags.restoration.protocol import Enhancer
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.threads import one_torch_thread
from extrags.view_synthesis.gather import gather_references

__all__ = ["restore", "restore_batch"]


def restore(
    scene: Scene,
    sequence: EndoscopicSequence,
    trajectories: Sequence[Cameras],
    config: EnhanceConfig | None = None,
    coarse: CoarseConfig | None = None,
    *,
    measure: PerceptualDifference | None = None,
    enhancer: Enhancer | None = None,
) -> PseudoViews:
    """Restore the views of virtual trajectories: prepare the scene's restorer, then all batches of clips.

    Args:
        scene: the coarse scene.
        sequence: its frames; only training frames are used.
        trajectories: virtual views of each trajectory, its real start first (`Exploration.trajectories`);
            those without another are left out.
        config: backend and budgets; None takes the defaults.
        coarse: settings the scene was reconstructed with; None takes the defaults.
        measure: behind the pixel-level confidence; None takes LPIPS where its weights can be found.
        enhancer: the scene's restorer (`train_enhancer`); None prepares it.

    Raises:
        ShapeError: when there is no view at all.
        ExtragsError: as `extrags.restoration.backends.train_enhancer`.
    """
    config = EnhanceConfig() if config is None else config
    if enhancer is None:
        enhancer = train_enhancer(scene, sequence, config, CoarseConfig() if coarse is None else coarse)
    measure = PerceptualDifference.available() if measure is None else measure
    trajectories = [cameras for cameras in trajectories if len(cameras) > 1]
    parts = [
        restore_batch(scene, sequence, trajectories, enhancer, config, batch, measure)
        for batch in range(config.batches(len(trajectories)))
    ]
    return PseudoViews.concatenated(parts).quantised()


@one_torch_thread()
def restore_batch(
    scene: Scene,
    sequence: EndoscopicSequence,
    trajectories: Sequence[Cameras],
    enhancer: Enhancer,
    config: EnhanceConfig,
    batch: int,
    measure: PerceptualDifference,
) -> PseudoViews:
    """Render, restore and weigh one batch of trajectories; batches are independent of each other.

    Args:
        scene: the coarse scene.
        sequence: its frames; only training frames are used.
        trajectories: all of them, the real start of each first.
        enhancer: the scene's restorer.
        config: number of views and of clips per batch, and the form of the pixel-level confidence.
        batch: which batch.
        measure: behind the pixel-level confidence; whether it is `raw` is the settings' to say.

    Raises:
        ShapeError: when the batch has no view at all.
    """
    views = choose_views([len(cameras) for cameras in trajectories], config.max_views)
    first = batch * config.clips_per_batch
    chosen = range(first, min(first + config.clips_per_batch, len(trajectories)))
    return make_pseudo_observations(
        scene,
        gather_references(scene, sequence, sequence.train),
        [trajectories[index][views[index]] for index in chosen],
        enhancer,
        replace(measure, raw=config.pixel_confidence == "raw"),
        count=config.references,
        reference=config.reference,
        iou=config.iou,
        first_index=first,
    )
