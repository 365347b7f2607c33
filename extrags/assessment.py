"""Assessment of a coarse scene: holes and unresolved surface, measured in probe views."""

from __future__ import annotations

import logging
import math

import numpy as np
import torch
from jaxtyping import Bool, Float

from extrags.cameras import Cameras, rotation_about
from extrags.config import DEFAULT_PROFILE, PROFILES, AssessConfig, CoverageConfig, PipelineConfig
from extrags.errors import CaptureError
from extrags.events import Progress, emit
from extrags.exploration.coverage import direction_counts, training_coverage
from extrags.exploration.waves import start_views
from extrags.raster import Rendering
from extrags.scene import Scene
from extrags.scene_plan import ScenePlan, decide
from extrags.sequence import EndoscopicSequence
from extrags.shown_pixels import shown_pixels
from extrags.threads import one_torch_thread

__all__ = ["assess", "measure", "probe_views"]

_log = logging.getLogger(__name__)

GOLDEN_ANGLE_RAD = math.pi * (3 - math.sqrt(5))
"""The golden angle in radians: its successive multiples spread directions evenly over the circle."""
PROBE_CLEARANCE_SHARE = 0.2
"""Smallest distance of a probe camera from solid Gaussians, in median rendered depths."""
SOLID_OPACITY = 0.5
PROBES_PER_BATCH = 8


def assess(scene: Scene, sequence: EndoscopicSequence, config: PipelineConfig | None = None) -> ScenePlan:
    """Measure the scene (`measure`) and decide which stages run (`decide`).

    Args:
        scene: the coarse reconstruction.
        sequence: its frames.
        config: settings of all stages: `assess` and `explore`, and the stages whose budgets are scaled. None
            takes the profile `balanced`.

    Returns:
        The plan, with all measurements.

    Raises:
        CaptureError: as `measure`.
    """
    config = PROFILES[DEFAULT_PROFILE] if config is None else config
    return decide(measure(scene, sequence, config.assess, config.explore.coverage), config)


@one_torch_thread()
def measure(
    scene: Scene, sequence: EndoscopicSequence, settings: AssessConfig, coverage: CoverageConfig
) -> dict[str, float]:
    """Measure holes and unresolved surface in probe views near the training views.

    A pixel of a probe view is a hole where alpha is below `hole_alpha`. A Gaussian is unresolved in a probe
    as far as the training view that shows it largest, inside its mask, has fewer than `sufficient_resolution`
    times the pixels that the probe has of it. Sizes are sums of blending weights: how many Gaussians a
    surface is made of makes little difference. What a probe lacks are its holes and, with
    `unresolved_weight`, its unresolved pixels. Budgets are not used here: `decide` turns the numbers into a
    plan.

    Args:
        scene: the coarse reconstruction.
        sequence: its frames.
        settings: the probe views, and what they lack.
        coverage: when a Gaussian counts as seen from a direction, as in the exploration. By the frustum no
            masks are looked at.

    Returns:
        Measurements by name; shares are of all pixels of the probe views, of the valid ones of the training
        views, or of all Gaussians.

    Raises:
        CaptureError: when there are no Gaussians, or no training view sees any.
    """
    cameras = sequence.training_cameras
    if len(scene.gaussians) == 0 or len(cameras) == 0:
        raise CaptureError(
            f"{sequence.name}: nothing to assess with {len(scene.gaussians)} Gaussians "
            f"and {len(cameras)} training views"
        )
    # Blending weights come from the native kernels, and the search tree is on the processor.
    on_processor = scene.to("cpu")
    small = cameras.at_most_width(coverage.render_width)
    valid = shown_pixels(sequence.training_masks, cameras, small)
    depth_unit_mm, training_holes = _training_view_measurements(scene, small, valid, settings)
    covered = training_coverage(on_processor, small, **coverage.options, mask=valid)
    directions = direction_counts(covered)
    probes = probe_views(on_processor, small.as_pinholes(), depth_unit_mm, settings)
    holes, unresolved = _lacking_shares(
        on_processor, probes, _largest_sizes(on_processor, small, valid), settings
    )
    lacking = holes + settings.unresolved_weight * unresolved
    seen = directions > 0
    measurements = {
        "lacking_share": float(lacking.mean()),
        "hole_share": float(holes.mean()),
        "unresolved_share": float(unresolved.mean()),
        "worst_probe_lacking_share": float(lacking.max()),
        "training_hole_share": training_holes,
        "gaussians": float(len(directions)),
        "gaussians_unseen_share": float(1 - seen.mean()),
        "directions_mean": float(directions[seen].mean()) if seen.any() else 0.0,
        "directions_median": float(np.median(directions[seen])) if seen.any() else 0.0,
        "coverage_share": float(directions.mean()) / coverage.directions,
        "depth_unit_mm": depth_unit_mm,
        "training_views": float(len(cameras)),
        "pixels": float(cameras.width * cameras.height),
        "width": float(cameras.width),
        "probe_views": float(len(probes)),
    }
    _log.info(
        "assess: %.2f %% of probe pixels are holes, %.2f %% unresolved surface",
        100 * measurements["hole_share"],
        100 * measurements["unresolved_share"],
    )
    return measurements


def probe_views(scene: Scene, cameras: Cameras, depth_unit_mm: float, config: AssessConfig) -> Cameras:
    """Probe cameras next to the training views, shifted sideways and turned.

    Probes start at training views spread over the recording. The direction of the shift advances by the
    golden angle about the optical axis, and the turn is alternately towards and away from it. A shift that
    would bring the probe too close to solid Gaussians is halved until it does not.

    Args:
        scene: its solid Gaussians (opacity above `SOLID_OPACITY`) are the obstacles.
        cameras: the training views.
        depth_unit_mm: median rendered depth, in world units.
        config: number, shift and turn of the probes.

    Returns:
        `probe_views` cameras.
    """
    from scipy.spatial import cKDTree

    anchors = start_views(cameras, config.probe_views, depth_unit_mm)
    solid = scene.gaussians.opacities.detach().sigmoid().numpy() > SOLID_OPACITY
    means = scene.gaussians.means.detach().numpy().astype(np.float64)
    tissue = cKDTree(means[solid] if solid.any() else means)
    phase = float(np.random.default_rng(config.seed).uniform(0, 2 * np.pi))
    poses = []
    for index in range(config.probe_views):
        pose = cameras.world_from_camera[anchors[index % len(anchors)]].copy()
        angle = phase + index * GOLDEN_ANGLE_RAD
        side = np.array([np.cos(angle), np.sin(angle), 0.0])
        # The tissue may already be nearer to the training view itself; then the probe turns in place.
        allowed = min(PROBE_CLEARANCE_SHARE * depth_unit_mm, float(tissue.query(pose[:3, 3])[0]))
        shift = config.probe_offset * depth_unit_mm
        while shift > 0.02 * depth_unit_mm:
            path = pose[:3, 3] + np.linspace(0.25, 1, 4)[:, None] * shift * (pose[:3, :3] @ side)
            if (tissue.query(path)[0] >= allowed).all():
                break
            shift /= 2
        else:
            shift = 0.0
        pose[:3, 3] += shift * (pose[:3, :3] @ side)
        axis = np.cross([0.0, 0.0, 1.0], side)
        turn = np.radians(config.probe_turn_deg) * (1 if index % 2 == 0 else -1)
        pose[:3, :3] = pose[:3, :3] @ rotation_about(axis, turn)
        poses.append(pose)
    K = cameras.K[anchors[np.arange(config.probe_views) % len(anchors)]]
    return Cameras(K, np.stack(poses), cameras.width, cameras.height)


def _training_view_measurements(
    scene: Scene, cameras: Cameras, valid: Bool[np.ndarray, "v h w"], config: AssessConfig
) -> tuple[float, float]:
    """Median rendered depth, and share of holes in the training views themselves."""
    depths, holes = [], []
    with torch.no_grad():
        for start in range(0, len(cameras), PROBES_PER_BATCH):
            rendering = scene.render(cameras[start : start + PROBES_PER_BATCH], sh_degree=0)
            field = torch.from_numpy(valid[start : start + PROBES_PER_BATCH]).to(scene.device)
            surface = (rendering.alpha >= config.hole_alpha) & field
            depths.append(rendering.depth[surface].cpu().numpy())
            holes.append((field & ~surface)[field].cpu().numpy())
            emit(Progress("assess", min(start + PROBES_PER_BATCH, len(cameras)), len(cameras)))
    depth = np.concatenate(depths)
    if depth.size == 0:
        raise CaptureError(f"none of the {len(cameras)} training views sees a surface of the scene")
    return float(np.median(depth)), float(np.concatenate(holes).mean())


def _largest_sizes(
    scene: Scene, cameras: Cameras, valid: Bool[np.ndarray, "v h w"]
) -> Float[np.ndarray, "n"]:
    """Pixels that each Gaussian has in the training view that shows it largest, inside the masks."""
    largest = np.zeros(len(scene.gaussians), dtype=np.float32)
    with torch.no_grad():
        for start in range(0, len(cameras), PROBES_PER_BATCH):
            batch = slice(start, start + PROBES_PER_BATCH)
            sizes = _sizes(
                scene.render(
                    cameras[batch],
                    visibility=True,
                    visibility_mask=torch.from_numpy(valid[batch]),
                    sh_degree=0,
                )
            )
            largest = np.maximum(largest, sizes.max(axis=0))
    return largest


def _lacking_shares(
    scene: Scene, probes: Cameras, largest_px: Float[np.ndarray, "n"], config: AssessConfig
) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "p"]]:
    """Of each probe the share of holes, and that of surface that no training view resolves.

    Args:
        scene: the coarse reconstruction.
        probes: the P probe views.
        largest_px: size of each Gaussian in the training view that shows it largest.
        config: what a hole is, and which share of a probe's size is enough.
    """
    holes, unresolved = [], []
    with torch.no_grad():
        for start in range(0, len(probes), PROBES_PER_BATCH):
            rendering = scene.render(probes[start : start + PROBES_PER_BATCH], visibility=True, sh_degree=0)
            sizes = _sizes(rendering).astype(np.float64)
            missing = np.maximum(0.0, sizes - largest_px / config.sufficient_resolution)
            hole = (rendering.alpha < config.hole_alpha).double().mean(dim=(1, 2)).numpy()
            holes.append(hole)
            # What is faint in holes has sizes as well.
            unresolved.append(np.minimum(1 - hole, missing.sum(axis=1) / rendering.alpha[0].numel()))
    return np.concatenate(holes), np.concatenate(unresolved)


def _sizes(rendering: Rendering) -> Float[np.ndarray, "v n"]:
    """Pixels that each Gaussian has in each view: the sum of its blending weights."""
    assert rendering.visibility_sum is not None
    return np.asarray(rendering.visibility_sum.numpy())
