"""coarse: Gaussians and light from the training views."""

from __future__ import annotations

from typing import TYPE_CHECKING

from extrags.config import CoarseConfig
from extrags.store import Ref, Slot
from tasks.divergence import keep_last_finite_scene
from tasks.stage import stage

if TYPE_CHECKING:
    from extrags.sequence import EndoscopicSequence
    from extrags.training import TrainingResult

__all__ = [
    "COARSE_VERSION",
    "HISTORY",
    "coarse",
    "refined_frames",
    "save_reconstruction",
]

COARSE_VERSION = 19
"""Of the reconstruction, wherever it begins: scenes that go on from an earlier one follow it."""

HISTORY = "history.json"
"""Training curve: a list of `{iteration, loss, psnr, n_gaussians}`."""


@stage("coarse", version=COARSE_VERSION)
def coarse(slot: Slot, sequence: Ref, config: CoarseConfig, device: str = "cpu") -> None:
    """Optimise the coarse scene; writes `scene/` and `history.json`.

    Where blurred and moved frames were looked for, also writes `frame_weights.json`; what was found is
    said in the counts (`inconsistent_frames`).

    If poses were refined (`refined_poses` in the counts), also writes `refined_poses/`: the poses of the
    training frames that the scene was optimised with. It is optimised on the `device`.
    """
    from extrags.devices import chosen_device
    from extrags.sequence import EndoscopicSequence
    from extrags.training import reconstruct

    frames = slot.load(EndoscopicSequence, sequence)
    if config.train_on == "all":
        slot.counts["held_out_frames_trained_on"] = len(frames.test)
    with keep_last_finite_scene(slot):
        result = reconstruct(frames, config, device=chosen_device(device, "device"))
    save_reconstruction(slot, frames, result)


def save_reconstruction(slot: Slot, frames: EndoscopicSequence, result: TrainingResult) -> None:
    """Write a coarse scene and what was found while it was made; fills the counts.

    Args:
        slot: to write into.
        frames: what it was made from.
        result: of the reconstruction.
    """
    from extrags.training.starting import starts_at_random

    slot.save(result.scene)
    slot.save_json(HISTORY, result.history)
    slot.counts["n_gaussians"] = len(result.scene.gaussians)
    if result.frame_weights is not None:
        slot.save(result.frame_weights)
        if result.frame_weights.statements:
            slot.counts["inconsistent_frames"] = "; ".join(result.frame_weights.statements)
    # Without depth and points there is nothing that says where the surface is: to be told beside the figures.
    slot.counts["random_start"] = int(starts_at_random(frames, frames.train))
    slot.counts["refined_poses"] = int(result.refined is not None)
    if result.refined is not None:
        slot.save(result.refined)
        slot.counts["refined_mean_shift"] = result.refined.mean_shift
        slot.counts["refined_mean_turn_deg"] = result.refined.mean_turn_deg
    slot.counts["corrected_colors"] = int(result.colors is not None)
    if result.colors is not None:
        slot.save(result.colors)


@stage("refined-frames", version=4)
def refined_frames(slot: Slot, sequence: Ref, coarse: Ref) -> None:
    """The whole sequence with the poses and colours that the coarse stage corrected; writes `sequence/`."""
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence
    from extrags.training.frame_colors import FrameColors, with_corrected_colors
    from extrags.training.pose_refinement import RefinedPoses, with_refined_poses

    whole, found = slot.load(EndoscopicSequence, sequence), slot.store.manifest(coarse).counts
    if found.get("refined_poses"):
        whole = with_refined_poses(whole, slot.load(RefinedPoses, coarse).world_from_camera)
    light = slot.load(Scene, coarse).light
    if found.get("corrected_colors") and light is not None:
        whole = with_corrected_colors(whole, slot.load(FrameColors, coarse), light)
    slot.save(whole)
    slot.counts.update(frames=len(whole), train=len(whole.train), test=len(whole.test))
