"""The smallest size that keeps the detail of a source's frames.

Footage is often larger than what it shows: enlarged by a capture card, out of focus, or coarsely rendered.
Of a few frames it is measured what is lost when they are shrunk (by areas, as ingest does) and enlarged again
(bicubically). Noise counts as detail, so that noisy frames keep their size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from data_catalog.dataset import Dataset, Source
from extrags.config import IngestConfig
from extrags.sequence import EndoscopicSequence

__all__ = ["DIVISORS", "DetailSize", "detail_size", "kept_psnr_db", "source_detail"]

DIVISORS = (1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 4.0)
"""Of width and height that are tried, up to the first that loses too much."""

FRAMES = 8
"""Frames that are measured, spread evenly."""

SMALLEST_WIDTH = 160
"""Frames are not made narrower."""

_EDGE_PX = 5
"""Pixels at the border of the mask are left out: what lies beyond it is mixed into them."""

_LOSSLESS_DB = 99.0
"""Stands for the PSNR of frames that come back as they were."""


@dataclass(frozen=True)
class DetailSize:
    """The size that keeps the detail of frames.

    Args:
        width: of the frames as they are, in pixels.
        height: in pixels.
        divisor: of both; 1 where every smaller size loses too much.
        kept_psnr_db: of the frames shrunk by it and enlarged again against the frames; infinite for 1.
        next_psnr_db: the same for the next divisor, which loses too much; None where there is none.
    """

    width: int
    height: int
    divisor: float
    kept_psnr_db: float
    next_psnr_db: float | None

    @property
    def reduced_width(self) -> int:
        """Width in pixels that keeps the detail."""
        return round(self.width / self.divisor)

    @property
    def reduced_height(self) -> int:
        """Height in pixels that keeps the detail."""
        return round(self.height / self.divisor)

    def applied_to(self, config: IngestConfig) -> IngestConfig:
        """The settings that read frames of this size."""
        width = None if self.divisor == 1 else self.reduced_width
        return config.model_copy(update={"size": "source", "width": width})

    def __str__(self) -> str:
        if self.divisor == 1:
            lost = "" if self.next_psnr_db is None else f": the next smaller keeps {self.next_psnr_db:.1f} dB"
            return f"detail of all {self.width} x {self.height} px{lost}"
        kept = f"no more detail than {self.reduced_width} x {self.reduced_height} px hold"
        return f"{kept} ({self.kept_psnr_db:.1f} dB of {self.width} x {self.height})"


def detail_size(sequence: EndoscopicSequence, limit_db: float) -> DetailSize:
    """Measure the smallest size that keeps the detail of a sequence's frames.

    Args:
        sequence: at most `FRAMES` of its frames are looked at.
        limit_db: median PSNR over frames, of them shrunk and enlarged against them, that is kept at least.
    """
    positions = np.unique(np.linspace(0, len(sequence) - 1, FRAMES).round().astype(int))
    divisor, kept = 1.0, float("inf")
    for candidate in DIVISORS:
        if sequence.width / candidate < SMALLEST_WIDTH:
            return DetailSize(sequence.width, sequence.height, divisor, kept, None)
        losses = [kept_psnr_db(sequence.rgb[k], sequence.mask[k], candidate) for k in positions]
        found = float(np.median(losses))
        if found < limit_db:
            return DetailSize(sequence.width, sequence.height, divisor, kept, found)
        divisor, kept = candidate, found
    return DetailSize(sequence.width, sequence.height, divisor, kept, None)


def kept_psnr_db(rgb: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], divisor: float) -> float:
    """PSNR of a frame that was shrunk and enlarged again, against the frame, inside its mask.

    Args:
        rgb: the frame.
        mask: its valid pixels.
        divisor: of width and height.

    Returns:
        Decibels; at most 99, which stands for no loss, as it does for a frame without a valid pixel.
    """
    import cv2

    height, width = mask.shape
    size = max(1, round(width / divisor)), max(1, round(height / divisor))
    shrunk = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    back = cv2.resize(shrunk, (width, height), interpolation=cv2.INTER_CUBIC)
    # Beyond the image nothing is mixed in: its border is not eroded.
    inside = cv2.erode(mask.astype(np.uint8), np.ones((_EDGE_PX, _EDGE_PX), np.uint8)) > 0
    lost: Float[np.ndarray, "n 3"] = (rgb[inside].astype(np.float32) - back[inside]) / 255
    if not lost.size:
        return _LOSSLESS_DB
    return float(min(_LOSSLESS_DB, -10 * np.log10(max(float(np.square(lost).mean()), 1e-12))))


def source_detail(dataset: Dataset, source: Source, config: IngestConfig) -> DetailSize | None:
    """The size that keeps the detail of a source, from a few frames of its full size.

    Args:
        dataset: that reads the source.
        source: to be read.
        config: a width or a divisor that it gives decides instead of the detail.

    Returns:
        None unless the settings ask for that size (`ingest.size=detail`).

    Raises:
        SourceError: as reading does.
        ConfigError: as reading does.
    """
    if config.size != "detail" or config.width is not None or config.downscale is not None:
        return None
    few = min(FRAMES, config.max_frames or FRAMES)
    frames = dataset.read(source, config.model_copy(update={"size": "source", "max_frames": few}))
    return detail_size(frames, config.detail_psnr_db)
