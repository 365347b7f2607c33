"""The dark direction of a view, and the illumination-aware weight of candidates."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from extrags.cameras import Cameras, pixel_rays
from extrags.illumination import NearFieldLight
from extrags.thresholds import HOLE_ALPHA

__all__ = ["dark_direction", "illumination_weight", "lit_luminance", "luminance"]

DARK_RATIO = 0.7
"""A patch is dark when its mean luminance is below this share of the view's median."""
PATCH_SHARE = 15 / 160
"""Edge of the patch as a share of the image width (15 px at a width of 160)."""


def luminance(rgb: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Rec. 709 luminance of linear colours."""
    return np.asarray(0.2126 * rgb[..., 0] + 0.7152 * rgb[..., 1] + 0.0722 * rgb[..., 2])


def lit_luminance(
    camera: Cameras,
    rgb: Float[np.ndarray, "h w 3"],
    depth_mm: Float[np.ndarray, "h w"],
    valid: Bool[np.ndarray, "h w"],
    light: NearFieldLight | None,
) -> Float[np.ndarray, "h w"]:
    """Luminance with the light's fall-off divided out.

    With a light model its own fall-off is used. Without one the fall-off is fitted to the view itself:
    log-luminance against log-distance by least squares over the valid pixels, slope held to what light
    can do (0: none, -2: inverse square).

    Args:
        camera: the view, a batch of one.
        rgb: rendered colours.
        depth_mm: rendered z-depth, world units.
        valid: pixels that can be trusted.
        light: the scene's light, if it has one.

    Returns:
        Luminance as if every surface had the same distance from the lens; 0 where not valid.
    """
    brightness = np.clip(luminance(rgb), 0.0, None)
    rays = pixel_rays(camera)[0]
    points = rays * np.where(valid, depth_mm, 1.0)[..., None]
    if light is not None:
        import torch

        with torch.no_grad():
            turned = camera.world_from_camera[0, :3, :3]
            falloff = light.gain(torch.from_numpy(points @ turned)).numpy()
            # Of this luminance in each colour, whose glare differs.
            grey = torch.from_numpy(brightness).clamp(max=1.0)[..., None].expand(-1, -1, 3)
            brightness = luminance(light.invert_response(grey).numpy())
    else:
        distance = np.linalg.norm(points, axis=-1)
        falloff = np.ones_like(distance)
        usable = valid & (brightness > 1e-3) & (distance > 0)
        if usable.sum() >= 16:
            x, y = np.log(distance[usable]), np.log(brightness[usable])
            spread = float(((x - x.mean()) ** 2).sum())
            if spread > 1e-6 * len(x):
                slope = float(((x - x.mean()) * (y - y.mean())).sum()) / spread
                falloff = (distance / float(np.exp(x.mean()))) ** np.clip(slope, -2.0, 0.0)
    return np.where(valid, brightness / np.maximum(falloff, 1e-12), 0.0)


def dark_direction(
    camera: Cameras,
    rgb: Float[np.ndarray, "h w 3"],
    alpha: Float[np.ndarray, "h w"],
    depth_mm: Float[np.ndarray, "h w"],
    light: NearFieldLight | None,
    *,
    min_alpha: float = HOLE_ALPHA,
) -> Float[np.ndarray, "3"]:
    """World-space unit ray through the centre of the darkest patch of a view.

    Only pixels on a surface count (a hole is not dark but unknown), and only patches that lie inside
    the image: a patch cut by the border would be darker or noisier than the others for that reason
    alone. Half of a patch's pixels must be valid.

    Args:
        camera: the view, a batch of one.
        rgb: rendered colours, [H, W, 3].
        alpha: rendered opacity, [H, W].
        depth_mm: rendered z-depth, world units, [H, W].
        light: the scene's light, if it has one.
        min_alpha: pixels below are holes.

    Returns:
        The ray, or the zero vector when no patch is markedly darker than the view's median, so that
        it favours no direction.

    Source: [ExtraGS, section "Illumination-aware exploration reweighting"], see docs/references.md.
    """
    from scipy.ndimage import uniform_filter

    valid = (alpha >= min_alpha) & np.isfinite(depth_mm) & (depth_mm > 0)
    height, width = valid.shape
    half = max(1, round(width * PATCH_SHARE) // 2)
    size = 2 * half + 1
    if not valid.any() or height < size or width < size:
        return np.zeros(3)
    lit = lit_luminance(camera, rgb.astype(np.float64), depth_mm.astype(np.float64), valid, light)
    share = uniform_filter(valid.astype(np.float64), size, mode="constant")
    mean = uniform_filter(lit, size, mode="constant") / np.maximum(share, 1e-9)
    inner = np.zeros_like(valid)
    inner[half : height - half, half : width - half] = True
    mean = np.where(inner & (share >= 0.5), mean, np.inf)
    row, column = np.unravel_index(int(np.argmin(mean)), mean.shape)
    if not mean[row, column] < DARK_RATIO * float(np.median(lit[valid])):
        return np.zeros(3)
    ray = pixel_rays(camera)[0, row, column]
    return np.asarray(ray / np.linalg.norm(ray))


def illumination_weight(
    dark: Float[np.ndarray, "3"],
    current: Float[np.ndarray, "4 4"],
    candidates: Float[np.ndarray, "a 4 4"],
    strength: float,
) -> Float[np.ndarray, "a"]:
    r"""w_ill = 1 + lambda_l max(0, <d_dark, d_a>) for every candidate [ExtraGS, eq. 13].

    d_a is the direction of the camera's displacement. A pure rotation has none: there the change of
    the optical axis takes its place, so that turning towards the dark is favoured like going there.

    Args:
        dark: unit ray, or zero for no preference.
        current: `world_from_camera` of the current state.
        candidates: `world_from_camera` of the candidates.
        strength: lambda_l.
    """
    displacement = candidates[:, :3, 3] - current[:3, 3]
    turned = candidates[:, :3, 2] - current[:3, 2]
    scale = max(1.0, float(np.abs(current[:3, 3]).max()))
    still = np.linalg.norm(displacement, axis=1) < 1e-9 * scale
    direction = np.where(still[:, None], turned, displacement)
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    direction = np.where(length > 1e-12, direction / np.maximum(length, 1e-12), 0.0)
    return np.asarray(1.0 + strength * np.maximum(0.0, direction @ dark))
