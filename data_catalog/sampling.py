"""From the pixels of a file to those of the sequence: lens undone or kept, box cut out, shrunk."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, UInt8

from data_catalog.resampling import Resampling
from extrags.cameras import field_mask
from extrags.config import IngestConfig
from extrags.errors import ConfigError, SourceError
from extrags.lens import Lens, Undistortion, keeps_central_resolution, pinhole_size, source_areas
from extrags.radial_lens import LensFit, RadialLens

__all__ = ["CameraModel", "LensSampling", "Sampling", "keeps_central_resolution", "source_areas"]

logger = logging.getLogger(__name__)

OFF_CENTRE_SHARE = 0.2
"""Of width and height: farther from the image's centre no principal point is expected."""
LARGEST_FIT_ERROR_PX = 1.0
"""A radial model that is farther from the calibrated lens, in pixels of the sequence, is refused: root mean
square over the image."""


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
    def radial_lens(self) -> RadialLens | None:
        """Of the sequence's images; None where they are a pinhole's."""

    @property
    def roll_rad(self) -> float:
        """Turn of the images about the axis, from right to down, against the axes of the source's poses."""

    @property
    def source_share(self) -> Float[np.ndarray, "h2 w2"]:
        """Share of the source's image that each pixel stands for; 0 where the source shows nothing."""

    @property
    def width(self) -> int:
        """Columns of the result."""

    @property
    def height(self) -> int:
        """Rows of the result."""

    def color(
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
    size = pinhole_size(lens, config)
    if size is not None and isinstance(first, LensSampling):
        # Frames of several lenses share the first one's size.
        return first.resampling.source_width, first.resampling.source_height
    return size


@dataclass(frozen=True)
class LensSampling:
    """A lens undone at full size or kept, then the crop and shrinking that all frames share.

    Args:
        undistortion: None where the source's pixels are taken as they are.
        resampling: crop and size.
        K: of the result.
        radial_lens: that was kept; None for a pinhole.
        roll_rad: turn of a kept lens's image about the axis.
    """

    undistortion: Undistortion | None
    resampling: Resampling
    K: Float[np.ndarray, "3 3"]
    radial_lens: RadialLens | None = None
    roll_rad: float = 0.0

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
            ConfigError: a size that the source cannot give, or that its several lenses cannot share.
        """
        undistortion = None
        width, height = lens.width, lens.height
        if config.lens == "native" and not lens.is_pinhole:
            resampling = Resampling.planned(width, height, config, usual_downscale, box)
            return cls.native(lens.radial, resampling, config, first)
        if not lens.is_pinhole:
            undistortion = Undistortion.planned(
                lens, config.field_of_view_deg, size=_enlarged_size(lens, config, first)
            )
            height, width = undistortion.valid.shape
        elif isinstance(first, LensSampling):
            first.check_shared_with(lens, config)
        resampling = (
            first.resampling
            if isinstance(first, LensSampling)
            else Resampling.planned(width, height, config, usual_downscale, box)
        )
        if undistortion is None:
            return cls(None, resampling, resampling.intrinsics(lens.K))
        return cls(undistortion, resampling, resampling.intrinsics(undistortion.K))

    @classmethod
    def native(
        cls,
        fit: Callable[[], LensFit],
        resampling: Resampling,
        config: IngestConfig,
        first: Sampling | None,
    ) -> LensSampling:
        """Keep the pixels of a wide lens.

        Args:
            fit: of a radial model to the source's.
            resampling: crop and size of the sequence's first lens.
            config: must ask for no pinhole.
            first: of the sequence's first lens; None for the first itself.

        Raises:
            ConfigError: when a pinhole's field of view is asked for.
            SourceError: when the model is too far from the lens, or frames have several lenses.
        """
        if config.field_of_view_deg is not None:
            raise ConfigError(
                "ingest.lens=native keeps the lens's own field: leave ingest.field_of_view_deg out"
            )
        found = fit()
        scale = resampling.width / resampling.crop_width
        logger.info(
            "lens kept up to %.1f degrees from its axis: the radial model is at most %.2f px from the "
            "source's, %.2f px in the root mean square",
            np.degrees(found.lens.max_angle_rad),
            found.error_px * scale,
            found.rms_px * scale,
        )
        if found.rms_px * scale > LARGEST_FIT_ERROR_PX:
            raise SourceError(
                f"a radial model is {found.rms_px * scale:.2f} px from this lens in the root mean square, "
                f"expected at most {LARGEST_FIT_ERROR_PX:g}; take ingest.lens=pinhole",
                field="lens",
            )
        if first is not None and first.radial_lens != found.lens:
            raise SourceError(
                "frames of several lenses cannot keep their pixels; take ingest.lens=pinhole", field="lens"
            )
        return cls(None, resampling, resampling.intrinsics(found.K), found.lens, found.roll_rad)

    def check_shared_with(self, pinhole: Lens, config: IngestConfig) -> None:
        """Refuse frames of a pinhole beside those of a lens whose pinhole was enlarged: these share no size.

        Raises:
            ConfigError: names both sizes, and the settings.
        """
        sizes = self.resampling
        wider = self.undistortion is not None and config.field_of_view_deg is not None
        enlarged = wider and keeps_central_resolution(config)
        if not enlarged or (pinhole.width, pinhole.height) == (sizes.source_width, sizes.source_height):
            return
        raise ConfigError(
            f"frames of a pinhole keep their {pinhole.width} x {pinhole.height} pixels, and those of a "
            f"distorted lens, which come first, become {sizes.source_width} x {sizes.source_height} by "
            "ingest.size=central and ingest.field_of_view_deg; give ingest.width or ingest.downscale, or "
            "leave the field of view out"
        )

    @cached_property
    def source_share(self) -> Float[np.ndarray, "h2 w2"]:
        """Share of the source's image that each pixel stands for; 0 where the source shows nothing."""
        sizes = self.resampling
        if self.undistortion is None:
            cropped = sizes.crop_width * sizes.crop_height / (sizes.source_width * sizes.source_height)
            return np.full((self.height, self.width), cropped / (self.width * self.height))
        plan = self.undistortion
        share = source_areas(plan.u, plan.v) * plan.valid / plan.valid.size
        share = share[sizes.top : sizes.top + sizes.crop_height, sizes.left : sizes.left + sizes.crop_width]
        import cv2

        mean = cv2.resize(share, (self.width, self.height), interpolation=cv2.INTER_AREA)
        return np.asarray(mean * (share.size / (self.width * self.height)))

    @property
    def width(self) -> int:
        """Columns of the result."""
        return self.resampling.width

    @property
    def height(self) -> int:
        """Rows of the result."""
        return self.resampling.height

    def color(
        self, image: UInt8[np.ndarray, "h w 3"], *, file: object = None, frame: object = None
    ) -> UInt8[np.ndarray, "h2 w2 3"]:
        """Averaged colours; black where the lens saw nothing.

        Raises:
            SourceError: the image is not of the sequence's size.
        """
        straight = image if self.undistortion is None else self.undistortion.color(image)
        return self.resampling.color(straight, file=file, frame=frame)

    def mask(
        self, mask: Bool[np.ndarray, "h w"], *, file: object = None, frame: object = None
    ) -> Bool[np.ndarray, "h2 w2"]:
        """True where all that a pixel covers is true and was seen by the lens.

        Raises:
            SourceError: the mask is not of the sequence's size.
        """
        straight = mask if self.undistortion is None else self.undistortion.mask(mask)
        shrunk = self.resampling.mask(straight, file=file, frame=frame)
        if self.radial_lens is None:
            return shrunk
        return np.asarray(shrunk & field_mask(self.K, self.radial_lens, self.width, self.height))

    def depth(
        self, depth: Float[np.ndarray, "h w"], *, file: object = None, frame: object = None
    ) -> Float[np.ndarray, "h2 w2"]:
        """z-depth, never mixed across a fold; 0 stays unknown.

        Raises:
            SourceError: the depth map is not of the sequence's size.
        """
        straight = depth if self.undistortion is None else self.undistortion.depth(depth)
        return self.resampling.depth(straight, file=file, frame=frame)
