"""Endoscopic scenes as 3D Gaussians: reconstructed, explored, restored, fine-tuned and evaluated.

The front door of the library: what most programs need is here, and loaded when it is first used, so that
`import extrags` stays fast.

    import extrags

    sequence = extrags.read("phantom/0@sparse")
    result = extrags.run_pipeline(sequence, extrags.PROFILES["quick"])
    print(result.evaluations["final"].metrics["psnr"])
    result.scene.gaussians.write_ply("scene.ply")

The stages can be called one by one: `read`, `estimate_poses`, `estimate_depth`, `reconstruct`, `assess`,
`fuse_surface`, `carve`, `explore`, `restore`, `finetune`, `evaluate`; `extrags.pipeline` says how they
follow each other. All names are listed in `extrags.api`.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from extrags.api import *  # noqa: F403

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    # The import system asks for modules and for names of its own before it looks elsewhere: not for us.
    if name.startswith("_") or _is_module(name):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    api = import_module(f"{__name__}.api")
    if name not in api.__all__:
        from extrags.errors import did_you_mean

        hint = did_you_mean(name, api.__all__)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")
    value = globals()[name] = getattr(api, name)
    return value


def _is_module(name: str) -> bool:
    found = find_spec(f"{__name__}.{name}")
    # A folder without code, which an older checkout may have left, has no origin.
    return found is not None and found.origin is not None


def __dir__() -> list[str]:
    return sorted(["__version__", *import_module(f"{__name__}.api").__all__])
