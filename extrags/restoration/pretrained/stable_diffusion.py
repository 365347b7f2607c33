"""Stable Diffusion, image by image: restoration of the whole image, or of its holes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from extrags.restoration.pretrained.adapter import Adapter, Window, pictures, seeded
from extrags.restoration.pretrained.enhancer import DiffusersBackend
from extrags.restoration.pretrained.model import PipelineRule

__all__ = ["IMAGE_TO_IMAGE", "INPAINT", "StableDiffusionImageToImage", "StableDiffusionInpaint"]

IMAGES_AT_ONCE = 4
_TEXT = ("text_encoder", "tokenizer")
_IMAGE = ("unet", "vae")
# The safety checker blackens images that it misjudges, and tissue is what it misjudges.
_ABSENT = ("safety_checker", "feature_extractor", "image_encoder")


class _StableDiffusion(Adapter):
    """Base of both: without a time axis, all frames share their noise, which reduces flicker."""

    def _restored(self, window: Window, seed: int) -> np.ndarray:
        # The real view is for the video models; it needs no restoration.
        parts = [window.frames[:1]]
        for first in range(1, len(window), IMAGES_AT_ONCE):
            chosen = slice(first, first + IMAGES_AT_ONCE)
            images = pictures(window.frames[chosen])
            count = len(images)
            result = self.pipeline(
                image=images,
                strength=self.strength,
                num_inference_steps=self.steps,
                guidance_scale=self.guidance(self.settings),
                generator=[seeded(seed) for _ in images],
                callback_on_step_end=self.step_made,
                output_type="np",
                **{name: value.expand(count, -1, -1) for name, value in self.encoded_text().items()},
                **self._further(window, chosen),
            )
            parts.append(np.asarray(result.images))
        return np.concatenate(parts)

    def _further(self, window: Window, chosen: slice) -> dict[str, Any]:
        return {}

    @classmethod
    def _encoded(cls, pipeline: Any, text: str, negative_text: str, *, guided: bool) -> dict[str, Tensor]:
        positive, negative = pipeline.encode_prompt(
            text,
            torch.device(pipeline._execution_device),
            1,
            guided,
            negative_prompt=negative_text if guided else None,
        )
        encoded = {"prompt_embeds": positive}
        if guided:
            encoded["negative_prompt_embeds"] = negative
        return encoded


class StableDiffusionImageToImage(_StableDiffusion):
    """`StableDiffusionImg2ImgPipeline`: each frame started from itself with noise, as SDEdit does.

    Run with tiny random parts only.

    Source: Rombach et al.: High-Resolution Image Synthesis with Latent Diffusion Models, 2022;
    diffusers 0.42.
    """

    rule = PipelineRule(
        backend="sd-img2img",
        pipeline="StableDiffusionImg2ImgPipeline",
        accepts=("StableDiffusionImg2ImgPipeline", "StableDiffusionPipeline"),
        usual_model="stable-diffusion-v1-5/stable-diffusion-v1-5",
        size="about 5 GB",
        frame_step=1,
        size_multiple=8,
        frames=16,
        short_side_px=512,
        steps=30,
        strength=0.4,
        guidance_scale=5.0,
        text_parts=_TEXT,
        image_parts=_IMAGE,
        masked=False,
        absent=_ABSENT,
    )


class StableDiffusionInpaint(_StableDiffusion):
    """`StableDiffusionInpaintPipeline`: only masked pixels are generated.

    Takes inpainting checkpoints (a network of nine input channels) and plain ones (four).

    Run with tiny random parts only.

    Source: Rombach et al.: High-Resolution Image Synthesis with Latent Diffusion Models, 2022;
    diffusers 0.42.
    """

    rule = replace(
        StableDiffusionImageToImage.rule,
        backend="sd-inpaint",
        pipeline="StableDiffusionInpaintPipeline",
        accepts=("StableDiffusionInpaintPipeline", "StableDiffusionPipeline"),
        usual_model="stable-diffusion-v1-5/stable-diffusion-inpainting",
        strength=0.9,
        masked=True,
    )

    def _further(self, window: Window, chosen: slice) -> dict[str, Any]:
        return {
            "mask_image": pictures(window.unknown[chosen]),
            "height": window.height,
            "width": window.width,
        }


IMAGE_TO_IMAGE = DiffusersBackend(StableDiffusionImageToImage)
INPAINT = DiffusersBackend(StableDiffusionInpaint)
