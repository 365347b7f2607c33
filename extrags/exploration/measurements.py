"""What the search has to know of a scene, measured once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int, UInt32

from extrags.cameras import Cameras
from extrags.config import ExploreConfig
from extrags.errors import CaptureError
from extrags.exploration.expected_error import SizeModel, measure_sizes, probe_cameras
from extrags.exploration.frontier import Frontier, find_frontier
from extrags.exploration.observation import Observation, gaussian_words, observe, seen_pairs
from extrags.exploration.seen import ErrorValue, PairValue, Seen, Value, restored
from extrags.freespace import FREE, FreeSpace
from extrags.scene import Scene
from extrags.shown_pixels import chosen_masks, shown_pixels
from extrags.store.storable import Storable
from extrags.zarr_io import has_array, new_group, open_group, read_array, write_array

__all__ = ["Destinations", "SceneMeasurements", "frontier_of", "measure_scene"]


@dataclass(frozen=True)
class Destinations:
    """Views that a path may make for: probes that are fit to be virtual views themselves.

    Args:
        poses: `world_from_camera`, [P, 4, 4].
        start: where the rows of each view begin in `row` and `level`, and their end, [P + 1].
        row: rows that each view shows.
        level: how well it shows them.
    """

    poses: Float[np.ndarray, "p 4 4"]
    start: Int[np.ndarray, "p1"]
    row: Int[np.ndarray, "m"]
    level: Float[np.ndarray, "m"]

    @classmethod
    def of(cls, poses: Float[np.ndarray, "p 4 4"], seen: list[Seen]) -> Destinations:
        """Those of views and of what each of them shows."""
        start = np.cumsum([0, *(len(view.row) for view in seen)]).astype(np.int64)
        row = np.concatenate([view.row for view in seen] or [np.zeros(0, np.int32)])
        level = np.concatenate([view.value for view in seen] or [np.zeros(0, np.float32)])
        return cls(poses, start, row, level)

    def __len__(self) -> int:
        return len(self.poses)

    def seen(self, index: int) -> Seen:
        """What one of the views shows."""
        rows = slice(self.start[index], self.start[index + 1])
        return Seen(self.row[rows], self.level[rows])


@dataclass(frozen=True)
class SceneMeasurements(Storable):
    """Measurements of a scene that all branches share.

    Args:
        training: pinholes at the training views, at the sequence's image size: what virtual views are.
        depth_unit_mm: median rendered depth of the training views.
        pairs: (Gaussian, direction) pairs that the training views cover, packed, [N].
        known: what they show of each row, in the terms of `value`, [R].
        value: what newly shown rows are worth.
        sizes: size model; None with `score=pairs`.
        destinations: views a path may make for; none with `score=pairs`.
        renders: images rendered for all this.
    """

    stored_as: ClassVar[str] = "search"

    training: Cameras
    depth_unit_mm: float
    pairs: UInt32[np.ndarray, "n"]
    known: np.ndarray
    value: Value
    sizes: SizeModel | None
    destinations: Destinations
    renders: int

    def cameras(self, poses: Float[np.ndarray, "c 4 4"]) -> Cameras:
        """Cameras at poses with the sequence's usual intrinsics and its image size."""
        K = np.broadcast_to(np.median(self.training.K, axis=0), (len(poses), 3, 3)).copy()
        return Cameras(K, poses, self.training.width, self.training.height)

    @property
    def removable_error(self) -> float:
        """Error of views off the trajectory that virtual views could take away; 0 with `score=pairs`."""
        if not isinstance(self.value, ErrorValue):
            return 0.0
        return float(np.sum(self.value.error * (1 - self.known), dtype=np.float64))

    def save(self, path: Path) -> None:
        """Write a zarr v3 group."""
        with new_group(path) as group:
            write_array(group, "K", self.training.K)
            write_array(group, "world_from_camera", self.training.world_from_camera)
            write_array(group, "pairs", self.pairs)
            write_array(group, "known", self.known)
            if self.sizes is not None:
                write_array(group, "size_px", self.sizes.size_px)
            for name in ("poses", "start", "row", "level"):
                write_array(group, f"destination_{name}", getattr(self.destinations, name))
            attributes, arrays = self.value.saved()
            for name, array in arrays.items():
                write_array(group, name, array)
            group.attrs.update(
                {
                    "width": self.training.width,
                    "height": self.training.height,
                    "depth_unit_mm": self.depth_unit_mm,
                    "sufficient": None if self.sizes is None else self.sizes.sufficient,
                    "renders": self.renders,
                    **attributes,
                }
            )

    @classmethod
    def load(cls, path: Path) -> SceneMeasurements:
        """Read what `save` wrote."""
        group = open_group(path)
        attributes: dict[str, Any] = dict(group.attrs)
        value = restored(attributes, read_array(group, "error") if has_array(group, "error") else None)
        sizes = None
        if isinstance(value, ErrorValue):
            sizes = SizeModel(read_array(group, "size_px"), value, attributes["sufficient"])
        poses = read_array(group, "world_from_camera")
        return cls(
            training=Cameras(read_array(group, "K"), poses, attributes["width"], attributes["height"]),
            depth_unit_mm=attributes["depth_unit_mm"],
            pairs=read_array(group, "pairs"),
            known=read_array(group, "known"),
            value=value,
            sizes=sizes,
            destinations=Destinations(
                *(read_array(group, f"destination_{name}") for name in ("poses", "start", "row", "level"))
            ),
            renders=attributes["renders"],
        )


def frontier_of(scene: Scene, freespace: FreeSpace, config: ExploreConfig) -> Frontier:
    """The frontier of a scene's free space, with the weight that the score gives it."""
    return find_frontier(scene, freespace, 1.0 if config.score == "error" else config.hole_weight)


def measure_scene(
    scene: Scene,
    cameras: Cameras,
    freespace: FreeSpace,
    config: ExploreConfig,
    frontier: Frontier,
    masks: Sequence[Bool[np.ndarray, "h w"]] | None = None,
) -> SceneMeasurements:
    """Measure what all branches need: every training view and every probe is rendered once.

    Args:
        scene: the reconstructed scene.
        cameras: the training views.
        freespace: where cameras may go.
        config: settings.
        frontier: from `frontier_of`.
        masks: pixels of each training view that show tissue, at the size of `cameras`; None: all. By the
            frustum (`explore.visibility`) none are looked at.

    Raises:
        CaptureError: when there is no training view, or none sees a surface.
        ShapeError: for masks of other views.
    """
    if len(cameras) == 0:
        raise CaptureError("there is no training view to explore from")
    spread = np.unique(np.linspace(0, len(cameras) - 1, min(len(cameras), config.max_training_views)).round())
    spread = spread.astype(np.int64)
    small = cameras[spread].at_most_width(config.render_width)
    shown = None
    if config.visibility == "blending":
        shown = shown_pixels(chosen_masks(masks, cameras, spread), cameras[spread], small)
    n, rows = len(scene.gaussians), len(scene.gaussians) + len(frontier)
    views = observe(scene, small, frontier, config, depth_unit_mm=None, shown=shown)
    depth_mm = np.concatenate([view.depth_mm for view in views])
    if depth_mm.size == 0:
        raise CaptureError(f"none of the {len(cameras)} training views sees a surface of the scene")
    depth_unit_mm = float(np.median(depth_mm))
    pairs = np.zeros(n, dtype=np.uint32)
    for view in views:
        pairs[view.visible] |= gaussian_words(scene, view, config.directions)

    if config.score == "pairs":
        value = PairValue(n, frontier.pair_value)
        known = np.zeros(rows, dtype=np.uint32)
        for index, view in enumerate(views):
            value.add(known, seen_pairs(scene, small[index], view, frontier, config.directions))
        none = Destinations.of(np.zeros((0, 4, 4)), [])
        virtual = cameras.as_pinholes()
        return SceneMeasurements(virtual, depth_unit_mm, pairs, known, value, None, none, len(views))

    virtual = small.as_pinholes()
    probes = probe_cameras(virtual, freespace, depth_unit_mm, config.safety_share * depth_unit_mm, config)
    probed = observe(scene, probes, frontier, config, depth_unit_mm=depth_unit_mm)
    model = measure_sizes(
        [probe.sizes for probe in probed], n, len(frontier), small.width * small.height, config
    )
    levels = np.zeros(rows, dtype=np.float32)
    for view in views:
        model.value.add(levels, model.seen(view.sizes))
    # Where the recording looked into a hole, nothing was reconstructed all the same.
    levels[n:] = 0.0
    fit = _fit_to_be_views(probed, freespace, depth_unit_mm, config)
    return SceneMeasurements(
        training=cameras.as_pinholes(),
        depth_unit_mm=depth_unit_mm,
        pairs=pairs,
        known=levels,
        value=model.value,
        sizes=model,
        destinations=Destinations.of(
            probes.world_from_camera[fit], [model.seen(probed[index].sizes) for index in fit]
        ),
        renders=len(views) + len(probed),
    )


def _fit_to_be_views(
    probed: list[Observation], freespace: FreeSpace, depth_unit_mm: float, config: ExploreConfig
) -> list[int]:
    """Which probes a virtual camera may take as they are."""
    if not config.destinations:
        return []
    centers = np.stack([probe.pose[:3, 3] for probe in probed])
    inside = (freespace.lookup(centers) == FREE) & (
        freespace.clearance_at(centers) >= config.safety_share * depth_unit_mm
    )
    return [
        index
        for index, probe in enumerate(probed)
        if inside[index] and not probe.rejected and probe.saturated_share <= config.max_saturated_share
    ]
