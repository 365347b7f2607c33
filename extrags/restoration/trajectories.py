"""Restoration of whole trajectories, in batches that are independent of each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from extrags.cameras import Cameras
from extrags.confidence import PerceptualDifference
from extrags.config import DEFAULT_PROFILE, PROFILES, CoarseConfig, EnhanceConfig
from extrags.errors import ShapeError
from extrags.pseudo_views import PseudoViews
from extrags.restoration.backends import train_enhancer
from extrags.restoration.clips import choose_views, make_pseudo_observations
from extrags.restoration.keyframes import Keyframes, follows_keyframes, make_keyframes
from extrags.restoration.protocol import Enhancer
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.threads import one_torch_thread
from extrags.view_synthesis.gather import gather_references
from extrags.view_synthesis.references import ReferenceViews

__all__ = ["at_working_size", "restore", "restore_batch", "restore_keyframes", "restored_batches"]


@one_torch_thread()
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
        config: backend and budgets; None takes those of the profile `balanced`.
        coarse: settings the scene was reconstructed with; None takes those of the profile `balanced`.
        measure: behind the pixel-level confidence; None takes LPIPS where its weights can be found.
        enhancer: the scene's restorer (`train_enhancer`); None prepares it.

    Raises:
        ShapeError: when there is no view at all.
        ExtragsError: as `extrags.restoration.backends.train_enhancer`.
    """
    config = PROFILES[DEFAULT_PROFILE].enhance if config is None else config
    trajectories = [cameras for cameras in trajectories if len(cameras) > 1]
    if not trajectories:
        raise ShapeError(f"{sequence.name}: no trajectory has a view beyond its start; nothing to restore")
    if enhancer is None:
        coarse = PROFILES[DEFAULT_PROFILE].coarse if coarse is None else coarse
        enhancer = train_enhancer(scene, sequence, config, coarse)
    measure = PerceptualDifference.available() if measure is None else measure
    parts = list(restored_batches(scene, sequence, trajectories, enhancer, config, measure))
    return PseudoViews.concatenated(parts).quantised()


def at_working_size(
    sequence: EndoscopicSequence, trajectories: Sequence[Cameras], config: EnhanceConfig
) -> tuple[EndoscopicSequence, list[Cameras]]:
    """Frames and virtual views at the size that views are restored at (`enhance.max_width`).

    Args:
        sequence: frames of any size; those that are small enough, and pinholes, are returned as they are.
        trajectories: virtual views.
        config: the settings.
    """
    width = config.working_width(sequence.width)
    return sequence.as_pinhole().at_most_width(width), [
        cameras.at_most_width(width) for cameras in trajectories
    ]


def restored_batches(
    scene: Scene,
    sequence: EndoscopicSequence,
    trajectories: Sequence[Cameras],
    enhancer: Enhancer,
    config: EnhanceConfig,
    measure: PerceptualDifference,
) -> Iterator[PseudoViews]:
    """Restore keyframes, then one batch of clips after the other.

    Args:
        scene: the coarse scene.
        sequence: its frames; only training frames are used.
        trajectories: all of them, the real start of each first.
        enhancer: the scene's restorer.
        config: as `restore_batch`.
        measure: behind the pixel-level confidence.

    Yields:
        The views of each batch.

    Raises:
        ShapeError: when a batch has no view at all.
    """
    scene = scene.to("cpu")
    sequence, trajectories = at_working_size(sequence, trajectories, config)
    references = gather_references(scene, sequence, sequence.train)
    keyframes = restore_keyframes(scene, sequence, trajectories, enhancer, config, references=references)
    for batch in range(config.batches(len(trajectories))):
        yield restore_batch(
            scene,
            sequence,
            trajectories,
            enhancer,
            config,
            batch,
            measure,
            keyframes=keyframes,
            references=references,
        )


@one_torch_thread()
def restore_keyframes(
    scene: Scene,
    sequence: EndoscopicSequence,
    trajectories: Sequence[Cameras],
    enhancer: Enhancer,
    config: EnhanceConfig,
    *,
    references: ReferenceViews | None = None,
) -> Keyframes:
    """Choose and restore the views that all clips will follow, among those that will be restored.

    Args:
        scene: the coarse scene.
        sequence: its frames; only training frames are used.
        trajectories: all of them, the real start of each first; at least one.
        enhancer: the scene's restorer.
        config: number of keyframes and of views.
        references: training views of the scene at the working size, where they are gathered already.

    Returns:
        The keyframes; none with `enhance.keyframes=0`, or for a restorer that follows none.
    """
    if config.keyframes == 0 or not follows_keyframes(enhancer):
        return Keyframes.none(trajectories[0].at_most_width(config.working_width(trajectories[0].width)))
    sequence, trajectories = at_working_size(sequence, trajectories, config)
    if references is None:
        references = gather_references(scene, sequence, sequence.train)
    views = choose_views([len(cameras) for cameras in trajectories], config.max_views)
    clips = [cameras[chosen] for cameras, chosen in zip(trajectories, views, strict=True)]
    return make_keyframes(scene, references, clips, enhancer, config)


@one_torch_thread()
def restore_batch(
    scene: Scene,
    sequence: EndoscopicSequence,
    trajectories: Sequence[Cameras],
    enhancer: Enhancer,
    config: EnhanceConfig,
    batch: int,
    measure: PerceptualDifference,
    *,
    keyframes: Keyframes | None = None,
    references: ReferenceViews | None = None,
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
        keyframes: restored views that all batches follow (`restore_keyframes`); None for none.
        references: training views of the scene at the working size, where they are gathered already.

    Raises:
        ShapeError: when the batch has no view at all.
    """
    sequence, trajectories = at_working_size(sequence, trajectories, config)
    views = choose_views([len(cameras) for cameras in trajectories], config.max_views)
    first = batch * config.clips_per_batch
    chosen = range(first, min(first + config.clips_per_batch, len(trajectories)))
    if references is None:
        references = gather_references(scene, sequence, sequence.train)
    return make_pseudo_observations(
        scene,
        references,
        [trajectories[index][views[index]] for index in chosen],
        enhancer,
        replace(measure, raw=config.pixel_confidence == "raw"),
        count=config.references,
        reference=config.reference,
        iou=config.iou,
        first_index=first,
        invented=None if keyframes is None else keyframes.invented(references.transfer),
    )
