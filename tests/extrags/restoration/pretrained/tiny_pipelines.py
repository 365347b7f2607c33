"""Pipelines with tiny random parts, saved as diffusers saves them, text encoder and tokenizer included."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

from extrags.config.backends import BACKENDS
from extrags.restoration.backends import backend_of
from extrags.restoration.pretrained.enhancer import DiffusersBackend

WORDS = ["<pad>", "</s>", "<unk>", "pink", "wall", "of", "a", "tube", "blurry"]
TEXT_WIDTH = 32

ADAPTERS = {
    name: backend.adapter for name in BACKENDS if isinstance(backend := backend_of(name), DiffusersBackend)
}


def wan_vace(diffusers: ModuleType) -> Any:
    vae = diffusers.AutoencoderKLWan(
        base_dim=3,
        z_dim=16,
        dim_mult=[1, 1, 1, 1],
        num_res_blocks=1,
        temperal_downsample=[False, True, True],
    )
    transformer = diffusers.WanVACETransformer3DModel(
        patch_size=(1, 2, 2),
        num_attention_heads=2,
        attention_head_dim=12,
        in_channels=16,
        out_channels=16,
        text_dim=TEXT_WIDTH,
        freq_dim=64,
        ffn_dim=32,
        num_layers=2,
        rope_max_seq_len=32,
        vace_layers=[0],
        vace_in_channels=96,
    )
    return diffusers.WanVACEPipeline(
        tokenizer=t5_tokenizer(),
        text_encoder=t5_encoder("umt5"),
        vae=vae,
        scheduler=diffusers.FlowMatchEulerDiscreteScheduler(shift=7.0),
        transformer=transformer,
    )


def ltx(diffusers: ModuleType) -> Any:
    vae = diffusers.AutoencoderKLLTXVideo(
        latent_channels=8,
        block_out_channels=(8, 8, 8, 8),
        decoder_block_out_channels=(8, 8, 8, 8),
        layers_per_block=(1, 1, 1, 1, 1),
        decoder_layers_per_block=(1, 1, 1, 1, 1),
        spatio_temporal_scaling=(True, True, True, False),
        decoder_spatio_temporal_scaling=(True, True, True, False),
        decoder_inject_noise=(False,) * 5,
        upsample_residual=(False,) * 4,
        upsample_factor=(1,) * 4,
        patch_size=4,
        patch_size_t=1,
        encoder_causal=True,
        decoder_causal=False,
    )
    transformer = diffusers.LTXVideoTransformer3DModel(
        in_channels=8,
        out_channels=8,
        num_attention_heads=2,
        attention_head_dim=16,
        cross_attention_dim=32,
        num_layers=1,
        caption_channels=TEXT_WIDTH,
    )
    return diffusers.LTXConditionPipeline(
        scheduler=diffusers.FlowMatchEulerDiscreteScheduler(),
        vae=vae,
        text_encoder=t5_encoder("t5"),
        tokenizer=t5_tokenizer(),
        transformer=transformer,
    )


def stable_video(diffusers: ModuleType) -> Any:
    from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection
    from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil

    unet = diffusers.UNetSpatioTemporalConditionModel(
        block_out_channels=(32, 64),
        layers_per_block=1,
        sample_size=16,
        in_channels=8,
        out_channels=4,
        down_block_types=("CrossAttnDownBlockSpatioTemporal", "DownBlockSpatioTemporal"),
        up_block_types=("UpBlockSpatioTemporal", "CrossAttnUpBlockSpatioTemporal"),
        cross_attention_dim=32,
        num_attention_heads=4,
        projection_class_embeddings_input_dim=96,
        addition_time_embed_dim=32,
    )
    scheduler = diffusers.EulerDiscreteScheduler(
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        prediction_type="v_prediction",
        sigma_max=700.0,
        sigma_min=0.002,
        steps_offset=1,
        timestep_spacing="leading",
        timestep_type="continuous",
        use_karras_sigmas=True,
    )
    vae = diffusers.AutoencoderKLTemporalDecoder(
        block_out_channels=(32, 32, 32),
        down_block_types=("DownEncoderBlock2D",) * 3,
        layers_per_block=1,
        latent_channels=4,
    )
    encoder = CLIPVisionModelWithProjection(
        CLIPVisionConfig(
            hidden_size=32,
            projection_dim=32,
            num_hidden_layers=1,
            num_attention_heads=4,
            intermediate_size=32,
            image_size=224,
            patch_size=56,
        )
    )
    return diffusers.StableVideoDiffusionPipeline(
        vae=vae,
        image_encoder=encoder,
        unet=unet,
        scheduler=scheduler,
        feature_extractor=CLIPImageProcessorPil(),
    )


def stable_diffusion(diffusers: ModuleType, pipeline: str, channels: int) -> Any:
    unet = diffusers.UNet2DConditionModel(
        block_out_channels=(16, 32),
        norm_num_groups=8,
        layers_per_block=1,
        sample_size=16,
        in_channels=channels,
        out_channels=4,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
        up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        cross_attention_dim=TEXT_WIDTH,
        attention_head_dim=8,
    )
    vae = diffusers.AutoencoderKL(
        block_out_channels=(16, 16),
        norm_num_groups=8,
        down_block_types=("DownEncoderBlock2D",) * 2,
        up_block_types=("UpDecoderBlock2D",) * 2,
        latent_channels=4,
    )
    scheduler = diffusers.DDIMScheduler(
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        clip_sample=False,
        set_alpha_to_one=False,
        steps_offset=1,
    )
    return getattr(diffusers, pipeline)(
        vae=vae,
        text_encoder=clip_encoder(),
        tokenizer=clip_tokenizer(),
        unet=unet,
        scheduler=scheduler,
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )


def t5_encoder(kind: str) -> Any:
    from transformers import T5Config, T5EncoderModel, UMT5Config, UMT5EncoderModel

    config, model = {"t5": (T5Config, T5EncoderModel), "umt5": (UMT5Config, UMT5EncoderModel)}[kind]
    shape = {"d_model": TEXT_WIDTH, "d_ff": 32, "d_kv": 8, "num_layers": 1, "num_heads": 2}
    return model(config(vocab_size=len(WORDS), **shape)).eval()


def t5_tokenizer() -> Any:
    from tokenizers import Tokenizer, models, pre_tokenizers, processors
    from transformers import PreTrainedTokenizerFast

    made = Tokenizer(models.WordLevel({word: place for place, word in enumerate(WORDS)}, unk_token="<unk>"))
    made.pre_tokenizer = pre_tokenizers.Whitespace()
    made.post_processor = processors.TemplateProcessing(single="$A </s>", special_tokens=[("</s>", 1)])
    return PreTrainedTokenizerFast(
        tokenizer_object=made, pad_token="<pad>", eos_token="</s>", unk_token="<unk>", model_max_length=64
    )


def clip_encoder() -> Any:
    from transformers import CLIPTextConfig, CLIPTextModel

    shape = {"hidden_size": TEXT_WIDTH, "intermediate_size": 32, "num_hidden_layers": 1}
    return CLIPTextModel(
        CLIPTextConfig(
            vocab_size=len(WORDS),
            num_attention_heads=2,
            max_position_embeddings=16,
            pad_token_id=0,
            eos_token_id=1,
            bos_token_id=1,
            **shape,
        )
    ).eval()


def clip_tokenizer() -> Any:
    made = t5_tokenizer()
    made.model_max_length = 16
    return made


BUILDERS: dict[str, Callable[[ModuleType], Any]] = {
    "WanVACEPipeline": wan_vace,
    "LTXConditionPipeline": ltx,
    "StableVideoDiffusionPipeline": stable_video,
    "StableDiffusionImg2ImgPipeline": lambda diffusers: stable_diffusion(
        diffusers, "StableDiffusionImg2ImgPipeline", 4
    ),
    "StableDiffusionInpaintPipeline": lambda diffusers: stable_diffusion(
        diffusers, "StableDiffusionInpaintPipeline", 9
    ),
}


def moving_tube(frames: int, height: int, width: int) -> np.ndarray:
    """Smooth images with something to tell them apart."""
    rows, columns = np.mgrid[:height, :width] / max(height, width)
    phases = np.arange(frames)[:, None, None] * 0.3
    waves = [0.5 + 0.4 * np.sin(6 * rows + shift + phases + 4 * columns) for shift in (0.0, 0.5, 1.0)]
    return np.stack(waves, axis=-1).astype(np.float32)
