"""Restorers that are another one with something added or taken away, to measure what that contributes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from extrags.errors import CaptureError, ConfigError
from extrags.restoration.agreement import agreed_views
from extrags.restoration.clips import as_images
from extrags.restoration.protocol import Clip, Enhancer, Restoration
from extrags.restoration.refinement.refiner import Refiner, textured_views
from extrags.restoration.surface_texture import SurfaceTexture
from extrags.restoration.training_data.augmentation import drop_references, unconfirmed
from extrags.view_synthesis.conditioning import Layers, condition
from extrags.view_synthesis.references import ReferenceViews

__all__ = ["Agreed", "AsRendered", "Textured", "WithoutReferences"]


class AsRendered:
    """The restorer that changes nothing: the baseline of all others."""

    name = "none"

    def restore(self, clip: Clip) -> Restoration:
        """The rendering itself."""
        return Restoration(as_images(clip.layers.get("rendered").clamp(0, 1)), None, {"backend": self.name})

    def save(self, path: Path) -> None:
        """Not possible: there is nothing to save.

        Raises:
            ConfigError: always.
        """
        raise ConfigError(f"{path}: the baseline without restoration cannot be saved")


class WithoutReferences:
    """A restorer without its reference views, to measure their contribution.

    Args:
        enhancer: the restorer.
    """

    def __init__(self, enhancer: Enhancer) -> None:
        self.enhancer = enhancer
        self.name = f"{enhancer.name}/no-references"

    def restore(self, clip: Clip) -> Restoration:
        """Restore a clip with its references removed; the clip itself is not changed."""
        alone = drop_references(Layers(clip.layers.data.clone()))
        restoration = self.enhancer.restore(replace(clip, layers=alone))
        return replace(restoration, provenance={**restoration.provenance, "references": False})

    def save(self, path: Path) -> None:
        """Save the wrapped restorer."""
        self.enhancer.save(path)


class Agreed:
    """A restorer whose views of a clip agree on what they have invented.

    Restored renders do so as well, unless the restorer keeps what is known (`keeps_known`).

    Args:
        enhancer: the restorer.
    """

    def __init__(self, enhancer: Enhancer) -> None:
        self.enhancer = enhancer
        self.name = f"{enhancer.name}/agreed"

    def restore(self, clip: Clip) -> Restoration:
        """Restore a clip, then bring its views nearer to each other."""
        restoration = self.enhancer.restore(clip)
        rgb = agreed_views(
            torch.from_numpy(restoration.rgb).permute(0, 3, 1, 2),
            _completed(restoration, clip),
            unconfirmed(clip.layers),
            clip.cameras,
            clip.exposure,
            clip.transfer,
        )
        return replace(restoration, rgb=as_images(rgb), provenance={**restoration.provenance, "agreed": True})

    def save(self, path: Path) -> None:
        """Save the wrapped restorer."""
        self.enhancer.save(path)


def _completed(restoration: Restoration, clip: Clip) -> Float[Tensor, "t 1 h w"]:
    """z-depth without gaps."""
    if restoration.depth_mm is None:
        return condition(clip.layers, clip.transfer).depth_mm
    return torch.from_numpy(restoration.depth_mm)[:, None]


class Textured:
    """A restorer whose invented surfaces get texture of the scene's own frames.

    Restored renders do so as well, at the mean of this depth and the final scene's; no network refines them
    where the restorer keeps what is known (`keeps_known`).

    Args:
        enhancer: the restorer.
        texture: of the scene.
        refiner: makes texture and shapes agree; None lays the texture alone.
    """

    def __init__(
        self, enhancer: Enhancer, texture: SurfaceTexture, *, refiner: Refiner | None = None
    ) -> None:
        self.enhancer, self.texture, self.refiner = enhancer, texture, refiner
        self.name = f"{enhancer.name}/{'textured' if refiner is None else 'refined'}"

    @classmethod
    def of_references(
        cls, enhancer: Enhancer, references: ReferenceViews, *, seed: int = 0, refiner: Refiner | None = None
    ) -> Textured:
        """With the texture that real views show.

        Args:
            enhancer: the restorer.
            references: the scene's real views.
            seed: which tile lies where.
            refiner: makes texture and shapes agree; None lays the texture alone.

        Raises:
            CaptureError: when no frame shows the surface closely enough to give texture.
        """
        texture = SurfaceTexture.of_references(references, seed=seed)
        if texture is None:
            raise CaptureError("no frame shows the surface closely enough to give texture")
        return cls(enhancer, texture, refiner=refiner)

    def restore(self, clip: Clip) -> Restoration:
        """Restore a clip, then lay texture onto what was invented."""
        restoration = self.enhancer.restore(clip)
        rgb = textured_views(
            self.texture,
            self.refiner,
            torch.from_numpy(restoration.rgb).permute(0, 3, 1, 2),
            clip.cameras,
            _completed(restoration, clip),
            unconfirmed(clip.layers),
        )
        return replace(
            restoration,
            rgb=as_images(rgb),
            provenance={**restoration.provenance, "textured": True, "refined": self.refiner is not None},
        )

    def save(self, path: Path) -> None:
        """Save the wrapped restorer."""
        self.enhancer.save(path)
