"""One crop and resize, applied to everything that belongs to a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from extrags.config import IngestConfig
from extrags.errors import ConfigError, SourceError
from extrags.lens import resized_depth

__all__ = ["Resampling"]


@dataclass(frozen=True)
class Resampling:
    """Crop a box out of an image, then shrink it; the same for everything that belongs to a frame.

    Args:
        source_width: size of the images on disk.
        source_height: size of the images on disk.
        left: first column kept.
        top: first row kept.
        crop_width: columns kept.
        crop_height: rows kept.
        width: columns of the result.
        height: rows of the result.
    """

    source_width: int
    source_height: int
    left: int
    top: int
    crop_width: int
    crop_height: int
    width: int
    height: int

    @classmethod
    def planned(
        cls,
        source_width: int,
        source_height: int,
        config: IngestConfig,
        usual_downscale: int = 1,
        box: tuple[int, int, int, int] | None = None,
    ) -> Resampling:
        """Decide crop and size from the settings.

        A whole divisor crops the few columns and rows that do not fill a block of pixels, right and bottom.

        Args:
            source_width: size of the images on disk.
            source_height: size of the images on disk.
            config: `width` and `height`, or `downscale`, or `size`.
            usual_downscale: divisor of thumbnails.
            box: left, top, width and height to keep; None keeps all.

        Raises:
            ConfigError: a size that is larger than the source, too small, or of another proportion.
        """
        left, top, crop_width, crop_height = box or (0, 0, source_width, source_height)
        if config.width is None:
            if config.height is not None:
                raise ConfigError("ingest.height needs ingest.width")
            divisor = config.downscale or (usual_downscale if config.size == "thumbnail" else 1)
            width, height = crop_width // divisor, crop_height // divisor
            crop_width, crop_height = width * divisor, height * divisor
        else:
            width = config.width
            proportional = crop_height * width / crop_width
            height = config.height or round(proportional)
            if abs(height - proportional) > max(1.0, 0.02 * proportional):
                raise ConfigError(
                    f"ingest.width = {width} and ingest.height = {height} would squeeze an image of "
                    f"{crop_width} x {crop_height} pixels; give the width alone ({round(proportional)} rows)"
                )
        if width > crop_width or height > crop_height:
            raise ConfigError(
                f"{width} x {height} pixels is larger than the source's {crop_width} x {crop_height}"
            )
        if width < 16 or height < 16:
            raise ConfigError(f"an image of {width} x {height} pixels is too small; expected 16 x 16 or more")
        return cls(source_width, source_height, left, top, crop_width, crop_height, width, height)

    def intrinsics(self, K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
        """K of the result; pixel edges stay where they are (centres at +0.5)."""
        moved = K.copy()
        moved[0, 2] -= self.left
        moved[1, 2] -= self.top
        moved[0] *= self.width / self.crop_width
        moved[1] *= self.height / self.crop_height
        return moved

    def color(
        self, image: UInt8[np.ndarray, "h w 3"], *, file: object = None, frame: object = None
    ) -> UInt8[np.ndarray, "h2 w2 3"]:
        """Area-averaged colours.

        Raises:
            SourceError: the image is not of the sequence's size.
        """
        import cv2

        crop = self._cropped(image, "rgb", file, frame)
        return np.asarray(cv2.resize(crop, (self.width, self.height), interpolation=cv2.INTER_AREA))

    def mask(
        self, mask: Bool[np.ndarray, "h w"], *, file: object = None, frame: object = None
    ) -> Bool[np.ndarray, "h2 w2"]:
        """True where every source pixel below is true.

        Raises:
            SourceError: the mask is not of the sequence's size.
        """
        import cv2

        crop = self._cropped(mask, "mask", file, frame).astype(np.float32)
        share = cv2.resize(crop, (self.width, self.height), interpolation=cv2.INTER_AREA)
        return np.asarray(share > 0.999)

    def depth(
        self, depth: Float[np.ndarray, "h w"], *, file: object = None, frame: object = None
    ) -> Float[np.ndarray, "h2 w2"]:
        """Depth at the new pixel centres, never mixed across a fold.

        Where the four neighbours are known and close, their inverse depth is interpolated (exact on a
        plane); elsewhere the nearest value is taken. 0 stays unknown.

        Raises:
            SourceError: the depth map is not of the sequence's size.
        """
        crop = self._cropped(depth, "depth", file, frame)
        if (self.width, self.height) == (self.crop_width, self.crop_height):
            # The new pixels are the old ones: the same numbers, in a fortieth of the time.
            return crop.astype(np.float32)
        return resized_depth(crop, self.width, self.height).astype(np.float32)

    def _cropped(self, array: np.ndarray, field: str, file: object, frame: object) -> np.ndarray:
        if array.shape[:2] != (self.source_height, self.source_width):
            raise SourceError(
                f"{array.shape[1]} x {array.shape[0]} pixels; "
                f"expected {self.source_width} x {self.source_height} as in the first frame",
                file=file,
                frame=frame,
                field=field,
            )
        return array[self.top : self.top + self.crop_height, self.left : self.left + self.crop_width]
