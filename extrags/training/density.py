"""Adaptive density control: clone, split and prune, with the semantics of gsplat's DefaultStrategy.

Opacities are never reset: in a tube the camera is inside the scene, a reset opens the wall everywhere
at once, and short schedules never close it again.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.config import DensifyConfig

__all__ = ["DensityControl", "DensityRound"]

SPLIT_SHRINK = 1.6
"""A split Gaussian's children are this much smaller (3DGS, section 5.2)."""

MAX_SCALE_SHARE = 0.25
"""Gaussians whose largest standard deviation exceeds this share of the extent are pruned."""


@dataclass(frozen=True)
class DensityRound:
    """What one round decides.

    Args:
        keep: Gaussians that stay, over the set before the round, [N].
        born: parameters of new Gaussians, appended after the kept ones.
    """

    keep: Bool[Tensor, "n"]
    born: dict[str, Tensor]

    @property
    def changed(self) -> bool:
        """Whether the set differs from before."""
        return not bool(self.keep.all()) or len(self.born["means"]) > 0


class DensityControl:
    """Collects 2D-position gradients and decides which Gaussians are cloned, split or pruned.

    Args:
        config: thresholds.
        extent: length scale of the scene in world units.
        n_gaussians: size of the set at the start.
        seed: of the samples that place split children.
    """

    def __init__(self, config: DensifyConfig, extent: float, n_gaussians: int, *, seed: int) -> None:
        self._config = config
        self._extent = extent
        self._generator = torch.Generator().manual_seed(seed)
        self._gradient = torch.zeros(n_gaussians)
        self._count = torch.zeros(n_gaussians)

    def observe(
        self, gradient2d: Float[Tensor, "n 2"], visible: Bool[Tensor, "n"], width: int, height: int
    ) -> None:
        """Add one view's gradient of the 2D means (in pixels), scaled to half image sizes."""
        scale = torch.tensor([width / 2, height / 2])
        norm = (gradient2d * scale).norm(dim=-1)
        self._gradient += torch.where(visible, norm, torch.zeros(()))
        self._count += visible

    def decide(self, parameters: dict[str, Tensor]) -> DensityRound:
        """One round; call `reset` with the new size once it is applied."""
        config = self._config
        n = len(parameters["means"])
        mean_gradient = self._gradient / self._count.clamp_min(1)
        scales = parameters["scales"].detach().exp()
        largest = scales.max(dim=-1).values
        grows = mean_gradient > config.gradient_threshold
        room = config.max_gaussians - n
        if room <= 0:
            grows = torch.zeros_like(grows)
        elif int(grows.sum()) > room:
            # The strongest first, so that the cap does not depend on the order in memory.
            strongest = torch.argsort(
                torch.where(grows, mean_gradient, torch.zeros(())), descending=True, stable=True
            )[:room]
            grows = torch.zeros_like(grows).index_fill_(0, strongest, True)
        small = largest <= config.split_scale_share * self._extent
        clones = grows & small
        splits = grows & ~small
        faint = parameters["opacities"].detach().sigmoid() < config.prune_opacity
        oversized = largest > MAX_SCALE_SHARE * self._extent
        born = {
            name: torch.cat([first, second])
            for (name, first), second in zip(
                _chosen(parameters, clones & ~faint).items(),
                self._children(parameters, splits & ~faint).values(),
                strict=True,
            )
        }
        return DensityRound(~(faint | splits | oversized), born)

    def reset(self, n_gaussians: int) -> None:
        """Start collecting anew."""
        self._gradient = torch.zeros(n_gaussians)
        self._count = torch.zeros(n_gaussians)

    def _children(self, parameters: dict[str, Tensor], chosen: Bool[Tensor, "n"]) -> dict[str, Tensor]:
        parents = _chosen(parameters, chosen)
        scales = parents["scales"].exp()
        twice = {name: value.repeat(2, *[1] * (value.ndim - 1)) for name, value in parents.items()}
        noise = torch.randn(2 * len(scales), 3, generator=self._generator)
        offset = torch.einsum("nij,nj->ni", quaternion_matrix(twice["quats"]), noise * scales.repeat(2, 1))
        twice["means"] = twice["means"] + offset
        twice["scales"] = (scales.repeat(2, 1) / SPLIT_SHRINK).log()
        return twice


def _chosen(parameters: dict[str, Tensor], index: Bool[Tensor, "n"]) -> dict[str, Tensor]:
    return {name: value.detach()[index].clone() for name, value in parameters.items()}


def quaternion_matrix(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z) of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)
