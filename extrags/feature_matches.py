"""SIFT features of pale, unevenly lit tissue, and which of two frames are the same.

Source: Lowe: Distinctive image features from scale-invariant keypoints, IJCV 2004; root of the descriptors:
Arandjelović and Zisserman, CVPR 2012.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

__all__ = ["Features", "mutual_matches", "sift_features"]

FEATURES = 1500
CONTRAST = 0.004
RATIO = 0.9


@dataclass(frozen=True)
class Features:
    """Features of a frame.

    Args:
        pixels: where they are, [n, 2], (column, row) with the centre of the first pixel at .5.
        descriptors: of unit length, [n, 128].
    """

    pixels: Float[np.ndarray, "n 2"]
    descriptors: Float[np.ndarray, "n 128"]

    @classmethod
    def none(cls) -> Self:
        """Of a frame in which there are none."""
        return cls(np.zeros((0, 2)), np.zeros((0, 128), np.float32))

    def rows_and_columns(self, height: int, width: int) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
        """Of the pixels that the features lie in."""
        places = np.floor(self.pixels).astype(np.int64)
        return np.clip(places[:, 1], 0, height - 1), np.clip(places[:, 0], 0, width - 1)


def sift_features(rgb: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]) -> Features:
    """Those of a frame, in the same order for any number of threads.

    Args:
        rgb: from 0 to 255.
        mask: true where features are looked for.
    """
    import cv2

    grey = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY)
    # Mucosa is pale and unevenly lit: contrast is raised block by block.
    grey = cv2.createCLAHE(clipLimit=4.0, tileGridSize=(8, 8)).apply(grey)
    finder = cv2.SIFT.create(nfeatures=FEATURES, contrastThreshold=CONTRAST, edgeThreshold=20)
    keypoints, descriptors = finder.detectAndCompute(grey, mask.astype(np.uint8) * 255)
    if descriptors is None or len(keypoints) == 0:
        return Features.none()
    pixels = np.array([keypoint.pt for keypoint in keypoints]) + 0.5
    # Threads find features in any order.
    order = np.lexsort((descriptors[:, 0], descriptors[:, 1], pixels[:, 0], pixels[:, 1]))
    roots = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    return Features(pixels[order], roots[order].astype(np.float32))


def mutual_matches(
    first: Float[np.ndarray, "n 128"], second: Float[np.ndarray, "m 128"]
) -> Int[np.ndarray, "k 2"]:
    """Rows of descriptors that are each other's nearest and clearly nearer than the second nearest.

    Args:
        first: of one frame, of unit length, [n, 128].
        second: of the other, [m, 128].

    Returns:
        Row in the first and row in the second, [k, 2].
    """
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    likeness = first @ second.T
    best = likeness.argmax(1)
    mutual = likeness.argmax(0)[best] == np.arange(len(best))
    two = -np.partition(-likeness, 1, axis=1)[:, :2]
    distance = np.sqrt(np.clip(2 - 2 * two, 1e-12, None))
    kept = np.flatnonzero(mutual & (distance[:, 0] < RATIO * distance[:, 1]))
    return np.stack([kept, best[kept]], axis=1)
