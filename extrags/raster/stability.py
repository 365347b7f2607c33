"""Numerical stability of the rasteriser on extreme inputs: `extrags bench stability`.

A case passes when all outputs of the native kernels are finite, alpha is in [0, 1], and image and gradients
agree with the float64 reference as well as float32 allows: within a fixed tolerance, or within a few times
the error of the reference itself in float32.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from extrags.errors import ConfigError, NonFiniteError
from extrags.radial_lens import LARGEST_ANGLE_RAD, RadialLens
from extrags.raster import native
from extrags.raster.bench import BenchSize, bench_scene, machine
from extrags.raster.dispatch import rasterize
from extrags.raster.peers import use_threads
from extrags.raster.rendering import Rendering

__all__ = ["AXES", "REFUSED", "bench_stability"]

IMAGE_TOLERANCE, GRADIENT_TOLERANCE = 1e-4, 1e-3
"""Relative L2 errors that always pass."""

FLOAT32_FACTOR = 4.0
"""Multiple of the reference's own float32 error that passes as well."""

NEAR = 0.01
LEARNED = ("means", "quats", "scales", "opacities", "sh")

Scene = dict[str, Tensor]


@dataclass(frozen=True)
class _Case:
    """One scene.

    Args:
        axis: the quantity that takes extreme values.
        value: its value, for the table.
        scene: arrays in the layout of `bench_scene`.
        compared: whether results are compared with float64; if not, they only have to be finite.
        note: remark for the table.
        lens: of the camera; None for a pinhole.
    """

    axis: str
    value: str
    scene: Scene
    compared: bool = True
    note: str = ""
    lens: RadialLens | None = None


def bench_stability(axes: Sequence[str] | None = None, *, threads: int = 1) -> dict[str, Any]:
    """Render and differentiate every case with the native kernels.

    Args:
        axes: of `AXES`, or `REFUSED`; None is all.
        threads: of the kernels.

    Returns:
        `{machine, cases}`; a case is `{axis, value, ok, error, note}` with the relative L2 of the image
        (None where there is nothing to compare with) and beside them `gradient_error`, the worst of the
        gradients, and `float32`, what the specification gives in float32, both kinds.

    Raises:
        ConfigError: for an unknown axis, or where the kernels are not built.
    """
    chosen = [*AXES, REFUSED] if axes is None else axes
    unknown = [axis for axis in chosen if axis not in (*AXES, REFUSED)]
    if unknown:
        raise ConfigError(f"unknown axes {', '.join(unknown)}; expected {', '.join([*AXES, REFUSED])}")
    if native.native_isa() is None:
        raise ConfigError(str(native.missing_kernels_error()))
    before = native.num_threads(), torch.get_num_threads()
    use_threads("native", threads)
    try:
        cases = [_case_result(case) for axis in chosen if axis in AXES for case in AXES[axis]()]
        if REFUSED in chosen:
            cases += _refusals()
        return {"machine": machine(), "cases": cases}
    finally:
        native.set_num_threads(before[0])
        torch.set_num_threads(before[1])


def _case_result(case: _Case) -> dict[str, Any]:
    found = _outputs_and_gradients(case.scene, "native", torch.float32, case.lens)
    result: dict[str, Any] = {"axis": case.axis, "value": case.value, "error": None}
    bad = [name for name, value in found.items() if not bool(torch.isfinite(value).all())]
    alpha = found["alpha"]
    if bad:
        return {**result, "ok": False, "note": f"not finite: {', '.join(bad)}"}
    if not 0 <= float(alpha.min()) <= float(alpha.max()) <= 1:
        return {**result, "ok": False, "note": "alpha outside [0, 1]"}
    if not case.compared:
        return {**result, "ok": True, "note": case.note or "finite"}
    exact = _outputs_and_gradients(case.scene, "reference", torch.float64, case.lens)
    plain = _outputs_and_gradients(case.scene, "reference", torch.float32, case.lens)
    image, gradient = _errors(found, exact)
    plain_image, plain_gradient = _errors(plain, exact)
    good_image = image <= max(IMAGE_TOLERANCE, FLOAT32_FACTOR * plain_image)
    good_gradient = gradient <= max(GRADIENT_TOLERANCE, FLOAT32_FACTOR * plain_gradient)
    problems = [
        f"{name} further off than float32 explains"
        for name, good in (("image", good_image), ("gradient", good_gradient))
        if not good
    ]
    return {
        **result,
        "ok": not problems,
        "error": image,
        "note": "; ".join(problems) or case.note or f"worst gradient {gradient:.1e}",
        "gradient_error": gradient,
        "float32": {"error": plain_image, "gradient_error": plain_gradient},
    }


def _outputs_and_gradients(
    scene: Scene, backend: Any, dtype: torch.dtype, lens: RadialLens | None = None
) -> dict[str, Tensor]:
    """All outputs, and the gradients of a fixed random linear function of colour, alpha and depth."""
    values = {name: value.to(dtype, copy=True) for name, value in scene.items()}
    leaves = {name: values[name].requires_grad_() for name in LEARNED}
    height, width = scene["target"].shape[1:3]
    more = backend == "native"
    rendering: Rendering = rasterize(
        leaves["means"],
        leaves["quats"],
        leaves["scales"],
        leaves["opacities"],
        leaves["sh"],
        values["viewmats"],
        values["Ks"],
        width,
        height,
        near=NEAR,
        backend=backend,
        median_depth=more,
        visibility=more,
        absgrad=more,
        lens=lens,
    )
    generator = torch.Generator().manual_seed(1)
    total = rendering.rgb.new_zeros(())
    for image in (rendering.rgb, rendering.alpha, rendering.depth):
        weights = torch.randn(image.shape, generator=generator).to(dtype)
        total = total + (weights * image / image.detach().abs().amax().clamp_min(1)).sum()
    found = {name: getattr(rendering, name).detach() for name in ("rgb", "alpha", "depth", "radius_px")}
    if more:
        optional = (rendering.median_depth, rendering.visibility_max, rendering.visibility_sum)
        found |= {str(index): value for index, value in enumerate(optional) if value is not None}
    if total.requires_grad:
        total.backward()
    found |= {f"gradient of {k}": v.grad for k, v in leaves.items() if v.grad is not None}
    if rendering.means2d.grad is not None:
        found["gradient of means2d"] = rendering.means2d.grad
    return found


def _errors(found: dict[str, Tensor], exact: dict[str, Tensor]) -> tuple[float, float]:
    """Relative L2 error of the image, and the largest one of the gradients."""

    def relative(name: str) -> float:
        difference = (found[name].double() - exact[name].double()).norm()
        return float(difference / exact[name].double().norm().clamp_min(1e-30))

    names = [f"gradient of {name}" for name in LEARNED]
    # A relative error is meaningless where the exact value is (nearly) zero.
    sizes = {name: float(exact[name].norm()) for name in names if name in exact and name in found}
    largest = max(sizes.values(), default=0.0)
    counted = [name for name, size in sizes.items() if size > 1e-12 * largest]
    return relative("rgb"), max((relative(name) for name in counted), default=0.0)


def _base(n: int = 200, width: int = 48, height: int = 36) -> Scene:
    return bench_scene(BenchSize(width, height, n), seed=3)


def _with(scene: Scene, **values: Tensor) -> Scene:
    return {**scene, **values}


def _scales() -> Iterator[_Case]:
    base = _base()
    for value in (0.0, 1e-20, 1e-6, 1e-2, 1e2, 1e4):
        yield _Case("scale", f"{value:g}", _with(base, scales=torch.full_like(base["scales"], value)))
    for value in (1e18, 1e38):
        scales = torch.full_like(base["scales"], value)
        yield _Case("scale", f"{value:g}", _with(base, scales=scales), compared=False)


def _needles() -> Iterator[_Case]:
    base = _base()
    for ratio in (1e2, 1e4, 1e6):
        scales = torch.tensor([1.0, 1 / ratio, 1 / ratio]).expand(200, 3).clone()
        yield _Case("needle", f"1:{ratio:g}", _with(base, scales=scales))


def _flat() -> Iterator[_Case]:
    base = _base()
    for thickness in (1e-3, 1e-6, 0.0):
        scales = torch.tensor([0.5, 0.5, thickness]).expand(200, 3).clone()
        yield _Case("flat", f"{thickness:g}", _with(base, scales=scales))


def _quaternions() -> Iterator[_Case]:
    base = _base()
    unit = torch.nn.functional.normalize(base["quats"], dim=1)
    for length in (0.0, 1e-38, 1e-20, 1e-3, 1e3, 1e18, 1e37):
        note = "stands for the identity" if length == 0 else ""
        # Below the reference's guard against division by zero its result is arbitrary, and in float32 the
        # squared length of the longest overflows: results only have to be finite there.
        compared = length in (0.0, 1e-3, 1e3)
        yield _Case("quaternion length", f"{length:g}", _with(base, quats=unit * length), compared, note)


def _near_plane() -> Iterator[_Case]:
    base = _with(_base(), viewmats=torch.eye(4)[None])
    below = math.nextafter(NEAR, 0)
    for name, depth in (("at", NEAR), ("1e-6 before", NEAR - 1e-6), ("1e-6 beyond", NEAR + 1e-6)):
        means = base["means"].clone()
        means[:, 2] = depth
        yield _Case("near plane", name, _with(base, means=means), compared=False)
    means = base["means"] * torch.tensor([1.0, 1.0, -1.0]) - torch.tensor([0.0, 0.0, 1.0])
    yield _Case("near plane", "behind the camera", _with(base, means=means))
    means = base["means"].clone()
    means[::2, 2], means[::2, 0] = NEAR * 1.01, 100.0
    yield _Case("near plane", "grazing, far to the side", _with(base, means=means))
    means = torch.zeros_like(base["means"])
    yield _Case("near plane", "on the camera centre", _with(base, means=means))
    means[:, 2] = below
    yield _Case("near plane", "on the axis, on either side", _with(base, means=means * base["means"]))


def _opacities() -> Iterator[_Case]:
    base = _base()
    for value in (0.0, 1e-38, 0.0039, 0.00393, 0.5, 0.999, 1 - 6e-8, 1.0):
        opacities = torch.full((200,), value)
        yield _Case("opacity", f"{value:.8g}", _with(base, opacities=opacities))
    opacities = torch.full((200,), 1 / 255)
    note = "the cut itself: rounding decides"
    yield _Case("opacity", "1/255", _with(base, opacities=opacities), compared=False, note=note)


def _pile_up() -> Iterator[_Case]:
    for count in (1000, 5000, 20_000):
        base = _base(count, 16, 12)
        means = base["means"] * torch.tensor([1e-4, 1e-4, 1.0])
        scales = torch.full_like(base["scales"], 1e-3)
        for name, factor in (("faint", 0.02), ("opaque", 1.0)):
            changed = _with(base, means=means, scales=scales, opacities=base["opacities"] * factor)
            yield _Case("Gaussians on one pixel", f"{count} {name}", changed)


def _image_sizes() -> Iterator[_Case]:
    for width, height in ((1, 1), (2, 3), (4095, 1), (3, 4096), (4096, 9), (4096, 4096)):
        base = _base(200, width, height)
        K = torch.tensor([[60.0, 0, width / 2], [0, 60.0, height / 2], [0, 0, 1]])[None]
        yield _Case("image", f"{width}x{height}", _with(base, Ks=K), compared=width * height < 50_000)


def _far_means() -> Iterator[_Case]:
    base = _base()
    for factor in (1e2, 1e4):
        grown = _with(base, means=base["means"] * factor, scales=base["scales"] * factor)
        yield _Case("means", f"scene times {factor:g}", grown)
        yield _Case("means", f"positions times {factor:g}", _with(base, means=base["means"] * factor))
    for offset in (1e2, 1e4):
        # Scene and rotated camera far from the origin: large terms of the pose cancel.
        turn = torch.tensor([[0.0, -0.3, 0.2], [0.3, 0.0, -0.1], [-0.2, 0.1, 0.0]])
        viewmat = torch.eye(4)
        viewmat[:3, :3] = torch.linalg.matrix_exp(turn)
        shift = torch.tensor([offset, -offset, offset])
        viewmat[:3, 3] = torch.tensor([0.0, 0.0, 0.3]) - viewmat[:3, :3] @ shift
        moved = _with(base, means=base["means"] + shift, viewmats=viewmat[None])
        yield _Case("means", f"scene and camera {offset:g} from the origin", moved)
    yield _Case("means", "times 1e30", _with(base, means=base["means"] * 1e30), compared=False)


def _depths() -> Iterator[_Case]:
    base = _with(_base(), viewmats=torch.eye(4)[None])
    for groups in (1, 2, 20):
        means = base["means"].clone()
        means[:, 2] = 2.0 + 0.25 * (torch.arange(200) % groups)
        yield _Case("duplicate depths", f"{200 // groups} each", _with(base, means=means))


def _focal_lengths() -> Iterator[_Case]:
    base = _base()
    for focal in (0.1, 1e3, 1e5):
        K = base["Ks"].clone()
        K[0, 0, 0] = K[0, 1, 1] = focal
        yield _Case("focal length", f"{focal:g} px", _with(base, Ks=K))


def _lenses() -> Iterator[_Case]:
    base = _with(_base(), viewmats=torch.eye(4)[None])
    lenses = {
        "barrel of 170 degrees": RadialLens((-0.21, 0.04, 0.008, -0.003), LARGEST_ANGLE_RAD),
        "nearly folding back": RadialLens((-0.149, 0.0, 0.0, 0.0), LARGEST_ANGLE_RAD),
        "pincushion of 60 degrees": RadialLens((0.4, 0.3, 0.2, 0.1), math.radians(30)),
        "10 degrees": RadialLens((2.0, 0.0, 0.0, 0.0), math.radians(5)),
    }
    for name, lens in lenses.items():
        yield _Case("lens", name, base, lens=lens)
    barrel = lenses["barrel of 170 degrees"]
    for share in (1e-20, 1e-6, 1e-3):
        means = base["means"] * torch.tensor([share, share, 1.0])
        yield _Case("lens", f"{share:g} from its axis", _with(base, means=means), lens=barrel)
    slope = base["means"][:, :2].norm(dim=1, keepdim=True)
    for degrees in (23.0, 60.0, 84.9, 85.1, 87.9):
        z = slope / math.tan(math.radians(degrees))
        means = torch.cat([base["means"][:, :2], z], dim=1)
        yield _Case("lens", f"{degrees:g} degrees from its axis", _with(base, means=means), lens=barrel)
    means = torch.cat([base["means"][:, :2], slope * torch.linspace(-0.1, 0.1, len(slope))[:, None]], dim=1)
    yield _Case("lens", "beside and behind", _with(base, means=means), compared=False, lens=barrel)


def _colors() -> Iterator[_Case]:
    base = _base()
    for factor in (0.0, 1e4):
        yield _Case("harmonics", f"times {factor:g}", _with(base, sh=base["sh"] * factor))
    yield _Case("harmonics", "times 1e30", _with(base, sh=base["sh"] * 1e30), compared=False)


def _counts() -> Iterator[_Case]:
    for count in (0, 1, 17):
        base = _base(200)
        changed = {name: value[:count] if name in LEARNED else value for name, value in base.items()}
        yield _Case("number of Gaussians", str(count), changed)


AXES: dict[str, Callable[[], Iterator[_Case]]] = {
    "scale": _scales,
    "needle": _needles,
    "flat": _flat,
    "quaternion length": _quaternions,
    "near plane": _near_plane,
    "opacity": _opacities,
    "Gaussians on one pixel": _pile_up,
    "image": _image_sizes,
    "means": _far_means,
    "duplicate depths": _depths,
    "focal length": _focal_lengths,
    "lens": _lenses,
    "harmonics": _colors,
    "number of Gaussians": _counts,
}
"""Cases by the quantity that takes extreme values."""

REFUSED = "not finite"
"""A further axis: non-finite inputs, which must be rejected."""


def _refusals() -> Iterator[dict[str, Any]]:
    """NaN and infinity in every input: must raise an error that names the array."""
    for name in (*LEARNED, "viewmats", "Ks"):
        for value in (math.nan, math.inf):
            scene = _base(20, 16, 12)
            scene[name] = scene[name].clone()
            scene[name].view(-1)[-1] = value
            found = {"axis": REFUSED, "value": f"{value} in {name}", "error": None}
            try:
                _outputs_and_gradients(scene, "native", torch.float32)
            except NonFiniteError as error:
                yield {**found, "ok": name in str(error), "note": str(error)}
            else:
                yield {**found, "ok": False, "note": "was rendered"}
