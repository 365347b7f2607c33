"""Learning the few numbers of the light without autograd: its row, the chain rule, Adam."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.config import LightConfig
from extrags.illumination import NearFieldLight
from extrags.raster.light import ROUGHNESS_MIN, ROW_LENGTH
from extrags.training.frame_colors import FrameColorFit

__all__ = [
    "BESIDE",
    "LOG_ROUGHNESS_BOUNDS",
    "DenseAdam",
    "LightFit",
    "drop_faint_glare",
    "lamp_distance",
    "learned_parameters",
    "learning_rate",
]

COMMON = (
    "log_softening",
    "log_exponent",
    "spread",
    "cosine",
    "offset",
    "log_shoulder",
    "log_specular",
    "log_roughness",
    "log_glare",
)
"""Parameters all cameras share, in the order of `CameraLight.packed`; the exposure comes before them."""
BESIDE = (1.0, 1.0, 0.0)
"""Which axes the lamp moves along: it stands beside the lens. Free along the optical axis as well, it leaves
the scope's tip by a tenth of the depth, since a fall-off that is off looks much the same."""
SMALLEST_OFFSET = 3e-3
"""Distances of the lamp from the lens, in reference distances, that are rounded off to zero."""
LOG_ROUGHNESS_BOUNDS = (math.log(ROUGHNESS_MIN) + 1e-3, -1e-3)
"""A learned roughness is kept inside those of the lobe: at them it has no gradient that brings it back."""


def learned_parameters(config: LightConfig) -> list[str]:
    """Names of the global light parameters that the settings leave free."""
    switches = {
        "log_softening": config.falloff,
        "log_exponent": config.falloff,
        "spread": config.spread,
        "cosine": config.cosine,
        "offset": config.offset,
        "log_shoulder": config.response,
        "log_specular": config.specular,
        "log_roughness": config.specular,
        "log_glare": config.glare,
    }
    return [name for name, free in switches.items() if free]


def learning_rate(name: str, config: LightConfig) -> float:
    """Of one of the parameters that all cameras share."""
    if name == "offset":
        return config.offset_learning_rate
    specular = name in ("log_specular", "log_roughness")
    return config.specular_learning_rate if specular else config.learning_rate


@torch.no_grad()
def drop_faint_glare(light: NearFieldLight, config: LightConfig) -> None:
    """Take glare away, in place and for good, where black would hardly show it (`config.glare_kept_from`).

    Args:
        light: whose tensors are being learned.
        config: has the bound.
    """
    if float(light.log_glare.exp().mean()) < config.glare_kept_from:
        light.log_glare.fill_(-math.inf)


def lamp_distance(offset: Float[Tensor, "3"]) -> Float[Tensor, ""]:
    """How far beside the lens the lamp stands, by which the loss holds it there; smooth at zero.

    Not its square, which would draw lamps that do stand beside the lens away from their place as well.

    Args:
        offset: of the light, in reference distances.
    """
    softened = offset.square().sum() + SMALLEST_OFFSET**2
    return softened.sqrt() - SMALLEST_OFFSET


class DenseAdam:
    """`torch.optim.Adam` for one short array, at the cost of a few numpy calls.

    Args:
        values: stepped in place, [N].
        learning_rate: of all entries, or of each.

    Source: Kingma & Ba, Adam, ICLR 2015.
    """

    BETAS = (0.9, 0.999)
    EPS = 1e-15

    def __init__(self, values: Float[np.ndarray, "n"], learning_rate: float | Float[np.ndarray, "n"]) -> None:
        self.values, self.learning_rate = values, learning_rate
        self._first, self._second = np.zeros_like(values), np.zeros_like(values)
        self._steps = 0

    def step(self, gradient: Float[np.ndarray, "n"], rate_share: float = 1.0) -> None:
        """One step at a share of the learning rate; entries whose gradient is always zero stay."""
        beta1, beta2 = self.BETAS
        self._steps += 1
        self._first += (1 - beta1) * (gradient - self._first)
        self._second *= beta2
        self._second += (1 - beta2) * gradient * gradient
        root = np.sqrt(self._second) / math.sqrt(1 - beta2**self._steps) + self.EPS
        self.values -= rate_share * self.learning_rate / (1 - beta1**self._steps) * self._first / root


@dataclass(frozen=True)
class _Slots:
    """Where a parameter lies among the common ones."""

    begin: int
    end: int
    logarithm: bool
    scalar: bool


class LightFit:
    """A near-field light while it is learned.

    Args:
        light: where to start; it is copied.
        config: what is learned, and how fast.
        colors: haze and balance of single frames, if they are learned; they are stepped too.
    """

    def __init__(
        self, light: NearFieldLight, config: LightConfig, colors: FrameColorFit | None = None
    ) -> None:
        self._config, self._colors = config, colors
        self._reference_distance = light.reference_distance
        values = light.parameters()
        self._slots: dict[str, _Slots] = {}
        parts = []
        begin = 0
        for name in COMMON:
            value = values[name].detach().float()
            part = value.reshape(-1)
            logarithm = name.startswith("log_")
            self._slots[name] = _Slots(begin, begin + len(part), logarithm, value.ndim == 0)
            begin += len(part)
            parts.append(part)
        # The tensors and the arrays below are the same memory.
        self._tensor, self._exposures = torch.cat(parts), values["log_exposure"].detach().float().clone()
        self._common, self._log_exposure = self._tensor.numpy(), self._exposures.numpy()
        self._logarithms = np.zeros(begin, dtype=bool)
        self._free = np.zeros(begin, dtype=np.float32)
        rates = np.zeros(begin, dtype=np.float32)
        learned = learned_parameters(config)
        for name, slots in self._slots.items():
            self._logarithms[slots.begin : slots.end] = slots.logarithm
            self._free[slots.begin : slots.end] = name in learned
            rates[slots.begin : slots.end] = learning_rate(name, config)
        offset = self._slots["offset"]
        self._offset = slice(offset.begin, offset.end)
        self._free[self._offset] *= BESIDE
        self._any_free = bool(self._free.any())
        self._row = np.zeros(ROW_LENGTH, dtype=np.float32)
        self._row[-1] = light.reference_distance
        self._frame: int | None = None
        self._adam = DenseAdam(self._common, rates)
        self._exposure_adam = DenseAdam(self._log_exposure, config.exposure_learning_rate)

    @property
    def light(self) -> NearFieldLight:
        """The light as it is now; it changes with the next step."""
        values = {
            name: self._tensor[slots.begin] if slots.scalar else self._tensor[slots.begin : slots.end]
            for name, slots in self._slots.items()
        }
        return NearFieldLight(
            **values, log_exposure=self._exposures, reference_distance=self._reference_distance
        )

    def row(self, frame: int | None) -> Float[np.ndarray, "17"]:
        """What the camera of a training frame carries; None is the mean exposure.

        Returns:
            A row of `CameraLight.packed`, overwritten by the next call.
        """
        self._frame = frame
        row = self._row
        exposures = self._log_exposure
        row[:3] = 1 if frame is None else math.exp(float(exposures[frame]) - self._mean(exposures))
        common = row[3:-1]
        common[:] = self._common
        # Whoever uses the row says so where it is not finite.
        with np.errstate(over="ignore"):
            np.exp(common, out=common, where=self._logarithms)
        return row if self._colors is None or frame is None else self._colors.applied(row, frame)

    @staticmethod
    def _mean(values: np.ndarray) -> float:
        return float(np.add.reduce(values, dtype=np.float64)) / len(values)

    def prior(self) -> float:
        """Terms of the loss: the lamp at the lens, log-exposures and balances of real frames near zero."""
        term = 0.0
        if self._config.offset:
            term = self._config.offset_prior * float(lamp_distance(self._tensor[self._offset]))
        if self._frame is None:
            return term
        exposures = self._log_exposure
        term += 0.0 if self._colors is None else self._colors.prior()
        return term + self._config.exposure_prior * float(exposures @ exposures) / len(exposures)

    def step(self, gradient: Float[np.ndarray, "17"], rate_share: float = 1.0) -> None:
        """Step what is learned.

        Args:
            gradient: of the loss without the priors, with respect to the last `row`.
            rate_share: of the settings' learning rates.
        """
        if self._colors is not None and self._frame is not None:
            gradient, own = self._colors.carried_back(gradient, self._row, self._frame)
            self._colors.step(own, self._frame, rate_share)
        if self._any_free:
            self._adam.step(self.common_gradient(gradient), rate_share)
        if self._config.specular:
            at = self._slots["log_roughness"].begin
            self._common[at] = np.clip(self._common[at], *LOG_ROUGHNESS_BOUNDS)
        if self._config.exposure and self._frame is not None:
            self._exposure_adam.step(self.exposure_gradient(gradient), rate_share)

    def common_gradient(self, gradient: Float[np.ndarray, "17"]) -> Float[np.ndarray, "13"]:
        """Gradient of the parameters all cameras share, with that of the prior; zero where not learned."""
        common: np.ndarray = gradient[3:-1] * self._free
        if self._config.offset and self._config.offset_prior > 0:
            offset = self._common[self._offset]
            softened = math.sqrt(float(offset @ offset) + SMALLEST_OFFSET**2)
            common[self._offset] += self._config.offset_prior / softened * offset * BESIDE
        np.multiply(common, self._row[3:-1], out=common, where=self._logarithms)
        return common

    def exposure_gradient(self, gradient: Float[np.ndarray, "17"]) -> Float[np.ndarray, "f"]:
        """Gradient of the log-exposures, that of the prior included; the last row was of a real frame."""
        count = len(self._log_exposure)
        carried = float(gradient[:3].sum()) * float(self._row[0])
        # Each exposure is taken relative to the mean of all.
        exposure: np.ndarray = (2 * self._config.exposure_prior / count) * self._log_exposure
        exposure -= carried / count
        exposure[self._frame] += carried
        return exposure
