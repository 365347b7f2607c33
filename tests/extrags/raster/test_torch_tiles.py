"""The torch baseline against the specification."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from extrags.raster import torch_tiles
from extrags.raster.loss import l1_ssim_loss_reference
from extrags.raster.torch_tiles import TileImages, l1_ssim_loss_torch, rasterize_tiles, tile_gradients
from tests.extrags.raster.scenes import RasterScene, relative_l2, tube, weighted_sum

NAMES = ("means", "quats", "scales", "opacities", "sh")


def arguments(scene: RasterScene) -> dict[str, Tensor]:
    return {name: getattr(scene, name) for name in (*NAMES, "viewmats", "Ks")}


def on_black(n: int, width: int, height: int, dtype: torch.dtype, **changes: object) -> RasterScene:
    scene = tube(n, width, height)
    return RasterScene(**{**vars(scene), "background": None, **changes}).to(dtype, gradients=True)  # type: ignore[arg-type]


def weights_of(images: TileImages) -> TileImages:
    """Those of `weighted_sum`."""
    generator = torch.Generator().manual_seed(1)
    shapes = [value[None].shape for value in (images.rgb, images.alpha, images.depth)]
    drawn = [torch.randn(shape, generator=generator)[0].to(images.rgb.dtype) for shape in shapes]
    return TileImages(*drawn)


def specified(scene: RasterScene) -> tuple[TileImages, dict[str, Tensor]]:
    rendering = scene.render("reference")
    weighted_sum(rendering).backward()
    found = {name: getattr(scene, name).grad for name in NAMES}
    images = TileImages(rendering.rgb[0].detach(), rendering.alpha[0].detach(), rendering.depth[0].detach())
    return images, found


@pytest.mark.parametrize(("n", "width", "height"), [(300, 45, 38), (7, 8, 8), (150, 5, 3), (2000, 20, 17)])
def test_float64_is_the_specification(n: int, width: int, height: int) -> None:
    scene = on_black(n, width, height, torch.float64)
    images, gradients = specified(scene)
    found, streamed = tile_gradients(arguments(scene), width, height, weights_of(images))
    at_once = on_black(n, width, height, torch.float64)
    rendered = rasterize_tiles(arguments(at_once), width, height)
    cotangents = weights_of(images)
    sum((getattr(rendered, k) * getattr(cotangents, k)).sum() for k in ("rgb", "alpha", "depth")).backward()  # type: ignore[union-attr]
    for name in ("rgb", "alpha", "depth"):
        assert relative_l2(getattr(found, name), getattr(images, name)) < 1e-12
        assert relative_l2(getattr(rendered, name), getattr(images, name)) < 1e-12
    for name in NAMES:
        assert relative_l2(streamed[name], gradients[name]) < 1e-10
        assert relative_l2(getattr(at_once, name).grad, gradients[name]) < 1e-10


def test_float32_is_near_it() -> None:
    images, gradients = specified(on_black(600, 64, 48, torch.float64))
    scene = on_black(600, 64, 48, torch.float32)
    found, streamed = tile_gradients(arguments(scene), 64, 48, weights_of(images).__class__(
        *(value.float() for value in vars(weights_of(images)).values())
    ))  # fmt: skip
    assert relative_l2(found.rgb, images.rgb) < 1e-5
    for name in NAMES:
        assert relative_l2(streamed[name], gradients[name]) < 1e-3


def test_the_cut_into_layers_and_batches_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = on_black(2000, 20, 17, torch.float64)
    whole = rasterize_tiles(arguments(scene), 20, 17)
    monkeypatch.setattr(torch_tiles, "ENTRIES_PER_LAYER", 5)
    monkeypatch.setattr(torch_tiles, "ELEMENTS_PER_BATCH", 700)
    pieces = rasterize_tiles(arguments(scene), 20, 17)
    torch.testing.assert_close(pieces.rgb, whole.rgb, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(pieces.depth, whole.depth, rtol=1e-12, atol=1e-14)


def test_opaque_walls_end_the_lists_early() -> None:
    """Thousands behind an opaque front: stopped tiles change nothing."""
    scene = tube(3000, 20, 17)
    opaque = on_black(3000, 20, 17, torch.float64, opacities=torch.full_like(scene.opacities, 0.99))
    images, gradients = specified(opaque)
    found, streamed = tile_gradients(arguments(opaque), 20, 17, weights_of(images))
    assert relative_l2(found.rgb, images.rgb) < 1e-12
    assert relative_l2(streamed["sh"], gradients["sh"]) < 1e-10


def test_nothing_in_view() -> None:
    scene = tube(20, 16, 16)
    behind = on_black(20, 16, 16, torch.float64, means=-scene.means - torch.tensor([0, 0, 9.0]))
    rendered = rasterize_tiles(arguments(behind), 16, 16)
    assert float(rendered.alpha.detach().abs().max()) == 0
    rendered.rgb.sum().backward()
    assert float(behind.sh.grad.abs().max()) == 0  # type: ignore[union-attr]


@pytest.mark.parametrize("shape", [(20, 33), (11, 5), (64, 48)])
def test_loss_is_the_specified_one(shape: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(2)
    image, target = torch.rand(2, *shape, 3, generator=generator, dtype=torch.float64)
    first, second = (image.clone().requires_grad_() for _ in range(2))
    found, expected = l1_ssim_loss_torch(first, target), l1_ssim_loss_reference(second, target)
    torch.testing.assert_close(found, expected)
    found.backward()
    expected.backward()
    torch.testing.assert_close(first.grad, second.grad)
