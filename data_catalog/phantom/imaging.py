r"""Light and sensor of the phantom, deliberately richer than any light model of a reconstruction.

Two small lamps sit left and right of the lens. A lamp with intensity :math:`I` sends to a wall point
at distance :math:`r`, :math:`\beta` off the lamp's axis,

.. math:: E = I \, \frac{\cos^p \beta}{r^2} \, V, \qquad
          L = E \left(\frac{a}{\pi} \cos\alpha + f_s(\alpha)\right) + L_\text{around}

with shadows :math:`V`, a GGX lobe :math:`f_s` of the wet surface (bent by the texture's relief) and
light that came by way of the surrounding wall. The sensor multiplies by exposure, vignetting and white
balance, adds shot and read noise, and applies a tone curve with a shoulder before it rounds to 8 bits.

Source: GGX after Walter et al., "Microfacet models for refraction through rough surfaces", EGSR 2007;
the shadowing term is the Schlick approximation used with it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from data_catalog.phantom.config import PhantomConfig, stream
from data_catalog.phantom.variation import Variation, vary

__all__ = ["LightPair", "Sensor", "recording_sensor"]


@dataclass(frozen=True)
class LightPair:
    """The lamps, in camera coordinates."""

    offsets_mm: tuple[tuple[float, float, float], ...] = ((-2.9, 0.4, 0.3), (2.9, 0.4, 0.3))
    intensities: tuple[float, ...] = (1.0, 0.86)
    """Relative; one fibre bundle is a little weaker."""
    angular_exponent: float = 1.8
    """p: the lamps shine less to the side."""
    around: float = 0.11
    """Share of light that comes back from the surrounding wall."""
    specular_reflectance: float = 0.035
    """At normal incidence, of a water film."""
    specular_roughness: float = 0.13
    """alpha of GGX."""

    @classmethod
    def of(cls, variation: Variation) -> LightPair:
        """The lamps of a scene."""
        standard = cls()
        factor = variation.lamp_offset
        return cls(
            tuple((factor * x, factor * y, factor * z) for x, y, z in standard.offsets_mm),
            (standard.intensities[0], variation.lamp_balance),
            variation.lamp_exponent,
            variation.around,
            standard.specular_reflectance * variation.specular,
            variation.specular_roughness,
        )

    def radiance(
        self,
        to_camera: Float[np.ndarray, "n 3"],
        to_lights: list[Float[np.ndarray, "n 3"]],
        light_cosines: list[Float[np.ndarray, "n"]],
        visible: list[Bool[np.ndarray, "n"]],
        normal: Float[np.ndarray, "n 3"],
        shading_normal: Float[np.ndarray, "n 3"],
        albedo: Float[np.ndarray, "n 3"],
        wetness: Float[np.ndarray, "n"],
        *,
        speculars: bool,
    ) -> Float[np.ndarray, "n 3"]:
        """Light sent from wall points to the camera, linear, unit exposure.

        Args:
            to_camera: unit vectors from the wall to the lens.
            to_lights: for each lamp, vectors from the wall to it, in mm (not unit).
            light_cosines: for each lamp, cosine between its axis and the ray to the wall point.
            visible: for each lamp, false in shadow.
            normal: unit normals of the wall.
            shading_normal: the same bent by the relief.
            albedo: linear reflectance.
            wetness: multiplies the specular lobe.
            speculars: false leaves the lobe out.
        """
        total = np.zeros_like(albedo)
        around = np.zeros(len(albedo), dtype=np.float32)
        for lamp, intensity in enumerate(self.intensities):
            offset = to_lights[lamp]
            squared = np.maximum(_dot(offset, offset), 1.0)
            direction = offset / np.sqrt(squared)[:, None]
            incident = intensity * np.clip(light_cosines[lamp], 0, None) ** self.angular_exponent / squared
            around += incident
            lit = incident * visible[lamp]
            cosine = np.clip(_dot(shading_normal, direction), 0, None)
            # The relief must not light what the wall itself turns away from the lamp.
            cosine = cosine * _terminator(_dot(normal, direction))
            total += (lit * cosine)[:, None] * albedo / np.pi
            if speculars:
                lobe = self._specular(direction, to_camera, shading_normal) * wetness * cosine
                total += (lit * lobe)[:, None]
        # Light that bounced once more took the colour of the wall once more.
        tint = albedo * albedo / albedo.max(axis=1, keepdims=True)
        return np.asarray(total + self.around * around[:, None] * tint / np.pi)

    def _specular(
        self,
        to_light: Float[np.ndarray, "n 3"],
        to_camera: Float[np.ndarray, "n 3"],
        normal: Float[np.ndarray, "n 3"],
    ) -> Float[np.ndarray, "n"]:
        half = to_light + to_camera
        half = half / np.sqrt(_dot(half, half))[:, None]
        n_half = np.clip(_dot(normal, half), 0, 1)
        n_light = np.clip(_dot(normal, to_light), 1e-3, 1)
        n_camera = np.clip(_dot(normal, to_camera), 1e-3, 1)
        squared = self.specular_roughness**2
        spread = squared / (np.pi * (n_half**2 * (squared - 1) + 1) ** 2)
        k = self.specular_roughness / 2
        masking = 1 / ((n_light * (1 - k) + k) * (n_camera * (1 - k) + k))
        fresnel = (
            self.specular_reflectance
            + (1 - self.specular_reflectance) * (1 - np.clip(_dot(to_light, half), 0, 1)) ** 5
        )
        return np.asarray(spread * masking * fresnel / 4)

    def as_json(self) -> dict[str, Any]:
        """For the ground truth."""
        return asdict(self)


@dataclass(frozen=True)
class Sensor:
    """From radiance to 8 bits, for one recording.

    Args:
        gain: radiance to linear signal; 1 is where the tone curve's shoulder is well bent.
        white_balance: factors for red, green and blue.
        drift: relative standard deviation of the exposure between frames.
        noise: whether the sensor is noisy.
    """

    gain: float
    white_balance: tuple[float, float, float]
    drift: float
    noise: bool
    full_well_electrons: float = 9000.0
    read_noise_electrons: float = 9.0
    vignetting: float = 0.22
    gamma: float = 1.95

    def exposure(self, rng: np.random.Generator) -> float:
        """Exposure of one frame, drawn before its noise."""
        return float(1 + self.drift * np.clip(rng.standard_normal(), -2.5, 2.5))

    def develop(
        self, radiance: Float[np.ndarray, "h w 3"], exposure: float, rng: np.random.Generator
    ) -> UInt8[np.ndarray, "h w 3"]:
        """The 8-bit image of a frame."""
        height, width = radiance.shape[:2]
        y = (np.arange(height) + 0.5) / height * 2 - 1
        x = (np.arange(width) + 0.5) / width * 2 - 1
        corner = (y[:, None] ** 2 * height**2 + x[None, :] ** 2 * width**2) / (height**2 + width**2)
        signal = radiance * (exposure * self.gain * (1 - self.vignetting * corner))[..., None]
        signal = signal * np.asarray(self.white_balance)
        if self.noise:
            electrons = signal * self.full_well_electrons
            sigma = np.sqrt(np.maximum(electrons, 0) + self.read_noise_electrons**2)
            electrons = electrons + sigma * rng.standard_normal(signal.shape)
            signal = electrons / self.full_well_electrons
        return np.asarray(np.round(255 * self.tone(signal)), dtype=np.uint8)

    def tone(self, signal: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
        """Linear signal to display value in [0, 1]: a shoulder, then a power law."""
        positive = np.clip(signal, 0, None)
        return np.asarray(np.clip(1 - np.exp(-1.25 * positive), 0, 1) ** (1 / self.gamma))

    def as_json(self) -> dict[str, Any]:
        """For the ground truth."""
        return asdict(self)


def recording_sensor(config: PhantomConfig, recording: int, scene_gain: float) -> Sensor:
    """The sensor's settings for a recording: exposure and white balance differ between recordings."""
    rng = stream(config.scene, "exposure", recording)
    factor = 1 + config.exposure_spread * rng.uniform(-1, 1)
    balance = 1 + config.white_balance_spread * rng.uniform(-1, 1, 3)
    variation = vary(config)
    return Sensor(
        scene_gain * factor * variation.brightness,
        (float(balance[0]), float(balance[1]), float(balance[2])),
        config.exposure_drift,
        config.noise,
        vignetting=variation.vignetting,
        gamma=variation.gamma,
    )


def _dot(first: Float[np.ndarray, "n 3"], second: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    return np.asarray(np.einsum("ij,ij->i", first, second))


def _terminator(cosine: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    return np.asarray(np.clip(cosine / 0.05, 0, 1))
