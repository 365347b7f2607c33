"""Straight from a fisheye image to an ideal pinhole: one grid for all frames. Or the fisheye's own pixels.

Colour is averaged over each new pixel's footprint (as many bicubic samples as the largest footprint has
source pixels), so that shrinking does not alias and the corners, which the pinhole stretches, do not blur.
Depth is taken along the new pixel's central ray: z-depth does not change from one model to the other, as both
share their axes. A new pixel is valid when all of its footprint lies inside the valid part of the source.

Vignetting is not corrected: the falling off towards the corners (about a fifth for this endoscope) stays in
the picture, and grows a little into it, since the corners are cut. It is part of what the light model sees.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from data_catalog.c3vd.scaramuzza import ScaramuzzaCamera
from data_catalog.resampling import Resampling
from data_catalog.sampling import LensSampling, Sampling, keeps_central_resolution, source_areas
from extrags.cameras import unproject_pixels
from extrags.config import IngestConfig
from extrags.errors import SourceError
from extrags.lens import sample_depth, size_for_focal
from extrags.radial_lens import RadialLens

__all__ = ["USUAL_FIELD_OF_VIEW_DEG", "USUAL_WIDTH", "PinholeResampling", "own_pixels"]

logger = logging.getLogger(__name__)

USUAL_FIELD_OF_VIEW_DEG = 100.0
"""Nearly the widest pinhole of 5 : 4 that the published lenses fill to its edges."""
USUAL_WIDTH = 225
"""Of thumbnails (`ingest.size`): the whole divisor that comes nearest to this."""

_LARGEST_SUPERSAMPLE = 16
_REACH_PX = 2
"""A bicubic sample takes colours from pixels so far from the one that it lies in."""


@dataclass(frozen=True)
class PinholeResampling:
    """The grid of one fisheye and one pinhole; made once, used for every frame.

    Args:
        camera: of the source images.
        K: of the pinhole, pixel centres at +0.5, [3, 3].
        width: of the pinhole's image.
        height: of the pinhole's image.
        supersample: samples per new pixel and axis.
        centres: source pixel (column, row; centres at integers) of each new pixel's centre, NaN beyond the
            lens, [H, W, 2].
        samples: the same for the samples of the colours, float32, -1 beyond the lens, [H * s, W * s, 2].
        inside: where all of a pixel's footprint lies in the source image, [H, W].
    """

    camera: ScaramuzzaCamera
    K: Float[np.ndarray, "3 3"]
    width: int
    height: int
    supersample: int
    centres: Float[np.ndarray, "h w 2"]
    samples: Float[np.ndarray, "hs ws 2"]
    inside: Bool[np.ndarray, "h w"]

    @classmethod
    def planned(cls, camera: ScaramuzzaCamera, config: IngestConfig) -> PinholeResampling:
        """Decide size and field of view from the settings.

        Args:
            camera: of the source images.
            config: `width`, `height`, `downscale` or `size`, and `field_of_view_deg`.

        Raises:
            ConfigError: a size that the source cannot give.
        """
        usual_divisor = max(1, round(camera.width / USUAL_WIDTH))
        size = Resampling.planned(camera.width, camera.height, config, usual_divisor)
        width, height = size.width, size.height
        angle = np.radians(config.field_of_view_deg or USUAL_FIELD_OF_VIEW_DEG)
        if keeps_central_resolution(config):
            # On the axis the fisheye resolves a0 pixels per radian, as a pinhole of that focal length does.
            width, height = size_for_focal(camera.width, camera.height, angle, camera.a0)
        focal = width / 2 / np.tan(angle / 2)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
        resolution = focal / camera.a0
        logger.info(
            "pinhole of %d x %d pixels, %.0f degrees wide: %.2f of the central resolution of the source",
            width,
            height,
            np.degrees(angle),
            resolution,
        )
        return cls.to_pinhole(camera, K, width, height)

    @classmethod
    def to_pinhole(
        cls, camera: ScaramuzzaCamera, K: Float[np.ndarray, "3 3"], width: int, height: int
    ) -> PinholeResampling:
        """The grid for a given pinhole with the fisheye's axes."""
        centres = _source_pixels(camera, K, width, height, 1)
        steps = [np.linalg.norm(np.diff(centres, axis=axis), axis=2) for axis in (0, 1)]
        largest = max((float(np.nanmax(step)) for step in steps if np.isfinite(step).any()), default=1.0)
        supersample = int(np.clip(np.ceil(largest), 1, _LARGEST_SUPERSAMPLE))
        samples = centres if supersample == 1 else _source_pixels(camera, K, width, height, supersample)
        with np.errstate(invalid="ignore"):
            within = (
                (samples[..., 0] >= 0)
                & (samples[..., 1] >= 0)
                & (samples[..., 0] <= camera.width - 1)
                & (samples[..., 1] <= camera.height - 1)
            )
        stored = np.where(np.isfinite(samples), samples, -1).astype(np.float32)
        return cls(camera, K, width, height, supersample, centres, stored, _all_of_block(within, supersample))

    @property
    def radial_lens(self) -> RadialLens | None:
        """None: the result is a pinhole's."""
        return None

    @property
    def roll_rad(self) -> float:
        """None is left: the grid has the axes of the poses."""
        return 0.0

    @property
    def source_share(self) -> Float[np.ndarray, "h w"]:
        """Share of the source's image that each pixel stands for; 0 where the source shows nothing."""
        areas = source_areas(self.centres[..., 0], self.centres[..., 1])
        return np.asarray(areas * self.inside / (self.camera.width * self.camera.height))

    def color(
        self, image: UInt8[np.ndarray, "h w 3"], *, file: object = None, frame: object = None
    ) -> UInt8[np.ndarray, "h2 w2 3"]:
        """Colours averaged over each new pixel's footprint; what lies outside the source repeats its edge.

        Raises:
            SourceError: the image is not of the camera's size.
        """
        import cv2

        self._check_size(image, "rgb", file, frame)
        fine = cv2.remap(
            image,
            self.samples,
            None,
            interpolation=cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        )
        if self.supersample == 1:
            return np.asarray(fine)
        return np.asarray(cv2.resize(fine, (self.width, self.height), interpolation=cv2.INTER_AREA))

    def depth(
        self, depth_mm: Float[np.ndarray, "h w"], *, file: object = None, frame: object = None
    ) -> Float[np.ndarray, "h2 w2"]:
        """z-depth along each new pixel's central ray, float32, never mixed across a fold.

        Where the four source pixels around are known and close, their inverse depth is interpolated;
        elsewhere the nearest value is taken. 0 is unknown, before and after.

        Raises:
            SourceError: the depth map is not of the camera's size.
        """
        self._check_size(depth_mm, "depth", file, frame)
        column, row = self.centres[..., 0], self.centres[..., 1]
        with np.errstate(invalid="ignore"):
            within = (
                (column > -0.5)
                & (row > -0.5)
                & (column < self.camera.width - 0.5)
                & (row < self.camera.height - 0.5)
            )
        result = np.zeros(within.shape, dtype=np.float32)
        # Half a pixel: the source's centres lie at integers.
        result[within] = sample_depth(depth_mm, column[within] + 0.5, row[within] + 0.5)
        return result

    def mask(
        self, mask: Bool[np.ndarray, "h w"], *, file: object = None, frame: object = None
    ) -> Bool[np.ndarray, "h2 w2"]:
        """True where the footprint, and all that its interpolation reaches, is true and in the source image.

        Raises:
            SourceError: the mask is not of the camera's size.
        """
        import cv2

        self._check_size(mask, "mask", file, frame)
        kernel = np.ones((2 * _REACH_PX + 1, 2 * _REACH_PX + 1), np.uint8)
        # The image border takes nothing away: colours repeat it.
        clear = cv2.erode(mask.astype(np.uint8), kernel) > 0
        column = np.clip(np.rint(self.samples[..., 0]).astype(int), 0, self.camera.width - 1)
        row = np.clip(np.rint(self.samples[..., 1]).astype(int), 0, self.camera.height - 1)
        return np.asarray(self.inside & _all_of_block(clear[row, column], self.supersample))

    def _check_size(self, array: np.ndarray, field: str, file: object, frame: object) -> None:
        if array.shape[:2] != (self.camera.height, self.camera.width):
            raise SourceError(
                f"{array.shape[1]} x {array.shape[0]} pixels; "
                f"expected {self.camera.width} x {self.camera.height} as in the first frame",
                file=file,
                frame=frame,
                field=field,
            )


def own_pixels(camera: ScaramuzzaCamera, config: IngestConfig, first: Sampling | None) -> LensSampling:
    """The fisheye's images as they are, with a radial lens fitted to its model.

    Args:
        camera: of the source images.
        config: `width`, `height`, `downscale` or `size`.
        first: of the sequence's first camera; None for the first itself.

    Raises:
        ConfigError: a size that the source cannot give, or a pinhole's field of view.
        SourceError: when no radial lens is near enough, or frames have several lenses.
    """
    divisor = max(1, round(camera.width / USUAL_WIDTH))
    resampling = Resampling.planned(camera.width, camera.height, config, divisor)
    return LensSampling.native(camera.radial, resampling, config, first)


def _source_pixels(
    camera: ScaramuzzaCamera, K: Float[np.ndarray, "3 3"], width: int, height: int, supersample: int
) -> Float[np.ndarray, "hs ws 2"]:
    """Fisheye pixels of a regular grid of points in the pinhole's image."""
    u = (np.arange(width * supersample) + 0.5) / supersample
    v = (np.arange(height * supersample) + 0.5) / supersample
    return camera.project(unproject_pixels(np.stack(np.meshgrid(u, v), axis=-1), K))


def _all_of_block(fine: Bool[np.ndarray, "hs ws"], block: int) -> Bool[np.ndarray, "h w"]:
    rows, columns = fine.shape[0] // block, fine.shape[1] // block
    return np.asarray(fine.reshape(rows, block, columns, block).all(axis=(1, 3)))
