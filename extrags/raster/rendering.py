"""Inputs and outputs of a rasteriser, common to all backends."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.array_shapes import check_whole
from extrags.cameras import ROTATION_TOLERANCE
from extrags.errors import NonFiniteError, PoseError, ShapeError
from extrags.radial_lens import RadialLens
from extrags.raster.light import ROW_LENGTH

__all__ = ["RasterInputs", "RasterOptions", "Rendering", "checked_inputs"]

DILATION_PX2 = 0.3
"""Added to the diagonal of each projected covariance, in px^2: gsplat's `eps2d`, a low-pass filter."""

COVARIANCE_MAX_PX2 = 1e12
"""Gaussians with a larger variance along an image axis, in px^2, are culled: their inverse covariance has no
digits left in float32."""

ALPHA_MAX = 0.999
"""Upper limit of a Gaussian's alpha."""

ALPHA_MIN = 1.0 / 255.0
"""Contributions with a smaller alpha are dropped."""

TRANSMITTANCE_MIN = 1e-4
"""Compositing of a pixel stops before its transmittance would fall to this value."""

FIELD_OF_VIEW_MARGIN = 0.3
"""Centres are clamped to the image, enlarged by this share of half its size, to evaluate the Jacobian."""

ALPHA_EPS = 1e-10
"""Lower bound of the denominator of the expected depth."""

_LAST_ROW_TOLERANCE = 1e-4
"""Of a view matrix; differences of gradients by finite steps are smaller."""
_OPACITY_ROUNDING = 1e-6
"""By so much products of opacities in single precision may lie outside [0, 1]."""
_OPTIONAL = ("sh", "colors", "background", "query_points", "light", "visibility_mask")
"""Of `RasterInputs`."""


@dataclass(frozen=True)
class Rendering:
    """Images of C cameras and optional outputs.

    Args:
        rgb: colour, background included, [C, H, W, 3].
        alpha: opacity, 1 - final transmittance, [C, H, W].
        depth: expected z-depth, sum(w z) / max(sum w, 1e-10) with blending weights w, in world units;
            0 where nothing was hit. Differentiable. [C, H, W].
        means2d: centres in pixels, [C, N, 2]; 0 where not `visible`. A plain tensor outside the graph:
            `backward()` fills `means2d.grad` with the gradient of the loss with respect to the centres in
            pixels, as gsplat's retained gradient does, and, asked for with `absgrad`, `means2d.absgrad`
            with the sum over pixels of its absolute value.
        radius_px: half the longer side of the box round the pixels a Gaussian can reach, in pixels;
            0 where it is culled. [C, N].
        median_depth: z-depth of the Gaussian at which the transmittance falls to one half or below;
            0 where it never does. Not differentiable. [C, H, W].
        visibility_max: largest blending weight (transmittance times alpha) over the pixels, or over those of
            a `visibility_mask`, [C, N].
        visibility_sum: sum of the blending weights over the same pixels, [C, N].
        transmittance: at the query points, [C, Q]: what is left of the light at the centre of the pixel
            the point projects to, in front of its depth. NaN where the point lies outside the image or
            not beyond the near plane. Not differentiable.
    """

    rgb: Float[Tensor, "c h w 3"]
    alpha: Float[Tensor, "c h w"]
    depth: Float[Tensor, "c h w"]
    means2d: Float[Tensor, "c n 2"]
    radius_px: Float[Tensor, "c n"]
    median_depth: Float[Tensor, "c h w"] | None = None
    visibility_max: Float[Tensor, "c n"] | None = None
    visibility_sum: Float[Tensor, "c n"] | None = None
    transmittance: Float[Tensor, "c q"] | None = None

    @property
    def visible(self) -> Bool[Tensor, "c n"]:
        """Gaussians whose footprint overlaps the image; occlusion is not considered."""
        return self.radius_px > 0


@dataclass(frozen=True)
class RasterInputs:
    """Checked arguments of a rasterisation; exactly one of `sh` and `colors` is given."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    opacities: Float[Tensor, "n"]
    sh: Float[Tensor, "n k 3"] | None
    colors: Float[Tensor, "c n 3"] | Float[Tensor, "n 3"] | None
    viewmats: Float[Tensor, "c 4 4"]
    Ks: Float[Tensor, "c 3 3"]
    background: Float[Tensor, "c 3"] | Float[Tensor, "3"] | None
    query_points: Float[Tensor, "q 3"] | None
    light: Float[Tensor, "c 17"] | None = None
    visibility_mask: Float[Tensor, "c h w"] | None = None


@dataclass(frozen=True)
class RasterOptions:
    """Arguments of a rasterisation that are not arrays."""

    width: int
    height: int
    sh_degree: int
    near: float
    median_depth: bool
    visibility: bool
    absgrad: bool
    lens: RadialLens | None = None


def checked_inputs(
    inputs: RasterInputs, width: int, height: int, near: float, sh_degree: int | None
) -> tuple[RasterInputs, int]:
    """Check shapes, dtypes and devices of the arguments.

    Args:
        inputs: arguments of the caller; a background of one colour may be [3].
        width: of the images, in pixels.
        height: of the images, in pixels.
        near: distance of the near plane.
        sh_degree: highest degree to use; None is all there is.

    Returns:
        The inputs with the background expanded to all cameras, and the SH degree to use.

    Raises:
        ShapeError: when shapes, dtypes or devices do not fit together, or a size is out of range.
    """
    for name, value in vars(inputs).items():
        if value is None and name in _OPTIONAL:
            continue
        if not isinstance(value, Tensor):
            raise ShapeError(f"{name} is {type(value).__name__}, expected a torch tensor")
    means = inputs.means
    if means.ndim != 2 or means.shape[1] != 3:
        raise ShapeError(f"means has shape {tuple(means.shape)}, expected (N, 3)")
    if not means.is_floating_point():
        raise ShapeError(f"means has dtype {means.dtype}, expected a floating-point dtype")
    check_size(width, height)
    check_near(near)
    n = means.shape[0]
    c = inputs.viewmats.shape[0] if inputs.viewmats.ndim == 3 else -1
    if (inputs.sh is None) == (inputs.colors is None):
        raise ShapeError("exactly one of sh and colors must be given")
    if inputs.background is not None and inputs.background.ndim == 1 and c >= 0:
        inputs = _with_background(inputs, inputs.background.expand(c, -1))
    expected: dict[str, tuple[tuple[int, ...], ...]] = {
        "quats": ((n, 4),),
        "scales": ((n, 3),),
        "opacities": ((n,),),
        "colors": ((n, 3), (c, n, 3)),
        "viewmats": ((c, 4, 4),),
        "Ks": ((c, 3, 3),),
        "background": ((c, 3),),
        "light": ((c, ROW_LENGTH),),
        "visibility_mask": ((c, height, width),),
    }
    for name, shapes in expected.items():
        value = getattr(inputs, name)
        if value is not None and tuple(value.shape) not in shapes:
            wanted = " or ".join(str(shape).replace("-1", "C") for shape in shapes)
            raise ShapeError(f"{name} has shape {tuple(value.shape)}, expected {wanted}")
    degree = _checked_degree(inputs.sh, n, sh_degree)
    points = inputs.query_points
    if points is not None and (points.ndim != 2 or points.shape[1] != 3):
        raise ShapeError(f"query_points has shape {tuple(points.shape)}, expected (Q, 3)")
    for name, value in vars(inputs).items():
        if value is None:
            continue
        if value.dtype != means.dtype:
            raise ShapeError(f"{name} has dtype {value.dtype}, means has {means.dtype}")
        if value.device != means.device:
            raise ShapeError(f"{name} is on {value.device}, means is on {means.device}")
    return inputs, degree


def check_size(width: int, height: int) -> None:
    """Check the size of an image.

    Raises:
        ShapeError: when it is out of range.
    """
    check_whole("width", width)
    check_whole("height", height)
    if not (1 <= width <= 32768 and 1 <= height <= 32768):
        raise ShapeError(f"image size {width}x{height}, expected 1 to 32768 pixels a side")


def check_near(near: float) -> None:
    """Check the distance of the near plane.

    Raises:
        ShapeError: when it is not finite and positive.
    """
    if not (near > 0 and math.isfinite(near)):
        raise ShapeError(f"near is {near}, expected a finite positive distance")


def check_finite(inputs: RasterInputs) -> None:
    """Check that all arrays are finite.

    Raises:
        NonFiniteError: names the array and the first bad entry.
    """
    for name, value in vars(inputs).items():
        if value is None:
            continue
        finite = torch.isfinite(value.detach())
        if not bool(finite.all()):
            raise nonfinite_error(name, value)


def check_values(inputs: RasterInputs) -> None:
    """Check that finite arguments mean something: they would render, and mislead.

    Raises:
        ShapeError: for opacities outside [0, 1], as logits are, and focal lengths that are not positive.
        PoseError: for view matrices that are no rigid motions.
    """
    if inputs.opacities.numel():
        low, high = (float(value) for value in torch.aminmax(inputs.opacities.detach()))
        if low < -_OPACITY_ROUNDING or high > 1 + _OPACITY_ROUNDING:
            raise ShapeError(
                f"opacities are from {low:.7g} to {high:.7g}, expected [0, 1]; logits go through a sigmoid "
                "first"
            )
    # As plain numbers: for the few of a camera, calls on arrays take many times as long.
    matrices = [value.detach().cpu().numpy().tolist() for value in (inputs.Ks, inputs.viewmats)]
    for camera, (K, view) in enumerate(zip(*matrices, strict=True)):
        fx, fy = K[0][0], K[1][1]
        if not (fx > 0 and fy > 0):
            raise ShapeError(
                f"Ks[{camera}] has the focal lengths {fx:g} and {fy:g} px, expected positive numbers"
            )
        (a, b, c, _), (d, e, f, _), (g, h, i, _), last = view
        # With rows of unit length, the volume they span is 1 only where they are at right angles as well.
        volume = a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)
        lengths = (a * a + b * b + c * c, d * d + e * e + f * f, g * g + h * h + i * i)
        off = max(abs(volume - 1), *(abs(length - 1) for length in lengths))
        last_off = max(abs(entry - value) for entry, value in zip(last, (0, 0, 0, 1), strict=True))
        if off > 3 * ROTATION_TOLERANCE or last_off > _LAST_ROW_TOLERANCE:
            raise _view_error(np.array(view), camera)


def _view_error(view: Float[np.ndarray, "4 4"], camera: int) -> PoseError:
    if np.abs(view[3] - (0, 0, 0, 1)).max() > _LAST_ROW_TOLERANCE:
        problem = f"the last row is {np.round(view[3], 4).tolist()}, expected [0, 0, 0, 1]"
    else:
        lengths = np.round(np.linalg.svd(view[:3, :3], compute_uv=False), 4).tolist()
        determinant = float(np.linalg.det(view[:3, :3]))
        problem = (
            f"no rigid motion: singular values {lengths} and determinant {determinant:.3f}, expected 1, 1, 1 "
            "and +1; is it scaled or mirrored?"
        )
    return PoseError(problem, field=f"viewmats[{camera}]")


def nonfinite_error(name: str, value: Tensor) -> NonFiniteError:
    """The error that names the first NaN or infinity of an array."""
    bad = torch.nonzero(~torch.isfinite(value.detach()))
    entry = tuple(int(i) for i in bad[0])
    found = float(value.detach()[entry])
    return NonFiniteError(f"{name}[{', '.join(map(str, entry))}] is {found} ({len(bad)} such entries)")


def _checked_degree(sh: Tensor | None, n: int, sh_degree: int | None) -> int:
    if sh is None:
        return 0
    if sh.ndim != 3 or sh.shape[0] != n or sh.shape[2] != 3:
        raise ShapeError(f"sh has shape {tuple(sh.shape)}, expected ({n}, K, 3)")
    stored = math.isqrt(sh.shape[1]) - 1
    if (stored + 1) ** 2 != sh.shape[1] or not 0 <= stored <= 3:
        raise ShapeError(f"sh holds {sh.shape[1]} coefficients, expected 1, 4, 9 or 16")
    if sh_degree is None:
        return stored
    if not 0 <= sh_degree <= stored:
        raise ShapeError(f"sh_degree is {sh_degree}, the coefficients reach degree {stored}")
    return sh_degree


def _with_background(inputs: RasterInputs, background: Tensor) -> RasterInputs:
    return RasterInputs(**{**vars(inputs), "background": background})
