"""The restorer without learning: blend of light-compensated real views, holes by push-pull."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import torch

from extrags.restoration.protocol import Clip, Restoration
from extrags.view_synthesis.conditioning import condition

__all__ = ["ClassicalEnhancer"]


@dataclass(frozen=True)
class ClassicalEnhancer:
    """Multi-view blend where real views see the surface, the rendering elsewhere, holes filled.

    The base image of the embedded diffusion, by itself: its baseline, and what serves where the diffusion
    would do harm.

    Args:
        reason: why it serves although another restorer was asked for; empty where it was asked for.
    """

    reason: str = ""

    name = "classical"

    def restore(self, clip: Clip) -> Restoration:
        """Restore all views of a clip."""
        with torch.no_grad():
            base = condition(clip.layers, clip.transfer).base
        rgb = base.permute(0, 2, 3, 1).contiguous().numpy()
        return Restoration(rgb, None, self._about)

    def save(self, path: Path) -> None:
        """Write `restorer.json`; there are no weights."""
        path.mkdir(parents=True, exist_ok=True)
        (path / "restorer.json").write_text(json.dumps(self._about, indent=2) + "\n")

    @property
    def _about(self) -> dict[str, str]:
        return {"backend": self.name, **({"reason": self.reason} if self.reason else {})}
