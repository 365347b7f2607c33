"""LTX-Video: the whole clip as a soft condition, a real view as a hard one."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from torch import Tensor

from extrags.restoration.pretrained.adapter import Adapter, Window, pictures, seeded
from extrags.restoration.pretrained.enhancer import DiffusersBackend
from extrags.restoration.pretrained.model import PipelineRule

__all__ = ["LTX", "LtxCondition"]

FRAME_RATE = 25
DECODE_TIMESTEP = 0.05
DECODE_NOISE_SCALE = 0.025
"""Of the autoencoders that take a time step; what the pipeline's documentation uses."""


class LtxCondition(Adapter):
    """`LTXConditionPipeline`: frames start from the clip with noise, the first frame is a real view.

    There is no mask: known pixels change as well, and are put back by the blend that follows every
    restorer.

    Run with tiny random parts only.

    Source: HaCohen et al.: LTX-Video: Realtime Video Latent Diffusion, 2024; diffusers 0.42.
    """

    rule = PipelineRule(
        backend="ltx",
        pipeline="LTXConditionPipeline",
        accepts=("LTXConditionPipeline", "LTXPipeline", "LTXImageToVideoPipeline"),
        usual_model="Lightricks/LTX-Video-0.9.5",
        size="about 25 GB",
        frame_step=8,
        size_multiple=32,
        frames=17,
        short_side_px=480,
        steps=40,
        strength=0.6,
        guidance_scale=3.0,
        text_parts=("text_encoder", "tokenizer"),
        image_parts=("transformer", "vae"),
        masked=False,
    )

    @property
    def steps_run(self) -> int:
        """All: strength says how firm the condition is, and leaves the schedule whole."""
        return self.steps

    def _restored(self, window: Window, seed: int) -> np.ndarray:
        condition = importlib.import_module("diffusers.pipelines.ltx.pipeline_ltx_condition")
        images = pictures(window.frames)
        # The order counts: the second overwrites the first latent frame of the first.
        conditions = [
            condition.LTXVideoCondition(video=images, frame_index=0, strength=1 - self.strength),
            condition.LTXVideoCondition(image=images[0], frame_index=0, strength=1.0),
        ]
        result = self.pipeline(
            conditions=conditions,
            height=window.height,
            width=window.width,
            num_frames=len(window),
            frame_rate=FRAME_RATE,
            num_inference_steps=self.steps,
            guidance_scale=self.guidance(self.settings),
            decode_timestep=DECODE_TIMESTEP,
            decode_noise_scale=DECODE_NOISE_SCALE,
            generator=seeded(seed),
            callback_on_step_end=self.step_made,
            output_type="np",
            **self.encoded_text(),
        )
        return np.asarray(result.frames[0])

    @classmethod
    def _encoded(cls, pipeline: Any, text: str, negative_text: str, *, guided: bool) -> dict[str, Tensor]:
        positive, mask, negative, negative_mask = pipeline.encode_prompt(
            text, negative_text if guided else None, do_classifier_free_guidance=guided
        )
        encoded = {"prompt_embeds": positive, "prompt_attention_mask": mask}
        if guided:
            encoded |= {
                "negative_prompt_embeds": negative,
                "negative_prompt_attention_mask": negative_mask,
            }
        return encoded


LTX = DiffusersBackend(LtxCondition)
