"""Gaussians through a radial lens: kernels against the reference, the reference against the lens itself."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from extrags.errors import ConfigError
from extrags.radial_lens import RadialLens
from extrags.raster import CameraLight, Rendering, rasterize
from extrags.raster.gsplat import rasterize_gsplat
from extrags.raster.lens_projection import lens_gain, project_through_lens
from extrags.raster.rendering import RasterInputs, RasterOptions
from tests.extrags.raster.scenes import RasterScene, relative_l2, same_transmittance, tube, weighted_sum

LENS = RadialLens((-0.209, 0.0397, 0.00787, -0.00334), float(np.radians(80)))
NARROW = RadialLens((0.3, 0.2, -0.05, 0.1), float(np.radians(25)))
LIGHT = CameraLight(
    torch.tensor([[1.1, 0.9, 1.0]]).repeat(2, 1),
    *(torch.tensor(value) for value in (0.3, 1.2, 0.5, 0.8)),
    torch.tensor([0.1, -0.2, 0.05]),
    torch.tensor(0.2),
    1.0,
    torch.tensor(0.3),
    torch.tensor(0.4),
    torch.tensor([0.1, 0.05, 0.07]),
)


def _rendered(
    scene: RasterScene, backend: str, dtype: torch.dtype, lens: RadialLens, light: CameraLight | None
) -> tuple[Rendering, dict[str, torch.Tensor]]:
    leaves = scene.to(dtype, gradients=True)
    generator = torch.Generator().manual_seed(5)
    points = torch.rand(300, 3, generator=generator) * torch.tensor([2.0, 2, 6]) - torch.tensor([1, 1, 0.5])
    if light is not None:
        values = {
            name: value.to(dtype) if isinstance(value, torch.Tensor) else value
            for name, value in vars(light).items()
        }
        light = CameraLight(**values)
    rendering = leaves.render(
        backend, lens=lens, light=light, median_depth=True, visibility=True, query_points=points.to(dtype)
    )
    weighted_sum(rendering).backward()
    return rendering, {name: leaf.grad for name, leaf in leaves.leaves() if leaf.grad is not None}


@pytest.mark.parametrize("lit", [False, True])
@pytest.mark.parametrize("lens", [LENS, NARROW], ids=["wide", "narrow"])
def test_native_equals_reference(lens: RadialLens, lit: bool, isa: str) -> None:
    scene = tube(500, 67, 45, cameras=2)
    scene = replace(scene, Ks=scene.Ks * torch.tensor([0.6, 0.6, 1.0])[None, :, None])
    scene.Ks[:, :2, 2] /= 0.6
    light = LIGHT if lit else None
    found, found_gradients = _rendered(scene, "native", torch.float32, lens, light)
    expected, expected_gradients = _rendered(scene, "reference", torch.float64, lens, light)
    for name in ("rgb", "alpha", "depth", "means2d", "radius_px", "median_depth", "visibility_max"):
        assert relative_l2(getattr(found, name), getattr(expected, name)) < 1e-4, name
    assert torch.equal(found.visible, expected.visible)
    same_transmittance(found, expected)
    for name, gradient in expected_gradients.items():
        assert relative_l2(found_gradients[name], gradient) < 1e-3, name


def test_centres_are_those_of_opencv() -> None:
    scene = tube(300, 67, 45)
    rendering = scene.render("native", lens=LENS)
    means = scene.means.double().numpy()
    rotation, shift = scene.viewmats[0, :3, :3].double().numpy(), scene.viewmats[0, :3, 3].double().numpy()
    local = means @ rotation.T + shift
    local = local[rendering.visible[0].numpy()]
    pixels, _ = cv2.fisheye.projectPoints(
        local[:, None], np.zeros(3), np.zeros(3), scene.Ks[0].double().numpy(), np.array(LENS.coefficients)
    )
    inside = np.arctan2(np.hypot(*local[:, :2].T), local[:, 2]) < LENS.max_angle_rad
    found = rendering.means2d[0][rendering.visible[0]].numpy()
    assert inside.sum() > 100
    np.testing.assert_allclose(found[inside], pixels[inside, 0], atol=2e-4)


def _points(n: int) -> tuple[torch.Tensor, ...]:
    """Directions from the axis to 80 degrees, on both sides of where the series ends and r is linear."""
    generator = torch.Generator().manual_seed(3)
    angle = torch.linspace(0, 1.45, n, dtype=torch.float64)
    turn = 6.3 * torch.rand(n, generator=generator, dtype=torch.float64)
    distance = 0.2 + 3 * torch.rand(n, generator=generator, dtype=torch.float64)
    across = distance * angle.sin()
    return across * turn.cos(), across * turn.sin(), distance * angle.cos()


@pytest.mark.parametrize("lens", [LENS, NARROW], ids=["wide", "narrow"])
def test_jacobian_is_that_of_the_projection(lens: RadialLens) -> None:
    K = torch.tensor([[30.0, 0, 33], [0, 31, 24], [0, 0, 1]], dtype=torch.float64)
    x, y, z = _points(60)
    _, jacobian = project_through_lens(x, y, z, K, lens)
    step = 1e-6
    for axis in range(3):
        ahead, behind = [x, y, z], [x, y, z]
        ahead[axis], behind[axis] = ahead[axis] + step, behind[axis] - step
        slope = (project_through_lens(*ahead, K, lens)[0] - project_through_lens(*behind, K, lens)[0]) / (
            2 * step
        )
        assert relative_l2(slope, jacobian[:, :, axis]) < 1e-6


def test_reference_gradients_are_slopes() -> None:
    """Of the pixel and the Jacobian, which the covariance is made of, by central differences."""
    K = torch.tensor([[30.0, 0, 33], [0, 31, 24], [0, 0, 1]], dtype=torch.float64)
    points = tuple(value.requires_grad_() for value in _points(5))
    assert torch.autograd.gradcheck(lambda x, y, z: project_through_lens(x, y, z, K, LENS), points, eps=1e-6)
    square = torch.tensor([0.0, 1e-8, 0.1, 0.17, 0.19, 3.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda w: lens_gain(w, LENS), (square,), eps=1e-7)


def test_covariance_is_that_of_many_samples() -> None:
    """The footprint of a small Gaussian 60 degrees from the axis is the spread of its samples' pixels."""
    K = torch.tensor([[80.0, 0, 100], [0, 80, 100], [0, 0, 1]], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    axes = torch.tensor([[0.03, 0.01, 0], [0, 0.02, 0.015], [0.005, 0, 0.03]], dtype=torch.float64)
    mean = torch.tensor([1.5, 0.9, 1.0], dtype=torch.float64)
    samples = mean + torch.randn(200_000, 3, generator=generator, dtype=torch.float64) @ axes.T
    pixels, _ = project_through_lens(*samples.unbind(-1), K, LENS)
    _, jacobian = project_through_lens(*mean[:, None], K, LENS)
    half = jacobian[0] @ axes
    assert relative_l2(half @ half.T, torch.cov(pixels.T)) < 0.03


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_behind_and_beyond_is_culled(backend: str) -> None:
    means = torch.tensor(
        [[0.0, 0, -1], [5, 0, 0.02], [1e18, 0, 1e-2], [0, 3, -2], [0, 0, 1.0], [-30, 0, 0.5]],
        requires_grad=True,
    )
    n = len(means)
    rendering = rasterize(
        means,
        torch.eye(4)[:1].repeat(n, 1),
        torch.full((n, 3), 0.2),
        torch.full((n,), 0.9),
        None,
        torch.eye(4)[None],
        torch.tensor([[[10.0, 0, 16], [0, 10, 16], [0, 0, 1]]]),
        32,
        32,
        colors=torch.rand(n, 3),
        backend=backend,  # type: ignore[arg-type]
        lens=LENS,
    )
    assert rendering.visible[0].tolist() == [False, False, False, False, True, False]
    rendering.rgb.sum().backward()
    assert means.grad is not None
    for value in (rendering.rgb, rendering.depth, rendering.means2d, means.grad):
        assert bool(torch.isfinite(value).all())


def test_gsplat_refuses_a_lens() -> None:
    scene = tube(4, 8, 8, sh_degree=None)
    inputs = RasterInputs(
        scene.means,
        scene.quats,
        scene.scales,
        scene.opacities,
        None,
        scene.colors,
        scene.viewmats,
        scene.Ks,
        None,
        None,
    )
    with pytest.raises(ConfigError, match=r"ingest\.lens=pinhole"):
        rasterize_gsplat(inputs, RasterOptions(8, 8, 0, 0.01, False, False, False, LENS))
