"""From the pixels of a file to those of the sequence: lens undone, box cut out, shrunk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, UInt8

from data_catalog.images import Resampling
from extrags.config import IngestConfig
from extrags.lens import Lens, Undistortion, size_for_focal

__all__ = ["CameraModel", "LensSampling", "Sampling", "keeps_central_resolution"]


@runtime_checkable
class CameraModel(Protocol):
    """A camera as it was calibrated; hashable, so that frames of one camera share a sampling."""

    @property
    def width(self) -> int:
        """Image width in pixels."""

    @property
    def height(self) -> int:
        """Image height in pixels."""


@runtime_checkable
class Sampling(Protocol):
    """How everything that belongs to a frame is brought to the sequence's pinhole."""

    @property
    def K(self) -> Float[np.ndarray, "3 3"]:
        """Of the sequence's pinhole, pixel centres at +0.5."""

    @property
    def width(self) -> int:
        """Columns of the result."""

    @property
    def height(self) -> int:
        """Rows of the result."""

    def colour(
        self, image: UInt8[np.ndarray, "h w 3"], *, file: object = None, frame: object = None
    ) -> UInt8[np.ndarray, "h2 w2 3"]:
        """Averaged colours."""

    def mask(
        self, mask: Bool[np.ndarray, "h w"], *, file: object = None, frame: object = None
    ) -> Bool[np.ndarray, "h2 w2"]:
        """True where all that a pixel covers is true and was seen by the lens."""

    def depth(
        self, depth: Float[np.ndarray, "h w"], *, file: object = None, frame: object = None
    ) -> Float[np.ndarray, "h2 w2"]:
        """z-depth, never mixed across a fold; 0 stays unknown."""


def _enlarged_size(lens: Lens, config: IngestConfig, first: Sampling | None) -> tuple[int, int] | None:
    """Size at which a pinhole of the given field of view keeps the central resolution; None: the lens's."""
    if config.field_of_view_deg is None or not keeps_central_resolution(config):
        return None
    if isinstance(first, LensSampling):
        # Frames of several lenses share the first one's size.
        return first.resampling.source_width, first.resampling.source_height
    focal = float(np.sqrt(lens.K[0, 0] * lens.K[1, 1]))
    return size_for_focal(lens.width, lens.height, float(np.radians(config.field_of_view_deg)), focal)


def keeps_central_resolution(config: IngestConfig) -> bool:
    """Whether a pinhole wider than the source's centre allows grows instead of losing resolution."""
    return config.size == "central" and config.width is None and config.downscale is None


@dataclass(frozen=True)
class LensSampling:
    """A COLMAP lens undone at full size, then the crop and shrinking that all frames share.

    Args:
        undistortion: None for a pinhole, whose pixels are taken as they are.
        resampling: crop and size.
        K: of the result.
    """

    undistortion: Undistortion | None
    resampling: Resampling
    K: Float[np.ndarray, "3 3"]

    @classmethod
    def planned(
        cls,
        lens: Lens,
        config: IngestConfig,
        first: Sampling | None,
        *,
        usual_downscale: int = 1,
        box: tuple[int, int, int, int] | None = None,
    ) -> LensSampling:
        """Decide from the settings.

        Args:
            lens: of the images.
            config: `width` and `height`, or `downscale`, or `size`; `field_of_view_deg` where there is
                distortion.
            first: of the sequence's first lens, whose crop and size are kept; None for the first itself.
            usual_downscale: divisor of thumbnails.
            box: left, top, width and height to keep, in pixels; None keeps all.

        Raises:
            ConfigError: a size that the source cannot give.
        """
        undistortion = None
        width, height = lens.width, lens.height
        if not lens.is_pinhole:
            undistortion = Undistortion.planned(
                lens, config.field_of_view_deg, size=_enlarged_size(lens, config, first)
            )
            height, width = undistortion.valid.shape
        resampling = (
            first.resampling
            if isinstance(first, LensSampling)
            else Resampling.planned(width, height, config, usual_downscale, box)
        )
        if undistortion is None:
            return cls(None, resampling, resampling.intrinsics(lens.K))
        return cls(undistortion, resampling, resampling.intrinsics(undistortion.K))

    @property
    def width(self) -> int:
        """Columns of the result."""
        return self.resampling.width

    @property
    def height(self) -> int:
        """Rows of the result."""
        return self.resampling.height

    def colour(
        self, image: UInt8[np.ndarray, "h w 3"], *, file: object = None, frame: object = None
    ) -> UInt8[np.ndarray, "h2 w2 3"]:
        """Averaged colours; black where the lens saw nothing.

        Raises:
            SourceError: the image is not of the sequence's size.
        """
        straight = image if self.undistortion is None else self.undistortion.colour(image)
        return self.resampling.colour(straight, file=file, frame=frame)

    def mask(
        self, mask: Bool[np.ndarray, "h w"], *, file: object = None, frame: object = None
    ) -> Bool[np.ndarray, "h2 w2"]:
        """True where all that a pixel covers is true and was seen by the lens.

        Raises:
            SourceError: the mask is not of the sequence's size.
        """
        straight = mask if self.undistortion is None else self.undistortion.mask(mask)
        return self.resampling.mask(straight, file=file, frame=frame)

    def depth(
        self, depth: Float[np.ndarray, "h w"], *, file: object = None, frame: object = None
    ) -> Float[np.ndarray, "h2 w2"]:
        """z-depth, never mixed across a fold; 0 stays unknown.

        Raises:
            SourceError: the depth map is not of the sequence's size.
        """
        straight = depth if self.undistortion is None else self.undistortion.depth(depth)
        return self.resampling.depth(straight, file=file, frame=frame)
