"""A candidate view as the search sees it: what it shows, and whether it may be taken at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt32

from extrags.cameras import Cameras
from extrags.config import ExploreConfig
from extrags.exploration.coverage import view_pairs
from extrags.exploration.darkness import dark_direction, luminance
from extrags.exploration.expected_error import Sizes, sizes_in
from extrags.exploration.frontier import Frontier
from extrags.exploration.seen import Seen
from extrags.scene import Scene
from extrags.thresholds import HOLE_ALPHA

__all__ = ["Observation", "gaussian_words", "observe", "seen_pairs"]

NEAR_SHARE = 0.5
"""A candidate is too near when more than this share of its surface pixels is inside the safety margin."""
VIEWS_PER_BATCH = 16
"""Views rendered in one call; bounds the memory, has no influence on the result."""


@dataclass(frozen=True, slots=True)
class Observation:
    """Measurements of one small render.

    Args:
        pose: `world_from_camera`.
        visible: Gaussians that count as seen, rising, [M].
        sizes: pixels of each row, Gaussians and frontier voxels.
        holes: pixels without a surface.
        depth_mm: of the pixels with a surface, in no order.
        look_at_mm: median depth of the central half of the view.
        dark: world-space unit ray to its darkest patch; zero where none is dark or nobody asked.
        saturated_share: share of pixels that the camera's light overexposes.
        rejected: too many holes, too near to the wall, or no surface at all.
    """

    pose: Float[np.ndarray, "4 4"]
    visible: Int[np.ndarray, "m"]
    sizes: Sizes
    holes: Bool[np.ndarray, "h w"]
    depth_mm: Float[np.ndarray, "p"]
    look_at_mm: float
    dark: Float[np.ndarray, "3"]
    saturated_share: float
    rejected: bool


def observe(
    scene: Scene,
    cameras: Cameras,
    frontier: Frontier,
    config: ExploreConfig,
    *,
    depth_unit_mm: float | None,
    shown: Bool[np.ndarray, "c h w"] | None = None,
) -> list[Observation]:
    """Render views in batches and measure them.

    Args:
        scene: the reconstructed scene.
        cameras: the views, at the size they are scored at.
        frontier: where views through holes leave free space.
        config: what a view must not be.
        depth_unit_mm: median rendered depth of the training views; None for these themselves: then no view
            is too near.
        shown: pixels of training views that show tissue: what lies beyond the edge of a scope's picture was
            not seen. None: all.
    """
    found: list[Observation] = []
    for start in range(0, len(cameras), VIEWS_PER_BATCH):
        part = slice(start, start + VIEWS_PER_BATCH)
        inside = None if shown is None else shown[part]
        found += _observed(scene, cameras[part], frontier, config, depth_unit_mm, inside)
    return found


def _observed(
    scene: Scene,
    cameras: Cameras,
    frontier: Frontier,
    config: ExploreConfig,
    depth_unit_mm: float | None,
    shown: Bool[np.ndarray, "c h w"] | None,
) -> list[Observation]:
    counted = None if shown is None else torch.from_numpy(shown)
    with torch.no_grad():
        # The diffuse colour is all the search looks at, and saves the harmonics of every Gaussian and view.
        rendering = scene.render(cameras, visibility=True, visibility_mask=counted, sh_degree=0)
    assert rendering.visibility_max is not None
    if config.visibility == "blending":
        visible = (rendering.visibility_max > config.visible_weight).numpy()
    else:
        visible = rendering.visible.numpy()
    alpha, depth, rgb = rendering.alpha.numpy(), rendering.depth.numpy(), rendering.rgb.numpy()
    inside = np.ones(alpha.shape, dtype=bool) if shown is None else shown
    holes = (alpha < HOLE_ALPHA) & inside
    sizes = sizes_in(rendering, cameras, frontier, holes)
    margin_mm = 0.0 if depth_unit_mm is None else config.safety_share * depth_unit_mm
    found = []
    for index in range(len(cameras)):
        surface = inside[index] & (alpha[index] >= HOLE_ALPHA) & (depth[index] > 0)
        seen_mm = depth[index][surface]
        # A view of no surface at all shows nothing that a restorer could continue.
        rejected = bool(
            not surface.any()
            or 1 - surface.mean() > config.max_hole_share
            or (seen_mm < margin_mm).mean() > NEAR_SHARE
        )
        dark = np.zeros(3)
        if config.darkness_weight > 0:
            dark = dark_direction(cameras[index], rgb[index], alpha[index], depth[index], scene.light)
        found.append(
            Observation(
                pose=cameras.world_from_camera[index],
                visible=np.flatnonzero(visible[index]).astype(np.int32),
                sizes=sizes[index],
                holes=holes[index],
                depth_mm=seen_mm,
                look_at_mm=_look_at_distance(depth[index], surface, depth_unit_mm),
                dark=dark,
                saturated_share=float((luminance(rgb[index]) >= 1.0).mean()),
                rejected=rejected,
            )
        )
    return found


def _look_at_distance(
    depth_mm: Float[np.ndarray, "h w"], surface: Bool[np.ndarray, "h w"], depth_unit_mm: float | None
) -> float:
    """Median depth of the surface in the central half of the view, held near the scene's own unit.

    Looking down the lumen the centre may be far away or empty; an orbit about so distant a point would be a
    large jump.
    """
    if depth_unit_mm is None:
        return 0.0
    height, width = depth_mm.shape
    centre = (slice(height // 4, height - height // 4), slice(width // 4, width - width // 4))
    seen = depth_mm[centre][surface[centre]]
    return (
        float(np.clip(np.median(seen), 0.25 * depth_unit_mm, 2.0 * depth_unit_mm))
        if seen.size
        else depth_unit_mm
    )


def seen_pairs(
    scene: Scene, camera: Cameras, observation: Observation, frontier: Frontier, directions: int
) -> Seen:
    """(Row, direction) pairs that a view covers, of Gaussians and of frontier voxels.

    Args:
        scene: its Gaussians' centres give the directions.
        camera: the view, a batch of one.
        observation: what was measured of it.
        frontier: where views through holes leave free space.
        directions: D.
    """
    words = gaussian_words(scene, observation, directions)
    voxels, further = frontier.pairs(camera, observation.holes, directions)
    row = np.concatenate([observation.visible, voxels + len(scene.gaussians)]).astype(np.int32)
    return Seen(row, np.concatenate([words, further]))


def gaussian_words(scene: Scene, observation: Observation, directions: int) -> UInt32[np.ndarray, "m"]:
    """Of each visible Gaussian, the direction it is seen from, packed; `directions` is D."""
    return view_pairs(scene, observation.pose[:3, 3], observation.visible, directions)
