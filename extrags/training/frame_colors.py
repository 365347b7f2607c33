"""Haze and white balance of single training frames, learned together with the Gaussians and the light.

Smoke, or a lens that is fogged, takes a share of a frame's light and scatters some of its own over the image;
automatic white balance changes the gain of each colour from frame to frame. The light model has a value for
both: a frame's haze h adds to the veiling glare, as squares, and its balance multiplies the exposure of each
colour. Balance is taken relative to the mean of all frames and of the three colours, which are the scene's
own colours and the frame's exposure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from extrags.errors import ShapeError
from extrags.frame_stacks import FrameStack
from extrags.illumination import NearFieldLight
from extrags.raster.light import CameraLight
from extrags.sequence import EndoscopicSequence
from extrags.store.storable import Storable
from extrags.zarr_io import new_group, open_group, read_array, write_array

__all__ = ["FrameColorFit", "FrameColors", "colored", "with_corrected_colors"]

INITIAL_HAZE = 0.02
"""What black shows at the start; from .05 a haze is learned faster, and clear frames lose more."""
LEAST_HAZE = 1e-3
"""A learned haze stays above: at zero it has no gradient that brings it back."""
HAZE_KEPT_FROM = 0.1
"""What black shows, from which haze is kept: clear frames learn up to .08."""
BALANCE_KEPT_FROM = 0.03
"""Root mean square of the logarithms of gains, from which balance is kept: steady ones learn .01 to .02."""
RATES = (0.015, 0.01, 0.01, 0.01)
"""Learning rates of haze and of the logarithms of the gains."""
BALANCE_PRIOR = 0.1
"""Weight of the mean square of these logarithms."""
BETAS = (0.9, 0.99)
"""A frame is drawn once in an epoch: its own Adam must not remember longer than that lasts."""
EPSILON = 1e-15


@dataclass(frozen=True)
class FrameColors(Storable):
    """Haze and white balance of the frames that a scene was trained on.

    Args:
        haze: what black shows of each frame beside the glare that all have, [M]; 0 is none.
        log_balance: logarithms of the gains of each frame's colours, [M, 3].
    """

    stored_as: ClassVar[str] = "frame_colors"

    haze: Float[np.ndarray, "m"]
    log_balance: Float[np.ndarray, "m 3"]

    def save(self, path: Path) -> None:
        """Write a zarr v3 group."""
        with new_group(path) as group:
            write_array(group, "haze", self.haze)
            write_array(group, "log_balance", self.log_balance)

    @classmethod
    def load(cls, path: Path) -> FrameColors:
        """Read what `save` wrote."""
        group = open_group(path)
        return cls(read_array(group, "haze"), read_array(group, "log_balance"))

    def developed(
        self, rgb: UInt8[np.ndarray, "h w 3"], position: int, light: NearFieldLight
    ) -> UInt8[np.ndarray, "h w 3"]:
        """A frame as it would be without its haze and at the mean white balance.

        Args:
            rgb: the frame.
            position: among those that the scene was trained on.
            light: of the scene.
        """
        image = torch.from_numpy(rgb.astype(np.float32) / 255)
        clear = (image.square() - float(self.haze[position]) ** 2).clamp_min(0).sqrt()
        signal = light.invert_response(clear)
        gain = torch.from_numpy(np.exp(self.log_balance[position]).astype(np.float32))
        # What is darker than the glare of the scene is no light from a surface.
        shown = torch.where(signal > 0, light.apply_response(signal / gain), clear)
        return np.asarray(np.rint(255 * shown.detach().clamp(0, 1).numpy()).astype(np.uint8))


class FrameColorFit:
    """Haze and balance of each training frame, while they are learned.

    `step` is Adam (Kingma & Ba, ICLR 2015) with moments of its own for each frame.

    Args:
        count: number of training frames.
    """

    def __init__(self, count: int) -> None:
        self._values = np.zeros((count, 4), dtype=np.float32)
        self._values[:, 0] = INITIAL_HAZE
        self._learned = np.ones((count, 4), dtype=bool)
        self._first, self._second = np.zeros((2, count, 4), dtype=np.float32)
        self._steps = np.zeros(count, dtype=np.int64)

    def log_balance(self) -> Float[np.ndarray, "f 3"]:
        """Logarithms of the gains, relative to the mean of all frames and of the colours."""
        return _centered(self._values[:, 1:])

    def applied(self, row: Float[np.ndarray, "17"], frame: int) -> Float[np.ndarray, "17"]:
        """The light of a frame's camera (`CameraLight.packed`), from that of one without haze."""
        found = row.copy()
        found[:3] *= np.exp(self.log_balance()[frame])
        found[13:16] = np.sqrt(row[13:16] ** 2 + self._values[frame, 0] ** 2)
        return found

    def carried_back(
        self, gradient: Float[np.ndarray, "17"], row: Float[np.ndarray, "17"], frame: int
    ) -> tuple[Float[np.ndarray, "17"], Float[np.ndarray, "f 4"]]:
        """From the gradient of `applied` to those of the row and of what is learned, with the prior's.

        Args:
            gradient: of the loss.
            row: as it was given to `applied`.
            frame: that was given too.
        """
        shown = self.applied(row, frame)
        before = gradient.copy()
        before[:3] *= np.exp(self.log_balance()[frame])
        share = np.divide(1, shown[13:16], out=np.zeros(3, np.float32), where=shown[13:16] > 0)
        before[13:16] *= row[13:16] * share
        own = np.zeros_like(self._values)
        own[frame, 0] = float((gradient[13:16] * share).sum()) * self._values[frame, 0]
        own[frame, 1:] = gradient[:3] * shown[:3]
        own[:, 1:] = _centered(own[:, 1:])
        own[:, 1:] += (2 * BALANCE_PRIOR / self._values[:, 1:].size) * self._values[:, 1:]
        return before, own

    def prior(self) -> float:
        """Term of the loss that holds the gains near one."""
        return BALANCE_PRIOR * float(np.square(self._values[:, 1:], dtype=np.float64).mean())

    def leaf(self) -> Float[Tensor, "f 4"]:
        """What is learned, for autograd."""
        return torch.from_numpy(self._values.copy()).requires_grad_()

    def step(self, gradient: Float[np.ndarray, "f 4"], frame: int, rate_share: float = 1.0) -> None:
        """Step what is learned of a frame, at a share of the learning rates."""
        beta1, beta2 = BETAS
        own = gradient[frame] * self._learned[frame]
        self._steps[frame] += 1
        self._first[frame] += (1 - beta1) * (own - self._first[frame])
        self._second[frame] += (1 - beta2) * (own * own - self._second[frame])
        root = np.sqrt(self._second[frame] / (1 - beta2 ** self._steps[frame])) + EPSILON
        mean = self._first[frame] / (1 - beta1 ** self._steps[frame])
        moved = self._values[frame] - rate_share * np.array(RATES, np.float32) * mean / root
        moved[0] = np.clip(moved[0], LEAST_HAZE, 1)
        self._values[frame] = np.where(self._learned[frame], moved, self._values[frame])

    def decide(self) -> None:
        """Take away, for good, haze of frames that have hardly any, and balance that hardly changes."""
        clear = self._values[:, 0] < HAZE_KEPT_FROM
        self._values[clear, 0] = 0
        self._learned[clear, 0] = False
        if np.sqrt(np.square(self.log_balance()).mean()) < BALANCE_KEPT_FROM:
            self._values[:, 1:] = 0
            self._learned[:, 1:] = False

    def found(self) -> FrameColors | None:
        """What was found; None where that is nothing."""
        if not self._values.any():
            return None
        return FrameColors(self._values[:, 0].copy(), self.log_balance())


def colored(light: CameraLight, values: Float[Tensor, "f 4"], frame: int) -> CameraLight:
    """`FrameColorFit.applied` of one camera's light, for autograd.

    Args:
        light: of one camera.
        values: `FrameColorFit.leaf`, on the light's device.
        frame: position of the training frame.
    """
    balance = values[:, 1:] - values[:, 1:].mean(0)
    balance = balance - balance.mean(1, keepdim=True)
    squares = light.glare.square() + values[frame, 0].square()
    # The root has no slope at zero.
    glare = torch.where(squares > 0, torch.where(squares > 0, squares, 1).sqrt(), 0)
    return replace(light, exposure=light.exposure * balance[frame].exp(), glare=glare)


def with_corrected_colors(
    sequence: EndoscopicSequence, colors: FrameColors, light: NearFieldLight
) -> EndoscopicSequence:
    """The sequence, its training frames without the haze and balance that a reconstruction has found.

    Held-out frames stay as they are.

    Args:
        sequence: whose training frames, in order, were trained on.
        colors: of these.
        light: of the scene that was trained.

    Raises:
        ShapeError: when there are not as many values as training frames.
    """
    if len(colors.haze) != len(sequence.train):
        raise ShapeError(
            f"{sequence.name}: colours of {len(colors.haze)} frames for {len(sequence.train)} training frames"
        )
    position = {int(frame): place for place, frame in enumerate(sequence.train)}
    frames = FrameStack(len(sequence))
    for frame in range(len(sequence)):
        rgb, place = sequence.rgb[frame], position.get(frame)
        frames.append(rgb if place is None else colors.developed(rgb, place, light))
    return replace(sequence, rgb=frames.array)


def _centered(values: Float[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3"]:
    """Without the mean of the frames and that of the colours."""
    values = values - values.mean(0)
    return np.asarray(values - values.mean(1, keepdims=True))
