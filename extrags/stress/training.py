"""Rows of whole reconstructions: the same in any unit, place, and number of frames and threads."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial

import numpy as np
import torch

from extrags.config import CoarseConfig, DensifyConfig
from extrags.errors import ExtragsError
from extrags.metrics.image import psnr
from extrags.sequence import EndoscopicSequence
from extrags.stress.inputs import FARTHEST_OFFSET_MM, IMAGES, SCALES, TURN, plane_recording
from extrags.stress.rows import (
    EXACT,
    FINITE,
    Effort,
    Row,
    Trial,
    all_finite,
    differs,
    finite_or_refused,
    with_threads,
)
from extrags.training import reconstruct

__all__ = ["CONFIG", "ROWS", "quality"]

LEVELS = 255
"""Of the images' eight bits: reconstructions whose errors differ by less than one level are equally good."""
# Scenes are judged at the poses that are said; corrected ones would belong to others.
CONFIG = CoarseConfig(
    iterations=200,
    max_points=300,
    sh_degree=0,
    densify=DensifyConfig(max_gaussians=400),
    refine_poses=False,
)
FRAMES = (1, 2, 10, 100, 1000)


def quality(sequence: EndoscopicSequence, *, lit: bool = True) -> float:
    """Root of the mean squared error of the first training views, in levels."""
    config = CONFIG.model_copy(update={"light": CONFIG.light.model_copy(update={"enabled": lit})})
    scene = reconstruct(sequence, config).scene
    shown = sequence.cameras[:4]
    with torch.no_grad():
        exposure = None if scene.light is None else scene.light.exposures()[:4]
        rgb = scene.render(shown, exposure=exposure).rgb.clamp(0, 1)
    found = psnr(rgb, torch.from_numpy(sequence.rgb[: len(shown)].astype(np.float32) / 255))
    return math.inf if found is None else LEVELS * 10 ** (-found / 20)


def _units(effort: Effort) -> Iterator[Trial]:
    base = quality(plane_recording(6))
    for scale in SCALES:
        yield f"times {scale:g}", abs(quality(plane_recording(6, unit=scale)) - base)
    for offset in (1e2, 1e4, FARTHEST_OFFSET_MM):
        yield f"{offset:g} from the origin", abs(quality(plane_recording(6, offset_mm=offset)) - base)
    yield "turned", abs(quality(plane_recording(6, turn=TURN)) - base)


def _without_light(effort: Effort) -> Iterator[Trial]:
    base = quality(plane_recording(6), lit=False)
    for scale in SCALES:
        try:
            yield f"times {scale:g}", abs(quality(plane_recording(6, unit=scale), lit=False) - base)
        except ExtragsError as error:
            # A scene so small lies before the near plane; no other is refused.
            if scale >= 1:
                raise
            yield f"times {scale:g}, refused: {error}", 0.0


def _extremes(effort: Effort) -> Iterator[Trial]:
    for kind in IMAGES:
        yield kind, _not_finite(plane_recording(3, kind=kind))
    for frames in FRAMES:
        yield f"{frames} frames", _not_finite(plane_recording(frames))
    for size in ((1, 1), (1, 9), (9, 1), (2, 2)):
        # Here alone a reconstruction may say that there is too little to go by.
        found = finite_or_refused(partial(_reconstructed, plane_recording(3, size=size)))
        yield f"{size[0]}x{size[1]}", found


def _not_finite(sequence: EndoscopicSequence) -> float:
    return 0.0 if all_finite(_reconstructed(sequence)) else math.inf


def _reconstructed(sequence: EndoscopicSequence) -> list[dict[str, torch.Tensor]]:
    scene = reconstruct(sequence, CONFIG.model_copy(update={"iterations": 40})).scene
    return [scene.gaussians.parameters(), {} if scene.light is None else scene.light.parameters()]


def _repeat(effort: Effort) -> Iterator[Trial]:
    run = partial(_parameters, plane_recording(4, size=(70, 50)))
    first = with_threads(1, run)
    for threads in (1, 2, 4):
        yield f"{threads} threads", differs(with_threads(threads, run), first)


def _parameters(sequence: EndoscopicSequence) -> dict[str, torch.Tensor]:
    return reconstruct(sequence, CONFIG.model_copy(update={"iterations": 60})).scene.gaussians.parameters()


ROWS = (
    Row(
        "reconstruction",
        "scale 1e-3 to 1e4, offset to 1e5, rotation",
        "change of the error, in levels of 8 bits",
        1.0,
        _units,
    ),
    Row(
        "reconstruction",
        "scale 1e-3 to 1e4, no light",
        "change of the error, in levels of 8 bits",
        1.0,
        _without_light,
    ),
    Row("reconstruction", "images without content, 1 to 1000 frames", "scenes not finite", FINITE, _extremes),
    Row("reconstruction", "repeat and threads", "results that differ", EXACT, _repeat),
)
