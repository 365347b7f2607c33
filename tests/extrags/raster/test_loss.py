from __future__ import annotations

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from extrags.errors import ConfigError, ShapeError
from extrags.raster import l1_ssim_loss, native, set_num_threads
from extrags.raster.loss import l1_ssim_loss_reference
from tests.extrags.raster.scenes import relative_l2


def _images(*shape: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(*shape, generator=generator)
    return (target + 0.1 * torch.randn(*shape, generator=generator)).clamp(0, 1), target


def _with_gradient(function, image: torch.Tensor, *args, **options) -> tuple[torch.Tensor, torch.Tensor]:
    leaf = image.clone().requires_grad_()
    value = function(leaf, *args, **options)
    value.backward()
    assert leaf.grad is not None
    return value.detach(), leaf.grad


@pytest.mark.parametrize(
    "shape", [(48, 64, 3), (37, 53, 3), (1, 1, 3), (3, 200, 3), (90, 5, 3), (2, 40, 33, 3)]
)
@pytest.mark.parametrize("masked", [False, True])
def test_native_equals_reference(shape: tuple[int, ...], masked: bool, isa: str) -> None:
    image, target = _images(*shape)
    mask = None
    if masked:
        generator = torch.Generator().manual_seed(3)
        mask = torch.rand(*shape[:-1], generator=generator) * (
            torch.rand(*shape[:-1], generator=generator) > 0.3
        )
        mask[..., 0, 0] = 1.0
    value, gradient = _with_gradient(l1_ssim_loss, image, target, dssim_weight=0.3, mask=mask)
    wide = None if mask is None else mask.double()
    expected, expected_gradient = _with_gradient(
        l1_ssim_loss_reference, image.double(), target.double(), dssim_weight=0.3, mask=wide
    )
    assert float(value) == pytest.approx(float(expected), rel=2e-6)
    assert relative_l2(gradient, expected_gradient) < 1e-5


@pytest.mark.parametrize("shape", [(37, 53, 3), (3, 200, 3), (90, 5, 3), (2, 40, 33, 3)])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("normalisation", [None, 321.0])
def test_native_equals_reference_with_other_weights_for_ssim(
    shape: tuple[int, ...], masked: bool, normalisation: float | None, isa: str
) -> None:
    image, target = _images(*shape)
    mask, ssim_mask = (
        0.1 + torch.rand(*shape[:-1], generator=torch.Generator().manual_seed(seed)) for seed in (3, 4)
    )
    options = {"dssim_weight": 0.3, "normalisation": normalisation}
    value, gradient = _with_gradient(
        l1_ssim_loss, image, target, mask=mask if masked else None, ssim_mask=ssim_mask, **options
    )
    expected, expected_gradient = _with_gradient(
        l1_ssim_loss_reference,
        image.double(),
        target.double(),
        mask=mask.double() if masked else None,
        ssim_mask=ssim_mask.double(),
        **options,
    )
    assert float(value) == pytest.approx(float(expected), rel=2e-6)
    assert relative_l2(gradient, expected_gradient) < 1e-5


@pytest.mark.parametrize("function", [l1_ssim_loss, l1_ssim_loss_reference])
def test_what_weights_and_normalisation_mean(function) -> None:
    image, target = _images(12, 14, 3)
    weights = torch.rand(12, 14, generator=torch.Generator().manual_seed(3))

    def loss(factor: float, **options: float | torch.Tensor) -> float:
        return float(function(image, target, mask=factor * weights, **options))

    # The magnitude cancels in a weighted mean, and counts where the number of pixels is given.
    assert loss(0.1) == pytest.approx(loss(1), rel=1e-5)
    assert loss(0.1, normalisation=168.0) == pytest.approx(0.1 * loss(1, normalisation=168.0), rel=1e-5)
    # Weights of the SSIM term leave the L1 term alone, and the other way round.
    ones = torch.ones(12, 14)
    l1, dssim = (float(function(image, target, dssim_weight=w)) for w in (0.0, 1.0))
    options = {"normalisation": 168.0, "dssim_weight": 0.25}
    mixed = float(function(image, target, mask=0.5 * ones, ssim_mask=2 * ones, **options))
    assert mixed == pytest.approx(0.5 * 0.75 * l1 + 2 * 0.25 * dssim, rel=1e-5)


def test_ssim_weights_equal_to_the_mask_change_no_bit(isa: str) -> None:
    image, target = _images(40, 50, 3)
    mask = torch.rand(40, 50, generator=torch.Generator().manual_seed(3))
    value, gradient = _with_gradient(l1_ssim_loss, image, target, mask=mask)
    total = float(mask.sum(dtype=torch.float64))
    for options in ({"ssim_mask": mask}, {"ssim_mask": mask.clone(), "normalisation": total}):
        other, other_gradient = _with_gradient(l1_ssim_loss, image, target, mask=mask, **options)
        assert torch.equal(value, other)
        assert torch.equal(gradient, other_gradient)


def test_ssim_is_that_of_scikit_image() -> None:
    """Inside, five pixels from the border, where padding plays no part."""
    image, target = _images(40, 50, 3)
    inner = torch.zeros(40, 50)
    inner[5:-5, 5:-5] = 1
    loss = l1_ssim_loss(image, target, dssim_weight=1.0, mask=inner)
    _, ssim_map = structural_similarity(
        image.double().numpy(),
        target.double().numpy(),
        channel_axis=-1,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    expected = (1 - np.mean(ssim_map[5:-5, 5:-5])) / 2
    # scikit-image cuts its window at 3.5 sigma, the same 11 x 11
    assert float(loss) == pytest.approx(expected, rel=1e-5)


def test_l1_by_hand() -> None:
    image, target = torch.full((4, 4, 3), 0.75), torch.full((4, 4, 3), 0.5)
    assert float(l1_ssim_loss(image, target, dssim_weight=0.0)) == pytest.approx(0.25)
    assert float(l1_ssim_loss(image, image, dssim_weight=0.2)) == pytest.approx(0, abs=1e-7)


def test_weights_only_choose_where_the_maps_count() -> None:
    image, target = _images(30, 30, 3)
    half = torch.zeros(30, 30)
    half[:, :15] = 1
    left = l1_ssim_loss(image, target, mask=half)
    right = l1_ssim_loss(image, target, mask=1 - half)
    assert float((left + right) / 2) == pytest.approx(float(l1_ssim_loss(image, target)), rel=1e-6)
    assert float(l1_ssim_loss(image, target, mask=0.5 * half)) == pytest.approx(float(left), rel=1e-6)


@pytest.mark.parametrize("function", [l1_ssim_loss, l1_ssim_loss_reference])
@pytest.mark.parametrize("ssim_mask", [None, torch.ones(10, 12)])
def test_empty_mask_is_no_loss(function, ssim_mask: torch.Tensor | None) -> None:
    image, target = _images(10, 12, 3)
    value, gradient = _with_gradient(function, image, target, mask=torch.zeros(10, 12), ssim_mask=ssim_mask)
    assert float(value) == 0
    assert float(gradient.abs().max()) == 0


def test_same_bits_on_any_number_of_threads(isa: str, threads: None) -> None:
    image, target = _images(150, 70, 3)
    set_num_threads(1)
    value, gradient = _with_gradient(l1_ssim_loss, image, target)
    for count in (2, 3, 4):
        set_num_threads(count)
        other, other_gradient = _with_gradient(l1_ssim_loss, image, target)
        assert torch.equal(value, other)
        assert torch.equal(gradient, other_gradient)


def test_reference_gradcheck() -> None:
    image, target = _images(7, 8, 3)
    mask = torch.rand(7, 8, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda x: l1_ssim_loss_reference(x, target.double(), mask=mask),
        [image.double().requires_grad_()],
        fast_mode=True,
    )


def test_errors(unchecked: None) -> None:
    image = torch.zeros(4, 5, 3)
    with pytest.raises(ShapeError, match="target is"):
        l1_ssim_loss(image, torch.zeros(5, 4, 3))
    with pytest.raises(ShapeError, match="mask is"):
        l1_ssim_loss(image, image, mask=torch.zeros(5, 4))
    with pytest.raises(ShapeError, match="image has shape"):
        l1_ssim_loss(torch.zeros(4, 5), torch.zeros(4, 5))
    with pytest.raises(ShapeError, match="ssim_mask is"):
        l1_ssim_loss(image, image, ssim_mask=torch.zeros(5, 4))
    with pytest.raises(ConfigError, match="normalisation is 0"):
        l1_ssim_loss(image, image, normalisation=0)


def test_native_is_what_runs() -> None:
    image, target = _images(8, 8, 3)
    loss = l1_ssim_loss(image.requires_grad_(), target)
    assert native.native_isa() is not None
    assert type(loss.grad_fn).__name__ == "_L1SsimBackward"
