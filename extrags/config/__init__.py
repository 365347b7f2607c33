"""Settings: frozen models, one per stage, documented field by field, and the profiles that combine them."""

from extrags.config.base import StageConfig
from extrags.config.profiles import PROFILES, ProfileName, profile_config
from extrags.config.restorer import CaptionConfig, CheckpointConfig, EnhanceConfig, PretrainedConfig
from extrags.config.stages import (
    AssessConfig,
    CoarseConfig,
    CoverageConfig,
    DensifyConfig,
    EvaluateConfig,
    ExploreConfig,
    FinetuneConfig,
    FreespaceConfig,
    IngestConfig,
    LightConfig,
    LpipsNet,
    OptimiserConfig,
    PipelineConfig,
    PoseRefinementConfig,
    PosesConfig,
    ReportConfig,
    SurfaceConfig,
)

__all__ = [
    "PROFILES",
    "AssessConfig",
    "CaptionConfig",
    "CheckpointConfig",
    "CoarseConfig",
    "CoverageConfig",
    "DensifyConfig",
    "EnhanceConfig",
    "EvaluateConfig",
    "ExploreConfig",
    "FinetuneConfig",
    "FreespaceConfig",
    "IngestConfig",
    "LightConfig",
    "LpipsNet",
    "OptimiserConfig",
    "PipelineConfig",
    "PoseRefinementConfig",
    "PosesConfig",
    "PretrainedConfig",
    "ProfileName",
    "ReportConfig",
    "StageConfig",
    "SurfaceConfig",
    "profile_config",
]
