"""An imported scene in the place of the coarse one: the call that makes it, and the settings after it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from extrags.config import PipelineConfig
from extrags.errors import ConfigError
from extrags.store import Ref
from flows.runners import Call
from tasks.imported import imported_scene, scene_digest

__all__ = ["imported_call", "of_imported_scene"]


def imported_call(config: PipelineConfig, frames: Ref) -> Call:
    """The task that reads and checks the scene; the file counts by its content, not by its path.

    Args:
        config: with `imported.scene`.
        frames: the training frames.

    Raises:
        SourceNotFoundError: when there is no such file.
        ConfigError: when the settings name none.
    """
    if config.imported.scene is None:
        raise ConfigError("imported.scene names no file")
    inputs = {
        "sequence": frames,
        "digest": scene_digest(config.imported),
        "scale": config.imported.scale,
        "file": config.imported.scene,
    }
    return Call(imported_scene, inputs)


def of_imported_scene(config: PipelineConfig, counts: Mapping[str, Any]) -> PipelineConfig:
    """The settings of later stages, from what the task has counted."""
    return config.of_imported_scene(
        count=int(counts["n_gaussians"]), sh_degree=int(counts["sh_degree"]), lit=bool(counts["has_light"])
    )
