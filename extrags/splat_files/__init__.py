"""Files of Gaussians that other programs read and write: PLY, compressed PLY, SPZ and SOG.

These formats hold colours; none of them knows a lamp on the camera. `bake_light` makes colours of albedo and
light, and a PLY can keep the light beside the albedo in its header.
"""

from __future__ import annotations

from extrags.splat_files.baking import bake_light as bake_light
from extrags.splat_files.baking import bake_recorded_light as bake_recorded_light
from extrags.splat_files.compressed_ply import write_compressed_ply as write_compressed_ply
from extrags.splat_files.importing import ImportedScene as ImportedScene
from extrags.splat_files.importing import import_scene as import_scene
from extrags.splat_files.ply import read_ply_scene as read_ply_scene
from extrags.splat_files.ply import write_ply_scene as write_ply_scene
from extrags.splat_files.reading import read_splat_file as read_splat_file
from extrags.splat_files.sog import write_sog as write_sog
from extrags.splat_files.spz import read_spz as read_spz
from extrags.splat_files.spz import write_spz as write_spz

__all__ = [
    "ImportedScene",
    "bake_light",
    "bake_recorded_light",
    "import_scene",
    "read_ply_scene",
    "read_splat_file",
    "read_spz",
    "write_compressed_ply",
    "write_ply_scene",
    "write_sog",
    "write_spz",
]
