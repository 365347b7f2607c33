"""Inputs at the edges of what float32 can hold: nothing that leaves a kernel may be NaN or infinite."""

from __future__ import annotations

import math
from collections.abc import Callable

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from torch import Tensor

from extrags.raster import Rendering
from tests.extrags.raster.scenes import RasterScene, relative_l2, tube, weighted_sum

Change = Callable[[RasterScene], dict[str, Tensor]]


def _changed(scene: RasterScene, **values: object) -> RasterScene:
    return RasterScene(**{**vars(scene), **values})  # type: ignore[arg-type]


def _assert_finite(scene: RasterScene) -> Rendering:
    leaves = scene.to(torch.float32, gradients=True)
    rendering = leaves.render("native", visibility=True, median_depth=True, absgrad=True)
    weighted_sum(rendering).backward()
    for name in ("rgb", "alpha", "depth", "median_depth", "means2d", "radius_px", "visibility_sum"):
        assert bool(getattr(rendering, name).isfinite().all()), name
    for name, leaf in leaves.leaves():
        assert leaf.grad is None or bool(leaf.grad.isfinite().all()), f"gradient of {name}"
    assert rendering.means2d.grad is not None
    assert bool(rendering.means2d.grad.isfinite().all())
    alpha = rendering.alpha.detach()
    assert 0 <= float(alpha.min()) <= float(alpha.max()) <= 1
    return rendering


def _scale(value: float) -> Change:
    return lambda scene: {"scales": torch.full_like(scene.scales, value)}


def _needles(scene: RasterScene) -> dict[str, Tensor]:
    return {"scales": torch.tensor([3.0, 1e-6, 1e-6]).expand(len(scene.scales), 3).clone()}


def _flakes(scene: RasterScene) -> dict[str, Tensor]:
    return {"scales": torch.tensor([0.5, 0.5, 0.0]).expand(len(scene.scales), 3).clone()}


def _grazing(scene: RasterScene) -> dict[str, Tensor]:
    """At, just behind and just beyond the near plane of an identity camera, far to the sides too."""
    means = scene.means.clone()
    near = 0.01
    means[:, 2] = torch.tensor([near, near * (1 - 1e-6), near * (1 + 1e-6), -near])[
        torch.arange(len(means)) % 4
    ]
    means[::2, 0] *= 100
    return {"means": means, "viewmats": torch.eye(4)[None]}


CHANGES: dict[str, Change] = {
    "scales 0": _scale(0.0),
    "scales 1e-20": _scale(1e-20),
    "scales 1e4": _scale(1e4),
    "scales 1e18": _scale(1e18),
    "scales 1e38": _scale(1e38),
    "needles": _needles,
    "flakes": _flakes,
    "quats 0": lambda s: {"quats": torch.zeros_like(s.quats)},
    "quats 1e-20": lambda s: {"quats": s.quats * 1e-20},
    "quats 1e-38": lambda s: {"quats": s.quats * 1e-38},
    "quats 1e37": lambda s: {"quats": s.quats * 1e37},
    "opacities 0": lambda s: {"opacities": torch.zeros_like(s.opacities)},
    "opacities 1": lambda s: {"opacities": torch.ones_like(s.opacities)},
    "opacities at the cut": lambda s: {"opacities": torch.full_like(s.opacities, 1 / 255)},
    "opacities 1e-38": lambda s: {"opacities": torch.full_like(s.opacities, 1e-38)},
    "grazing the near plane": _grazing,
    "behind": lambda s: {"means": s.means * torch.tensor([1.0, 1.0, -1.0]) - torch.tensor([0, 0, 1.0])},
    "far": lambda s: {"means": s.means * 1e4},
    "very far": lambda s: {"means": s.means * 1e30},
    "far and large": lambda s: {"means": s.means * 1e4, "scales": s.scales * 1e4},
    "on the camera": lambda s: {"means": torch.zeros_like(s.means), "viewmats": torch.eye(4)[None]},
    "colours 1e30": lambda s: {"sh": None if s.sh is None else s.sh * 1e30},  # type: ignore[dict-item]
}


@pytest.mark.parametrize("case", CHANGES)
def test_stays_finite(case: str, isa: str) -> None:
    scene = tube(203, 45, 38, seed=3)
    changed = _changed(scene, **CHANGES[case](scene))
    if case == "colours 1e30":
        # The sum of the products must be finite for the statement to make sense.
        leaves = changed.to(torch.float32, gradients=True)
        rendering = leaves.render("native")
        assert bool(rendering.rgb.isfinite().all())
        (rendering.rgb * 1e-30).mean().backward()
        assert all(leaf.grad is None or bool(leaf.grad.isfinite().all()) for _, leaf in leaves.leaves())
    else:
        _assert_finite(changed)


@pytest.mark.parametrize(
    "case",
    ["scales 0", "scales 1e4", "needles", "flakes", "quats 0", "quats 1e-20", "quats 1e37", "opacities 1"],
)
def test_extremes_equal_the_reference(case: str) -> None:
    scene = tube(60, 24, 20, seed=3)
    changed = _changed(scene, **CHANGES[case](scene))
    found = changed.render("native")
    expected = changed.to(torch.float64).render("reference")
    assert torch.equal(found.visible, expected.visible)
    assert relative_l2(found.rgb, expected.rgb) < 3e-4
    assert relative_l2(found.depth, expected.depth) < 3e-4


def test_thousands_of_gaussians_on_one_pixel(isa: str) -> None:
    scene = tube(5000, 16, 12, seed=1)
    means = scene.means * torch.tensor([1e-4, 1e-4, 1.0])
    crowded = _changed(
        scene, means=means, scales=torch.full_like(scene.scales, 1e-3), opacities=scene.opacities * 0.02
    )
    rendering = _assert_finite(crowded)
    expected = crowded.to(torch.float64).render("reference")
    assert relative_l2(rendering.rgb, expected.rgb) < 1e-4


def test_duplicate_depths_keep_the_order_of_the_rows() -> None:
    scene = tube(300, 40, 30, seed=2)
    means = scene.means.clone()
    means[:, 2] = 2.0
    flat = _changed(scene, means=means, viewmats=torch.eye(4)[None])
    expected = flat.to(torch.float64).render("reference")
    assert relative_l2(flat.render("native").rgb, expected.rgb) < 1e-5


def test_large_and_narrow_images(isa: str) -> None:
    for width, height in ((4096, 9), (3, 4096), (1, 1), (4095, 1)):
        scene = tube(200, width, height, sh_degree=0)
        K = torch.tensor([[60.0, 0, width / 2], [0, 60.0, height / 2], [0, 0, 1]])[None]
        _assert_finite(_changed(scene, Ks=K))


@pytest.mark.slow
def test_a_whole_image_of_4096_pixels_a_side() -> None:
    scene = tube(3000, 4096, 4096, sh_degree=0)
    _assert_finite(scene)


def _log_uniform(generator: torch.Generator, low: float, high: float, *shape: int) -> Tensor:
    exponent = torch.rand(shape, generator=generator) * (math.log10(high) - math.log10(low)) + math.log10(low)
    return torch.pow(10.0, exponent)


def _wild(seed: int) -> RasterScene:
    """Every parameter over its whole plausible range and far beyond, all in one scene."""
    generator = torch.Generator().manual_seed(seed)
    n = int(torch.randint(1, 80, (), generator=generator))
    width, height = (int(v) for v in torch.randint(1, 50, (2,), generator=generator))
    reach = float(_log_uniform(generator, 1e-2, 1e4))
    K = torch.eye(3)[None].clone()
    K[0, 0, 0], K[0, 1, 1] = _log_uniform(generator, 1.0, 1e3, 2)
    K[0, 0, 2], K[0, 1, 2] = torch.rand(2, generator=generator) * torch.tensor([width, height]) * 1.5
    skew = torch.randn(3, 3, generator=generator)
    viewmat = torch.eye(4)[None].clone()
    viewmat[0, :3, :3] = torch.linalg.matrix_exp(skew - skew.T)
    viewmat[0, :3, 3] = torch.randn(3, generator=generator) * reach * 0.1
    return RasterScene(
        means=torch.randn(n, 3, generator=generator) * reach,
        quats=torch.randn(n, 4, generator=generator) * _log_uniform(generator, 1e-15, 1e15, n, 1),
        scales=_log_uniform(generator, 1e-8, 1e5, n, 3) * (torch.rand(n, 3, generator=generator) > 0.05),
        opacities=torch.rand(n, generator=generator).pow(float(_log_uniform(generator, 0.01, 100.0))),
        sh=torch.randn(n, 4, 3, generator=generator),
        colors=None,
        viewmats=viewmat,
        Ks=K,
        background=torch.rand(3, generator=generator),
        width=width,
        height=height,
    )


@given(st.integers(0, 2**31 - 1))
@settings(max_examples=150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
def test_random_scenes_stay_finite(seed: int) -> None:
    _assert_finite(_wild(seed))


@pytest.mark.slow
def test_ten_thousand_random_scenes_stay_finite() -> None:
    for seed in range(10_000):
        _assert_finite(_wild(seed))
