"""New Gaussians where restored virtual views show surface and the scene has none."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from extrags.cameras import rays_of_pixels
from extrags.frame_quantiles import quantile_of_frames
from extrags.frame_stacks import stacked
from extrags.gaussians import Gaussians
from extrags.pseudo_views import PseudoViews
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.thresholds import HOLE_ALPHA
from extrags.training.starting import LEAST_COLOR, surface_normals, thin_out
from extrags.unique_rows import unique_rows

__all__ = ["hole_gaussians"]

CARVED_MARGIN = 0.05
"""A new Gaussian nearer than a real view's surface by this share of its depth would hide it."""

KNOWN_BELOW = 0.5
"""Below this uncertainty a solid pixel of a virtual view shows surface the scene knows."""

GUESSED_NEARER = 0.25
"""A new Gaussian this much nearer than another virtual view's completed depth stands in that view's way."""

NEAREST_QUANTILE = 0.01
"""Of the depths of training frames: the nearest surface they show, without outliers."""

CLEAR_OF_CAMERAS = 0.7
"""No new Gaussian is nearer to a camera than this share of the nearest surface: cameras fly in free space."""

MIN_POINTS = 8
"""Fewer hole points have neither neighbours nor normals."""

MIN_GAIN = 0.05
"""Lower bound of the light divided out of a hole's colour: far and grazing surface there is only guessed."""

HOLE_STRIDE_PX = 2
"""Hole pixels are taken on a grid of this step; thinning would drop most of them anyway."""

LEAST_SPACING_PX = 2.0
"""New Gaussians lie no closer, at the median depth of the holes, than the grid that they are taken from."""


def hole_gaussians(
    scene: Scene,
    sequence: EndoscopicSequence,
    pseudo_views: PseudoViews,
    room: int,
    *,
    thickness: float = 1.0,
    max_distance: float = np.inf,
    alpha: Float[np.ndarray, "v h w"] | None = None,
) -> Gaussians | None:
    """New Gaussians where a restored virtual view shows surface and the scene has none.

    Points come from the completed depth of hole pixels, their albedo from the restored colour with the
    light divided out; like the scene's first Gaussians they lie flat on the surface, which the light's
    cosine asks for. A guess must not hide what is known: dropped are points

    * in front of what a real view saw, of what a virtual view shows of known surface, or of the depth that
      another virtual view completes there,
    * much nearer to a camera, real or virtual, than the nearest surface that training frames show,
    * far from all known surface.

    Args:
        scene: the coarse scene, on the processor, where the search trees are.
        sequence: posed frames; training frames carve.
        pseudo_views: restored virtual views.
        room: at most so many new Gaussians.
        thickness: along the surface's normal, as a share of the radius.
        max_distance: points farther than this from all Gaussians of the scene are dropped, in world units.
        alpha: opacity of the virtual views in the scene, where it is no longer the one that they were
            rendered from: what it has filled by now is no hole any more, but stays a guess that no other
            may hide. None takes that of the views.

    Returns:
        The new Gaussians, or None where there is nothing to fill.
    """
    alpha = pseudo_views.alpha if alpha is None else alpha
    holes = (alpha < HOLE_ALPHA) & (pseudo_views.depth_mm > 0)
    lattice = np.zeros_like(holes)
    lattice[:, ::HOLE_STRIDE_PX, ::HOLE_STRIDE_PX] = True
    chosen = np.flatnonzero(holes & lattice)
    if len(chosen) == 0 or room <= 0:
        return None
    cameras = pseudo_views.cameras
    view = chosen // (cameras.width * cameras.height)
    rays = rays_of_pixels(cameras, chosen)
    points = cameras.centers[view] + pseudo_views.depth_mm.reshape(-1)[chosen, None] * rays
    rgb = pseudo_views.target.reshape(-1, 3)[chosen].astype(np.float64)
    if len(points) < MIN_POINTS:
        return None
    if scene.light is not None:
        into_camera = cameras.world_from_camera[view, :3, :3]
        local = np.einsum("nji,nj->ni", into_camera, points - cameras.centers[view])
        normals = np.einsum("nji,nj->ni", into_camera, surface_normals(points))
        lit = torch.from_numpy(rgb), torch.from_numpy(local), torch.from_numpy(normals)
        rgb = scene.light.albedo(*lit, min_gain=MIN_GAIN).detach().numpy()
    placed = _near_known_surface(points, scene, max_distance)
    seen = stacked(
        (_real_depth(scene, sequence, int(frame)) for frame in sequence.train), len(sequence.train)
    )
    placed &= ~_in_front_of_real_surface(points, sequence, seen)
    every_camera = np.concatenate([sequence.cameras[sequence.train].centers, cameras.centers])
    placed &= _clear_of_cameras(points, every_camera, seen)
    placed &= ~_in_front_of_virtual_surface(points, pseudo_views)
    points, rgb = points[placed], rgb[placed]
    if len(points) < MIN_POINTS:
        return None
    # Where Gaussians lie upon each other, as after a relocation, their spacing says nothing of the surface's.
    shown_px_mm = np.median(pseudo_views.depth_mm.reshape(-1)[chosen] / cameras.K[view, 0, 0])
    spacing = max(_typical_spacing(scene.gaussians), LEAST_SPACING_PX * float(shown_px_mm))
    points, rgb = _one_per_cell(points, rgb, spacing)
    wanted = len(points)
    points, rgb = thin_out(points, rgb, room)
    if len(points) < MIN_POINTS:
        return None
    # On a surface, fewer points lie farther apart: they have to close it as well.
    radius = np.full(len(points), 0.7 * spacing * np.sqrt(wanted / len(points)))
    return Gaussians.from_points(
        points,
        rgb.clip(LEAST_COLOR, None),
        radius,
        opacity=0.3,
        sh_degree=scene.gaussians.sh_degree,
        normals=surface_normals(points) if thickness != 1 else None,
        thickness=thickness,
    )


def _typical_spacing(gaussians: Gaussians) -> float:
    means = gaussians.means.numpy()
    sample = means[:: max(1, len(means) // 5000)]
    distance, _ = cKDTree(means).query(sample, k=2)
    return float(np.median(distance[:, 1])) * 1.5


def _one_per_cell(
    points: Float[np.ndarray, "n 3"], rgb: Float[np.ndarray, "n 3"], edge: float
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
    cells = np.floor((points - points.min(axis=0)) / edge).astype(np.int64)
    _, owner = unique_rows(cells)
    count = np.bincount(owner)

    def averaged(array: np.ndarray) -> np.ndarray:
        sums = np.stack(
            [np.bincount(owner, weights=array[:, k], minlength=len(count)) for k in range(3)], axis=1
        )
        return np.asarray(sums / count[:, None])

    return averaged(points), averaged(rgb)


def _in_front_of_real_surface(
    points: Float[np.ndarray, "n 3"], sequence: EndoscopicSequence, seen: Float[np.ndarray, "m h w"]
) -> Bool[np.ndarray, "n"]:
    """Points that stand between a training camera and the surface it saw."""
    hides = np.zeros(len(points), dtype=bool)
    cameras = sequence.cameras[sequence.train]
    for index, depth in enumerate(seen):
        (pixels,), (z,) = cameras[index].project(points)
        inside = cameras.contains(pixels)
        column, row = pixels[inside].astype(np.int64).T
        surface = depth[row, column]
        hides[inside] |= (surface > 0) & (z[inside] < (1 - CARVED_MARGIN) * surface)
    return hides


def _clear_of_cameras(
    points: Float[np.ndarray, "n 3"],
    centers: Float[np.ndarray, "c 3"],
    seen: Float[np.ndarray, "m h w"],
) -> Bool[np.ndarray, "n"]:
    """Points that are not implausibly near to a camera, by the nearest surface that training frames show."""
    nearest = quantile_of_frames(lambda: (depth[depth > 0] for depth in seen), NEAREST_QUANTILE)
    if nearest is None:
        return np.ones(len(points), dtype=bool)
    distance, _ = cKDTree(centers).query(points)
    return np.asarray(distance >= CLEAR_OF_CAMERAS * nearest)


def _in_front_of_virtual_surface(
    points: Float[np.ndarray, "n 3"], pseudo_views: PseudoViews
) -> Bool[np.ndarray, "n"]:
    """Points that stand between a virtual camera and the surface it shows, known or completed."""
    hides = np.zeros(len(points), dtype=bool)
    cameras = pseudo_views.cameras
    for index in range(len(cameras)):
        (pixels,), (z,) = cameras[index].project(points)
        inside = cameras.contains(pixels)
        column, row = pixels[inside].astype(np.int64).T
        solid = pseudo_views.alpha[index][row, column] >= HOLE_ALPHA
        known = solid & (pseudo_views.uncertainty[index][row, column] < KNOWN_BELOW)
        # Completed depths of two views hardly ever agree closely; surface between both is uncertain.
        margin = np.where(known, CARVED_MARGIN, np.where(solid, 1.0, GUESSED_NEARER))
        hides[inside] |= z[inside] < (1 - margin) * pseudo_views.depth_mm[index][row, column]
    return hides


def _near_known_surface(
    points: Float[np.ndarray, "n 3"], scene: Scene, distance: float
) -> Bool[np.ndarray, "n"]:
    found, _ = cKDTree(scene.gaussians.means.numpy()).query(points, distance_upper_bound=distance)
    return np.asarray(np.isfinite(found))


def _real_depth(scene: Scene, sequence: EndoscopicSequence, frame: int) -> Float[np.ndarray, "h w"]:
    """Depth of the surface that a training frame saw, 0 where it saw none.

    Where its own depth is unknown or unsure the scene's is taken: other frames have had their say there.
    """
    valid = sequence.mask[frame]
    reliable = sequence.reliable_depth_mm(frame)
    if reliable is not None and bool(((reliable > 0) | ~valid).all()):
        return reliable
    with torch.no_grad():
        rendering = scene.render(sequence.cameras[frame])
    shown = valid & (rendering.alpha[0].numpy() > HOLE_ALPHA)
    rendered = np.where(shown, rendering.depth[0].numpy(), np.float32(0))
    return rendered if reliable is None else np.where(reliable > 0, reliable, rendered)
