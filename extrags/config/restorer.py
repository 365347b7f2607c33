"""Settings of the restoration: the embedded restorer, pretrained models, and captions."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator

from extrags.config.backends import BACKEND_NAME, backend_schema, backend_summaries
from extrags.config.base import Seed, StageConfig

__all__ = [
    "CaptionConfig",
    "CheckpointConfig",
    "EnhanceConfig",
    "IouSet",
    "LevelWidth",
    "PretrainedConfig",
    "ReferenceChoice",
    "SeamlessCloning",
]

ReferenceChoice = Literal["covisibility", "nearest"]
"""Which real view is the reference of a virtual one."""

SeamlessCloning = Literal["auto", "always", "never"]
"""When what a restorer invents is cloned seamlessly into what is known."""

LevelWidth = Annotated[int, Field(gt=0, multiple_of=8)]
"""Channels of a level of the U-Net, which are normalised in eight groups."""

IouSet = Literal["reference", "union"]
"""What the overlap of two views is a share of."""


class CaptionConfig(StageConfig):
    """Text prompts of pretrained pipelines.

    The endpoint's URL and API key are not settings: they come from EXTRAGS_CAPTION_URL and
    EXTRAGS_CAPTION_KEY, so that no API key can end up in an artefact.
    """

    source: Literal["constant", "file", "endpoint"] = Field(
        "constant", description="one text for all, a text per scene, or an OpenAI-compatible endpoint"
    )
    text: str = Field(
        "endoscopic view of the colon mucosa, folds, blood vessels, sharp, well lit",
        min_length=1,
        description="the constant text",
    )
    negative_text: str = Field(
        "blurry, noisy, floating blobs, distorted, text, watermark",
        description="the negative prompt",
    )
    file: str | None = Field(None, description="YAML or JSON file {name of the sequence: text}")
    model: str | None = Field(None, description="model the endpoint is asked for")
    frames: int = Field(6, ge=1, le=32, description="training frames sent to the endpoint")
    frame_width: int = Field(320, ge=32, le=1024, description="width they are reduced to, in pixels")
    max_tokens: int = Field(70, ge=8, le=500, description="length of the answer; CLIP reads 77 tokens")
    timeout_s: float = Field(60.0, gt=0, description="of one request")
    retries: int = Field(4, ge=0, le=10, description="retries after a transient error")
    retry_wait_s: float = Field(1.0, ge=0, description="before the second try; doubled after each")
    prompt_price: float = Field(0.0, ge=0, description="of a million tokens sent; the cost is shown in it")
    completion_price: float = Field(0.0, ge=0, description="of a million tokens received")


class PretrainedConfig(StageConfig):
    """Settings that all diffusers pipelines share; None takes the pipeline's usual value."""

    model: str | None = Field(None, description="folder of a saved pipeline, or a hub id")
    revision: str | None = Field(None, description="commit, tag or branch of a hub id")
    local_files_only: bool = Field(True, description="False: a hub id may be downloaded")
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="auto: cuda where there is one")
    threads: int = Field(
        4,
        ge=1,
        le=64,
        description="threads of torch on a processor, however many cores it has: results depend on them "
        "by rounding",
    )
    dtype: Literal["auto", "float32", "bfloat16", "float16"] = Field(
        "auto", description="auto: bfloat16 on cuda, float32 on a processor"
    )
    offload: Literal["none", "model", "sequential"] = Field(
        "none", description="keep idle parts of the pipeline in main memory; needs cuda"
    )
    frames: int | None = Field(None, ge=2, description="frames of one window, a real view first")
    overlap: int = Field(4, ge=0, description="frames two windows share, cross-faded")
    short_side_px: int | None = Field(None, ge=16, description="shorter side of the images it works on")
    steps: int | None = Field(None, ge=1, description="denoising steps")
    strength: float | None = Field(
        None, gt=0, le=1, description="share of the noise that known pixels start from (not Wan VACE)"
    )
    guidance_scale: float | None = Field(None, ge=0, description="weight of the text; 1 and less: none")
    reference_images: int = Field(2, ge=0, description="real views handed over where a pipeline takes them")
    mask_threshold: float = Field(
        0.5, gt=0, le=1, description="pixels with a smaller known share are inpainted"
    )
    mask_dilation_px: int = Field(3, ge=0, description="dilation of the inpainted region")


class CheckpointConfig(StageConfig):
    """A DynamiCrafter-type checkpoint, run by the user's own clone of its code."""

    root: str | None = Field(None, description="the clone: folder that holds lvdm/ and utils/")
    config: str | None = Field(None, description="YAML file of the model, absolute or inside the clone")
    checkpoint: str | None = Field(None, description="weights: .ckpt, .pt or .safetensors")
    interface: Literal["enhancer", "dynamicrafter"] = Field(
        "enhancer",
        description="enhancer: restores renders, as the paper's; dynamicrafter: the published image-to-video "
        "model, holes only",
    )
    python: str | None = Field(None, description="interpreter with the clone's packages; None: this one")
    trust_pickle: bool = Field(
        False, description="load a checkpoint that holds more than tensors; it can run any code"
    )
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="auto: cuda where there is one")
    threads: int = Field(
        4,
        ge=1,
        le=64,
        description="threads of torch on a processor, however many cores it has: results depend on them "
        "by rounding",
    )
    steps: int = Field(50, ge=1, description="DDIM steps")
    eta: float = Field(1.0, ge=0, le=1, description="of DDIM; 1 is ancestral sampling")
    guidance_scale: float | None = Field(
        None, ge=0, description="weight of the text; None: 1 for enhancer, 7.5 for dynamicrafter"
    )
    fps: int = Field(5, ge=1, description="frame rate that conditions the model")
    frames: int = Field(16, ge=2, description="frames of one window, a real view first")
    overlap: int = Field(4, ge=0, description="frames two windows share, cross-faded")
    width: int = Field(512, ge=16, description="image width; images are stretched to it, as the paper does")
    height: int = Field(320, ge=16, description="image height")
    timeout_s: float = Field(3600.0, gt=0, description="of one clip, loading included; longer is an error")


MOST_SAMPLES = 16


class EnhanceConfig(StageConfig):
    """Restoration of the virtual views."""

    backend: Annotated[str, BACKEND_NAME] = Field(
        "embedded",
        description=backend_summaries(),
        json_schema_extra=backend_schema,
    )
    pretrained_weights: str = Field(
        "bundled",
        min_length=1,
        description="what the embedded backend starts from: bundled (weights of the package: those that know "
        "the scene), colons or cavities (one set of them), none (the scene's own pairs alone), or a path",
    )
    folds: int = Field(2, ge=1, description="leave-out reconstructions that make training pairs")
    fold_iterations: int = Field(300, ge=1, description="optimisation steps of each of them")
    synthetic_views: int = Field(24, ge=0, description="further pairs from perturbed, unoptimised Gaussians")
    train_iterations: int = Field(
        0,
        ge=0,
        description="steps of the diffusion's training on the scene's own pairs, kept where validation pairs "
        "show a gain; 0: none are made. Where it was measured, that gain did not reach the final scene",
    )
    judge: bool = Field(
        True,
        description="compare the embedded restorer with blending and filling on leave-out pairs of the "
        "scene, and use the latter where the former is worse",
    )
    seamless_cloning: SeamlessCloning = Field(
        "auto",
        description="clone what the embedded restorer invents seamlessly into what is known, which then "
        "keeps its colours. auto: where the judge finds the plain restorer worse than blending and filling, "
        "and unjudged on scenes unlike all that it was trained on",
    )
    judge_pairs: int = Field(
        48,
        ge=4,
        description="leave-out pairs the restorers are compared on, at most, spread over the recording; they "
        "take longer than the reconstructions they come from, and more of them hardly tell more",
    )
    batch: int = Field(4, ge=1, description="crops per step")
    crop: int = Field(96, ge=32, multiple_of=8, description="crop size in pixels")
    channels: tuple[LevelWidth, LevelWidth, LevelWidth] = Field(
        (32, 64, 96), description="widths of the U-Net's levels, where it starts from no weights"
    )
    learning_rate: float = Field(8e-4, gt=0, description="of a training from nothing")
    scene_learning_rate: float = Field(2e-4, gt=0, description="of a training from pretrained weights")
    steps: int | Literal["auto"] = Field(
        "auto",
        description="sampling steps; auto: those of the weights, or, after training on the scene, 1 or 4, as "
        "its validation pairs decide",
    )
    samples: int | Literal["mean"] = Field(
        1,
        description="mean: the mean of all plausible views, which is smooth where nothing was seen; a "
        "number: so many of them are drawn, of which the first is used, and their spread adds to the "
        "expected error. Weights that are not generative give the mean of what they draw",
    )
    depth_from_image: bool = Field(
        True,
        description="read the depth of what the embedded restorer has invented from its image, with a "
        "network of the package; false: the restorer's own guess",
    )
    precision: Literal["auto", "float32", "bfloat16"] = Field(
        "auto", description="of the convolutions; auto: bfloat16 where the processor computes it faster"
    )
    references: int = Field(8, ge=1, description="real views blended into the reference")
    reference: ReferenceChoice = Field(
        "covisibility",
        description="the first of them, which U_img compares with. covisibility: that which saw most of the "
        "virtual view well; nearest: the nearest by pose, as in the paper",
    )
    iou: IouSet = Field(
        "reference",
        description="what U_img divides the Gaussians by that both see: reference: those the reference "
        "sees, as in the paper; union: those either sees, as in ExploreGS",
    )
    max_views: int = Field(
        160,
        ge=1,
        description="virtual views restored at most; no more trajectories than this are planned or restored",
    )
    max_width: int | None = Field(
        320,
        ge=32,
        le=4096,
        description="virtual views are rendered, restored and fine-tuned on at most this wide, in pixels, "
        "with real views and leave-out pairs of the same size; None: as wide as the frames",
    )
    keyframes: int = Field(
        0,
        ge=0,
        description="virtual views restored first, one after the other; what they invent is shown to all "
        "views (embedded and classical); 12 is a usual number. 0: every view is restored alone. Where it was "
        "measured, the final scene gained on some sequences and lost on others",
    )
    clips_per_batch: int = Field(4, ge=1, description="clips restored by one task")
    pixel_confidence: Literal["bounded", "raw"] = Field(
        "bounded",
        description="U_pixel. bounded: 1 - exp(-LPIPS / 0.25), in [0, 1], of rendering and target; raw: "
        "LPIPS itself, without an upper bound, of rendering and restored image, as the paper has it",
    )
    caption: CaptionConfig = CaptionConfig()
    pretrained: PretrainedConfig = PretrainedConfig()
    checkpoint: CheckpointConfig = CheckpointConfig()
    seed: Seed = Field(0, description="seed of all random sampling")

    @field_validator("samples")
    @classmethod
    def _few_samples(cls, samples: int | Literal["mean"]) -> int | Literal["mean"]:
        if samples != "mean" and not 1 <= samples <= MOST_SAMPLES:
            raise ValueError(f"expected mean, or a number from 1 to {MOST_SAMPLES}")
        return samples

    def working_width(self, width: int) -> int:
        """Width of virtual views of a sequence whose frames have a width, in pixels."""
        return width if self.max_width is None else min(width, self.max_width)

    def batches(self, trajectories: int) -> int:
        """Number of batches that so many trajectories, of which `max_views` at most, are restored in."""
        return -(-min(trajectories, self.max_views) // self.clips_per_batch)
