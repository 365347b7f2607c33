"""Restore renders with another model: a backend of one's own, registered from outside the library.

    python examples/restore_with_another_model.py phantom/0@sparse

The model here is OpenCV's inpainting by fast marching (Telea 2004): it needs no weights and shows what a
backend has to say. A network takes its place in `TeleaEnhancer.restore`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

import extrags
from extrags.restoration.description import write_description
from extrags.restoration.protocol import Clip, Restoration
from extrags.thresholds import HOLE_ALPHA

RADIUS_PX = 3.0


@dataclass(frozen=True)
class TeleaEnhancer:
    """Fills holes from their rims, view by view."""

    name = "telea"

    def restore(self, clip: Clip) -> Restoration:
        """Restore all views of a clip."""
        rendered = clip.layers.get("rendered").clamp(0, 1).permute(0, 2, 3, 1).numpy()
        holes = clip.layers.get("alpha")[:, 0].numpy() < HOLE_ALPHA
        images = np.rint(rendered * 255).astype(np.uint8)
        filled = [
            cv2.inpaint(image, hole.astype(np.uint8), RADIUS_PX, cv2.INPAINT_TELEA)
            for image, hole in zip(images, holes, strict=True)
        ]
        rgb = np.where(holes[..., None], np.stack(filled).astype(np.float32) / 255, rendered)
        return Restoration(rgb, expected_error=None, provenance={"backend": self.name})

    def save(self, path: Path) -> None:
        """There are no weights: the name is enough."""
        write_description(path, {"backend": self.name})


class TeleaBackend:
    """Makes a `TeleaEnhancer` for any scene."""

    name = TeleaEnhancer.name

    def check(self, config: extrags.EnhanceConfig) -> None:
        """Nothing is needed besides the scene."""

    def digest(self, config: extrags.EnhanceConfig) -> None:
        """There is no pretrained model."""

    def needs_text(self, config: extrags.EnhanceConfig) -> bool:
        """No text is read."""
        return False

    def prepare(
        self,
        scene: extrags.Scene,
        sequence: extrags.EndoscopicSequence,
        config: extrags.EnhanceConfig,
        coarse: extrags.CoarseConfig,
    ) -> TeleaEnhancer:
        """The same for every scene."""
        return TeleaEnhancer()

    def load(self, path: Path) -> TeleaEnhancer:
        """The same from every folder."""
        return TeleaEnhancer()


def restored_with_telea(source: str, config: extrags.PipelineConfig) -> extrags.Result:
    """Run the pipeline with the registered backend, and say how much of the virtual views it changed."""
    config = config.with_overrides({"enhance.backend": TeleaBackend.name})
    result = extrags.run_pipeline(extrags.read(source, config.ingest), config, until="enhance")
    if result.pseudo_views is None:
        print(f"nothing was restored: {result.skipped['enhance']}")
    else:
        print(f"{len(result.pseudo_views)} views restored by {TeleaBackend.name}")
    return result


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    extrags.register_backend(TeleaBackend(), "inpainting by fast marching")
    restored_with_telea(sys.argv[1], extrags.PROFILES["quick"])
