"""Other values of a setting: what depends on it is found by trying them."""

from __future__ import annotations

from typing import Any

from extrags.config.settings import Setting
from extrags.errors import ConfigError

__all__ = ["other_values"]

WORDS = (
    "true",
    "false",
    "none",
    "0",
    "1",
    "2",
    "3",
    "7",
    "24",
    "400",
    "0.1",
    "0.4",
    "0.7",
    "8,16,24",
    "vgg",
    "other",
)


def other_values(setting: Setting, value: Any) -> list[Any]:
    """Valid values of a setting that differ from a given one, each once: choices, counts and shares.

    Args:
        setting: which.
        value: that is left out.
    """
    candidates = [*setting.choices, *WORDS]
    if isinstance(value, int | float) and not isinstance(value, bool):
        candidates += [str(value // 2), str(value * 2), str(value / 2)]
    found: list[Any] = []
    for text in candidates:
        try:
            other = setting.parse(text)
        except ConfigError:
            continue
        if other != value and other not in found:
            found.append(other)
    return found
