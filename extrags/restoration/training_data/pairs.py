"""Training pairs for restorers, made of the scene's own training frames.

*Leave-out pairs*: the scene is reconstructed briefly without some training frames, which are then rendered
twice: from that scene, and from a perturbed copy with holes.
*Synthetic pairs*: Gaussians from the depth of a few frames, perturbed and not optimised, rendered in other
frames. Held-out frames are never used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from extrags.cameras import pixel_rays
from extrags.config import CoarseConfig, EnhanceConfig
from extrags.errors import CaptureError
from extrags.events import Progress, emit
from extrags.gaussians import Gaussians
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, saturated_mask
from extrags.training.leave_out import (
    MIN_FRAMES,
    leave_out_folds,
    log_exposures,
    partial_scene,
    show_tissue,
)
from extrags.training.starting import surface_normals
from extrags.view_synthesis.conditioning import Layers, observe_views
from extrags.view_synthesis.gather import gather_references
from extrags.view_synthesis.references import ReferenceViews

__all__ = ["Pairs", "fold_pairs", "make_pairs", "pair_views", "synthetic_pairs", "usable_folds"]

VALIDATION_EVERY = 5
"""Every n-th training frame is a target of the validation only."""
TARGETS_PER_SUBSET = 4
SYNTHETIC_GAUSSIANS = 8000
FLAT = 0.1
"""Thickness of synthetic Gaussians, as a share of their radius."""
MIN_GAIN = 0.05
"""Lower bound of the received light when albedo is computed: in the dark, noise would dominate."""


@dataclass(frozen=True)
class Pairs:
    """P degraded views with their true images.

    Args:
        layers: of the degraded views, [P].
        target: the real image, in [0, 1], [P, 3, H, W].
        weight: 1 where the target is valid tissue and not saturated, [P, 1, H, W].
        depth_mm: z-depth, measured or reliably estimated, 0 where unknown, [P, 1, H, W].
        frame: frame of the sequence, [P].
        synthetic: which pairs come from unoptimised or perturbed Gaussians, [P].
        validation: which pairs are for validation, [P].
    """

    layers: Layers
    target: Float[Tensor, "p 3 h w"]
    weight: Float[Tensor, "p 1 h w"]
    depth_mm: Float[Tensor, "p 1 h w"]
    frame: Int[np.ndarray, "p"]
    synthetic: Bool[np.ndarray, "p"]
    validation: Bool[np.ndarray, "p"]

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the images in pixels."""
        return int(self.target.shape[-2]), int(self.target.shape[-1])

    def subset(self, chosen: Int[np.ndarray, "m"]) -> Pairs:
        """Chosen pairs."""
        index = torch.from_numpy(np.asarray(chosen, dtype=np.int64))
        return Pairs(
            self.layers[chosen],
            self.target[index],
            self.weight[index],
            self.depth_mm[index],
            self.frame[chosen],
            self.synthetic[chosen],
            self.validation[chosen],
        )

    @staticmethod
    def concatenated(parts: list[Pairs]) -> Pairs:
        """Join pairs.

        Raises:
            CaptureError: when there are none.
        """
        if not parts:
            raise CaptureError("no pairs to train the restorer on")
        return Pairs(
            Layers(torch.cat([part.layers.data for part in parts])),
            torch.cat([part.target for part in parts]),
            torch.cat([part.weight for part in parts]),
            torch.cat([part.depth_mm for part in parts]),
            np.concatenate([part.frame for part in parts]),
            np.concatenate([part.synthetic for part in parts]),
            np.concatenate([part.validation for part in parts]),
        )


def make_pairs(
    scene: Scene,
    sequence: EndoscopicSequence,
    config: EnhanceConfig,
    coarse: CoarseConfig,
    *,
    most: int | None = None,
) -> Pairs:
    """All pairs of a scene; folds that keep no frame with a valid pixel give none.

    Args:
        scene: the coarse scene, trained on `sequence.train`; leave-out reconstructions run where it is.
        sequence: posed frames; only training frames are used.
        config: how many pairs.
        coarse: settings of the leave-out reconstructions.
        most: about so many leave-out pairs at most, two of every frame that is taken; None takes all.

    Raises:
        CaptureError: with fewer than four training frames, or when there is no pair at all.
    """
    parts = []
    folds = usable_folds(sequence, config)
    frames = None if most is None else max(1, most // (2 * max(1, len(folds))))
    for done, fold in enumerate(folds, start=1):
        parts.append(fold_pairs(scene, sequence, config, coarse, fold, most_frames=frames))
        emit(Progress("enhance-pairs", done, len(folds) + 1))
    if config.synthetic_views > 0:
        parts.append(synthetic_pairs(scene, sequence, config))
    emit(Progress("enhance-pairs", len(folds) + 1, len(folds) + 1))
    return Pairs.concatenated(parts)


def usable_folds(sequence: EndoscopicSequence, config: EnhanceConfig) -> list[int]:
    """Folds of which a scene can be reconstructed: some frame that is kept has a valid pixel.

    Args:
        sequence: frames; only training frames are looked at.
        config: number of folds.

    Raises:
        CaptureError: with fewer than four training frames.
    """
    folds = leave_out_folds(np.asarray(sequence.train, dtype=np.int64), config.folds)
    return [fold for fold, (kept, _) in enumerate(folds) if show_tissue(sequence, kept)]


def fold_pairs(
    scene: Scene,
    sequence: EndoscopicSequence,
    config: EnhanceConfig,
    coarse: CoarseConfig,
    fold: int,
    *,
    most_frames: int | None = None,
) -> Pairs:
    """Reconstruct without the frames of a fold, and render them, from the scene and from a perturbed copy.

    Args:
        scene: the coarse scene; its light gives the exposure of the left-out frames. The reconstruction runs
            where it is.
        sequence: posed frames.
        config: folds, iterations, seed.
        coarse: settings of the reconstruction.
        fold: which fold, from 0.
        most_frames: of the fold, at most so many are rendered, spread evenly; None renders all.

    Raises:
        CaptureError: with fewer than four training frames.
    """
    train = np.asarray(sequence.train, dtype=np.int64)
    kept, left = leave_out_folds(train, config.folds)[fold]
    partial = partial_scene(
        scene,
        sequence,
        coarse,
        kept,
        iterations=config.fold_iterations,
        seed=config.seed + fold,
        stage="enhance-pairs",
    )
    # The views of pairs need blending weights and median depth, which the native kernels give.
    scene, partial = scene.to("cpu"), partial.to("cpu")
    references = gather_references(partial, sequence, kept)
    if most_frames is not None and len(left) > most_frames:
        left = left[np.linspace(0, len(left) - 1, most_frames).round().astype(np.int64)]
    # In the partial scene the mean over the kept frames is one.
    gain = (log_exposures(scene, sequence, left) - log_exposures(scene, sequence, kept).mean()).exp()
    generator = np.random.default_rng([config.seed, 4, fold])
    perturbed = _perturbed(partial, generator)
    parts = []
    for degraded, views in ((partial, references), (perturbed, references.of_scene(perturbed))):
        observation = observe_views(
            degraded,
            views,
            sequence.cameras[left],
            count=config.references,
            reference=config.reference,
            exposure=gain,
        )
        parts.append(pair_views(sequence, observation.layers, left, synthetic=degraded is perturbed))
    return Pairs.concatenated(parts)


def _perturbed(scene: Scene, generator: np.random.Generator) -> Scene:
    """The scene with holes and displaced Gaussians, as it looks from farther off the trajectory."""
    means = scene.gaussians.means.numpy()
    keep = generator.random(len(means)) > generator.uniform(0, 0.3)
    keep &= _outside_random_balls(means, float(np.ptp(means, axis=0).min()), generator)
    gaussians = scene.gaussians.subset(torch.from_numpy(keep))
    size = gaussians.scales.exp().numpy()
    shift = generator.normal(0, generator.uniform(0, 1), size.shape) * size
    grown = generator.normal(0.1, 0.2, (len(size), 1))
    return Scene(
        replace(
            gaussians,
            means=gaussians.means + torch.from_numpy(shift.astype(np.float32)),
            scales=gaussians.scales + torch.from_numpy(grown.astype(np.float32)),
        ),
        scene.light,
    )


def _outside_random_balls(
    points: Float[np.ndarray, "n 3"], scale: float, generator: np.random.Generator
) -> Bool[np.ndarray, "n"]:
    """False inside up to four balls round random points; true everywhere when nothing would be left."""
    outside = np.ones(len(points), dtype=bool)
    for _ in range(int(generator.integers(0, 5))):
        center = points[generator.integers(len(points))]
        outside &= np.linalg.norm(points - center, axis=1) > generator.uniform(0.05, 0.35) * scale
    return outside if outside.any() else np.ones(len(points), dtype=bool)


def synthetic_pairs(scene: Scene, sequence: EndoscopicSequence, config: EnhanceConfig) -> Pairs:
    """Gaussians from the depth of a few frames, perturbed, rendered in other frames.

    Args:
        scene: the coarse scene; gives light, exposures and depth where none was measured.
        sequence: posed frames.
        config: number of views and seed.

    Raises:
        CaptureError: with fewer than four training frames; when some of them, that lie near each other, know
            no surface: neither their depth nor the scene tells of any.
    """
    scene = scene.to("cpu")
    train = np.asarray(sequence.train, dtype=np.int64)
    if len(train) < MIN_FRAMES:
        leave_out_folds(train, config.folds)
    everything = gather_references(scene, sequence, train)
    generator = np.random.default_rng([config.seed, 1])
    centers = sequence.cameras[train].centers
    parts = []
    remaining = config.synthetic_views
    while remaining > 0:
        size = int(generator.integers(2, max(3, len(train) // 3 + 1)))
        start = int(generator.integers(len(train)))
        nearest = np.argsort(np.linalg.norm(centers - centers[start], axis=1), kind="stable")
        subset = np.sort(generator.choice(nearest[: min(len(train) - 1, 2 * size)], size, replace=False))
        others = np.array([i for i in nearest if i not in subset])
        count = min(TARGETS_PER_SUBSET, remaining, len(others))
        targets = generator.choice(others[: max(count, len(others) // 2)], count, replace=False)
        views = everything.subset(subset)
        if not _usable(views).any():
            shown = ", ".join(sequence.frame_name(int(frame)) for frame in views.frames)
            raise CaptureError(
                f"{sequence.name}: no surface is known at any valid pixel of the training frames {shown}; "
                "the restorer cannot be shown views made from them"
            )
        crude = Scene(_crude_gaussians(views, generator), scene.light)
        views = views.of_scene(crude)
        gain = everything.exposure[torch.from_numpy(targets)]
        observation = observe_views(
            crude,
            views,
            sequence.cameras[train[targets]],
            count=config.references,
            reference=config.reference,
            exposure=gain,
        )
        parts.append(pair_views(sequence, observation.layers, train[targets], synthetic=True))
        remaining -= count
    return Pairs.concatenated(parts)


def _usable(views: ReferenceViews) -> Bool[np.ndarray, "p"]:
    """Pixels, of all views in a row, that are trusted and whose depth is known."""
    return ((views.packed[:, 3] > 0) & (views.packed[:, 5] > 0)).flatten().numpy()


def _crude_gaussians(views: ReferenceViews, generator: np.random.Generator) -> Gaussians:
    """Unoptimised Gaussians on the views' surface: noisy depth, torn holes, floaters."""
    rays = pixel_rays(views.cameras).reshape(-1, 3)
    packed = views.packed.permute(0, 2, 3, 1).reshape(-1, 6).numpy().astype(np.float64)
    usable = np.flatnonzero(_usable(views))
    count = min(SYNTHETIC_GAUSSIANS, len(usable))
    chosen = np.sort(generator.choice(usable, count, replace=False))
    view = chosen // (views.cameras.width * views.cameras.height)
    depth = 1 / packed[chosen, 4]
    offsets = rays[chosen] * depth[:, None]
    # Flat on the surface, as a scene's Gaussians are: the light darkens what is turned away from it.
    normals = surface_normals(views.cameras.centers[view] + offsets)
    colors = packed[chosen, :3]
    light = views.transfer.light
    # Without a light the fall-off cannot be divided out: the colour stays as it was seen.
    if light is not None:
        turned = views.cameras.world_from_camera[view, :3, :3]
        in_camera = [
            torch.from_numpy(np.einsum("nji,nj->ni", turned, values).astype(np.float32))
            for values in (offsets, normals)
        ]
        signal = light.invert_response(torch.from_numpy(colors)).numpy() / views.exposure.numpy()[view, None]
        signal = (signal - light.specular_gain(*in_camera).detach().numpy()[:, None]).clip(0)
        colors = signal / np.maximum(light.gain(*in_camera).detach().numpy(), MIN_GAIN)[:, None]
    # Standard deviation of a Gaussian that covers the area of one point.
    pitch = np.sqrt(len(usable) / count) / views.cameras.K[view, 0, 0]
    radius = 0.6 * depth * pitch * np.exp(generator.normal(0, 0.25, count))
    noise = generator.normal(0, generator.uniform(0.003, 0.04), count)
    points = views.cameras.centers[view] + offsets * (1 + noise)[:, None]
    floats = generator.random(count) < generator.uniform(0, 0.02)
    inward = generator.uniform(0.3, 0.95, count)
    points = np.where(floats[:, None], views.cameras.centers[view] + offsets * inward[:, None], points)
    colors = np.where(floats[:, None], generator.uniform(0, 1.2, (count, 3)), colors)
    # A floater near the lens must not look larger than the surface it was taken from.
    radius = np.where(floats, radius * inward, radius)
    keep = _outside_random_balls(points, float(np.median(depth)), generator)
    opacity = float(generator.uniform(0.4, 0.95))
    return Gaussians.from_points(
        points[keep],
        colors[keep].clip(0, None),
        radius[keep],
        opacity=opacity,
        normals=normals[keep],
        thickness=FLAT,
    )


def pair_views(
    sequence: EndoscopicSequence, layers: Layers, frames: Int[np.ndarray, "m"], *, synthetic: bool
) -> Pairs:
    """Layers of frames with their true images; every fifth training frame is for validation."""
    rgb = sequence.rgb[frames]
    valid = sequence.supervised_mask(frames) & ~saturated_mask(rgb)
    depth = sequence.reliable_depth_mm(frames)
    if depth is None:
        depth = np.zeros(valid.shape, dtype=np.float32)
    train = np.asarray(sequence.train, dtype=np.int64)
    position = np.searchsorted(np.sort(train), frames)
    return Pairs(
        layers,
        torch.from_numpy(rgb.astype(np.float32) / 255).permute(0, 3, 1, 2).contiguous(),
        torch.from_numpy(valid.astype(np.float32))[:, None],
        torch.from_numpy(depth)[:, None],
        frames,
        np.full(len(frames), synthetic),
        position % VALIDATION_EVERY == VALIDATION_EVERY // 2,
    )
