r"""Projection through a radial lens and its Jacobian, in torch: the specification of the kernels.

With the slopes :math:`a = x/z`, :math:`b = y/z`, :math:`w = a^2 + b^2 = \tan^2\theta` and the gain
:math:`G(w) = r(\theta) / \tan\theta`, a centre falls on :math:`u = f_x G a + c_x`,
:math:`v = f_y G b + c_y`, and

.. math::
    J = \begin{pmatrix} f_x (G + 2 a^2 G') & 2 f_x a b G' \\ 2 f_y a b G' & f_y (G + 2 b^2 G') \end{pmatrix}
        \begin{pmatrix} 1/z & 0 & -a/z \\ 0 & 1/z & -b/z \end{pmatrix} .

Source: Zwicker et al., "EWA volume splatting", 2001; Kannala and Brandt, "A generic camera model and
calibration method for conventional, wide-angle and fish-eye lenses", PAMI 2006.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.radial_lens import SERIES_SQUARE, RadialLens

__all__ = ["lens_gain", "project_through_lens", "within_lens"]


def within_lens(
    x: Float[Tensor, "n"], y: Float[Tensor, "n"], z: Float[Tensor, "n"], lens: RadialLens
) -> Bool[Tensor, "n"]:
    """Points in front of the camera that the lens projects: its field of view and a margin."""
    limit = math.tan(lens.projected_up_to_rad) ** 2
    a, b = x.detach() / z.detach(), y.detach() / z.detach()
    return (z.detach() > 0) & (a.square() + b.square() <= limit)


def lens_gain(square: Float[Tensor, "n"], lens: RadialLens) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """G and its derivative by w, both differentiable.

    Args:
        square: w, the squared tangent of the angle from the axis.
        lens: of the camera.
    """
    near_axis = square <= SERIES_SQUARE
    held = torch.where(near_axis, square, torch.zeros_like(square))
    gain_series, slope_series = torch.zeros_like(square), torch.zeros_like(square)
    for power, coefficient in reversed(list(enumerate(lens.series.tolist()))):
        gain_series = gain_series * held + coefficient
        if power > 0:
            slope_series = slope_series * held + power * coefficient
    beyond = torch.where(near_axis, torch.ones_like(square), square)
    tangent = beyond.sqrt()
    angle = torch.atan(tangent)
    end = lens.linear_from_rad
    inner = angle.clamp_max(end)
    k1, k2, k3, k4 = lens.coefficients
    q = inner.square()
    radius = inner * (1 + q * (k1 + q * (k2 + q * (k3 + q * k4))))
    slope = 1 + q * (3 * k1 + q * (5 * k2 + q * (7 * k3 + q * 9 * k4)))
    gain = (radius + slope * (angle - inner)) / tangent
    gain_slope = (slope / (1 + beyond) - gain) / (2 * beyond)
    return torch.where(near_axis, gain_series, gain), torch.where(near_axis, slope_series, gain_slope)


def project_through_lens(
    x: Float[Tensor, "n"],
    y: Float[Tensor, "n"],
    z: Float[Tensor, "n"],
    K: Float[Tensor, "3 3"],
    lens: RadialLens,
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 3"]]:
    """Pixels of points in the camera frame, and the Jacobian of that map; both differentiable.

    Args:
        x: to the right.
        y: down.
        z: forward, positive.
        K: intrinsics in pixels.
        lens: of the camera.
    """
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    a, b = x / z, y / z
    gain, gain_slope = lens_gain(a.square() + b.square(), lens)
    across = 2 * a * b * gain_slope
    aa, bb = gain + 2 * a.square() * gain_slope, gain + 2 * b.square() * gain_slope
    rows = [
        torch.stack([fx * aa, fx * across, -fx * (aa * a + across * b)], -1),
        torch.stack([fy * across, fy * bb, -fy * (across * a + bb * b)], -1),
    ]
    jacobian = torch.stack(rows, 1) / z[:, None, None]
    return torch.stack([fx * gain * a + cx, fy * gain * b + cy], -1), jacobian
