"""Free space for virtual cameras: bounding volume, occupancy grid and clearance."""

from extrags.freespace.carving import carve as carve
from extrags.freespace.grid import FREE as FREE
from extrags.freespace.grid import OCCUPIED as OCCUPIED
from extrags.freespace.grid import UNKNOWN as UNKNOWN
from extrags.freespace.grid import FreeSpace as FreeSpace
from extrags.freespace.visibility import voxel_visibility as voxel_visibility

__all__ = ["FREE", "OCCUPIED", "UNKNOWN", "FreeSpace", "carve", "voxel_visibility"]
