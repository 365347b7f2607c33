"""The start of a coarse scene that goes on from an earlier one of fewer frames."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from extrags.config import CoarseConfig, ContinuationConfig
from extrags.errors import CaptureError, ShapeError
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.thresholds import HOLE_ALPHA
from extrags.training.schedule import Schedule
from extrags.training.starting import starting_gaussians, valid_pixels

__all__ = [
    "EarlierScene",
    "continued_iterations",
    "continued_schedule",
    "continued_start",
    "unexplained_pixels",
]

_log = logging.getLogger(__name__)

WRONG_DEPTH_SHARE = 0.1
"""A rendered depth that differs by more from the depth known there shows another surface."""

ROOM_SHARE = 0.5
"""When the earlier scene is full, so much of their even share of the Gaussians is free for new frames."""

MIN_POINTS = 8
"""Fewer unexplained pixels have neither neighbours nor normals, and say little."""


@dataclass(frozen=True)
class EarlierScene:
    """A coarse scene of some of the frames, to go on from.

    Args:
        scene: its Gaussians and light, in the world of the sequence.
        frames: the sequence's index of each frame it was trained on, in the order of its exposures.
        iterations: of the optimisation that goes on from it.
    """

    scene: Scene
    frames: Int[np.ndarray, "k"]
    iterations: int


def continued_iterations(config: ContinuationConfig, iterations: int, shared: int, frames: int) -> int:
    """Iterations of a scene that goes on from an earlier one.

    Args:
        config: share of the iterations per share of new frames, and its lower bound.
        iterations: those of a scene that starts anew.
        shared: number of training frames the earlier scene was trained on.
        frames: number of all training frames.

    Returns:
        At least one, at most `iterations`.
    """
    share = config.iterations_per_new_share * (frames - shared) / frames
    return max(1, math.ceil(iterations * min(1.0, max(config.min_iterations_share, share))))


def continued_start(
    earlier: EarlierScene, sequence: EndoscopicSequence, chosen: Int[np.ndarray, "m"], config: CoarseConfig
) -> Scene:
    """The earlier scene with exposures for all frames, and with new Gaussians where new frames ask for them.

    New frames begin at the mean exposure: that leaves those of the others, relative to the mean, as they are.
    New Gaussians are placed as those of any start (`starting_gaussians`), on pixels of new frames alone that
    the earlier scene does not explain (`unexplained_pixels`), and as densely as there, but at most as many as
    the new frames' even share of `densify.max_gaussians`. Where that is full, Gaussians of the earlier scene
    that show least make room.

    Args:
        earlier: the scene and its frames.
        sequence: posed frames.
        chosen: the frames that train, all of the earlier scene's among them.
        config: settings of the reconstruction.

    Raises:
        ShapeError: when the earlier scene was trained on a frame that does not train here, its exposures are
            not as many as its frames, or its Gaussians and light are not of the kind the settings ask for.
    """
    scene = earlier.scene.detached().to("cpu")
    _check_fits(earlier, sequence, chosen, config)
    light = scene.light
    if light is not None:
        light = _with_exposures(light, np.searchsorted(chosen, earlier.frames), len(chosen))
    new = np.setdiff1d(chosen, earlier.frames)
    if len(new) == 0:
        return Scene(scene.gaussians, light)
    where = unexplained_pixels(scene, sequence, new)
    # As densely as a start on all frames, whose points are spread over the valid pixels of all of them.
    pixels = valid_pixels(sequence, chosen)
    share = float(where.sum()) / max(1, pixels)
    limit = config.densify.max_gaussians
    # What the frames before explain is not given up for points of new ones.
    points = min(
        math.ceil(share * config.starting_points(pixels)), math.floor(len(new) / len(chosen) * limit)
    )
    kept = math.floor((1 - ROOM_SHARE * len(new) / len(chosen)) * limit)
    scene = Scene(
        scene.gaussians.subset(_strongest(scene, sequence, chosen, min(kept, limit - points))), light
    )
    added = _added_gaussians(scene, sequence, new, where, points, config)
    return scene if added is None else Scene(Gaussians.concatenated(scene.gaussians, added), light)


def continued_schedule(schedule: Schedule, iterations: int) -> Schedule:
    """The schedule of a scene that goes on from an earlier one: fewer iterations, all harmonics at once.

    Args:
        schedule: of a scene that starts anew.
        iterations: how many there are.
    """
    return replace(schedule.resumed(seed=schedule.seed), iterations=iterations)


def unexplained_pixels(
    scene: Scene, sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"]
) -> Bool[np.ndarray, "m h w"]:
    """Valid pixels where the scene has a hole, or another surface than the depth that is known there.

    Args:
        scene: on the processor.
        sequence: posed frames.
        frames: which of them to look at.
    """
    found = np.array(sequence.mask[frames])
    depth = sequence.reliable_depth_mm(frames)
    for position, frame in enumerate(frames):
        with torch.no_grad():
            rendering = scene.render(sequence.cameras[int(frame)])
        unexplained = rendering.alpha[0].numpy() < HOLE_ALPHA
        if depth is not None:
            known = depth[position]
            off = np.abs(rendering.depth[0].numpy() - known) > WRONG_DEPTH_SHARE * known
            unexplained |= (known > 0) & off
        found[position] &= unexplained
    return found


def _check_fits(
    earlier: EarlierScene, sequence: EndoscopicSequence, chosen: Int[np.ndarray, "m"], config: CoarseConfig
) -> None:
    name, scene = sequence.name, earlier.scene
    if not np.isin(earlier.frames, chosen).all() or (chosen[1:] <= chosen[:-1]).any():
        raise ShapeError(
            f"{name}: the earlier scene was trained on {len(earlier.frames)} frames; expected that all of "
            f"them are among the {len(chosen)} training frames, which are in ascending order"
        )
    if scene.gaussians.sh_degree != config.sh_degree:
        raise ShapeError(
            f"{name}: the earlier scene has harmonics of degree {scene.gaussians.sh_degree}, expected "
            f"{config.sh_degree} (coarse.sh_degree)"
        )
    if (scene.light is not None) != config.light.enabled:
        has = "a light" if scene.light is not None else "no light"
        raise ShapeError(f"{name}: the earlier scene has {has}, which coarse.light.enabled contradicts")
    if scene.light is not None and len(scene.light.log_exposure) != len(earlier.frames):
        raise ShapeError(
            f"{name}: the earlier scene has {len(scene.light.log_exposure)} exposures, expected one for each "
            f"of its {len(earlier.frames)} frames"
        )


def _with_exposures(light: NearFieldLight, places: Int[np.ndarray, "k"], count: int) -> NearFieldLight:
    exposures = light.log_exposure.new_zeros(count)
    exposures[torch.from_numpy(places)] = light.log_exposure - light.log_exposure.mean()
    return replace(light, log_exposure=exposures)


def _strongest(
    scene: Scene, sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"], count: int
) -> Int[Tensor, "n"]:
    """Indices of the Gaussians that show most of tissue in the frames, at most `count`, in their order."""
    everyone = len(scene.gaussians)
    if everyone <= count:
        return torch.arange(everyone)
    seen = torch.zeros(everyone)
    for frame in frames:
        with torch.no_grad():
            # Beyond the mask, in the dark corners of a round picture, a scene shows what nobody saw.
            tissue = torch.from_numpy(sequence.mask[[int(frame)]])
            shown = scene.render(
                sequence.cameras[int(frame)], visibility=True, visibility_mask=tissue
            ).visibility_sum
        if shown is None:
            raise ShapeError("the rasteriser returned no visibility")
        seen += shown.sum(dim=0) if shown.ndim > 1 else shown
    order = torch.argsort(seen, descending=True, stable=True)
    return order[: max(0, count)].sort().values


def _added_gaussians(
    scene: Scene,
    sequence: EndoscopicSequence,
    new: Int[np.ndarray, "k"],
    where: Bool[np.ndarray, "k h w"],
    points: int,
    config: CoarseConfig,
) -> Gaussians | None:
    """New Gaussians on unexplained pixels of the new frames; None where there are hardly any."""
    if sequence.depth_mm is not None and bool(((sequence.depth_mm[new] > 0) & where).any()):
        where = where & (sequence.depth_mm[new] > 0)
    if int(where.sum()) < MIN_POINTS or points < MIN_POINTS:
        return None
    try:
        return starting_gaussians(
            sequence,
            new,
            points,
            light=scene.light,
            sh_degree=config.sh_degree,
            thickness=config.thickness,
            seed=config.seed,
            where=where,
        )
    except CaptureError as error:
        # The other frames have shown where surface is; densification may still reach what these show.
        _log.warning("%s: new frames add no starting points: %s", sequence.name, error)
        return None
