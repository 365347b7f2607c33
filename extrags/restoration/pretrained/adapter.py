"""Base class of the diffusers adapters: one window in, one window out, text encoded beforehand."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.config import PretrainedConfig
from extrags.errors import ConfigError, NonFiniteError
from extrags.events import MetricRecorded, emit
from extrags.restoration.pretrained.model import PipelineRule, load_pipeline

__all__ = ["Adapter", "Window", "pictures", "seeded"]


@dataclass(frozen=True)
class Window:
    """Frames for one call of a pipeline, at its size and in a number it takes.

    Args:
        frames: the first is a real view, the others base images of the clip, in [0, 1], [T, H, W, 3].
        unknown: pixels to generate; none in the first frame, [T, H, W].
        references: real views that see most of the same surface, best first, [R, H, W, 3].
    """

    frames: Float[np.ndarray, "t h w 3"]
    unknown: Bool[np.ndarray, "t h w"]
    references: Float[np.ndarray, "r h w 3"]

    @property
    def width(self) -> int:
        """Image width in pixels."""
        return int(self.frames.shape[2])

    @property
    def height(self) -> int:
        """Image height in pixels."""
        return int(self.frames.shape[1])

    def __len__(self) -> int:
        return len(self.frames)


class Adapter(ABC):
    """A diffusers pipeline that restores windows.

    Args:
        pipeline: loaded, without the parts that only read text.
        text: encoded by `encode_text`.
        settings: of the user.
    """

    rule: ClassVar[PipelineRule]
    float32_parts: ClassVar[tuple[str, ...]] = ()
    """Components kept in float32: they are too inaccurate in half precision."""

    def __init__(self, pipeline: Any, text: Mapping[str, Tensor], settings: PretrainedConfig) -> None:
        self.pipeline = pipeline
        self.text = dict(text)
        self.settings = settings

    @classmethod
    def open(cls, folder: Path, text: Mapping[str, Tensor], settings: PretrainedConfig) -> Adapter:
        """Load the pipeline without its text parts.

        Raises:
            ConfigError: when a setting does not fit the machine.
            WeightsError: when a file is missing or does not fit.
            MissingDependencyError: without diffusers.
        """
        pipeline = load_pipeline(
            folder, cls.rule, settings, without=cls.rule.text_parts, float32_parts=cls.float32_parts
        )
        return cls(pipeline, text, settings)

    @classmethod
    def encode_text(
        cls, folder: Path, text: str, negative_text: str, settings: PretrainedConfig
    ) -> dict[str, Tensor]:
        """Encode a caption once; the text encoder, often the largest part, is then released.

        Args:
            folder: of the saved pipeline.
            text: the caption.
            negative_text: what guidance leads away from.
            settings: device and number format.

        Returns:
            Tensors by the pipeline's argument names, in main memory; empty for pipelines that read no
            text.

        Raises:
            WeightsError: when the folder has no text encoder.
        """
        if not cls.rule.text_parts:
            return {}
        pipeline = load_pipeline(folder, cls.rule, settings, without=cls.rule.image_parts)
        with torch.no_grad():
            encoded = cls._encoded(pipeline, text, negative_text, guided=cls.guidance(settings) > 1)
        return {name: value.detach().cpu().contiguous() for name, value in encoded.items()}

    @classmethod
    def guidance(cls, settings: PretrainedConfig) -> float:
        """Weight of the text; 1 and less switches it off."""
        return cls.rule.guidance_scale if settings.guidance_scale is None else settings.guidance_scale

    @property
    def steps(self) -> int:
        """Denoising steps of a full run."""
        return self.settings.steps or self.rule.steps

    @property
    def strength(self) -> float:
        """Share of the noise that known pixels start from."""
        return self.settings.strength or self.rule.strength

    @property
    def steps_run(self) -> int:
        """Denoising steps that are left of a full run at this strength."""
        return int(self.steps * self.strength)

    def check_steps(self) -> None:
        """Look at steps and strength; needs no pipeline.

        Raises:
            ConfigError: when so few steps at this strength leave none to run.
        """
        if self.steps_run < 1:
            raise ConfigError(
                f"{self.steps} steps at strength {self.strength:g} leave no step to run; "
                "raise enhance.pretrained.steps or strength"
            )

    def restore(self, window: Window, seed: int) -> Float[np.ndarray, "t h w 3"]:
        """Restore a window; the same window and seed give the same images on the same machine.

        Args:
            window: frames, mask and references.
            seed: of all noise.

        Raises:
            ConfigError: as `check_steps`.
            NonFiniteError: when the pipeline returns NaN (half precision can).
        """
        self.check_steps()
        with torch.no_grad():
            images = np.asarray(self._restored(window, seed), dtype=np.float32)
        if not np.isfinite(images).all():
            raise NonFiniteError(
                f"{self.rule.pipeline} returned NaN or infinity; try enhance.pretrained.dtype=float32"
            )
        return images.clip(0, 1)

    def step_made(
        self, pipeline: Any, step: int, timestep: Any, tensors: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Tells of a denoising step, as `callback_on_step_end` of a pipeline, and changes nothing.

        A clip can take an hour: whoever listens may also end it here, at a limit of time for instance. How
        many clips are done is counted elsewhere, so this is no `Progress` of the stage.
        """
        emit(MetricRecorded("enhance", "denoising_step", step + 1))
        return {}

    def encoded_text(self) -> dict[str, Tensor]:
        """The encoded caption on the pipeline's device."""
        device = self.pipeline._execution_device
        return {name: value.to(device) for name, value in self.text.items()}

    def parameters(self) -> dict[str, Any]:
        """Settings in force, for the provenance."""
        return {
            "pipeline": self.rule.pipeline,
            "steps": self.steps,
            "strength": self.strength,
            "guidance_scale": self.guidance(self.settings),
        }

    @abstractmethod
    def _restored(self, window: Window, seed: int) -> np.ndarray:
        """Images [T, H, W, 3] of one window."""

    @classmethod
    def _encoded(cls, pipeline: Any, text: str, negative_text: str, *, guided: bool) -> dict[str, Tensor]:
        """Embeddings of the pipeline's own text encoder."""
        raise NotImplementedError


def seeded(seed: int) -> torch.Generator:
    """A generator on the CPU, so that the noise is the same for every device."""
    return torch.Generator("cpu").manual_seed(seed)


def pictures(images: Float[np.ndarray, "t h w 3"] | Bool[np.ndarray, "t h w"]) -> list[Any]:
    """Images as PIL images, which every pipeline takes."""
    from PIL import Image

    # A mask becomes a grey image of 0 and 255.
    return [Image.fromarray(np.rint(image.astype(np.float32) * 255).astype(np.uint8)) for image in images]
