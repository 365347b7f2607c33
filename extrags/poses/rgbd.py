"""Poses from colour and depth: each frame is aligned with the frames that are placed already.

The model is the set of placed frames, each kept as it is instead of being fused into a volume, so a frame
that proves wrong later can still be moved. Training frames make the model, in the order of time and then
all together; held-out frames are aligned with the finished model afterwards, one by one, and never move it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from extrags.cameras import project_points
from extrags.config import PosesConfig
from extrags.errors import CaptureError
from extrags.events import Progress, emit
from extrags.poses.alignment import Agreement, Posed, agreement, align, moved, pair_equations, solve_twists
from extrags.poses.depth_views import LEVELS, DepthView, depth_view
from extrags.poses.landmarks import Landmarks, landmarks, relative_pose
from extrags.poses.pairs import spread_evenly
from extrags.sequence import EndoscopicSequence

__all__ = ["RgbdAlignment", "align_by_depth"]

MIN_SURFACE = 0.6
"""Of the points of a frame that fall into placed frames, at least this share must meet their surface."""
MIN_OVERLAP = 0.15
MIN_EVIDENCE = 0.85
"""Smallest sum of surface and texture agreement: smooth walls fit each other without texture."""
RECOGNISED = 15
"""This many landmarks that agree on a pose are sufficient evidence."""
CERTAIN_SURFACE, CERTAIN_TEXTURE = 0.9, 0.4
"""With this agreement no further starting pose is tried."""
PLACES = 12
"""Placed frames with which a frame without a good start is matched."""
LINKS = 4
"""Frames a new frame is aligned with; the joint adjustment uses more."""
BEGINNINGS = 5
"""Frames that a model is begun with, one after another, while most frames cannot be joined to it."""
JOINT_ROUNDS = 8
JOINT_OVERLAP = 0.3
POINTS = 4000


@dataclass(frozen=True)
class RgbdAlignment:
    """Result of the alignment; see `align_by_depth`.

    Args:
        world_from_camera: [F, 4, 4], NaN for frames that were not placed; the first placed frame is the
            origin, lengths are those of the depth.
        points: of the surface the training frames show, [P, 3].
        points_rgb: their colours, [P, 3].
        report: counts and residuals, ready for JSON.
    """

    world_from_camera: Float[np.ndarray, "f 4 4"]
    points: Float[np.ndarray, "p 3"]
    points_rgb: UInt8[np.ndarray, "p 3"]
    report: dict[str, Any]


def align_by_depth(sequence: EndoscopicSequence, config: PosesConfig) -> RgbdAlignment:
    """Place the frames of a sequence by their colour and depth.

    A frame starts from where its predecessor is, from the same motion once more, and from where features it
    shares with placed frames put it; each start is aligned (`extrags.poses.alignment`) and the one that fits
    surface and texture best is taken, if it fits well enough.

    Args:
        sequence: with depth; poses it may have are not looked at.
        config: size and neighbours.

    Raises:
        CaptureError: for a sequence without depth, or without depth in all its training frames.
    """
    if sequence.depth_mm is None:
        raise CaptureError(f"{sequence.name}: alignment by colour and depth needs depth, and there is none")
    return _Alignment(sequence, config).run()


@dataclass(frozen=True)
class _Model:
    """Frames that were joined to one another, and what is known of those that were tried."""

    placed: dict[int, Posed]
    model: list[int]
    fits: dict[int, Agreement]
    recognised: dict[int, int]


class _Alignment:
    def __init__(self, sequence: EndoscopicSequence, config: PosesConfig) -> None:
        self.sequence, self.config = sequence, config
        frames = len(sequence)
        self.recording = (
            np.zeros(frames, dtype=np.int64) if sequence.recording is None else sequence.recording
        )
        self.views: dict[int, DepthView] = {}
        self.landmarks: dict[int, Landmarks] = {}
        self.placed: dict[int, Posed] = {}
        self.model: list[int] = []
        """Training frames placed so far."""
        self.fits: dict[int, Agreement] = {}
        self.recognised: dict[int, int] = {}
        self.done = 0
        self.total = 2 * frames + len(sequence.train) + JOINT_ROUNDS

    def run(self) -> RgbdAlignment:
        train = [int(frame) for frame in self.sequence.train]
        test = [int(frame) for frame in self.sequence.test]
        self._prepare(train)
        waiting = [frame for frame in train if frame in self.views]
        if not waiting:
            raise CaptureError(
                f"{self.sequence.name}: none of {len(train)} training frames has enough depth to be aligned"
            )
        self._build_model(waiting)
        residual = self._adjust_jointly()
        self._prepare(test)
        self._place_all([frame for frame in test if frame in self.views], grows=False)
        emit(Progress("poses", self.total, self.total, {"registered": float(len(self.placed))}))
        poses = np.full((len(self.sequence), 4, 4), np.nan)
        for frame, posed in self.placed.items():
            poses[frame] = posed.world_from_camera
        points, colors = self._surface()
        return RgbdAlignment(poses, points, colors, self._account(residual))

    def _build_model(self, frames: list[int]) -> None:
        """Place training frames, beginning with the first; where most cannot be joined to it, with another.

        It may show something else, or nothing: the largest model counts, as among COLMAP's.
        """
        largest: _Model | None = None
        left = frames
        for _ in range(BEGINNINGS):
            first, *others = left
            self.placed, self.model = {first: Posed(self.views[first], np.eye(4))}, [first]
            self.fits, self.recognised = {}, {}
            self._place_all(others, grows=True)
            found = _Model(self.placed, self.model, self.fits, self.recognised)
            if largest is None or len(found.model) > len(largest.model):
                largest = found
            left = [frame for frame in left if frame not in self.placed]
            if len(left) <= len(largest.model):
                break
        assert largest is not None
        self.placed, self.model = largest.placed, largest.model
        self.fits, self.recognised = largest.fits, largest.recognised
        if len(self.placed) + len(left) < len(frames):
            # Those that were joined to a smaller one have not been tried with this.
            self._place_all([frame for frame in frames if frame not in self.placed], grows=True)

    def _prepare(self, frames: list[int]) -> None:
        for frame in frames:
            view = depth_view(self.sequence, frame, self.config.rgbd_width)
            if view is not None:
                self.views[frame] = view
                self.landmarks[frame] = landmarks(self.sequence, frame)
            self._step()

    def _place_all(self, waiting: list[int], *, grows: bool) -> None:
        """In temporal order; frames that cannot be placed are tried again after others were."""
        told = self.done + len(waiting)
        thorough = False
        while waiting:
            left = []
            for frame in waiting:
                if not self._place(frame, grows=grows, thorough=thorough):
                    left.append(frame)
                elif self.done < told:
                    self._step()
            if len(left) == len(waiting) and thorough:
                break
            # Once more with a wider search, as long as that places any.
            thorough = True
            waiting = left

    def _place(self, frame: int, *, grows: bool, thorough: bool) -> bool:
        view = self.views[frame]
        best: tuple[float, np.ndarray, Agreement] | None = None
        recognised = 0
        for start, support in self._starts(frame, thorough):
            near = self._nearest(view, start, LINKS)
            if not near:
                continue
            pose = align(view, start, near)
            # What it was started from may not be what it sees from where it came to stand.
            near = self._nearest(view, pose, LINKS)
            if not near:
                continue
            pose = align(view, pose, near, first_level=len(LEVELS) - 2)
            fit = agreement(Posed(view, pose), near)
            if best is None or fit.score > best[0]:
                best, recognised = (fit.score, pose, fit), support
            if fit.surface > CERTAIN_SURFACE and fit.texture > CERTAIN_TEXTURE:
                break
        if best is None:
            return False
        self.fits[frame], self.recognised[frame] = best[2], recognised
        if not _convincing(best[2], recognised):
            return False
        self.placed[frame] = Posed(view, best[1])
        if grows:
            self.model.append(frame)
        return True

    def _starts(self, frame: int, thorough: bool) -> list[tuple[np.ndarray, int]]:
        """Guesses with the number of landmarks behind each, none twice."""
        guesses: list[tuple[np.ndarray, int]] = []
        same = [
            other
            for other in self.placed
            if self.recording[other] == self.recording[frame] and other != frame
        ]
        same.sort(key=lambda other: (abs(other - frame), other))
        guesses += [(self.placed[other].world_from_camera, 0) for other in same[: 3 if thorough else 1]]
        if len(same) >= 2:
            last, before = (self.placed[other].world_from_camera for other in same[:2])
            if abs(same[0] - frame) < abs(same[1] - frame) and (same[0] - frame) * (same[1] - frame) > 0:
                guesses.append((last @ np.linalg.inv(before) @ last, 0))
        nearest = sorted(self.model, key=lambda other: (abs(other - frame), other))
        in_time = [other for other in nearest if self.recording[other] == self.recording[frame]]
        places = in_time[: 3 if in_time else 0]
        if thorough or not places:
            spread = spread_evenly(np.array(sorted(self.model)), PLACES)
            places += [int(other) for other in spread if other not in places]
        found = []
        for other in places:
            between, support = relative_pose(
                self.landmarks[frame], self.landmarks[other], seed=self.config.seed + 7919 * frame + other
            )
            if between is not None:
                found.append((self.placed[other].world_from_camera @ between, support))
        found.sort(key=lambda guess: -guess[1])
        # Many landmarks that agree are hardly ever wrong; without them the nearest frame in time is all.
        sure = [guess for guess in found if guess[1] >= RECOGNISED]
        return sure[:2] + guesses + [guess for guess in found[:4] if guess[1] < RECOGNISED]

    def _nearest(self, view: DepthView, pose: np.ndarray, count: int, without: int = -1) -> list[Posed]:
        """The model frames that show most of what a frame sees; looking from nearly the same side counts."""
        scored = []
        for other in self.model:
            if other == without:
                continue
            share = _overlap(Posed(view, pose), self.placed[other])
            if share >= MIN_OVERLAP:
                scored.append((-share, other))
        return [self.placed[other] for _, other in sorted(scored)[:count]]

    def _adjust_jointly(self) -> float:
        """Adjust all model frames together, so that drift from frame to frame does not accumulate."""
        number = {frame: index for index, frame in enumerate(self.model)}
        unit = float(np.median([self.views[frame].median_depth for frame in self.model]))
        pairs: list[tuple[int, int]] = []
        for frame in self.model:
            scored = sorted(
                (-share, other)
                for other in self.model
                if other != frame
                and (share := _overlap(self.placed[frame], self.placed[other])) >= JOINT_OVERLAP
            )
            pairs += [(frame, other) for _, other in scored[: self.config.rgbd_neighbours]]
        finest = len(LEVELS) - 1
        for round_number in range(JOINT_ROUNDS):
            level = finest - 1 if round_number < JOINT_ROUNDS // 2 else finest
            centre = np.mean([self.placed[frame].world_from_camera[:3, 3] for frame in self.model], axis=0)
            equations = [
                (number[i], number[j], pair_equations(self.placed[i], self.placed[j], level, centre))
                for i, j in pairs
            ]
            if equations:
                twists = solve_twists(equations, len(self.model), unit)
                for frame, twist in zip(self.model, twists, strict=True):
                    posed = self.placed[frame]
                    pose = moved(posed.world_from_camera, twist, centre)
                    self.placed[frame] = replace(posed, world_from_camera=pose)
            self._step()
        residuals = []
        for frame in self.model:
            near = [self.placed[other] for i, other in pairs if i == frame]
            if near:
                self.fits[frame] = agreement(self.placed[frame], near)
                residuals.append(self.fits[frame].residual_mm)
        finite = [value for value in residuals if np.isfinite(value)]
        return float(np.median(finite)) if finite else 0.0

    def _surface(self) -> tuple[np.ndarray, np.ndarray]:
        """A thin cloud of what the model frames show."""
        each = max(1, POINTS // len(self.model))
        points, colors = [], []
        for frame in self.model:
            view, pose = self.placed[frame].view, self.placed[frame].world_from_camera
            chosen = spread_evenly(view.samples, each)
            local = view.points.reshape(-1, 3)[chosen]
            points.append(local @ pose[:3, :3].T + pose[:3, 3])
            column, row = np.floor(project_points(local, self.sequence.K[frame])).astype(np.int64).T
            colors.append(
                self.sequence.rgb[frame][
                    np.clip(row, 0, self.sequence.height - 1), np.clip(column, 0, self.sequence.width - 1)
                ]
            )
        return np.concatenate(points), np.concatenate(colors)

    def _account(self, residual: float) -> dict[str, Any]:
        frames = {}
        for frame, fit in sorted(self.fits.items()):
            frames[self.sequence.frame_name(frame)] = {
                "placed": frame in self.placed,
                "overlap": round(fit.overlap, 4),
                "surface": round(fit.surface, 4),
                "texture": round(fit.texture, 4),
                "landmarks": self.recognised.get(frame, 0),
            }
        return {
            "surface_residual_mm" if self.sequence.metric else "surface_residual": residual,
            "frames": frames,
            "without_depth": [
                self.sequence.frame_name(int(frame))
                for frame in (*self.sequence.train, *self.sequence.test)
                if int(frame) not in self.views
            ],
        }

    def _step(self) -> None:
        self.done = min(self.done + 1, self.total)
        emit(Progress("poses", self.done, self.total, {"registered": float(len(self.placed))}))


def _convincing(fit: Agreement, recognised: int) -> bool:
    if fit.overlap < MIN_OVERLAP or fit.surface < MIN_SURFACE:
        return False
    return fit.surface + max(fit.texture, 0.0) >= MIN_EVIDENCE or recognised >= RECOGNISED


def _overlap(moving: Posed, reference: Posed, stride: int = 8) -> float:
    """Share of a frame's points that another frame sees, from nearly as near and the same side."""
    view, other = moving.view, reference.view
    height, width = other.valid.shape
    samples = view.samples[::stride]
    world = view.points.reshape(-1, 3)[samples] @ moving.world_from_camera[:3, :3].T
    world += moving.world_from_camera[:3, 3]
    local = (world - reference.world_from_camera[:3, 3]) @ reference.world_from_camera[:3, :3]
    u, v = project_points(local, other.K).T
    rows = np.flatnonzero((u >= 0) & (u < width) & (v >= 0) & (v < height))
    pixel = v[rows].astype(np.int64) * width + u[rows].astype(np.int64)
    there, z = other.points.reshape(-1, 3)[pixel, 2], local[rows, 2]
    # A guess may be off by a good deal: only what is clearly hidden is left out.
    seen = other.valid.reshape(-1)[pixel] & (np.abs(there - z) < 0.25 * z)
    return float(seen.sum() / len(samples))
