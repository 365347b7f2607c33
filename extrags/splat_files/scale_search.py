"""Which scale of its unit puts a scene where the frames show it.

Scaled about the world's origin by k, a scene looks from a camera at c as it does unscaled from c / k, and its
depths are k times as large. So all scales are renderings of one scene, from cameras that move along lines
through the origin, and a step along these has to be as short as the surroundings are near: in a scene far
from the origin a scale that is wrong by 2 % already puts the cameras outside of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from extrags.gaussians import Gaussians
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence

__all__ = ["LARGEST_SCALE", "SMALLEST_SCALE", "ScaleFit", "ScaleSearch"]

SMALLEST_SCALE = 1e-4
LARGEST_SCALE = 1e4
"""The scales that are searched, in units of the sequence in one unit of the file."""
_VIEWS = 5
_WIDTH_PX = 64
"""So many training frames are compared, at most so wide."""
_SEARCHED_GAUSSIANS = 30_000
"""The search renders so many, enlarged; what it finds is rendered once more with all."""
_NEIGHBOURS = 8
"""How near the surroundings are is the distance of this Gaussian: a floater or two count for nothing."""
_STEP = 0.35
"""Step of the cameras, as a share of the distance of their surroundings."""
_SHORTEST_STEP, _LONGEST_STEP = 0.002, 0.3
"""Of the logarithm of the scale."""
_NEAR_GAUSSIANS = 0.9
"""The nearest share of the Gaussians tells how wide a scene is."""
_REFINEMENTS = 7
"""How often the step is halved round the scale that fits best."""
_NEAR_SHARE = 0.01
"""As in `Scene.near`: the unit that is looked for must not decide what is rendered."""
_LEAST_CONTRAST = 0.005
"""Standard deviation of brightness, in [0, 1], under which a frame has nothing to correlate with."""

# What fits, and what fits better: set on the scenes and scales whose figures are in docs/export.md.
_NEAR_DEPTH = 0.25
"""Depth agrees where the median of its absolute log ratio is no larger."""
_LARGEST_MISFIT = 0.5
"""Misfit up to which agreeing depth is enough."""
_LIKE_BESIDE_DEPTH = 0.3
_LIKE_AGAINST_DEPTH = 0.55
_LIKE_WITHOUT_DEPTH = 0.35
"""Correlation from which pictures are alike: where depth agrees, where it does not, and without any."""
_ALL_SHOWN = 0.95
"""Share of the pixels that show the scene from which practically all do."""
_DEPTH_BIAS = 0.1
"""Error in depth, as a log ratio, that a scene trained without depth may have at the right scale."""
_MISFIT_NOISE = 0.03
_LIKENESS_NOISE = 0.02
"""Differences of misfit and of correlation that say nothing."""
_LESS_UNEXPLAINED = 0.6
"""Share of what the other scale's pictures leave unexplained, under which one explains clearly more."""
_MOST_DIGITS = 5
_ROUNDING_MISFIT = 0.005
"""A scale is written with as few digits, at most so many, as cost no more misfit than this."""


@dataclass(frozen=True)
class ScaleFit:
    """How a scene, scaled, agrees with some training frames.

    Args:
        scale: units of the sequence in one unit of the file.
        shown_share: pixels of the frames that show the scene.
        correlation: of the brightness of renderings and frames, mean over the frames that have contrast; what
            is not shown explains nothing, and a gain common to a frame, as of exposure, does not count. None
            where no frame has contrast.
        depth_error: median of the absolute log ratio of rendered and known depth; None where none is known,
            infinite where nothing known is shown.
        misfit: what the search minimises, 0 to 2. With depth the mean of the absolute log ratio, at most 1,
            which is also that of pixels that are not shown; else one less the correlation.
    """

    scale: float
    shown_share: float
    correlation: float | None
    depth_error: float | None
    misfit: float

    @property
    def fits(self) -> bool:
        """Whether scene and frames are of one world; measured on five scenes, see docs/export.md.

        With depth, where it agrees and half of it is shown, or less but in pictures that are somewhat alike;
        else, where pictures are alike: more so beside a depth that does not agree.
        """
        likeness = 0.0 if self.correlation is None else self.correlation
        if self.depth_error is None:
            return likeness >= _LIKE_WITHOUT_DEPTH
        shown = self.misfit <= _LARGEST_MISFIT or likeness >= _LIKE_BESIDE_DEPTH
        return (self.depth_error <= _NEAR_DEPTH and shown) or likeness >= _LIKE_AGAINST_DEPTH

    @property
    def possible(self) -> bool:
        """Whether it fits, or nothing says that it does not.

        Without depth, where practically all pixels show the scene, low correlation proves nothing about its
        place: it may be a true surface in one grey, or a mesh without texture.
        """
        return self.fits or (self.depth_error is None and self.shown_share >= _ALL_SHOWN)

    def clearly_better_than(self, other: ScaleFit) -> bool:
        """Whether this scale has to be taken in place of the other one.

        With depth: half the error, or half as much again of the pixels shown, unless pictures say the
        contrary. A scene's depth may be biased: a small error of the other one is held against it where its
        pictures are worse, too. Without depth: much less that the pictures leave unexplained.
        """
        if self.depth_error is None or other.depth_error is None:
            return self._explains_more_than(other)
        if self.misfit > other.misfit - _MISFIT_NOISE or other._explains_more_than(self):
            return False
        large = other.depth_error > _DEPTH_BIAS or self._explains_more_than(other)
        nearer = large and 2 * self.depth_error <= other.depth_error
        return nearer or self.shown_share >= 1.5 * other.shown_share

    def _explains_more_than(self, other: ScaleFit) -> bool:
        if self.correlation is None or other.correlation is None:
            return False
        unexplained = 1 - other.correlation
        return 1 - self.correlation <= min(_LESS_UNEXPLAINED * unexplained, unexplained - _LIKENESS_NOISE)

    @property
    def words(self) -> str:
        """What was found, for messages; to follow `the training views`."""
        if not self.shown_share:
            return "do not see it"
        found = [f"show it in {100 * self.shown_share:.3g} % of their pixels"]
        if self.correlation is not None:
            found.append(f"correlate with it by {self.correlation:.2f}")
        if self.depth_error is not None:
            factor = math.exp(min(self.depth_error, 700.0))
            off = f"{100 * (factor - 1):.2g} %" if factor < 2 else f"a factor of {factor:.3g}"
            hidden = math.isinf(self.depth_error)
            found.append("have no depth there" if hidden else f"have depth that it misses by {off} (median)")
        return f"{', '.join(found[:-1])} and {found[-1]}" if len(found) > 1 else found[0]


class ScaleSearch:
    """Renders a scene at any scale beside a few small training frames, and finds the scale that fits.

    Args:
        scene: in the unit of its file.
        sequence: posed frames; those with depth are preferred.
    """

    def __init__(self, scene: Scene, sequence: EndoscopicSequence) -> None:
        self._scene = scene
        self._thinned = _thinned(scene)
        train = sequence.train
        if sequence.depth_mm is not None and sequence.training_depth_known:
            depth = sequence.depth_mm
            train = np.array([k for k in train if bool((depth[k] > 0).any())])
        frames = train[np.unique(np.round(np.linspace(0, len(train) - 1, _VIEWS)).astype(np.int64))]
        self._cameras = sequence.cameras[frames].at_most_width(_WIDTH_PX)
        self._frames = _compared_frames(sequence, frames, self._cameras.height, self._cameras.width)
        self._surroundings = cKDTree(self._thinned.gaussians.means.numpy().astype(np.float64))

    def at(self, scale: float) -> ScaleFit:
        """The agreement at one scale, with all Gaussians."""
        return self._fit(self._scene, scale)

    def along(self) -> list[ScaleFit]:
        """The agreement from the largest scale to the smallest, in steps that miss nothing, thinned."""
        return [self._fit(self._thinned, scale) for scale in self._path()]

    def may_have_missed(self, tried: list[ScaleFit]) -> bool:
        """Whether the shortest step, where it was taken, carries the cameras past a good part of the scene.

        Args:
            tried: from `along`.
        """
        across = _STEP * _width(self._thinned)
        shortest = [fit.scale for fit in tried if self._wanted_step(fit.scale) < _SHORTEST_STEP]
        return any(across < _SHORTEST_STEP * self._way(scale) for scale in shortest)

    def refined(self, start: ScaleFit) -> ScaleFit:
        """The scale of least misfit round one that `along` has rendered.

        Of as few digits as fit as well; rendered with all Gaussians at just that scale.
        """
        best = start
        step = self._step(start.scale)
        for _ in range(_REFINEMENTS):
            step /= 2
            for scale in (start.scale * math.exp(-step), start.scale * math.exp(step)):
                found = self._fit(self._thinned, scale)
                if found.misfit < best.misfit:
                    best = found
            start = best
        rounded = [self.at(float(f"{best.scale:.{digits}g}")) for digits in range(1, _MOST_DIGITS + 1)]
        limit = min(fit.misfit for fit in rounded) + _ROUNDING_MISFIT
        return next(fit for fit in rounded if fit.misfit <= limit)

    def _path(self) -> Iterator[float]:
        scale = LARGEST_SCALE
        while scale >= SMALLEST_SCALE:
            yield scale
            scale *= math.exp(-self._step(scale))

    def _step(self, scale: float) -> float:
        return min(_LONGEST_STEP, max(_SHORTEST_STEP, self._wanted_step(scale)))

    def _wanted_step(self, scale: float) -> float:
        """Step of the logarithm of the scale by which the cameras move a share of the way to a surface."""
        return _STEP * self._distance(scale) / self._way(scale)

    def _way(self, scale: float) -> float:
        """Typical distance of the cameras from the origin, in the file's unit; more than 0."""
        return max(float(np.median(np.linalg.norm(self._cameras.centers, axis=1))) / scale, 1e-12)

    def _distance(self, scale: float) -> float:
        """Typical distance of the cameras from the scene, in the file's unit."""
        count = min(_NEIGHBOURS, self._surroundings.n)
        distances = self._surroundings.query(self._cameras.centers / scale, k=[count])[0]
        return float(np.median(distances))

    def _fit(self, scene: Scene, scale: float) -> ScaleFit:
        poses = self._cameras.world_from_camera.copy()
        poses[:, :3, 3] /= scale
        near = _NEAR_SHARE * self._distance(scale)
        with torch.no_grad():
            rendering = scene.render(
                replace(self._cameras, world_from_camera=poses), median_depth=True, near=max(near, 1e-12)
            )
        frames = self._frames
        shown = (rendering.alpha.numpy() > 0.5) & frames.mask
        correlation = _correlation(rendering.rgb.clamp(0, 1).mean(dim=-1).numpy(), shown, frames)
        error, misfit = None, 1.0 if correlation is None else 1 - correlation
        if frames.depth is not None:
            known = frames.mask & (frames.depth > 0)
            both = known & shown
            rendered = np.asarray(rendering.median_depth)[both] * scale
            logs = np.abs(np.log(np.maximum(rendered, 1e-20) / frames.depth[both]))
            error = float(np.median(logs)) if len(logs) else math.inf
            missing = int(known.sum()) - len(logs)
            misfit = (float(np.minimum(logs, 1).sum()) + missing) / max(1, int(known.sum()))
        return ScaleFit(
            scale, float(shown.sum() / max(1, int(frames.mask.sum()))), correlation, error, misfit
        )


@dataclass(frozen=True)
class _Frames:
    grey: Float[np.ndarray, "v h w"]
    mask: Bool[np.ndarray, "v h w"]
    depth: Float[np.ndarray, "v h w"] | None


def _compared_frames(sequence: EndoscopicSequence, frames: np.ndarray, height: int, width: int) -> _Frames:
    from cv2 import INTER_AREA, resize

    # Nearest pixels: depth and masks are not averaged over edges.
    rows = ((np.arange(height) + 0.5) * sequence.height / height).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * sequence.width / width).astype(np.int64)
    small = [resize(sequence.rgb[k], (width, height), interpolation=INTER_AREA) for k in frames]
    depth = sequence.depth_mm if sequence.training_depth_known else None
    return _Frames(
        grey=np.stack(small).astype(np.float64).mean(axis=-1) / 255,
        mask=sequence.mask[frames][:, rows][:, :, columns],
        depth=None if depth is None else depth[frames][:, rows][:, :, columns].astype(np.float64),
    )


def _thinned(scene: Scene) -> Scene:
    """Every n-th Gaussian, enlarged so that they cover the same surface."""
    every = -(-len(scene.gaussians) // _SEARCHED_GAUSSIANS)
    if every == 1:
        return scene
    values = {name: value[::every] for name, value in scene.gaussians.parameters().items()}
    values["scales"] = values["scales"] + 0.5 * math.log(every)
    return Scene(Gaussians(**values), scene.light)


def _width(scene: Scene) -> float:
    """Standard deviation of its Gaussians across: of a tube across its length, of a plane along it."""
    means = scene.gaussians.means.numpy().astype(np.float64)
    means = means - np.median(means, axis=0)
    distance = np.linalg.norm(means, axis=1)
    # Floaters far outside would make it large.
    near = means[distance <= np.quantile(distance, _NEAR_GAUSSIANS)]
    return math.sqrt(max(0.0, float(np.linalg.eigvalsh(near.T @ near / len(near))[1])))


def _correlation(
    rendered: Float[np.ndarray, "v h w"], shown: Bool[np.ndarray, "v h w"], frames: _Frames
) -> float | None:
    """Mean over the frames that have contrast."""
    found = []
    for image, grey, visible, mask in zip(rendered, frames.grey, shown, frames.mask, strict=True):
        if not mask.any() or grey[mask].std() < _LEAST_CONTRAST:
            continue
        given = grey[mask] - grey[mask].mean()
        if not visible.any():
            found.append(0.0)
            continue
        x = image[visible] - image[visible].mean()
        y = grey[visible] - grey[visible].mean()
        size = math.sqrt(float((x**2).sum()) * float((given**2).sum()))
        found.append(float((x * y).sum()) / size if size > 0 else 0.0)
    return float(np.mean(found)) if found else None
