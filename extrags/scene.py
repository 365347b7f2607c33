"""A reconstructed scene: Gaussians and the light that is part of the model, rendered together."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.cameras import Cameras
from extrags.gaussians import SH_C0, Gaussians
from extrags.illumination import NearFieldLight
from extrags.raster import Rendering, rasterize

__all__ = ["Scene", "sh_colors"]


@dataclass(frozen=True)
class Scene:
    """Gaussians, and the near-field light if the scene was reconstructed with one."""

    gaussians: Gaussians
    light: NearFieldLight | None = None

    def render(
        self,
        cameras: Cameras,
        *,
        exposure: Float[Tensor, "c"] | None = None,
        sh_degree: int | None = None,
        **options: Any,
    ) -> Rendering:
        """Render all cameras.

        Args:
            cameras: the views.
            exposure: gain per camera; None is the mean exposure of the training frames.
            sh_degree: use spherical harmonics up to this degree only.
            options: handed to `extrags.raster.rasterize` (visibility, query_points, ...).

        Returns:
            Renderings of all cameras in one batch.
        """
        gaussians = self.gaussians
        viewmats = torch.from_numpy(cameras.viewmats.astype(np.float32))
        degree = gaussians.sh_degree if sh_degree is None else min(sh_degree, gaussians.sh_degree)
        if self.light is None and exposure is None:
            color: dict[str, Any] = {"sh": gaussians.sh, "sh_degree": degree}
        else:
            color = {"sh": None, "colors": self.lit_colors(cameras, exposure, degree)}
        return rasterize(
            gaussians.means,
            gaussians.quats,
            gaussians.scales.exp(),
            gaussians.opacities.sigmoid(),
            color.pop("sh"),
            viewmats,
            torch.from_numpy(cameras.K.astype(np.float32)),
            cameras.width,
            cameras.height,
            **color,
            **options,
        )

    def lit_colors(
        self, cameras: Cameras, exposure: Float[Tensor, "c"] | None, sh_degree: int
    ) -> Float[Tensor, "c n 3"]:
        """What each Gaussian sends to each camera: albedo times fall-off times exposure."""
        centers = torch.from_numpy(cameras.centers.astype(np.float32))
        lit = []
        for index, center in enumerate(centers):
            offset = self.gaussians.means - center
            distance = (offset.square().sum(-1) + 1e-20).sqrt()
            color = sh_colors(self.gaussians, offset / distance[:, None], sh_degree)
            if self.light is not None:
                color = color * self.light.falloff(distance)[:, None]
            if exposure is not None:
                color = color * exposure[index]
            lit.append(color)
        return torch.stack(lit)

    def detached(self) -> Scene:
        """A copy without gradient history."""
        light = None if self.light is None else self.light.detached()
        return Scene(self.gaussians.detached(), light)

    def save(self, path: Path) -> None:
        """Write `gaussians/` and, if there is one, `light/`."""
        path.mkdir(parents=True, exist_ok=True)
        self.gaussians.save(path / "gaussians")
        if self.light is not None:
            self.light.save(path / "light")

    @classmethod
    def load(cls, path: Path) -> Scene:
        """Read what `save` wrote."""
        light = NearFieldLight.load(path / "light") if (path / "light").exists() else None
        return cls(Gaussians.load(path / "gaussians"), light)


def sh_colors(gaussians: Gaussians, directions: Float[Tensor, "n 3"], sh_degree: int) -> Float[Tensor, "n 3"]:
    """Colours max(SH(direction) + 0.5, 0) for unit directions from camera to Gaussian."""
    color = SH_C0 * gaussians.sh0[:, 0] + 0.5
    if sh_degree > 0:
        from extrags.raster import sh_basis

        basis = sh_basis(directions, sh_degree)[:, 1:]
        color = color + torch.einsum("nk,nkc->nc", basis, gaussians.shN[:, : basis.shape[1]])
    return color.clamp_min(0)
