"""Specular highlights and saturated pixels.

A mirror reflection of the light adds its own, nearly white colour to that of the tissue: it raises the
weakest channel, which on tissue is low and changes slowly. A pixel is part of a highlight when its weakest
channel stands out over its surroundings by more than the image's own texture does (a multiple of the median
absolute deviation, and a floor), and when its colour is clearly paler than theirs. The surroundings are a
median over a window, of which the brightest nearby counts: the lit side of a fold before a dark lumen is no
highlight. Regions grow from such pixels into neighbours that stand out half as much, and are dilated by the
width of a blurred rim.

Saturated pixels are told apart (`extrags.sequence.saturated_mask`): their true value is not known, whatever
shines there, and a simulated or overexposed wall may be saturated as a whole.

Source: the contrast to a median-filtered image with an image-dependent threshold follows Arnold et al.,
"Automatic segmentation and inpainting of specular highlights for endoscopic imaging", EURASIP Journal on
Image and Video Processing 2010; the weakest channel as the measure of the achromatic part follows the
dichromatic model (Tan and Ikeuchi, "Separating reflection components of textured surfaces using a single
image", PAMI 2005).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from extrags.events import Progress, emit
from extrags.frame_stacks import stacked
from extrags.sequence import EndoscopicSequence
from extrags.thresholds import SATURATED

__all__ = ["specular_mask", "specular_masks", "with_specular"]

_WINDOW_SHARE = 0.10
_DEVIATIONS = 8.0
_FLOOR = 36.0
_PALER = 1.15
_GROW_SHARE = 0.5
_RIM_SHARE = 0.004
_SURROUNDINGS_WIDTH = 320


def specular_mask(
    rgb: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"] | None = None
) -> Bool[np.ndarray, "h w"]:
    """Highlights of one image.

    Args:
        rgb: the image.
        mask: tissue; what lies outside neither counts for the threshold nor is marked.

    Returns:
        True on highlights.
    """
    import cv2

    height, width = rgb.shape[:2]
    inside = np.ones((height, width), dtype=bool) if mask is None else mask
    if not inside.any():
        return np.zeros((height, width), dtype=bool)
    # Several times as fast as a minimum over the last axis.
    red, green, blue = cv2.split(rgb)
    weakest, strongest = cv2.min(cv2.min(red, green), blue), cv2.max(cv2.max(red, green), blue)
    (median, around), (_, brightest) = _surroundings((weakest, strongest), inside)
    excess = weakest.astype(np.float32) - around
    texture = (weakest - median)[inside]
    spread = 1.4826 * float(np.median(np.abs(texture - np.median(texture))))
    threshold = max(_FLOOR, _DEVIATIONS * spread)
    # Paler than its surroundings: the weakest channel grew by more than the strongest, in proportion.
    paler = (weakest + 1.0) * (brightest + 1.0) > _PALER * (strongest + 1.0) * (around + 1.0)
    seed = (excess > threshold) & (paler | (weakest >= SATURATED)) & inside
    weak = (excess > _GROW_SHARE * threshold) & inside
    _, labels = cv2.connectedComponents(weak.astype(np.uint8), connectivity=8)
    found = np.isin(labels, np.setdiff1d(np.unique(labels[seed]), 0))
    rim = max(1, round(_RIM_SHARE * width))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * rim + 1, 2 * rim + 1))
    return np.asarray((cv2.dilate(found.astype(np.uint8), kernel) > 0) & inside)


def specular_masks(
    rgb: UInt8[np.ndarray, "f h w 3"], mask: Bool[np.ndarray, "f h w"]
) -> Bool[np.ndarray, "f h w"]:
    """`specular_mask` of each frame."""

    def found() -> Iterator[Bool[np.ndarray, "h w"]]:
        for index, (image, inside) in enumerate(zip(rgb, mask, strict=True), start=1):
            yield specular_mask(image, inside)
            emit(Progress("ingest", index, len(rgb)))

    return stacked(found(), len(rgb))


def with_specular(sequence: EndoscopicSequence) -> EndoscopicSequence:
    """The sequence with its highlights marked."""
    return replace(sequence, specular=specular_masks(sequence.rgb, sequence.mask))


def _surroundings(
    channels: tuple[UInt8[np.ndarray, "h w"], ...], inside: Bool[np.ndarray, "h w"]
) -> list[tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]]:
    """Of each channel the median over a window, and the brightest of them nearby.

    What lies outside the mask is filled by the nearest inside. Both vary slowly and are found at a small
    size, so that the work does not grow with the image.
    """
    import cv2
    from scipy.ndimage import distance_transform_edt

    height, width = inside.shape
    small_width = min(width, _SURROUNDINGS_WIDTH)
    size = (small_width, max(1, round(height * small_width / width)))
    # Pixels that the mask cuts count as outside.
    small_inside = cv2.resize(inside.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
    if not small_inside.any():
        blank = np.full(inside.shape, 255, dtype=np.float32)
        return [(blank, blank)] * len(channels)
    nearest = None
    if not small_inside.all():
        nearest = distance_transform_edt(~small_inside, return_distances=False, return_indices=True)
    window = max(3, round(_WINDOW_SHARE * small_width)) | 1
    nearby = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (window, window))
    surroundings = []
    for channel in channels:
        small = cv2.resize(channel, size, interpolation=cv2.INTER_AREA)
        if nearest is not None:
            small = np.ascontiguousarray(small[tuple(nearest)])
        median = cv2.medianBlur(small, window)
        found = [np.asarray(part, dtype=np.float32) for part in (median, cv2.dilate(median, nearby))]
        if size != (width, height):
            found = [cv2.resize(part, (width, height), interpolation=cv2.INTER_LINEAR) for part in found]
        surroundings.append((found[0], found[1]))
    return surroundings
