"""The convolution that networks halve images with, right in bfloat16 too where one column is left."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

__all__ = ["HalvingConv2d"]

TWO_COLUMNS_FROM_PX = 3
"""Width from which half of it, rounded up, is more than one column."""


class HalvingConv2d(nn.Conv2d):
    """A convolution of 3 x 3 pixels, at every second row and column.

    In bfloat16, oneDNN's kernels for processors (torch 2.13) give arbitrary numbers, and not-a-number, for
    images of one or two columns and more than eight rows: a frame eight pixels wide is so narrow where the
    restorer's network is coarsest, one of 64 x 640 px where its depth is read. Two more columns of zeros,
    which is what lies there anyway, leave the first column of the result as it should be.

    Args:
        inputs: channels.
        outputs: channels.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 3, stride=2, padding=1)

    def forward(self, input: Tensor) -> Tensor:
        """Half of the images, of sides rounded up."""
        in_half = input.dtype == torch.bfloat16 or torch.is_autocast_enabled(input.device.type)
        if input.shape[-1] >= TWO_COLUMNS_FROM_PX or not in_half:
            return super().forward(input)
        return super().forward(functional.pad(input, (0, 2)))[..., :1]
