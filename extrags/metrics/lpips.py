"""LPIPS v0.1 with an AlexNet or SqueezeNet backbone, its weights read from one npz file.

Source: Zhang, Isola, Efros, Shechtman, Wang: The Unreasonable Effectiveness of Deep Features as a
Perceptual Metric, CVPR 2018, equation 1.

Values of different backbones are not comparable; state the network with every value. Much of the literature
on 3D Gaussians reports LPIPS-VGG.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.config import LpipsNet
from extrags.data_directories import weights_roots
from extrags.errors import ConfigError, ShapeError, WeightsError

__all__ = ["WEIGHTS_VARIABLE", "Lpips", "find_weights"]

WEIGHTS_VARIABLE = "EXTRAGS_LPIPS_WEIGHTS"
"""Environment variable: an npz file, or a folder that holds `lpips_<net>_v0.1.npz`."""

_Step = tuple[str, int]
# Layers by torchvision's numbers; "tap" hands the current activation out.
_STEPS: dict[str, tuple[_Step, ...]] = {
    "alex": (
        ("conv stride 4 pad 2", 0),
        ("tap", 0),
        ("pool", 0),
        ("conv stride 1 pad 2", 3),
        ("tap", 1),
        ("pool", 0),
        ("conv stride 1 pad 1", 6),
        ("tap", 2),
        ("conv stride 1 pad 1", 8),
        ("tap", 3),
        ("conv stride 1 pad 1", 10),
        ("tap", 4),
    ),
    "squeeze": (
        ("conv stride 2 pad 0", 0),
        ("tap", 0),
        ("pool ceil", 0),
        ("fire", 3),
        ("fire", 4),
        ("tap", 1),
        ("pool ceil", 0),
        ("fire", 6),
        ("fire", 7),
        ("tap", 2),
        ("pool ceil", 0),
        ("fire", 9),
        ("tap", 3),
        ("fire", 10),
        ("tap", 4),
        ("fire", 11),
        ("tap", 5),
        ("fire", 12),
        ("tap", 6),
    ),
}
_CHANNEL_SHIFT = (-0.030, -0.088, -0.188)
_CHANNEL_SCALE = (0.458, 0.448, 0.450)
_MIN_SIDE_PX = 32
_NORM_EPS = 1e-10
_IMAGES_AT_ONCE = 16


@dataclass(frozen=True)
class Lpips:
    """LPIPS with loaded weights.

    Args:
        net: backbone.
        weights: tensors by the names of the npz file.
    """

    net: LpipsNet
    weights: dict[str, Tensor]

    @classmethod
    def load(cls, path: str | Path | None = None, net: LpipsNet = "alex") -> Lpips:
        """Read the weights.

        Args:
            path: npz file, or None to look where `find_weights` looks.
            net: backbone.

        Raises:
            WeightsError: when there is no file, or it does not hold this network.
            ConfigError: for an unknown network.
        """
        file = find_weights(None if path is None else str(path), net)
        try:
            with np.load(file) as archive:
                weights = {name: torch.from_numpy(archive[name].astype(np.float32)) for name in archive.files}
        except (OSError, ValueError) as error:
            raise WeightsError(f"{file}: not a readable npz file ({error})") from error
        missing = [name for name in _expected_names(net) if name not in weights]
        if missing:
            raise WeightsError(
                f"{file}: not the weights of LPIPS with {net}; {missing[0]} "
                f"and {len(missing) - 1} more arrays are missing"
            )
        return cls(net, weights)

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
    ) -> dict[str, list[float | None]]:
        """LPIPS inside regions, from one pass of the network.

        Each layer's map is averaged with the share of the region in each of its cells as weight. For a region
        of all pixels this equals `distance`. Receptive fields extend beyond the region, like SSIM's window.

        Args:
            first: images in [0, 1].
            second: images in [0, 1].
            regions: pixels that count, by name.

        Returns:
            For each region one distance per pair; None where the region is empty.

        Raises:
            ShapeError: when the images differ in shape or are smaller than 32 px.
        """
        with torch.inference_mode():
            layers = self._layer_differences(first, second)
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

    def _layer_differences(self, first: Tensor, second: Tensor) -> list[Float[Tensor, "n hl wl"]]:
        if first.shape != second.shape or first.ndim < 3 or first.shape[-1] != 3:
            raise ShapeError(
                f"LPIPS compares images [..., H, W, 3]; found {tuple(first.shape)} and {tuple(second.shape)}"
            )
        if min(first.shape[-3:-1]) < _MIN_SIDE_PX:
            raise ShapeError(
                f"LPIPS needs images of at least {_MIN_SIDE_PX} px, found {first.shape[-2]}x{first.shape[-3]}"
            )
        firsts = first.reshape(-1, *first.shape[-3:])
        seconds = second.reshape(-1, *second.shape[-3:])
        # A few images at a time: the activations of a long stack would not fit into memory.
        parts = [
            self._differences_of_chunk(
                firsts[start : start + _IMAGES_AT_ONCE], seconds[start : start + _IMAGES_AT_ONCE]
            )
            for start in range(0, len(firsts), _IMAGES_AT_ONCE)
        ]
        if not parts:
            raise ShapeError("LPIPS needs at least one pair of images")
        return [torch.cat(layers) for layers in zip(*parts, strict=True)]

    def _differences_of_chunk(self, first: Tensor, second: Tensor) -> list[Tensor]:
        taps = self._activations(torch.cat([first, second]))
        layers = []
        for index, tap in enumerate(taps):
            unit = tap / (tap.square().sum(1, keepdim=True).sqrt() + _NORM_EPS)
            one, other = unit.chunk(2)
            head = self.weights[f"lin{index}"].reshape(1, -1, 1, 1)
            layers.append(((one - other).square() * head).sum(1))
        return layers

    def _activations(self, images: Float[Tensor, "n h w 3"]) -> list[Tensor]:
        shift = images.new_tensor(_CHANNEL_SHIFT)
        scale = images.new_tensor(_CHANNEL_SCALE)
        x = ((2 * images - 1 - shift) / scale).movedim(-1, 1).contiguous()
        taps = []
        for kind, number in _STEPS[self.net]:
            if kind == "tap":
                taps.append(x)
            elif kind.startswith("conv"):
                _, _, stride, _, pad = kind.split()
                x = self._convolved(x, f"features.{number}", int(stride), int(pad))
            elif kind == "fire":
                x = self._fire(x, f"features.{number}")
            else:
                x = F.max_pool2d(x, 3, 2, ceil_mode=kind == "pool ceil")
        return taps

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


def find_weights(explicit: str | None = None, net: LpipsNet = "alex") -> Path:
    """The npz file with LPIPS weights of a backbone.

    Looks, in this order, at the explicit path, at the environment variable `EXTRAGS_LPIPS_WEIGHTS`
    (each a file, or a folder that holds `lpips_<net>_v0.1.npz`), and at `extrags/lpips` in the user's
    data and cache directories (`extrags.data_directories`). A named path that does not exist is an error;
    later places are then not searched.

    Args:
        explicit: path the user named, or None.
        net: backbone.

    Raises:
        WeightsError: when there is none; says how to get them.
        ConfigError: for an unknown network.
    """
    if net not in _STEPS:
        raise ConfigError(f"no LPIPS network {net!r}; known: {', '.join(_STEPS)}")
    filename = f"lpips_{net}_v0.1.npz"
    for origin, text in (("the setting", explicit), (WEIGHTS_VARIABLE, os.environ.get(WEIGHTS_VARIABLE))):
        if text:
            file = Path(text).expanduser()
            file = file / filename if file.is_dir() else file
            if not file.is_file():
                raise WeightsError(f"LPIPS weights: {origin} names {file}, which does not exist")
            return file
    folders = weights_roots("lpips")
    for folder in folders:
        if (folder / filename).is_file():
            return folder / filename
    searched = " and no ".join(str(folder / filename) for folder in folders)
    raise WeightsError(
        f"no LPIPS weights for {net}: there is no {searched}. Convert the published LPIPS v0.1 weights to "
        "npz (features.N.weight, features.N.bias, lin0, lin1, ...) and put the file there, or name it, or "
        f"the folder that holds it, in {WEIGHTS_VARIABLE} or evaluate.lpips_weights"
    )


def _expected_names(net: LpipsNet) -> list[str]:
    names = []
    for kind, number in _STEPS[net]:
        if kind == "tap":
            names.append(f"lin{number}")
        elif kind.startswith("conv"):
            names += [f"features.{number}.weight", f"features.{number}.bias"]
        elif kind == "fire":
            names += [
                f"features.{number}.{part}.{what}"
                for part in ("squeeze", "expand1x1", "expand3x3")
                for what in ("weight", "bias")
            ]
    return names
