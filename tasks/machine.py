"""The machine that an artefact is made on, as its manifest tells it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from extrags.config import PipelineConfig

__all__ = ["asks_for_gpu", "machine_counts"]


def machine_counts(inputs: Mapping[str, Any]) -> dict[str, str | None]:
    """What tells whether costs of two artefacts can be compared.

    Args:
        inputs: of the task that makes one.

    Returns:
        `processor` (its name), `isa` (instruction set of the kernels, None without them) and `device` (`cpu`,
        or the name of the GPU that the task asks for).
    """
    # Here, because they load torch, which looking up an artefact must not.
    from extrags.cores import processor_name
    from extrags.devices import device_name
    from extrags.raster import native_isa

    return {
        "processor": processor_name(),
        "isa": native_isa(),
        "device": device_name("cuda" if asks_for_gpu(inputs) else "cpu"),
    }


def asks_for_gpu(inputs: Mapping[str, Any]) -> bool:
    """Whether the device of a task, or one in its settings, is `cuda`."""
    return inputs.get("device") == "cuda" or any(_on_gpu(value) for value in inputs.values())


def _on_gpu(value: Any) -> bool:
    # The settings of a whole run are a page's: they are shown, and nothing is computed by them.
    if not isinstance(value, BaseModel) or isinstance(value, PipelineConfig):
        return False
    fields = [getattr(value, name) for name in type(value).model_fields]
    return getattr(value, "device", None) == "cuda" or any(map(_on_gpu, fields))
