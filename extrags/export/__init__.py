"""What other programs open: meshes with texture, point clouds, camera paths and videos of a scene.

Files of Gaussians are in `extrags.splat_files`; sequences as COLMAP model or `transforms.json` are written by
the catalogue's readers of these formats.
"""

from __future__ import annotations

from extrags.export.camera_path import CameraPath as CameraPath
from extrags.export.camera_path import flight_through as flight_through
from extrags.export.camera_path import read_camera_path as read_camera_path
from extrags.export.camera_path import write_camera_path as write_camera_path
from extrags.export.mesh_files import write_mesh as write_mesh
from extrags.export.points import write_points as write_points
from extrags.export.textured import ColoredMesh as ColoredMesh
from extrags.export.textured import colored_mesh as colored_mesh
from extrags.export.video import fly_through as fly_through
from extrags.export.video import write_video as write_video

__all__ = [
    "CameraPath",
    "ColoredMesh",
    "colored_mesh",
    "flight_through",
    "fly_through",
    "read_camera_path",
    "write_camera_path",
    "write_mesh",
    "write_points",
    "write_video",
]
