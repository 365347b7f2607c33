"""Real views as references of virtual ones: colour, depth, exposure, and visible Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from extrags.cameras import Cameras
from extrags.errors import CaptureError, ShapeError
from extrags.illumination import NearFieldLight
from extrags.raster import Rendering
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, saturated_mask

__all__ = ["SEEN_WEIGHT", "LightTransfer", "ReferenceViews"]

SEEN_WEIGHT = 0.02
"""A Gaussian counts as seen in a view when its largest blending weight there exceeds this."""
FEATHER_PX = 4.0
"""Trust in a real view rises over so many pixels from the border of its valid area."""
SOLID_ALPHA = 0.9
"""Rendered depth is taken for the real view's where the rendering is at least this opaque."""


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

    def falloff(
        self,
        distance: Float[Tensor, "*b"],
        axis_cosine: Float[Tensor, "*b"],
        facing_cosine: Float[Tensor, "*b"] | None = None,
    ) -> Float[Tensor, "*b"]:
        """Brightness relative to that of a surface at the reference distance, on the axis, facing the lens.

        Args:
            distance: from the lens, in world units.
            axis_cosine: cosine between the ray and the optical axis; counts with `light` only.
            facing_cosine: cosine between the ray and the surface's normal; counts with `light` only. None
                takes every surface to face the lens.
        """
        if self.light is not None:
            return self.light.falloff(distance, axis_cosine, facing_cosine)
        return (distance / self.scale_mm) ** -self.exponent

    def signal(self, rgb: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Image values in [0, 1] with the camera's response undone."""
        return rgb if self.light is None else self.light.signal(rgb)

    def apply_response(self, signal: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """The image values of a signal."""
        return signal if self.light is None else self.light.apply_response(signal)


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
    """

    frames: Int[np.ndarray, "r"]
    cameras: Cameras
    packed: Float[Tensor, "r 6 h w"]
    exposure: Float[Tensor, "r"]
    seen: Bool[Tensor, "r n"]
    transfer: LightTransfer

    def __len__(self) -> int:
        return len(self.frames)

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
        seen = []
        for view in range(len(self)):
            with torch.no_grad():
                rendering = scene.render(self.cameras[view], visibility=True)
            seen.append(_visibility(rendering) > SEEN_WEIGHT)
        return replace(self, seen=torch.cat(seen))

    @classmethod
    def gather(
        cls,
        scene: Scene,
        sequence: EndoscopicSequence,
        frames: Int[np.ndarray, "r"],
        *,
        exposure: Float[Tensor, "r"] | None = None,
    ) -> ReferenceViews:
        """Prepare real frames as references of a scene.

        Depth is the measured one where the sequence has it, else the scene's rendering where it is
        opaque. Without a light model, how brightness falls with distance is fitted to the views.

        Args:
            scene: the reconstruction; needed for depth and for what each frame saw.
            sequence: posed frames.
            frames: which frames; training frames only, else held-out images would leak into the evaluation.
            exposure: gain of each frame; None takes the light's own, for a scene trained on exactly
                these frames, else 1.

        Raises:
            CaptureError: without any frame, or when none has usable depth.
            ShapeError: when the light's exposures are not those of the frames.
        """
        frames = np.asarray(frames, dtype=np.int64)
        if len(frames) == 0:
            raise CaptureError(f"{sequence.name}: no real views to refer to")
        cameras = sequence.cameras[frames]
        depth, seen = _depth_and_seen(scene, sequence, frames)
        if not bool((depth > 0).any()):
            raise CaptureError(f"{sequence.name}: no depth in any of the {len(frames)} real views")
        rgb = torch.from_numpy(sequence.rgb[frames].astype(np.float32) / 255).permute(0, 3, 1, 2)
        trust = torch.from_numpy(_trust(sequence, frames))
        known = depth > 0
        inverse = torch.where(known, 1 / depth.clamp_min(1e-9), torch.zeros(()))
        packed = torch.cat(
            [rgb, trust[:, None], inverse[:, None], known[:, None].to(torch.float32)], dim=1
        ).contiguous()
        scale = float(depth[known].median())
        references = cls(
            frames,
            cameras,
            packed,
            _exposures(scene, frames) if exposure is None else exposure,
            seen,
            LightTransfer(scene.light, 0.0, scale),
        )
        if scene.light is None:
            from extrags.view_synthesis.warp import with_fitted_transfer

            references = with_fitted_transfer(references)
        return references


def _exposures(scene: Scene, frames: Int[np.ndarray, "r"]) -> Float[Tensor, "r"]:
    light = scene.light
    if light is None:
        return torch.ones(len(frames))
    if len(light.log_exposure) != len(frames):
        raise ShapeError(
            f"the scene's light has {len(light.log_exposure)} exposures for {len(frames)} reference frames; "
            "give the frames the scene was trained on, or their exposures"
        )
    return light.exposures()


def _depth_and_seen(
    scene: Scene, sequence: EndoscopicSequence, frames: Int[np.ndarray, "r"]
) -> tuple[Float[Tensor, "r h w"], Bool[Tensor, "r n"]]:
    depths, seen = [], []
    for frame in frames:
        with torch.no_grad():
            rendering = scene.render(sequence.cameras[int(frame)], visibility=True)
        seen.append(_visibility(rendering)[0] > SEEN_WEIGHT)
        rendered = torch.where(rendering.alpha[0] > SOLID_ALPHA, rendering.depth[0], torch.zeros(()))
        depth = rendered
        if sequence.depth_mm is not None:
            measured = torch.from_numpy(sequence.depth_mm[frame].astype(np.float32))
            depth = torch.where(measured > 0, measured, rendered)
        mask = torch.from_numpy(sequence.mask[frame])
        depths.append(torch.where(mask, depth, torch.zeros(())))
    return torch.stack(depths), torch.stack(seen)


def _visibility(rendering: Rendering) -> Float[Tensor, "c n"]:
    if rendering.visibility_max is None:
        raise ShapeError("the rendering carries no visibility; ask for it with visibility=True")
    return rendering.visibility_max


def _trust(sequence: EndoscopicSequence, frames: Int[np.ndarray, "r"]) -> Float[np.ndarray, "r h w"]:
    """1 inside the valid area, falling to 0 at its border and the image's; low where saturated."""
    from scipy.ndimage import distance_transform_edt

    maps = []
    for frame in frames:
        bordered = np.pad(sequence.mask[frame], 1)
        distance = distance_transform_edt(bordered)[1:-1, 1:-1]
        trust = np.clip((distance - 0.5) / FEATHER_PX, 0, 1)
        maps.append(np.where(saturated_mask(sequence.rgb[frame]), 0.1 * trust, trust))
    return np.stack(maps).astype(np.float32)
