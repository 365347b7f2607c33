"""Random scenes the rasteriser's tests share."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from extrags.raster import Rendering, rasterize


@dataclass(frozen=True)
class RasterScene:
    """Arguments of `rasterize` that carry numbers."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor | None
    colors: Tensor | None
    viewmats: Tensor
    Ks: Tensor
    background: Tensor | None
    width: int
    height: int

    def to(self, dtype: torch.dtype, *, gradients: bool = False) -> RasterScene:
        """A copy in another dtype, its arrays leaves of a new graph."""
        values = {
            item.name: value.detach().to(dtype, copy=True).requires_grad_(gradients and item.name != "Ks")
            if isinstance(value := getattr(self, item.name), Tensor)
            else value
            for item in fields(self)
        }
        return RasterScene(**values)

    def leaves(self) -> Iterator[tuple[str, Tensor]]:
        """The arrays that get a gradient, by name."""
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, Tensor) and item.name != "Ks":
                yield item.name, value

    def render(self, backend: str, **options: Any) -> Rendering:
        return rasterize(
            self.means,
            self.quats,
            self.scales,
            self.opacities,
            self.sh,
            self.viewmats,
            self.Ks,
            self.width,
            self.height,
            colors=self.colors,
            background=self.background,
            backend=backend,  # type: ignore[arg-type]
            **options,
        )


def tube(
    n: int,
    width: int,
    height: int,
    *,
    sh_degree: int | None = 3,
    cameras: int = 1,
    colors_per_camera: bool = False,
    seed: int = 0,
) -> RasterScene:
    """Flattened Gaussians on the wall of a tube, cameras inside looking along it, a little turned."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    angle, along = uniform(n) * 2 * math.pi, 0.4 + 6 * uniform(n)
    radius = 1 + 0.1 * torch.sin(3 * angle)
    means = torch.stack([radius * angle.cos(), radius * angle.sin(), along], -1) + 0.02 * normal(n, 3)
    spacing = math.sqrt(2 * math.pi * 6 / max(n, 1))
    scales = spacing * (0.6 + 0.8 * uniform(n, 3)) * torch.tensor([1.0, 1.0, 0.15])
    sh = colors = None
    if sh_degree is None:
        colors = uniform(cameras, n, 3) if colors_per_camera else uniform(n, 3)
    else:
        sh = 0.2 * normal(n, (sh_degree + 1) ** 2, 3)
        sh[:, 0] += 0.5
    viewmats = torch.eye(4).repeat(cameras, 1, 1)
    for camera in range(cameras):
        turn = 0.3 * (torch.rand(3, generator=generator) - 0.5)
        skew = torch.zeros(3, 3)
        skew[0, 1], skew[0, 2], skew[1, 2] = -turn[2], turn[1], -turn[0]
        viewmats[camera, :3, :3] = torch.linalg.matrix_exp(skew - skew.T)
        viewmats[camera, :3, 3] = 0.2 * normal(3) + torch.tensor([0.0, 0.0, 0.3])
    focal = 0.6 * width
    K = torch.tensor([[focal, 0, 0.48 * width], [0, 1.03 * focal, 0.53 * height], [0, 0, 1]])
    return RasterScene(
        means=means,
        quats=normal(n, 4),
        scales=scales,
        opacities=0.1 + 0.89 * uniform(n),
        sh=sh,
        colors=colors,
        viewmats=viewmats,
        Ks=K.repeat(cameras, 1, 1),
        background=torch.tensor([0.2, 0.5, 0.1]),
        width=width,
        height=height,
    )


def weighted_sum(rendering: Rendering, seed: int = 1) -> Tensor:
    """A loss with a different random weight on each number of the differentiable images."""
    generator = torch.Generator().manual_seed(seed)
    total = rendering.rgb.new_zeros(())
    for image in (rendering.rgb, rendering.alpha, rendering.depth):
        weights = torch.randn(image.shape, generator=generator).to(image.dtype)
        total = total + (weights * image).sum()
    return total


def relative_l2(found: Tensor, expected: Tensor) -> float:
    difference = (found.detach().double() - expected.detach().double()).norm()
    return float(difference / expected.detach().double().norm().clamp_min(1e-30))


def same_transmittance(found: Rendering, expected: Rendering) -> None:
    """At query points: the same ones are in the image, and what is left of the light agrees."""
    assert found.transmittance is not None
    assert expected.transmittance is not None
    known = ~expected.transmittance.isnan()
    assert torch.equal(~found.transmittance.isnan(), known)
    assert relative_l2(found.transmittance[known], expected.transmittance[known]) < 1e-5
