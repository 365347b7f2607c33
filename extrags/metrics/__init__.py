"""Figures of merit: image, perceptual, depth and pose errors, and the protocol that combines them."""

from __future__ import annotations

from extrags.metrics.depth import DepthErrors, depth_errors
from extrags.metrics.exposure import align_exposure, exposure_gain
from extrags.metrics.flip import flip, flip_map
from extrags.metrics.image import psnr, ssim, ssim_map
from extrags.metrics.lpips import Lpips, find_weights
from extrags.metrics.perceptual import perceptual_map
from extrags.metrics.pose import absolute_trajectory_error, relative_pose_error, umeyama
from extrags.metrics.protocol import PROTOCOL_VERSION, EvaluationResult, RenderedViews, evaluate_views

__all__ = [
    "PROTOCOL_VERSION",
    "DepthErrors",
    "EvaluationResult",
    "Lpips",
    "RenderedViews",
    "absolute_trajectory_error",
    "align_exposure",
    "depth_errors",
    "evaluate_views",
    "exposure_gain",
    "find_weights",
    "flip",
    "flip_map",
    "perceptual_map",
    "psnr",
    "relative_pose_error",
    "ssim",
    "ssim_map",
    "umeyama",
]
