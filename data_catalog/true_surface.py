"""The true surface of a sequence: the source's own geometry, else its true depth fused."""

from __future__ import annotations

import weakref

from data_catalog.ct_colon.model import FOLDER
from data_catalog.named_folders import find_folder, not_on_this_machine
from extrags.metrics.surface import TrueSurface, surface_from_depth
from extrags.sequence import EndoscopicSequence
from extrags.surface import Mesh

__all__ = ["true_surface"]

_last: list[tuple[weakref.ref[EndoscopicSequence], TrueSurface | None]] = []
"""The sequence that was asked for last, as long as it is in memory, and its surface."""


def true_surface(sequence: EndoscopicSequence) -> TrueSurface | None:
    """Ground truth that a reconstruction of the sequence is compared with; None where there is none.

    Who asks again for that of the same object gets the same one: a run evaluates several scenes on the same
    frames, and to fuse a thousand large ones takes minutes.

    The wall of a phantom, a cavern or a stretch of the colon is made again from the settings that the
    sequence carries in `truth`; where poses were estimated, the wall is in another world than they are, and
    depth takes its place.

    Raises:
        SourceNotFoundError: for a stretch of the colon whose model is no longer on this machine.
    """
    for of, known in _last:
        if of() is sequence:
            return known
    found = _made(sequence)
    _last[:] = [(weakref.ref(sequence, lambda _: _last.clear()), found)]
    return found


def _made(sequence: EndoscopicSequence) -> TrueSurface | None:
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
    colon = sequence.truth.get("ct_colon")
    if colon is not None and sequence.truth.get("world") != "estimated":
        from data_catalog.ct_colon.config import CtColonConfig
        from data_catalog.ct_colon.stretch import build_stretch

        folder = find_folder((FOLDER,))
        if folder is None:
            # Its files have gone since it was read. Fused depth would be another surface, and other figures.
            raise not_on_this_machine(f"the surface of {sequence.name}", FOLDER, "another sequence")
        stretch = build_stretch(CtColonConfig.model_validate(colon).scene, folder).wall
        return TrueSurface(Mesh(stretch.vertices, stretch.triangles), "mesh")
    return surface_from_depth(sequence)
