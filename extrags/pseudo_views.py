"""Pseudo-observations: restored virtual views with their confidences, and their storage in zarr."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Int

from extrags.cameras import Cameras
from extrags.errors import ShapeError
from extrags.store.storable import Storable
from extrags.zarr_io import has_array, new_group, open_group, read_array, write_array, write_frames

__all__ = ["PseudoViews"]

_IMAGES = ("rendered", "restored", "target")
_SHARES = ("alpha", "uncertainty")
_STEPPED = (*_IMAGES, *_SHARES, "pixel_confidence")


@dataclass(frozen=True)
class PseudoViews(Storable):
    """Virtual views after restoration.

    Colours are at the mean exposure of the training frames.

    Args:
        cameras: the virtual views, [V].
        rendered: what the coarse scene shows, in [0, 1], [V, H, W, 3].
        restored: output of the restorer, in [0, 1], [V, H, W, 3].
        target: `u * restored + (1 - u) * rendered` with the feathered uncertainty u, which keeps rendered
            texture where the scene is certain, [V, H, W, 3].
        alpha: opacity of the rendering, [V, H, W].
        depth_mm: rendered z-depth, smoothly extrapolated where `alpha` is low, in world units, [V, H, W].
        uncertainty: in [0, 1]; 1 where the scene has no information on the pixel, [V, H, W].
        pixel_confidence: U_pixel, weight of the colour term of each pixel, not negative, in [0, 1] unless it
            is raw LPIPS, [V, H, W].
        image_confidence: U_img, weight of each view in [0, 1], [V].
        reference: position, among the training frames, of the frame with the largest overlap, [V].
        clip: index of the clip each view belongs to, [V].
        provenance: backend, steps, seed, perceptual measure, ...; JSON types.
        expected_error: absolute error of a restored pixel, mean over its channels, as predicted by the
            restorer; None for restorers that predict none, [V, H, W].

    Raises:
        ShapeError: when the arrays do not fit each other.
    """

    stored_as: ClassVar[str] = "pseudo"

    cameras: Cameras
    rendered: Float[np.ndarray, "v h w 3"]
    restored: Float[np.ndarray, "v h w 3"]
    target: Float[np.ndarray, "v h w 3"]
    alpha: Float[np.ndarray, "v h w"]
    depth_mm: Float[np.ndarray, "v h w"]
    uncertainty: Float[np.ndarray, "v h w"]
    pixel_confidence: Float[np.ndarray, "v h w"]
    image_confidence: Float[np.ndarray, "v"]
    reference: Int[np.ndarray, "v"]
    clip: Int[np.ndarray, "v"]
    provenance: dict[str, Any] = field(default_factory=dict)
    expected_error: Float[np.ndarray, "v h w"] | None = None

    def __post_init__(self) -> None:
        views = len(self.cameras)
        size = (views, self.cameras.height, self.cameras.width)
        expected: dict[str, tuple[int, ...]] = dict.fromkeys(_IMAGES, (*size, 3))
        expected.update(dict.fromkeys((*_SHARES, "pixel_confidence", "depth_mm"), size))
        expected.update(dict.fromkeys(("image_confidence", "reference", "clip"), (views,)))
        if self.expected_error is not None:
            expected["expected_error"] = size
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ShapeError(f"{name} has shape {getattr(self, name).shape}, expected {shape}")

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def changed_share(self) -> float:
        """Share of pixels whose target differs from the rendering by more than 4/255 in any channel."""
        if len(self) == 0:
            return 0.0
        return float((np.abs(self.target - self.rendered).max(axis=-1) > 4 / 255).mean())

    @staticmethod
    def concatenated(parts: Sequence[PseudoViews]) -> PseudoViews:
        """Concatenate batches of clips in the order given; the provenance is taken from the first.

        Raises:
            ShapeError: when `parts` is empty, or image sizes differ.
        """
        if not parts:
            raise ShapeError("no pseudo-observations to join")
        names = (*_STEPPED, "depth_mm", "image_confidence", "reference", "clip")
        arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        errors = [part.expected_error for part in parts if part.expected_error is not None]
        if len(errors) == len(parts):
            arrays["expected_error"] = np.concatenate(errors)
        cameras = Cameras.concatenated([part.cameras for part in parts])
        return PseudoViews(cameras, **arrays, provenance=dict(parts[0].provenance))

    def quantised(self) -> PseudoViews:
        """The same values as `load` returns after `save`: a run in memory then equals a cached one."""
        values: dict[str, Any] = {name: _from_steps(self._as_steps(name)) for name in _STEPPED}
        error = self.expected_error
        return replace(
            self,
            **values,
            depth_mm=self.depth_mm.astype(np.float32),
            image_confidence=self.image_confidence.astype(np.float32),
            expected_error=None if error is None else error.astype(np.float16).astype(np.float32),
        )

    def save(self, path: Path) -> None:
        """Write a zarr v3 group: values in [0, 1] with 8 bits, depth in float32, one view per chunk.

        Where a pixel-level confidence exceeds one, all of them have 16 bits, in the same steps of 1/255.
        """
        with new_group(path) as group:
            for name in _STEPPED:
                write_frames(group, name, self._as_steps(name))
            if self.expected_error is not None:
                # 8 bits would be too coarse: expected errors are only a few steps of 1/255.
                write_frames(group, "expected_error", self.expected_error.astype(np.float16))
            write_frames(group, "depth_mm", self.depth_mm.astype(np.float32))
            write_array(group, "image_confidence", self.image_confidence.astype(np.float32))
            write_array(group, "reference", self.reference.astype(np.int64))
            write_array(group, "clip", self.clip.astype(np.int64))
            write_array(group, "K", self.cameras.K)
            write_array(group, "world_from_camera", self.cameras.world_from_camera)
            group.attrs.update(
                {
                    "width": self.cameras.width,
                    "height": self.cameras.height,
                    "provenance": self.provenance,
                    "changed_share": self.changed_share,
                }
            )

    def _as_steps(self, name: str) -> np.ndarray:
        """An array in steps of 1/255; equal values give equal steps whatever else the array holds."""
        most = np.iinfo(np.uint16).max if name == "pixel_confidence" else 255
        steps = np.clip(np.rint(getattr(self, name) * 255), 0, most)
        return np.asarray(steps, dtype=np.uint8 if steps.max(initial=0) <= 255 else np.uint16)

    @classmethod
    def load(cls, path: Path) -> PseudoViews:
        """Read what `save` wrote; values in [0, 1] come back quantised to steps of 1/255."""
        group = open_group(path)
        attributes: Any = dict(group.attrs)
        arrays: dict[str, Any] = {name: _from_steps(read_array(group, name)) for name in _STEPPED}
        if has_array(group, "expected_error"):
            arrays["expected_error"] = read_array(group, "expected_error").astype(np.float32)
        for name in ("depth_mm", "image_confidence", "reference", "clip"):
            arrays[name] = read_array(group, name)
        cameras = Cameras(
            read_array(group, "K"),
            read_array(group, "world_from_camera"),
            int(attributes["width"]),
            int(attributes["height"]),
        )
        return cls(cameras, **arrays, provenance=dict(attributes["provenance"]))


def _from_steps(values: np.ndarray) -> np.ndarray:
    return np.asarray(values.astype(np.float32) / np.float32(255))
