"""Joint fine-tuning on real views and confidence-weighted pseudo-observations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from extrags.cameras import rays_of_pixels
from extrags.config import DEFAULT_PROFILE, PROFILES, CoarseConfig, FinetuneConfig
from extrags.frame_quantiles import quantile_of_frames
from extrags.frame_stacks import stacked
from extrags.gaussians import Gaussians
from extrags.pseudo_views import PseudoViews
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.threads import one_torch_thread
from extrags.thresholds import HOLE_ALPHA
from extrags.training.filling import FillingStep, filling_schedule
from extrags.training.frame_weights import FrameWeights, weighted_views
from extrags.training.optimise import TrainingResult, optimise
from extrags.training.reconstruction import coarse_schedule, scene_extent, smallest_footprint
from extrags.training.starting import LEAST_COLOR, median_depth, surface_normals, thin_out
from extrags.training.views import View, epochs, in_steps, real_views

__all__ = ["finetune", "hole_gaussians", "virtual_steps", "virtual_views"]

UNKNOWN = 0.5
"""Uncertainty of a pixel from which its restored depth supervises."""

CARVED_MARGIN = 0.05
"""A new Gaussian nearer than a real view's surface by this share of its depth would hide it."""

KNOWN_BELOW = 0.5
"""Below this uncertainty a solid pixel of a virtual view shows surface the scene knows."""

GUESSED_NEARER = 0.25
"""A new Gaussian this much nearer than another virtual view's completed depth stands in that view's way."""

MAX_GUESS_DISTANCE = 1.0
"""In median depths. Farther from known surface completed depth says nothing; nearer, a wall at a third too
short a distance is less wrong than none at all."""

NEAREST_QUANTILE = 0.01
"""Of the depths of training frames: the nearest surface they show, without outliers."""

CLEAR_OF_CAMERAS = 0.7
"""No new Gaussian is nearer to a camera than this share of the nearest surface: cameras fly in free space."""

_ROUNDING = 1e-14
"""Of a sum of shares, relative."""

MIN_POINTS = 8
"""Fewer hole points have neither neighbours nor normals."""

MIN_GAIN = 0.05
"""Lower bound of the light divided out of a hole's colour: far and grazing surface there is only guessed."""

HOLE_STRIDE_PX = 2
"""Hole pixels are taken on a grid of this step; thinning would drop most of them anyway."""
LEAST_SPACING_PX = 2.0
"""New Gaussians lie no closer, at the median depth of the holes, than the grid that they are taken from."""


def finetune(
    scene: Scene,
    sequence: EndoscopicSequence,
    pseudo_views: PseudoViews | None,
    config: FinetuneConfig | None = None,
    coarse: CoarseConfig | None = None,
    *,
    stage: str = "finetune",
    frame_weights: FrameWeights | None = None,
) -> TrainingResult:
    r"""Fine-tune a scene on real and virtual views together.

    With P pixels in an image, :math:`\ell_1 = \sum_c |I - \hat I| / 3` and
    :math:`\ell_s = \sum_c (1 - \mathrm{SSIM}_c) / 6` of each of them, a virtual view's loss is

    .. math:: w \, U_{img} \Bigl( \frac{\phi}{Z} \sum_p \bigl( (1 - \lambda) \, U_{pixel} \, \ell_1
            + \lambda \, s \, \ell_s \bigr) + w_d \, L_{depth} \Bigr)

    with w the `pseudo_weight`, :math:`\phi` the `photometric_weight` and :math:`U_{pixel}` not below
    `confidence_floor`. `loss` chooses Z and s: `weighted_mean` :math:`Z = \sum_p U_{pixel}` and
    :math:`s = U_{pixel}`, in which the magnitude of :math:`U_{pixel}` cancels; `weighted_sum` Z = P and
    :math:`s = U_{pixel}`; `paper` Z = P and s = 1. For a real view w, :math:`U_{img}` and :math:`U_{pixel}`
    are one and sums are over its valid pixels. The depth term, for virtual views with `pseudo_depth` alone,
    is `inverse_depth_loss`; there on pixels whose surface the scene does not know.

    [ExtraGS, eq. 24 and 25] are loss `paper`, `dssim_weight` 2/3 and `photometric_weight` 3, which is
    L1 + (1 - SSIM), the D-SSIM of the published code; `pseudo_weight` 1, `confidence_floor` 0, `depth_weight`
    0, and U_pixel from `enhance.pixel_confidence` raw.

    Which kind a step draws follows a fixed pattern whose share of virtual views falls linearly. The position
    learning rate starts anew. Seeds and densification together may bring the scene to `growth` times the
    coarse limit. Without pseudo-observations only real views are used, and the light cools down
    (`light_cooldown_share`): with them, half of the steps hold the brightness.

    With `keep_scene` the scene's own Gaussians and its light stay as they are: only new ones in holes are
    learned, without densification; where there are none, the scene is returned as it was given.

    Args:
        scene: the coarse scene; the optimisation runs where it is, and so does the result.
        sequence: posed frames; only training frames are used.
        pseudo_views: restored virtual views with confidences, or None.
        config: budgets and shares; None takes those of the profile `balanced`.
        coarse: rates and weights, those the coarse scene was made with; None takes those of the profile
            `balanced`.
        stage: named in progress events.
        frame_weights: of the training frames, where they are known from the reconstruction; None looks for
            blurred frames where `coarse.inconsistent_frames` is `weight`.

    Raises:
        DivergedError: when the optimisation does not stay finite.
        ShapeError: for weights of other frames.

    Source: [ExtraGS, eq. 24] (training views) and [ExtraGS, eq. 25] (virtual views), see
    docs/references.md; their depth term is our own.
    """
    # Not as a decorator, which would hold the virtual views for its caller.
    with one_torch_thread():
        config = PROFILES[DEFAULT_PROFILE].finetune if config is None else config
        coarse = PROFILES[DEFAULT_PROFILE].coarse if coarse is None else coarse
        frames = sequence.train
        depth = median_depth(sequence, frames)
        max_gaussians = round(config.growth * coarse.densify.max_gaussians)
        start = scene
        if pseudo_views is not None and config.seed_holes:
            room = max_gaussians - len(scene.gaussians)
            start = _with_filled_holes(scene, sequence, pseudo_views, room, coarse.thickness, depth)
        if config.keep_scene and start is scene:
            return TrainingResult(scene.detached(), [])
        cooldown_share = config.light_cooldown_share if pseudo_views is None else 0.0
        draw = _draws(sequence, pseudo_views, config, coarse, frame_weights, scene.device)
        # A caller that keeps none either has their floats out of memory while the scene is optimised.
        del pseudo_views
        densify = {"start_share": 0.0, "stop_share": config.densify_share, "max_gaussians": max_gaussians}
        schedule = coarse_schedule(
            _with_loss_weights(coarse, config),
            scene_extent(sequence, frames),
            depth,
            stage,
            iterations=config.iterations,
            densify=coarse.densify.model_copy(update=densify),
        )
        # All harmonics are active from the first step: the scene is optimised already.
        schedule = replace(
            schedule, photometric_weight=config.photometric_weight, light_cooldown_share=cooldown_share
        ).resumed(seed=config.seed)
        if config.keep_scene:
            fixed = len(scene.gaussians)
            return optimise(
                start,
                draw,
                filling_schedule(schedule),
                make_step=lambda scene, schedule: FillingStep(scene, schedule, fixed),
            )
        footprint = smallest_footprint(coarse, sequence.cameras[frames])
        return optimise(start, draw, schedule, footprint=footprint)


def _with_filled_holes(
    scene: Scene,
    sequence: EndoscopicSequence,
    pseudo_views: PseudoViews,
    room: int,
    thickness: float,
    depth: float,
) -> Scene:
    """The scene with `hole_gaussians`, or itself where there are none; `depth` is its length scale."""
    new_gaussians = hole_gaussians(
        scene.to("cpu"),
        sequence,
        pseudo_views,
        room,
        thickness=thickness,
        max_distance=MAX_GUESS_DISTANCE * depth,
    )
    if new_gaussians is None:
        return scene
    return Scene(Gaussians.concatenated(scene.gaussians, new_gaussians.to(scene.device)), scene.light)


def _draws(
    sequence: EndoscopicSequence,
    pseudo_views: PseudoViews | None,
    config: FinetuneConfig,
    coarse: CoarseConfig,
    frame_weights: FrameWeights | None,
    device: torch.device,
) -> Callable[[int], View]:
    """What each iteration draws: a real or a virtual view, by the pattern of `virtual_steps`."""
    if coarse.inconsistent_frames == "weight":
        real, _ = weighted_views(sequence, sequence.train, coarse, frame_weights)
    else:
        real = real_views(sequence, sequence.train)
    virtual = [] if pseudo_views is None else virtual_views(pseudo_views, config)
    real, virtual = ([view.to(device) for view in views] for views in (real, virtual))
    generator = np.random.default_rng(config.seed)
    next_real, next_virtual = epochs(len(real), generator), epochs(max(1, len(virtual)), generator)
    pattern = virtual_steps(config, any_virtual=bool(virtual))

    def draw(iteration: int) -> View:
        return virtual[next(next_virtual)] if pattern[iteration] else real[next(next_real)]

    return draw


def _with_loss_weights(coarse: CoarseConfig, config: FinetuneConfig) -> CoarseConfig:
    """The coarse stage's weights of the loss, where fine-tuning sets none of its own."""
    own = {"dssim_weight": config.dssim_weight, "depth_weight": config.depth_weight}
    return coarse.model_copy(update={name: value for name, value in own.items() if value is not None})


def virtual_steps(config: FinetuneConfig, *, any_virtual: bool = True) -> Bool[np.ndarray, "i"]:
    """Which iterations draw a virtual view: evenly spread, with a share that falls linearly.

    Args:
        config: number of iterations, and the share of virtual views at the start and at the end.
        any_virtual: False where there is no virtual view to draw.
    """
    if not any_virtual:
        return np.zeros(config.iterations, dtype=bool)
    share = np.linspace(config.pseudo_share, config.pseudo_share_final, config.iterations)
    # The sum of all shares so far. Rounding must not leave one that is a whole number just below it.
    behind = np.arange(1, config.iterations + 1) * (share[0] + share) / 2
    return np.asarray(np.diff(np.floor(behind * (1 + _ROUNDING)), prepend=0) > 0)


def virtual_views(pseudo_views: PseudoViews, config: FinetuneConfig) -> list[View]:
    """Pseudo-observations as views, with both levels of confidence as weights.

    Args:
        pseudo_views: restored virtual views; those of image-level confidence zero are left out.
        config: which form the loss has (see `finetune`), and what weights and targets are made of.
    """
    views = []
    cameras = pseudo_views.cameras
    # Virtual cameras have no mask: every pixel is valid.
    normalisation = None if config.loss == "weighted_mean" else float(cameras.height * cameras.width)
    ssim_weight = torch.ones(cameras.height, cameras.width) if config.loss == "paper" else None
    # Completed depth supervises only where the scene has no reliable surface.
    weights = config.pseudo_weight * pseudo_views.image_confidence
    used = np.flatnonzero(weights > 0)
    if not config.image_confidence:
        weights = np.full_like(weights, weights[used].mean() if len(used) else 0)
    for index in used.tolist():
        target = pseudo_views.target[index] if config.keep_known else pseudo_views.restored[index]
        confidence = in_steps(pseudo_views.pixel_confidence[index])
        depth = None
        if config.pseudo_depth:
            unknown = pseudo_views.uncertainty[index] > UNKNOWN
            depth = torch.from_numpy(np.where(unknown, pseudo_views.depth_mm[index], 0).astype(np.float32))
        if confidence.dtype != torch.uint8:
            confidence = confidence.clamp(min=config.confidence_floor)
        views.append(
            View(
                camera=cameras[index],
                rgb=in_steps(target),
                weight=confidence,
                least_weight=config.confidence_floor,
                depth_mm=depth,
                frame=None,
                loss_weight=float(weights[index]),
                ssim_weight=ssim_weight,
                normalisation=normalisation,
            )
        )
    return views


def hole_gaussians(
    scene: Scene,
    sequence: EndoscopicSequence,
    pseudo_views: PseudoViews,
    room: int,
    *,
    thickness: float = 1.0,
    max_distance: float = np.inf,
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

    Returns:
        The new Gaussians, or None where there is nothing to fill.
    """
    holes = (pseudo_views.alpha < HOLE_ALPHA) & (pseudo_views.depth_mm > 0)
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
    _, owner, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    owner = owner.reshape(-1)

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
