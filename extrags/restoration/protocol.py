"""What every restorer is given and what it gives back."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from extrags.cameras import Cameras
from extrags.errors import ShapeError
from extrags.view_synthesis.conditioning import Layers
from extrags.view_synthesis.references import LightTransfer

__all__ = ["Clip", "Enhancer", "Restoration", "restore_clips"]


@dataclass(frozen=True)
class Clip:
    """T views of one trajectory, rendered and ready to be restored.

    Args:
        index: of the clip in the scene; its noise is drawn from it.
        cameras: the views, [T].
        layers: what is known about them, [T].
        transfer: how brightness changes with distance in this scene.
        reference: position among the training frames of the one that sees most of the same surface, [T].
        image_confidence: U_img of each view, [T].

    Raises:
        ShapeError: when the numbers of views differ.
    """

    index: int
    cameras: Cameras
    layers: Layers
    transfer: LightTransfer
    reference: Int[np.ndarray, "t"]
    image_confidence: Float[np.ndarray, "t"]

    def __post_init__(self) -> None:
        counts = {len(self.cameras), len(self.layers), len(self.reference), len(self.image_confidence)}
        if len(counts) != 1:
            raise ShapeError(f"the parts of clip {self.index} have different lengths: {sorted(counts)}")

    def __len__(self) -> int:
        return len(self.cameras)


@dataclass(frozen=True)
class Restoration:
    """Restored views of a clip.

    Args:
        rgb: in [0, 1], [T, H, W, 3].
        expected_error: expected absolute error of a pixel, mean of the channels, or None where the restorer
            has no idea of it, [T, H, W].
        provenance: backend, steps, seed, ...; ready for JSON.
        depth_mm: z-depth without gaps, where the restorer completes it better than smooth filling does,
            or None, [T, H, W].
    """

    rgb: Float[np.ndarray, "t h w 3"]
    expected_error: Float[np.ndarray, "t h w"] | None
    provenance: dict[str, Any] = field(default_factory=dict)
    depth_mm: Float[np.ndarray, "t h w"] | None = None


@runtime_checkable
class Enhancer(Protocol):
    """Turns degraded renderings into images the tissue could have given."""

    name: str

    def restore(self, clip: Clip) -> Restoration:
        """Restore all views of a clip; the same clip always gives the same result."""
        ...

    def save(self, path: Path) -> None:
        """Write whatever `extrags.restoration.load_enhancer` needs into a folder."""
        ...


def restore_clips(enhancer: Enhancer, clips: Iterable[Clip]) -> list[Restoration]:
    """Restore clips one after the other; they are independent, so that batches may run anywhere."""
    return [enhancer.restore(clip) for clip in clips]
