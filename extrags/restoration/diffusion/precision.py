"""The precision in which the embedded restorer computes; keys of artefacts need it without a network."""

from __future__ import annotations

from typing import Literal

import torch

from extrags.config import EnhanceConfig

__all__ = ["chosen_precision", "has_fast_half_precision"]


def has_fast_half_precision() -> bool:
    """Whether this processor computes bfloat16 convolutions faster than float32 ones."""
    return bool(torch.cpu._is_avx512_bf16_supported())


def chosen_precision(config: EnhanceConfig) -> Literal["float32", "bfloat16"]:
    """The precision that the settings mean on this processor."""
    if config.precision != "auto":
        return config.precision
    return "bfloat16" if has_fast_half_precision() else "float32"
