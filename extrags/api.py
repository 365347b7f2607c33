"""The public names of `import extrags`; this module is imported when the first of them is used.

Its functions are those of the modules they come from, and check what kinds of arguments they are given.

Reading belongs to `data_catalog`, a layer above the library: no other module of the library imports it.
"""

from __future__ import annotations

from inspect import isclass, isfunction

from data_catalog import read, register_reader
from extrags.arguments import with_checked_arguments
from extrags.assessment import assess
from extrags.cameras import Cameras
from extrags.config import (
    PROFILES,
    AssessConfig,
    CoarseConfig,
    ContinuationConfig,
    DepthConfig,
    EnhanceConfig,
    EvaluateConfig,
    ExploreConfig,
    FinetuneConfig,
    FreespaceConfig,
    ImportedConfig,
    IngestConfig,
    JudgeConfig,
    PipelineConfig,
    PosesConfig,
    ReportConfig,
    SurfaceConfig,
    UcNerfConfig,
    profile_config,
)
from extrags.depth.estimate import DepthEstimate, estimate_depth, with_estimated_depth
from extrags.evaluation import evaluate, render
from extrags.exploration import Exploration, explore
from extrags.frame_arrays import sequence_from_arrays
from extrags.freespace import FreeSpace, carve
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.in_memory_pipeline import Result, run_pipeline
from extrags.metrics.image import means_in_regions
from extrags.metrics.protocol import EvaluationResult, RenderedViews
from extrags.metrics.registry import Metric, register_metric
from extrags.poses import PoseEstimate, estimate_poses, with_estimated_poses
from extrags.pseudo_views import PseudoViews
from extrags.raster import Rendering, rasterize
from extrags.restoration.backends import register_backend
from extrags.restoration.trajectories import restore
from extrags.scene import Scene
from extrags.scene_plan import ScenePlan
from extrags.sequence import EndoscopicSequence, Split
from extrags.stages import STAGES
from extrags.surface import Mesh, fuse_surface
from extrags.training import TrainingResult, as_reconstructed, finetune, reconstruct
from extrags.training.pose_refinement import with_refined_poses

__all__ = [
    "PROFILES",
    "STAGES",
    "AssessConfig",
    "Cameras",
    "CoarseConfig",
    "ContinuationConfig",
    "DepthConfig",
    "DepthEstimate",
    "EndoscopicSequence",
    "EnhanceConfig",
    "EvaluateConfig",
    "EvaluationResult",
    "Exploration",
    "ExploreConfig",
    "FinetuneConfig",
    "FreeSpace",
    "FreespaceConfig",
    "Gaussians",
    "ImportedConfig",
    "IngestConfig",
    "JudgeConfig",
    "Mesh",
    "Metric",
    "NearFieldLight",
    "PipelineConfig",
    "PoseEstimate",
    "PosesConfig",
    "PseudoViews",
    "RenderedViews",
    "Rendering",
    "ReportConfig",
    "Result",
    "Scene",
    "ScenePlan",
    "Split",
    "SurfaceConfig",
    "TrainingResult",
    "UcNerfConfig",
    "as_reconstructed",
    "assess",
    "carve",
    "estimate_depth",
    "estimate_poses",
    "evaluate",
    "explore",
    "finetune",
    "fuse_surface",
    "means_in_regions",
    "profile_config",
    "rasterize",
    "read",
    "reconstruct",
    "register_backend",
    "register_metric",
    "register_reader",
    "render",
    "restore",
    "run_pipeline",
    "sequence_from_arrays",
    "with_estimated_depth",
    "with_estimated_poses",
    "with_refined_poses",
]

_classes = {name: value for name, value in globals().items() if isclass(value)}
globals().update(
    {
        name: with_checked_arguments(value, _classes)
        for name, value in list(globals().items())
        if name in __all__ and isfunction(value)
    }
)
