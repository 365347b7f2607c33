"""Training examples of the completion: stereo on procedural clips, exactly as it runs on a user's frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.depth.completion import POINTS, CompletionInputs, CompletionNetwork, completion_inputs
from extrags.depth.frames import PosedFrames
from extrags.depth.pretraining.cavities import Cavities, Kind
from extrags.depth.pretraining.photographs import Clips, photograph
from extrags.depth.pretraining.points import triangulated_points
from extrags.depth.stereo import SECOND_SWEEP, StereoDepth, StereoSettings, multi_view_stereo, sweep_around
from extrags.source_frames import select_sources

__all__ = ["SIZES", "Examples", "make_examples"]

SIZES: tuple[tuple[int, int], ...] = ((128, 160), (144, 144), (112, 176))
"""Heights and widths in pixels."""
VIEWS = 7
SOURCES = 6

NETWORK_CHUNK = 56

SINGLE_SHARE = 0.12
"""Of the clips, those whose frames are matched with nothing: single images."""
UNMATCHED_SHARE = 0.05
"""Of the other clips' frames, those that nothing matches."""
WRONG_SHARE, BADLY_WRONG_SHARE = 0.5, 0.1
"""Of the clips, those whose poses are wrong, and those where they are wrong by up to four times as much."""


@dataclass(frozen=True)
class Examples:
    """Inputs and truth of frames of one size.

    Args:
        channels: from `completion_inputs`, half precision, [F, 19, H, W].
        truth: true log-depth relative to the inputs' scale, half precision, [F, H, W].
        known: where the truth is known, [F, H, W].
    """

    channels: Float[Tensor, "f 19 h w"]
    truth: Float[Tensor, "f h w"]
    known: Float[Tensor, "f h w"]


def make_examples(
    kind: Kind,
    scenes: int,
    generator: torch.Generator,
    size: tuple[int, int],
    settings: StereoSettings | None = None,
    network: CompletionNetwork | None = None,
) -> Examples | None:
    """Clips of one kind of scene with their stereo; None if no clip is usable.

    In half of the clips poses are slightly wrong, in a quarter the focal length is; frames have one to six
    sources, those of `SINGLE_SHARE` of the clips none; the searched range of depths is wider than the true
    one by random factors.

    Args:
        kind: of scene.
        scenes: number of clips to try.
        generator: source of randomness; its device is used.
        size: height and width in pixels.
        settings: of stereo.
        network: whose completion the second sweep runs around, as `estimate_depth` does; then there are
            two examples of each frame, those of the first sweep before those of the second. None makes the
            first alone.
    """
    scene = Cavities(kind, scenes, generator)
    clips = photograph(scene, generator, size, VIEWS)
    n = len(clips.depth)
    if n == 0:
        return None
    ordered = torch.where(clips.depth > 0, clips.depth, float("nan")).flatten(1)
    low, middle, high = (ordered.nanquantile(q, dim=1) for q in (0.01, 0.5, 0.99))
    near, far = low / scene.uniform(1.1, 2.0, n), high * scene.uniform(1.1, 2.0, n)
    frames = _miscalibrated(clips, scene)
    allowed = _allowed_sources(scene, n, clips.views)
    sources = _sources(clips, middle, allowed)
    stereo = multi_view_stereo(frames, sources, near, far, settings, recording=clips.clip, chunk=n)
    points = triangulated_points(clips, scene)
    inputs = completion_inputs(frames, stereo, points)
    parts = [_examples(inputs, stereo, clips)]
    if network is not None:
        log_depth = _completed(network, inputs)
        inside = torch.where(frames.mask, log_depth, float("nan")).flatten(1)
        sources = _sources(clips, inside.nanmedian(dim=1).values.exp(), allowed)
        stereo = sweep_around(frames, sources, stereo, log_depth, **SECOND_SWEEP, settings=settings, chunk=n)
        parts.append(_examples(completion_inputs(frames, stereo, points), stereo, clips))
    return Examples(
        *(torch.cat([getattr(part, f) for part in parts]) for f in ("channels", "truth", "known"))
    )


def _examples(inputs: CompletionInputs, stereo: StereoDepth, clips: Clips) -> Examples:
    known = clips.frames.mask & (clips.depth > 0)
    truth = torch.log(clips.depth.clamp_min(1e-6)) - inputs.log_scale[:, None, None]
    # Nothing tells the scale of a single image: its depths are learned up to their own median.
    scatter = torch.tensor([fit.scatter for fit in stereo.fits], device=truth.device)[stereo.recording]
    blind = (stereo.n_sources == 0) & ~torch.isfinite(scatter)
    own = torch.where(known, truth, float("nan")).flatten(1).nanmedian(dim=1).values.nan_to_num()
    truth = truth - torch.where(blind, own, 0.0)[:, None, None]
    truth = torch.where(known, truth, 0.0).clamp(-4, 4)
    return Examples(inputs.channels.half(), truth.half(), known.half())


@torch.no_grad()
def _completed(network: CompletionNetwork, inputs: CompletionInputs) -> Tensor:
    # Points are left out, as `estimate_depth` does.
    channels = inputs.channels.clone()
    channels[:, POINTS] = 0
    found = [network(part)[0] for part in channels.split(NETWORK_CHUNK)]
    return torch.cat(found) + inputs.log_scale[:, None, None]


def _allowed_sources(scene: Cavities, n: int, views: int) -> Tensor:
    """How many sources each frame may have."""
    clips = n // views
    allowed = 1 + (scene.uniform(0.0, 1.0, clips) * SOURCES).long().clamp_max(SOURCES - 1)
    allowed[scene.uniform(0.0, 1.0, clips) < SINGLE_SHARE] = 0
    allowed = allowed.repeat_interleave(views)
    allowed[scene.uniform(0.0, 1.0, n) < UNMATCHED_SHARE] = 0
    return allowed


def _sources(clips: Clips, typical_depth: Tensor, allowed: Tensor) -> Tensor:
    """Sources of each frame within its clip, at most as many as are allowed."""
    n, v = len(clips.depth), clips.views
    poses, K = clips.frames.world_from_camera.cpu().numpy(), clips.frames.K.cpu().numpy()
    typical = typical_depth.cpu().numpy().astype(np.float64)
    chosen = np.full((n, SOURCES), -1, dtype=np.int64)
    for first in range(0, n, v):
        part = slice(first, first + v)
        found = select_sources(
            poses[part].astype(np.float64),
            K[part].astype(np.float64),
            clips.frames.size,
            typical[part],
            SOURCES,
        )
        chosen[part] = np.where(found >= 0, found + first, -1)
    sources = torch.from_numpy(chosen).to(clips.depth.device)
    ranks = torch.arange(SOURCES, device=sources.device)[None]
    return torch.where(ranks < allowed[:, None], sources, -1)


def _miscalibrated(clips: Clips, scene: Cavities) -> PosedFrames:
    """The frames with slightly wrong poses and focal lengths, as an estimate of them would be."""
    frames, v = clips.frames, clips.views
    n = len(clips.depth)
    device = clips.depth.device
    per_clip = n // v
    wrong_poses = scene.uniform(0.0, 1.0, per_clip) < WRONG_SHARE
    amount = wrong_poses.float() * scene.uniform(0.0, 1.0, per_clip)
    badly = scene.uniform(0.0, 1.0, per_clip) < BADLY_WRONG_SHARE
    amount = torch.where(badly, scene.uniform(1.0, 4.0, per_clip), amount)
    amount = amount.repeat_interleave(v)[:, None]
    turn = amount * math.radians(0.2) * scene.uniform(-1.0, 1.0, n, 3)
    centers = frames.world_from_camera[:, :3, 3]
    pace = (centers.roll(-1, 0) - centers).norm(dim=1)
    pace = pace.unflatten(0, (per_clip, v))[:, :-1].mean(1).repeat_interleave(v)[:, None]
    shift = amount * 0.04 * pace * scene.uniform(-1.0, 1.0, n, 3)
    wrong = torch.eye(4, device=device).repeat(n, 1, 1)
    a, b, c = turn.unbind(1)
    zero = torch.zeros_like(a)
    wrong[:, :3, :3] = torch.linalg.matrix_exp(
        torch.stack([zero, -c, b, c, zero, -a, -b, a, zero], dim=1).unflatten(1, (3, 3))
    )
    poses = frames.world_from_camera @ wrong
    poses[:, :3, 3] += shift
    focal = 1 + (scene.uniform(0.0, 1.0, per_clip) < 0.25).float() * scene.uniform(-0.03, 0.03, per_clip)
    K = frames.K.clone()
    K[:, [0, 1], [0, 1]] *= focal.repeat_interleave(v)[:, None]
    return replace(frames, world_from_camera=poses, K=K)
