from __future__ import annotations

import math

import pytest
import torch

from extrags.errors import ShapeError
from extrags.raster import rasterize, sh_basis
from tests.extrags.raster.scenes import tube


def _sphere(n: int = 200) -> tuple[torch.Tensor, torch.Tensor]:
    """Gauss-Legendre times uniform quadrature: exact for the products of harmonics up to degree 3."""
    import numpy as np

    z, weight = (torch.from_numpy(v) for v in np.polynomial.legendre.leggauss(8))
    angle = torch.arange(16, dtype=torch.float64) * (2 * math.pi / 16)
    r = (1 - z * z).sqrt()
    xyz = torch.stack([r[:, None] * angle.cos(), r[:, None] * angle.sin(), z[:, None].expand(-1, 16)], -1)
    return xyz.reshape(-1, 3), (weight[:, None] * (2 * math.pi / 16)).expand(-1, 16).reshape(-1)


def test_orthonormal() -> None:
    directions, weights = _sphere()
    basis = sh_basis(directions, 3)
    torch.testing.assert_close(basis.T @ (weights[:, None] * basis), torch.eye(16, dtype=torch.float64))


def test_signs_of_the_first_degree() -> None:
    """3DGS and gsplat: -y, z, -x."""
    c = math.sqrt(3 / (4 * math.pi))
    basis = sh_basis(torch.eye(3, dtype=torch.float64), 1)
    expected = torch.tensor([[0, 0, -c], [-c, 0, 0], [0, c, 0]], dtype=torch.float64)
    torch.testing.assert_close(basis[:, 1:], expected)


def test_differentiable() -> None:
    directions = torch.nn.functional.normalize(torch.randn(4, 3, dtype=torch.float64), dim=-1)
    assert torch.autograd.gradcheck(lambda d: sh_basis(d, 3), [directions.requires_grad_()])


def test_degree_is_checked() -> None:
    with pytest.raises(ShapeError, match="degree is 4"):
        sh_basis(torch.ones(1, 3), 4)


def test_colors_from_the_basis_render_like_coefficients() -> None:
    """What the near-field light model does by hand is what the kernels do inside."""
    scene = tube(200, 30, 24, sh_degree=3)
    viewmat = scene.viewmats[0]
    center = -viewmat[:3, :3].T @ viewmat[:3, 3]
    directions = torch.nn.functional.normalize(scene.means - center, dim=-1)
    assert scene.sh is not None
    colors = (torch.einsum("nk,nkc->nc", sh_basis(directions, 3), scene.sh) + 0.5).clamp_min(0)
    arguments = (scene.means, scene.quats, scene.scales, scene.opacities)
    cameras = (scene.viewmats, scene.Ks, scene.width, scene.height)
    by_colors = rasterize(*arguments, None, *cameras, colors=colors).rgb
    torch.testing.assert_close(by_colors, rasterize(*arguments, scene.sh, *cameras).rgb, rtol=1e-5, atol=1e-6)
