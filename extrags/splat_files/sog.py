"""SOG of PlayCanvas (version 2): attributes as lossless WebP images and a `meta.json`, in one zip.

Positions are 16 bits of sign(x) ln(1 + |x|) in two images, rotations 3 x 8 bits with the largest component
left out, scales and colours 8-bit indices into codebooks of 256 numbers, higher harmonics 16-bit indices
into a palette whose entries are indices into a codebook again.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped, UInt8

from extrags.gaussians import Gaussians
from extrags.output_files import whole_file
from extrags.splat_files.packing import (
    SCALE_LIMIT,
    largest_component,
    levels,
    neighbours_together,
    unit_quaternions,
)

__all__ = ["write_sog"]

_CODEBOOK = 256
_LLOYD_ROUNDS = 12
_PALETTE_LARGEST = 65_536
_PALETTE_ROW = 64
_PALETTE_ROUNDS = 4
_SAMPLE_PER_ENTRY = 4
_CELLS_SEARCHED = 16
_COMPARED_AT_ONCE = 1 << 18
"""Numbers that stay in a processor's cache."""
_TIME = (1980, 1, 1, 0, 0, 0)
"""The earliest a zip knows: the same scene gives the same file."""


def write_sog(gaussians: Gaussians, path: Path) -> None:
    """Write a bundled SOG; Gaussians are reordered along a space-filling curve.

    Args:
        gaussians: with colours, not albedo (`bake_light`).
        path: file to write; viewers expect it to end in `.sog`.

    Raises:
        CaptureError: when there are no Gaussians.
    """
    gaussians, n = neighbours_together(gaussians.for_file(path)), len(gaussians)
    images: dict[str, UInt8[np.ndarray, "h w 4"]] = {}
    width = -(-int(np.ceil(np.sqrt(n))) // 4) * 4
    height = -(-n // (width * 4)) * 4

    def image(*channels: Shaped[np.ndarray, "n"]) -> UInt8[np.ndarray, "h w 4"]:
        """Three or four channels, one Gaussian per pixel; without a fourth it is opaque."""
        pixels = np.full((height * width, 4), 255, dtype=np.uint8)
        for index, channel in enumerate(channels):
            pixels[:n, index] = channel
        pixels[n:, :3] = 0
        return pixels.reshape(height, width, 4)

    means = gaussians.means.double().numpy()
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(axis=0), logs.max(axis=0)
    fixed = levels((logs - low) / np.where(high > low, high - low, 1.0), 16)
    images["means_l.webp"] = image(*(fixed & 255).T)
    images["means_u.webp"] = image(*(fixed >> 8).T)
    largest, rest = largest_component(unit_quaternions(gaussians.quats.numpy()))
    images["quats.webp"] = image(*levels(rest * np.sqrt(2) * 0.5 + 0.5, 8).T, 252 + largest)
    scales = gaussians.scales.numpy().clip(-SCALE_LIMIT, SCALE_LIMIT)
    scale_labels, scale_codebook = _codebook(scales)
    images["scales.webp"] = image(*scale_labels.T)
    color_labels, color_codebook = _codebook(gaussians.sh0[:, 0].numpy())
    opacity = levels(gaussians.opacities.sigmoid().numpy(), 8)
    images["sh0.webp"] = image(*color_labels.T, opacity)
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "extrags"},
        "count": n,
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": {"codebook": scale_codebook.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_codebook.tolist(), "files": ["sh0.webp"]},
    }
    if gaussians.sh_degree:
        shN = gaussians.shN.numpy()
        palette, labels = _palette(shN.reshape(n, -1))
        entries, codebook = _codebook(palette)
        rows = -(-len(palette) // _PALETTE_ROW)
        centroids = np.full((rows * _PALETTE_ROW, shN.shape[1], 4), 255, dtype=np.uint8)
        centroids[: len(palette), :, :3] = entries.reshape(len(palette), -1, 3)
        images["shN_centroids.webp"] = centroids.reshape(rows, _PALETTE_ROW * shN.shape[1], 4)
        images["shN_labels.webp"] = image(labels & 255, labels >> 8, np.zeros_like(labels))
        meta["shN"] = {
            "count": len(palette),
            "bands": gaussians.sh_degree,
            "codebook": codebook.tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    with whole_file(path) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as bundle:
        bundle.writestr(zipfile.ZipInfo("meta.json", _TIME), json.dumps(meta))
        for name, pixels in images.items():
            bundle.writestr(zipfile.ZipInfo(name, _TIME), _webp(pixels))


def _codebook(values: Float[np.ndarray, "n k"]) -> tuple[Int[np.ndarray, "n k"], Float[np.ndarray, "c"]]:
    """At most 256 numbers for all values, by Lloyd's algorithm in one dimension from their quantiles.

    Returns:
        Index of each value's number, and the 256 numbers, ascending; unused ones repeat the largest.
    """
    flat = np.sort(values.astype(np.float64), axis=None)
    total = np.concatenate([[0.0], np.cumsum(flat)])
    # Between quantiles, which spend all on the bulk, and an even grid, which spends half on the tails.
    share = (np.arange(_CODEBOOK) + 0.5) / _CODEBOOK
    centers = 0.5 * (np.quantile(flat, share) + flat[0] + share * (flat[-1] - flat[0]))
    for _ in range(_LLOYD_ROUNDS):
        edges = np.concatenate([[0], np.searchsorted(flat, 0.5 * (centers[1:] + centers[:-1])), [len(flat)]])
        count = np.diff(edges)
        mean = np.diff(total[edges]) / np.maximum(count, 1)
        centers = np.sort(np.where(count > 0, mean, centers))
    numbers = centers.astype(np.float32)
    labels = np.searchsorted(0.5 * (numbers[1:] + numbers[:-1]), values)
    return labels, numbers


def _palette(
    vectors: Float[np.ndarray, "n k"],
) -> tuple[Float[np.ndarray, "p k"], Int[np.ndarray, "n"]]:
    """Representative vectors by k-means, and which of them each vector takes."""
    n = len(vectors)
    count = min(_PALETTE_LARGEST, max(1, n // 2 if n > 2048 else n))
    chosen = np.random.default_rng(0).permutation(n)
    centers = vectors[np.sort(chosen[:count])]
    # Four vectors for each entry tell where it lies; all of them would take several times as long.
    sample = vectors[np.sort(chosen[: _SAMPLE_PER_ENTRY * _PALETTE_LARGEST])]
    for _ in range(_PALETTE_ROUNDS):
        labels = _nearest(sample, centers)
        used = np.bincount(labels, minlength=count)
        for column in range(centers.shape[1]):
            sums = np.bincount(labels, weights=sample[:, column], minlength=count)
            centers[:, column] = np.where(used > 0, sums / np.maximum(used, 1), centers[:, column])
    return centers, _nearest(vectors, centers)


def _nearest(vectors: Float[np.ndarray, "n k"], centers: Float[np.ndarray, "p k"]) -> Int[np.ndarray, "n"]:
    """Which centre is nearest to each vector, or nearly so where the nearest lies in a cell farther off.

    Harmonics of degree 3 have 45 dimensions, in which trees search nearly everything. So centres and vectors
    are sorted into cells, and a vector is compared with the centres of the cells next to its own.
    """
    seeds = centers[np.linspace(0, len(centers) - 1, math.isqrt(len(centers))).round().astype(np.int64)]
    if len(seeds) <= _CELLS_SEARCHED:
        return _nearest_of_all(vectors, centers)
    apart = ((seeds[:, None] - seeds) ** 2).sum(axis=2)
    cell_of_center, cell_of_vector = (_nearest_of_all(rows, seeds) for rows in (centers, vectors))
    found = np.empty(len(vectors), dtype=np.int64)
    for cell, distances in enumerate(apart):
        rows = np.flatnonzero(cell_of_vector == cell)
        near = np.argsort(distances, kind="stable")[:_CELLS_SEARCHED]
        candidates = np.flatnonzero(np.isin(cell_of_center, near))
        if not len(candidates):
            candidates = np.arange(len(centers))
        found[rows] = candidates[_nearest_of_all(vectors[rows], centers[candidates])]
    return found


def _nearest_of_all(
    vectors: Float[np.ndarray, "n k"], centers: Float[np.ndarray, "p k"]
) -> Int[np.ndarray, "n"]:
    """The same by comparing all with all: |c|^2 - 2 v c, the square of the distance less |v|^2."""
    left = np.concatenate([vectors, np.ones((len(vectors), 1), vectors.dtype)], axis=1)
    right = np.concatenate([-2 * centers, (centers**2).sum(axis=1, keepdims=True)], axis=1).T
    found = np.empty(len(vectors), dtype=np.int64)
    rows = max(1, _COMPARED_AT_ONCE // len(centers))
    for begun in range(0, len(vectors), rows):
        found[begun : begun + rows] = (left[begun : begun + rows] @ right).argmin(axis=1)
    return found


def _webp(pixels: UInt8[np.ndarray, "h w 4"]) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    # exact: colours of transparent pixels count here.
    Image.fromarray(pixels).save(buffer, "WEBP", lossless=True, exact=True, quality=100, method=4)
    return buffer.getvalue()
