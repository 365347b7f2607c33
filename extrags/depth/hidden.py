"""Depth of what a restored view has invented, read from its image.

A restorer paints what was never seen, and its painting says how far that is: it gets darker with distance,
and folds have shades. The network that completes stereo reads images for that very purpose. It is given what
the scene shows as depth that all sources confirm, and what it does not show as depth that none confirms, and
has practised this on explored views of procedural scenes (`extrags.restoration.hidden_depth`).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from extrags.depth.completion import CompletionInputs, CompletionNetwork, completion_inputs
from extrags.depth.frames import PosedFrames
from extrags.depth.shading import fit_shading, smoothed_brightness
from extrags.depth.stereo import NEARLY_SATURATED, StereoDepth
from extrags.threads import in_threads, one_torch_thread
from extrags.thresholds import HOLE_ALPHA
from extrags.view_synthesis.filling import push_pull

__all__ = [
    "LONGEST_SIDES_PX",
    "SOLID",
    "depth_from_image",
    "met_where_known",
    "read_depth",
    "reading_inputs",
    "reading_size",
    "shrunk",
    "shrunk_intrinsics",
]

SOLID = 0.8
"""Opacity from which a rendered depth counts as confirmed, and the guess is left as it is. From there down to
`HOLE_ALPHA` the share of what is read rises to all."""
LONGEST_SIDES_PX = (160, 80)
"""Sizes that depth is read at, whose mean is taken: the smaller serves large holes, the larger small ones."""
SOURCES = 6
"""Of every view, as stereo usually has them; they count as all or none of them confirming a pixel."""
CONFIRMED_COST, CONFIRMED_MARGIN, CONFIRMED_DIFFERENCE = 0.25, 0.1, 0.02
UNCONFIRMED_COST, UNCONFIRMED_DIFFERENCE = 1.0, 0.3
"""What stereo usually reports of a pixel that all sources confirm, and of one that none does."""


@one_torch_thread()
@torch.no_grad()
def depth_from_image(
    network: CompletionNetwork,
    rgb: Float[Tensor, "t 3 h w"],
    depth_mm: Float[Tensor, "t h w"],
    guess_mm: Float[Tensor, "t h w"],
    opacity: Float[Tensor, "t h w"],
    K: Float[Tensor, "t 3 3"],
    *,
    half_precision: bool = False,
) -> Float[Tensor, "t h w"]:
    """Z-depth without gaps: the guess where the scene is solid, in holes what the image says.

    Args:
        network: reads depth.
        rgb: restored views of one scene under one light, in [0, 1].
        depth_mm: rendered z-depth, smoothly continued into holes.
        guess_mm: a guess of the whole by other means.
        opacity: of the rendering.
        K: pinhole intrinsics in pixels.
        half_precision: convolutions in bfloat16.

    Returns:
        In the units of `depth_mm`.
    """
    read = read_depth(network, rgb, depth_mm, opacity, K, half_precision=half_precision).log()
    guess = guess_mm.clamp_min(1e-9).log()
    hidden = ((SOLID - opacity) / (SOLID - HOLE_ALPHA)).clamp(0, 1)
    return (guess + hidden * (read - guess)).exp()


@one_torch_thread()
@torch.no_grad()
def read_depth(
    network: CompletionNetwork,
    rgb: Float[Tensor, "t 3 h w"],
    depth_mm: Float[Tensor, "t h w"],
    opacity: Float[Tensor, "t h w"],
    K: Float[Tensor, "t 3 3"],
    *,
    half_precision: bool = False,
) -> Float[Tensor, "t h w"]:
    """Z-depth as the image and the rendered depth around holes say, in the units of `depth_mm`.

    What is read meets the rendered depth at the border of a hole: what it is off there is carried inside.

    Args:
        network: reads depth.
        rgb: restored views of one scene under one light, in [0, 1].
        depth_mm: rendered z-depth, smoothly continued into holes.
        opacity: of the rendering.
        K: pinhole intrinsics in pixels.
        half_precision: convolutions in bfloat16; depth then differs by less than half a percent.
    """
    size = opacity.shape[-2:]
    smooth = depth_mm.clamp_min(1e-9).log()
    read = torch.zeros_like(smooth)
    sizes = {reading_size(size, longest) for longest in LONGEST_SIDES_PX}
    for small in sorted(sizes):
        change = _read_change(
            network,
            shrunk(rgb, small),
            shrunk(smooth[:, None], small)[:, 0],
            shrunk(opacity[:, None], small)[:, 0] > SOLID,
            shrunk_intrinsics(K, size, small),
            half_precision=half_precision,
        )
        change = functional.interpolate(change[:, None], size, mode="bilinear", align_corners=False)
        read += change[:, 0] / len(sizes)
    return (smooth + read).exp()


def reading_size(size: Sequence[int], longest: int) -> tuple[int, int]:
    """Height and width in pixels with the longest side at most so long, in nearly the same proportion.

    Args:
        size: height and width.
        longest: the most that the longer of them may be.
    """
    height, width = (-(-longest * side // max(size)) if longest < max(size) else side for side in size)
    return height, width


def shrunk(image: Float[Tensor, "t c h w"], size: Sequence[int]) -> Float[Tensor, "t c h2 w2"]:
    """Images as means over areas, of another height and width; as they are where they have it."""
    return (
        image
        if tuple(image.shape[-2:]) == tuple(size)
        else functional.interpolate(image, list(size), mode="area")
    )


def shrunk_intrinsics(
    K: Float[Tensor, "t 3 3"], size: Sequence[int], small: tuple[int, int]
) -> Float[Tensor, "t 3 3"]:
    """Pinhole intrinsics in pixels of the same views at another size.

    Args:
        K: at the size `size`.
        size: height and width.
        small: height and width of the other.
    """
    return torch.tensor([small[1] / size[1], small[0] / size[0], 1.0])[:, None] * K


def _read_change(
    network: CompletionNetwork,
    rgb: Float[Tensor, "t 3 h w"],
    log_depth: Float[Tensor, "t h w"],
    known: Bool[Tensor, "t h w"],
    K: Float[Tensor, "t 3 3"],
    *,
    half_precision: bool,
) -> Float[Tensor, "t h w"]:
    """What is to be added to smoothly continued log-depths, at the size of the images given here."""
    frames, stereo = _as_stereo(rgb, log_depth, known, K)
    confirmed = known.to(log_depth.dtype)

    def of_view(view: Tensor) -> Tensor:
        inputs = completion_inputs(frames.of_frames(view), stereo.of_frames(view))
        # Whether it is on belongs to a thread.
        with torch.autocast("cpu", torch.bfloat16, enabled=half_precision):
            found, _ = network(inputs.channels.contiguous(memory_format=torch.channels_last))
        found = found + inputs.log_scale[:, None, None]
        change: Tensor = met_where_known(found, log_depth[view], confirmed[view]) - log_depth[view]
        return change

    return torch.cat(in_threads(of_view, torch.arange(len(rgb)).split(1)))


def met_where_known(
    found: Float[Tensor, "t h w"], log_depth: Float[Tensor, "t h w"], known: Float[Tensor, "t h w"]
) -> Float[Tensor, "t h w"]:
    """Log-depth that meets another one where that is known: what it is off there is carried inside.

    Args:
        found: what is to meet it.
        log_depth: the other one.
        known: one where that is known, zero elsewhere.
    """
    off = push_pull(((log_depth - found) * known)[:, None], known[:, None])
    return found + off[:, 0]


def reading_inputs(
    rgb: Float[Tensor, "t 3 h w"],
    log_depth: Float[Tensor, "t h w"],
    known: Bool[Tensor, "t h w"],
    K: Float[Tensor, "t 3 3"],
) -> CompletionInputs:
    """What the network is shown of views of one scene under one light, at the size it reads them at.

    Args:
        rgb: restored views, in [0, 1].
        log_depth: rendered, smoothly continued into holes.
        known: where the rendering is solid.
        K: pinhole intrinsics in pixels.
    """
    return completion_inputs(*_as_stereo(rgb, log_depth, known, K))


def _as_stereo(
    rgb: Float[Tensor, "t 3 h w"],
    log_depth: Float[Tensor, "t h w"],
    known: Bool[Tensor, "t h w"],
    K: Float[Tensor, "t 3 3"],
) -> tuple[PosedFrames, StereoDepth]:
    # Poses play no part: nothing is matched.
    frames = PosedFrames(rgb, torch.ones_like(known), K, torch.eye(4).expand(len(rgb), 4, 4))
    brightness = smoothed_brightness(frames)
    (fit,) = fit_shading(brightness, log_depth, known & (rgb.amax(dim=1) < NEARLY_SATURATED))
    confirmed = known.to(log_depth.dtype)
    nothing = torch.zeros_like(confirmed)
    stereo = StereoDepth(
        log_depth=log_depth,
        cost=torch.where(known, CONFIRMED_COST, UNCONFIRMED_COST),
        margin=CONFIRMED_MARGIN * confirmed,
        seen=confirmed,
        agrees=confirmed,
        violates=nothing,
        difference=torch.where(known, CONFIRMED_DIFFERENCE, UNCONFIRMED_DIFFERENCE),
        fused=log_depth,
        prior=fit.log_depth(brightness),
        prior_scatter=torch.full((len(rgb),), fit.scatter),
        fits=[fit],
        monocular=[],
        recording=torch.zeros(len(rgb), dtype=torch.long),
        n_sources=torch.full((len(rgb),), SOURCES),
    )
    return frames, stereo
