"""Where networks and kernels of torch run: on a CUDA device, or on the processor."""

from __future__ import annotations

import torch

from extrags.errors import ConfigError

__all__ = ["chosen_device", "device_name"]


def chosen_device(value: str, setting: str) -> torch.device:
    """The device a setting means.

    Args:
        value: auto (cuda where there is one), cpu or cuda.
        setting: its dotted name, for the message.

    Raises:
        ConfigError: when cuda is asked for and there is none.
    """
    there = torch.cuda.is_available()
    if value == "cuda" and not there:
        raise ConfigError(f"{setting}=cuda, but torch sees no CUDA device; use auto or cpu")
    return torch.device("cuda" if there and value != "cpu" else "cpu")


def device_name(kind: str) -> str:
    """What a device is, as records of costs name it.

    Args:
        kind: cpu or cuda.

    Returns:
        `cpu`; of a GPU its name, or `cuda` where torch sees none.
    """
    if kind == "cpu" or not torch.cuda.is_available():
        return kind
    return str(torch.cuda.get_device_name())
