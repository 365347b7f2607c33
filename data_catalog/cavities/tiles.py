"""Square textures that tile, in a pyramid of halved sizes, and how they are laid on a curved surface.

A tile is looked up along three axes and blended by the surface's normal. What is finer than a pixel's
footprint is averaged away by the pyramid; the slopes' variance that is lost with it is returned, so that
gloss becomes rougher instead of glittering.

Source: the pyramid after Williams, "Pyramidal parametrics", SIGGRAPH 1983; slope variance as roughness after
Toksvig, "Mipmapping normal maps", Journal of Graphics Tools 10 (2005).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

__all__ = ["TILE_CHANNELS", "Tile", "lay"]

TILE_CHANNELS = 8
"""Linear reflectance (3), wetness, slopes along u and v, their mean square, noise for edges."""
_LOOKUP_WIDTH = 1024
_NEGLIGIBLE = 0.03


@dataclass(frozen=True)
class Tile:
    """A pyramid of one square texture.

    Args:
        stacked: two images of four channels each; the levels stand below each other, with a border of one
            texel that repeats the opposite edge.
        side: texels along the finest level.
        texel_mm: size of its texels.
    """

    stacked: tuple[Float[np.ndarray, "r c 4"], Float[np.ndarray, "r c 4"]]
    side: int
    texel_mm: float

    @property
    def levels(self) -> int:
        """How many sizes there are."""
        return int(np.log2(self.side)) - 2

    @classmethod
    def of(cls, channels: Float[np.ndarray, "s s 6"], texel_mm: float) -> Tile:
        """A tile from reflectance (3), wetness, height in mm and noise for edges.

        Args:
            channels: on a square whose side is a power of two.
            texel_mm: size of its texels.
        """
        side = len(channels)
        height = channels[..., 4]
        slope_u = (np.roll(height, -1, 1) - np.roll(height, 1, 1)) / (2 * texel_mm)
        slope_v = (np.roll(height, -1, 0) - np.roll(height, 1, 0)) / (2 * texel_mm)
        square = slope_u**2 + slope_v**2
        first = np.ascontiguousarray(channels[..., :4], dtype=np.float32)
        second = np.stack([slope_u, slope_v, square, channels[..., 5]], axis=2).astype(np.float32)
        levels = int(np.log2(side)) - 2
        stacks: list[list[np.ndarray]] = [[], []]
        for _ in range(levels):
            for image, stack in zip((first, second), stacks, strict=True):
                bordered = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="wrap")
                stack.append(np.pad(bordered, ((0, 0), (0, side + 2 - bordered.shape[1]), (0, 0))))
            first, second = _halved(first), _halved(second)
        one, two = (np.ascontiguousarray(np.concatenate(stack)) for stack in stacks)
        return cls((one, two), side, texel_mm)

    def sample(
        self,
        u_mm: Float[np.ndarray, "n"],
        v_mm: Float[np.ndarray, "n"],
        footprint_mm: Float[np.ndarray, "n"],
    ) -> Float[np.ndarray, "n 8"]:
        """Look-up between texels and between levels.

        Args:
            u_mm: coordinate across.
            v_mm: coordinate down.
            footprint_mm: side of the patch of the surface that one ray stands for.
        """
        import cv2

        count = len(u_mm)
        rows = max(1, -(-count // _LOOKUP_WIDTH))
        size_mm = self.side * self.texel_mm
        u, v = u_mm / size_mm, v_mm / size_mm
        u, v = u - np.floor(u), v - np.floor(v)
        finest = np.log2(np.maximum(footprint_mm, 1e-6) / self.texel_mm)
        level = np.clip(finest, 0, self.levels - 1.001)
        lower = level.astype(np.int64)
        share = (level - lower).astype(np.float32)[:, None]
        tops = np.concatenate([[0], np.cumsum([(self.side >> k) + 2 for k in range(self.levels)])])
        result = np.zeros((count, TILE_CHANNELS), dtype=np.float32)
        for chosen, weight in ((lower, 1 - share), (lower + 1, share)):
            size = self.side >> chosen
            x = np.zeros(rows * _LOOKUP_WIDTH, dtype=np.float32)
            y = np.zeros(rows * _LOOKUP_WIDTH, dtype=np.float32)
            x[:count] = u * size + 0.5
            y[:count] = tops[chosen] + v * size + 0.5
            grid = x.reshape(rows, -1), y.reshape(rows, -1)
            for half, image in enumerate(self.stacked):
                found = cv2.remap(image, *grid, cv2.INTER_LINEAR).reshape(-1, 4)[:count]
                result[:, 4 * half : 4 * half + 4] += weight * found
        return result


def lay(
    tile: Tile,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    footprint_mm: Float[np.ndarray, "n"],
    axes: Float[np.ndarray, "3 3"],
) -> tuple[Float[np.ndarray, "n 8"], Float[np.ndarray, "n 3"]]:
    """Values of a tile laid on a surface from three sides, and the gradient of its height there.

    Args:
        tile: what is laid.
        points: on the surface, in mm.
        normals: unit normals there.
        footprint_mm: side of the patch that one ray stands for.
        axes: the three directions, as rows, orthonormal.

    Returns:
        Channels as in `TILE_CHANNELS` (slopes are the tile's own and mean nothing any more), and the gradient
        in space, [N, 3].
    """
    facing = [_along(normals, axis) ** 2 for axis in axes]
    # The eighth power of the cosine, by squaring: a general power would take longest of all here.
    facing = [(one * one) ** 2 for one in facing]
    total = np.maximum(facing[0] + facing[1] + facing[2], 1e-12)
    shares = [np.where(one < _NEGLIGIBLE * total, np.float32(0), one) for one in facing]
    total = np.maximum(shares[0] + shares[1] + shares[2], 1e-12)
    values = np.zeros((len(points), TILE_CHANNELS), dtype=np.float32)
    gradient = np.zeros((len(points), 3), dtype=np.float32)
    for side in range(3):
        first, second = (side + 1) % 3, (side + 2) % 3
        chosen = np.flatnonzero(shares[side])
        if not len(chosen):
            continue
        # Each side has a place of its own in the tile, or a corner of a box would mirror itself.
        shift = np.float32(0.37 * side * tile.side * tile.texel_mm)
        places = points[chosen]
        u, v = _along(places, axes[first]) + shift, _along(places, axes[second]) + np.float32(0.61) * shift
        found = tile.sample(u, v, footprint_mm[chosen])
        weight = (shares[side][chosen] / total[chosen])[:, None]
        values[chosen] += weight * found
        gradient[chosen] += weight * (found[:, 4:5] * axes[first] + found[:, 5:6] * axes[second])
    return values, gradient


def _halved(image: Float[np.ndarray, "s s 4"]) -> Float[np.ndarray, "t t 4"]:
    half = len(image) // 2
    return np.asarray(image.reshape(half, 2, half, 2, -1).mean(axis=(1, 3)), dtype=np.float32)


def _along(vectors: Float[np.ndarray, "n 3"], axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n"]:
    a, b, c = axis.astype(np.float32)
    return np.asarray(a * vectors[:, 0] + b * vectors[:, 1] + c * vectors[:, 2])
