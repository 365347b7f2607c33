"""One cavity, ready to be photographed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from data_catalog.cavities.growths import draw_growths, stamp
from data_catalog.cavities.noise import stream
from data_catalog.cavities.shapes import Kind, Shape, make_shape
from data_catalog.cavities.skin import Skin, make_skin
from data_catalog.cavities.surface import Lattice, Wall, contour
from data_catalog.ray_casting import RayCaster

__all__ = ["NODES", "Cavity", "build_cavity"]

NODES = 1_600_000
"""Of the lattice that a wall is contoured on."""
_SMOOTHED = 0.8
"""Ridges sharper than the lattice would be jagged."""


@dataclass(frozen=True)
class Cavity:
    """The wall of a cavity with its skin.

    Args:
        shape: before growths.
        lattice: clearance with growths.
        wall: the mesh.
        rays: the mesh as a target.
        skin: of the wall.
    """

    shape: Shape
    lattice: Lattice
    wall: Wall
    rays: RayCaster
    skin: Skin


def build_cavity(
    scene: int,
    kind: Kind,
    *,
    nodes: int = NODES,
    photograph: Float[np.ndarray, "s s 6"] | None = None,
) -> Cavity:
    """Make a cavity; the same number and kind give the same one.

    Args:
        scene: seed of everything random.
        kind: what it is like.
        nodes: of the lattice.
        photograph: a tile made of a real frame, for the ordinary tissue.

    Raises:
        CaptureError: when the clearance drawn has no wall.
    """
    shape = make_shape(kind, stream(scene, "shape"))
    plain = Lattice.of(shape.clearance, shape.low_mm, shape.high_mm, nodes)
    growths = draw_growths(kind, contour(plain), shape.radius_mm, stream(scene, "growths"))
    lattice = (stamp(plain, growths) if growths else plain).without_islands().smoothed(_SMOOTHED)
    wall = contour(lattice)
    skin = make_skin(kind, wall, growths, lattice.step_mm, stream(scene, "skin"), shape.radius_mm, photograph)
    return Cavity(shape, lattice, wall, RayCaster(wall.vertices, wall.triangles), skin)
