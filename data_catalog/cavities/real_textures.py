"""Material from real frames: patches of laparoscopy, strewn over a square that tiles.

The data set `laparoscopy_frames_40` (MIT) has them. Of its files in sorted order only those at even positions
are used; the others are for judging.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from data_catalog.cavities.canvas import TEXEL_MM, Canvas
from data_catalog.named_folders import find_folder, not_on_this_machine
from extrags.errors import SourceError

__all__ = ["FOLDER", "judging_files", "photographed_tile", "texture_files"]

FOLDER = "laparoscopy_frames_40"
_PATCH = 256
_TRIES = 60
_GAMMA = 2.2
_DARKEST, _DARK_SHARE, _GLARE, _GLARE_SHARE = 18, 0.01, 245, 0.02
_GREY = 0.06
_SMOOTHED_PX = 48
_PIECE, _PIECES = 124, 6
"""Radius of the pieces in texels, and how many there are down and across. The nearest middle is no farther
than the diagonal of a cell, 122 texels, so that every place is covered."""


def texture_files(folder: Path | None = None) -> list[Path]:
    """The frames that training may use as material.

    Args:
        folder: that holds them; None looks below the data roots.

    Raises:
        SourceNotFoundError: when there is no such folder.
        SourceError: when it holds no frames.
    """
    return _frames(folder)[::2]


def judging_files(folder: Path | None = None) -> list[Path]:
    """The other frames, which no training takes; otherwise as `texture_files`."""
    files = _frames(folder)[1::2]
    if not files:
        raise SourceError("one frame alone; every second one is for judging", file=folder)
    return files


def _frames(folder: Path | None) -> list[Path]:
    found = find_folder((FOLDER,)) if folder is None else folder
    if found is None:
        raise not_on_this_machine("real textures", FOLDER, "no --real-textures")
    files = sorted(found.glob("*.jpg"))
    if not files:
        raise SourceError("no frames (*.jpg)", file=found)
    return files


def photographed_tile(files: list[Path], rng: np.random.Generator) -> Float[np.ndarray, "s s 6"] | None:
    """A tile made of a patch of one frame, as `data_catalog.cavities.materials` paints them.

    Args:
        files: frames to choose from.
        rng: source of randomness.

    Returns:
        None when no patch of the frame drawn shows tissue alone.

    Raises:
        SourceError: when a frame cannot be read.
    """
    import cv2

    file = files[int(rng.integers(len(files)))]
    frame = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if frame is None:
        raise SourceError("not a picture", file=file)
    frame = np.ascontiguousarray(np.asarray(frame)[..., ::-1])
    height, width = frame.shape[:2]
    for _ in range(_TRIES):
        top, left = int(rng.integers(0, height - _PATCH)), int(rng.integers(0, width - _PATCH))
        # The lower corners carry text.
        if top + _PATCH > 0.8 * height and (left < 0.35 * width or left + _PATCH > 0.65 * width):
            continue
        patch = frame[top : top + _PATCH, left : left + _PATCH]
        brightest, darkest = patch.max(axis=2), patch.min(axis=2)
        grey = (brightest.astype(int) - darkest) < _GREY * brightest
        if (brightest < _DARKEST).mean() > _DARK_SHARE or (darkest > _GLARE).mean() > _GLARE_SHARE:
            continue
        if (grey & (brightest < _GLARE)).mean() > _GREY:
            continue
        return _tile(patch, rng)
    return None


def _tile(patch: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "s s 6"]:
    import cv2

    glints = (patch.min(axis=2) > 200).astype(np.uint8)
    if glints.any():
        patch = cv2.inpaint(patch, cv2.dilate(glints, np.ones((5, 5), np.uint8)), 3, cv2.INPAINT_TELEA)
    linear = (patch.astype(np.float32) / 255) ** _GAMMA
    # Tissue under white light is no bluer than it is green: a frame that is has another white.
    green, blue = linear[..., 1].mean(), linear[..., 2].mean()
    linear[..., 2] *= min(1.0, float(green / max(blue, 1e-6)))
    # What is brighter over a wide area is nearer to the lamp, not paler.
    brightness = linear.mean(axis=2)
    wide = cv2.GaussianBlur(brightness, (0, 0), _SMOOTHED_PX, borderType=cv2.BORDER_REFLECT_101)
    albedo = linear / np.maximum(wide, 0.01)[..., None] * rng.uniform(0.2, 0.36)
    fine = brightness / np.maximum(wide, 0.01)
    soft = cv2.GaussianBlur(fine, (0, 0), 1.5, borderType=cv2.BORDER_REFLECT_101)
    strewn = _strewn(np.concatenate([albedo, soft[..., None]], axis=2), rng)
    albedo, soft = strewn[..., :3], strewn[..., 3]
    canvas = Canvas(rng, 2 * _PATCH)
    wet = np.clip(0.8 + 0.2 * canvas.octaves((4.0, 1.5), (1.0, 0.5)), 0.1, 1.4)
    return canvas.packed(np.clip(albedo, 0.01, 0.9), wet, TEXEL_MM * soft, slope=rng.uniform(0.04, 0.15))


def _strewn(patch: Float[np.ndarray, "p p c"], rng: np.random.Generator) -> Float[np.ndarray, "s s c"]:
    """A square twice as large, covered with turned pieces of the patch; it continues over its edges.

    The patch is continued by mirroring where a turned piece is larger than it. A patch that is only mirrored
    shows its symmetry like a kaleidoscope; strewn pieces do not.
    """
    import cv2

    side = 2 * _PATCH
    total = np.zeros((side, side, patch.shape[2]), dtype=np.float32)
    weights = np.zeros((side, side, 1), dtype=np.float32)
    span = np.arange(-_PIECE, _PIECE)
    rho = np.sqrt(span[:, None] ** 2 + span**2) / _PIECE
    # Sharp: where pieces meet, one of them wins within a few texels, and hardly anything is blurred.
    weight = np.clip(1 - rho, 0, 1)[..., None].astype(np.float32) ** 6
    step = side // _PIECES
    for row in range(_PIECES):
        for column in range(_PIECES):
            turn = cv2.getRotationMatrix2D((_PIECE, _PIECE), float(rng.uniform(0, 360)), 1.0)
            turn[:, 2] += rng.uniform(-0.25, 0.25, 2) * _PATCH + _PATCH / 2 - _PIECE
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            piece = cv2.warpAffine(
                patch, turn, (2 * _PIECE, 2 * _PIECE), flags=flags, borderMode=cv2.BORDER_REFLECT_101
            )
            y, x = np.array([row, column]) * step + rng.integers(0, step, 2)
            block = np.ix_((y + span) % side, (x + span) % side)
            total[block] += weight * piece
            weights[block] += weight
    return total / weights
