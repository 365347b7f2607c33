"""Brief reconstructions without some training frames, which then serve as ground truth.

Held-out frames are never used: a leave-out reconstruction sees fewer frames than the scene it stands for.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrags.config import CoarseConfig
from extrags.errors import CaptureError
from extrags.facing import with_facing
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training.frame_weights import FrameWeights, weighted_views
from extrags.training.normal_term import NormalTerm
from extrags.training.optimise import optimise
from extrags.training.reconstruction import coarse_schedule, scene_extent, smallest_footprint
from extrags.training.starting import median_depth, starting_gaussians, valid_pixels
from extrags.training.views import epochs

__all__ = ["MIN_FRAMES", "leave_out_folds", "log_exposures", "partial_scene", "show_tissue"]

MIN_FRAMES = 4
"""With fewer training frames none can be left out."""
BLOCKS_PER_FOLD = 3
"""Runs of neighbouring frames that a fold leaves out, so that gaps are like those of a new trajectory."""


def leave_out_folds(
    frames: Int[np.ndarray, "n"], folds: int
) -> list[tuple[Int[np.ndarray, "kept"], Int[np.ndarray, "left"]]]:
    """Kept and left-out frames of each fold; every frame is left out exactly once, in runs.

    With one fold a third of the frames is left out.

    Args:
        frames: the training frames.
        folds: number of folds; there are no more of them than frames, since each leaves out at least one.

    Raises:
        CaptureError: with fewer than four frames.
    """
    if len(frames) < MIN_FRAMES:
        raise CaptureError(
            f"{len(frames)} training frames are too few to leave some out and train a restorer on (at least "
            f"{MIN_FRAMES} are needed); set enhance.backend to classical"
        )
    folds = min(folds, len(frames))
    parts = max(folds, 2) if folds != 1 else 3
    blocks = min(BLOCKS_PER_FOLD * parts, len(frames))
    owner = np.arange(len(frames)) * blocks // len(frames) % parts
    return [(frames[owner != fold], frames[owner == fold]) for fold in range(folds)]


def show_tissue(sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"]) -> bool:
    """Whether any of the frames has a valid pixel: without one there is nothing to reconstruct from.

    Args:
        sequence: frames.
        frames: which of them to look at.
    """
    return any(bool(sequence.mask[frame].any()) for frame in frames)


def partial_scene(
    scene: Scene,
    sequence: EndoscopicSequence,
    coarse: CoarseConfig,
    kept: Int[np.ndarray, "k"],
    *,
    iterations: int,
    seed: int,
    stage: str,
    frame_weights: FrameWeights | None = None,
) -> Scene:
    """A brief reconstruction from the kept frames, under the coarse scene's light.

    A brief reconstruction is too short to learn the light: with a new one, it would have errors of brightness
    that the coarse scene does not have.

    Args:
        scene: the coarse scene, trained on `sequence.train`; the reconstruction runs where it is.
        sequence: posed frames.
        coarse: settings the scene was reconstructed with.
        kept: training frames to use.
        iterations: optimisation steps.
        seed: of all random sampling.
        stage: named in progress events.
        frame_weights: what was found of the kept frames; None looks for it, where the settings weigh frames.

    Raises:
        DivergedError: when the optimisation does not stay finite.
    """
    light = scene.light
    if light is not None:
        light = replace(light, log_exposure=log_exposures(scene, sequence, kept))
    brief = coarse.model_copy(
        update={
            "iterations": iterations,
            "sh_every": max(1, iterations // 3),
            "seed": seed,
            # What would only be reported is not looked for.
            "inconsistent_frames": "weight" if coarse.inconsistent_frames == "weight" else "ignore",
        }
    )
    start = starting_gaussians(
        sequence,
        kept,
        brief.starting_points(valid_pixels(sequence, kept)),
        light=light,
        sh_degree=brief.sh_degree,
        seed=brief.seed,
        thickness=brief.thickness,
        exposures=None if light is None else light.exposures().cpu().numpy(),
    )
    views = [view.to(scene.device) for view in weighted_views(sequence, kept, brief, frame_weights)[0]]
    order = epochs(len(views), np.random.default_rng(brief.seed))
    schedule = coarse_schedule(brief, scene_extent(sequence, kept), median_depth(sequence, kept), stage)
    if brief.normal_weight > 0:
        schedule = replace(schedule, normals=NormalTerm.at(start.means.numpy(), brief, iterations))
    footprint = smallest_footprint(coarse, sequence.cameras[kept])
    begin = Scene(start.to(scene.device), light)
    found = optimise(begin, lambda _: views[next(order)], schedule, footprint=footprint).scene
    # What is made of it knows its sides, and is compared with it.
    return with_facing(found, [sequence.cameras[kept]]) if coarse.one_sided else found


def log_exposures(
    scene: Scene, sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"]
) -> Float[Tensor, "m"]:
    """Log-exposures of training frames in the coarse scene, zero where it has no light.

    Args:
        scene: the coarse scene, trained on `sequence.train`.
        sequence: its frames.
        frames: some of the training frames.
    """
    if scene.light is None:
        return torch.zeros(len(frames))
    position = {int(frame): index for index, frame in enumerate(sequence.train)}
    return scene.light.log_exposure[torch.tensor([position[int(frame)] for frame in frames])]
