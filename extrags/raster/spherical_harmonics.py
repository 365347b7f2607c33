"""Real spherical harmonics with the signs of 3DGS and gsplat."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from extrags.errors import ShapeError

__all__ = ["sh_basis"]


def sh_basis(directions: Float[Tensor, "*b 3"], degree: int) -> Float[Tensor, "*b k"]:
    """Values of the real spherical harmonics up to a degree.

    Args:
        directions: unit vectors from the camera to the Gaussian.
        degree: 0 to 3.

    Returns:
        The (degree + 1)^2 values per direction, in the order of the stored coefficients.

    Raises:
        ShapeError: when the degree is not 0 to 3.

    Source: P.-P. Sloan, Efficient spherical harmonic evaluation, JCGT 2013; signs as in 3DGS.
    """
    if not 0 <= degree <= 3:
        raise ShapeError(f"degree is {degree}, expected 0 to 3")
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, 0.28209479177387814)]
    if degree > 0:
        values += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        values += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if degree > 2:
        values += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * (xx + yy)),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return torch.stack(values, -1)
