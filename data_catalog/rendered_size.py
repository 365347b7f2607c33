"""The size in which a source that is rendered on request is rendered."""

from __future__ import annotations

from extrags.config import IngestConfig
from extrags.errors import ConfigError

__all__ = ["rendered_size"]

_SMALLEST_PX = 16


def rendered_size(config: IngestConfig, width: int, height: int) -> tuple[int, int]:
    """Width and height in pixels that the ingest settings ask for.

    Args:
        config: without a height, the proportion of the usual size is kept.
        width: the usual one.
        height: the usual one.

    Raises:
        ConfigError: for a height without a width, or a picture that is too small.
    """
    if config.width is not None:
        found = config.width, config.height or max(_SMALLEST_PX, round(config.width * height / width))
    elif config.height is not None:
        raise ConfigError("ingest.height needs ingest.width")
    else:
        downscale = config.downscale or 1
        found = width // downscale, height // downscale
    if min(found) < _SMALLEST_PX:
        raise ConfigError(
            f"an image of {found[0]} x {found[1]} pixels is too small; "
            f"expected at least {_SMALLEST_PX} x {_SMALLEST_PX}"
        )
    return found
