"""Locating, checking and loading a saved diffusers pipeline."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from extrags.config import PretrainedConfig
from extrags.devices import chosen_device
from extrags.errors import ConfigError, MissingDependencyError, WeightsError, installed_with, reason_of
from extrags.restoration.pretrained.parts import lacking_part
from extrags.user_paths import expanded

__all__ = [
    "INSTALL",
    "PipelineRule",
    "check_device",
    "check_packages",
    "chosen_dtype",
    "find_model",
    "load_pipeline",
    "require_diffusers",
]

INSTALL = installed_with("diffusers")
PACKAGES = ("diffusers", "transformers", "accelerate", "ftfy")
"""ftfy because Wan's text clean-up fails with a NameError without it."""
INDEX = "model_index.json"

_HUB_ID = re.compile(r"[\w.-]+/[\w.-]+")


@dataclass(frozen=True)
class PipelineRule:
    """Requirements of a diffusers pipeline, and its usual settings.

    Args:
        backend: its name in `enhance.backend`.
        pipeline: class in diffusers.
        accepts: classes a saved pipeline may name; they share their parts.
        usual_model: hub id.
        size: of the download, for messages.
        frame_step: valid numbers of frames are k * step + 1.
        size_multiple: both image sides must be multiples of this.
        frames: of one window.
        short_side_px: shorter side of the images.
        steps: of denoising.
        strength: share of the noise that known pixels start from.
        guidance_scale: weight of the text.
        text_parts: components that only encode the text; not loaded to restore.
        image_parts: all others that hold weights; not loaded to encode the text.
        masked: only unknown pixels are taken from its output; its autoencoder blurs the known ones.
        absent: components that are never loaded.
    """

    backend: str
    pipeline: str
    accepts: tuple[str, ...]
    usual_model: str
    size: str
    frame_step: int
    size_multiple: int
    frames: int
    short_side_px: int
    steps: int
    strength: float
    guidance_scale: float
    text_parts: tuple[str, ...]
    image_parts: tuple[str, ...]
    masked: bool
    absent: tuple[str, ...] = ()


def check_packages() -> None:
    """Look for the packages of the extra, without loading them.

    Raises:
        MissingDependencyError: with the command that installs what is missing.
    """
    missing = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingDependencyError(
            f"the pretrained backends need {', '.join(missing)}: not installed. Install with: {INSTALL}"
        )


def require_diffusers() -> Any:
    """The diffusers package.

    Raises:
        MissingDependencyError: as `check_packages`.
    """
    check_packages()
    return importlib.import_module("diffusers")


def find_model(rule: PipelineRule, settings: PretrainedConfig) -> Path:
    """The folder of a saved pipeline: a local one, or a hub id's in the local cache.

    Args:
        rule: of the pipeline.
        settings: which model; whether it may be downloaded.

    Raises:
        WeightsError: when it is not there, not complete, or another pipeline; says how to get it.
        MissingDependencyError: without diffusers.
    """
    check_packages()
    model = settings.model or rule.usual_model
    folder = expanded(model)
    if not folder.is_dir():
        folder = _from_hub(model, rule, settings)
    index = folder / INDEX
    if not index.is_file():
        raise WeightsError(
            f"{folder} holds no {INDEX}, so it is no saved diffusers pipeline. {_how_to_get(model, rule)}"
        )
    try:
        description = dict(json.loads(index.read_text()))
    except (ValueError, TypeError) as error:
        raise WeightsError(f"{index}: not readable as a JSON object ({error})") from error
    found = description.get("_class_name")
    if found not in rule.accepts:
        raise WeightsError(
            f"{index} names a {found}; enhance.backend={rule.backend} needs one of {', '.join(rule.accepts)}"
        )
    lacking = lacking_part(folder, description, (*rule.text_parts, *rule.image_parts), rule.absent)
    if lacking is not None:
        raise WeightsError(
            f"{folder} is not whole, {lacking} (weights are read from .safetensors alone). Was "
            f"its download interrupted? {_how_to_get(model, rule)}"
        )
    return folder


def _from_hub(model: str, rule: PipelineRule, settings: PretrainedConfig) -> Path:
    if _HUB_ID.fullmatch(model) is None:
        raise WeightsError(
            f"enhance.pretrained.model={model}: there is no such folder. {_how_to_get(model, rule)}"
        )
    hub = importlib.import_module("huggingface_hub")
    errors = importlib.import_module("huggingface_hub.errors")
    try:
        if settings.local_files_only:
            return Path(hub.snapshot_download(model, revision=settings.revision, local_files_only=True))
        pipeline = importlib.import_module("diffusers").DiffusionPipeline
        return Path(pipeline.download(model, revision=settings.revision, use_safetensors=True))
    except errors.HFValidationError as error:
        # `../models` has the form of an id, but is none.
        raise WeightsError(
            f"enhance.pretrained.model={model}: there is no such folder, and it is no hub id. "
            f"{_how_to_get(rule.usual_model, rule)}"
        ) from error
    except (errors.HfHubHTTPError, errors.LocalEntryNotFoundError, OSError) as error:
        where = "in the local Hugging Face cache" if settings.local_files_only else "on the hub"
        raise WeightsError(
            f"the model {model} is neither a folder here nor {where}. {_how_to_get(model, rule)}"
        ) from error


def _how_to_get(model: str, rule: PipelineRule) -> str:
    name = model if _HUB_ID.fullmatch(model) else rule.usual_model
    return (
        "extrags downloads nothing by default. "
        f"Get it once with `hf download {name}` ({rule.size}), or set enhance.pretrained.model to a folder "
        f"where a {rule.pipeline} was saved (it holds {INDEX}), or allow the download with "
        "enhance.pretrained.local_files_only=false."
    )


def check_device(settings: PretrainedConfig) -> torch.device:
    """The device a pipeline will run on.

    Raises:
        ConfigError: when cuda is asked for and there is none, or offload on a processor.
    """
    device = chosen_device(settings.device, "enhance.pretrained.device")
    if settings.offload != "none" and device.type != "cuda":
        raise ConfigError(
            f"enhance.pretrained.offload={settings.offload} moves idle parts off a CUDA device; none is in "
            "use. Set it to none"
        )
    return device


def chosen_dtype(name: str, device: torch.device) -> torch.dtype:
    """The number format a setting means on a device."""
    if name == "auto":
        return torch.bfloat16 if device.type == "cuda" else torch.float32
    return {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}[name]


def load_pipeline(
    folder: Path,
    rule: PipelineRule,
    settings: PretrainedConfig,
    *,
    without: tuple[str, ...],
    float32_parts: tuple[str, ...] = (),
) -> Any:
    """A pipeline ready to run, without the components that are not needed.

    Args:
        folder: found by `find_model`.
        rule: of the pipeline.
        settings: device, number format and offload.
        without: components left out; their files are not read.
        float32_parts: components kept in float32 whatever the format.

    Raises:
        ConfigError: when offload is asked for on a processor.
        WeightsError: when a file is missing or does not fit.
    """
    diffusers = require_diffusers()
    device = check_device(settings)
    dtype = chosen_dtype(settings.dtype, device)
    dtypes: Mapping[str, torch.dtype] = {"default": dtype, **dict.fromkeys(float32_parts, torch.float32)}
    absent = {name: None for name in (*without, *rule.absent) if name in _components(diffusers, rule)}
    options: dict[str, Any] = {"requires_safety_checker": False} if "safety_checker" in absent else {}
    try:
        with _without_bars():
            pipeline = getattr(diffusers, rule.pipeline).from_pretrained(
                str(folder),
                dtype=dict(dtypes),
                local_files_only=True,
                use_safetensors=True,
                **absent,
                **options,
            )
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise WeightsError(f"{folder}: not loadable as a {rule.pipeline}: {reason_of(error)}") from error
    pipeline.set_progress_bar_config(disable=True)
    if settings.offload == "model":
        pipeline.enable_model_cpu_offload(device=device)
    elif settings.offload == "sequential":
        pipeline.enable_sequential_cpu_offload(device=device)
    else:
        pipeline.to(device)
    return pipeline


@contextmanager
def _without_bars() -> Iterator[None]:
    """No progress bars on the terminal."""
    switches = [importlib.import_module(f"{name}.utils.logging") for name in ("diffusers", "transformers")]
    for switch in switches:
        switch.disable_progress_bar()
    try:
        yield
    finally:
        for switch in switches:
            switch.enable_progress_bar()


def _components(diffusers: Any, rule: PipelineRule) -> set[str]:
    return set(inspect.signature(getattr(diffusers, rule.pipeline).__init__).parameters)
