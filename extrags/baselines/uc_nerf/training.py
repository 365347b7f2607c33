"""Training of the baseline on the training frames of one scene."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from extrags.baselines.uc_nerf.field import RayColors, Rays, sample_depths
from extrags.baselines.uc_nerf.scene import UcNerf, UcNerfNetwork, nearest_views
from extrags.baselines.uc_nerf.stereo import (
    DepthPrior,
    EncodedViews,
    PosedImages,
    locally_normalised,
    plane_sweep,
)
from extrags.config import UcNerfConfig
from extrags.errors import CaptureError, ConfigError, DivergedError
from extrags.events import Progress, emit
from extrags.sequence import EndoscopicSequence
from extrags.threads import one_torch_thread
from extrags.training.random_start import depth_range
from extrags.training.views import View, epochs, real_views

__all__ = [
    "SparseDepth",
    "UcNerfResult",
    "edge_aware_smoothness",
    "photometric_consistency",
    "scale_invariant_gradient",
    "sparse_depths",
    "train",
]

_log = logging.getLogger(__name__)

HISTORY_EVERY = 50
"""Iterations between two entries of the history."""
SPARE_SOURCES = 2
"""Sources of a step are drawn from so many more than are needed: held-out views have other baselines."""
FINAL_RATE_SHARE = 0.05
"""Learning rate at the end, as a share of that at the start."""
NEAR_MARGIN, FAR_MARGIN = 0.5, 1.5
"""Rays reach from this share of the nearest known depth to this multiple of the farthest."""
_DEPTH_QUANTILES = (0.01, 0.99)
_CORNER_DISTANCE_PX = 4
_CORNER_QUALITY = 0.01
_CORNER_REACH_PX = 7
"""Side of the pixels that the strength of a corner depends on: derivatives of 3 x 3 in a window of 3 x 3,
and of neighbours, which it is the largest of."""
_OCCLUSION_CELL_PX = 8
_OCCLUSION_MARGIN = 1.1
_MIN_SPARSE = 4
"""A frame with fewer pixels of known depth counts as one without any."""
_MOST_NAMED = 3
"""Frames that a warning names."""


@dataclass(frozen=True)
class SparseDepth:
    """Pixels of a frame whose depth is known.

    Args:
        pixels: positions (u, v), pixel centres at +0.5, [K, 2].
        z: z-depths, [K].
    """

    pixels: Float[np.ndarray, "k 2"]
    z: Float[np.ndarray, "k"]


NO_DEPTH = SparseDepth(np.zeros((0, 2)), np.zeros(0))


@dataclass(frozen=True)
class UcNerfResult:
    """A trained baseline and the history of its training.

    Args:
        scene: without gradient history.
        history: every 50 iterations `{iteration, loss, psnr}`; the PSNR is of the rays just drawn.
    """

    scene: UcNerf
    history: list[dict[str, float]]


def train(
    sequence: EndoscopicSequence, config: UcNerfConfig | None = None, *, stage: str = "coarse"
) -> UcNerfResult:
    """Train stereo network and radiance field together on the training frames.

    Each step renders rays of one training frame from its neighbours, exactly as a held-out view is rendered:
    the frame itself is never among its sources.

    Args:
        sequence: posed frames; only the split's training frames are used.
        config: budgets, widths and weights; None takes the defaults.
        stage: named in progress events.

    Raises:
        CaptureError: with fewer than three training frames; when neither depth nor points are known and all
            cameras stand in one place; as `sparse_depths`.
        ConfigError: for frames through a lens: the baseline renders pinholes.
        DivergedError: when the loss does not stay finite.

    Source: Guo et al.: UC-NeRF: Uncertainty-aware Conditional Neural Radiance Fields from Endoscopic Sparse
    Views, IEEE Transactions on Medical Imaging 2024; docs/algorithms/uc_nerf.md lists what differs.
    """
    config = UcNerfConfig() if config is None else config
    if sequence.lens is not None:
        raise ConfigError(
            f"{sequence.name}: its frames have a lens, and uc_nerf renders pinholes; take ingest.lens=pinhole"
        )
    frames = np.asarray(sequence.train)
    if len(frames) < 3:
        raise CaptureError(
            f"{sequence.name}: {len(frames)} training frames; stereo needs at least 3, since a frame is "
            "rendered from two others"
        )
    sparse = sparse_depths(sequence, frames, config.sparse_pixels)
    with one_torch_thread():
        return _Training(sequence, frames, config, sparse, stage).run()


class _Training:
    """State of one training."""

    def __init__(
        self,
        sequence: EndoscopicSequence,
        frames: np.ndarray,
        config: UcNerfConfig,
        sparse: list[SparseDepth],
        stage: str,
    ) -> None:
        self.config = config
        self.stage = stage
        self.sparse = sparse
        self.views = real_views(sequence, frames)
        known = np.concatenate([item.z for item in sparse])
        cameras = sequence.cameras[frames]
        if len(known):
            nearest, farthest = np.quantile(known, _DEPTH_QUANTILES)
            scale = float(np.median(known))
        else:
            within = depth_range(cameras, sequence.name)
            nearest, scale, farthest = within.near, within.typical, within.far
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            network = UcNerfNetwork(config)
        self.scene = UcNerf(
            network=network,
            config=config,
            rgb=sequence.rgb[frames],
            mask=sequence.mask[frames],
            cameras=cameras,
            inverse_range=(1 / (FAR_MARGIN * float(farthest)), 1 / (NEAR_MARGIN * float(nearest))),
            center=cameras.centers.mean(axis=0),
            scale=scale,
        )
        self.images = PosedImages.of(self.scene.rgb, cameras, self.scene.mask)
        self.center = torch.from_numpy(self.scene.center.astype(np.float32))
        self.neighbours = [
            [
                int(other)
                for other in nearest_views(cameras[place], cameras, self.scene.scale)
                if other != place
            ]
            for place in range(len(frames))
        ]
        self.random = np.random.default_rng(config.seed)
        self.generator = torch.Generator().manual_seed(config.seed)

    def run(self) -> UcNerfResult:
        config, network = self.config, self.scene.network
        adam = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
        order = epochs(len(self.views), self.random)
        history: list[dict[str, float]] = []
        for iteration in range(config.iterations):
            share = iteration / config.iterations
            cosine = (1 + math.cos(math.pi * share)) / 2
            adam.param_groups[0]["lr"] = config.learning_rate * (
                FINAL_RATE_SHARE + (1 - FINAL_RATE_SHARE) * cosine
            )
            adam.zero_grad(set_to_none=True)
            loss, squared = self._loss(next(order))
            if not bool(torch.isfinite(loss)):
                raise DivergedError(f"{self.stage}: loss not finite any more at iteration {iteration}")
            loss.backward()
            adam.step()
            if iteration % HISTORY_EVERY == 0 or iteration == config.iterations - 1:
                psnr = -10 * math.log10(max(float(squared.detach()), 1e-12))
                entry = {"iteration": float(iteration), "loss": float(loss.detach()), "psnr": psnr}
                history.append(entry)
                emit(Progress(self.stage, iteration + 1, config.iterations, entry))
        network.requires_grad_(False)
        return UcNerfResult(self.scene, history)

    def _loss(self, frame: int) -> tuple[Tensor, Tensor]:
        """The loss of rays of one frame, and its mean squared colour error."""
        config, scene, view = self.config, self.scene, self.views[frame]
        around = self.neighbours[frame][: config.source_views + SPARE_SOURCES]
        count = min(config.source_views, len(around))
        sources = [around[i] for i in np.sort(self.random.choice(len(around), count, replace=False))]
        stereo, field = scene.network.stereo, scene.network.field
        encoded = stereo.encode(self.images[sources])
        K, viewmat = self.images.K[frame], self.images.viewmats[frame]
        height, width = view.rgb.shape[:2]
        prior = stereo(encoded, K, viewmat, scene.inverse_range, width, height)

        pixels = self._pixels(width, height)
        known = self.sparse[frame]
        sparse_pixels = torch.from_numpy(known.pixels.astype(np.float32))
        sparse_z = torch.from_numpy(known.z.astype(np.float32))
        rays = Rays(torch.cat([pixels + 0.5, sparse_pixels]), K, viewmat, width, height)
        guide = rays.sampled(torch.stack([prior.inverse, prior.deviation, prior.uncertainty])).detach()
        z = sample_depths(
            guide[0],
            guide[1],
            scene.inverse_range,
            config.samples_uniform,
            config.samples_prior,
            self.generator,
        )
        found = field(rays, z, encoded, prior, scene.inverse_range, self.center, scene.scale)

        column, row = pixels.long().unbind(dim=1)
        weight = view.weights[row, column]
        assert found.rgb is not None
        squares = (found.rgb[: len(pixels)] - view.colors[row, column]).square().mean(dim=1)
        squared = (squares * weight).sum() / weight.sum().clamp_min(1)

        confidence = 1 - guide[2]
        loss = config.color_weight * squared
        rendered = found.depth[len(pixels) :]
        # The mean over no pixel at all would be NaN.
        if len(sparse_z):
            loss = loss + config.sparse_depth_weight * functional.smooth_l1_loss(
                rendered / scene.scale, sparse_z / scene.scale
            )
        loss = loss + config.stereo_weight * (
            self._stereo_loss(prior, encoded, rays, view, frame)
            + (confidence * (found.depth - 1 / guide[0]).abs() / scene.scale).mean()
        )
        mask = self.images.mask
        shown = view.colors if mask is None else view.colors * mask[frame, ..., None]
        loss = loss + config.smoothness_weight * edge_aware_smoothness(
            prior.inverse * scene.scale, _resized(shown, prior.inverse)
        )
        patches = self._patches(found, guide, confidence)
        return loss + config.gradient_weight * scale_invariant_gradient(*patches), squared

    def _stereo_loss(
        self, prior: DepthPrior, encoded: EncodedViews, rays: Rays, view: View, frame: int
    ) -> Tensor:
        """What supervises the stereo network itself: known depth on both levels, and agreement of colours."""
        scene, known = self.scene, self.sparse[frame]
        levels = []
        if len(known.z):
            at_known = Rays(rays.pixels[-len(known.z) :], rays.K, rays.viewmat, rays.width, rays.height)
            target = torch.from_numpy((scene.scale / known.z).astype(np.float32))
            levels = [
                functional.smooth_l1_loss(at_known.sampled(inverse[None])[0] * scene.scale, target)
                for inverse in (prior.coarse_inverse, prior.inverse)
            ]
        height, width = prior.inverse.shape
        small = self.images[[frame]].resized(width, height)
        weight = _resized(view.weights[..., None], prior.inverse)[0]
        images = encoded.images.resized(width, height)
        return sum(levels, start=photometric_consistency(small, images, prior.inverse, weight))

    def _pixels(self, width: int, height: int) -> Float[Tensor, "r 2"]:
        """Columns and rows of single rays, then of patches, as floats."""
        config = self.config
        edge = min(config.patch_px, width, height)
        single = self.random.integers([width, height], size=(config.rays, 2))
        corners = self.random.integers([width - edge + 1, height - edge + 1], size=(config.patches, 1, 2))
        inside = np.stack(np.meshgrid(np.arange(edge), np.arange(edge)), axis=-1).reshape(1, -1, 2)
        pixels = np.concatenate([single, (corners + inside).reshape(-1, 2)])
        return torch.from_numpy(pixels.astype(np.float32))

    def _patches(self, found: RayColors, guide: Tensor, confidence: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Rendered depth, stereo depth and confidence of the patches."""
        config = self.config
        edge = min(config.patch_px, self.images.rgb.shape[-1], self.images.rgb.shape[-2])
        chosen = slice(config.rays, config.rays + config.patches * edge * edge)
        rendered, stereo, weight = (
            value[chosen].reshape(config.patches, edge, edge)
            for value in (found.depth, 1 / guide[0], confidence)
        )
        return rendered, stereo, weight


def sparse_depths(
    sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"], per_frame: int
) -> list[SparseDepth]:
    """Known depth at a few pixels of each frame: where structure from motion would have it.

    The sparse points of the source where it has some; else its depth at the strongest corners of the image.
    Nothing between these pixels is used. Where neither is known, or not enough, no pixel has a depth, which a
    warning says: agreement of colours is then all that supervises, between depths that follow from the
    cameras (`extrags.training.random_start.depth_range`). So are single frames of which too few pixels have
    one, between the depths of the others.

    Args:
        sequence: posed frames.
        frames: the frames that may be used.
        per_frame: corners of a frame at most.

    Raises:
        CaptureError: when there are points, or depth of some frame, and no frame has it at enough pixels.
    """
    if sequence.points is not None and len(sequence.points) >= _MIN_SPARSE:
        found = [_visible_points(sequence, int(frame), sequence.points) for frame in frames]
    elif sequence.depth_mm is not None and bool((sequence.depth_mm[frames] > 0).any()):
        found = [_depth_at_corners(sequence, int(frame), sequence.depth_mm, per_frame) for frame in frames]
    else:
        _log.warning(
            "%s: neither depth nor enough sparse points are known; colours alone supervise", sequence.name
        )
        return [NO_DEPTH] * len(frames)
    few = [place for place, item in enumerate(found) if len(item.z) < _MIN_SPARSE]
    if len(few) == len(found):
        raise CaptureError(
            f"{sequence.name}: none of {len(found)} training frames has {_MIN_SPARSE} pixels of known depth "
            "or more, at corners of the image or sparse points"
        )
    if few:
        named = ", ".join(sequence.frame_name(int(frames[place])) for place in few[:_MOST_NAMED])
        more = f" and {len(few) - _MOST_NAMED} more" if len(few) > _MOST_NAMED else ""
        _log.warning(
            "%s: fewer than %d pixels of known depth in %d of %d training frames (%s%s); colours alone "
            "supervise there",
            *(sequence.name, _MIN_SPARSE, len(few), len(found), named, more),
        )
    return [NO_DEPTH if place in few else item for place, item in enumerate(found)]


def photometric_consistency(
    target: PosedImages,
    sources: PosedImages,
    inverse: Float[Tensor, "h w"],
    weight: Float[Tensor, "h w"],
) -> Float[Tensor, ""]:
    """How far sources warped by the depth are from the target, mean absolute difference of normalised grey.

    The half of the sources that agree best counts: the others may not see the surface.

    Args:
        target: one view.
        sources: of the same size.
        inverse: inverse z-depth of the target.
        weight: of the target's pixels.

    Source: Khot et al.: Learning Unsupervised Multi-View Stereopsis via Robust Photometric Consistency, 2019,
    section 3.
    """
    warped, valid = plane_sweep(
        locally_normalised(sources.rgb, sources.mask),
        sources.K,
        sources.viewmats,
        target.K[0],
        target.viewmats[0],
        inverse[None],
        sources.mask,
    )
    difference = (warped[:, 0, 0] - locally_normalised(target.rgb, target.mask)[:, 0]).abs()
    counted = valid[:, 0] & (weight > 0)
    if target.mask is not None:
        counted = counted & target.mask
    best, index = difference.masked_fill(~counted, math.inf).sort(dim=0)
    kept = slice(0, max(1, len(sources) // 2))
    counts = counted.gather(0, index)[kept].to(best.dtype)
    return (torch.where(counts > 0, best[kept], 0.0) * counts).sum() / counts.sum().clamp_min(1)


def edge_aware_smoothness(inverse: Float[Tensor, "h w"], rgb: Float[Tensor, "c h w"]) -> Float[Tensor, ""]:
    """Mean absolute gradient of relative inverse depth, less where the image has edges.

    Source: Godard et al.: Unsupervised Monocular Depth Estimation with Left-Right Consistency, CVPR 2017,
    eq. 3, on inverse depth divided by its mean.
    """
    inverse = inverse / inverse.mean().detach()
    total = inverse.new_zeros(())
    for axis in (0, 1):
        edge = rgb.diff(dim=axis + 1).abs().mean(dim=0)
        total = total + (inverse.diff(dim=axis).abs() * torch.exp(-10 * edge)).mean()
    return total


def scale_invariant_gradient(
    depth: Float[Tensor, "p h w"], reference: Float[Tensor, "p h w"], weight: Float[Tensor, "p h w"]
) -> Float[Tensor, ""]:
    """Difference of the gradients of log-depth within patches; any scale between the two cancels.

    Args:
        depth: to be judged.
        reference: what it should be like, up to scale.
        weight: of each pixel of the reference.

    Source: Li, Snavely: MegaDepth: Learning Single-View Depth Prediction from Internet Photos, CVPR 2018,
    section 4, at one scale.
    """
    residual = torch.log(depth.clamp_min(1e-6)) - torch.log(reference.clamp_min(1e-6))
    total = residual.new_zeros(())
    for axis in (1, 2):
        both = torch.minimum(
            weight.narrow(axis, 0, weight.shape[axis] - 1), weight.narrow(axis, 1, weight.shape[axis] - 1)
        )
        total = total + (both * residual.diff(dim=axis).abs()).mean()
    return total


def _visible_points(sequence: EndoscopicSequence, frame: int, points: np.ndarray) -> SparseDepth:
    """Points that project into a frame, without those that lie behind others in their cell of the image."""
    (pixels,), (z,) = sequence.cameras[frame].project(points)
    inside = sequence.cameras.contains(pixels)
    pixels, z = pixels[inside], z[inside]
    masked = sequence.mask[frame][pixels[:, 1].astype(np.int64), pixels[:, 0].astype(np.int64)]
    pixels, z = pixels[masked], z[masked]
    column, row = (pixels // _OCCLUSION_CELL_PX).astype(np.int64).T
    cell = row * (sequence.width // _OCCLUSION_CELL_PX + 1) + column
    nearest = np.full(int(cell.max(initial=0)) + 1, np.inf)
    np.minimum.at(nearest, cell, z)
    visible = z <= _OCCLUSION_MARGIN * nearest[cell]
    return SparseDepth(pixels[visible], z[visible])


def _depth_at_corners(
    sequence: EndoscopicSequence, frame: int, depth_mm: np.ndarray, per_frame: int
) -> SparseDepth:
    # What a corner is measured in lies inside the mask as well: its outline is no corner of tissue.
    inside = cv2.erode(sequence.mask[frame].astype(np.uint8), np.ones((_CORNER_REACH_PX,) * 2, np.uint8))
    usable = sequence.supervised_mask(frame) & (depth_mm[frame] > 0) & (inside > 0)
    grey = cv2.cvtColor(sequence.rgb[frame], cv2.COLOR_RGB2GRAY)
    corners = cv2.goodFeaturesToTrack(
        grey, per_frame, _CORNER_QUALITY, _CORNER_DISTANCE_PX, mask=usable.astype(np.uint8)
    )
    corners = np.zeros((0, 2), np.int64) if corners is None else corners.reshape(-1, 2).astype(np.int64)
    return SparseDepth(corners + 0.5, depth_mm[frame][corners[:, 1], corners[:, 0]].astype(np.float64))


def _resized(image: Float[Tensor, "h w c"], like: Float[Tensor, "h2 w2"]) -> Float[Tensor, "c h2 w2"]:
    return functional.interpolate(image.permute(2, 0, 1)[None], tuple(like.shape), mode="area")[0]
