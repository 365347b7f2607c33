"""freespace: occupancy and clearance."""

from __future__ import annotations

from extrags.config import FreespaceConfig
from extrags.store import Ref, Slot
from tasks.stage import stage

__all__ = ["freespace"]


@stage("freespace", version=7)
def freespace(slot: Slot, scene: Ref, surface: Ref, sequence: Ref, config: FreespaceConfig) -> None:
    """Carve the space the training views look through; writes `freespace/`."""
    from extrags.freespace import carve
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence
    from extrags.surface import Mesh
    from extrags.surface_error import surface_error_mm

    frames = slot.load(EndoscopicSequence, sequence)
    mesh = slot.load(Mesh, surface)
    space = carve(
        slot.load(Scene, scene),
        mesh,
        frames.training_cameras,
        config,
        surface_error_mm=surface_error_mm(mesh, frames),
        masks=frames.training_masks,
    )
    slot.save(space)
    slot.counts.update(grid_size=space.grid_size, free_share=round(space.free_share, 4))
