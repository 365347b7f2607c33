"""Rows of the training step: loss and gradients of one view, lit and unlit, against float64 autograd."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from extrags.raster.direct import DirectStep, Target
from extrags.raster.dispatch import rasterize
from extrags.raster.light import LEARNED_LENGTH, CameraLight
from extrags.raster.loss import inverse_depth_loss, l1_ssim_loss_reference
from extrags.raster.stability import AXES, FLOAT32_FACTOR, GRADIENT_TOLERANCE, REFUSED, bench_stability
from extrags.stress.inputs import (
    FARTHEST_OFFSET_MM,
    GAINS,
    IMAGES,
    SCALES,
    LitScene,
    image,
    lit_tube,
    random_lit_scene,
)
from extrags.stress.rows import (
    EPS,
    EXACT,
    FINITE,
    Effort,
    Row,
    Trial,
    all_finite,
    differs,
    relative,
    with_threads,
)

__all__ = ["ROWS", "autograd_step", "native_step", "over_allowed"]

DEPTH_WEIGHT, DSSIM_WEIGHT = 0.3, 0.2
LOSS_TOLERANCE = 1e-5
TOUCHED = 16 * EPS
"""Relative change of the inputs by which a result's sensitivity is found: what rounding on the way does."""
TOUCHES = 3
ALLOWED = "error, in multiples of what float32 allows"

Found = dict[str, Tensor]


def native_step(scene: LitScene) -> Found:
    """Loss and gradients as training has them."""
    lit = scene.light is not None
    step = DirectStep(lit=lit)
    step.bind({name: value.float().contiguous() for name, value in scene.parameters.items()})
    target = Target(scene.viewmat.double().numpy(), scene.K.double().numpy(), scene.target, depth=scene.depth)
    loss = step.run(
        target,
        sh_degree=math.isqrt(scene.parameters["sh"].shape[1]) - 1,
        light=None if scene.light is None else scene.light.float().numpy(),
        dssim_weight=DSSIM_WEIGHT,
        depth_weight=DEPTH_WEIGHT,
        depth_scale=_depth_scale(scene),
        near=_near(scene),
        pose=True,
    )
    found = {
        "loss": torch.tensor(loss, dtype=torch.float64),
        "viewmat": torch.from_numpy(step.viewmat_gradient[:3]),
    }
    found |= {name: value.clone() for name, value in step.gradients.items()}
    return {**found, "light": torch.from_numpy(step.light_gradient[:LEARNED_LENGTH].copy())} if lit else found


def autograd_step(scene: LitScene, dtype: torch.dtype = torch.float64, *, rounded: bool = True) -> Found:
    """The same by the specification of the rasteriser, differentiated by autograd.

    Args:
        scene: what is rendered.
        dtype: of all that is computed.
        rounded: whether parameters are rounded to float32 first, so that both are given the same numbers.
    """
    parameters = {k: value.float() if rounded else value for k, value in scene.parameters.items()}
    leaves = {name: value.to(dtype, copy=True).requires_grad_() for name, value in parameters.items()}
    viewmat = scene.viewmat.float().to(dtype, copy=True).requires_grad_()
    light = None if scene.light is None else scene.light.float().to(dtype, copy=True).requires_grad_()
    height, width = scene.depth.shape
    rendering = rasterize(
        leaves["means"],
        leaves["quats"],
        leaves["scales"].exp(),
        leaves["opacities"].sigmoid(),
        leaves["sh"],
        viewmat[None],
        scene.K.float().to(dtype)[None],
        width,
        height,
        near=_near(scene),
        backend="reference",
        light=None if light is None else _light(light),
    )
    loss = l1_ssim_loss_reference(rendering.rgb[0], scene.target.to(dtype), dssim_weight=DSSIM_WEIGHT)
    loss = loss + DEPTH_WEIGHT * inverse_depth_loss(
        rendering.depth[0], rendering.alpha[0], scene.depth.to(dtype), scale=_depth_scale(scene)
    )
    if loss.requires_grad:
        loss.backward()
    found = {
        name: leaf.grad if leaf.grad is not None else torch.zeros_like(leaf) for name, leaf in leaves.items()
    }
    pose = torch.zeros(3, 4, dtype=dtype) if viewmat.grad is None else viewmat.grad[:3]
    found |= {"loss": loss.detach(), "viewmat": pose}
    if light is not None:
        found["light"] = (
            torch.zeros(LEARNED_LENGTH, dtype=dtype) if light.grad is None else light.grad[:LEARNED_LENGTH]
        )
    return found


def _light(row: Tensor) -> CameraLight:
    return CameraLight(
        row[None, :3],
        row[3],
        row[4],
        row[5],
        row[6],
        row[7:10],
        row[10],
        float(row[-1].detach()),
        row[11],
        row[12],
        row[13:16],
    )


def _depth_scale(scene: LitScene) -> float:
    known = scene.depth[scene.depth > 0]
    return float(known.median()) if len(known) else 1.0


def _near(scene: LitScene) -> float:
    return 0.01 * (1.0 if scene.light is None else float(scene.light[-1]))


def over_allowed(scene: LitScene) -> float:
    """Worst error of the native step, in multiples of what float32 allows; infinite where it is not finite.

    Allowed is, of each gradient, a fixed tolerance, or a few times what the specification itself is off in
    float32, here or at inputs some roundings away, or what changes between those: where terms cancel, or a
    Gaussian is at the edge of being left out, that is a lot.
    """
    found = native_step(scene)
    if not all_finite(found):
        return math.inf
    exact = autograd_step(scene)
    errors = _errors(found, exact)
    floors = {name: LOSS_TOLERANCE if name == "loss" else GRADIENT_TOLERANCE for name in errors}
    if all(errors[name] <= floors[name] for name in errors):
        return max(errors[name] / floors[name] for name in errors)
    explained = [_errors(autograd_step(scene, torch.float32), exact)]
    # One rounding more or less may cancel by chance: the specification is tried on other inputs too.
    for touched in (_touched(scene, seed) for seed in range(TOUCHES)):
        there = autograd_step(touched)
        explained += [_errors(there, exact), _errors(autograd_step(touched, torch.float32), there)]
    allowed = {
        name: max(
            floors[name], FLOAT32_FACTOR * max(_finite_or_zero(one.get(name, 0.0)) for one in explained)
        )
        for name in errors
    }
    return max(errors[name] / allowed[name] for name in errors)


def _finite_or_zero(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def _errors(found: Found, exact: Found) -> dict[str, float]:
    """Relative to the gradient; to its share of the whole where it is next to nothing."""
    largest = max((float(value.norm()) for name, value in exact.items() if name != "loss"), default=0.0)
    return {
        name: relative(found[name], exact[name])
        for name in exact
        if name == "loss" or float(exact[name].norm()) > 1e-12 * largest
    }


def _touched(scene: LitScene, seed: int) -> LitScene:
    generator = torch.Generator().manual_seed(seed)

    def changed(values: Tensor) -> Tensor:
        noise = 2 * torch.rand(values.shape, generator=generator, dtype=torch.float64) - 1
        return (values.double() * (1 + TOUCHED * noise)).float()

    parameters = {name: changed(value) for name, value in scene.parameters.items()}
    light = None if scene.light is None else changed(scene.light)
    return replace(scene, parameters=parameters, viewmat=changed(scene.viewmat), light=light)


def _compared(cases: Callable[[], Iterable[tuple[str, LitScene]]], effort: Effort) -> Iterator[Trial]:
    for place, scene in cases():
        yield place, over_allowed(scene)


def _scales(lit: bool) -> Iterator[tuple[str, LitScene]]:
    for factor in SCALES:
        yield f"times {factor:g}", lit_tube(lit=lit).scaled(factor)


def _offsets(lit: bool) -> Iterator[tuple[str, LitScene]]:
    for scale in (1.0, 20.0):
        for offset in (1e2, 1e4, FARTHEST_OFFSET_MM):
            scene = lit_tube(lit=lit).scaled(scale)
            yield (
                f"{offset:g} from the origin, times {scale:g}",
                scene.moved(torch.tensor([offset, -offset, offset])),
            )


def _gains() -> Iterator[tuple[str, LitScene]]:
    for gain in GAINS:
        scene = lit_tube()
        assert scene.light is not None
        light = scene.light.clone()
        light[:3] *= gain
        yield f"exposure times {gain:g}", replace(scene, light=light)


def _images(lit: bool) -> Iterator[tuple[str, LitScene]]:
    for kind in IMAGES:
        yield kind, replace(lit_tube(lit=lit), target=image(kind, 32, 40, 3))
    scene = lit_tube(lit=lit)
    black = torch.full_like(scene.parameters["sh"], 0.0)
    black[:, 0] = -10
    yield (
        "black rendering of a black image",
        replace(scene.with_parameters(sh=black), target=image("black", 32, 40, 3)),
    )


def _depths(lit: bool) -> Iterator[tuple[str, LitScene]]:
    scene = lit_tube(lit=lit)
    yield "none", replace(scene, depth=torch.zeros_like(scene.depth))
    one = torch.zeros_like(scene.depth)
    one[16, 20] = 3.0
    yield "a single pixel", replace(scene, depth=one)
    outliers = torch.rand(32, 40, generator=torch.Generator().manual_seed(0)) < 0.1
    yield "outliers", replace(scene, depth=torch.where(outliers, 1e6, scene.depth))
    step = torch.ones_like(scene.depth)
    step[:, 20:] = 1e3
    yield "a step by a thousand", replace(scene, depth=step)
    yield "1e-6", replace(scene, depth=torch.full_like(scene.depth, 1e-6))


def _shapes(lit: bool) -> Iterator[tuple[str, LitScene]]:
    scene = lit_tube(lit=lit)
    n = len(scene.parameters["means"])
    for name, shape in {
        "needles 1:1e3": (0.5, 5e-4, 5e-4),
        "needles 1:1e6": (0.5, 5e-7, 5e-7),
        "pancakes 1:1e3": (0.3, 0.3, 3e-4),
        "pancakes 1:1e6": (0.3, 0.3, 3e-7),
        "points": (1e-9, 1e-9, 1e-9),
        "a hundred scenes wide": (100.0, 100.0, 100.0),
        "spheres": (0.2, 0.2, 0.2),
    }.items():
        yield name, scene.with_parameters(scales=torch.tensor(shape).log().expand(n, 3).clone())


def _lenses(lit: bool) -> Iterator[tuple[str, LitScene]]:
    for focal in (0.5, 4.0, 400.0, 1e4):
        K = lit_tube().K.clone()
        K[0, 0] = K[1, 1] = focal
        yield f"focal length {focal:g} px", replace(lit_tube(lit=lit), K=K)
    K = lit_tube().K.clone()
    K[0, 0] *= 30
    yield "pixels 30 times as wide as high", replace(lit_tube(lit=lit), K=K)
    K = lit_tube().K.clone()
    K[0, 2] = -200.0
    yield "principal point outside", replace(lit_tube(lit=lit), K=K)


def _sizes(lit: bool) -> Iterator[tuple[str, LitScene]]:
    for width, height in ((1, 1), (1, 9), (9, 1), (2, 2), (10, 11), (17, 16)):
        yield f"{width}x{height}", lit_tube(60, width, height, lit=lit)


def _opacities(lit: bool) -> Iterator[tuple[str, LitScene]]:
    scene = lit_tube(lit=lit)
    for logit in (-100.0, -5.5, 5.0, 15.0, 100.0):
        opacities = torch.full_like(scene.parameters["opacities"], logit)
        yield f"logits {logit:g}", scene.with_parameters(opacities=opacities)


CASES: dict[str, Callable[[bool], Iterator[tuple[str, LitScene]]]] = {
    "scene scale 1e-3 to 1e4": _scales,
    "offset to 1e5": _offsets,
    "images without content": _images,
    "depth with zeros, outliers, steps": _depths,
    "needles and pancakes": _shapes,
    "extreme lenses": _lenses,
    "image sizes from one pixel": _sizes,
    "opacity": _opacities,
}


def _random(effort: Effort) -> Iterator[Trial]:
    for seed in range(effort.scenes):
        yield f"seed {seed}", over_allowed(random_lit_scene(seed))


def _wild(effort: Effort) -> Iterator[Trial]:
    for seed in range(effort.scenes):
        scene = random_lit_scene(seed, wild=True)
        yield f"seed {seed}", 0.0 if all_finite(native_step(scene)) else math.inf


def _counts(lit: bool, effort: Effort) -> Iterator[Trial]:
    for count in (0, 1, 2, 1000):
        scene = lit_tube(max(count, 1), 16, 12, lit=lit)
        scene = scene.with_parameters(**{k: v[:count] for k, v in scene.parameters.items()})
        yield f"{count} Gaussians", over_allowed(scene)
    for count in (10_000, 100_000, 1_000_000):
        if count <= effort.largest:
            found = native_step(lit_tube(count, 160, 128, lit=lit))
            yield f"{count} Gaussians", 0.0 if all_finite(found) else math.inf


def _invariance(lit: bool, effort: Effort) -> Iterator[Trial]:
    """Loss of the same scene in another unit and frame: what is left is rounding."""
    for seed in range(min(effort.scenes, 50)):
        # Harmonics of degree 0 alone, which do not turn.
        drawn = random_lit_scene(seed)
        scene = drawn.with_parameters(sh=drawn.parameters["sh"][:, :1].contiguous())
        scene = scene if lit else replace(scene, light=None)
        here = autograd_step(scene)["loss"]
        generator = torch.Generator().manual_seed(seed)
        turn = torch.randn(3, 3, generator=generator, dtype=torch.float64)
        rotation = torch.linalg.matrix_exp(turn - turn.T)
        turned = _rotated(scene, rotation)
        allowed = max(LOSS_TOLERANCE, FLOAT32_FACTOR * relative(autograd_step(turned)["loss"], here))
        yield (
            f"rotation, seed {seed}",
            relative(native_step(turned)["loss"], native_step(scene)["loss"]) / allowed,
        )
        if lit:
            larger = native_step(scene.scaled(1024.0))["loss"]
            yield f"unit, seed {seed}", relative(larger, native_step(scene)["loss"]) / LOSS_TOLERANCE


def _rotated(scene: LitScene, rotation: Tensor) -> LitScene:
    """The same scene in a turned frame."""
    viewmat = scene.viewmat.double().clone()
    viewmat[:3, :3] = viewmat[:3, :3] @ rotation.T
    w, x, y, z = _quaternion(rotation)
    a, b, c, d = scene.parameters["quats"].double().unbind(1)
    quats = torch.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        dim=1,
    )
    means = scene.parameters["means"].double() @ rotation.T
    return replace(scene.with_parameters(means=means.float(), quats=quats.float()), viewmat=viewmat.float())


def _quaternion(rotation: Tensor) -> tuple[float, float, float, float]:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation.numpy()).as_quat()
    return w, x, y, z


def _repeated(lit: bool, effort: Effort) -> Iterator[Trial]:
    for seed in range(min(effort.scenes, 20)):
        scene = random_lit_scene(seed) if lit else replace(random_lit_scene(seed), light=None)
        first = with_threads(1, partial(native_step, scene))
        for threads in (1, 2, 3, 8):
            yield (
                f"seed {seed}, {threads} threads",
                differs(with_threads(threads, partial(native_step, scene)), first),
            )
    scene = lit_tube(5000, 120, 90, lit=lit)
    first = with_threads(1, partial(native_step, scene))
    for threads in (1, 2, 3, 8):
        yield (
            f"5000 Gaussians, {threads} threads",
            differs(with_threads(threads, partial(native_step, scene)), first),
        )


def _axis(name: str, effort: Effort) -> Iterator[Trial]:
    for case in bench_stability([name])["cases"]:
        value = 0.0 if case["ok"] else math.inf
        if case["error"] is not None and "float32" in case:
            plain = case["float32"]
            image_allowed = max(1e-4, FLOAT32_FACTOR * plain["error"])
            allowed = max(GRADIENT_TOLERANCE, FLOAT32_FACTOR * plain["gradient_error"])
            value = max(case["error"] / image_allowed, case["gradient_error"] / allowed)
        yield case["value"], value


def _rows() -> Iterator[Row]:
    for axis in (*AXES, REFUSED):
        yield Row("rasteriser", axis, ALLOWED, 1.0, partial(_axis, axis))
    for part, lit in (("unlit step", False), ("lit step", True)):
        for case, scenes in CASES.items():
            yield Row(part, case, ALLOWED, 1.0, partial(_compared, partial(scenes, lit)))
        yield Row(part, "1 to 1e6 Gaussians", ALLOWED, 1.0, partial(_counts, lit))
        yield Row(
            part, "rigid motion and unit", "change of the loss, " + ALLOWED, 1.0, partial(_invariance, lit)
        )
        yield Row(part, "repeat and threads", "results that differ", EXACT, partial(_repeated, lit))
    yield Row("lit step", "exposure x16 and /16", ALLOWED, 1.0, partial(_compared, _gains))
    yield Row("lit step", "random scenes", ALLOWED, 1.0, _random)
    yield Row("lit step", "wild scenes", "results that are not finite", FINITE, _wild)


ROWS = tuple(_rows())
