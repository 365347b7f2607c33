"""Rows of what works on images: warping, filling, the restorer, depth from stereo."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from extrags.cameras import Cameras
from extrags.config import EnhanceConfig
from extrags.depth.completion import INPUT_CHANNELS, completion_inputs
from extrags.depth.frames import PosedFrames
from extrags.depth.stereo import StereoSettings, multi_view_stereo
from extrags.depth.weights import load_completion
from extrags.illumination import NearFieldLight
from extrags.restoration.diffusion.embedded import pretrained
from extrags.restoration.diffusion.rectified_flow import sample
from extrags.restoration.diffusion.weights import COLONS
from extrags.stress.inputs import FARTHEST_OFFSET_MM, GAINS, IMAGES, SCALES, TURN, UPRIGHT, image, plane_views
from extrags.stress.rows import (
    EPS,
    EXACT,
    FINITE,
    Effort,
    Row,
    Trial,
    differs,
    finite_or_refused,
    relative,
    with_threads,
)
from extrags.threads import in_threads
from extrags.view_synthesis.conditioning import Layers, condition
from extrags.view_synthesis.filling import completed_depth, push_pull
from extrags.view_synthesis.references import LightTransfer, ReferenceViews
from extrags.view_synthesis.warp import Warped, warp_references

__all__ = ["ROWS"]

BFLOAT16_EPS = 2.0**-7
STEREO = StereoSettings(hypotheses=24, refinement_hypotheses=5)


def _references(
    unit: float,
    offset_mm: float,
    *,
    gain: float = 1.0,
    rgb: Tensor | None = None,
    frames: int = 3,
    turn: np.ndarray = UPRIGHT,
) -> tuple[ReferenceViews, Cameras, Tensor]:
    """Exact views of a plane, as references of themselves."""
    cameras, depth, _, _ = plane_views(frames, 32, 24, unit=unit, offset_mm=offset_mm, turn=turn)
    known = torch.from_numpy(depth)[:, None]
    color = image("noise", frames, 3, 24, 32) * 0.5 + 0.2 if rgb is None else rgb
    packed = torch.cat([color, torch.ones_like(known), 1 / known, torch.ones_like(known)], dim=1)
    light = NearFieldLight.initial(frames, 2 * unit)
    references = ReferenceViews(
        np.arange(frames),
        cameras,
        packed.contiguous(),
        torch.full((frames,), gain),
        torch.zeros(frames, 0, dtype=torch.bool),
        LightTransfer(light, 0.0, 2 * unit),
    )
    return references, cameras, known


def _warped(unit: float, offset_mm: float, gain: float = 1.0, turn: np.ndarray = UPRIGHT) -> Warped:
    references, cameras, depth = _references(unit, offset_mm, gain=gain, turn=turn)
    exposure = torch.full((len(cameras),), gain)
    return warp_references(references, cameras, depth, count=2, exposure=exposure)


def _warp_invariance(effort: Effort) -> Iterator[Trial]:
    base = _warped(1.0, 0.0)
    for unit in SCALES:
        yield f"times {unit:g}", relative(_warped(unit, 0.0).blend, base.blend)
    for gain in GAINS:
        yield f"exposure times {gain:g}", relative(_warped(1.0, 0.0, gain).blend, base.blend)
    yield "turned", relative(_warped(1.0, 0.0, turn=TURN).blend, base.blend)


def _warp_offset(effort: Effort) -> Iterator[Trial]:
    base = _warped(20.0, 0.0)
    for offset in (1e2, 1e4, FARTHEST_OFFSET_MM):
        yield f"{offset:g} from the origin", relative(_warped(20.0, offset).blend, base.blend)


def _warp_extremes(effort: Effort) -> Iterator[Trial]:
    for kind in IMAGES:
        references, cameras, depth = _references(1.0, 0.0, rgb=image(kind, 3, 3, 24, 32))
        yield kind, finite_or_refused(partial(warp_references, references, cameras, depth, count=2))
    references, cameras, depth = _references(1.0, 0.0)
    for name, values in {
        "zero depth": torch.zeros_like(depth),
        "depth 1e-6": torch.full_like(depth, 1e-6),
        "depth 1e6": torch.full_like(depth, 1e6),
        "a step": torch.where(torch.arange(32) < 16, 1.0, 1e3).expand_as(depth).contiguous(),
    }.items():
        yield name, finite_or_refused(partial(warp_references, references, cameras, values, count=2))
    for gain in (0.0, 1e-6, 1e6):
        exposure = torch.full((3,), gain)
        yield (
            f"exposure {gain:g}",
            finite_or_refused(
                partial(warp_references, references, cameras, depth, count=2, exposure=exposure)
            ),
        )
    blind = ReferenceViews(
        references.frames,
        cameras,
        torch.zeros_like(references.packed),
        references.exposure,
        references.seen,
        references.transfer,
    )
    yield (
        "references that know nothing",
        finite_or_refused(partial(warp_references, blind, cameras, depth, count=2)),
    )


def _filling_error(effort: Effort) -> Iterator[Trial]:
    """Float32 beside float64, and half precisions within theirs."""
    for seed in range(min(effort.scenes, 30)):
        generator = torch.Generator().manual_seed(seed)
        height, width = (int(v) for v in torch.randint(1, 40, (2,), generator=generator))
        values = torch.rand(1, 3, height, width, generator=generator)
        weight = torch.rand(1, 1, height, width, generator=generator)
        weight = weight * (torch.rand(weight.shape, generator=generator) < 0.3)
        exact = push_pull(values.double(), weight.double())
        place = f"seed {seed}, {width}x{height}"
        yield f"{place}, float32", relative(push_pull(values, weight), exact) / (64 * EPS)
        half = push_pull(values.bfloat16(), weight.bfloat16())
        rounded = push_pull(values.bfloat16().double(), weight.bfloat16().double())
        yield f"{place}, bfloat16", relative(half, rounded) / (4 * BFLOAT16_EPS)
        half = push_pull(values.half(), weight.half())
        rounded = push_pull(values.half().double(), weight.half().double())
        yield f"{place}, float16", relative(half, rounded) / (4 * BFLOAT16_EPS / 8)


def _filling_range(effort: Effort) -> Iterator[Trial]:
    """Filled values never leave the range of the known ones."""
    for seed in range(min(effort.scenes, 30)):
        for strength in (1e-20, 1e-12, 1e-6, 1.0):
            generator = torch.Generator().manual_seed(seed)
            values = 0.2 + 0.6 * torch.rand(1, 3, 20, 17, generator=generator)
            weight = strength * (torch.rand(1, 1, 20, 17, generator=generator) < 0.1).float()
            filled = push_pull(values, weight)
            below, above = 0.2 - float(filled.min()), float(filled.max()) - 0.8
            yield (
                f"seed {seed}, weights {strength:g}",
                max(below, above, 0.0) / EPS if float(weight.sum()) else 0.0,
            )


def _filled_depth(effort: Effort) -> Iterator[Trial]:
    _, depth, _, _ = plane_views(1, 32, 24)
    holes = torch.from_numpy(depth)[:, None] * (image("noise", 1, 1, 24, 32) > 0.6)
    weight = (holes > 0).float()
    base = completed_depth(holes, weight, 2.0)
    for unit in SCALES:
        yield f"times {unit:g}", relative(completed_depth(holes * unit, weight, 2.0 * unit) / unit, base)
    nothing = completed_depth(torch.zeros_like(holes), weight * 0, 2.0)
    yield "nothing known", relative(nothing, torch.full_like(holes, 2.0))
    one = completed_depth(torch.full((1, 1, 1, 1), 3.0), torch.ones(1, 1, 1, 1), 2.0)
    yield "one pixel", relative(one, torch.full((1, 1, 1, 1), 3.0))


def _layers(kind: str, height: int, width: int, *, unit: float = 1.0, hole: bool = True) -> Layers:
    color = image(kind, 1, 3, height, width)
    one = torch.ones(1, 1, height, width)
    alpha = one.clone()
    if hole:
        alpha[..., : (width + 1) // 2] = 0
    zero = torch.zeros_like(one)
    return Layers.of(
        rendered=color * alpha,
        alpha=alpha,
        depth_mm=3.0 * unit * alpha,
        spread=zero,
        uncertainty=1 - alpha,
        nearest=color,
        nearest_weight=0.5 * one,
        blend=color,
        blend_weight=0.5 * one,
        log_ratio=zero,
        ray_length=1.1 * one,
        invented=torch.zeros_like(color),
        invented_weight=zero,
    )


def _restored(layers: Layers, unit: float, *, half: bool, dtype: torch.dtype = torch.float32) -> list[Tensor]:
    enhancer = pretrained(EnhanceConfig(pretrained_weights=COLONS))[0]
    transfer = LightTransfer(NearFieldLight.initial(1, 3 * unit), 0.0, 3 * unit)
    conditioning = condition(layers, transfer, folded=enhancer.network.folded)
    network = enhancer.network.to(dtype)
    size = layers.data.shape[-2:]
    noise = torch.randn(1, 3, *size, generator=torch.Generator().manual_seed(0)).to(dtype)
    whole = type(conditioning)(
        *(getattr(conditioning, n).to(dtype) for n in ("channels", "base", "depth_mm"))
    )
    found = sample(network, whole, noise, steps=1, half_precision=half)
    return [found.rgb.float(), found.depth_mm.float() / unit, found.error.float()]


def _restorer_precision(effort: Effort) -> Iterator[Trial]:
    """Largest change of a colour by float32, over a level of eight bits; by bfloat16, over 0.1."""
    for kind in IMAGES:
        layers = _layers(kind, 32, 48)
        single = _restored(layers, 1.0, half=False)
        half = _restored(layers, 1.0, half=True)
        yield f"{kind}, bfloat16", float((half[0] - single[0]).abs().max()) / 0.1
        twice = [_restored(layers, 1.0, half=False)[0], single[0]]
        yield f"{kind}, repeated", float((twice[0] - twice[1]).abs().max()) * 255


def _restorer_extremes(effort: Effort) -> Iterator[Trial]:
    for kind in IMAGES:
        for height, width in ((1, 1), (1, 9), (7, 3), (24, 40)):
            for half in (False, True):
                run = partial(_restored, _layers(kind, height, width), 1.0, half=half)
                yield f"{kind}, {width}x{height}{', bfloat16' if half else ''}", finite_or_refused(run)
    for strength in (1e3, 1e30):
        layers = _layers("noise", 24, 40)
        layers.get("depth_mm")[:] *= strength
        yield f"depth times {strength:g}", finite_or_refused(partial(_restored, layers, 1.0, half=False))


def _restorer_units(effort: Effort) -> Iterator[Trial]:
    base = _restored(_layers("noise", 24, 40), 1.0, half=False)
    for unit in SCALES:
        found = _restored(_layers("noise", 24, 40, unit=unit), unit, half=False)
        yield f"times {unit:g}", max(relative(one, other) for one, other in zip(found, base, strict=True))


def _frames(
    rgb: Tensor, unit: float, offset_mm: float, frames: int = 3, turn: np.ndarray = UPRIGHT
) -> tuple[PosedFrames, np.ndarray, Cameras]:
    height, width = rgb.shape[-2:]
    cameras, depth, _, _ = plane_views(frames, width, height, unit=unit, offset_mm=offset_mm, turn=turn)
    mask = torch.ones(frames, *rgb.shape[-2:], dtype=torch.bool)
    posed = PosedFrames(
        rgb,
        mask,
        torch.from_numpy(cameras.K.astype(np.float32)),
        # As `posed_frames` has it: only where frames stand to each other matters.
        torch.from_numpy(_centred(cameras).astype(np.float32)),
    )
    return posed, depth, cameras


def _centred(cameras: Cameras) -> np.ndarray:
    poses = cameras.world_from_camera.copy()
    poses[:, :3, 3] -= poses[:, :3, 3].mean(0)
    return poses


def _textured(frames: int = 3, height: int = 24, width: int = 32) -> Tensor:
    return image("noise", frames, 3, height, width) * 0.6 + 0.2


def _stereo(posed: PosedFrames, unit: float) -> dict[str, Any]:
    count = len(posed)
    sources = torch.stack([torch.tensor([k for k in range(count) if k != f] or [-1]) for f in range(count)])
    near, far = torch.full((count,), 0.7 * unit), torch.full((count,), 7.0 * unit)
    stereo = multi_view_stereo(posed, sources, near, far, STEREO)
    found = {"log_depth": stereo.log_depth - math.log(unit), "cost": stereo.cost, "agrees": stereo.agrees}
    network = load_completion("bundled")
    if network is not None:
        inputs = completion_inputs(posed, stereo)
        with torch.no_grad():
            # As `estimate_depth` runs it.
            found["completed"], found["error"] = in_threads(network, [inputs.channels])[0]
    return found


def _stereo_extremes(effort: Effort) -> Iterator[Trial]:
    for kind in IMAGES:
        posed, _, _ = _frames(image(kind, 3, 3, 24, 32), 1.0, 0.0)
        yield kind, finite_or_refused(partial(_stereo, posed, 1.0))
    posed, _, _ = _frames(_textured(), 1.0, 0.0)
    poses = posed.world_from_camera
    away = poses.clone()
    away[:, :3, 3] *= 1e3
    back = poses @ torch.diag(torch.tensor([1.0, -1, -1, 1]))
    mixed = torch.cat([poses[:1], back[1:]])
    near = poses[:1].repeat(3, 1, 1)
    near[:, :3, 3] += 1e-7 * torch.randn(3, 3, generator=torch.Generator().manual_seed(0))
    for name, other in {
        "one pose thrice": poses[:1].repeat(3, 1, 1),
        "poses a rounding apart": near,
        "poses far off": away,
        "views back to back": mixed,
    }.items():
        changed = PosedFrames(posed.rgb, posed.mask, posed.K, other)
        yield name, finite_or_refused(partial(_stereo, changed, 1.0))
    nothing = PosedFrames(posed.rgb, torch.zeros_like(posed.mask), posed.K, poses)
    yield "empty masks", finite_or_refused(partial(_stereo, nothing, 1.0))
    for height, width in ((1, 1), (1, 9), (9, 1), (5, 4)):
        small, _, _ = _frames(_textured(3, height, width), 1.0, 0.0)
        yield f"{width}x{height}", finite_or_refused(partial(_stereo, small, 1.0))
    alone, _, _ = _frames(_textured(1), 1.0, 0.0, frames=1)
    yield "one frame", finite_or_refused(partial(_stereo, alone, 1.0))
    for focal in (0.1, 1e5):
        K = posed.K.clone()
        K[:, 0, 0] = K[:, 1, 1] = focal
        yield (
            f"focal length {focal:g} px",
            finite_or_refused(partial(_stereo, PosedFrames(posed.rgb, posed.mask, K, poses), 1.0)),
        )


def _stereo_units(effort: Effort) -> Iterator[Trial]:
    """Share of pixels whose depth differs by more than a tenth of a step of the search."""
    posed, _, _ = _frames(_textured(), 1.0, 0.0)
    base = _stereo(posed, 1.0)
    step = math.log(10) / (STEREO.hypotheses - 1)
    for unit in SCALES:
        found = _stereo(_frames(_textured(), unit, 0.0)[0], unit)
        yield (
            f"times {unit:g}",
            float(((found["log_depth"] - base["log_depth"]).abs() > 0.1 * step).float().mean()),
        )
    for offset in (1e2, 1e4, FARTHEST_OFFSET_MM):
        found = _stereo(_frames(_textured(), 20.0, offset)[0], 20.0)
        share = float(((found["log_depth"] - base["log_depth"]).abs() > 0.1 * step).float().mean())
        yield f"times 20, {offset:g} from the origin", share
    found = _stereo(_frames(_textured(), 1.0, 0.0, turn=TURN)[0], 1.0)
    yield "turned", float(((found["log_depth"] - base["log_depth"]).abs() > 0.1 * step).float().mean())


def _stereo_repeat(effort: Effort) -> Iterator[Trial]:
    posed, _, _ = _frames(_textured(3, 48, 64), 1.0, 0.0)
    first = with_threads(1, partial(_stereo, posed, 1.0))
    for threads in (1, 2, 4):
        yield f"{threads} threads", differs(with_threads(threads, partial(_stereo, posed, 1.0)), first)


def _completion_precision(effort: Effort) -> Iterator[Trial]:
    """Largest difference of log-depth by bfloat16, over a tenth."""
    network = load_completion("bundled")
    assert network is not None
    for seed in range(3):
        channels = torch.randn(
            1, INPUT_CHANNELS, 24, 32, generator=torch.Generator().manual_seed(seed)
        ).clamp(-1, 1)
        with torch.no_grad():
            plain = network(channels)[0]
            with torch.autocast("cpu", torch.bfloat16):
                half = network(channels)[0]
            exact = network.double()(channels.double())[0]
            network.float()
        yield f"seed {seed}, bfloat16", float((half - plain).abs().max()) / 0.1
        yield f"seed {seed}, float32", float((plain - exact).abs().max()) / 1e-3


def _rows() -> Iterator[Row]:
    yield Row(
        "warp",
        "scale 1e-3 to 1e4, exposure x16 and /16, rotation",
        "relative change of colours",
        1e-3,
        _warp_invariance,
    )
    yield Row("warp", "offset to 1e5", "relative change of colours", 0.05, _warp_offset)
    yield Row("warp", "images and depth without content", "results not finite", FINITE, _warp_extremes)
    yield Row("filling", "float32, bfloat16, float16", "error over that of the type", 1.0, _filling_error)
    yield Row("filling", "faint weights", "excess over the range, in roundings", 8.0, _filling_range)
    yield Row("filling", "depth in any unit", "relative change", 1e-5, _filled_depth)
    yield Row("restorer", "bfloat16 and repeat", "change over 0.1, or over a level", 1.0, _restorer_precision)
    yield Row(
        "restorer", "images without content, from one pixel", "results not finite", FINITE, _restorer_extremes
    )
    yield Row("restorer", "scale 1e-3 to 1e4", "relative change", 1e-3, _restorer_units)
    yield Row("depth", "images without content, poses off", "results not finite", FINITE, _stereo_extremes)
    yield Row(
        "depth",
        "scale 1e-3 to 1e4, offset to 1e5, rotation",
        "share of pixels that change",
        0.02,
        _stereo_units,
    )
    yield Row("depth", "float32 and bfloat16", "change over 0.001, and over 0.1", 1.0, _completion_precision)
    yield Row("depth", "repeat and threads", "results that differ", EXACT, _stereo_repeat)


ROWS = tuple(_rows())
