"""Camera poses: by COLMAP or by colour and depth, from training frames; held-out frames afterwards.

Each name is loaded when it is first asked for: COLMAP's process runs modules of this package, and needs
neither torch nor the stages.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from extrags.lazy_names import lazy_names

if TYPE_CHECKING:
    from extrags.poses.calibration import check_lens_use, with_calibration
    from extrags.poses.estimate import PoseEstimate, estimate_poses, with_estimated_poses
    from extrags.poses.lens_calibration import LensCalibration
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

_MODULES = {
    "DepthScale": "scale",
    "LensCalibration": "lens_calibration",
    "PoseEstimate": "estimate",
    "RgbdAlignment": "rgbd",
    "Triangulation": "triangulation",
    "align_by_depth": "rgbd",
    "check_lens_use": "calibration",
    "depth_scale": "scale",
    "errors_against_given": "registration_report",
    "estimate_poses": "estimate",
    "observed_by_those_left": "observed",
    "triangulate_points": "triangulation",
    "with_calibration": "calibration",
    "with_estimated_poses": "estimate",
}

__getattr__ = lazy_names(__name__, _MODULES)


def __dir__() -> list[str]:
    return sorted(__all__)
