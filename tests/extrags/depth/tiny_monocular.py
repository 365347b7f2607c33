"""Monocular networks with tiny random weights, saved as transformers saves them; and a made-up one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

__all__ = ["KnownDepth", "save_depth_anything", "save_dpt"]

PREPROCESSOR = {
    "do_resize": True,
    "size": {"height": 42, "width": 42},
    "keep_aspect_ratio": True,
    "ensure_multiple_of": 14,
    "resample": 3,
    "do_rescale": True,
    "rescale_factor": 1 / 255,
    "do_normalize": True,
    "image_mean": [0.485, 0.456, 0.406],
    "image_std": [0.229, 0.224, 0.225],
    "do_pad": False,
    "image_processor_type": "DPTImageProcessor",
}


def save_depth_anything(folder: Path, kind: str = "relative") -> None:
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config

    backbone = Dinov2Config(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        image_size=42,
        patch_size=14,
        out_features=["stage1", "stage2", "stage3", "stage4"],
        reshape_hidden_states=False,
    )
    config = DepthAnythingConfig(
        backbone_config=backbone,
        reassemble_hidden_size=16,
        neck_hidden_sizes=[4, 4, 8, 8],
        fusion_hidden_size=8,
        head_hidden_size=4,
        depth_estimation_type=kind,
        max_depth=20 if kind == "metric" else 1,
    )
    _save(folder, DepthAnythingForDepthEstimation(config))


def save_dpt(folder: Path) -> None:
    from transformers import DPTConfig, DPTForDepthEstimation

    config = DPTConfig(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        intermediate_size=16,
        image_size=42,
        patch_size=14,
        backbone_out_indices=[0, 1, 2, 3],
        neck_hidden_sizes=[4, 4, 8, 8],
        fusion_hidden_size=8,
        reassemble_factors=[4, 2, 1, 0.5],
    )
    _save(folder, DPTForDepthEstimation(config))


def _save(folder: Path, model) -> None:  # type: ignore[no-untyped-def]
    with torch.no_grad():
        generator = torch.Generator().manual_seed(7)
        for value in model.parameters():
            value += 0.05 * torch.randn(value.shape, generator=generator)
    model.save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps(PREPROCESSOR))


class KnownDepth:
    """Gives what such a network would: inverse depth up to a scale and a shift of each frame, a little wrong.

    Args:
        depth: true depths of the frames, in the order they are asked for, [F, H, W].
        error: standard deviation of log-depth, of blotches a sixth of the image wide.
        seed: of scales, shifts and errors.
    """

    def __init__(self, depth: np.ndarray, error: float, seed: int = 0) -> None:
        self.depth, self.error = torch.from_numpy(depth).float(), error
        self.generator = torch.Generator().manual_seed(seed)
        self.frame = 0

    def inverse_depth(self, rgb: Tensor) -> Tensor:
        depth = self.depth[self.frame]
        self.frame += 1
        blotches = torch.randn(1, 1, 7, 7, generator=self.generator)
        blotches = functional.interpolate(blotches, size=depth.shape, mode="bicubic", align_corners=True)[
            0, 0
        ]
        scale, shift = 1 + 4 * torch.rand(2, generator=self.generator)
        known = depth > 0
        inverse = torch.exp(-self.error * blotches) / torch.where(known, depth, depth[known].median())
        return scale * inverse / inverse.median() + shift
