"""Images as data URIs, so that a page is one file."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Num, UInt8

from extrags.errors import ConfigError, NonFiniteError, ShapeError

__all__ = [
    "DataImage",
    "as_uint8",
    "color_bar",
    "color_mapped",
    "data_uri",
    "fitted_image",
    "outlined",
    "png_image",
]

LARGEST_WIDTH_PX = 480
"""Images stand five in a row: more pixels than this would not be seen."""
JPEG_QUALITIES = (92, 85, 75, 60)
SMALLEST_WIDTH_PX = 48
OUTSIDE_RGB = (228, 231, 235)
"""Pixels that do not count: a light grey that no colour map holds."""
UNSEEN_RGB = (90, 220, 235)
"""Surface that no training frame saw: a cyan that is neither in magma nor in grey images, for all eyes."""


@dataclass(frozen=True, slots=True)
class DataImage:
    """An image inside a page.

    Args:
        uri: `data:` URI.
        width: of the stored image in pixels; 0 for one without a size of its own.
        height: the same for the height.
    """

    uri: str
    width: int = 0
    height: int = 0


def data_uri(content: bytes, media_type: str) -> str:
    """Content as a base64 `data:` URI."""
    return f"data:{media_type};base64,{base64.b64encode(content).decode('ascii')}"


def as_uint8(image: Num[np.ndarray, "*b h w 3"]) -> UInt8[np.ndarray, "*b h w 3"]:
    """Colours as bytes: floats in [0, 1] are clipped and rounded, bytes pass through.

    Raises:
        ShapeError: for integers that are not bytes.
        NonFiniteError: for NaN or infinity.
    """
    if image.dtype == np.uint8:
        return image
    if not np.issubdtype(image.dtype, np.floating):
        raise ShapeError(f"an image must be uint8 or float, found {image.dtype}")
    if not np.isfinite(image).all():
        raise NonFiniteError("an image of the report holds NaN or infinity")
    return np.asarray(np.rint(np.clip(image.astype(np.float32), 0, 1) * 255).astype(np.uint8))


def png_image(image: UInt8[np.ndarray, "h w 3"]) -> DataImage:
    """A lossless image at its own size."""
    return DataImage(_encoded(_pillow(image), "PNG"), image.shape[1], image.shape[0])


def fitted_image(image: UInt8[np.ndarray, "h w 3"], largest_bytes: int) -> DataImage:
    """An image in at most so many bytes: lossless if that fits, else JPEG, else a smaller JPEG.

    Args:
        image: colours.
        largest_bytes: bound on the length of the URI.

    Raises:
        ConfigError: when not even a thumbnail fits.
    """
    from PIL import Image

    picture = _pillow(image)
    if picture.width > LARGEST_WIDTH_PX:
        height = max(1, round(picture.height * LARGEST_WIDTH_PX / picture.width))
        picture = picture.resize((LARGEST_WIDTH_PX, height), Image.Resampling.BOX)
    # A photograph takes about two bytes a pixel; larger ones need not be tried.
    lossless = 2 * picture.width * picture.height <= largest_bytes
    uri = _encoded(picture, "PNG") if lossless else ""
    while not 0 < len(uri) <= largest_bytes:
        for quality in JPEG_QUALITIES:
            # 4:4:4: mucosa differs in hue more than in lightness, chroma must not be halved.
            uri = _encoded(picture, "JPEG", quality=quality, subsampling=0)
            if len(uri) <= largest_bytes:
                break
        else:
            if picture.width <= SMALLEST_WIDTH_PX:
                raise ConfigError(
                    f"an image of the report has {largest_bytes} bytes at most, too few for a thumbnail; "
                    "show fewer views (report.held_out_views, report.virtual_views)"
                )
            width = max(SMALLEST_WIDTH_PX, picture.width * 3 // 4)
            picture = picture.resize(
                (width, max(1, round(picture.height * width / picture.width))), Image.Resampling.BOX
            )
    return DataImage(uri, picture.width, picture.height)


def color_mapped(
    values: Float[np.ndarray, "h w"],
    low: float | int,
    high: float | int,
    *,
    colormap: str = "magma",
    valid: Bool[np.ndarray, "h w"] | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """A map of numbers in colours; what is not valid or not finite becomes light grey.

    Args:
        values: the numbers.
        low: shown in the first colour, as is everything below.
        high: shown in the last colour, as is everything above.
        colormap: a matplotlib name.
        valid: pixels that count; all when None.
    """
    table = _color_table(colormap)
    shown = np.isfinite(values) if valid is None else np.isfinite(values) & valid
    share = (np.where(shown, values, low) - low) / max(high - low, 1e-12)
    index = np.rint(np.clip(share, 0, 1) * 255).astype(np.intp)
    return np.where(shown[..., None], table[index], np.array(OUTSIDE_RGB, dtype=np.uint8))


def color_bar(colormap: str) -> DataImage:
    """The colours of a map from left to right; to be stretched by the page."""
    return png_image(_color_table(colormap)[None])


def outlined(
    image: UInt8[np.ndarray, "h w 3"], region: Bool[np.ndarray, "h w"], rgb: tuple[int, int, int]
) -> UInt8[np.ndarray, "h w 3"]:
    """The image with the inner edge of a region drawn one pixel wide."""
    padded = np.pad(region, 1, mode="edge")
    inner = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return np.where((region & ~inner)[..., None], np.array(rgb, dtype=np.uint8), image)


def _color_table(colormap: str) -> UInt8[np.ndarray, "256 3"]:
    from matplotlib import colormaps

    table = colormaps[colormap](np.linspace(0, 1, 256))[:, :3]
    return np.asarray(np.rint(table * 255).astype(np.uint8))


def _pillow(image: np.ndarray) -> Any:
    from PIL import Image

    return Image.fromarray(np.ascontiguousarray(image))


def _encoded(picture: Any, kind: str, **options: Any) -> str:
    buffer = io.BytesIO()
    picture.save(buffer, kind, **options)
    return data_uri(buffer.getvalue(), f"image/{kind.lower()}")
