"""Surfaces that restored views have invented, carried into other views: invented once, seen by all.

A restored view shows surfaces that no real view and no rendering knows. Its depth says where they are. They
are carried in two steps: small discs on the invented surface are rendered into the other view, which gives
depth to its holes; then colours are looked up as those of real views are, with the light's fall-off
compensated and where the depths of both views agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrags.cameras import Cameras, pixel_rays
from extrags.errors import ShapeError
from extrags.gaussians import Gaussians
from extrags.scene import Scene
from extrags.threads import in_threads
from extrags.thresholds import HOLE_ALPHA
from extrags.view_synthesis.conditioning import Layers, feathered, known_share
from extrags.view_synthesis.filling import completed_depth, push_pull
from extrags.view_synthesis.references import LightTransfer, ReferenceViews
from extrags.view_synthesis.warp import depth_normals, warp_references

__all__ = ["InventedViews", "border_trust", "evidence", "with_invented"]

BLENDED = 4
"""Invented references of one view at most; those that show most of it."""
GOOD_QUALITY = 1e-4
"""As that of real references, but an invented surface is the same from any side: whoever sees it follows."""
DEPTH_TOLERANCE = 0.15
"""As that of real references, but the depth is that of discs: on walls seen at an angle the nearer one hides
the farther, which moves the surface a few percent towards the lens."""
INVENTED = 0.3
"""Share of a pixel that nothing knew, from which its surface counts as invented."""
GRAZING = (0.1, 0.3)
"""Cosines between ray and normal between which trust rises: a smoothly filled depth spans the gap between a
fold and the wall behind it, and that surface is nowhere."""
FEATHER_PX = 4.0
"""Trust rises over so many pixels from the border of the image."""
REACH = 0.25
"""Distance from what is known, in widths of the image, over which the evidence for what was invented falls to
1/e."""
LEAST_EVIDENCE = 0.1
"""Far inside a hole one view knows no better than another, and the later follows the earlier."""
FOLLOWED = 2.0
"""A keyframe is followed completely where its evidence is not worse than the own by more than this factor."""
HARMONY_PX = 4
"""Side of the blocks in which the brightness of invented and known colours is compared."""
LARGEST_CORRECTION = 4.0
DARKEST = 0.02
"""Added to brightness before two of them are divided."""
DISCS = 20_000
"""Discs of one view at most; larger ones on a coarser lattice, if need be."""
DISC_PITCHES = 0.4
"""Radius of a disc in distances to its neighbours: without gaps, and little beyond the rim."""
DISC_OPACITY = 0.8
DISC_THICKNESS = 0.1


@dataclass(frozen=True)
class InventedViews:
    """K restored views as references of others.

    Args:
        views: their colours, trust, depth and exposure, [K]; no Gaussian of the scene is seen in them.
        surface: discs on what they have invented.
    """

    views: ReferenceViews
    surface: Scene

    def __len__(self) -> int:
        return len(self.views)

    @classmethod
    def of_views(
        cls,
        cameras: Cameras,
        rgb: Float[Tensor, "k 3 h w"],
        depth_mm: Float[Tensor, "k 1 h w"],
        unknown: Float[Tensor, "k 1 h w"],
        exposure: Float[Tensor, "k"],
        transfer: LightTransfer,
    ) -> InventedViews:
        """Prepare restored views as references.

        Args:
            cameras: of the views, at least one.
            rgb: restored colours in [0, 1].
            depth_mm: their z-depth without gaps.
            unknown: share of a pixel that nothing knew before it was restored.
            exposure: gain of each view.
            transfer: how brightness changes with distance.

        Raises:
            ShapeError: when the numbers of views differ or there is none.
        """
        counts = {len(cameras), len(rgb), len(depth_mm), len(unknown), len(exposure)}
        if len(counts) != 1 or counts == {0}:
            raise ShapeError(f"the parts of invented views have different lengths: {sorted(counts)}")
        rays = [torch.from_numpy(pixel_rays(cameras[view])[0].astype(np.float32)) for view in range(len(rgb))]
        normals = [depth_normals(ray, depth) for ray, depth in zip(rays, depth_mm, strict=True)]
        facing = torch.stack(
            [
                (normal * ray).sum(dim=-1).abs() / ray.norm(dim=-1)
                for normal, ray in zip(normals, rays, strict=True)
            ]
        )[:, None]
        trust = ((facing - GRAZING[0]) / (GRAZING[1] - GRAZING[0])).clamp(0, 1)
        trust = trust * border_trust(cameras.height, cameras.width) * evidence(unknown)
        packed = torch.cat([rgb, trust, 1 / depth_mm.clamp_min(1e-9), torch.ones_like(trust)], dim=1)
        views = ReferenceViews(
            np.arange(len(rgb)),
            cameras,
            packed.contiguous(),
            exposure,
            torch.zeros(len(rgb), 0, dtype=torch.bool),
            transfer,
        )
        parts = [
            _discs(
                cameras[view], rays[view], depth_mm[view], normals[view], unknown[view] * (trust[view] > 0)
            )
            for view in range(len(rgb))
        ]
        points, found, radius = (np.concatenate(part) for part in zip(*parts, strict=True))
        surface = Gaussians.from_points(
            points,
            np.zeros_like(points),
            radius,
            opacity=DISC_OPACITY,
            normals=found,
            thickness=DISC_THICKNESS,
        )
        return cls(views, Scene(surface, None))


def with_invented(
    layers: Layers,
    invented: InventedViews | None,
    cameras: Cameras,
    exposure: Float[Tensor, "v"] | None = None,
) -> Layers:
    """Layers with what other restored views have invented; depth, too, where only they know the surface.

    Args:
        layers: of V views; they are not changed.
        invented: restored views; None gives the layers back.
        cameras: the views.
        exposure: gain of each; None is 1.

    Raises:
        ShapeError: when the numbers of views differ.
    """
    if len(layers) != len(cameras):
        raise ShapeError(f"layers of {len(layers)} views, {len(cameras)} cameras")
    if invented is None or len(invented.surface.gaussians) == 0:
        return layers

    def followed(view: int) -> Tensor:
        gain = None if exposure is None else exposure[[view]]
        return _followed(layers[view], invented, cameras[view], gain).data

    return Layers(torch.cat(in_threads(followed, range(len(layers)))))


def _followed(
    layers: Layers, invented: InventedViews, camera: Cameras, exposure: Float[Tensor, "1"] | None
) -> Layers:
    layers = Layers(layers.data.clone())
    alpha = layers.get("alpha")
    # As near as the scene itself is rendered: in a small unit, all discs may be nearer than without a light.
    near = Scene(invented.surface.gaussians, invented.views.transfer.light).near
    with torch.no_grad():
        rendering = invented.surface.render(camera, median_depth=True, near=near)
    if rendering.median_depth is None:
        raise ShapeError("the rasteriser returned no median depth")
    share, median = rendering.alpha[:, None], rendering.median_depth[:, None]
    # What the scene itself shows stays: an invented surface behind it is hidden, one before it is wrong.
    only = (alpha < HOLE_ALPHA) & (share > HOLE_ALPHA) & (median > 0)
    depth = torch.where(only, median, layers.get("depth_mm"))
    complete = completed_depth(depth, torch.where(only, share, alpha), invented.views.transfer.scale_mm)
    warped = warp_references(
        invented.views,
        camera,
        complete,
        count=BLENDED,
        exposure=exposure,
        good_quality=GOOD_QUALITY,
        depth_tolerance=DEPTH_TOLERANCE,
    )
    missing = (1 - known_share(layers)).clamp(0, 1)
    trust = feathered(warped.blend_weight)
    # Near what it knows the view itself knows better than a keyframe that looked from far inside the hole.
    weight = (FOLLOWED * trust / evidence(missing)).clamp(max=1) * missing
    layers.get("depth_mm").copy_(torch.where(weight > 0, depth, layers.get("depth_mm")))
    layers.get("invented").copy_(_in_harmony(warped.blend, warped.blend_weight, layers) * (weight > 0))
    layers.get("invented_weight").copy_(weight)
    return layers


def evidence(unknown: Float[Tensor, "v 1 h w"]) -> Float[Tensor, "v 1 h w"]:
    """How well each pixel of a view can be invented: the better, the nearer to what is known.

    Args:
        unknown: share of a pixel that nothing gives.
    """
    from scipy.ndimage import distance_transform_edt

    maps = []
    for holes in (unknown[:, 0] > INVENTED).numpy():
        # Without anything known there is no distance to it.
        far = np.full(holes.shape, np.inf) if holes.all() else distance_transform_edt(holes)
        maps.append(np.exp(-far / (REACH * holes.shape[1])).clip(LEAST_EVIDENCE))
    return torch.from_numpy(np.stack(maps).astype(np.float32))[:, None]


def _in_harmony(
    color: Float[Tensor, "1 3 h w"], trust: Float[Tensor, "1 1 h w"], layers: Layers
) -> Float[Tensor, "1 3 h w"]:
    """Invented colours as bright as what is known around them.

    The light's model and the depths are not exact. How far a keyframe is off is seen where it shows what the
    view knows itself; this factor is extended smoothly into the hole.
    """
    known = known_share(layers)
    weight = layers.get("blend_weight")
    own = weight * layers.get("blend") + (1 - weight) * layers.get("rendered")
    both = trust * known * (known > HOLE_ALPHA)

    def in_blocks(values: Tensor) -> Tensor:
        return functional.avg_pool2d(values, HARMONY_PX, ceil_mode=True, count_include_pad=False)

    share = in_blocks(both).clamp_min(1e-6)
    ours = in_blocks(both * own.mean(dim=1, keepdim=True) / known.clamp_min(1e-3)) / share
    theirs = in_blocks(both * color.mean(dim=1, keepdim=True)) / share
    limit = float(np.log(LARGEST_CORRECTION))
    off = ((ours + DARKEST) / (theirs + DARKEST)).log().clamp(-limit, limit)
    factor = functional.interpolate(
        push_pull(off, in_blocks(both)), size=color.shape[-2:], mode="bilinear", align_corners=False
    ).exp()
    bright = color * factor
    return bright / bright.amax(dim=1, keepdim=True).clamp_min(1)


def border_trust(height: int, width: int) -> Float[Tensor, "h w"]:
    """Trust in a pixel by its place alone: 1 inside, falling to 0 over `FEATHER_PX` at the border.

    Args:
        height: of the image, in pixels.
        width: of the image, in pixels.
    """
    down, along = (
        torch.minimum(torch.arange(size) + 0.5, size - 0.5 - torch.arange(size)) for size in (height, width)
    )
    return (torch.minimum(down[:, None], along[None]) / FEATHER_PX).clamp(0, 1)


def _discs(
    camera: Cameras,
    rays: Float[Tensor, "h w 3"],
    depth_mm: Float[Tensor, "1 h w"],
    normals: Float[Tensor, "h w 3"],
    unknown: Float[Tensor, "1 h w"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Centres, normals and radii of discs on the invented surface of one view."""
    chosen = unknown[0] > INVENTED
    stride = max(1, int(np.ceil(np.sqrt(int(chosen.sum()) / DISCS))))
    lattice = torch.zeros_like(chosen)
    lattice[stride // 2 :: stride, stride // 2 :: stride] = True
    chosen = chosen & lattice
    ray, depth, normal = rays[chosen], depth_mm[0][chosen], normals[chosen]
    # Seen at an angle, neighbouring pixels lie farther apart on the surface.
    cosine = ((normal * ray).sum(dim=-1).abs() / ray.norm(dim=-1)).clamp_min(GRAZING[0])
    pitch = stride * depth / float(camera.K[0, 0, 0]) / cosine.sqrt()
    points = torch.from_numpy(camera.centers[0].astype(np.float32)) + ray * depth[:, None]
    return points.numpy(), normal.numpy(), (DISC_PITCHES * pitch).numpy()
