"""Keyframes: a few virtual views, restored first and one after the other, that all clips then follow.

Restored alone, neighbouring views invent different things in the same hole. Keyframes are chosen so that
together they see most of what will be invented. Each is restored with those before it as references of what
they have invented; then every clip is, independently of all other clips.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn import functional

from extrags.cameras import Cameras, pixel_rays
from extrags.config import EnhanceConfig
from extrags.errors import ShapeError
from extrags.events import Progress, emit
from extrags.restoration.clips import render_clips
from extrags.restoration.protocol import Clip, Enhancer, restore_clip
from extrags.scene import Scene
from extrags.store.storable import Storable
from extrags.threads import in_threads
from extrags.view_synthesis.conditioning import Layers, condition, filled_depth, known_share, observe_views
from extrags.view_synthesis.invented import InventedViews, evidence, with_invented
from extrags.view_synthesis.references import LightTransfer, ReferenceViews
from extrags.zarr_io import new_group, open_group, read_array, write_array, write_frames

__all__ = ["Keyframes", "choose_keyframes", "following", "follows_keyframes", "make_keyframes"]

SURVEY_WIDTH = 80
"""Views are chosen from renderings of this width, in pixels: what is missing is seen on them as well."""
LATTICE_POINTS = 192
"""Points of a view, at most, on which it is decided who sees what."""
MISSING = 0.3
"""A point counts as missing where the scene and real views give less than the rest of its colour."""
DEPTH_TOLERANCE = 0.25
"""Absolute log ratio of depths at which two views are taken to see the same surface by 1/e: before they are
restored, both depths are filled in."""
MIN_GAIN_SHARE = 0.003
"""A keyframe sees at least this share of all that is missing, beyond what those before it see."""


@dataclass(frozen=True)
class Keyframes(Storable):
    """K restored views that other views follow, in the order in which they were restored.

    Args:
        cameras: the views, [K].
        rgb: restored, [K, H, W, 3].
        depth_mm: z-depth without gaps, [K, H, W].
        unknown: share of a pixel, in steps of 1/255, that neither the scene nor real views gave, [K, H, W].
        exposure: gain of each view, [K].
        view: trajectory of each, and its position among the views of it that are restored: without the real
            start, and thinned where there are more than `enhance.max_views`, [K, 2].

    Raises:
        ShapeError: when the arrays do not fit each other.
    """

    stored_as: ClassVar[str] = "keyframes"

    cameras: Cameras
    rgb: UInt8[np.ndarray, "k h w 3"]
    depth_mm: Float[np.ndarray, "k h w"]
    unknown: UInt8[np.ndarray, "k h w"]
    exposure: Float[np.ndarray, "k"]
    view: Int[np.ndarray, "k 2"]

    def __post_init__(self) -> None:
        size = (len(self.cameras), self.cameras.height, self.cameras.width)
        for name, shape in (
            ("rgb", (*size, 3)),
            ("depth_mm", size),
            ("unknown", size),
            ("exposure", size[:1]),
            ("view", (size[0], 2)),
        ):
            if getattr(self, name).shape != shape:
                raise ShapeError(f"{name} has shape {getattr(self, name).shape}, expected {shape}")

    def __len__(self) -> int:
        return len(self.cameras)

    @classmethod
    def none(cls, like: Cameras) -> Keyframes:
        """No keyframes, of views as large as these."""
        size = (0, like.height, like.width)
        return cls(
            like[:0],
            np.zeros((*size, 3), np.uint8),
            np.zeros(size, np.float32),
            np.zeros(size, np.uint8),
            np.zeros(0, np.float32),
            np.zeros((0, 2), np.int64),
        )

    @staticmethod
    def concatenated(parts: Sequence[Keyframes]) -> Keyframes:
        """Join keyframes in the order given; at least one part."""
        names = ("rgb", "depth_mm", "unknown", "exposure", "view")
        arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return Keyframes(Cameras.concatenated([part.cameras for part in parts]), **arrays)

    def invented(self, transfer: LightTransfer) -> InventedViews | None:
        """What they have invented, as references of other views; None without any keyframe.

        Args:
            transfer: how brightness changes with distance in this scene.
        """
        if len(self) == 0:
            return None
        return InventedViews.of_views(
            self.cameras,
            torch.from_numpy(self.rgb.astype(np.float32) / 255).permute(0, 3, 1, 2).contiguous(),
            torch.from_numpy(self.depth_mm)[:, None],
            torch.from_numpy(self.unknown.astype(np.float32) / 255)[:, None],
            torch.from_numpy(self.exposure),
            transfer,
        )

    def save(self, path: Path) -> None:
        """Write a zarr v3 group, one view per chunk."""
        with new_group(path) as group:
            for name in ("rgb", "depth_mm", "unknown"):
                write_frames(group, name, getattr(self, name))
            for name in ("exposure", "view"):
                write_array(group, name, getattr(self, name))
            write_array(group, "K", self.cameras.K)
            write_array(group, "world_from_camera", self.cameras.world_from_camera)
            group.attrs.update({"width": self.cameras.width, "height": self.cameras.height})

    @classmethod
    def load(cls, path: Path) -> Keyframes:
        """Read what `save` wrote: the same bits."""
        group = open_group(path)
        attributes: Any = dict(group.attrs)
        cameras = Cameras(
            read_array(group, "K"),
            read_array(group, "world_from_camera"),
            int(attributes["width"]),
            int(attributes["height"]),
        )
        names = ("rgb", "depth_mm", "unknown", "exposure", "view")
        return cls(cameras, **{name: read_array(group, name) for name in names})


def follows_keyframes(enhancer: Enhancer) -> bool:
    """Whether a restorer makes use of what keyframes have invented: its attribute of this name, if any."""
    return bool(getattr(enhancer, "follows_keyframes", False))


def following(clip: Clip, invented: InventedViews | None) -> Clip:
    """The clip with what keyframes have invented; None gives it back as it is."""
    if invented is None:
        return clip
    exposure = None if clip.exposure is None else torch.from_numpy(clip.exposure)
    return replace(clip, layers=with_invented(clip.layers, invented, clip.cameras, exposure))


def make_keyframes(
    scene: Scene,
    references: ReferenceViews,
    trajectories: Sequence[Cameras],
    enhancer: Enhancer,
    config: EnhanceConfig,
    *,
    exposure: Sequence[Float[Tensor, "t"] | None] | None = None,
) -> Keyframes:
    """Choose and restore the keyframes of all views that will be restored.

    Args:
        scene: the coarse scene.
        references: its training views.
        trajectories: all views that will be restored, by clip; at least one clip, clips may be empty.
        enhancer: the scene's restorer.
        config: how many keyframes at most, and which references.
        exposure: gain of each view; None is 1.

    Returns:
        The keyframes; none without any view, where nothing is missing, or where the restorer follows none.
    """
    none = Keyframes.none(trajectories[0])
    if config.keyframes == 0 or not follows_keyframes(enhancer) or not any(map(len, trajectories)):
        return none
    places = [(clip, view) for clip, cameras in enumerate(trajectories) for view in range(len(cameras))]
    chosen = _chosen_views(scene, references, trajectories, config)
    found = none
    for done, index in enumerate(chosen, start=1):
        clip, view = places[index]
        camera = trajectories[clip][[view]]
        gains = None if exposure is None else exposure[clip]
        gain = None if gains is None else gains[[view]]
        (rendered,) = render_clips(
            scene,
            references,
            [camera],
            count=config.references,
            reference=config.reference,
            first_index=clip,
            exposure=[gain],
            invented=found.invented(references.transfer),
        )
        found = Keyframes.concatenated([found, _restored(rendered, enhancer, (clip, view))])
        emit(Progress("enhance-keyframes", done, len(chosen)))
    return found


def _restored(clip: Clip, enhancer: Enhancer, view: tuple[int, int]) -> Keyframes:
    restoration = restore_clip(enhancer, clip)
    depth = restoration.depth_mm
    if depth is None:
        with torch.no_grad():
            depth = condition(clip.layers, clip.transfer).depth_mm[:, 0].numpy()
    return Keyframes(
        clip.cameras,
        np.rint(restoration.rgb.clip(0, 1) * 255).astype(np.uint8),
        np.ascontiguousarray(depth, dtype=np.float32),
        np.rint(_missing(clip.layers)[:, 0].numpy() * 255).astype(np.uint8),
        np.ones(1, np.float32) if clip.exposure is None else clip.exposure,
        np.array([view], dtype=np.int64),
    )


def _missing(layers: Layers) -> Float[Tensor, "v 1 h w"]:
    """Share of a pixel that neither the scene nor real views give."""
    return (1 - known_share(layers)).clamp(0, 1)


def _chosen_views(
    scene: Scene, references: ReferenceViews, trajectories: Sequence[Cameras], config: EnhanceConfig
) -> list[int]:
    """Keyframes among all views of all clips, from small renderings of them."""
    cameras = Cameras.concatenated([part for part in trajectories if len(part)]).at_most_width(SURVEY_WIDTH)

    def surveyed(view: int) -> tuple[Tensor, Tensor]:
        layers = observe_views(scene, references, cameras[view], count=config.references).layers
        return filled_depth(layers, references.transfer.scale_mm), _missing(layers)

    depth, missing = zip(*in_threads(surveyed, range(len(cameras))), strict=True)
    return choose_keyframes(cameras, torch.cat(depth), torch.cat(missing), config.keyframes)


def choose_keyframes(
    cameras: Cameras,
    depth_mm: Float[Tensor, "v 1 h w"],
    missing: Float[Tensor, "v 1 h w"],
    count: int,
) -> list[int]:
    """Views that together see most of what is missing in all views: each adds most to those before it.

    What a view sees of another's missing points counts by how sharply it sees them, and by how far the depths
    of both agree. The value of a set never falls as it grows, and a view adds less to a larger set; so the
    greedy choice reaches at least 63 % of what the best set of as many views does.

    Args:
        cameras: the views.
        depth_mm: their z-depth without gaps.
        missing: share of each pixel that nothing gives.
        count: views at most.

    Returns:
        Their indices, in the order they were chosen; views that add little are not.

    Source: Nemhauser, Wolsey, Fisher: An analysis of approximations for maximizing submodular set functions,
    Mathematical Programming 14, 1978.
    """
    points, owner, weight = _missing_points(cameras, depth_mm, missing)
    total = float(weight.sum())
    if total == 0 or count == 0:
        return []
    centers = torch.from_numpy(cameras.centers.astype(np.float32))
    distance = (points - centers[owner]).norm(dim=-1)
    seen = torch.stack(
        [
            _seen(cameras[view], depth_mm[view], missing[view], points, distance)
            for view in range(len(cameras))
        ]
    )
    chosen: list[int] = []
    best = torch.zeros_like(weight)
    while len(chosen) < min(count, len(cameras)):
        gain = ((seen - best).clamp_min(0) * weight).sum(dim=1)
        view = int(gain.argmax())
        if float(gain[view]) < MIN_GAIN_SHARE * total:
            break
        chosen.append(view)
        best = torch.maximum(best, seen[view])
    return chosen


def _missing_points(
    cameras: Cameras, depth_mm: Float[Tensor, "v 1 h w"], missing: Float[Tensor, "v 1 h w"]
) -> tuple[Float[Tensor, "q 3"], Int[Tensor, "q"], Float[Tensor, "q"]]:
    """Points on a lattice of every view where it misses something: position, view, and how much."""
    stride = max(1, int(np.ceil(np.sqrt(cameras.width * cameras.height / LATTICE_POINTS))))
    inside = (slice(None), slice(stride // 2, None, stride), slice(stride // 2, None, stride))
    rays = torch.from_numpy(pixel_rays(cameras).astype(np.float32))[inside]
    centers = torch.from_numpy(cameras.centers.astype(np.float32))
    points = centers[:, None, None] + rays * depth_mm[:, 0][inside][..., None]
    share = missing[:, 0][inside]
    counted = share > MISSING
    owner = torch.arange(len(cameras))[:, None, None].expand_as(share)
    return points[counted], owner[counted], share[counted]


def _seen(
    camera: Cameras,
    depth_mm: Float[Tensor, "1 h w"],
    missing: Float[Tensor, "1 h w"],
    points: Float[Tensor, "q 3"],
    distance: Float[Tensor, "q"],
) -> Float[Tensor, "q"]:
    """How well a view, once restored, would show points that others miss."""
    viewmat = torch.from_numpy(camera.viewmats[0].astype(np.float32))
    K = torch.from_numpy(camera.K[0].astype(np.float32))
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = local[:, 2].clamp_min(1e-6)
    u = local[:, 0] / z * K[0, 0] + K[0, 2]
    v = local[:, 1] / z * K[1, 1] + K[1, 2]
    inside = (local[:, 2] > 1e-6) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    grid = torch.stack([2 * u / camera.width - 1, 2 * v / camera.height - 1], dim=-1).clamp(-4, 4)
    maps = torch.cat([depth_mm, missing * evidence(missing[None])[0]])[None]
    found = functional.grid_sample(maps, grid[None, None], mode="nearest", align_corners=False)[0, :, 0]
    agreement = torch.exp(-((z / found[0].clamp_min(1e-6)).log() / DEPTH_TOLERANCE).square())
    sharpness = (distance / local.norm(dim=-1).clamp_min(1e-9)).clamp(max=1)
    return torch.where(inside, agreement * sharpness * found[1], torch.zeros(()))
