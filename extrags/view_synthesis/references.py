"""Real views as references of virtual ones: colour, depth, exposure, and visible Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from extrags.cameras import Cameras
from extrags.errors import ShapeError
from extrags.illumination import NearFieldLight
from extrags.raster import Rendering
from extrags.scene import Scene
from extrags.view_synthesis.shrinkage import color_support, shrunk_sh0

__all__ = ["SEEN_WEIGHT", "LightTransfer", "ReferenceViews", "visibility_of"]

SEEN_WEIGHT = 0.02
"""A Gaussian counts as seen in a view when its largest blending weight there exceeds this."""


@dataclass(frozen=True)
class LightTransfer:
    """Effect of distance, angle and camera response on a surface's colour, up to a constant.

    Args:
        light: the scene's light; None where the scene has none.
        exponent: a of `distance^-a`, used without `light`.
        scale_mm: a typical distance, where the fall-off without `light` is one.
    """

    light: NearFieldLight | None
    exponent: float
    scale_mm: float

    @cached_property
    def lamp_position(self) -> Float[Tensor, "3"]:
        """Of the lamp beside the lens, in camera axes and world units; at the lens without `light`."""
        if self.light is None:
            return torch.zeros(3)
        return self.light.offset.detach().cpu() * self.light.reference_distance

    def falloff(
        self,
        distance: Float[Tensor, "*b"],
        axis_cosine: Float[Tensor, "*b"],
        facing_cosine: Float[Tensor, "*b"] | None = None,
    ) -> Float[Tensor, "*b"]:
        """Brightness relative to that of a surface at the reference distance, on the axis, facing the lamp.

        Args:
            distance: from the lamp, in world units.
            axis_cosine: cosine between its ray and the optical axis; counts with `light` only.
            facing_cosine: cosine between its ray and the surface's normal; counts with `light` only. None
                takes every surface to face the lamp.
        """
        if self.light is not None:
            return self.light.falloff(distance, axis_cosine, facing_cosine)
        return (distance / self.scale_mm) ** -self.exponent

    def invert_response(self, rgb: Float[Tensor, "*b"], channel_axis: int = -1) -> Float[Tensor, "*b"]:
        """What surfaces sent: image values in [0, 1] with the camera's response and the glare undone."""
        return rgb if self.light is None else self.light.invert_response(rgb, channel_axis)

    def apply_response(self, signal: Float[Tensor, "*b"], channel_axis: int = -1) -> Float[Tensor, "*b"]:
        """The image values of what surfaces send."""
        return signal if self.light is None else self.light.apply_response(signal, channel_axis)


@dataclass(frozen=True)
class ReferenceViews:
    """R real views of a scene.

    Args:
        frames: their indices in the sequence, [R].
        cameras: their cameras, [R].
        packed: rgb, trust, inverse depth (0 where unknown) and depth-is-known, [R, 6, H, W].
        exposure: gain of each view, [R].
        seen: which Gaussians of the scene each view sees, [R, N].
        transfer: how brightness changes with distance.
        sh0: constant harmonics of the scene's Gaussians as other views are to show them (`shrunk_sh0`), from
            all views that were gathered; None takes the scene's own, [N, 1, 3].
    """

    frames: Int[np.ndarray, "r"]
    cameras: Cameras
    packed: Float[Tensor, "r 6 h w"]
    exposure: Float[Tensor, "r"]
    seen: Bool[Tensor, "r n"]
    transfer: LightTransfer
    sh0: Float[Tensor, "n 1 3"] | None = None

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def valid(self) -> Bool[Tensor, "r h w"]:
        """Where the views show tissue: what is trusted at all."""
        return self.packed[:, 3] > 0

    @cached_property
    def viewmats(self) -> Float[Tensor, "r 4 4"]:
        """Camera from world."""
        return torch.from_numpy(self.cameras.viewmats.astype(np.float32))

    @cached_property
    def K(self) -> Float[Tensor, "r 3 3"]:
        """Intrinsics."""
        return torch.from_numpy(self.cameras.K.astype(np.float32))

    @cached_property
    def centers(self) -> Float[Tensor, "r 3"]:
        """Camera centres."""
        return torch.from_numpy(self.cameras.centers.astype(np.float32))

    def with_transfer(self, transfer: LightTransfer) -> ReferenceViews:
        """The same views with another brightness law."""
        return replace(self, transfer=transfer)

    def subset(self, index: Int[np.ndarray, "m"]) -> ReferenceViews:
        """Chosen views."""
        chosen = torch.from_numpy(np.asarray(index, dtype=np.int64))
        return replace(
            self,
            frames=self.frames[index],
            cameras=self.cameras[index],
            packed=self.packed[chosen],
            exposure=self.exposure[chosen],
            seen=self.seen[chosen],
        )

    def of_scene(self, scene: Scene) -> ReferenceViews:
        """The same images and depths for other Gaussians: what each view sees is found anew."""
        # Blending weights come from the native kernels, and the search for neighbours is on the processor.
        scene = scene.to("cpu")
        seen, support = [], torch.zeros(len(scene.gaussians))
        for view in range(len(self)):
            with torch.no_grad():
                rendering = scene.render(
                    self.cameras[view], visibility=True, visibility_mask=self.valid[[view]]
                )
            seen.append(visibility_of(rendering) > SEEN_WEIGHT)
            support += color_support(scene, self.cameras[view], rendering)
        return replace(self, seen=torch.cat(seen), sh0=shrunk_sh0(scene, support))

    def shown(self, scene: Scene) -> Scene:
        """The scene as views from elsewhere are to show it: with the colours of `sh0`.

        Raises:
            ShapeError: when the scene has other Gaussians than the references know of.
        """
        if self.sh0 is None:
            return scene
        if len(self.sh0) != len(scene.gaussians):
            raise ShapeError(
                f"references of a scene of {len(self.sh0)} Gaussians, and one of "
                f"{len(scene.gaussians)} is shown"
            )
        return Scene(replace(scene.gaussians, sh0=self.sh0), scene.light)


def visibility_of(rendering: Rendering) -> Float[Tensor, "c n"]:
    """Largest blending weight of each Gaussian in each view of a rendering.

    Raises:
        ShapeError: when it was rendered without `visibility=True`.
    """
    if rendering.visibility_max is None:
        raise ShapeError("the rendering carries no visibility; ask for it with visibility=True")
    return rendering.visibility_max
