"""What a video processor makes of a picture: tone curve, colour, sharpening, compression, interlace.

Exposure, vignetting, noise and the first tone curve are those of `data_catalog.phantom.imaging.Sensor`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from data_catalog.phantom.imaging import Sensor

__all__ = ["Processor", "random_sensor"]

_BRIGHTEST = 5.0
"""Of a linear signal of one: above, a sensor is full, so that a glint lights no more than its pixel."""


def random_sensor(rng: np.random.Generator, gain: float) -> Sensor:
    """A sensor with its tone curve; some are noisy."""
    noisy = rng.random() < 0.25
    balance = np.exp(rng.normal(0, 0.04, 3))
    return Sensor(
        gain,
        (float(balance[0]), float(balance[1]), float(balance[2])),
        0.0,
        True,
        full_well_electrons=float(rng.uniform(800, 3000) if noisy else rng.uniform(4000, 16000)),
        read_noise_electrons=float(rng.uniform(4, 12)),
        vignetting=float(rng.uniform(0.0, 0.55)),
        gamma=float(rng.uniform(1.6, 2.35)),
    )


@dataclass(frozen=True)
class Processor:
    """The look of a recording.

    Args:
        saturation: factor of the colours' distance from grey.
        contrast: strength of an S-shaped curve.
        black: level that black is lifted to.
        sharpening: strength of unsharp masking.
        sharpening_px: its radius.
        defocus_px: standard deviation of the lens's blur.
        quality: of JPEG; 0 is none.
        halved_color: whether colour is stored at half the resolution.
        shake_px: length of the longest motion blur.
        interlace_px: how far the odd rows of a frame are behind; 0 is none.
        drift: standard deviation of the exposure's logarithm from frame to frame.
        automatic: how far exposure follows what is seen, 0 to 1.
    """

    saturation: float
    contrast: float
    black: float
    sharpening: float
    sharpening_px: float
    defocus_px: float
    quality: int
    halved_color: bool
    shake_px: float
    interlace_px: int
    drift: float
    automatic: float

    @classmethod
    def random(cls, rng: np.random.Generator) -> Processor:
        """A processor; flaws fall independently."""
        return cls(
            saturation=float(rng.uniform(0.9, 1.4)),
            contrast=float(rng.uniform(-0.1, 0.45)),
            black=float(rng.uniform(0, 0.02)),
            sharpening=float(rng.uniform(0.0, 1.1)) * bool(rng.random() < 0.7),
            sharpening_px=float(rng.uniform(0.6, 1.4)),
            defocus_px=float(rng.uniform(0.1, 0.6)) if rng.random() < 0.85 else float(rng.uniform(0.6, 1.1)),
            quality=int(rng.integers(35, 93)) if rng.random() < 0.6 else 0,
            halved_color=bool(rng.random() < 0.7),
            shake_px=float(rng.uniform(0.5, 3.0)) if rng.random() < 0.3 else 0.0,
            interlace_px=int(rng.integers(1, 3)) if rng.random() < 0.04 else 0,
            drift=float(rng.choice([0.0, 0.015, 0.05])),
            automatic=float(rng.uniform(0.2, 0.9)) if rng.random() < 0.3 else 0.0,
        )

    def picture(
        self,
        radiance: Float[np.ndarray, "h w 3"],
        sensor: Sensor,
        exposure: float,
        rng: np.random.Generator,
        *,
        clean: bool,
    ) -> UInt8[np.ndarray, "h w 3"]:
        """The 8-bit image of a frame.

        Args:
            radiance: linear, unit exposure.
            sensor: with or without noise.
            exposure: of this frame, relative to the mean.
            rng: source of the frame's flaws.
            clean: leaves out motion, interlace and compression; colour, tone and sharpness stay.
        """
        import cv2

        light = np.minimum(radiance, _BRIGHTEST / (sensor.gain * exposure)).astype(np.float32)
        if self.defocus_px > 0.15:
            light = cv2.GaussianBlur(light, (0, 0), self.defocus_px, borderType=cv2.BORDER_REPLICATE)
        if not clean and self.shake_px > 0:
            light = _shaken(light, self.shake_px * rng.uniform(0, 1), rng.uniform(0, np.pi))
        image = sensor.develop(light, exposure, rng).astype(np.float32) / 255
        image = self._graded(image)
        if not clean and self.interlace_px:
            columns = np.arange(image.shape[1]) - int(rng.choice([-1, 1])) * self.interlace_px
            image[1::2] = image[1::2, np.clip(columns, 0, image.shape[1] - 1)]
        picture = np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)
        return picture if clean or not self.quality else self._compressed(picture)

    def _graded(self, image: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
        import cv2

        grey = (image @ np.array([0.299, 0.587, 0.114], dtype=np.float32))[..., None]
        image = np.clip(grey + self.saturation * (image - grey), 0, 1)
        curved = image * image * (3 - 2 * image)
        image = image + self.contrast * (curved - image)
        if self.sharpening > 0:
            soft = cv2.GaussianBlur(image, (0, 0), self.sharpening_px, borderType=cv2.BORDER_REPLICATE)
            image = image + self.sharpening * (image - soft)
        return np.asarray(self.black + (1 - self.black) * np.clip(image, 0, 1), dtype=np.float32)

    def _compressed(self, picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        import cv2

        factor = (
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420
            if self.halved_color
            else cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
        )
        settings = [cv2.IMWRITE_JPEG_QUALITY, self.quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, factor]
        _, data = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), settings)
        decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
        return np.ascontiguousarray(np.asarray(decoded)[..., ::-1], dtype=np.uint8)


def _shaken(light: Float[np.ndarray, "h w 3"], length_px: float, angle: float) -> Float[np.ndarray, "h w 3"]:
    import cv2

    taps = 5
    kernel = np.zeros((9, 9), dtype=np.float32)
    for share in np.linspace(-0.5, 0.5, taps):
        x, y = 4 + share * length_px * np.cos(angle), 4 + share * length_px * np.sin(angle)
        column, row = int(x), int(y)
        a, b = x - column, y - row
        kernel[row : row + 2, column : column + 2] += np.outer([1 - b, b], [1 - a, a]) / taps
    return np.asarray(cv2.filter2D(light, -1, kernel, borderType=cv2.BORDER_REPLICATE), dtype=np.float32)
