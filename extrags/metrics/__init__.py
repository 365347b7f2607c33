"""Figures of merit: image, perceptual, depth, surface and pose errors, and their protocol."""

from __future__ import annotations

from extrags.metrics.comparison import compare_runs, spread
from extrags.metrics.depth import DepthErrors, depth_errors
from extrags.metrics.exposure import align_exposure, exposure_gain
from extrags.metrics.flip import flip, flip_map
from extrags.metrics.folder import read_renders
from extrags.metrics.image import psnr, ssim, ssim_map
from extrags.metrics.lpips import Lpips, find_weights
from extrags.metrics.perceptual import perceptual_map
from extrags.metrics.pose import absolute_trajectory_error, relative_pose_error, umeyama
from extrags.metrics.protocol import PROTOCOL_VERSION, EvaluationResult, RenderedViews, evaluate_views
from extrags.metrics.surface import (
    SurfaceErrors,
    SurfaceResult,
    TrueSurface,
    evaluate_surface,
    scene_surface,
    surface_errors,
)

__all__ = [
    "PROTOCOL_VERSION",
    "DepthErrors",
    "EvaluationResult",
    "Lpips",
    "RenderedViews",
    "SurfaceErrors",
    "SurfaceResult",
    "TrueSurface",
    "absolute_trajectory_error",
    "align_exposure",
    "compare_runs",
    "depth_errors",
    "evaluate_surface",
    "evaluate_views",
    "exposure_gain",
    "find_weights",
    "flip",
    "flip_map",
    "perceptual_map",
    "psnr",
    "read_renders",
    "relative_pose_error",
    "scene_surface",
    "spread",
    "ssim",
    "ssim_map",
    "surface_errors",
    "umeyama",
]
