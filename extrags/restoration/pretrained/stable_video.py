"""Stable Video Diffusion: started from the clip, known parts put back at every step."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from extrags.restoration.pretrained.adapter import Adapter, Window, pictures, seeded
from extrags.restoration.pretrained.enhancer import DiffusersBackend
from extrags.restoration.pretrained.model import PipelineRule

__all__ = ["STABLE_VIDEO", "StableVideo"]

FRAME_RATE = 7
MOTION = 127
"""Frame rate and motion bucket the model was published with."""


class StableVideo(Adapter):
    """`StableVideoDiffusionPipeline`: made to animate one image, here guided by a clip.

    The real view is its image. Frames start from the clip's latents with noise (`strength` of the
    schedule, as SDEdit does), and after every step the latents of known pixels are set back to the
    clip's, with the noise of that step (as RePaint does, without its resampling).

    Run with tiny random parts only.

    Source: Blattmann et al.: Stable Video Diffusion, 2023; Meng et al.: SDEdit, 2022; Lugmayr et al.:
    RePaint, 2022; diffusers 0.42.
    """

    rule = PipelineRule(
        backend="stable-video",
        pipeline="StableVideoDiffusionPipeline",
        accepts=("StableVideoDiffusionPipeline",),
        usual_model="stabilityai/stable-video-diffusion-img2vid-xt",
        size="about 9 GB; its licence must be accepted on the hub",
        frame_step=1,
        size_multiple=64,
        frames=14,
        short_side_px=448,
        steps=25,
        strength=0.7,
        guidance_scale=3.0,
        text_parts=(),
        image_parts=("vae", "image_encoder", "unet"),
        masked=True,
    )

    def _restored(self, window: Window, seed: int) -> np.ndarray:
        pipeline = self.pipeline
        generator = seeded(seed)
        clean = self._latents(window.frames)
        noise = torch.randn(clean.shape, generator=generator, dtype=torch.float32)
        sigmas = self._sigmas()
        known = self._known(window.unknown, clean)

        def put_back(pipe: Any, step: int, time: Any, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
            self.step_made(pipe, step, time, inputs)
            latents = inputs["latents"]
            original = (clean + sigmas[step + 1] * noise)[None].to(latents)
            return {"latents": torch.lerp(latents, original, known.to(latents))}

        # The pipeline multiplies what it is given by its scheduler's first noise level.
        pipeline.scheduler.set_timesteps(sigmas=sigmas)
        start = (clean + sigmas[0] * noise)[None] / float(pipeline.scheduler.init_noise_sigma)
        result = pipeline(
            pictures(window.frames[:1])[0],
            height=window.height,
            width=window.width,
            num_frames=len(window),
            sigmas=sigmas,
            min_guidance_scale=1.0,
            max_guidance_scale=self.guidance(self.settings),
            fps=FRAME_RATE,
            motion_bucket_id=MOTION,
            latents=start.to(pipeline.unet.dtype),
            generator=generator,
            callback_on_step_end=put_back,
            output_type="np",
        )
        return np.asarray(result.frames[0])

    def _sigmas(self) -> list[float]:
        """Noise levels from `strength` of the schedule down to none."""
        scheduler = self.pipeline.scheduler
        scheduler.set_timesteps(self.steps)
        levels = [float(level) for level in scheduler.sigmas]
        return levels[self.steps - int(self.steps * self.strength) :]

    def _latents(self, frames: Float[np.ndarray, "t h w 3"]) -> Float[Tensor, "t c hh ww"]:
        vae = self.pipeline.vae
        parts = []
        for frame in frames:
            image = torch.from_numpy(frame).permute(2, 0, 1)[None] * 2 - 1
            encoded = vae.encode(image.to(self.pipeline._execution_device, vae.dtype)).latent_dist.mode()
            parts.append(encoded.float().cpu() * vae.config.scaling_factor)
        return torch.cat(parts)

    @staticmethod
    def _known(
        unknown: Bool[np.ndarray, "t h w"], latents: Float[Tensor, "t c hh ww"]
    ) -> Float[Tensor, "1 t 1 hh ww"]:
        """1 where every pixel of a latent's cell is known."""
        holes = torch.from_numpy(unknown.astype(np.float32))[:, None]
        reduced = functional.adaptive_max_pool2d(holes, (int(latents.shape[-2]), int(latents.shape[-1])))
        return (1 - reduced)[None]


STABLE_VIDEO = DiffusersBackend(StableVideo)
