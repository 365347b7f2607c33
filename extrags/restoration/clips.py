"""Pseudo-observations of trajectories: clips rendered, restored, and blended with the rendering."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrags.cameras import Cameras
from extrags.confidence import PerceptualDifference, image_confidence, pixel_confidence
from extrags.config import IouSet, ReferenceChoice
from extrags.errors import ShapeError
from extrags.events import Progress, emit
from extrags.metrics.filters import filter_separable, gaussian_weights
from extrags.pseudo_views import PseudoViews
from extrags.restoration.protocol import Clip, Enhancer, Restoration, restore_clips
from extrags.scene import Scene
from extrags.view_synthesis.conditioning import condition, observe_views
from extrags.view_synthesis.invented import InventedViews, with_invented
from extrags.view_synthesis.references import ReferenceViews

__all__ = [
    "as_images",
    "as_planes",
    "choose_views",
    "keep_known",
    "make_pseudo_observations",
    "pseudo_observations",
    "render_clips",
]

FEATHER_SIGMA_PX = 2.0
FEATHER_RADIUS_PX = 6


def choose_views(lengths: Sequence[int], max_views: int) -> list[Int[np.ndarray, "n"]]:
    """Which views of each trajectory are restored when there are too many.

    The first view of a trajectory is a real one and is left out. What remains is thinned evenly; the last
    view, the farthest from what is known, always stays. Where there are more trajectories than views, the
    first `max_views`, which exploration accepted first, keep their last view alone; the others have none.

    Args:
        lengths: views of each trajectory, the start included.
        max_views: at most so many in all.
    """
    longer = np.array(lengths) > 1
    available = np.where(longer & (np.cumsum(longer) <= max_views), np.array(lengths) - 1, 0).tolist()
    total = sum(available)
    longest = sum(count > 0 for count in available)
    # One view each, then the rest in proportion to what is left: rounding down never exceeds the budget.
    spare = min(max_views, total) - longest
    left = max(1, total - longest)
    counts = [1 + (count - 1) * spare // left if count else 0 for count in available]
    return [
        np.unique(np.linspace(length - 1, 1, count).round().astype(np.int64))
        if count
        else np.zeros(0, np.int64)
        for length, count in zip(lengths, counts, strict=True)
    ]


def render_clips(
    scene: Scene,
    references: ReferenceViews,
    trajectories: Sequence[Cameras],
    *,
    count: int,
    reference: ReferenceChoice = "covisibility",
    iou: IouSet = "reference",
    first_index: int = 0,
    exposure: Sequence[Float[Tensor, "t"] | None] | None = None,
    invented: InventedViews | None = None,
) -> list[Clip]:
    """Render trajectories, and warp real views into them.

    Args:
        scene: the coarse scene.
        references: its training views.
        trajectories: virtual views; empty ones give no clip.
        count: references blended per view.
        reference: which of them U_img compares with.
        iou: set that their overlap is divided by.
        first_index: index of the first clip; a batch of many passes where it begins.
        exposure: gain of each view of each trajectory; None is 1, the mean of the training frames.
        invented: what restored keyframes show where nothing else knows the surface.
    """
    clips = []
    for offset, cameras in enumerate(trajectories):
        if len(cameras) == 0:
            continue
        gain = None if exposure is None else exposure[offset]
        observation = observe_views(
            scene, references, cameras, count=count, reference=reference, exposure=gain
        )
        confidence = image_confidence(observation.seen, references.seen[observation.reference], iou)
        clips.append(
            Clip(
                index=first_index + offset,
                cameras=cameras,
                layers=with_invented(observation.layers, invented, cameras, gain),
                transfer=references.transfer,
                reference=observation.reference.numpy(),
                image_confidence=confidence.numpy().astype(np.float32),
                exposure=None if gain is None else gain.numpy(),
            )
        )
    return clips


def keep_known(
    rendered: Float[np.ndarray, "v h w 3"],
    restored: Float[np.ndarray, "v h w 3"],
    uncertainty: Float[np.ndarray, "v h w"],
) -> tuple[Float[np.ndarray, "v h w 3"], Float[np.ndarray, "v h w"]]:
    """`u * restored + (1 - u) * rendered`, with u feathered so that no seam is left.

    Args:
        rendered: of the scene.
        restored: of the enhancer.
        uncertainty: 1 in the holes of the scene.

    Returns:
        The blend, and the feathered uncertainty. Feathering never lowers the uncertainty of a hole.

    Raises:
        ShapeError: when the sizes differ.
    """
    from kornia.morphology import dilation

    if rendered.shape != restored.shape or uncertainty.shape != rendered.shape[:-1]:
        raise ShapeError(
            f"images {rendered.shape}, {restored.shape} and uncertainty {uncertainty.shape} do not fit"
        )
    raw = torch.from_numpy(np.ascontiguousarray(uncertainty, dtype=np.float32))[:, None]
    # Widened first: blurring alone would let the dark rim of a hole through.
    side = 2 * int(FEATHER_SIGMA_PX) + 1
    wide = dilation(raw, torch.ones(side, side))
    window = gaussian_weights(FEATHER_SIGMA_PX, FEATHER_RADIUS_PX)
    feathered = torch.maximum(raw, filter_separable(wide, window, window)).clamp(0, 1)[:, 0].numpy()
    u = feathered[..., None]
    return np.asarray(u * restored + (1 - u) * rendered, dtype=np.float32), feathered


def pseudo_observations(
    clips: Sequence[Clip],
    restorations: Sequence[Restoration],
    measure: PerceptualDifference,
) -> PseudoViews:
    """Targets, weights and depth for the fine-tuning from restored clips.

    Args:
        clips: at least one.
        restorations: one per clip.
        measure: behind the pixel-level confidence; named in the provenance.

    Raises:
        ShapeError: when the numbers differ or there is no clip.
    """
    if len(clips) != len(restorations) or not clips:
        raise ShapeError(f"{len(clips)} clips and {len(restorations)} restorations")
    parts = [
        _pseudo_observation(clip, restoration, measure)
        for clip, restoration in zip(clips, restorations, strict=True)
    ]
    return PseudoViews.concatenated(parts)


def make_pseudo_observations(
    scene: Scene,
    references: ReferenceViews,
    trajectories: Sequence[Cameras],
    enhancer: Enhancer,
    measure: PerceptualDifference,
    *,
    count: int,
    reference: ReferenceChoice = "covisibility",
    iou: IouSet = "reference",
    first_index: int = 0,
    invented: InventedViews | None = None,
) -> PseudoViews:
    """Render, restore and weigh trajectories: the work of one batch of clips.

    Args:
        scene: the coarse scene.
        references: its training views.
        trajectories: virtual views.
        enhancer: the restorer.
        measure: behind the pixel-level confidence.
        count: references blended per view.
        reference: which of them U_img compares with.
        iou: set that their overlap is divided by.
        first_index: index of the first clip.
        invented: what restored keyframes show where nothing else knows the surface.

    Raises:
        ShapeError: when there is no view at all.
    """
    parts = []
    for offset, cameras in enumerate(trajectories):
        clips = render_clips(
            scene,
            references,
            [cameras],
            count=count,
            reference=reference,
            iou=iou,
            first_index=first_index + offset,
            invented=invented,
        )
        if clips:
            parts.append(pseudo_observations(clips, restore_clips(enhancer, clips), measure))
        emit(Progress("enhance", offset + 1, len(trajectories)))
    return PseudoViews.concatenated(parts)


def _pseudo_observation(clip: Clip, restoration: Restoration, measure: PerceptualDifference) -> PseudoViews:
    rendered = as_images(clip.layers.get("rendered").clamp(0, 1))
    measure = measure.for_images(rendered.shape[2], rendered.shape[1])
    target, uncertainty = keep_known(rendered, restoration.rgb, as_planes(clip.layers.get("uncertainty")))
    depth = restoration.depth_mm
    if depth is None:
        with torch.no_grad():
            depth = as_planes(condition(clip.layers, clip.transfer).depth_mm)
    provenance = {**restoration.provenance, "pixel_confidence": measure.name}
    if measure.reason:
        provenance["pixel_confidence_reason"] = measure.reason
    return PseudoViews(
        cameras=clip.cameras,
        rendered=rendered,
        restored=restoration.rgb,
        target=target,
        alpha=as_planes(clip.layers.get("alpha")),
        depth_mm=depth,
        uncertainty=uncertainty,
        pixel_confidence=pixel_confidence(rendered, restoration.rgb if measure.raw else target, measure),
        image_confidence=clip.image_confidence,
        reference=clip.reference,
        clip=np.full(len(clip), clip.index, dtype=np.int64),
        provenance=provenance,
        expected_error=restoration.expected_error,
    )


def as_images(colors: Float[Tensor, "t 3 h w"]) -> Float[np.ndarray, "t h w 3"]:
    """Colours with the channels last."""
    return np.asarray(colors.permute(0, 2, 3, 1).contiguous().numpy())


def as_planes(values: Float[Tensor, "t 1 h w"]) -> Float[np.ndarray, "t h w"]:
    """Single-channel layers without their channel axis."""
    return np.asarray(values[:, 0].contiguous().numpy())
