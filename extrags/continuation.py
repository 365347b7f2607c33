"""Whether a scene of some frames can be gone on from with more: the same pictures, places and settings."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from extrags.config import CoarseConfig
from extrags.sequence import EndoscopicSequence
from extrags.store import canonical

__all__ = ["Comparison", "compared_frames", "other_settings"]

MASKED_SHARE = 0.01
"""Share of a frame's pixels that may be masked since: masks that are found from all frames shift a little."""
SAME_POSE = 1e-6
"""Largest difference between equal poses: of rotation entries, and of positions as a share of the largest."""


@dataclass(frozen=True)
class Comparison:
    """What the frames of an earlier scene are to the frames of a new one.

    Args:
        frames: the new sequence's index of each earlier frame; empty where refused.
        refusal: why the new scene cannot go on from the earlier one; empty where it can.
    """

    frames: Int[np.ndarray, "k"]
    refusal: str = ""


def compared_frames(earlier: EndoscopicSequence, sequence: EndoscopicSequence) -> Comparison:
    """Find the frames of an earlier scene among those of a new one.

    The earlier ones must be a proper subset: then no held-out frame of the new sequence has been trained on,
    and a scene is never its own start. Frames are the same where colours, poses and intrinsics are; their
    names do not count. Depth that was measured must be the same as well, so that none that is withheld now
    has been trained with; depth that was estimated from the training frames may differ. Nothing would remove
    Gaussians from pixels that have been masked since, so masks must not have grown.

    Args:
        earlier: the posed training frames of the earlier scene.
        sequence: the posed training frames of the new one.
    """
    refusal = _other_kind(earlier, sequence)
    if refusal:
        return _refused(refusal)
    if len(earlier) >= len(sequence):
        return _refused(
            f"it has {len(earlier)} training frames, not fewer than the {len(sequence)} of this run"
        )
    places = defaultdict(list)
    for index, digest in enumerate(_digests(sequence)):
        places[digest].append(index)
    found = []
    for index, digest in enumerate(_digests(earlier)):
        name = earlier.frame_name(index)
        if not places[digest]:
            return _refused(f"its frame {name} is not among the training frames of this run")
        same = [place for place in places[digest] if _same_camera(earlier, index, sequence, place)]
        if not same:
            return _refused(f"its frame {name} had another pose or other intrinsics")
        if _masked_since(earlier, index, sequence, same[0]):
            return _refused(f"pixels of its frame {name} that it was trained on are masked now")
        if not _same_depth(earlier, index, sequence, same[0]):
            return _refused(f"its frame {name} had another depth")
        found.append(same[0])
        places[digest].remove(same[0])
    return Comparison(np.asarray(found, dtype=np.int64))


def other_settings(made_with: CoarseConfig, wanted: CoarseConfig) -> str:
    """Why a scene's settings do not suit a run that would go on from it; empty where they do.

    They must be the same but for the number of iterations, of which there may have been more.
    """
    mine, theirs = canonical(wanted), canonical(made_with)
    differing = sorted(name for name in mine if name != "iterations" and mine[name] != theirs[name])
    if differing:
        return "it was made with other settings: " + ", ".join(f"coarse.{name}" for name in differing)
    if made_with.iterations < wanted.iterations:
        return f"it was made with {made_with.iterations} iterations, fewer than {wanted.iterations}"
    return ""


def _refused(why: str) -> Comparison:
    return Comparison(np.zeros(0, dtype=np.int64), why)


def _other_kind(earlier: EndoscopicSequence, sequence: EndoscopicSequence) -> str:
    if (earlier.width, earlier.height) != (sequence.width, sequence.height):
        return (
            f"its frames are {earlier.width} x {earlier.height} pixels, not "
            f"{sequence.width} x {sequence.height}"
        )
    if earlier.metric != sequence.metric or earlier.lens != sequence.lens:
        return "its frames have another unit of length or another lens"
    kinds = [
        "no" if not one.training_depth_known else "measured" if one.depth_error is None else "estimated"
        for one in (earlier, sequence)
    ]
    if kinds[0] != kinds[1]:
        return f"its frames had {kinds[0]} depth, those of this run have {kinds[1]} depth"
    return ""


def _digests(sequence: EndoscopicSequence) -> list[bytes]:
    return [
        hashlib.blake2b(np.ascontiguousarray(image).tobytes(), digest_size=16).digest()
        for image in sequence.rgb
    ]


def _same_camera(earlier: EndoscopicSequence, one: int, sequence: EndoscopicSequence, other: int) -> bool:
    mine, theirs = sequence.cameras.world_from_camera[other], earlier.cameras.world_from_camera[one]
    length = float(np.abs(sequence.cameras.centers).max(initial=0.0))
    return (
        bool(np.abs(mine[:3, :3] - theirs[:3, :3]).max() <= SAME_POSE)
        and bool(np.abs(mine[:3, 3] - theirs[:3, 3]).max() <= SAME_POSE * length)
        and bool(np.allclose(sequence.K[other], earlier.K[one], rtol=SAME_POSE, atol=0))
    )


def _masked_since(earlier: EndoscopicSequence, one: int, sequence: EndoscopicSequence, other: int) -> bool:
    """Whether pixels that supervised the earlier scene do not supervise the new one."""
    lost = earlier.supervised_mask(one) & ~sequence.supervised_mask(other)
    return float(lost.mean()) > MASKED_SHARE


def _same_depth(earlier: EndoscopicSequence, one: int, sequence: EndoscopicSequence, other: int) -> bool:
    if earlier.depth_mm is None or sequence.depth_mm is None or earlier.depth_error is not None:
        return True
    return bool(np.array_equal(earlier.depth_mm[one], sequence.depth_mm[other]))
