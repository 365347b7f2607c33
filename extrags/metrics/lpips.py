"""LPIPS v0.1 with an AlexNet, VGG16 or SqueezeNet backbone.

Source: Zhang, Isola, Efros, Shechtman, Wang: The Unreasonable Effectiveness of Deep Features as a
Perceptual Metric, CVPR 2018, equation 1.

Values of different backbones are not comparable; state the network with every value. Most of the literature
on 3D Gaussians reports LPIPS with VGG, which takes sixteen times as long as AlexNet on a processor.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.config import DEFAULT_PROFILE, PROFILES, EvaluateConfig, LpipsNet
from extrags.errors import ShapeError, WeightsError
from extrags.metrics.lpips_networks import LAYERS
from extrags.metrics.lpips_weights import find_weights, read_weights

__all__ = ["MIN_SIDE_PX", "Lpips", "LpipsByNet", "TargetActivations", "available_lpips"]

_CHANNEL_SHIFT = (-0.030, -0.088, -0.188)
_CHANNEL_SCALE = (0.458, 0.448, 0.450)
MIN_SIDE_PX = 32
"""Images with a shorter side are refused."""
_NORM_EPS = 1e-10
# A few images at a time: the activations of a long stack would not fit into memory.
_IMAGES_AT_ONCE: dict[LpipsNet, int] = {"alex": 16, "vgg": 1, "squeeze": 16}
_VALUES_AT_ONCE = 1_000_000
"""Of activations that are compared: temporaries of this size stay in the cache."""


@dataclass(frozen=True)
class Lpips:
    """LPIPS with loaded weights.

    Args:
        net: backbone.
        weights: tensors by the names of `extrags.metrics.lpips_networks.array_names`.
    """

    net: LpipsNet
    weights: dict[str, Tensor]

    @classmethod
    def load(cls, path: str | Path | None = None, net: LpipsNet = "alex") -> Lpips:
        """Read the weights.

        Args:
            path: npz file or the folder that holds it; None looks where `find_weights` looks.
            net: backbone.

        Raises:
            WeightsError: when there is no file, or it does not hold this network.
            ConfigError: for an unknown network.
        """
        return cls.read(find_weights(None if path is None else str(path), net), net)

    @classmethod
    def read(cls, files: tuple[Path, ...], net: LpipsNet) -> Lpips:
        """Read the weights from the files that `find_weights` found.

        Raises:
            WeightsError: when they cannot be read, or do not hold this network.
        """
        return cls(net, read_weights(files, net))

    def to(self, device: torch.device | str) -> Lpips:
        """The same metric on another device."""
        return Lpips(self.net, {name: tensor.to(device) for name, tensor in self.weights.items()})

    @property
    def name(self) -> str:
        """Key of the metric, e.g. `lpips_alex`."""
        return f"lpips_{self.net}"

    def distance(
        self, first: Float[Tensor, "*b h w 3"], second: Float[Tensor, "*b h w 3"]
    ) -> Float[Tensor, "*b"]:
        """LPIPS of each pair of whole images, exactly as published.

        Args:
            first: images in [0, 1].
            second: images in [0, 1].

        Returns:
            One distance per pair, 0 for equal images; differentiable.

        Raises:
            ShapeError: when the images differ in shape or are smaller than 32 px.
        """
        layers = self._layer_differences(first, second)
        total = sum((layer.mean((-2, -1)) for layer in layers), start=layers[0].new_zeros(()))
        return total.reshape(first.shape[:-3])

    def distance_map(
        self, first: Float[Tensor, "*b h w 3"], second: Float[Tensor, "*b h w 3"]
    ) -> Float[Tensor, "*b h w"]:
        """LPIPS of each pixel: the maps of all layers, resized bilinearly to the image size and summed.

        Its mean is close to `distance`, but not equal: border cells of a layer cover less of the image than
        inner ones.

        Args:
            first: images in [0, 1].
            second: images in [0, 1].

        Returns:
            Distances >= 0; differentiable.

        Raises:
            ShapeError: when the images differ in shape or are smaller than 32 px.
        """
        size = (int(first.shape[-3]), int(first.shape[-2]))
        layers = self._layer_differences(first, second)
        total = layers[0].new_zeros((layers[0].shape[0], *size))
        for layer in layers:
            total = total + F.interpolate(layer[:, None], size, mode="bilinear", align_corners=False)[:, 0]
        return total.reshape(first.shape[:-1])

    def regional_distances(
        self,
        first: Float[Tensor, "n h w 3"],
        second: Float[Tensor, "n h w 3"],
        regions: dict[str, Bool[Tensor, "n h w"]],
        targets: TargetActivations | None = None,
    ) -> dict[str, list[float | None]]:
        """LPIPS inside regions, from one pass of the network.

        Each layer's map is averaged with the share of the region in each of its cells as weight. For a region
        of all pixels this equals `distance`. Receptive fields extend beyond the region, like SSIM's window.

        Args:
            first: images in [0, 1].
            second: images in [0, 1].
            regions: pixels that count, by name.
            targets: of `second`, kept from call to call where several stacks are compared with it; the
                result is the same to the last bit.

        Returns:
            For each region one distance per pair; None where the region is empty.

        Raises:
            ShapeError: when the images differ in shape or are smaller than 32 px.
        """
        with torch.inference_mode():
            layers = self._layer_differences(first, second, targets)
            found: dict[str, list[float | None]] = {}
            for name, region in regions.items():
                weight = region.to(layers[0])[:, None]
                totals = torch.zeros(len(region), dtype=torch.float64)
                for layer in layers:
                    share = F.adaptive_avg_pool2d(weight, (layer.shape[-2], layer.shape[-1]))[:, 0].double()
                    sums = (layer.double() * share).sum((-2, -1))
                    totals += (sums / share.sum((-2, -1)).clamp_min(1e-12)).cpu()
                filled = region.flatten(1).any(1).tolist()
                found[name] = [
                    value if there else None for value, there in zip(totals.tolist(), filled, strict=True)
                ]
        return found

    def _layer_differences(
        self, first: Tensor, second: Tensor, targets: TargetActivations | None = None
    ) -> list[Float[Tensor, "n hl wl"]]:
        if first.shape != second.shape or first.ndim < 3 or first.shape[-1] != 3:
            raise ShapeError(
                f"LPIPS compares images [..., H, W, 3]; found {tuple(first.shape)} and {tuple(second.shape)}"
            )
        if min(first.shape[-3:-1]) < MIN_SIDE_PX:
            raise ShapeError(
                f"LPIPS needs images of at least {MIN_SIDE_PX} px, found {first.shape[-2]}x{first.shape[-3]}"
            )
        firsts = first.reshape(-1, *first.shape[-3:])
        seconds = second.reshape(-1, *second.shape[-3:])
        if len(firsts) == 0:
            raise ShapeError("LPIPS needs at least one pair of images")
        known = self.in_parts(seconds) if targets is None else targets.of(self)
        parts = [
            [
                self._difference(index, tap, other)
                for index, (tap, other) in enumerate(zip(*pair, strict=True))
            ]
            for pair in zip(self.in_parts(firsts), known, strict=True)
        ]
        return [torch.cat(layers) for layers in zip(*parts, strict=True)]

    def in_parts(self, images: Float[Tensor, "n h w 3"]) -> Iterator[Iterator[Float[Tensor, "m c hl wl"]]]:
        """`activations` of a few images at a time, as memory allows."""
        at_once = _IMAGES_AT_ONCE[self.net]
        for start in range(0, len(images), at_once):
            yield self.activations(images[start : start + at_once])

    def _difference(self, index: int, one: Tensor, other: Tensor) -> Float[Tensor, "m hl wl"]:
        """The difference map of one layer, `_VALUES_AT_ONCE` at a time."""
        head = self.weights[f"lin{index}"].reshape(-1)
        # Channels last, as the convolutions leave them: a pixel's channels are neighbours in memory.
        pixels = [tap.movedim(1, -1).reshape(-1, tap.shape[1]) for tap in (one, other)]
        rows = max(1, _VALUES_AT_ONCE // one.shape[1])
        parts = [
            (_unit(a) - _unit(b)).square() @ head
            for a, b in zip(*(item.split(rows) for item in pixels), strict=True)
        ]
        return torch.cat(parts).reshape(one.shape[0], *one.shape[-2:])

    def compared(self, activations: list[Tensor]) -> list[Float[Tensor, "n hl wl"]]:
        """The difference map of each layer, of the first N of twice N images with the others.

        Args:
            activations: of all images, from `activations`.
        """
        return [self._difference(index, *tap.chunk(2)) for index, tap in enumerate(activations)]

    def activations(self, images: Float[Tensor, "n h w 3"]) -> Iterator[Float[Tensor, "n c hl wl"]]:
        """What the backbone's layers give for images in [0, 1], layer by layer."""
        shift = images.new_tensor(_CHANNEL_SHIFT)
        scale = images.new_tensor(_CHANNEL_SCALE)
        # Channels last throughout: the convolutions are up to twice as fast, and so is comparing channels.
        x = ((2 * images - 1 - shift) / scale).movedim(-1, 1).contiguous(memory_format=torch.channels_last)
        for kind, number in LAYERS[self.net]:
            if kind == "tap":
                yield x
            elif kind.startswith("conv"):
                _, _, stride, _, pad = kind.split()
                x = self._convolved(x, f"features.{number}", int(stride), int(pad))
            elif kind == "fire":
                x = self._fire(x, f"features.{number}")
            elif kind == "halve":
                x = F.max_pool2d(x, 2, 2)
            else:
                x = F.max_pool2d(x, 3, 2, ceil_mode=kind == "pool ceil")

    def _fire(self, x: Tensor, name: str) -> Tensor:
        squeezed = self._convolved(x, f"{name}.squeeze", 1, 0)
        return torch.cat(
            [
                self._convolved(squeezed, f"{name}.expand1x1", 1, 0),
                self._convolved(squeezed, f"{name}.expand3x3", 1, 1),
            ],
            dim=1,
        )

    def _convolved(self, x: Tensor, name: str, stride: int, pad: int) -> Tensor:
        weight, bias = self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]
        return F.conv2d(x, weight, bias, stride=stride, padding=pad).relu_()


def _unit(pixels: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
    """Each pixel's channels at length one."""
    return pixels / (pixels.square().sum(1, keepdim=True).sqrt() + _NORM_EPS)


class TargetActivations:
    """What the backbones give for a stack of targets: computed with the first use, then kept.

    A view takes 120 floats a pixel with VGG, 17 with AlexNet: hold few views at once.

    Args:
        images: the targets, in [0, 1].
    """

    def __init__(self, images: Float[Tensor, "n h w 3"]) -> None:
        self._images = images
        self._found: dict[LpipsNet, list[list[Tensor]]] = {}

    def of(self, lpips: Lpips) -> list[list[Float[Tensor, "m c hl wl"]]]:
        """Layer by layer, in the parts of `Lpips.in_parts`."""
        if lpips.net not in self._found:
            self._found[lpips.net] = [list(part) for part in lpips.in_parts(self._images)]
        return self._found[lpips.net]


LpipsByNet = Mapping[LpipsNet, Lpips | str]
"""LPIPS as it was asked for: by backbone the metric with its weights, or the reason why there are none."""


def available_lpips(config: EvaluateConfig | None = None) -> dict[LpipsNet, Lpips | str]:
    """LPIPS with each backbone that the settings ask for.

    Args:
        config: the backbones, and optionally where their weights are; None takes those of the profile
            `balanced`.

    Raises:
        WeightsError: when the settings name weights that cannot be used.
    """
    config = PROFILES[DEFAULT_PROFILE].evaluate if config is None else config
    found: dict[LpipsNet, Lpips | str] = {}
    for net in config.lpips_nets:
        try:
            found[net] = Lpips.load(config.lpips_weights, net)
        except WeightsError as error:
            if config.lpips_weights is not None:
                raise
            found[net] = str(error)
    return found
