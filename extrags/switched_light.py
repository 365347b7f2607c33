"""Frames that were recorded under another light, such as narrow-band imaging: their colours are matched.

Endoscopes switch to light of a few narrow bands, in which vessels stand out, and back. A surface that some
frames show in these colours and others in white light gets a mixture of both. Frames of one light differ
from the others by a mixing of the three colours, which features that both show tell: where a linear map
explains their colours, frames of the rarer light are mapped to the other one. What narrow bands do not tell,
as most of the red, is thereby what tissue of such colours has in the mean.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from extrags.carried_depth import evenly
from extrags.feature_matches import Features, mutual_matches, sift_features
from extrags.frame_stacks import FrameStack
from extrags.sequence import EndoscopicSequence
from extrags.splits import Split

__all__ = ["LightSwitch", "light_switch", "with_matched_light"]

_log = logging.getLogger(__name__)

GAMMA = 2.2
"""Of stored values, about."""

LEAST_SEPARATION = 0.4
"""Of the mean colours of two lights, as logarithms of red and blue over green in linear light. Frames of one
light split into halves at most .22 apart."""

SEPARATION_TIMES = 3.0
"""The same in standard deviations of frames of one light."""

LEAST_FRAMES = 2
"""Training frames of each light."""

LOOKED_AT_PX = 5_000
"""Pixels of a frame that tell its colour, about."""

DARKEST, BRIGHTEST = 10, 247
"""Of 255: the brightest channel of a pixel whose colour tells."""

WIDTH_PX = 640
"""Larger frames are shrunk to this width to be matched."""

REACH = 3
"""Frames before and behind a switch of the light that are matched, at most so far from each other."""

SWITCHES = 8
"""Switches of the light that are looked at."""

LEAST_INLIERS = 15
"""Matches of two frames, at least, that agree about the motion between them."""

LEAST_MATCHES = 60
"""Of all pairs of frames of two lights."""

SAME_CHANGE, OTHER_CHANGE = 0.5, 0.3
"""Shares of the separation by which matches of frames of two lights change their colour at least, and those
of one light at most."""

LEFT = 0.6
"""Share of the difference of colours at matches that the map leaves at most."""

NOISE = 0.005
"""Standard deviation of stored values from 0 to 1. Colours of narrow bands differ little from each other: a
map that takes no account of noise multiplies it by ten."""

HAZE = np.linspace(0, 0.3, 31)
"""Grey light, from 0 to 1, that smoke or a fogged lens may add to frames of paler colours."""

LEFT_OF_HAZE = 0.5
"""Share of the difference that taking it away leaves at least: frames where it leaves less are hazy, and not
of another light. Haze is learned later."""

STEPS = 10
"""Of least squares with weights that bound outliers."""


@dataclass(frozen=True)
class LightSwitch:
    """Frames of the rarer of two lights, and how its colours become those of the other.

    Args:
        frames: indices in the sequence, held-out ones among them.
        mixing: stored values (in any unit, a row each) of the other light are those of this one times this,
            [3, 3].
        matches: of features that told.
        difference: of the colours at these before, relative, in the median.
        left: the same with the map.
    """

    frames: Int[np.ndarray, "n"]
    mixing: Float[np.ndarray, "3 3"]
    matches: int
    difference: float
    left: float

    def matched(self, rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """A frame of the rarer light in the colours of the other."""
        return np.asarray(np.rint(_mapped(rgb.astype(np.float64), self.mixing).clip(0, 255)).astype(np.uint8))


def with_matched_light(sequence: EndoscopicSequence) -> EndoscopicSequence:
    """The sequence, its training frames in the colours of one light; a warning says which were not.

    Held-out frames of the rarer light stay as they are and are not measured on, unless all are.

    Args:
        sequence: with or without poses.
    """
    found = light_switch(sequence)
    if found is None:
        return sequence
    train = np.intersect1d(found.frames, sequence.train)
    test = np.setdiff1d(sequence.split.test, found.frames)
    split = sequence.split
    if len(test) and len(test) < len(split.test):
        split = Split(split.name, split.train, test, split.version)
    frames, changed = FrameStack(len(sequence)), set(train.tolist())
    for frame, rgb in enumerate(sequence.rgb):
        frames.append(found.matched(rgb) if frame in changed else rgb)
    _log.warning(
        "%s: %d of %d training frames, %s first, were recorded under another light, as narrow-band imaging: "
        "their colours are matched to those of the others by %d features%s (ingest.match_light)",
        sequence.name,
        len(train),
        len(sequence.train),
        sequence.frame_name(int(train[0])),
        found.matches,
        _left_out(len(sequence.split.test) - len(split.test)),
        extra={"topic": "light", "field": "rgb"},
    )
    return replace(sequence, rgb=frames.array, split=split)


def _left_out(count: int) -> str:
    return f"; {count} held-out frames of this light are left out" if count else ""


def light_switch(sequence: EndoscopicSequence) -> LightSwitch | None:
    """The rarer of two lights, where features of both tell that and how they differ.

    Args:
        sequence: with or without poses.

    Returns:
        None where all frames are of one light, or where that cannot be told.
    """
    if len(sequence.train) < 2 * LEAST_FRAMES:
        return None
    train = np.sort(sequence.train)
    colors = np.stack([_log_color(sequence, int(frame)) for frame in train])
    tells = np.isfinite(colors).all(1)
    train, colors = train[tells], colors[tells]
    groups = _two_lights(colors) if len(train) >= 2 * LEAST_FRAMES else None
    if groups is None:
        return None
    rare, centers = groups
    across, within = _pairs(sequence, train, rare)
    frames = _Frames(sequence)
    first, second = frames.matched_colors(across)
    if len(first) < LEAST_MATCHES:
        return None
    separation = centers[1] - centers[0]
    length = float(np.linalg.norm(separation))
    changes = (_log_ratios(second) - _log_ratios(first)) @ (separation / length)
    if float(np.median(changes)) < SAME_CHANGE * length:
        return None
    here, there = frames.matched_colors(within)
    steady = np.linalg.norm(_log_ratios(there) - _log_ratios(here), axis=1)
    if len(here) >= LEAST_MATCHES and float(np.median(steady)) > OTHER_CHANGE * length:
        return None
    mixing = _mixing(first, second)
    difference, left = (_relative(mapped, second) for mapped in (first, _mapped(first, mixing)))
    if left > LEFT * difference:
        return None
    paler = np.argmin(np.linalg.norm(centers, axis=1))
    if _without_haze(*((first, second) if paler == 0 else (second, first))) < LEFT_OF_HAZE * difference:
        return None
    held_out = np.array([int(frame) for frame in sequence.test], dtype=np.int64)
    of_rare = [frame for frame in held_out if _is_nearer(_log_color(sequence, int(frame)), centers)]
    of_one = np.sort(np.concatenate([train[rare], np.array(of_rare, dtype=np.int64)]))
    return LightSwitch(of_one, mixing, len(first), difference, left)


def _log_color(sequence: EndoscopicSequence, frame: int) -> Float[np.ndarray, "2"]:
    """Logarithms of red and blue over green, of a frame's mean in linear light; NaN where nothing tells."""
    every = max(1, round(np.sqrt(sequence.height * sequence.width / LOOKED_AT_PX)))
    pixels = sequence.rgb[frame][::every, ::every][sequence.mask[frame][::every, ::every]]
    brightest = pixels.max(1, initial=0)
    pixels = pixels[(brightest >= DARKEST) & (brightest <= BRIGHTEST)]
    if not len(pixels):
        return np.full(2, np.nan)
    return np.asarray(_log_ratios(((pixels / 255.0) ** GAMMA).mean(0, keepdims=True) ** (1 / GAMMA))[0])


def _log_ratios(stored: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Logarithms of red and blue over green, in linear light."""
    logs = GAMMA * np.log(np.maximum(stored, 0.5 / 255))
    return np.asarray(logs[:, [0, 2]] - logs[:, [1]])


def _two_lights(
    colors: Float[np.ndarray, "n 2"],
) -> tuple[Bool[np.ndarray, "n"], Float[np.ndarray, "2 2"]] | None:
    """Which frames are of the rarer light, and the mean colours of it and of the other.

    Of as many frames of both the less red light, as narrow bands are, is taken for the rarer one. None where
    frames do not fall into two groups that are far apart.
    """
    centered = colors - colors.mean(0)
    axis = np.linalg.svd(centered, full_matrices=False)[2][0]
    # Its sign is arbitrary: the redder frames are to come last.
    axis = axis if axis[0] >= 0 else -axis
    place = centered @ axis
    order = np.argsort(place, kind="stable")
    ordered = place[order]
    cuts = range(LEAST_FRAMES, len(ordered) - LEAST_FRAMES + 1)
    spreads = [ordered[:cut].var() * cut + ordered[cut:].var() * (len(ordered) - cut) for cut in cuts]
    cut = cuts[int(np.argmin(spreads))]
    spread = np.sqrt(min(spreads) / len(ordered))
    apart = ordered[cut:].mean() - ordered[:cut].mean()
    if apart < LEAST_SEPARATION or apart < SEPARATION_TIMES * spread:
        return None
    rare = np.zeros(len(colors), dtype=bool)
    rare[order[:cut] if cut <= len(order) - cut else order[cut:]] = True
    return rare, np.stack([colors[rare].mean(0), colors[~rare].mean(0)])


def _is_nearer(color: Float[np.ndarray, "2"], centers: Float[np.ndarray, "2 2"]) -> bool:
    """Whether a colour is nearer to the first centre; one that is not known is not."""
    there, other = np.linalg.norm(centers - color, axis=1)
    return bool(there < other)


def _pairs(
    sequence: EndoscopicSequence, train: Int[np.ndarray, "n"], rare: Bool[np.ndarray, "n"]
) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Frames on both sides of switches, the rarer light first; and as many neighbours of one light."""
    recording = np.zeros(len(sequence), int) if sequence.recording is None else sequence.recording
    neighbours = [k for k in range(len(train) - 1) if recording[train[k]] == recording[train[k + 1]]]
    switches = [k for k in neighbours if rare[k] != rare[k + 1]]
    across = []
    for switch in (switches[k] for k in evenly(len(switches), SWITCHES)):
        for before, behind in _around(switch, len(train)):
            if rare[before] != rare[behind] and recording[train[before]] == recording[train[behind]]:
                first, second = (before, behind) if rare[before] else (behind, before)
                across.append((int(train[first]), int(train[second])))
    steady = [k for k in neighbours if rare[k] == rare[k + 1]]
    within = [(int(train[steady[k]]), int(train[steady[k] + 1])) for k in evenly(len(steady), SWITCHES)]
    return list(dict.fromkeys(across)), within


def _around(switch: int, count: int) -> Iterator[tuple[int, int]]:
    """Positions before and behind a switch, at most `REACH` apart."""
    for before in range(max(0, switch - REACH + 1), switch + 1):
        for behind in range(switch + 1, min(count, before + REACH + 1)):
            yield before, behind


class _Frames:
    """Frames at a size that is enough for matching, and their features.

    Args:
        sequence: with or without poses.
    """

    def __init__(self, sequence: EndoscopicSequence) -> None:
        self._sequence = sequence
        self._seen: dict[int, tuple[Features, Float[np.ndarray, "n 3"]]] = {}

    def features(self, frame: int) -> tuple[Features, Float[np.ndarray, "n 3"]]:
        """Of a frame, and the stored values round them, from 0 to 1."""
        if frame not in self._seen:
            rgb, mask = self._sequence.rgb[frame], self._sequence.mask[frame]
            height, width = mask.shape
            if width > WIDTH_PX:
                size = (WIDTH_PX, max(1, round(height * WIDTH_PX / width)))
                rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
                mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
            found = sift_features(rgb, mask)
            row, column = found.rows_and_columns(*mask.shape)
            across = 2 * max(1, round(mask.shape[1] / 200)) + 1
            self._seen[frame] = (found, cv2.blur(rgb, (across, across))[row, column] / 255.0)
        return self._seen[frame]

    def matched_colors(
        self, pairs: list[tuple[int, int]]
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        """Stored values at the features that frames share, of all pairs together."""
        parts = [self._of_pair(*pair) for pair in pairs]
        nothing = np.zeros((0, 3))
        first, second = (np.concatenate([nothing, *(part[k] for part in parts)]) for k in (0, 1))
        return first, second

    def _of_pair(self, first: int, second: int) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        (here, mine), (there, theirs) = self.features(first), self.features(second)
        matches = mutual_matches(here.descriptors, there.descriptors)
        kept = np.zeros(len(matches), dtype=bool)
        if len(matches) >= LEAST_INLIERS:
            near = max(1.5, 0.004 * min(self._sequence.width, WIDTH_PX))
            _, agrees = cv2.findFundamentalMat(
                here.pixels[matches[:, 0]], there.pixels[matches[:, 1]], cv2.FM_RANSAC, near, 0.999
            )
            if agrees is not None and int(agrees.sum()) >= LEAST_INLIERS:
                kept = agrees.ravel() > 0
        shown = mine[matches[kept, 0]], theirs[matches[kept, 1]]
        brightest = [colors.max(1, initial=0) for colors in shown]
        tells = np.minimum(*brightest) >= DARKEST / 255
        tells &= np.maximum(*brightest) <= BRIGHTEST / 255
        return shown[0][tells], shown[1][tells]


def _mixing(first: Float[np.ndarray, "m 3"], second: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "3 3"]:
    """The map of the first colours to the second, relative to how bright these are, outliers bounded."""
    weight = np.ones(len(first))
    brightness = np.linalg.norm(second, axis=1)
    mixing = np.eye(3)
    for _ in range(STEPS):
        weights = weight / brightness**2
        # Normal equations, summed without BLAS, whose rounding follows the number of threads.
        squares = np.einsum("m,mi,mj->ij", weights, first, first) + weights.sum() * NOISE**2 * np.eye(3)
        mixing = np.linalg.solve(squares, np.einsum("m,mi,mj->ij", weights, first, second))
        residual = np.linalg.norm(_mapped(first, mixing) - second, axis=1) / brightness
        residual = np.maximum(residual, 1e-9)
        weight = np.minimum(1, np.median(residual) / residual) ** 0.5
    return np.asarray(mixing)


def _without_haze(hazy: Float[np.ndarray, "m 3"], clear: Float[np.ndarray, "m 3"]) -> float:
    """Relative difference of colours once the grey light is taken away with which it is least."""
    light = hazy**GAMMA
    veiled = (np.maximum(light - haze, 1e-6) ** (1 / GAMMA) for haze in HAZE)
    return min(_relative(colors, clear) for colors in veiled)


def _mapped(colors: Float[np.ndarray, "*m 3"], mixing: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "*m 3"]:
    return np.asarray(sum(colors[..., k, None] * mixing[k] for k in range(3)))


def _relative(first: Float[np.ndarray, "m 3"], second: Float[np.ndarray, "m 3"]) -> float:
    """Relative difference of colours once they are equally bright, in the median."""
    unit = [
        colors / np.maximum(np.linalg.norm(colors, axis=1, keepdims=True), 1e-9) for colors in (first, second)
    ]
    return float(np.median(np.linalg.norm(unit[0] - unit[1], axis=1)))
