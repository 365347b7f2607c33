"""The restorer without learning: blend of light-compensated real views, holes by push-pull."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from extrags.enhance.conditioning import condition
from extrags.enhance.protocol import Clip, Restoration

__all__ = ["ClassicalEnhancer"]


class ClassicalEnhancer:
    """Multi-view blend where real views see the surface, the rendering elsewhere, holes filled.

    The base image of the embedded diffusion, by itself: its baseline, and the choice where there are too
    few frames to train on.
    """

    name = "classical"

    def restore(self, clip: Clip) -> Restoration:
        """Restore all views of a clip."""
        with torch.no_grad():
            base = condition(clip.layers, clip.transfer).base
        rgb = base.permute(0, 2, 3, 1).contiguous().numpy()
        return Restoration(rgb, None, {"backend": self.name})

    def save(self, path: Path) -> None:
        """Write `restorer.json`; there are no weights."""
        path.mkdir(parents=True, exist_ok=True)
        (path / "restorer.json").write_text(json.dumps({"backend": self.name}, indent=2) + "\n")
