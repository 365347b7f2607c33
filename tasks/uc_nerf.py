"""uc-nerf: the baseline's radiance field instead of the coarse scene, and its held-out views."""

from __future__ import annotations

from extrags.config import UcNerfConfig
from extrags.store import Ref, Slot
from tasks.coarse import HISTORY
from tasks.stage import stage

__all__ = ["render_uc_nerf", "uc_nerf"]


@stage("uc-nerf", version=2)
def uc_nerf(slot: Slot, sequence: Ref, config: UcNerfConfig) -> None:
    """Train the baseline on the training frames; writes `uc_nerf/` and `history.json`."""
    from extrags.baselines.uc_nerf.training import train
    from extrags.sequence import EndoscopicSequence

    result = train(slot.load(EndoscopicSequence, sequence), config)
    slot.save(result.scene)
    slot.save_json(HISTORY, result.history)
    slot.counts["parameters"] = sum(value.numel() for value in result.scene.network.parameters())


@stage("uc-nerf-render", version=3)
def render_uc_nerf(slot: Slot, scene: Ref, sequence: Ref) -> None:
    """What `evaluate-render` does, for the baseline; writes `renders/` and, with true depth, `mesh/`."""
    from extrags.baselines.uc_nerf import rendering
    from extrags.baselines.uc_nerf.scene import UcNerf
    from extrags.sequence import EndoscopicSequence

    shown, frames = slot.load(UcNerf, scene), slot.load(EndoscopicSequence, sequence)
    views = rendering.render(shown, frames)
    slot.save(views)
    slot.counts["views"] = len(views)
    if frames.depth_mm is None:
        return
    mesh = rendering.surface(shown, frames)
    if mesh is not None:
        slot.save(mesh)
    slot.counts["triangles"] = 0 if mesh is None else len(mesh.triangles)
