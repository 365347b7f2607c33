"""Which pixels of an endoscope's video show tissue: the picture inside its dark frame, less burnt-in text.

Everything is derived from several frames of one recording: the dark frame stays dark in all of them, and a
burnt-in overlay keeps its edges while the scene moves.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

__all__ = [
    "Circle",
    "FramedPicture",
    "content_circle",
    "content_mask",
    "framed_picture",
    "looked_at",
    "overlay_mask",
    "view_mask",
]

logger = logging.getLogger(__name__)

_DARK = 14
"""A pixel whose brightest channel stays below this belongs to the frame round the picture."""
_CORNER_SHARE = 0.04
"""Of width and height, of the squares in the four corners that tell how dark a frame is that is not black."""
_NEARLY_DARK, _LARGEST_DARK = 12, 40
_CORNERS_ALIKE = 4
"""So much may values in the corners differ, between corners, pixels and frames."""
_ABOVE_SURROUND = 6
_MARGIN_SHARE = 0.006
"""The picture's rim is blurred: so much of the image width is cut off all round."""
_LARGEST_DENT = 0.05
_CIRCLE_TRIALS = 400
_CIRCLE_TOLERANCE_SHARE = 0.006
_CIRCLE_INLIERS = 0.75
_NEAR_TOLERANCES = 3
_CIRCLE_LIT = 0.5
"""Share of the circle, as far as it lies in the image, that is lit. A dark round lumen at the image border
has a round rim, too, with the picture outside. How much is lit outside of the circle tells nothing: panels of
the processor may touch the picture."""
_MIN_FRAMES = 4
_MAX_FRAMES = 32
_LARGEST_WIDTH = 640
_EDGE_STRENGTH = 24.0
"""Of burnt-in text, in grey values per pixel; blurred tissue under compression stays below."""
_MOVED_SHARE = 0.25
"""So much of the picture must change visibly before what stays can be called burnt in."""
_VISIBLE_CHANGE = 8.0
_LARGEST_OVERLAY = 0.15
_ALIKE_MIRRORED = 0.9
"""Intersection over union of a picture's outline and its mirror image: pictures are symmetric, and what light
or an instrument leaves of them is not."""
_RIM_SHARE = 0.02
"""Of the image width: how far on both sides of a picture's outline it is looked whether it is a rim."""
_RIM_DARK = 0.9
"""So much of what is just outside of a rim is dark; the rest may be text."""
_RIM_LIT = 0.75
"""So much of what is just inside of a rim is lit, at least in some frames. Light that fades has no rim."""


@dataclass(frozen=True)
class Circle:
    """The rim of a round picture, in pixels with centres at +0.5.

    Args:
        center_x: may lie outside the image.
        center_y: may lie outside the image.
        radius_px: of the rim itself, before any margin.
        inliers: share of rim points that lie on it, of all or of those near it.
    """

    center_x: float
    center_y: float
    radius_px: float
    inliers: float

    def mask(self, width: int, height: int, margin_px: float = 0.0) -> Bool[np.ndarray, "h w"]:
        """True inside."""
        x = np.arange(width)[None, :] + 0.5 - self.center_x
        y = np.arange(height)[:, None] + 0.5 - self.center_y
        return np.asarray(np.hypot(x, y) <= self.radius_px - margin_px)


@dataclass(frozen=True)
class FramedPicture:
    """The box round a picture with a dark surround, in pixels with edges at whole numbers.

    Args:
        left: first column.
        top: first row.
        width: number of columns.
        height: number of rows.
    """

    left: int
    top: int
    width: int
    height: int

    @property
    def center(self) -> tuple[float, float]:
        """Column and row of its middle, pixel centres at +0.5."""
        return self.left + self.width / 2, self.top + self.height / 2


def view_mask(rgb: UInt8[np.ndarray, "f h w 3"], dark_below: int = _DARK) -> Bool[np.ndarray, "h w"]:
    """False in the dark frame round an endoscope's picture, whatever its shape.

    A pixel is outside when it is dark in every frame and joined to the image border by such pixels: a dark
    lumen in the middle stays inside.

    Args:
        rgb: frames of one recording.
        dark_below: a pixel is dark whose brightest channel is below this.
    """
    import cv2

    # Frames first: over both axes at once takes several times as long.
    dark = (rgb.max(axis=0).max(axis=-1) < dark_below).astype(np.uint8)
    _, labels = cv2.connectedComponents(dark, connectivity=4)
    border = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    outside = np.isin(labels, np.setdiff1d(border, 0)) & (dark > 0)
    return np.asarray(~outside)


def content_circle(rgb: UInt8[np.ndarray, "f h w 3"]) -> Circle | None:
    """The round picture of an endoscope, cut off by the image border or not.

    The rim of the largest lit region is sampled row by row and column by column; a circle is fitted to it
    by RANSAC (seeded) and least squares. Text and logos beside the picture are no part of that region.

    Returns:
        None where the rim is no circle, most of what it surrounds is dark, or the picture fills the image.
    """
    region = _largest(view_mask(rgb, _dark_below(rgb)))
    rim = _rim(region)
    height, width = rgb.shape[1:3]
    if len(rim) < 0.25 * height:
        return None
    tolerance = max(1.0, _CIRCLE_TOLERANCE_SHARE * width)
    generator = np.random.default_rng(0)
    best: np.ndarray | None = None
    for _ in range(_CIRCLE_TRIALS):
        found = _fitted(rim[generator.choice(len(rim), 3, replace=False)])
        if found is None or not 0.2 * height < found[2] < 1.5 * width:
            continue
        on_it = np.abs(np.hypot(*(rim - found[:2]).T) - found[2]) < tolerance
        if best is None or on_it.sum() > best.sum():
            best = on_it
    if best is None:
        return None
    found = _fitted(rim[best])
    if found is None:
        return None
    circle = Circle(float(found[0]), float(found[1]), float(found[2]), 0.0)
    # Of a panel that touches the picture only the part that hides the rim counts, not the panel's outline.
    near = _rim(region & circle.mask(width, height, -_NEAR_TOLERANCES * tolerance))
    share = max(
        float((np.abs(np.hypot(*(points - found[:2]).T) - found[2]) < tolerance).mean())
        for points in (rim, near)
        if len(points)
    )
    disc = circle.mask(width, height)
    if share < _CIRCLE_INLIERS or (region & disc).sum() < _CIRCLE_LIT * disc.sum():
        return None
    return replace(circle, inliers=share)


def framed_picture(
    mask: Bool[np.ndarray, "f h w"], rgb: UInt8[np.ndarray, "f h w 3"]
) -> FramedPicture | None:
    """The picture inside a dark frame, of whatever outline and wherever in the frame.

    A mask alone does not tell: it also leaves out text, instruments, dark corners and unlit lumen, or is what
    somebody has drawn. The surround counts as clear where the largest region that the mask keeps is convex
    and symmetric, and its outline is a rim: dark on one side and lit on the other.

    Args:
        mask: where frames show tissue.
        rgb: the frames.

    Returns:
        None where the picture fills the image, or its surround is not clear.
    """
    import cv2

    region = _largest(np.asarray(np.any(mask, axis=0)))
    if not region.any():
        return None
    outline, _ = cv2.findContours(region.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    whole, hull = np.zeros(region.shape, np.uint8), np.zeros(region.shape, np.uint8)
    cv2.drawContours(whole, outline, -1, 1, cv2.FILLED)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.concatenate(outline)), 1)
    left, top, width, height = cv2.boundingRect(hull)
    if (height, width) == region.shape or hull.sum() > (1 + _LARGEST_DENT) * whole.sum():
        return None
    inside = hull[top : top + height, left : left + width] > 0
    for mirrored in (inside[:, ::-1], inside[::-1]):
        if (inside & mirrored).sum() < _ALIKE_MIRRORED * (inside | mirrored).sum():
            return None
    return FramedPicture(left, top, width, height) if _is_rim(hull, rgb) else None


def overlay_mask(
    rgb: UInt8[np.ndarray, "f h w 3"], inside: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Burnt-in text and signs inside the picture.

    Their edges are strong in all frames (the tenth percentile over frames of the gradient is taken, so that
    changing digits are joined by those that stay), while the scene changes. Found edges are closed and
    dilated to whole signs.

    Args:
        rgb: frames of one recording, spread over it.
        inside: the picture; its rim is no sign.

    Returns:
        True on overlays; false everywhere with fewer than four frames, or where too little of the picture
        moves to tell.
    """
    import cv2

    frames, height, width = rgb.shape[:3]
    nothing = np.zeros((height, width), dtype=bool)
    if frames < _MIN_FRAMES:
        return nothing
    grey = np.stack([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in rgb])
    change = np.percentile(grey, 90, axis=0) - np.percentile(grey, 10, axis=0)
    margin = max(2, round(2 * _MARGIN_SHARE * width))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    # The image border is no rim.
    padded = np.pad(inside.astype(np.uint8), margin, mode="edge")
    core = cv2.erode(padded, kernel)[margin:-margin, margin:-margin] > 0
    if not core.any() or (change[core] > _VISIBLE_CHANGE).mean() < _MOVED_SHARE:
        return nothing
    edges = np.percentile(np.stack([_gradient(image) for image in grey]), 10, axis=0)
    strong = ((edges > _EDGE_STRENGTH) & core).astype(np.uint8)
    gap = max(2, round(0.012 * width))
    closed = cv2.morphologyEx(
        strong, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_RECT, (2 * gap + 1, gap | 1))
    )
    found = cv2.dilate(closed, np.ones((5, 5), np.uint8)) > 0
    if found[core].mean() > _LARGEST_OVERLAY:
        logger.warning(
            "%.0f %% of the picture keeps its edges in all frames: taken for a scene that stands still, "
            "not for burnt-in text",
            100 * found[core].mean(),
        )
        return nothing
    return np.asarray(found & inside)


def looked_at(frames: int) -> Int[np.ndarray, "n"]:
    """The frames that the mask of so many is found from."""
    return np.round(np.linspace(0, frames - 1, min(frames, _MAX_FRAMES))).astype(np.int64)


def content_mask(rgb: UInt8[np.ndarray, "f h w 3"]) -> Bool[np.ndarray, "h w"]:
    """True where frames show tissue: inside the round picture, or the dark frame, and not under text.

    Long and large recordings are looked at through 32 frames at 640 pixels of width.

    Args:
        rgb: frames of one recording.
    """
    import cv2

    height, width = rgb.shape[1:3]
    if len(rgb) > _MAX_FRAMES:
        rgb = rgb[looked_at(len(rgb))]
    small = rgb
    if width > _LARGEST_WIDTH:
        size = (_LARGEST_WIDTH, round(_LARGEST_WIDTH * height / width))
        small = np.stack([cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in rgb])
    circle = content_circle(small)
    margin = max(1.0, _MARGIN_SHARE * small.shape[2])
    inside = (
        _picture(view_mask(small, _dark_below(small)), margin)
        if circle is None
        else circle.mask(small.shape[2], small.shape[1], margin)
    )
    found = inside & ~overlay_mask(small, inside)
    if found.shape == (height, width):
        return np.asarray(found)
    share = cv2.resize(found.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(share > 0.999)


def _dark_below(rgb: UInt8[np.ndarray, "f h w 3"]) -> int:
    """Below which value of the brightest channel a pixel may belong to the frame round the picture.

    A frame that is not quite black, as of a video whose black level was left at 16, is told by the corners:
    all four are of one value that stays from frame to frame, and the picture is brighter.
    """
    frames, height, width = rgb.shape[:3]
    rows, columns = (max(4, round(_CORNER_SHARE * size)) for size in (height, width))
    if frames < _MIN_FRAMES or 2 * rows > height or 2 * columns > width:
        return _DARK
    ends = [(slice(size), slice(-size, None)) for size in (rows, columns)]
    corners = np.stack([rgb[:, down, right].max(axis=-1) for down in ends[0] for right in ends[1]])
    low, high = int(corners.min()), int(corners.max())
    dark_below = high + _ABOVE_SURROUND
    if high - low > _CORNERS_ALIKE or not _NEARLY_DARK <= high <= _LARGEST_DARK:
        return _DARK
    middle = rgb[:, height // 4 : -(height // 4), width // 4 : -(width // 4)].max(axis=-1)
    return dark_below if np.median(middle) > 2 * dark_below else _DARK


def _is_rim(picture: UInt8[np.ndarray, "h w"], rgb: UInt8[np.ndarray, "f h w 3"]) -> bool:
    """Whether an outline, as far as it lies inside the image, parts what is lit from what is always dark."""
    import cv2

    brightest = np.zeros(picture.shape, np.uint8)
    for index in looked_at(len(rgb)):
        np.maximum(brightest, rgb[index].max(axis=-1), out=brightest)
    # The mask may end a margin inside of the rim, which is blurred.
    gap = 1 + int(np.ceil(2 * _MARGIN_SHARE * picture.shape[1]))
    thickness = max(2, round(_RIM_SHARE * picture.shape[1]))

    def grown(by: int) -> UInt8[np.ndarray, "h w"]:
        # The image border is no rim.
        kernel = np.ones((2 * abs(by) + 1, 2 * abs(by) + 1), np.uint8)
        padded = np.pad(picture, abs(by), mode="edge")
        changed = cv2.dilate(padded, kernel) if by > 0 else cv2.erode(padded, kernel)
        return np.asarray(changed[abs(by) : -abs(by), abs(by) : -abs(by)])

    beyond = brightest[(grown(gap + thickness) > 0) & (grown(gap) == 0)]
    within = brightest[(picture > 0) & (grown(-thickness) == 0)]
    limit = _LARGEST_DARK + _ABOVE_SURROUND
    return bool(
        len(beyond) > 0
        and len(within) > 0
        and (beyond < limit).mean() >= _RIM_DARK
        and (within >= limit).mean() >= _RIM_LIT
    )


def _picture(seen: Bool[np.ndarray, "h w"], margin_px: float) -> Bool[np.ndarray, "h w"]:
    """The picture of any outline, such as an octagon, less its blurred rim and what is written beside it."""
    import cv2

    found = _largest(seen)
    if not found.any():
        return found
    outline, _ = cv2.findContours(found.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    whole = np.zeros(found.shape, np.uint8)
    cv2.fillConvexPoly(whole, cv2.convexHull(np.concatenate(outline)), 1)
    # Pictures are convex: a dark corner of the lumen that made a dent belongs to them. What is far from
    # convex is something else, and is left as it was found.
    picture = whole if whole.sum() <= (1 + _LARGEST_DENT) * found.sum() else found.astype(np.uint8)
    margin = int(np.ceil(margin_px))
    kernel = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    # The image border is no rim.
    padded = np.pad(picture, margin, mode="edge")
    return np.asarray(cv2.erode(padded, kernel)[margin:-margin, margin:-margin] > 0)


def _largest(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The largest connected region after thin bridges are cut."""
    import cv2

    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=4)
    if count < 2:
        return mask
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))


def _rim(region: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "p 2"]:
    """First and last pixels of rows and columns, less those at the image border."""
    height, width = region.shape
    points = []
    for row in np.flatnonzero(region.any(axis=1)):
        columns = np.flatnonzero(region[row])
        points += [(columns[0], row + 0.5), (columns[-1] + 1, row + 0.5)]
    for column in np.flatnonzero(region.any(axis=0)):
        rows = np.flatnonzero(region[:, column])
        points += [(column + 0.5, rows[0]), (column + 0.5, rows[-1] + 1)]
    found = np.array(points, dtype=np.float64).reshape(-1, 2)
    inner = (found[:, 0] > 3) & (found[:, 0] < width - 3) & (found[:, 1] > 3) & (found[:, 1] < height - 3)
    return np.asarray(found[inner])


def _fitted(points: Float[np.ndarray, "p 2"]) -> Float[np.ndarray, "3"] | None:
    """Centre and radius of the circle nearest to the points (algebraic); None where they lie on a line."""
    mean = points.mean(axis=0)
    x, y = (points - mean).T
    matrix = np.column_stack([2 * x, 2 * y, np.ones_like(x)])
    solution, _, rank, _ = np.linalg.lstsq(matrix, x * x + y * y, rcond=None)
    square = solution[2] + solution[0] ** 2 + solution[1] ** 2
    if rank < 3 or square <= 0:
        return None
    return np.array([solution[0] + mean[0], solution[1] + mean[1], np.sqrt(square)])


def _gradient(grey: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Length of the gradient, in grey values per pixel."""
    import cv2

    across = cv2.Scharr(grey, cv2.CV_32F, 1, 0, scale=1 / 32)
    down = cv2.Scharr(grey, cv2.CV_32F, 0, 1, scale=1 / 32)
    return np.asarray(np.hypot(across, down))
