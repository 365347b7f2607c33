"""Frames of a sequence, each compared with others that are warped into it through its depth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from extrags.dense_flow import DenseFlow
from extrags.errors import CaptureError
from extrags.sequence import EndoscopicSequence, saturated_mask

__all__ = ["ComparedFrames", "PairComparison"]

MAX_WIDTH_PX = 320
"""Wider frames are compared at this width: blur that it does not show does little harm."""

SOURCES = 6
"""Other frames that each frame is compared with."""

MANY_FRAMES = 100
"""With more frames than this each is compared with half as many: the optimisation does not grow with them."""

MIN_SHARED = 0.1
"""Share of a frame's pixels that another must show for the two to be compared."""

WELL_SHARED = 0.5
"""Sources are taken evenly from the frames that show at least this share of a frame's surface."""

MIN_COSINE = 0.8
"""Of the angle between two views' rays to a point: its appearance changes beyond that."""

MAX_SCALE = 1.6
"""Ratio of depths beyond which one view resolves detail of the surface that the other cannot."""

DEPTH_TOLERANCE = 0.05
"""Log-ratio of depths up to which both views see the same surface, where depth is measured."""

DARK = 0.06
"""Brightness below which a picture is mostly noise."""

OFFSET = 0.03
"""Added to brightness before its logarithm, in which a change of exposure is an offset."""

FINEST_PX, COARSEST_PX = 1.0, 3.0
"""Standard deviations between which detail lies: finer is noise and resampling, coarser is shading."""

MARGIN_PX = 7
"""Window that must be known round a pixel whose detail counts."""

CONTRAST_PX = 13
"""Window in which contrast is made equal before displacements are measured."""

SAMPLES = 64
"""Points of a frame's surface by which its sources are chosen."""

_GREY = np.array([0.2, 0.5, 0.3], np.float32)
"""Green and blue carry the vessels; red is nearly the same everywhere on mucosa."""


@dataclass(frozen=True)
class PairComparison:
    """A frame against another that was warped into it.

    Args:
        own: structure tensor of the frame's detail, mean over the pixels compared, [2, 2].
        other: the same of the warped frame, on the same pixels.
        displacement_px: where the frame's pixels lie in the warped one, less their own place, [H, W, 2].
        compared: pixels compared, [H, W].
    """

    own: Float[np.ndarray, "2 2"]
    other: Float[np.ndarray, "2 2"]
    displacement_px: Float[np.ndarray, "h w 2"]
    compared: Bool[np.ndarray, "h w"]


class ComparedFrames:
    """Some frames of a posed sequence with depth, ready to be compared with each other.

    Args:
        sequence: posed frames with depth.
        frames: which of them.

    Raises:
        CaptureError: without depth.
    """

    def __init__(self, sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"]) -> None:
        small = sequence.at_most_width(MAX_WIDTH_PX)
        if small.depth_mm is None:
            raise CaptureError(f"{sequence.name}: frames are compared through their depth, and there is none")
        self.depth = np.asarray(small.depth_mm[frames], np.float32)
        self.tolerance = np.full((len(frames), 1, 1), DEPTH_TOLERANCE, np.float32)
        if small.depth_error is not None:
            self.tolerance = np.maximum(DEPTH_TOLERANCE, 2 * small.depth_error[frames]).astype(np.float32)
        brightness = small.rgb[frames].astype(np.float32) / 255 @ _GREY
        self.usable = small.supervised_mask(frames) & ~saturated_mask(small.rgb[frames])
        self.usable &= (self.depth > 0) & (brightness > DARK)
        # The border of a round picture is no edge of what it shows, and not blurred with it.
        self.grey = _continued(np.log(brightness + OFFSET), small.mask[frames])
        cameras = small.cameras[frames]
        self._K = cameras.K
        self._world_from_camera = cameras.world_from_camera
        self._from_world = np.linalg.inv(self._world_from_camera)
        rows, columns = np.meshgrid(
            np.arange(small.height) + 0.5, np.arange(small.width) + 0.5, indexing="ij"
        )
        self._pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
        self._flow = DenseFlow()
        self._detail = [_detail(image) for image in self.grey]
        self._contrast = [_equal_contrast(image) for image in self.grey]

    def __len__(self) -> int:
        return len(self.grey)

    @property
    def width(self) -> int:
        """Width at which frames are compared, in pixels."""
        return int(self.grey.shape[2])

    def sources(self, frame: int) -> list[int]:
        """The frames that a frame is compared with, by position.

        They are spread over those that show much of its surface: neighbours in time are often blurred
        together.
        """
        known = np.flatnonzero(self.usable[frame])
        if len(known) == 0:
            return []
        chosen = known[np.linspace(0, len(known) - 1, min(SAMPLES, len(known))).astype(np.int64)]
        rays = self._pixels.reshape(-1, 3)[chosen] @ np.linalg.inv(self._K[frame]).T
        local = rays * self.depth[frame].reshape(-1, 1)[chosen]
        pose = self._world_from_camera[frame]
        points = local @ pose[:3, :3].T + pose[:3, 3]
        theirs = (
            np.einsum("fij,nj->fni", self._from_world[:, :3, :3], points) + self._from_world[:, None, :3, 3]
        )
        z = np.maximum(theirs[..., 2], 1e-9)
        u = self._K[:, None, 0, 0] * theirs[..., 0] / z + self._K[:, None, 0, 2]
        v = self._K[:, None, 1, 1] * theirs[..., 1] / z + self._K[:, None, 1, 2]
        height, width = self.grey.shape[1:]
        seen = (theirs[..., 2] > 1e-9) & (u > 0) & (u < width) & (v > 0) & (v < height)
        seen &= np.abs(np.log(z / local[:, 2])) < np.log(MAX_SCALE)
        toward = points - pose[:3, 3]
        from_others = points - self._world_from_camera[:, None, :3, 3]
        cosine = np.einsum("ni,fni->fn", toward, from_others)
        cosine /= np.linalg.norm(toward, axis=-1) * np.linalg.norm(from_others, axis=-1) + 1e-12
        shared = (seen & (cosine > MIN_COSINE)).mean(axis=1)
        shared[frame] = 0
        good = np.flatnonzero(shared >= WELL_SHARED)
        count = SOURCES if len(self) <= MANY_FRAMES else SOURCES // 2
        if len(good) < count:
            order = np.argsort(-shared, kind="stable")[:count]
            return [int(other) for other in order if shared[other] >= MIN_SHARED]
        return [int(good[place]) for place in np.linspace(0, len(good) - 1, count).astype(np.int64)]

    def compare(self, frame: int, source: int) -> PairComparison | None:
        """A frame against another; None where they share too little.

        Args:
            frame: position of the one that keeps its place.
            source: position of the one that is warped.
        """
        known, warped = self._warped(frame, source)
        compared = cv2.erode(known.astype(np.uint8), np.ones((MARGIN_PX, MARGIN_PX), np.uint8)) > 0
        if compared.mean() < MIN_SHARED:
            return None
        own = self.grey[frame]
        offset = float((warped - own)[known].mean())
        # What the source does not show has no displacement.
        filled = np.where(known, warped - offset, own).astype(np.float32)
        flow = self._flow.between(self._contrast[frame], _equal_contrast(filled))
        return PairComparison(
            _structure(self._detail[frame], compared), _structure(_detail(warped), compared), flow, compared
        )

    def _warped(self, frame: int, source: int) -> tuple[Bool[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
        """Where both show the same surface, and the source's log-brightness as the frame would see it."""
        motion = self._from_world[source] @ self._world_from_camera[frame]
        turn = self._K[source] @ motion[:3, :3] @ np.linalg.inv(self._K[frame])
        shift = self._K[source] @ motion[:3, 3]
        own = self.depth[frame]
        height, width = own.shape
        with np.errstate(over="ignore", invalid="ignore"):
            # Depth of a background may be as large as float32 goes: such pixels come to lie nowhere.
            column, row, z = (
                (self._pixels @ turn[axis]).astype(np.float32) * own + np.float32(shift[axis])
                for axis in range(3)
            )
            positive = (z > 1e-9) & np.isfinite(z)
            z = np.where(positive, z, 1)
            column, row = column / z - 0.5, row / z - 0.5
            column, row = (np.where(np.isfinite(place), place, np.float32(-1)) for place in (column, row))
        inside = positive & (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
        column, row = column.clip(0, width - 1), row.clip(0, height - 1)
        nearest = np.rint(row).astype(np.intp), np.rint(column).astype(np.intp)
        theirs = self.depth[source][nearest]
        known = inside & self.usable[frame] & self.usable[source][nearest]
        tolerance = np.maximum(self.tolerance[frame], self._at(self.tolerance[source], nearest))
        ratio = np.log(np.maximum(theirs, 1e-9) / z)
        known &= np.abs(ratio) < tolerance
        known &= np.abs(np.log(np.maximum(own, 1e-9) / z)) < np.log(MAX_SCALE)
        warped = cv2.remap(self.grey[source], column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return known, warped

    @staticmethod
    def _at(image: np.ndarray, nearest: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        return image if image.shape == (1, 1) else image[nearest]


def _continued(
    images: Float[np.ndarray, "m h w"], masks: Bool[np.ndarray, "m h w"]
) -> Float[np.ndarray, "m h w"]:
    """Images whose pixels outside of their masks have the value of the nearest pixel inside."""
    # On first use: most sequences have no border.
    from scipy.ndimage import distance_transform_edt

    continued = images.copy()
    for image, mask in zip(continued, masks, strict=True):
        if mask.any() and not mask.all():
            nearest = distance_transform_edt(~mask, return_distances=False, return_indices=True)
            image[...] = image[tuple(nearest)]
    return continued


def _detail(image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """What lies between the finest and the coarsest scale."""
    fine = cv2.GaussianBlur(image, (0, 0), FINEST_PX)
    return np.asarray(fine - cv2.GaussianBlur(image, (0, 0), COARSEST_PX))


def _equal_contrast(image: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """An image less its local mean, over its local standard deviation."""
    window = (CONTRAST_PX, CONTRAST_PX)
    mean = cv2.blur(image, window)
    deviation = np.sqrt(np.maximum(cv2.blur(image * image, window) - mean * mean, 0)) + 0.01
    return np.asarray((128 + 45 * (image - mean) / deviation).clip(0, 255), dtype=np.uint8)


def _structure(
    detail: Float[np.ndarray, "h w"], compared: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "2 2"]:
    """Mean outer product of the gradient; of the few strongest pixels none counts more than the others."""
    across = cv2.Sobel(detail, cv2.CV_32F, 1, 0, ksize=1)[compared] / 2
    down = cv2.Sobel(detail, cv2.CV_32F, 0, 1, ksize=1)[compared] / 2
    energy = across * across + down * down
    rank = int(0.98 * (len(energy) - 1))
    strongest = np.partition(energy, rank)[rank]
    share = np.minimum(1, strongest / np.maximum(energy, 1e-12))
    mixed = float((share * across * down).mean())
    return np.array(
        [[float((share * across * across).mean()), mixed], [mixed, float((share * down * down).mean())]]
    )
