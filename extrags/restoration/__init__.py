"""Restoration of virtual views: restorers behind one protocol, their training data, errors and benchmark.

Layers, bottom to top, each importing from those below it only: `protocol` and `description` (what a
restorer is and how it is saved); `clips`, `uncertainty` and `training_data`; `classical`; `diffusion`;
`pretrained`; `backends` (restorers by name); `trajectories` and `benchmark`.

To add a backend: a module with a `protocol.Backend`, and its entry in `extrags.config.backends.BACKENDS`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from extrags.config.backends import BACKENDS

if TYPE_CHECKING:
    from extrags.restoration.backends import (
        backend_of,
        check_restorer,
        load_enhancer,
        register_backend,
        restorer_digest,
        train_enhancer,
    )
    from extrags.restoration.protocol import Backend, Clip, Enhancer, Restoration

__all__ = [
    "BACKENDS",
    "Backend",
    "Clip",
    "Enhancer",
    "Restoration",
    "backend_of",
    "check_restorer",
    "load_enhancer",
    "register_backend",
    "restorer_digest",
    "train_enhancer",
]


def __getattr__(name: str) -> Any:
    # On first use, so that importing this package loads no torch.
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    owner = "protocol" if name[0].isupper() else "backends"
    return getattr(importlib.import_module(f"{__name__}.{owner}"), name)
