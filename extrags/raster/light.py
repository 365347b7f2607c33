r"""Near-field light fixed to the camera, as the rasteriser applies it to every Gaussian.

A Gaussian of albedo a (from its spherical harmonics), at :math:`\mathbf d` from the light (in the camera
frame, in reference distances), with normal n (its shortest axis), has signal x and image value I:

.. math::
    x = g \left(\frac{1 + c}{|\mathbf d|^2 + c}\right)^{e} \left(\frac{d_z}{|\mathbf d|}\right)^{k}
        \left( a \left(\frac{\cos^2 \beta + \epsilon}{1 + \epsilon}\right)^{q / 2} + m \, S(\beta) \right),
    \qquad \cos\beta = \frac{\mathbf n \cdot \mathbf d}{|\mathbf d|},

    S(\beta) = \left(\frac{\rho^2}{\rho^2 + (1 - \rho^2) \sin^2 \beta}\right)^2,
    \qquad I = \sqrt{\left( \frac{(1 + s) \, x}{1 + s \, x} \right)^2 + v^2}

with exposure g (one per colour channel), softening c and exponent e of the fall-off with distance, exponent k
of the light's angular spread, exponent q of the cosine law at the surface, strength m and roughness rho of
the specular lobe of a wet surface, shoulder s of the camera response, and veiling glare v, one per colour:
light that lens and tube scatter over the whole image. It adds to the sensor's linear signal, of which the
image shows about the square root; v is what a black surface shows. It does not grow with the exposure: glare
is a share of the image's mean, which automatic exposure holds. The lobe is the GGX distribution of
normals with its peak at one; since the light rides beside the lens, the direction half-way between both is
that to the camera. It has the colour of the light. Normalisation: at the reference distance, on the axis and
facing the light, x = g (a + m); without glare, I = 1 for x = 1. With k = q = m = s = v = 0 this is the
softened fall-off with distance alone.

Source: GGX after Walter et al., "Microfacet models for refraction through rough surfaces", EGSR 2007.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from extrags.raster.rotations import rotation_matrices

__all__ = [
    "LEARNED_LENGTH",
    "ROW_LENGTH",
    "CameraLight",
    "add_glare",
    "apply_response",
    "invert_response",
    "light_gain",
    "lit_colors",
    "remove_glare",
    "shortest_axes",
    "specular_gain",
]

LEARNED_LENGTH = 16
"""Numbers of a row that a light may learn; the last one, the reference distance, is a gauge."""
ROW_LENGTH = LEARNED_LENGTH + 1

SQUARE_MIN = 1e-6
"""Lower bound of the squared distance to the light, in reference distances."""

SPREAD_MIN = 0.1
"""Lower bound of the cosine to the light's axis; at larger angles the angular spread is constant."""

COSINE_SOFTENING = 0.04
"""epsilon: surfaces at grazing incidence do not become black, and the gradient of the normal is bounded."""

ROUGHNESS_MIN = 0.02
"""Lower bound of the roughness: a sharper lobe falls between the Gaussians. The upper one is 1, where the
lobe is the same in all directions."""

LOG2_GAIN_MAX = 40.0
"""Gains are clamped to [2^-40, 2^40]."""


@dataclass(frozen=True)
class CameraLight:
    """The light of C cameras; all but the exposure is common to them.

    Args:
        exposure: g, one per camera and colour, [C, 3].
        softening: c, not negative, scalar.
        exponent: e, scalar.
        spread: k, scalar.
        cosine: q, scalar.
        offset: position of the light in the camera frame, in reference distances, [3].
        shoulder: s, not negative, scalar.
        reference_distance: in world units; not learned.
        specular: m, not negative, scalar; 0 is a surface without highlights, where the kernels give it no
            gradient.
        roughness: rho, scalar; held between `ROUGHNESS_MIN` and 1.
        glare: v, not negative, one per colour, [3]; where it is 0 the kernels give it no gradient.
    """

    exposure: Float[Tensor, "c 3"]
    softening: Float[Tensor, ""]
    exponent: Float[Tensor, ""]
    spread: Float[Tensor, ""]
    cosine: Float[Tensor, ""]
    offset: Float[Tensor, "3"]
    shoulder: Float[Tensor, ""]
    reference_distance: float
    specular: Float[Tensor, ""] = field(default_factory=lambda: torch.zeros(()))
    roughness: Float[Tensor, ""] = field(default_factory=lambda: torch.ones(()))
    glare: Float[Tensor, "3"] = field(default_factory=lambda: torch.zeros(3))

    def packed(self) -> Float[Tensor, "c 17"]:
        """One row per camera.

        Exposure, softening, exponent, spread, cosine, offset, shoulder, specular, roughness, glare,
        reference.
        """
        common = torch.cat(
            [
                torch.stack([self.softening, self.exponent, self.spread, self.cosine]),
                self.offset,
                torch.stack(
                    [self.shoulder, self.specular.to(self.shoulder), self.roughness.to(self.shoulder)]
                ),
                self.glare.to(self.shoulder),
                self.shoulder.new_tensor([self.reference_distance]),
            ]
        )
        return torch.cat([self.exposure, common.expand(len(self.exposure), -1)], dim=1)


def lit_colors(
    albedo: Float[Tensor, "n 3"],
    points: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    light: Float[Tensor, "17"],
) -> Float[Tensor, "n 3"]:
    """Image colours of Gaussians in one camera under its light.

    Args:
        albedo: colours without light, not negative.
        points: centres in the camera frame, in world units.
        normals: unit normals in the camera frame, of either sign.
        light: a row of `CameraLight.packed`.
    """
    signal = albedo * light_gain(points, normals, light)[:, None]
    signal = signal + specular_gain(points, normals, light)[:, None]
    return add_glare(apply_response(light[:3] * signal, light[10]), light[13:16])


def light_gain(
    points: Float[Tensor, "*b 3"], normals: Float[Tensor, "*b 3"] | None, light: Float[Tensor, "17"]
) -> Float[Tensor, "*b"]:
    """Gain of the light at points in the camera frame, at unit exposure and without highlights.

    Without normals all surfaces are assumed to face the light.
    """
    offset, square = _from_lamp(points, light)
    logarithm = _log_arriving(offset, square, light)
    if normals is not None:
        squared_cosine = (normals * offset).sum(-1).square() / square
        facing = torch.log2((squared_cosine + COSINE_SOFTENING) / (1 + COSINE_SOFTENING))
        logarithm = logarithm + 0.5 * light[6] * facing
    return torch.exp2(logarithm.clamp(-LOG2_GAIN_MAX, LOG2_GAIN_MAX))


def specular_gain(
    points: Float[Tensor, "*b 3"], normals: Float[Tensor, "*b 3"], light: Float[Tensor, "17"]
) -> Float[Tensor, "*b"]:
    """What highlights add to the signal of a surface of any albedo, at unit exposure.

    Args:
        points: in the camera frame, in world units.
        normals: unit normals in the camera frame, of either sign.
        light: a row of `CameraLight.packed`.

    Source: GGX after Walter et al., EGSR 2007.
    """
    offset, square = _from_lamp(points, light)
    squared_roughness = light[12].clamp(ROUGHNESS_MIN, 1).square()
    squared_sine = (1 - (normals * offset).sum(-1).square() / square).clamp_min(0)
    lobe = squared_roughness / (squared_roughness + (1 - squared_roughness) * squared_sine)
    arriving = torch.exp2(_log_arriving(offset, square, light).clamp(-LOG2_GAIN_MAX, LOG2_GAIN_MAX))
    return light[11] * lobe.square() * arriving


def _from_lamp(
    points: Float[Tensor, "*b 3"], light: Float[Tensor, "17"]
) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b"]]:
    """Where points are as the lamp sees them, in reference distances, and the square of how far."""
    offset = points / light[-1] - light[7:10]
    return offset, offset.square().sum(-1).clamp(SQUARE_MIN, 1e30)


def _log_arriving(
    offset: Float[Tensor, "*b 3"], square: Float[Tensor, "*b"], light: Float[Tensor, "17"]
) -> Float[Tensor, "*b"]:
    """Logarithm to base two of the light that arrives, whichever way the surface faces."""
    softening, exponent, spread = light[3:6]
    fall = torch.log2(1 + softening) - torch.log2(square + softening)
    axis = torch.log2((offset[..., 2] * square.rsqrt()).clamp_min(SPREAD_MIN))
    logarithm: Tensor = exponent * fall + spread * axis
    return logarithm


def apply_response(signal: Float[Tensor, "*b"], shoulder: Float[Tensor, ""]) -> Float[Tensor, "*b"]:
    """Camera response I(x) of a signal x."""
    return (1 + shoulder) * signal / (1 + shoulder * signal)


def invert_response(image: Float[Tensor, "*b"], shoulder: Float[Tensor, ""]) -> Float[Tensor, "*b"]:
    """Inverse of `apply_response`: the signal x of image values I in [0, 1]."""
    return image / (1 + shoulder * (1 - image))


def add_glare(image: Float[Tensor, "*b"], glare: Float[Tensor, "*c"]) -> Float[Tensor, "*b"]:
    """Image values under veiling glare, from those without: squares add up.

    Args:
        image: not negative.
        glare: what black shows, broadcast to the image.
    """
    none = glare.square() == 0
    # The root has no slope at zero.
    return torch.where(none, image, torch.where(none, 1, image.square() + glare.square()).sqrt())


def remove_glare(image: Float[Tensor, "*b"], glare: Float[Tensor, "*c"]) -> Float[Tensor, "*b"]:
    """Inverse of `add_glare`; what is darker than the glare is black."""
    squared = image.clamp_min(0).square() - glare.square()
    left = torch.where(squared > 0, squared, 1).sqrt()
    return torch.where(glare.square() == 0, image, torch.where(squared > 0, left, 0))


def shortest_axes(quats: Float[Tensor, "n 4"], scales: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Normals of Gaussians in world coordinates: the axis of the smallest scale, the first of equals."""
    rotation = rotation_matrices(quats)
    # argmin may take any of equal entries; the kernels take the first.
    first = (scales[:, 0] <= scales[:, 1]) & (scales[:, 0] <= scales[:, 2])
    shortest = torch.where(first, 0, torch.where(scales[:, 1] <= scales[:, 2], 1, 2))
    return rotation.gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
