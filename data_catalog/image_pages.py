"""Image files that hold several pictures, of which only the first is read."""

from __future__ import annotations

import logging
from pathlib import Path

__all__ = ["pages_in", "tell_about_pages"]

logger = logging.getLogger(__name__)

_SUFFIXES = (".tif", ".tiff", ".webp", ".png")
"""Of a JPEG, further pictures are the camera's previews."""


def pages_in(file: Path) -> int:
    """Pictures in an image file, such as the pages of a TIFF; 1 of files that do not tell."""
    from PIL import Image

    if file.suffix.lower() not in _SUFFIXES:
        return 1
    try:
        with Image.open(file) as image:
            return int(getattr(image, "n_frames", 1))
    except Exception:  # what is damaged behind the first picture, which was read, says nothing
        return 1


def tell_about_pages(file: Path) -> None:
    """Warn where a file holds more than the picture that is read of it."""
    pages = pages_in(file)
    if pages > 1:
        logger.warning(
            "%s: %d pictures in the file, as pages or an animation; of each file the first is read",
            file,
            pages,
        )
