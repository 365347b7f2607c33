"""The registry of restorer backends, by the names that `enhance.backend` takes.

Settings are validated and documented with these names, so no backend is imported here: an entry gives the
import path of its backend, and `extrags.restoration.backends.backend_of` imports it on first use.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from extrags.config.base import KeyOf

__all__ = ["BACKENDS", "BACKEND_NAME", "BackendEntry", "backend_schema", "backend_summaries"]


@dataclass(frozen=True)
class BackendEntry:
    """One restorer backend.

    Args:
        summary: what it is, in a few words, for help texts.
        implementation: import path of its `extrags.restoration.protocol.Backend` as "module:attribute", or
            the object itself for backends registered by a program.
        version: of a backend registered by a program, part of the cache key; 0 for those of the project,
            whose code is covered by the stage's version.
    """

    summary: str
    implementation: Any
    version: int = 0


BACKENDS: dict[str, BackendEntry] = {
    "embedded": BackendEntry(
        "conditional diffusion, pretrained weights included",
        "extrags.restoration.diffusion.backend:EMBEDDED",
    ),
    "classical": BackendEntry("blend and fill, no learning", "extrags.restoration.classical:CLASSICAL"),
    "wan-vace": BackendEntry(
        "diffusers video pipeline with mask and references",
        "extrags.restoration.pretrained.wan_vace:WAN_VACE",
    ),
    "stable-video": BackendEntry(
        "diffusers image-to-video pipeline", "extrags.restoration.pretrained.stable_video:STABLE_VIDEO"
    ),
    "ltx": BackendEntry("diffusers video pipeline", "extrags.restoration.pretrained.ltx:LTX"),
    "sd-img2img": BackendEntry(
        "diffusers image pipeline, whole images",
        "extrags.restoration.pretrained.stable_diffusion:IMAGE_TO_IMAGE",
    ),
    "sd-inpaint": BackendEntry(
        "diffusers image pipeline, holes only", "extrags.restoration.pretrained.stable_diffusion:INPAINT"
    ),
    "dynamicrafter": BackendEntry(
        "a checkpoint run by the user's clone of its code",
        "extrags.restoration.pretrained.checkpoint:DYNAMICRAFTER",
    ),
}

BACKEND_NAME = KeyOf(BACKENDS)
"""Annotation of a setting that names a backend."""


def backend_summaries() -> str:
    """All names with their summaries, for help texts."""
    return "; ".join(f"{name}: {entry.summary}" for name, entry in BACKENDS.items())


def backend_schema(schema: dict[str, Any]) -> None:
    """Add the backends registered so far to a JSON schema of the setting."""
    schema.update(enum=list(BACKENDS), description=backend_summaries())
