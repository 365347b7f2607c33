"""surface: a mesh from rendered depth."""

from __future__ import annotations

from extrags.config import SurfaceConfig
from extrags.store import Ref, Slot
from tasks.stage import stage

__all__ = ["surface"]


@stage("surface", version=4)
def surface(slot: Slot, scene: Ref, sequence: Ref, config: SurfaceConfig) -> None:
    """Fuse the training views' rendered depth; writes `mesh/` and `mesh.ply`."""
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence
    from extrags.surface import fuse_surface

    frames = slot.load(EndoscopicSequence, sequence)
    mesh = fuse_surface(slot.load(Scene, scene), frames.training_cameras, config, masks=frames.training_masks)
    slot.save(mesh)
    mesh.write_ply(slot.path / "mesh.ply")
    slot.counts.update(vertices=len(mesh.vertices), triangles=len(mesh.triangles))
