"""The restorer's network: a small conditional U-Net that predicts the clean view.

Its outputs are a residual to the base image, a residual to the logarithm of the completed depth, and the
logarithm of the expected error of its colours.

Two-by-two pixel blocks become channels at the entrance (full resolution costs most and gains least),
group normalisation and SiLU, the diffusion time by feature-wise scale and shift, attention at the
coarsest level only. All residual branches and the output start at zero, so that an untrained network
returns its base image.

The generative form of the network can do two things more: it takes texture from patches of the scene's own
frames (`TextureTransfer`), and it is told whether the mean of all plausible views is asked for or one of
them.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from extrags.depth.halving import HalvingConv2d
from extrags.restoration.diffusion.texture_transfer import PatchFeatures, TextureTransfer
from extrags.view_synthesis.conditioning import CONDITION_CHANNELS

__all__ = ["OUTPUT_CHANNELS", "SIZE_MULTIPLE", "RestorationNetwork", "build_network"]

UNSHUFFLE = 2
TIME_FEATURES = 64
TIME_WIDTH = 128
NORM_GROUPS = 8
DRAWING_DEVIATION = 0.2
OUTPUT_CHANNELS = 5
"""Colour residual (3), residual of the log-depth (1), logarithm of the expected error (1)."""
SIZE_MULTIPLE = UNSHUFFLE * 4
"""Image sides must be multiples of this: one unshuffling, two halvings."""


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions whose middle is scaled and shifted by the diffusion time."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.norm_in = nn.GroupNorm(NORM_GROUPS, inputs)
        self.conv_in = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.norm_out = nn.GroupNorm(NORM_GROUPS, outputs)
        self.conv_out = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.time = nn.Linear(TIME_WIDTH, 2 * outputs)
        self.skip = nn.Conv2d(inputs, outputs, 1) if inputs != outputs else nn.Identity()

    def forward(self, features: Tensor, time: Tensor) -> Tensor:
        hidden = self.conv_in(functional.silu(self.norm_in(features)))
        scale, shift = self.time(time)[:, :, None, None].chunk(2, dim=1)
        hidden = self.norm_out(hidden) * (1 + scale) + shift
        hidden = self.conv_out(functional.silu(hidden))
        return self.skip(features) + hidden  # type: ignore[no-any-return]


class SelfAttention(nn.Module):
    """Attention over all positions of the coarsest level."""

    def __init__(self, channels: int, heads: int = 4) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.GroupNorm(NORM_GROUPS, channels)
        self.qkv = nn.Linear(channels, 3 * channels)
        self.out = nn.Linear(channels, channels)

    def forward(self, features: Tensor) -> Tensor:
        n, channels, height, width = features.shape
        tokens = self.norm(features).flatten(2).transpose(1, 2)
        query, key, value = (
            part.reshape(n, height * width, self.heads, channels // self.heads).transpose(1, 2)
            for part in self.qkv(tokens).chunk(3, dim=-1)
        )
        attended = functional.scaled_dot_product_attention(query, key, value)
        attended = self.out(attended.transpose(1, 2).reshape(n, height * width, channels))
        mixed: Tensor = features + attended.transpose(1, 2).reshape(features.shape)
        return mixed


class RestorationNetwork(nn.Module):
    """Residuals to base image and depth, and the expected error, from conditioning, noisy image and time.

    Args:
        condition_channels: channels of the conditioning.
        widths: channels of the three levels; multiples of 8.
        generative: with texture transfer, and able to draw one of many plausible views.
    """

    def __init__(
        self, condition_channels: int, widths: tuple[int, int, int], *, generative: bool = False
    ) -> None:
        super().__init__()
        self.condition_channels = condition_channels
        self.widths = widths
        self.generative = generative
        fine, middle, coarse = widths
        blocks = UNSHUFFLE**2
        self.time = nn.Sequential(
            nn.Linear(TIME_FEATURES, TIME_WIDTH), nn.SiLU(), nn.Linear(TIME_WIDTH, TIME_WIDTH), nn.SiLU()
        )
        self.entrance = nn.Conv2d((condition_channels + 3) * blocks, fine, 3, padding=1)
        self.down_fine = ResidualBlock(fine, fine)
        self.to_middle = HalvingConv2d(fine, middle)
        self.down_middle = ResidualBlock(middle, middle)
        self.to_coarse = HalvingConv2d(middle, coarse)
        self.down_coarse = ResidualBlock(coarse, coarse)
        self.attention = SelfAttention(coarse)
        self.up_coarse = ResidualBlock(coarse, coarse)
        self.from_coarse = nn.Conv2d(coarse, middle, 3, padding=1)
        self.up_middle = ResidualBlock(2 * middle, middle)
        self.from_middle = nn.Conv2d(middle, fine, 3, padding=1)
        self.up_fine = ResidualBlock(2 * fine, fine)
        self.up_last = ResidualBlock(2 * fine, fine)
        self.norm = nn.GroupNorm(NORM_GROUPS, fine)
        self.exit = nn.Conv2d(fine, OUTPUT_CHANNELS * blocks, 3, padding=1)
        if generative:
            self.drawing = nn.Linear(1, TIME_WIDTH, bias=False)
            self.texture = TextureTransfer(widths)

    @property
    def folded(self) -> bool:
        """Whether it has no channels of its own for what keyframes have invented."""
        return self.condition_channels == CONDITION_CHANNELS

    def forward(
        self,
        condition: Float[Tensor, "n c h w"],
        noisy: Float[Tensor, "n 3 h w"],
        time: Float[Tensor, "n"],
        drawing: Float[Tensor, "n"] | None = None,
        patches: PatchFeatures | None = None,
    ) -> Float[Tensor, "n 5 h w"]:
        """Residual colours, normalised as `noisy`; residual log-depth; log-error.

        Args:
            condition: conditioning.
            noisy: a point of the path from the clean view to noise.
            time: its place there, 1 at the noise.
            drawing: 1 for one of the plausible views, 0 for their mean; None is 0. Counts in the generative
                form only.
            patches: features of patches of the scene's frames; None takes no texture from them. Counts in
                the generative form only.
        """
        embedded = self.time(_sinusoids(time))
        if self.generative and drawing is not None:
            embedded = embedded + self.drawing(drawing[:, None])
        entered, fine, middle, coarse = self._encoded(condition, noisy, embedded)
        coarse = self.attention(coarse)
        taken = self.texture(coarse, patches) if self.generative and patches is not None else None
        coarse = self.up_coarse(coarse if taken is None else coarse + taken.coarse, embedded)
        hidden = self.from_coarse(_doubled(coarse))
        if taken is not None:
            hidden = hidden + taken.middle
        hidden = self.up_middle(torch.cat([hidden, middle], dim=1), embedded)
        hidden = self.from_middle(_doubled(hidden))
        if taken is not None:
            hidden = hidden + taken.fine
        hidden = self.up_fine(torch.cat([hidden, fine], dim=1), embedded)
        hidden = self.up_last(torch.cat([hidden, entered], dim=1), embedded)
        hidden = self.exit(functional.silu(self.norm(hidden)))
        return functional.pixel_shuffle(hidden, UNSHUFFLE)

    def coarsest(
        self,
        condition: Float[Tensor, "n c h w"],
        noisy: Float[Tensor, "n 3 h w"],
        time: Float[Tensor, "n"],
    ) -> Float[Tensor, "n d h8 w8"]:
        """Features at an eighth of the size, before places look at each other; arguments as of `forward`."""
        return self._encoded(condition, noisy, self.time(_sinusoids(time)))[-1]

    def _encoded(
        self, condition: Tensor, noisy: Tensor, time: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """At the entrance, and at the fine, middle and coarsest level."""
        packed = functional.pixel_unshuffle(torch.cat([condition, noisy], dim=1), UNSHUFFLE)
        entered = self.entrance(packed.contiguous(memory_format=torch.channels_last))
        fine = self.down_fine(entered, time)
        middle = self.down_middle(self.to_middle(fine), time)
        return entered, fine, middle, self.down_coarse(self.to_coarse(middle), time)

    def initialise(self, generator: torch.Generator) -> None:
        """Draw all weights from one generator; residual branches and output start at zero."""
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.Linear):
                fan_in = module.weight[0].numel()
                nn.init.normal_(module.weight, std=(2 / fan_in) ** 0.5, generator=generator)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
            elif isinstance(module, nn.GroupNorm):
                nn.init.ones_(module.weight)
                nn.init.zeros_(module.bias)
        for module in self.modules():
            if isinstance(module, ResidualBlock):
                nn.init.zeros_(module.conv_out.weight)
                nn.init.zeros_(module.time.weight)
            elif isinstance(module, SelfAttention):
                nn.init.zeros_(module.out.weight)
        nn.init.zeros_(self.exit.weight)
        if self.generative:
            # From zero, both tasks would stay one for thousands of steps.
            nn.init.normal_(self.drawing.weight, std=DRAWING_DEVIATION, generator=generator)
            self.texture.initialise()

    def widened(self, condition_channels: int) -> RestorationNetwork:
        """The generative form of this network with more conditioning channels, which it does not use yet.

        Args:
            condition_channels: of the wider network; its first ones are those of this network.
        """
        wider = build_network(
            condition_channels, self.widths, torch.Generator().manual_seed(0), generative=True
        )
        own = {name: value.clone() for name, value in self.state_dict().items()}
        old = own["entrance.weight"].unflatten(1, (-1, UNSHUFFLE**2))
        new = old.new_zeros(len(old), condition_channels + 3, *old.shape[2:])
        new[:, : self.condition_channels] = old[:, : self.condition_channels]
        new[:, -3:] = old[:, -3:]
        own["entrance.weight"] = new.flatten(1, 2)
        wider.load_state_dict({**wider.state_dict(), **own})
        return wider


def build_network(
    condition_channels: int,
    widths: tuple[int, int, int],
    generator: torch.Generator,
    *,
    generative: bool = False,
) -> RestorationNetwork:
    """A network whose weights come from `generator` alone (no global random state is touched)."""
    with torch.device("meta"):
        network = RestorationNetwork(condition_channels, widths, generative=generative)
    # Not `to_empty`, which loads torch's symbolic shapes, and with them sympy.
    empty = {name: torch.empty(value.shape) for name, value in network.state_dict().items()}
    network.load_state_dict(empty, assign=True)
    network.initialise(generator)
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]


def _sinusoids(time: Tensor) -> Tensor:
    frequencies = torch.exp(
        torch.arange(TIME_FEATURES // 2, device=time.device) * (-math.log(1000) / (TIME_FEATURES // 2 - 1))
    )
    angles = time[:, None].float() * 1000 * frequencies
    return torch.cat([angles.sin(), angles.cos()], dim=1)


def _doubled(features: Tensor) -> Tensor:
    return functional.interpolate(features, scale_factor=2, mode="nearest")
