"""Real frames of a sequence prepared as references of a scene."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from extrags.errors import CaptureError, ShapeError
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, saturated_mask
from extrags.threads import one_torch_thread
from extrags.view_synthesis.references import SEEN_WEIGHT, LightTransfer, ReferenceViews, visibility_of
from extrags.view_synthesis.shrinkage import color_support, shrunk_sh0
from extrags.view_synthesis.warp import with_fitted_transfer

__all__ = ["gather_references"]

FEATHER_PX = 4.0
"""Trust in a real view rises over so many pixels from the border of its valid area."""
SOLID_ALPHA = 0.9
"""Rendered depth is taken for the real view's where the rendering is at least this opaque."""


@one_torch_thread()
def gather_references(
    scene: Scene,
    sequence: EndoscopicSequence,
    frames: Int[np.ndarray, "r"],
    *,
    exposure: Float[Tensor, "r"] | None = None,
) -> ReferenceViews:
    """Prepare real frames as references of a scene.

    Depth is the measured one where the sequence has it, or an estimate that is reliable
    (`EndoscopicSequence.reliable_depth_mm`), else the scene's rendering where it is opaque. Without a light
    model, how brightness falls with distance is fitted to the views.

    Args:
        scene: the reconstruction; needed for depth and for what each frame saw.
        sequence: posed frames.
        frames: which frames; training frames only, else held-out images would leak into the evaluation.
        exposure: gain of each frame; None takes the light's own, for a scene trained on exactly
            these frames, else 1.

    Raises:
        CaptureError: without any frame, or when none has usable depth.
        ShapeError: when the light's exposures are not those of the frames, or these are no pinholes.
    """
    if sequence.lens is not None:
        raise ShapeError(f"{sequence.name}: references are pinholes; take `EndoscopicSequence.as_pinhole`")
    # What a frame saw is told by blending weights, which the native kernels give and gsplat does not.
    scene = scene.to("cpu")
    frames = np.asarray(frames, dtype=np.int64)
    if len(frames) == 0:
        raise CaptureError(f"{sequence.name}: no real views to refer to")
    cameras = sequence.cameras[frames]
    depth, seen, support = _depth_and_seen(scene, sequence, frames)
    if not bool((depth > 0).any()):
        raise CaptureError(f"{sequence.name}: no depth in any of the {len(frames)} real views")
    rgb = torch.from_numpy(sequence.rgb[frames].astype(np.float32) / 255).permute(0, 3, 1, 2)
    trust = torch.from_numpy(_trust(sequence, frames))
    known = depth > 0
    inverse = torch.where(known, 1 / depth.clamp_min(1e-9), torch.zeros(()))
    packed = torch.cat(
        [rgb, trust[:, None], inverse[:, None], known[:, None].to(torch.float32)], dim=1
    ).contiguous()
    scale = float(depth[known].median())
    references = ReferenceViews(
        frames,
        cameras,
        packed,
        _exposures(scene, frames) if exposure is None else exposure,
        seen,
        LightTransfer(scene.light, 0.0, scale),
        shrunk_sh0(scene, support),
    )
    if scene.light is None:
        references = with_fitted_transfer(references)
    return references


def _exposures(scene: Scene, frames: Int[np.ndarray, "r"]) -> Float[Tensor, "r"]:
    light = scene.light
    if light is None:
        return torch.ones(len(frames))
    if len(light.log_exposure) != len(frames):
        raise ShapeError(
            f"the scene's light has {len(light.log_exposure)} exposures for {len(frames)} reference frames; "
            "give the frames the scene was trained on, or their exposures"
        )
    return light.exposures()


def _depth_and_seen(
    scene: Scene, sequence: EndoscopicSequence, frames: Int[np.ndarray, "r"]
) -> tuple[Float[Tensor, "r h w"], Bool[Tensor, "r n"], Float[Tensor, "n"]]:
    depths, seen, support = [], [], torch.zeros(len(scene.gaussians))
    for frame in frames:
        mask = torch.from_numpy(sequence.mask[frame])
        with torch.no_grad():
            # What lies in the dark corners of a round picture was not seen by it.
            rendering = scene.render(
                sequence.cameras[int(frame)], visibility=True, visibility_mask=mask[None]
            )
        seen.append(visibility_of(rendering)[0] > SEEN_WEIGHT)
        support += color_support(scene, sequence.cameras[int(frame)], rendering)
        rendered = torch.where(rendering.alpha[0] > SOLID_ALPHA, rendering.depth[0], torch.zeros(()))
        depth = rendered
        reliable = sequence.reliable_depth_mm(int(frame))
        if reliable is not None:
            known = torch.from_numpy(reliable)
            depth = torch.where(known > 0, known, rendered)
        depths.append(torch.where(mask, depth, torch.zeros(())))
    return torch.stack(depths), torch.stack(seen), support


def _trust(sequence: EndoscopicSequence, frames: Int[np.ndarray, "r"]) -> Float[np.ndarray, "r h w"]:
    """1 inside the valid area, falling to 0 at its border and the image's; low where saturated."""
    from scipy.ndimage import distance_transform_edt

    maps = []
    for frame in frames:
        bordered = np.pad(sequence.mask[frame], 1)
        distance = distance_transform_edt(bordered)[1:-1, 1:-1]
        trust = np.clip((distance - 0.5) / FEATHER_PX, 0, 1)
        maps.append(np.where(saturated_mask(sequence.rgb[frame]), 0.1 * trust, trust))
    return np.stack(maps).astype(np.float32)
