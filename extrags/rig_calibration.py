"""What all frames have in common and is off: depth, the lens, the time and place of what is tracked.

Each is a few numbers, and depth that poses carry from frame to frame tells them, since they bend it alike
everywhere. Poses of single frames that are off, and depth that is off in each frame in another way, do not:
there no such numbers make the disagreement much smaller, and nothing is corrected.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from extrags.cameras import unproject_pixels
from extrags.carried_depth import (
    LEAST_POINTS,
    MEDIAN,
    CarriedDepth,
    Correction,
    Pair,
    evenly,
    relative_error,
)
from extrags.errors import SourceError
from extrags.sequence import EndoscopicSequence

__all__ = ["with_calibration_corrected"]

_log = logging.getLogger(__name__)

_TOPIC = {"topic": "depth and poses", "field": "depth_mm"}

LEAST_ERROR = 0.0015
"""Of depth, below which nothing is looked for: exact depth has 0.0003."""

CLEARLY_LESS = 0.25
"""Share of the disagreement that is left, at most, of what is corrected."""

PLAUSIBLE = 4.0
"""Corrections that are so many times the scale of one of their numbers, or more, explain something else."""

SIMPLER = 0.8
"""A correction of more numbers has to leave so much less than one of fewer."""

FITTED_PAIRS = 60
"""Pairs at most that a correction is fitted to."""

TRIED_PAIRS = 12
"""Pairs that a correction is tried on first."""

HOPEFUL = 1.5
"""So many times as much as is left of what is corrected may be left of these."""

EVERY = 5
"""One in so many points of a frame is used."""

CORRECTIONS = 3
"""At most, one after the other."""

ROUNDS = 10
"""Of reweighted least squares."""

LAST_ROUNDS = 3
"""Of these on all pairs, from where the tried ones arrived."""

PATIENCE = 3
"""Steps after which a correction is given up that still leaves `HOPELESS`."""

HOPELESS = 0.75
"""Share of the disagreement."""

HALVINGS = 5
"""Of a step, at most, after which the lens would fold back inside the image."""

STEP = 1e-3
"""Of the derivatives, in the scale of each number."""

HELD = 1e-3
"""Weight of no correction, beside that of all points: what nothing tells stays."""


@dataclass(frozen=True)
class _Family:
    """Corrections of one kind.

    Args:
        words: what is corrected, for the warning.
        scale: of each number, which is about the error that it can have.
        made: the correction of its numbers.
        told: numbers of a correction, in words.
        starts: of the first number, in its scale; the search begins where the least is left.
    """

    words: str
    scale: tuple[float, ...]
    made: Callable[[Float[np.ndarray, "k"]], Correction]
    told: Callable[[Correction], str]
    starts: tuple[float, ...] = (0.0,)

    def of(self, numbers: Float[np.ndarray, "k"]) -> Correction:
        """The correction of numbers that are given in their scales."""
        return self.made(np.array(self.scale) * numbers)


def _families(length: float) -> tuple[_Family, ...]:
    """Those there are, from few numbers to more; lengths are in median depths."""
    return (
        _Family(
            "poses are of other moments than the frames",
            (0.6,),
            lambda x: Correction(time=float(x[0])),
            lambda c: "each frame gets the pose of {:.2f} frames {} it".format(
                abs(c.time), "after" if c.time > 0 else "before"
            ),
            starts=(0.0, -1 / 0.6, 1 / 0.6, -2 / 0.6, 2 / 0.6),
        ),
        _Family(
            "depth is not in the unit of the poses, or has an offset",
            (0.1, 0.1 * length),
            lambda x: Correction(log_factor=float(x[0]), offset=float(x[1])),
            lambda c: f"depth is multiplied by {np.exp(c.log_factor):.3f}, and {c.offset:+.3g} is added",
        ),
        _Family(
            "focal length or principal point are off",
            (0.05, 0.05, 0.02, 0.02),
            lambda x: Correction(log_focal=_two(x[:2]), shift=_two(x[2:])),
            lambda c: (
                "focal lengths are multiplied by {:.3f} and {:.3f}, ".format(*np.exp(c.log_focal))
                + "the principal point is moved by ({:+.2f}, {:+.2f}) % of the width".format(
                    *(100 * part for part in c.shift)
                )
            ),
        ),
        _Family(
            "the lens is not the pinhole it is said to be",
            (0.05, 0.05, 0.02, 0.02, 0.15),
            lambda x: Correction(log_focal=_two(x[:2]), shift=_two(x[2:4]), distortion=float(x[4])),
            lambda c: (
                f"it distorts radially (division model, k = {c.distortion:+.3f}), "
                + "focal lengths are multiplied by {:.3f} and {:.3f}, ".format(*np.exp(c.log_focal))
                + "the principal point is moved by ({:+.2f}, {:+.2f}) % of the width".format(
                    *(100 * part for part in c.shift)
                )
            ),
        ),
        _Family(
            "the camera stands and looks otherwise on what is tracked (hand-eye calibration)",
            (*(0.03,) * 3, *(0.1 * length,) * 3),
            lambda x: Correction(turn=_three(x[:3]), move=_three(x[3:])),
            lambda c: (
                f"each camera is turned by {np.degrees(np.linalg.norm(c.turn)):.2f} degrees and moved by "
                f"{np.linalg.norm(c.move):.3g}"
            ),
        ),
        _Family(
            "both unit or offset of depth and the hand-eye calibration are off",
            (0.1, 0.1 * length, *(0.03,) * 3, *(0.1 * length,) * 3),
            lambda x: Correction(float(x[0]), float(x[1]), turn=_three(x[2:5]), move=_three(x[5:])),
            lambda c: (
                f"depth is multiplied by {np.exp(c.log_factor):.3f}, {c.offset:+.3g} is added, and each "
                f"camera is turned by {np.degrees(np.linalg.norm(c.turn)):.2f} degrees and moved by "
                f"{np.linalg.norm(c.move):.3g}"
            ),
        ),
    )


def with_calibration_corrected(
    sequence: EndoscopicSequence, carried: CarriedDepth | None, *, lens: bool = True
) -> EndoscopicSequence:
    """The sequence with what its frames have in common corrected, where their depth tells it clearly.

    Depth along the ray becomes z-depth. Of a delay between frames and poses, of depth's unit and offset, of
    focal lengths and principal point, of these with a radial distortion, and of a turn and shift of the
    camera on what is tracked, the one is corrected that leaves least of the disagreement, if that is a
    quarter of it at most, or unit, offset, turn and shift together; of all frames, held-out ones too. What is
    left then may be explained by another. A warning says what, and by how much. The sequence is returned as
    it is where nothing is off, or nothing of this explains it.

    Args:
        sequence: in any unit.
        carried: its depth; None where frames tell nothing of each other's.
        lens: whether the lens may be what is off.
    """
    for _ in range(CORRECTIONS):
        if carried is None:
            break
        corrected = _corrected_once(sequence, carried, lens)
        if corrected is sequence:
            break
        sequence, carried = corrected, CarriedDepth.of(corrected)
    return sequence


def _corrected_once(sequence: EndoscopicSequence, carried: CarriedDepth, lens: bool) -> EndoscopicSequence:
    pairs = [carried.pairs[k] for k in evenly(len(carried.pairs), FITTED_PAIRS).tolist()]
    error = relative_error([carried.ratio(pair) for pair in pairs])
    if error < LEAST_ERROR:
        return sequence
    along_ray = relative_error(carried.log_ratios(pairs, along_ray=True))
    if along_ray < CLEARLY_LESS * error:
        _warn(sequence, error, along_ray, "depth is the distance along the ray", "it is converted to z-depth")
        return sequence.with_changed_depth(lambda frame, depth: depth / _ray_lengths(sequence, frame))
    some = [pairs[k] for k in evenly(len(pairs), TRIED_PAIRS).tolist()]
    hopeful = HOPEFUL * CLEARLY_LESS * relative_error([carried.ratio(pair) for pair in some])
    best, left, family = Correction(), CLEARLY_LESS * error, None
    families = _families(float(np.median(carried.typical[carried.typical > 0])))
    # Points of the source were found with its poses and lens, and do not follow another.
    rig = sequence.points is None
    may_change = (rig, True, lens and rig, lens and rig and sequence.lens is None, rig, rig)
    for candidate in (family for family, may in zip(families, may_change, strict=True) if may):
        numbers = _fitted(carried, some, candidate, _start(carried, some, candidate), ROUNDS)
        if numbers is None or _left(carried, some, candidate, numbers) > hopeful:
            continue
        numbers = _fitted(carried, pairs, candidate, numbers, LAST_ROUNDS)
        if numbers is None:
            continue
        remains = _left(carried, pairs, candidate, numbers)
        if remains < (left if family is None else SIMPLER * left):
            best, left, family = candidate.of(numbers), remains, candidate
    if family is None:
        return sequence
    try:
        K, radial = best.of_lens(sequence.K, sequence.lens, sequence.width, sequence.height)
    except SourceError:
        # At a fold in the corner of the image, which the smaller maps that were carried have cut off.
        return sequence
    _warn(sequence, error, left, family.words, family.told(best))
    return replace(
        sequence.with_changed_depth(lambda _, depth: best.of_depth(depth)),
        K=K,
        lens=radial,
        world_from_camera=best.of_poses(sequence.cameras.world_from_camera, sequence.recording),
    )


def _left(
    carried: CarriedDepth, pairs: list[Pair], family: _Family, numbers: Float[np.ndarray, "k"]
) -> float:
    """Disagreement that a correction leaves."""
    return relative_error(carried.log_ratios(pairs, correction=family.of(numbers)))


def _start(carried: CarriedDepth, pairs: list[Pair], family: _Family) -> Float[np.ndarray, "k"]:
    """Numbers that a search begins with."""
    starts = np.zeros((len(family.starts), len(family.scale)))
    starts[:, 0] = family.starts
    if len(starts) == 1:
        return np.asarray(starts[0])
    return np.asarray(min(starts, key=lambda numbers: _left(carried, pairs, family, numbers)))


def _fitted(
    carried: CarriedDepth,
    pairs: list[Pair],
    family: _Family,
    numbers: Float[np.ndarray, "k"],
    rounds: int,
) -> Float[np.ndarray, "k"] | None:
    """The correction of a family that leaves the least disagreement, in the scales of its numbers.

    Gauss-Newton with the weights of a Cauchy distribution; the derivatives by differences, so that they hold
    for any lens.

    Args:
        carried: depth of the training frames.
        pairs: those that are looked at.
        family: what may be corrected.
        numbers: where to start.
        rounds: steps at most.

    Returns:
        None where the correction would be implausibly large, or too few points meet depth with it, or where
        the first steps hardly bring anything.
    """

    def ratios(numbers: Float[np.ndarray, "k"]) -> Float[np.ndarray, "p"] | None:
        """None where the lens would fold back inside the image."""
        try:
            parts = carried.log_ratios(pairs, correction=family.of(numbers), every=EVERY)
        except SourceError:
            return None
        return np.concatenate(parts)

    ratio = ratios(numbers)
    given = relative_error([carried.ratio(pair) for pair in pairs])
    for done in range(rounds):
        moved = [ratios(numbers + STEP * axis) for axis in np.eye(len(numbers))]
        if ratio is None or any(part is None for part in moved):
            return None
        if done == PATIENCE and relative_error([ratio]) > HOPELESS * given:
            return None
        J = np.stack([(part - ratio) / STEP for part in moved if part is not None], axis=1)
        known = np.isfinite(ratio) & np.isfinite(J).all(1)
        if known.sum() < LEAST_POINTS:
            return None
        spread = max(relative_error([ratio]) * np.sqrt(2), 1e-6)
        weighted = J[known] / (1 + (ratio[known, None] / (2 * spread)) ** 2)
        # Not by BLAS, whose sums depend on the number of threads.
        A = np.einsum("pk,pl->kl", weighted, J[known])
        # Where cameras do not turn, a shift of all of them changes nothing; no pair tells it then.
        A += HELD * np.trace(A) / len(A) * np.eye(len(A))
        step = np.linalg.solve(A, -np.einsum("pk,p->k", weighted, ratio[known]))
        step /= max(1.0, float(np.abs(step).max()))
        for _ in range(HALVINGS):
            ratio = ratios(numbers + step)
            if ratio is not None:
                break
            step /= 2
        if ratio is None:
            return None
        numbers = numbers + step
        if np.abs(numbers).max() >= PLAUSIBLE:
            return None
        if np.abs(step).max() < STEP:
            break
    return numbers


def _warn(sequence: EndoscopicSequence, error: float, left: float, found: str, done: str) -> None:
    _log.warning(
        "%s: depth that the poses carry from frame to frame is off by %.1f %% (median), but by %.1f %% if "
        "%s: %s (ingest.correct_calibration=false leaves it)",
        sequence.name,
        100 * MEDIAN * error,
        100 * MEDIAN * left,
        found,
        done,
        extra=_TOPIC,
    )


def _ray_lengths(sequence: EndoscopicSequence, frame: int) -> Float[np.ndarray, "h w"]:
    """Distance along each pixel's ray where z-depth is 1."""
    v, u = np.mgrid[: sequence.height, : sequence.width]
    centers = np.stack([u.ravel(), v.ravel()], axis=1) + 0.5
    rays = unproject_pixels(centers, sequence.K[frame], sequence.lens)
    return np.asarray(np.linalg.norm(rays, axis=1).reshape(sequence.height, sequence.width))


def _two(numbers: Float[np.ndarray, "2"]) -> tuple[float, float]:
    return float(numbers[0]), float(numbers[1])


def _three(numbers: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    return float(numbers[0]), float(numbers[1]), float(numbers[2])
