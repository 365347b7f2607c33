"""The true surface of a sequence: the source's own geometry, else its true depth fused."""

from __future__ import annotations

from extrags.metrics.surface import TrueSurface, surface_from_depth
from extrags.sequence import EndoscopicSequence
from extrags.surface import Mesh

__all__ = ["true_surface"]


def true_surface(sequence: EndoscopicSequence) -> TrueSurface | None:
    """Ground truth that a reconstruction of the sequence is compared with; None where there is none.

    The wall of a phantom or a cavern is made again from the settings that the sequence carries in `truth`;
    where poses were estimated, the wall is in another world than they are, and depth takes its place.
    """
    phantom = sequence.truth.get("phantom")
    if phantom is not None and sequence.truth.get("world") != "estimated":
        from data_catalog.phantom.config import PhantomConfig
        from data_catalog.phantom.geometry import build_wall

        wall = build_wall(PhantomConfig.model_validate(phantom))
        return TrueSurface(Mesh(wall.vertices, wall.triangles), "mesh")
    caverns = sequence.truth.get("caverns")
    if caverns is not None and sequence.truth.get("world") != "estimated":
        from data_catalog.caverns.config import CavernConfig
        from data_catalog.caverns.geometry import build_cavern

        cavern = build_cavern(CavernConfig.model_validate(caverns).scene).wall
        return TrueSurface(Mesh(cavern.vertices, cavern.triangles), "mesh")
    return surface_from_depth(sequence)
