"""The backbones of LPIPS: their layers, and the names of their weights."""

from __future__ import annotations

from collections.abc import Mapping

from extrags.config import LpipsNet

__all__ = ["LAYERS", "array_names", "misshapen_array"]

_Step = tuple[str, int]
# Layers by torchvision's numbers; "tap" hands the current activation out.
LAYERS: dict[str, tuple[_Step, ...]] = {
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
    "vgg": (
        ("conv stride 1 pad 1", 0),
        ("conv stride 1 pad 1", 2),
        ("tap", 0),
        ("halve", 0),
        ("conv stride 1 pad 1", 5),
        ("conv stride 1 pad 1", 7),
        ("tap", 1),
        ("halve", 0),
        ("conv stride 1 pad 1", 10),
        ("conv stride 1 pad 1", 12),
        ("conv stride 1 pad 1", 14),
        ("tap", 2),
        ("halve", 0),
        ("conv stride 1 pad 1", 17),
        ("conv stride 1 pad 1", 19),
        ("conv stride 1 pad 1", 21),
        ("tap", 3),
        ("halve", 0),
        ("conv stride 1 pad 1", 24),
        ("conv stride 1 pad 1", 26),
        ("conv stride 1 pad 1", 28),
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


def array_names(net: LpipsNet) -> list[str]:
    """Names of the arrays that LPIPS needs: `features.N.weight`, `features.N.bias`; its heads `lin0`, ..."""
    names = []
    for kind, number in LAYERS[net]:
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


def misshapen_array(net: LpipsNet, shapes: Mapping[str, tuple[int, ...]]) -> str | None:
    """The first array that does not fit those before it; None where all do.

    Args:
        net: backbone.
        shapes: of all arrays of `array_names`. A convolution takes the channels that the one before it gives,
            has a bias for each of its own, and its head a weight.
    """
    channels = 3
    for kind, number in LAYERS[net]:
        if kind == "tap":
            if shapes[f"lin{number}"] != (channels,):
                return f"lin{number}"
        elif kind.startswith("conv"):
            wrong = _misshapen_convolution(f"features.{number}", channels, shapes)
            if wrong is not None:
                return wrong
            channels = shapes[f"features.{number}.weight"][0]
        elif kind == "fire":
            parts = {part: f"features.{number}.{part}" for part in ("squeeze", "expand1x1", "expand3x3")}
            for part, name in parts.items():
                given = channels if part == "squeeze" else shapes[f"{parts['squeeze']}.weight"][0]
                wrong = _misshapen_convolution(name, given, shapes)
                if wrong is not None:
                    return wrong
            channels = sum(shapes[f"{parts[part]}.weight"][0] for part in ("expand1x1", "expand3x3"))
    return None


def _misshapen_convolution(name: str, channels: int, shapes: Mapping[str, tuple[int, ...]]) -> str | None:
    weight = shapes[f"{name}.weight"]
    if len(weight) != 4 or weight[1] != channels:
        return f"{name}.weight"
    return None if shapes[f"{name}.bias"] == weight[:1] else f"{name}.bias"
