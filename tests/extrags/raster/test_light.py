"""The light a camera carries, inside the rasteriser."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from extrags.errors import NonFiniteError
from extrags.raster import CameraLight, set_num_threads
from extrags.raster.light import (
    ROUGHNESS_MIN,
    add_glare,
    apply_response,
    invert_response,
    light_gain,
    lit_colors,
    remove_glare,
    shortest_axes,
    specular_gain,
)
from tests.extrags.raster.scenes import RasterScene, relative_l2, tube, weighted_sum

LEARNED = (
    "exposure",
    "softening",
    "exponent",
    "spread",
    "cosine",
    "offset",
    "shoulder",
    "specular",
    "roughness",
    "glare",
)


def a_light(
    cameras: int, dtype: torch.dtype, *, gradients: bool = False, specular: float = 0.4
) -> CameraLight:
    generator = torch.Generator().manual_seed(3)
    values = {
        "exposure": 0.8 + 0.4 * torch.rand(cameras, 3, generator=generator),
        "softening": torch.tensor(0.3),
        "exponent": torch.tensor(0.7),
        "spread": torch.tensor(0.6),
        "cosine": torch.tensor(0.5),
        "offset": torch.tensor([0.08, -0.05, 0.03]),
        "shoulder": torch.tensor(0.8),
        "specular": torch.tensor(specular),
        "roughness": torch.tensor(0.3),
        "glare": torch.tensor([0.08, 0.03, 0.05]),
    }
    leaves = {k: v.to(dtype).requires_grad_(gradients) for k, v in values.items()}
    return CameraLight(**leaves, reference_distance=1.7)


def rendered(
    scene: RasterScene, backend: str, dtype: torch.dtype, specular: float = 0.4
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    leaves = scene.to(dtype, gradients=True)
    light = a_light(len(scene.viewmats), dtype, gradients=True, specular=specular)
    rendering = leaves.render(backend, light=light)
    weighted_sum(rendering).backward()
    gradients = {name: leaf.grad for name, leaf in leaves.leaves() if leaf.grad is not None}
    gradients |= {name: getattr(light, name).grad for name in LEARNED}
    images = {"rgb": rendering.rgb, "alpha": rendering.alpha, "depth": rendering.depth}
    return images, gradients


@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(tube(700, 67, 45, cameras=2), id="degree3-two-cameras"),
        pytest.param(tube(300, 64, 48, sh_degree=2), id="degree2"),
        pytest.param(tube(333, 33, 50, sh_degree=1), id="degree1"),
        pytest.param(tube(200, 40, 30, sh_degree=0), id="degree0"),
        pytest.param(tube(400, 45, 40, sh_degree=None, cameras=3, colors_per_camera=True), id="colors"),
    ],
)
def test_native_equals_reference(scene: RasterScene, isa: str) -> None:
    found, found_gradients = rendered(scene, "native", torch.float32)
    expected, expected_gradients = rendered(scene, "reference", torch.float64)
    for name, image in expected.items():
        assert relative_l2(found[name], image) < 1e-5, name
    assert set(found_gradients) == set(expected_gradients)
    for name, gradient in expected_gradients.items():
        assert relative_l2(found_gradients[name], gradient) < 1e-3, name


def test_native_equals_reference_without_highlights(isa: str) -> None:
    scene = tube(700, 67, 45, cameras=2)
    found, found_gradients = rendered(scene, "native", torch.float32, specular=0.0)
    expected, expected_gradients = rendered(scene, "reference", torch.float64, specular=0.0)
    assert relative_l2(found["rgb"], expected["rgb"]) < 1e-5
    for name, gradient in expected_gradients.items():
        if name not in ("specular", "roughness"):
            assert relative_l2(found_gradients[name], gradient) < 1e-4, name


def test_same_bits_on_any_number_of_threads(isa: str, threads: None) -> None:
    scene = tube(3000, 130, 101, cameras=2, seed=7)
    results = []
    for count in (1, 3, 8):
        set_num_threads(count)
        images, gradients = rendered(scene, "native", torch.float32)
        results.append([*images.values(), *gradients.values()])
    for other in results[1:]:
        for first, second in zip(results[0], other, strict=True):
            assert torch.equal(first, second)


def test_gradients_of_the_formula() -> None:
    generator = torch.Generator().manual_seed(0)
    albedo = torch.rand(5, 3, generator=generator, dtype=torch.float64).requires_grad_()
    points = torch.randn(5, 3, generator=generator, dtype=torch.float64) + torch.tensor([0, 0, 2.5])
    normals = torch.nn.functional.normalize(
        torch.randn(5, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    row = a_light(1, torch.float64).packed()[0].detach().requires_grad_()
    inputs = (albedo, points.requires_grad_(), normals.requires_grad_(), row)
    # The reference distance is a gauge: its column carries a gradient only in torch.
    assert torch.autograd.gradcheck(lit_colors, inputs)


def test_the_gauge() -> None:
    """At the reference distance, on the axis, facing the lamp, a lit colour is exposure times albedo."""
    light = a_light(1, torch.float64)
    light = CameraLight(
        exposure=torch.full((1, 3), 1.0, dtype=torch.float64),
        **{name: getattr(light, name) for name in ("softening", "exponent", "spread", "cosine", "shoulder")},
        offset=torch.zeros(3, dtype=torch.float64),
        reference_distance=1.7,
    )
    ahead = torch.tensor([[0.0, 0.0, 1.7]], dtype=torch.float64)
    facing = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
    row = light.packed()[0]
    assert light_gain(ahead, facing, row) == pytest.approx(1, abs=1e-12)
    one = torch.ones(1, 3, dtype=torch.float64)
    torch.testing.assert_close(lit_colors(one, ahead, facing, row), one)


def test_a_neutral_light_changes_nothing_but_rounding() -> None:
    scene = tube(300, 40, 30)
    zero, one = torch.zeros(()), torch.ones(())
    neutral = CameraLight(torch.ones(1, 3), one, zero, zero, zero, torch.zeros(3), zero, 1.0)
    plain, lit = scene.render("native"), scene.render("native", light=neutral)
    torch.testing.assert_close(plain.rgb, lit.rgb, atol=0, rtol=2e-6)


def test_inverse_square_far_from_the_lamp() -> None:
    zero, one = torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)
    light = CameraLight(
        torch.ones(1, 3, dtype=torch.float64), zero, one, zero, zero, zero.expand(3), zero, 1.0
    )
    points = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 4.0], [3.0, 0.0, 4.0]], dtype=torch.float64)
    gain = light_gain(points, None, light.packed()[0])
    torch.testing.assert_close(gain, torch.tensor([1 / 4, 1 / 16, 1 / 25], dtype=torch.float64))


def test_response_and_its_inverse() -> None:
    signal = torch.linspace(0, 3, 50, dtype=torch.float64)
    shoulder = torch.tensor(0.8, dtype=torch.float64)
    image = apply_response(signal, shoulder)
    assert image[0] == 0
    assert torch.all(image.diff() > 0)
    torch.testing.assert_close(invert_response(image, shoulder), signal)


@pytest.mark.parametrize("glare", [0.0, 1e-30, 0.1])
def test_glare_and_its_inverse_have_finite_gradients(glare: float) -> None:
    veil = torch.tensor(glare, requires_grad=True)
    image = torch.tensor([0.0, 1e-20, 0.1, 0.3, 1.0], requires_grad=True)
    shown = add_glare(image, veil)
    clear = remove_glare(image, veil)
    assert float(shown[0].detach()) == pytest.approx(glare)
    # The bound of rounding grows where squares cancel.
    torch.testing.assert_close(remove_glare(shown, veil), image, atol=1e-6, rtol=1e-5)
    (shown.sum() + clear.sum()).backward()
    assert image.grad is not None
    assert veil.grad is not None
    assert bool(image.grad.isfinite().all())
    assert bool(veil.grad.isfinite())
    assert bool((remove_glare(torch.tensor([-0.3, 0.5 * glare]), veil) <= 0.5e-30).all())


def test_normals_are_the_shortest_axes() -> None:
    generator = torch.Generator().manual_seed(1)
    quats = torch.randn(6, 4, generator=generator, dtype=torch.float64)
    scales = torch.rand(6, 3, generator=generator, dtype=torch.float64) + 0.1
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    columns = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1),
        torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], -1),
        torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    expected = torch.stack(columns, 1)[torch.arange(6), scales.argmin(1)]
    torch.testing.assert_close(shortest_axes(quats, scales), expected)


@pytest.mark.parametrize("distance", [1e-4, 1e-2, 1e4, 1e12, 1e19])
def test_extreme_distances_stay_finite(distance: float, isa: str) -> None:
    scene = tube(64, 24, 20, seed=4).to(torch.float32, gradients=True)
    light = a_light(1, torch.float32, gradients=True)
    far = CameraLight(**{n: getattr(light, n) for n in LEARNED}, reference_distance=distance)
    rendering = scene.render("native", light=far)
    weighted_sum(rendering).backward()
    assert torch.isfinite(rendering.rgb).all()
    for name, leaf in scene.leaves():
        assert leaf.grad is None or torch.isfinite(leaf.grad).all(), name
    for name in LEARNED:
        assert torch.isfinite(getattr(light, name).grad).all(), name


def test_a_light_that_is_not_finite_is_refused() -> None:
    scene = tube(20, 16, 12)
    light = a_light(1, torch.float32)
    broken = CameraLight(
        **{n: getattr(light, n) for n in LEARNED if n != "spread"},
        spread=torch.tensor(float("nan")),
        reference_distance=1.0,
    )
    with pytest.raises(NonFiniteError, match="light"):
        scene.render("native", light=broken)


def test_highlights_are_the_distribution_of_ggx() -> None:
    """Against the distribution as it is published, over its own peak, and whatever the albedo."""
    light = a_light(1, torch.float64)
    row = light.packed()[0].clone()
    row[7:10] = 0
    angles = torch.linspace(0, 1.5, 40, dtype=torch.float64)
    normals = torch.stack([torch.sin(angles), torch.zeros_like(angles), torch.cos(angles)], dim=1)
    points = torch.tensor([[0.0, 0.0, 1.2]], dtype=torch.float64).expand(40, 3)
    squared = 0.3**2
    density = squared / (torch.pi * (torch.cos(angles) ** 2 * (squared - 1) + 1) ** 2)
    arriving = light_gain(points[:1], None, row)
    expected = 0.4 * arriving * density / density[0]
    torch.testing.assert_close(specular_gain(points, normals, row), expected)
    black = torch.zeros(40, 3, dtype=torch.float64)
    clear = remove_glare(lit_colors(black, points, normals, row), row[13:16])
    torch.testing.assert_close(invert_response(clear, row[10]), expected[:, None] * row[:3])


def test_glare_is_what_black_surfaces_show_whatever_the_exposure(isa: str) -> None:
    scene = tube(64, 24, 20, seed=4, sh_degree=None).to(torch.float32)
    light = a_light(1, torch.float32, specular=0.0)
    black = replace(scene, colors=torch.zeros_like(scene.colors), background=torch.zeros(3))
    for exposure in (0.5, 2.0):
        brighter = replace(light, exposure=torch.full((1, 3), exposure))
        rendering = black.render("native", light=brighter)
        assert float(rendering.alpha.max()) > 0.5
        torch.testing.assert_close(
            rendering.rgb, rendering.alpha[..., None] * light.glare, atol=1e-6, rtol=1e-5
        )


@pytest.mark.parametrize(("roughness", "held"), [(1e-9, ROUGHNESS_MIN), (1.7, 1.0)])
def test_a_roughness_is_held_between_its_bounds(roughness: float, held: float, isa: str) -> None:
    scene = tube(64, 24, 20, seed=4).to(torch.float32, gradients=True)
    light = a_light(1, torch.float32, gradients=True)
    beyond, bound = (
        CameraLight(
            **{n: getattr(light, n) for n in LEARNED if n != "roughness"},
            roughness=torch.tensor(value).requires_grad_(),
            reference_distance=1.7,
        )
        for value in (roughness, held)
    )
    rendering = scene.render("native", light=beyond)
    assert torch.equal(rendering.rgb, scene.render("native", light=bound).rgb)
    assert relative_l2(rendering.rgb, scene.render("reference", light=beyond).rgb) < 1e-5
    weighted_sum(rendering).backward()
    assert beyond.roughness.grad == 0


def test_without_strength_there_are_no_highlights_and_no_gradient_of_their_shape(isa: str) -> None:
    scene = tube(64, 24, 20, seed=4).to(torch.float32, gradients=True)
    light = a_light(1, torch.float32, gradients=True)
    kept = {n: getattr(light, n) for n in LEARNED if n not in ("specular", "roughness")}
    roughness = torch.tensor(0.3).requires_grad_()
    matt = CameraLight(**kept, reference_distance=1.7)
    none = replace(matt, specular=torch.zeros(()).requires_grad_(), roughness=roughness)
    rendering = scene.render("native", light=none)
    assert torch.equal(rendering.rgb, scene.render("native", light=matt).rgb)
    weighted_sum(rendering).backward()
    assert roughness.grad == 0
