"""Backends against each other, and the faces all of them share."""

from __future__ import annotations

import re
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from extrags.errors import ConfigError, MissingDependencyError, NonFiniteError, PoseError, ShapeError
from extrags.raster import Rendering, available_backends, native, rasterize, set_num_threads
from tests.extrags.raster.scenes import RasterScene, relative_l2, same_transmittance, tube, weighted_sum

IMAGES = ("rgb", "alpha", "depth", "means2d", "radius_px")
EXTRAS = ("median_depth", "visibility_max", "visibility_sum")


def _query_points(n: int = 400) -> Tensor:
    generator = torch.Generator().manual_seed(5)
    return torch.rand(n, 3, generator=generator) * torch.tensor([2.0, 2, 6]) - torch.tensor([1.0, 1, 0.5])


def _rendered(scene: RasterScene, backend: str, dtype: torch.dtype) -> tuple[Rendering, dict[str, Tensor]]:
    leaves = scene.to(dtype, gradients=True)
    rendering = leaves.render(
        backend,
        median_depth=True,
        visibility=True,
        absgrad=True,
        query_points=_query_points().to(dtype),
    )
    weighted_sum(rendering).backward()
    gradients = {name: leaf.grad for name, leaf in leaves.leaves() if leaf.grad is not None}
    gradients["means2d"] = rendering.means2d.grad  # type: ignore[assignment]
    gradients["absolute means2d"] = rendering.means2d.absgrad  # type: ignore[attr-defined]
    return rendering, gradients


@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(tube(700, 67, 45, cameras=2), id="degree3-two-cameras"),
        pytest.param(tube(300, 64, 48, sh_degree=2), id="degree2"),
        pytest.param(tube(333, 33, 50, sh_degree=1), id="degree1"),
        pytest.param(tube(17, 40, 30, sh_degree=0), id="degree0-few-large"),
        pytest.param(tube(400, 50, 41, sh_degree=None), id="colors"),
        pytest.param(
            tube(400, 45, 40, sh_degree=None, cameras=3, colors_per_camera=True), id="colors-per-camera"
        ),
        pytest.param(tube(50, 1, 1), id="one-pixel"),
    ],
)
def test_native_equals_reference(scene: RasterScene, isa: str) -> None:
    found, found_gradients = _rendered(scene, "native", torch.float32)
    expected, expected_gradients = _rendered(scene, "reference", torch.float64)
    for name in IMAGES:
        assert relative_l2(getattr(found, name), getattr(expected, name)) < 1e-5, name
    for name in EXTRAS:
        assert relative_l2(getattr(found, name), getattr(expected, name)) < 1e-4, name
    assert torch.equal(found.visible, expected.visible)
    same_transmittance(found, expected)
    assert set(found_gradients) == set(expected_gradients)
    for name, gradient in expected_gradients.items():
        assert relative_l2(found_gradients[name], gradient) < 1e-3, name


def _everything(scene: RasterScene) -> list[Tensor]:
    rendering, gradients = _rendered(scene, "native", torch.float32)
    tensors = [getattr(rendering, name) for name in (*IMAGES, *EXTRAS, "transmittance")]
    return [*tensors, *gradients.values()]


def test_same_bits_on_any_number_of_threads(isa: str, threads: None) -> None:
    scene = tube(3000, 130, 101, cameras=2, seed=7)
    results = []
    for count in (1, 2, 3, 8):
        set_num_threads(count)
        results.append(_everything(scene))
    for other in results[1:]:
        for first, second in zip(results[0], other, strict=True):
            assert torch.equal(first.nan_to_num(-1), second.nan_to_num(-1))


def test_same_bits_on_all_sets_with_fused_multiply_add() -> None:
    names = [name for name in native.usable_isas() if name != "portable"]
    if len(names) < 2:
        pytest.skip(f"this processor has only {names}")
    scene = tube(2000, 97, 83, seed=8)
    before = native.native_isa()
    results = []
    for name in names:
        native.set_native_isa(name)
        results.append(_everything(scene))
    native.set_native_isa(str(before))
    for first, second in zip(*results, strict=True):
        assert torch.equal(first.nan_to_num(-1), second.nan_to_num(-1))


def test_same_bits_from_concurrent_callers() -> None:
    scenes = [tube(500 + 100 * i, 70, 60, seed=i) for i in range(4)]
    alone = [_everything(scene) for scene in scenes]
    together: list[list[Tensor] | None] = [None] * len(scenes)

    def work(index: int) -> None:
        for _ in range(3):
            together[index] = _everything(scenes[index])

    workers = [threading.Thread(target=work, args=(i,)) for i in range(len(scenes))]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    for first, second in zip(alone, together, strict=True):
        assert second is not None
        for a, b in zip(first, second, strict=True):
            assert torch.equal(a.nan_to_num(-1), b.nan_to_num(-1))


@pytest.mark.parametrize("backend", ["native", "reference"])
@pytest.mark.parametrize("case", ["tiny_case", "basic_case"])
def test_equals_renders_of_gsplat(case: str, backend: str, shared_data: Path) -> None:
    """Images that gsplat's CUDA kernels made (published by the brush project)."""
    data = load_file(shared_data / "gsplat_reference_renders" / f"{case}.safetensors")
    height, width = data["out_img"].shape[:2]
    dtype = torch.float64 if backend == "reference" else torch.float32
    viewmat = torch.eye(4, dtype=dtype)
    viewmat[:3, 3] = -torch.tensor([0.123, 0.456, -8.0], dtype=dtype)
    K = torch.tensor([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]], dtype=dtype)
    rendering = rasterize(
        data["means"].to(dtype),
        data["quats"].to(dtype),
        data["scales"].to(dtype).exp(),
        data["opacities"].to(dtype).sigmoid(),
        data["coeffs"].to(dtype),
        viewmat[None],
        K[None],
        width,
        height,
        backend=backend,  # type: ignore[arg-type]
    )
    image = torch.cat([rendering.rgb[0], rendering.alpha[0][..., None]], -1)
    assert float((image - data["out_img"]).abs().max()) < 1e-5


def _visibility(scene: RasterScene, backend: str, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    rendering = scene.render(backend, visibility=True, visibility_mask=mask)
    assert rendering.visibility_max is not None
    assert rendering.visibility_sum is not None
    return rendering.visibility_max, rendering.visibility_sum


def _random_masks() -> Tensor:
    mask = torch.rand(2, 45, 67, generator=torch.Generator().manual_seed(3)) > 0.4
    mask[1, :, 30:] = False
    return mask


@pytest.mark.parametrize(("backend", "dtype"), [("native", torch.float32), ("reference", torch.float64)])
def test_visibility_of_a_mask_and_of_the_rest_make_the_whole(backend: str, dtype: torch.dtype) -> None:
    scene, mask = tube(700, 67, 45, cameras=2).to(dtype), _random_masks()
    largest, total = _visibility(scene, backend, None)
    inside, outside = (_visibility(scene, backend, part) for part in (mask, ~mask))
    assert torch.equal(torch.maximum(inside[0], outside[0]), largest)
    assert (inside[0] < largest).any()
    assert (outside[0] < largest).any()
    # The sums differ by the order they are added in.
    rounding = 67 * 45 * torch.finfo(dtype).eps
    torch.testing.assert_close(inside[1] + outside[1], total, rtol=rounding, atol=rounding)
    assert torch.equal(_visibility(scene, backend, mask | ~mask)[1], total)


def test_masked_visibility_equals_the_reference(isa: str) -> None:
    scene, mask = tube(700, 67, 45, cameras=2), _random_masks()
    found = _visibility(scene.to(torch.float32), "native", mask)
    expected = _visibility(scene.to(torch.float64), "reference", mask)
    for own, true in zip(found, expected, strict=True):
        # As the other extras of two backends.
        assert relative_l2(own, true) < 1e-4


def test_a_mask_without_visibility_is_refused() -> None:
    with pytest.raises(ConfigError, match="no visibility"):
        tube(20, 16, 12).render("native", visibility_mask=torch.ones(1, 12, 16, dtype=torch.bool))


def test_a_mask_of_another_size_is_refused() -> None:
    scene = tube(20, 16, 12)
    with pytest.raises(ShapeError, match="visibility_mask"):
        scene.render("native", visibility=True, visibility_mask=torch.ones(1, 16, 12, dtype=torch.bool))


@pytest.mark.parametrize("backend", ["native", "reference"])
@pytest.mark.parametrize("n", [0, 1, 15, 16, 17])
def test_any_number_of_gaussians(n: int, backend: str) -> None:
    scene = tube(n, 20, 18, sh_degree=1).to(torch.float32, gradients=True)
    rendering = scene.render(backend, visibility=True, median_depth=True)
    assert rendering.visible.shape == (1, n)
    weighted_sum(rendering).backward()
    assert scene.means.grad is None or bool(scene.means.grad.isfinite().all())
    if n == 0:
        torch.testing.assert_close(rendering.rgb[0, 3, 4], scene.background)


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_no_camera(backend: str) -> None:
    scene = tube(10, 8, 8)
    rendering = rasterize(
        *(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh),
        torch.zeros(0, 4, 4),
        torch.zeros(0, 3, 3),
        8,
        8,
        backend=backend,  # type: ignore[arg-type]
    )
    assert rendering.rgb.shape == (0, 8, 8, 3)


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_a_low_degree_ignores_the_higher_coefficients(backend: str) -> None:
    scene = tube(60, 24, 20).to(torch.float32, gradients=True)
    low = scene.render(backend, sh_degree=1)
    weighted_sum(low).backward()
    assert scene.sh is not None
    assert scene.sh.grad is not None
    assert float(scene.sh.grad[:, 4:].abs().max()) == 0
    assert float(scene.sh.grad[:, :4].abs().max()) > 0
    cut = scene.sh.detach()[:, :4].contiguous()
    same = rasterize(
        *(scene.means, scene.quats, scene.scales, scene.opacities, cut, scene.viewmats, scene.Ks),
        scene.width,
        scene.height,
        background=scene.background,
        backend=backend,  # type: ignore[arg-type]
    )
    assert torch.equal(low.rgb, same.rgb)


def test_strided_inputs_are_welcome() -> None:
    scene = tube(100, 30, 20)
    strided = RasterScene(**{**vars(scene), "means": scene.means.T.contiguous().T})
    assert torch.equal(strided.render("native").rgb, scene.render("native").rgb)


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_a_query_ends_where_its_pixel_does(backend: str, isa: str) -> None:
    """Also where no other pixel of the block composites the Gaussian that ends it."""
    focal, centre = 100.0, 2.0
    gaussians = []

    def put(column: float, row: float, depth: float, size_px: float, opacity: float) -> None:
        mean = [(column - centre) / focal * depth, (row - centre) / focal * depth, depth]
        gaussians.append((mean, [size_px * depth / focal] * 3, opacity))

    # The neighbours of pixel (0, 0) have ended when the Gaussian comes that ends it; pixel (3, 3) is open.
    for layer in range(6):
        for column, row in ((1.5, 0.5), (0.5, 1.5), (1.5, 1.5)):
            put(column, row, 1 + 0.1 * layer, 0.01, 0.9985)
    put(0.5, 0.5, 2.0, 0.01, 0.9985)
    for depth in (3.0, 3.1, 3.2, 3.3, 3.4):
        put(2.0, 2.0, depth, 50.0, 0.5)
    means, scales, opacities = (torch.tensor(column) for column in zip(*gaussians, strict=True))
    n = len(means)
    rendering = rasterize(
        means,
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        scales,
        opacities,
        None,
        torch.eye(4)[None],
        torch.tensor([[[focal, 0, centre], [0, focal, centre], [0, 0, 1]]]),
        4,
        4,
        colors=torch.ones(n, 3),
        query_points=torch.tensor([[(0.5 - centre) / focal * 5, (0.5 - centre) / focal * 5, 5.0]]),
        backend=backend,  # type: ignore[arg-type]
    )
    assert rendering.transmittance is not None
    assert float(rendering.alpha[0, 3, 3]) > 0.9
    left = 1 - float(rendering.alpha[0, 0, 0])
    assert float(rendering.transmittance[0, 0]) == pytest.approx(left, abs=1e-6)


def test_without_gradients_nothing_is_kept() -> None:
    scene = tube(100, 30, 20).to(torch.float32, gradients=True)
    with torch.no_grad():
        rendering = scene.render("native")
    assert not rendering.rgb.requires_grad


def test_backward_twice_adds_up() -> None:
    scene = tube(80, 30, 20).to(torch.float32, gradients=True)
    rendering = scene.render("native")
    rendering.rgb.sum().backward(retain_graph=True)
    assert rendering.means2d.grad is not None
    once, centres = scene.means.grad, rendering.means2d.grad.clone()
    assert once is not None
    once = once.clone()
    rendering.rgb.sum().backward()
    torch.testing.assert_close(scene.means.grad, 2 * once)
    torch.testing.assert_close(rendering.means2d.grad, 2 * centres)


class TestErrors:
    @pytest.mark.parametrize(
        ("name", "shape"),
        [
            ("quats", (10, 3)),
            ("scales", (9, 3)),
            ("opacities", (10, 1)),
            ("sh", (10, 5, 3)),
            ("viewmats", (4, 4)),
            ("Ks", (2, 3, 3)),
            ("background", (4,)),
        ],
    )
    def test_shapes_by_name(self, name: str, shape: tuple[int, ...], unchecked: None) -> None:
        scene = tube(10, 8, 8)
        bad = RasterScene(**{**vars(scene), name: torch.ones(shape)})
        with pytest.raises(ShapeError, match=name):
            bad.render("native")

    def test_size_degree_dtype(self, unchecked: None) -> None:
        scene = tube(10, 8, 8)
        with pytest.raises(ShapeError, match="image size 0x8"):
            RasterScene(**{**vars(scene), "width": 0}).render("native")
        with pytest.raises(ShapeError, match="sh_degree is 4"):
            scene.render("native", sh_degree=4)
        with pytest.raises(ShapeError, match="near"):
            scene.render("native", near=0.0)
        with pytest.raises(ShapeError, match="quats has dtype"):
            RasterScene(**{**vars(scene), "quats": scene.quats.double()}).render("native")
        with pytest.raises(ShapeError, match="exactly one of sh and colors"):
            RasterScene(**{**vars(scene), "colors": torch.ones(10, 3)}).render("native")
        with pytest.raises(ShapeError, match="query_points"):
            scene.render("native", query_points=torch.ones(3))

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"means": np.zeros((10, 3), np.float32)}, "means is ndarray, expected Tensor"),
            ({"quats": np.zeros((10, 4), np.float32)}, "quats is ndarray, expected a torch tensor"),
            ({"viewmats": None}, "viewmats is NoneType, expected a torch tensor"),
            ({"background": [0.0, 0.0, 0.0]}, "background is list, expected a torch tensor"),
            ({"width": 32.0}, "width is 32.0, expected a whole number of pixels"),
            ({"height": "32"}, "height is '32', expected a whole number of pixels"),
        ],
    )
    def test_types_by_name(self, change: dict[str, Any], message: str, unchecked: None) -> None:
        with pytest.raises(ShapeError, match=re.escape(message)):
            RasterScene(**{**vars(tube(10, 8, 8)), **change}).render("native")

    @pytest.mark.parametrize("backend", ["native", "reference"])
    @pytest.mark.parametrize(
        ("change", "error", "message"),
        [
            ({"opacities": torch.full((10,), 1.5)}, ShapeError, "opacities are from 1.5 to 1.5"),
            ({"opacities": torch.full((10,), -0.5)}, ShapeError, "opacities are from -0.5 to -0.5"),
            ({"Ks": torch.zeros(1, 3, 3)}, ShapeError, "Ks[0] has the focal lengths 0 and 0 px"),
            ({"viewmats": torch.diag(torch.tensor([-1.0, 1, 1, 1]))[None]}, PoseError, "determinant -1.000"),
            (
                {"viewmats": torch.diag(torch.tensor([2.0, 2, 2, 1]))[None]},
                PoseError,
                "values [2.0, 2.0, 2.0]",
            ),
            ({"viewmats": torch.ones(1, 4, 4)}, PoseError, "the last row is [1.0, 1.0, 1.0, 1.0]"),
        ],
    )
    def test_values_that_mislead(
        self, change: dict[str, Any], error: type[Exception], message: str, backend: str
    ) -> None:
        with pytest.raises(error, match=re.escape(message)):
            RasterScene(**{**vars(tube(10, 8, 8)), **change}).render(backend)

    def test_opacities_may_be_rounded_to_their_limits(self) -> None:
        scene = tube(10, 8, 8)
        RasterScene(**{**vars(scene), "opacities": torch.linspace(0, 1, 10)}).render("native")

    @pytest.mark.parametrize("backend", ["native", "reference"])
    @pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
    @pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "sh", "viewmats", "Ks"])
    def test_non_finite_by_name(self, name: str, value: float, backend: str) -> None:
        scene = tube(40, 8, 8).to(torch.float32)
        array = getattr(scene, name)
        array.reshape(-1)[-2] = value
        with pytest.raises(NonFiniteError, match=rf"{name}\["):
            scene.render(backend)

    def test_backend(self, unchecked: None) -> None:
        scene = tube(10, 8, 8)
        with pytest.raises(ConfigError, match="backend is 'cuda'"):
            scene.render("cuda")
        with pytest.raises(ConfigError, match="float32 CPU"):
            scene.to(torch.float64).render("native")
        if "gsplat" not in available_backends():
            with pytest.raises((ConfigError, MissingDependencyError), match="gsplat"):
                scene.render("gsplat")

    def test_threads_and_sets(self) -> None:
        with pytest.raises(ConfigError, match="number of threads is 0"):
            set_num_threads(0)
        with pytest.raises(ConfigError, match="'sse9' is not usable here"):
            native.set_native_isa("sse9")


@pytest.mark.gpu
def test_gsplat_equals_native() -> None:
    if "gsplat" not in available_backends():
        pytest.skip("no CUDA device with gsplat")
    scene = tube(2000, 130, 101, cameras=2)
    expected = scene.to(torch.float32, gradients=True)
    rendering = expected.render("native", absgrad=True, visibility=True)
    weighted_sum(rendering).backward()
    moved = {k: v.cuda() if isinstance(v, Tensor) else v for k, v in vars(scene).items()}
    leaves = RasterScene(**moved).to(torch.float32, gradients=True)
    found = leaves.render("gsplat", absgrad=True, visibility=True)
    on_cpu = Rendering(**{k: v.cpu() if isinstance(v, Tensor) else v for k, v in vars(found).items()})
    weighted_sum(on_cpu).backward()
    for name in ("rgb", "alpha", "depth"):
        assert relative_l2(getattr(on_cpu, name), getattr(rendering, name)) < 1e-4, name
    for (name, leaf), (_, other) in zip(leaves.leaves(), expected.leaves(), strict=True):
        assert leaf.grad is not None
        assert other.grad is not None
        assert relative_l2(leaf.grad.cpu(), other.grad) < 1e-3, name
