"""Endoscopic scenes as 3D Gaussians: reconstructed, explored, restored, evaluated.

The library half of extrags: it knows no Prefect and no Dask. Modules are imported on demand, so that
`import extrags` stays fast.
"""

from __future__ import annotations

__all__ = ["__version__"]

__version__ = "0.1.0"
