r"""Near-field light that rides on the camera, and exposure per frame (design section 6).

What a Gaussian sends to the lens is

.. math:: I = g_f \, \frac{(1 + c)^e}{(r^2 / s^2 + c)^e} \, a

with albedo a (with its spherical harmonics), distance r from the lens, the scene's reference distance
s, softening c, exponent e and exposure g_f of frame f. The gauge is fixed: at r = s the fall-off is
one, and the log-exposures of the training frames have mean zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
import zarr
from jaxtyping import Float
from torch import Tensor

from extrags.zarr_io import open_group, read_array, write_array

__all__ = ["NearFieldLight"]


@dataclass(frozen=True)
class NearFieldLight:
    """Global light parameters and the exposure of each training frame.

    Args:
        log_softening: log of c, scalar.
        log_exponent: log of e, scalar.
        log_exposure: log of g_f for each training frame, [F_train]; mean zero.
        reference_distance: s, in world units.
    """

    log_softening: Float[Tensor, ""]
    log_exponent: Float[Tensor, ""]
    log_exposure: Float[Tensor, "f"]
    reference_distance: float

    @classmethod
    def initial(cls, n_frames: int, reference_distance: float, *, exponent: float = 0.6) -> NearFieldLight:
        """The starting light: a softened power of the distance, equal exposures."""
        return cls(
            torch.tensor(-1.0),
            torch.tensor(float(exponent)).log(),
            torch.zeros(n_frames),
            float(reference_distance),
        )

    def falloff(self, distance: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Brightness at a distance from the lens relative to the reference distance."""
        softening = self.log_softening.exp()
        relative = (distance / self.reference_distance) ** 2
        return ((1 + softening) / (relative + softening)) ** self.log_exponent.exp()

    def exposure(self, frame: int | None) -> Float[Tensor, ""]:
        """Gain of a training frame; None gives the mean exposure (held-out and virtual views)."""
        if frame is None:
            return torch.ones(())
        return (self.log_exposure[frame] - self.log_exposure.mean()).exp()

    def parameters(self) -> dict[str, Tensor]:
        """What is learned, by name."""
        return {
            "log_softening": self.log_softening,
            "log_exponent": self.log_exponent,
            "log_exposure": self.log_exposure,
        }

    def detached(self) -> NearFieldLight:
        """A copy without gradient history."""
        values = {k: v.detach().clone() for k, v in self.parameters().items()}
        return NearFieldLight(**values, reference_distance=self.reference_distance)

    def save(self, path: Path) -> None:
        """Write a zarr v3 group."""
        group = open_group(path, mode="w")
        for name, value in self.parameters().items():
            write_array(group, name, value.detach().numpy())
        group.attrs["reference_distance"] = self.reference_distance

    @classmethod
    def load(cls, path: Path) -> NearFieldLight:
        """Read what `save` wrote."""
        group = zarr.open_group(str(path), mode="r")
        names = ("log_softening", "log_exponent", "log_exposure")
        values = {name: torch.from_numpy(read_array(group, name)) for name in names}
        return cls(**values, reference_distance=float(group.attrs["reference_distance"]))  # type: ignore[arg-type]
