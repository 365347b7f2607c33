"""Wan VACE: video, hole mask and reference images in one pipeline."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from extrags.restoration.pretrained.adapter import Adapter, Window, pictures, seeded
from extrags.restoration.pretrained.enhancer import DiffusersBackend
from extrags.restoration.pretrained.model import PipelineRule

__all__ = ["WAN_VACE", "WanVace"]

GREY = 0.5
"""Colour of the pixels to generate, as in the training of VACE."""


class WanVace(Adapter):
    """`WanVACEPipeline`: known pixels are kept, masked ones generated from video, references and text.

    Of the pretrained pipelines the one whose inputs fit the task. `strength` has no meaning here.

    Run with tiny random parts only (Wan2.1-VACE-1.3B is 19 GB, of which the text encoder has 11).

    Source: Jiang et al.: VACE: All-in-One Video Creation and Editing, 2025; diffusers 0.42.
    """

    rule = PipelineRule(
        backend="wan-vace",
        pipeline="WanVACEPipeline",
        accepts=("WanVACEPipeline",),
        usual_model="Wan-AI/Wan2.1-VACE-1.3B-diffusers",
        size="about 19 GB",
        frame_step=4,
        size_multiple=16,
        frames=17,
        short_side_px=480,
        steps=30,
        strength=1.0,
        guidance_scale=5.0,
        text_parts=("text_encoder", "tokenizer"),
        image_parts=("transformer", "transformer_2", "vae"),
        masked=True,
    )
    float32_parts = ("vae",)

    @property
    def strength(self) -> float:
        """Always 1: the mask says what is kept."""
        return 1.0

    def _restored(self, window: Window, seed: int) -> np.ndarray:
        video = np.where(window.unknown[..., None], np.float32(GREY), window.frames)
        references = pictures(window.references) or None
        result = self.pipeline(
            video=pictures(video),
            mask=pictures(window.unknown),
            reference_images=references,
            height=window.height,
            width=window.width,
            num_frames=len(window),
            num_inference_steps=self.steps,
            guidance_scale=self.guidance(self.settings),
            generator=seeded(seed),
            callback_on_step_end=self.step_made,
            output_type="np",
            **self.encoded_text(),
        )
        return np.asarray(result.frames[0])

    @classmethod
    def _encoded(cls, pipeline: Any, text: str, negative_text: str, *, guided: bool) -> dict[str, Tensor]:
        positive, negative = pipeline.encode_prompt(
            text, negative_text if guided else None, do_classifier_free_guidance=guided
        )
        encoded = {"prompt_embeds": positive}
        if guided:
            encoded["negative_prompt_embeds"] = negative
        return encoded


WAN_VACE = DiffusersBackend(WanVace)
