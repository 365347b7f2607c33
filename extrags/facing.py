"""Which way surfaces face, and views in which what is seen from behind stands behind everything else.

Tissue is opaque, and no camera is inside of it: a wall that a view sees from behind is not where it stands.
It happens where the restorer guesses that an unseen stretch of a lumen ends, and a later view looks from
beyond that guess back at what training frames know. Gaussians are flat on the surface, so that each has a
side from which it was seen.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from extrags.cameras import Cameras
from extrags.raster import Rendering
from extrags.raster.light import shortest_axes
from extrags.scene import Scene
from extrags.threads import one_torch_thread

__all__ = [
    "BEHIND_COSINE",
    "laid_over",
    "one_sided_attributes",
    "one_sided_rendering",
    "seen_from_behind",
    "sides",
    "with_facing",
]

SEEN_WEIGHT = 0.01
"""A view whose largest blending weight of a Gaussian is smaller does not say which side it saw."""

SURE_COSINE = 0.2
"""Mean cosine, over the views that saw a Gaussian, between its normal and the directions to their cameras,
below which none of its sides is told from the other."""

BEHIND_COSINE = 0.2
"""Below minus this cosine a Gaussian is seen from behind: at grazing angles normals are noise."""

FLAT = 0.5
"""Shortest axis, as a share of the next one, below which a Gaussian is a piece of surface with two sides."""

MOST_VIEWS = 120
"""So many training views, and as many virtual ones, are asked; of more, evenly spaced ones."""

WIDTH_PX = 160
"""Views are rendered no wider for this."""


@one_torch_thread()
def with_facing(scene: Scene, cameras: Iterable[Cameras]) -> Scene:
    r"""The same scene with the side of each Gaussian that faces the views it was made from.

    With the normal :math:`n_i` (shortest axis) of a Gaussian, the directions :math:`d_{iv}` to the cameras
    and its largest blending weights :math:`w_{iv}` in their views, the side is the sign of
    :math:`\sum_v w_{iv} \, n_i \cdot d_{iv}`; 0, neither side, where no view saw it, where the weighted mean
    of the cosines is below `SURE_COSINE`, and for Gaussians that are not flat.

    Args:
        scene: the scene, rendered where it is.
        cameras: batches of views that the scene was made from, training and virtual ones; all their pixels
            count, those outside of masks as well.
    """
    gaussians = scene.gaussians
    normals = _normals(scene)
    scales = gaussians.scales.detach().exp().sort(dim=1).values
    flat = scales[:, 0] < FLAT * scales[:, 1]
    cosines = torch.zeros(len(gaussians), device=scene.device)
    weights = torch.zeros_like(cosines)
    for batch in cameras:
        small = batch.at_most_width(WIDTH_PX)
        for index in np.linspace(0, len(small) - 1, min(len(small), MOST_VIEWS)).round().astype(int):
            view = small[int(index)]
            with torch.no_grad():
                weight = scene.render(view, visibility=True, sh_degree=0).visibility_max
            if weight is None:
                raise AssertionError("visibility was asked for")
            seen = torch.where(weight[0] >= SEEN_WEIGHT, weight[0], 0)
            cosines += seen * _cosines(gaussians.means.detach(), normals, scene.array(view.centers[0]))
            weights += seen
    sure = flat & (weights > 0) & (cosines.abs() >= SURE_COSINE * weights)
    return replace(scene, facing=torch.where(sure, cosines.sign(), 0).to(torch.int8))


@one_torch_thread()
def one_sided_rendering(
    scene: Scene, camera: Cameras, *, exposure: Float[Tensor, "1"] | None = None
) -> Rendering:
    """Render one view in which Gaussians seen from behind stand behind all others.

    They show where there is nothing else, and hide nothing. For a scene that does not know which way its
    Gaussians face (`Scene.facing`) it is `Scene.render`.

    Args:
        scene: the scene, rendered where it is.
        camera: one view.
        exposure: its gain; None is the mean exposure of the training frames.

    Returns:
        Colour, opacity and expected depth; radii and centres are those of the Gaussians seen from the front,
        0 for the others.
    """
    behind = _behind(scene, camera)
    if behind is None:
        return scene.render(camera, exposure=exposure)
    front, back = _parts(scene, behind)
    return laid_over(front.render(camera, exposure=exposure), back.render(camera, exposure=exposure))


@one_torch_thread()
def one_sided_attributes(
    scene: Scene, camera: Cameras, attributes: Float[Tensor, "n k"]
) -> tuple[Float[Tensor, "1 h w k"], Float[Tensor, "1 h w"]]:
    """`Scene.render_attributes` of one view, with the blending weights of `one_sided_rendering`.

    Args:
        scene: the scene, rendered where it is.
        camera: one view.
        attributes: k values per Gaussian.

    Returns:
        The attributes summed with the blending weights, and alpha, the sum of the weights.
    """
    behind = _behind(scene, camera)
    if behind is None:
        return scene.render_attributes(camera, attributes)
    front, back = _parts(scene, behind)
    near, alpha = front.render_attributes(camera, attributes)
    far, further = back.render_attributes(camera, attributes.to(scene.device)[behind])
    left = 1 - alpha
    return near + left[..., None] * far, alpha + left * further


def sides(scene: Scene) -> Float[Tensor, "n 3"] | None:
    """Normals to the sides that were seen, zero where a Gaussian has none; None where nobody knows."""
    if scene.facing is None:
        return None
    normals = _normals(scene)
    return scene.facing.to(normals.dtype)[:, None] * normals


def seen_from_behind(
    means: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], eye: Float[Tensor, "3"]
) -> Bool[Tensor, "n"]:
    """Which Gaussians a camera sees from behind.

    Args:
        means: their centres.
        normals: to the sides that were seen, as `sides` has them.
        eye: centre of the camera.
    """
    return _cosines(means, normals, eye) < -BEHIND_COSINE


def laid_over(front: Rendering, back: Rendering) -> Rendering:
    """Colour, opacity and expected depth of one rendering over another; radii are those of the front one."""
    left = 1 - front.alpha
    alpha = front.alpha + left * back.alpha
    distance = front.alpha * front.depth + left * back.alpha * back.depth
    return replace(
        front,
        rgb=front.rgb + left[..., None] * back.rgb,
        alpha=alpha,
        # Of nothing the distance is 0 as well.
        depth=distance / alpha.clamp_min(torch.finfo(alpha.dtype).tiny),
        median_depth=None,
    )


def _behind(scene: Scene, camera: Cameras) -> Bool[Tensor, "n"] | None:
    """Which Gaussians one view sees from behind; None where it is none."""
    normals = sides(scene)
    if normals is None:
        return None
    behind = seen_from_behind(scene.gaussians.means.detach(), normals, scene.array(camera.centers[0]))
    return behind if bool(behind.any()) else None


def _parts(scene: Scene, behind: Bool[Tensor, "n"]) -> tuple[Scene, Scene]:
    """The scene without what stands behind, of as many Gaussians, and that alone."""
    gaussians = scene.gaussians
    # Of opacity 0 they are culled, at less than it takes to copy all others.
    opacities = torch.where(behind, -torch.inf, gaussians.opacities)
    front = replace(scene, gaussians=replace(gaussians, opacities=opacities))
    return front, Scene(gaussians.subset(behind), scene.light)


def _normals(scene: Scene) -> Float[Tensor, "n 3"]:
    """Shortest axes, of whatever sign."""
    gaussians = scene.gaussians
    return shortest_axes(gaussians.quats.detach(), gaussians.scales.detach())


def _cosines(
    means: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], eye: Float[Tensor, "3"]
) -> Float[Tensor, "n"]:
    """Cosines between normals and the directions to a camera."""
    return (functional.normalize(eye - means, dim=1) * normals).sum(dim=1)
