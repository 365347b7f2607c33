"""Diagnostics of a sequence that can be read: findings for `data check`.

Every check states in its sentence what was measured and what to do. Thresholds are set so that the sequences
of the catalogue pass; a source may be right and still be reported, which is why nothing here stops a run.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Iterator
from decimal import Decimal
from fractions import Fraction
from functools import partial

import numpy as np
from jaxtyping import Float

from data_catalog.checks import depth_disagreement
from data_catalog.content import framed_picture
from data_catalog.findings import Finding, warning
from data_catalog.mask_findings import mask_findings
from data_catalog.matches import match_neighbours, pose_support
from data_catalog.plausible_intrinsics import unlikely
from data_catalog.pose_conventions import OPENCV, USUAL_MISTAKES, PoseConvention, other_readings
from extrags.cameras import Cameras, rotation_angle_deg
from extrags.frame_names import NameOrder, is_gap, usual_step
from extrags.frame_quantiles import median_of_frames
from extrags.sequence import EndoscopicSequence, saturated_mask

__all__ = ["Finding", "diagnose"]

_MIN_MATCHES = 60
_FEWEST_NUMBERED = 7
# Exact poses of the catalogue's sequences explain 87 to 95 % of the matches; shuffled ones up to 30 % as
# given, and up to 80 % in the best of 48 readings.
_CONVINCING_SUPPORT = 0.82
_CLEARLY_LESS = 0.5
_POOR_SUPPORT = 0.4
# Of the logarithm of red over green, or blue over green. Neighbours in recordings of one light differ by 0.15
# at most in the catalogue; narrow-band light divides the red of tissue by two. What is matched while a source
# is read (extrags.switched_light) jumps no longer.
_COLOR_JUMP = 0.35
_EXPOSURE_JUMP = 0.5
_EXPOSURE_DEVIATIONS = 8.0
_MIN_BASELINE_SHARE = 0.02
_Check = Callable[[EndoscopicSequence], Iterator[Finding]]
_NEAREST_MM = 0.5
"""Nothing nearer is seen sharply; what an endoscope sees is at 2 to 200 mm, which are 0.002 to 0.2 m."""
_FARTHEST_MM = 1000.0
"""Nothing farther is lit; 2 to 200 mm are 2000 to 200000 micrometres."""
_JUMP = 8.0
_CLIPPED_SHARE = 0.02
_SATURATED_SHARE = 0.6
_BLACK = 4.0
# Sources of the catalogue reach 2 %; depth of other frames, mirrored or inverse, 7 to 44 %.
_DISAGREEMENT = 0.05


def diagnose(
    sequence: EndoscopicSequence, file: str, *, thinned: bool = False, stored: PoseConvention = OPENCV
) -> list[Finding]:
    """Everything questionable about a sequence.

    Frames are looked at one after another: of long recordings they do not fit into memory together.

    Args:
        sequence: as a reader made it.
        file: the source, named in findings.
        thinned: whether frames were left out on purpose, so that gaps in their numbering tell nothing.
        stored: how the file should hold poses, for findings about them.
    """
    found: list[Finding] = []
    of_poses = (partial(_points, stored=stored), partial(_epipolar, stored=stored))
    checks: tuple[_Check, ...] = (*_CHECKS, *of_poses, _disagreement, _depth)
    for check in checks if thinned else (_missing, *checks):
        found += [finding.model_copy(update={"file": file}) for finding in check(sequence)]
    return found


def _late(names: list[str]) -> int | None:
    """The first frame whose name comes before that of the one in front of it, however its number is read."""
    order = NameOrder(names)
    found = []
    for key in (order.key, order.other_key):
        # Keys alone: of names that are alike but for a zero, either may be first.
        keys = [key(name)[0] for name in names]
        found.append(next((k for k in range(1, len(keys)) if keys[k] < keys[k - 1]), None))
    return None if None in found else found[0]


def _order(sequence: EndoscopicSequence) -> Iterator[Finding]:
    """Frames out of order."""
    for members in _recordings(sequence):
        names = [sequence.frame_name(k) for k in members]
        late = _late(names)
        if late is not None:
            yield warning(
                "order of frames",
                f"listed after {names[late - 1]}, though its name comes before; neighbours in the list are "
                "taken for neighbours in time. List the frames in the order of recording",
                frame=names[late],
                field="frame names",
            )


def _missing(sequence: EndoscopicSequence) -> Iterator[Finding]:
    """Single frames that are missing from a regular numbering."""
    for members in _recordings(sequence):
        names = [sequence.frame_name(k) for k in members]
        order = NameOrder(names)
        numbers = [order.number(name) for name in names]
        if len(names) < _FEWEST_NUMBERED or None in numbers or _late(names) is not None:
            continue
        steps, digits = _steps([number for number in numbers if number is not None])
        usual = usual_step(steps)
        # Decimals are rounded, and times of a recorder uneven; frames are counted exactly.
        gaps = [k for k, step in enumerate(steps) if (is_gap(step, usual) if digits else step != usual)]
        anew = next((k for k, step in enumerate(steps) if step < 0), None)
        if anew is not None:
            yield warning(
                "series of frames",
                f"after {names[anew]} the numbering starts over; all frames are treated as one recording by "
                "one camera, and split into training and held-out frames as such. Give each series, as of a "
                "left and a right camera, a folder of its own",
                frame=names[anew + 1],
                field="frame names",
            )
            continue
        if usual > 0 and 0 < len(gaps) <= max(1, len(steps) // 20):
            gap = gaps[0]
            yield warning(
                "missing frame",
                f"the next frame is {names[gap + 1]}, {_in_words(steps[gap], digits)} on; all others are "
                f"{_in_words(usual, digits)} apart. Frames are missing between the two",
                frame=names[gap],
                field="frame names",
            )


def _images(sequence: EndoscopicSequence) -> Iterator[Finding]:
    """Duplicates, black frames, swapped channels, overexposure."""
    seen: dict[bytes, int] = {}
    repeats: list[tuple[int, int]] = []
    means = _brightness(sequence)
    for index in np.flatnonzero(means >= _BLACK).tolist():
        digest = hashlib.blake2b(sequence.rgb[index].tobytes(), digest_size=16).digest()
        if digest in seen:
            repeats.append((index, seen[digest]))
        seen.setdefault(digest, index)
    if repeats:
        index, first = repeats[0]
        several = (
            f"; {len(repeats)} frames repeat an earlier one: remove them"
            if len(repeats) > 1
            else "; remove one"
        )
        yield warning(
            "duplicate frame",
            f"the same image as frame {sequence.frame_name(first)}, pixel by pixel{several}",
            frame=sequence.frame_name(index),
            field="rgb",
        )
    for index in np.flatnonzero(means < _BLACK)[:1]:
        yield warning(
            "black frame",
            f"mean brightness {means[index]:.1f} of 255 inside the mask; {int((means < _BLACK).sum())} of "
            f"{len(means)} frames are like that. A run leaves them out where they are few",
            frame=sequence.frame_name(int(index)),
            field="rgb",
        )
    sums, saturated, inside = np.zeros(3), 0, max(1, sum(int(mask.sum()) for mask in sequence.mask))
    for image, mask in zip(sequence.rgb, sequence.mask, strict=True):
        sums += image[mask].sum(axis=0, dtype=np.float64)
        saturated += int((saturated_mask(image) & mask).sum())
    red, _, blue = (float(value) for value in sums / inside)
    if blue > 1.15 * red and blue > 20:
        yield warning(
            "colour channels",
            f"blue ({blue:.0f}) outweighs red ({red:.0f}) on average, which tissue never shows: the channels "
            "are probably swapped (BGR for RGB)",
            field="rgb",
        )
    share = saturated / inside
    if share > _SATURATED_SHARE:
        yield warning(
            "saturation",
            f"{share:.0%} of the pixels inside the mask are saturated in some channel; their colour is lost "
            "and does not train. Record darker",
            field="rgb",
        )


def _exposure(sequence: EndoscopicSequence) -> Iterator[Finding]:
    """Sudden changes of brightness between neighbours."""
    brightness = _brightness(sequence)
    means = np.log(np.maximum(brightness, 1.0))
    shown = brightness >= _BLACK
    steps = [(k, float(means[k] - means[j])) for j, k in _neighbours(sequence) if shown[j] and shown[k]]
    if len(steps) < 4:
        return
    values = np.array([step for _, step in steps])
    spread = 1.4826 * float(np.median(np.abs(values - np.median(values))))
    limit = max(_EXPOSURE_JUMP, _EXPOSURE_DEVIATIONS * spread)
    jumps = [(k, step) for k, step in steps if abs(step) > limit]
    if jumps:
        frame, step = jumps[0]
        yield warning(
            "exposure jump",
            f"{np.exp(step):.2f} times as bright as the frame before ({len(jumps)} such jumps; neighbours "
            f"usually differ by {np.exp(np.median(np.abs(values))) - 1:.0%}). Fix exposure and gain when "
            "recording, or keep the exposure per frame switched on (coarse.light.enabled)",
            frame=sequence.frame_name(frame),
            field="rgb",
        )


def _light(sequence: EndoscopicSequence) -> Iterator[Finding]:
    """Sudden changes of colour between neighbours, as where narrow-band light is switched on."""
    shown = _brightness(sequence) >= _BLACK
    frames = zip(sequence.rgb, sequence.mask, strict=True)
    means = np.array([image[mask].mean(0) if mask.any() else np.ones(3) for image, mask in frames])
    hue = np.log(np.maximum(means[:, [0, 2]], 1.0) / np.maximum(means[:, 1:2], 1.0))
    # What is matched while a source is read are training frames: others stay as they are.
    shown &= np.isin(np.arange(len(sequence)), sequence.train)
    steps = [(k, hue[k] - hue[j]) for j, k in _neighbours(sequence) if shown[j] and shown[k]]
    if len(steps) < 4:
        return
    sizes = np.array([np.abs(step).max() for _, step in steps])
    limit = max(_COLOR_JUMP, _EXPOSURE_DEVIATIONS * float(np.median(sizes)))
    jumps = [step for step, size in zip(steps, sizes, strict=True) if size > limit]
    if jumps:
        frame, step = jumps[0]
        red, blue = np.exp(step)
        yield warning(
            "colour jump",
            f"against green, red is {red:.2f} and blue {blue:.2f} times as bright as in the frame before "
            f"({len(jumps)} such jumps; neighbours usually differ by {np.expm1(np.median(sizes)):.0%}), as "
            "where the light is switched, to narrow bands for instance, and too few features tell how the "
            "colours of both belong together: a scene has one colour of each surface. Give frames of one "
            "light alone",
            frame=sequence.frame_name(frame),
            field="rgb",
        )


def _intrinsics(sequence: EndoscopicSequence) -> Iterator[Finding]:
    """Intrinsics that are possible but unlikely for images of this size."""
    if sequence.intrinsics == "guessed":
        # Of a video's pixels that are told to be wider than high, for instance: not K's own claim.
        return
    picture = framed_picture(sequence.mask, sequence.rgb)
    for index in range(len(sequence)):
        problem = unlikely(sequence.K[index], sequence.width, sequence.height, picture)
        if problem is not None:
            yield warning("intrinsics", problem, frame=sequence.frame_name(index), field="K")
            return


def _count(sequence: EndoscopicSequence) -> Iterator[Finding]:
    """Too few frames to train on, or to place where no poses are given."""
    from extrags.poses.registration_report import MIN_TRAINING_FRAMES

    train, test = len(sequence.train), len(sequence.test)
    if sequence.world_from_camera is not None and train == 1:
        yield warning(
            "number of frames",
            f"1 of {train + test} frames is to train on, and the others are held out (ingest.holdout_every, "
            "or the source's own split). One view tells nothing of what is beside it, and without a second "
            "nothing can be triangulated: give more frames",
            field="split",
        )
    if sequence.world_from_camera is None and train < MIN_TRAINING_FRAMES:
        yield Finding(
            kind="error",
            topic="number of frames",
            sentence=f"{train} of {train + test} frames are to train on (ingest.holdout_every holds out the "
            f"others); poses cannot be estimated from fewer than {MIN_TRAINING_FRAMES}: give more frames",
        )


def _poses(sequence: EndoscopicSequence) -> Iterator[Finding]:
    """Cameras that stand still, repeat or jump."""
    if sequence.world_from_camera is None:
        return
    cameras = sequence.cameras
    train = sequence.train
    reach = float(np.linalg.norm(np.ptp(cameras.centers[train], axis=0)))
    turn = float(
        rotation_angle_deg(
            cameras.world_from_camera[train, :3, :3],
            cameras.world_from_camera[np.repeat(train[:1], len(train)), :3, :3],
        ).max()
    )
    distance = _scene_distance(sequence)
    if len(train) == 1:
        # One camera reaches over nothing, which says nothing of the poses; `_count` tells.
        return
    if reach == 0 and turn < 1e-6:
        yield warning(
            "parallax",
            "all training frames have the same pose: the camera stands still, or the poses are placeholders. "
            "Nothing can be triangulated; depth alone carries the shape",
            field="world_from_camera",
        )
        return
    if distance is not None:
        known = sequence.depth_mm is not None
        yield from _parallax(
            reach, distance, *(["or look whether poses and depth have the same unit"] if known else [])
        )
    for members in _recordings(sequence):
        yield from _pose_steps(sequence, members)


def _unit(sequence: EndoscopicSequence) -> Iterator[Finding]:
    """Lengths that are called millimetres and are not, which nothing else contradicts."""
    distance = _scene_distance(sequence)
    if not sequence.metric or distance is None:
        return
    if distance < _NEAREST_MM:
        yield warning(
            "unit",
            f"lengths are taken for millimetres, and what cameras see is {distance:.3g} mm away (median), "
            "nearer than endoscopes see: are they metres? Multiply depth and positions of cameras by 1000, "
            "or state an arbitrary unit and give its millimetres (--scale 1000)",
            field="length_unit",
        )
    elif distance > _FARTHEST_MM:
        yield warning(
            "unit",
            f"lengths are taken for millimetres, and what cameras see is {distance:.4g} mm away (median), "
            "farther than endoscopes light: are they micrometres? Divide depth and positions of cameras by "
            "1000, or state an arbitrary unit and give its millimetres (--scale 0.001 for micrometres)",
            field="length_unit",
        )


def _parallax(reach: float, distance: float, cure: str = "or give depth") -> Iterator[Finding]:
    if reach < _MIN_BASELINE_SHARE * distance:
        yield warning(
            "parallax",
            f"the training cameras reach over {reach:.3g}, {reach / distance:.1%} of the distance to the "
            f"scene ({distance:.3g}); expected at least {_MIN_BASELINE_SHARE:.0%}. Too little parallax to "
            f"triangulate; record more motion sideways, {cure}",
            field="world_from_camera",
        )


def _pose_steps(sequence: EndoscopicSequence, members: list[int]) -> Iterator[Finding]:
    centers = sequence.cameras.centers[members]
    rotations = sequence.cameras.world_from_camera[members, :3, :3]
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    if len(steps) < 4:
        return
    usual = float(np.median(steps))
    for k in range(len(steps)):
        same = steps[k] == 0 and np.array_equal(rotations[k], rotations[k + 1])
        if same and usual > 0 and not np.array_equal(sequence.rgb[members[k]], sequence.rgb[members[k + 1]]):
            yield warning(
                "repeated pose",
                f"the same pose as frame {sequence.frame_name(members[k])}, but another image",
                frame=sequence.frame_name(members[k + 1]),
                field="world_from_camera",
            )
            return
    # A frame off the path: there and back is far longer than straight on.
    straight = np.linalg.norm(centers[2:] - centers[:-2], axis=1)
    detour = steps[:-1] + steps[1:] - straight
    worst = int(detour.argmax())
    if usual > 0 and detour[worst] > _JUMP * max(usual, float(straight[worst])):
        yield warning(
            "pose jump",
            f"lies {steps[worst]:.3g} from the frame before and {steps[worst + 1]:.3g} from the one after, "
            f"which are {straight[worst]:.3g} apart (usual step {usual:.3g}); its pose is probably wrong",
            frame=sequence.frame_name(members[worst + 1]),
            field="world_from_camera",
        )


def _points(sequence: EndoscopicSequence, stored: PoseConvention) -> Iterator[Finding]:
    """Sparse points that no camera sees."""
    if sequence.points is None or sequence.world_from_camera is None or len(sequence.points) < 20:
        return
    poses = np.asarray(sequence.world_from_camera, dtype=np.float64)
    as_given = _seen_share(sequence, poses)
    if as_given > 0.15:
        return
    shares = [(_seen_share(sequence, read), name) for name, read in other_readings(poses, stored)]
    # Many readings show all points to some camera: the mistakes that people make come first.
    convincing = 3 * as_given + 0.1
    usual = [found for found in shares[:USUAL_MISTAKES] if found[0] > convincing]
    best, best_name = max(usual or shares)
    hint = f", but {best:.0%} when the poses are read as {best_name}" if best > convincing else ""
    yield Finding(
        kind="error",
        topic="sparse points",
        sentence=f"on average a camera sees {as_given:.0%} of the sparse points in front of it and inside "
        f"its image{hint}. Points and poses are of different worlds, or the axes are wrong",
        field="points",
    )


def _seen_share(sequence: EndoscopicSequence, poses: Float[np.ndarray, "f 4 4"]) -> float:
    """Mean share of the sparse points in front of a camera and inside its image."""
    if sequence.points is None:
        return 0.0
    shares = []
    cameras = Cameras(sequence.K, poses, sequence.width, sequence.height, sequence.lens)
    for index in range(len(cameras)):
        pixels, _ = cameras[index].project(sequence.points)
        shares.append(float(cameras.contains(pixels).mean()))
    return float(np.mean(shares))


def _epipolar(sequence: EndoscopicSequence, stored: PoseConvention) -> Iterator[Finding]:
    """Poses that features contradict.

    Depth contradicts other axes and units, and does not tell poses of other frames from those of a scope that
    moves little.
    """
    if sequence.world_from_camera is None:
        return
    support = pose_support(sequence, match_neighbours(sequence), stored)
    if support.matches < _MIN_MATCHES:
        return
    if support.best > _CONVINCING_SUPPORT and support.as_given < _CLEARLY_LESS * support.best:
        yield Finding(
            kind="error",
            topic="pose direction" if "inverted" in support.best_name else "axes",
            sentence=f"the poses explain {support.as_given:.0%} of {support.matches} feature matches between "
            f"neighbouring frames, but {support.best:.0%} when they are read as {support.best_name}. "
            f"Expected {stored.expected}",
            field="world_from_camera",
        )
    elif support.as_given < _POOR_SUPPORT:
        yield warning(
            "poses",
            f"the poses explain {support.as_given:.0%} of {support.matches} feature matches between "
            f"neighbouring frames, and no other reading of the axes does convincingly ({support.best:.0%} at "
            "best): poses or K are wrong, or frames and poses are not in the same order",
            field="world_from_camera",
        )
    elif sequence.points is None and sequence.depth_mm is None and support.distance > 0:
        reach = float(np.linalg.norm(np.ptp(sequence.cameras.centers[sequence.train], axis=0)))
        yield from _parallax(reach, support.distance)


def _disagreement(sequence: EndoscopicSequence) -> Iterator[Finding]:
    """Depth that poses carry elsewhere than the next frame has it, though no axes and no unit explain it."""
    error = depth_disagreement(sequence)
    if error is not None and error > _DISAGREEMENT:
        yield warning(
            "depth and poses",
            f"depth that the poses carry from frame to frame is off by {error:.0%} (median), and neither "
            "other axes nor another unit explain it; usual are 2% at most. Frames, poses and depth maps may "
            "not be in the same order; depth may be inverse, of other pixels, or no z-depth; or poses or "
            "depth are inexact",
            field="depth_mm",
        )


def _depth(sequence: EndoscopicSequence) -> Iterator[Finding]:
    """Clip values that were not marked as unknown, and maps that hardly know anything."""
    if sequence.depth_mm is None:
        return
    depths = sequence.depth_mm
    largest = max(depth.max() for depth in depths)
    known = sum(int((depth > 0).sum()) for depth in depths)
    share = sum(int((depth == largest).sum()) for depth in depths) / max(1, known)
    first = next((index for index, depth in enumerate(depths) if depth.any()), 0)
    steps = np.unique(depths[first])
    if share > _CLIPPED_SHARE and len(steps) > 32:
        yield warning(
            "depth clipped",
            f"{share:.1%} of the known depths are exactly {largest:.6g}, the largest value: a clip value "
            "that is not marked as unknown. Write 0 there",
            field="depth_mm",
        )
    elif len(steps) <= 32:
        yield warning(
            "depth resolution",
            f"the frame has {len(steps)} different depths; expected a continuous map. Was it stored in "
            "8 bits or as a picture?",
            frame=sequence.frame_name(first),
            field="depth_mm",
        )
    shares = np.array(
        [
            ((depth > 0) & mask).sum() / max(1, mask.sum())
            for depth, mask in zip(depths, sequence.mask, strict=True)
        ]
    )
    if shares.min() < 0.1:
        index = int(shares.argmin())
        yield warning(
            "depth coverage",
            f"depth is known for {shares[index]:.1%} of the pixels inside the mask",
            frame=sequence.frame_name(index),
            field="depth_mm",
        )


_CHECKS: tuple[_Check, ...] = (
    _order,
    _images,
    _exposure,
    _light,
    mask_findings,
    _intrinsics,
    _count,
    _poses,
    _unit,
)


def _recordings(sequence: EndoscopicSequence) -> Iterator[list[int]]:
    recording = np.zeros(len(sequence), dtype=int) if sequence.recording is None else sequence.recording
    for number in np.unique(recording):
        yield np.flatnonzero(recording == number).tolist()


def _neighbours(sequence: EndoscopicSequence) -> Iterator[tuple[int, int]]:
    for members in _recordings(sequence):
        yield from itertools.pairwise(members)


def _steps(numbers: list[Decimal]) -> tuple[list[int], int]:
    """Steps between numbers in units of their last digit, and how many digits stand behind the point."""
    digits = max(-int(number.as_tuple().exponent) for number in numbers)
    # Fractions are exact, where a product of decimals has no more than 28 digits.
    units = [int(Fraction(number) * 10**digits) for number in numbers]
    return [after - before for before, after in itertools.pairwise(units)], digits


def _in_words(step: int, digits: int) -> str:
    return f"{step / 10**digits:.12g}" if digits else str(step)


def _brightness(sequence: EndoscopicSequence) -> Float[np.ndarray, "f"]:
    """Mean over the mask of the mean of the channels."""
    frames = zip(sequence.rgb, sequence.mask, strict=True)
    return np.array(
        [image[mask].sum(dtype=np.float64) / (3 * max(1, int(mask.sum()))) for image, mask in frames]
    )


def _scene_distance(sequence: EndoscopicSequence) -> float | None:
    """Median distance from cameras to what they see; None where neither depth nor points tell."""
    if sequence.depth_mm is not None:
        depths = sequence.depth_mm
        return median_of_frames(lambda: (depth[depth > 0] for depth in depths))
    if sequence.points is None or not len(sequence.points):
        return None
    _, z = sequence.cameras.project(sequence.points)
    return float(np.median(z[z > 0])) if (z > 0).any() else None
