"""Camera poses: by COLMAP or by colour and depth, from training frames; held-out frames afterwards."""

from __future__ import annotations

from extrags.poses.calibration import LensCalibration, check_lens_use, with_calibration
from extrags.poses.estimate import PoseEstimate, estimate_poses, with_estimated_poses
from extrags.poses.observed import observed_by_those_left
from extrags.poses.registration_report import errors_against_given
from extrags.poses.rgbd import RgbdAlignment, align_by_depth
from extrags.poses.scale import DepthScale, depth_scale
from extrags.poses.triangulation import Triangulation, triangulate_points

__all__ = [
    "DepthScale",
    "LensCalibration",
    "PoseEstimate",
    "RgbdAlignment",
    "Triangulation",
    "align_by_depth",
    "check_lens_use",
    "depth_scale",
    "errors_against_given",
    "estimate_poses",
    "observed_by_those_left",
    "triangulate_points",
    "with_calibration",
    "with_estimated_poses",
]
