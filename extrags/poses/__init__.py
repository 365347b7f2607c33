"""Camera poses by COLMAP: mapping on training frames, registration of held-out ones, metric scale."""

from __future__ import annotations

from extrags.poses.estimate import PoseEstimate, estimate_poses, with_estimated_poses
from extrags.poses.scale import DepthScale, depth_scale

__all__ = ["DepthScale", "PoseEstimate", "depth_scale", "estimate_poses", "with_estimated_poses"]
