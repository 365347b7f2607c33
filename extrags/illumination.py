"""Near-field light at the camera, and the camera's response, as learned parameters of a scene.

The model and its kernels are those of `extrags.raster.light`; this module holds the parameters: a few for the
whole scene and one exposure per training frame. Brightness and albedo are ambiguous up to a factor. Two
conventions fix it: the mean of the log-exposures is zero, and the gain of the light is one at the reference
distance on the optical axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrags.config import LightConfig
from extrags.errors import ShapeError
from extrags.raster.light import (
    COSINE_SOFTENING,
    SPREAD_MIN,
    CameraLight,
    add_glare,
    apply_response,
    invert_response,
    light_gain,
    remove_glare,
    specular_gain,
)
from extrags.zarr_io import new_group, open_group, read_array, write_array

__all__ = ["NearFieldLight"]

INITIAL_LOG_SOFTENING = -1.5
INITIAL_SPREAD = 0.5
INITIAL_COSINE = 0.5
INITIAL_LOG_SHOULDER = 0.0
INITIAL_SPECULAR = 0.1
INITIAL_ROUGHNESS = 0.2
INITIAL_GLARE = 0.02
"""Initial values of the parameters: moderate angular spread, partly Lambertian surfaces, a soft shoulder, a
faint and broad specular lobe, hardly any glare."""

SMOOTHED_FROM = 8
"""Training frames of a recording from which on their exposures tell whether they scatter."""
SMOOTHING = (1.0, 2.0, 4.0, 8.0, math.inf)
"""Standard deviations of means over several exposures, in steps between training frames."""
SMOOTHER = 0.9
"""Share of interpolation's squared error that a mean leaves at most, when training frames are left out."""

_LATER = ("log_specular", "log_roughness", "log_glare")
"""Parameters that lights of before there were highlights, or glare, do not have."""


@dataclass(frozen=True)
class NearFieldLight:
    """Global light parameters and the exposure of each training frame.

    Args:
        log_softening: logarithm of the softening c of the fall-off, scalar.
        log_exponent: logarithm of the fall-off exponent e, scalar.
        log_exposure: logarithm of the gain g_f of each training frame, [F_train]; mean zero.
        reference_distance: distance at which the gain of the light is one, in world units.
        spread: exponent k of the light's angular spread, scalar.
        cosine: exponent q of the cosine law at the surface, scalar.
        offset: position of the light in the camera frame, in reference distances, [3].
        log_shoulder: logarithm of the response's shoulder s, scalar; minus infinity is a linear response.
        log_specular: logarithm of the strength m of the specular lobe, scalar; minus infinity is none.
        log_roughness: logarithm of the lobe's roughness rho, scalar.
        log_glare: logarithm of the veiling glare v, one per colour, [3]; minus infinity is none.
    """

    log_softening: Float[Tensor, ""]
    log_exponent: Float[Tensor, ""]
    log_exposure: Float[Tensor, "f"]
    reference_distance: float
    spread: Float[Tensor, ""] = field(default_factory=lambda: torch.zeros(()))
    cosine: Float[Tensor, ""] = field(default_factory=lambda: torch.zeros(()))
    offset: Float[Tensor, "3"] = field(default_factory=lambda: torch.zeros(3))
    log_shoulder: Float[Tensor, ""] = field(default_factory=lambda: torch.tensor(-math.inf))
    log_specular: Float[Tensor, ""] = field(default_factory=lambda: torch.tensor(-math.inf))
    log_roughness: Float[Tensor, ""] = field(
        default_factory=lambda: torch.tensor(math.log(INITIAL_ROUGHNESS))
    )
    log_glare: Float[Tensor, "3"] = field(default_factory=lambda: torch.full((3,), -math.inf))

    @classmethod
    def initial(
        cls,
        n_frames: int,
        reference_distance: float,
        config: LightConfig | None = None,
    ) -> NearFieldLight:
        """Initial parameters: a softened power law of the distance, equal exposures.

        Args:
            n_frames: number of training frames.
            reference_distance: distance at which the gain of the light is one, in world units.
            config: which terms the model has; the parameters of the others keep values without effect.
        """
        config = LightConfig() if config is None else config
        return cls(
            torch.tensor(INITIAL_LOG_SOFTENING),
            torch.tensor(config.exponent if config.falloff else 0.0).log(),
            torch.zeros(n_frames),
            float(reference_distance),
            spread=torch.tensor(INITIAL_SPREAD if config.spread else 0.0),
            cosine=torch.tensor(INITIAL_COSINE if config.cosine else 0.0),
            log_shoulder=torch.tensor(INITIAL_LOG_SHOULDER if config.response else -math.inf),
            log_specular=torch.tensor(math.log(INITIAL_SPECULAR) if config.specular else -math.inf),
            log_glare=torch.full((3,), math.log(INITIAL_GLARE) if config.glare else -math.inf),
        )

    def camera_light(self, exposure: Float[Tensor, "c"]) -> CameraLight:
        """The light of C cameras with given exposure gains, as `rasterize` takes it."""
        return CameraLight(
            exposure[:, None].expand(-1, 3),
            self.log_softening.exp(),
            self.log_exponent.exp(),
            self.spread,
            self.cosine,
            self.offset,
            self.log_shoulder.exp(),
            self.reference_distance,
            self.log_specular.exp(),
            self.log_roughness.exp(),
            self.log_glare.exp(),
        )

    def exposure(self, frame: int | None) -> Float[Tensor, ""]:
        """Exposure gain of a training frame; None gives the mean exposure, which is 1."""
        if frame is None:
            return self.log_exposure.new_ones(())
        return (self.log_exposure[frame] - self.log_exposure.mean()).exp()

    def exposures(self) -> Float[Tensor, "f"]:
        """Exposure gains of all training frames, [F_train]."""
        return (self.log_exposure - self.log_exposure.mean()).exp()

    def interpolated_exposures(
        self,
        frames: Int[np.ndarray, "m"],
        train: Int[np.ndarray, "f"],
        recording: Int[np.ndarray, "n"] | None = None,
    ) -> Float[Tensor, "m"]:
        """Exposure gains of arbitrary frames, interpolated between training frames; no pixel is used.

        On the processor, wherever the light is.

        Automatic exposure changes slowly. Between training frames of the same recording the log-exposure is
        interpolated linearly over the frame index; before the first and after the last it is constant. Where
        leaving out one training frame after the other shows that a mean over several predicts them better,
        the exposures of single frames are scatter, and what lies between gets that mean. Training frames have
        their own exposure, and frames of a recording without any the mean one.

        Args:
            frames: indices of the frames in the sequence.
            train: indices of the training frames, in the order of `log_exposure`.
            recording: recording of every frame of the sequence; None for a single recording.

        Raises:
            ShapeError: when there is not one exposure for each training frame.
        """
        if len(self.log_exposure) != len(train):
            raise ShapeError(
                f"log_exposure has {len(self.log_exposure)} exposures, there are {len(train)} training frames"
            )
        owner = (
            np.zeros(int(max(frames.max(initial=0), train.max())) + 1, int)
            if recording is None
            else recording
        )
        logs = self.exposures().detach().log().cpu().double().numpy()
        result = np.zeros(len(frames))
        for which in np.unique(owner[train]):
            known, wanted = owner[train] == which, owner[frames] == which
            order = np.argsort(train[known], kind="stable")
            result[wanted] = _between(train[known][order], logs[known][order], frames[wanted])
        return torch.from_numpy(np.exp(result).astype(np.float32))

    def falloff(
        self,
        distance: Float[Tensor, "*b"],
        axis_cosine: Float[Tensor, "*b"] | None = None,
        facing_cosine: Float[Tensor, "*b"] | None = None,
    ) -> Float[Tensor, "*b"]:
        """Gain of a light at the optical centre (`offset` is ignored), at unit exposure; no highlights.

        Args:
            distance: from the optical centre, in world units.
            axis_cosine: cosine between the ray and the optical axis; None is on the axis.
            facing_cosine: cosine between the ray and the surface normal, of either sign; None assumes
                fronto-parallel surfaces.
        """
        softening = self.log_softening.exp()
        relative = (distance / self.reference_distance) ** 2
        gain = ((1 + softening) / (relative + softening)) ** self.log_exponent.exp()
        if axis_cosine is not None:
            gain = gain * axis_cosine.clamp_min(SPREAD_MIN) ** self.spread
        if facing_cosine is not None:
            facing = (facing_cosine.square() + COSINE_SOFTENING) / (1 + COSINE_SOFTENING)
            gain = gain * facing ** (0.5 * self.cosine)
        return gain

    def gain(
        self, points: Float[Tensor, "*b 3"], normals: Float[Tensor, "*b 3"] | None = None
    ) -> Float[Tensor, "*b"]:
        """Gain of the light at points, by which albedo is multiplied at unit exposure; no highlights.

        Args:
            points: in the camera frame, in world units.
            normals: unit surface normals in the camera frame; None assumes surfaces that face the light.
        """
        return light_gain(points, normals, self._row(points))

    def specular_gain(
        self, points: Float[Tensor, "*b 3"], normals: Float[Tensor, "*b 3"]
    ) -> Float[Tensor, "*b"]:
        """What highlights add to the signal, whatever the albedo, at unit exposure.

        Args:
            points: in the camera frame, in world units.
            normals: unit surface normals in the camera frame, of either sign.
        """
        return specular_gain(points, normals, self._row(points))

    def invert_response(self, rgb: Float[Tensor, "*b"], channel_axis: int = -1) -> Float[Tensor, "*b"]:
        """What surfaces send to the sensor, from image values in [0, 1].

        Glare is taken away and the camera response inverted; what is darker than the glare sends nothing.

        Args:
            rgb: image values.
            channel_axis: which axis has the three colours.
        """
        clear = remove_glare(rgb, self._glare(rgb, channel_axis))
        return invert_response(clear, self.log_shoulder.exp().to(rgb))

    def apply_response(self, signal: Float[Tensor, "*b"], channel_axis: int = -1) -> Float[Tensor, "*b"]:
        """Image values of what surfaces send to the sensor: the camera's response, and glare over it.

        Args:
            signal: the light from surfaces.
            channel_axis: which axis has the three colours.
        """
        clear = apply_response(signal, self.log_shoulder.exp().to(signal))
        return add_glare(clear, self._glare(signal, channel_axis))

    def _glare(self, like: Float[Tensor, "*b"], channel_axis: int) -> Tensor:
        shape = [1] * like.ndim
        shape[channel_axis] = 3
        return self.log_glare.exp().to(like).reshape(shape)

    def albedo(
        self,
        rgb: Float[Tensor, "n 3"],
        points: Float[Tensor, "n 3"],
        normals: Float[Tensor, "n 3"] | None = None,
        *,
        min_gain: float = 1e-3,
    ) -> Float[Tensor, "n 3"]:
        """Albedo from image values: response and glare are undone and the gain of the light divided out.

        Highlights are taken away where normals are given; without, nothing tells which surfaces have them.

        Args:
            rgb: image values in [0, 1], at unit exposure.
            points: the surface points they show, in the camera frame, in world units.
            normals: unit surface normals in the camera frame; None assumes surfaces that face the light.
            min_gain: lower bound of the gain, so that noise in dark regions is not amplified.
        """
        signal = self.invert_response(rgb)
        if normals is not None:
            signal = (signal - self.specular_gain(points, normals)[:, None]).clamp_min(0)
        return signal / self.gain(points, normals).clamp_min(min_gain)[:, None]

    def _row(self, like: Tensor) -> Float[Tensor, "17"]:
        return self.camera_light(self.log_exposure.new_ones(1)).packed()[0].to(like)

    def parameters(self) -> dict[str, Tensor]:
        """The learned tensors by name."""
        return {
            "log_softening": self.log_softening,
            "log_exponent": self.log_exponent,
            "spread": self.spread,
            "cosine": self.cosine,
            "offset": self.offset,
            "log_shoulder": self.log_shoulder,
            "log_specular": self.log_specular,
            "log_roughness": self.log_roughness,
            "log_glare": self.log_glare,
            "log_exposure": self.log_exposure,
        }

    def detached(self) -> NearFieldLight:
        """A copy without gradient history."""
        values = {k: v.detach().clone() for k, v in self.parameters().items()}
        return NearFieldLight(**values, reference_distance=self.reference_distance)

    def to(self, device: torch.device | str) -> NearFieldLight:
        """The same on a device; this very light where it is there already."""
        if self.log_exposure.device == torch.device(device):
            return self
        values = {k: v.to(device) for k, v in self.parameters().items()}
        return NearFieldLight(**values, reference_distance=self.reference_distance)

    def save(self, path: Path) -> None:
        """Write a zarr v3 group; from any device."""
        with new_group(path) as group:
            for name, value in self.parameters().items():
                write_array(group, name, value.detach().cpu().numpy())
            group.attrs["reference_distance"] = self.reference_distance

    @classmethod
    def load(cls, path: Path) -> NearFieldLight:
        """Read what `save` wrote, to the processor."""
        group = open_group(path)
        names = [name for name in cls.__dataclass_fields__ if name != "reference_distance"]
        names = [name for name in names if name in group or name not in _LATER]
        values = {name: torch.from_numpy(read_array(group, name)) for name in names}
        return cls(**values, reference_distance=float(group.attrs["reference_distance"]))  # type: ignore[arg-type]


def _between(
    train: Int[np.ndarray, "k"], logs: Float[np.ndarray, "k"], frames: Int[np.ndarray, "m"]
) -> Float[np.ndarray, "m"]:
    """Log-exposures of frames of one recording, from those of its training frames, which are in order."""
    found = np.asarray(np.interp(frames, train, logs))
    if len(train) < SMOOTHED_FROM:
        return found
    places, step = train.astype(np.float64), float(np.median(np.diff(train)))
    before, left, after = places[:-2], places[1:-1], places[2:]
    share = (left - before) / (after - before)
    predicted = (1 - share) * logs[:-2] + share * logs[2:]
    best, width = SMOOTHER * float(np.mean(np.square(logs[1:-1] - predicted))), 0.0
    for times in SMOOTHING:
        away = np.abs(places[:, None] - places) / (times * step)
        np.fill_diagonal(away, np.inf)
        error = float(np.mean(np.square(logs - _mean(logs, away))[1:-1]))
        if error < best:
            best, width = error, times * step
    if width == 0:
        return found
    others = ~np.isin(frames, train)
    inside = frames[others].clip(train[0], train[-1]).astype(np.float64)
    found[others] = _mean(logs, np.abs(inside[:, None] - places) / width)
    return found


def _mean(values: Float[np.ndarray, "k"], away: Float[np.ndarray, "m k"]) -> Float[np.ndarray, "m"]:
    """Means with the weights of a Gaussian of so many standard deviations; far from all, of the nearest."""
    weights = np.exp(-0.5 * (np.square(away) - np.square(away.min(1, keepdims=True))))
    # Not as a matrix product, whose rounding depends on the number of threads.
    return np.asarray((weights * values).sum(1) / weights.sum(1))
