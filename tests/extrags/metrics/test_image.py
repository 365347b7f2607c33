"""PSNR and SSIM against torchmetrics and scikit-image, and their rules for masks."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import TypeCheckError

from extrags.errors import ShapeError
from extrags.metrics.image import MAX_PSNR_DB, psnr, psnr_per_image, ssim, ssim_map


def image_pair(
    seed: int = 0, n: int = 2, height: int = 40, width: int = 56
) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    first = torch.rand(n, height, width, 3, generator=generator)
    second = (first + 0.15 * torch.randn(n, height, width, 3, generator=generator)).clamp(0, 1)
    return first, second


def test_psnr_is_the_mean_of_torchmetrics_per_image() -> None:
    from torchmetrics.functional.image import peak_signal_noise_ratio

    first, second = image_pair()
    second[1] = second[1] * 0.5
    expected = [
        float(peak_signal_noise_ratio(a, b, data_range=1.0)) for a, b in zip(first, second, strict=True)
    ]
    assert psnr_per_image(first, second) == pytest.approx(expected, abs=1e-4)
    assert psnr(first, second) == pytest.approx(np.mean(expected), abs=1e-4)


def test_psnr_counts_only_the_mask() -> None:
    first, second = image_pair(n=1)
    mask = torch.zeros(1, 40, 56, dtype=torch.bool)
    mask[:, 5:20, 7:30] = True
    inside = psnr(first[:, 5:20, 7:30], second[:, 5:20, 7:30])
    second[~mask] = float("nan")
    assert psnr(first, second, mask) == pytest.approx(inside, abs=1e-9)


def test_an_empty_mask_has_no_value_and_does_not_spoil_the_mean() -> None:
    first, second = image_pair()
    mask = torch.ones(2, 40, 56, dtype=torch.bool)
    mask[1] = False
    assert psnr_per_image(first, second, mask)[1] is None
    assert psnr(first, second, mask) == psnr(first[:1], second[:1])
    assert ssim(first, second, mask) == pytest.approx(ssim(first[:1], second[:1]), abs=1e-6)
    assert psnr(first[1], second[1], mask[1]) is None
    assert ssim(first[1], second[1], mask[1]) is None


def test_equal_images() -> None:
    first, _ = image_pair()
    assert psnr(first, first) == MAX_PSNR_DB
    assert ssim(first, first) == pytest.approx(1, abs=1e-6)


def test_ssim_map_is_torchmetrics_full_image() -> None:
    from torchmetrics.functional.image import structural_similarity_index_measure

    first, second = image_pair()
    expected_mean, expected_map = structural_similarity_index_measure(
        first.movedim(-1, 1),
        second.movedim(-1, 1),
        gaussian_kernel=True,
        sigma=1.5,
        kernel_size=11,
        data_range=1.0,
        return_full_image=True,
    )
    torch.testing.assert_close(ssim_map(first, second), expected_map.mean(1), atol=2e-5, rtol=0)
    assert ssim(first, second) == pytest.approx(float(expected_mean), abs=2e-5)


def test_ssim_is_scikit_image() -> None:
    from skimage.metrics import structural_similarity

    first, second = image_pair(n=1)
    expected, expected_map = structural_similarity(
        first[0].double().numpy(),
        second[0].double().numpy(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
        full=True,
    )
    ours = ssim_map(first[0].double(), second[0].double())[5:-5, 5:-5]
    np.testing.assert_allclose(ours.numpy(), expected_map.mean(-1)[5:-5, 5:-5], atol=1e-12)
    interior = torch.zeros(40, 56, dtype=torch.bool)
    interior[5:-5, 5:-5] = True
    assert ssim(first[0], second[0], interior) == pytest.approx(float(expected), abs=1e-5)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), height=st.integers(6, 24), width=st.integers(6, 24), dark=st.booleans())
def test_ssim_is_bounded_and_symmetric(seed: int, height: int, width: int, dark: bool) -> None:
    generator = torch.Generator().manual_seed(seed)
    first, second = torch.rand(2, height, width, 3, generator=generator) * (0.01 if dark else 1.0)
    forth, back = ssim_map(first, second), ssim_map(second, first)
    torch.testing.assert_close(forth, back, atol=1e-5, rtol=0)
    assert bool((forth <= 1).all())
    assert bool((forth >= -1).all())


def test_ssim_of_a_negative_is_negative() -> None:
    image = torch.rand(1, 32, 32, 3, generator=torch.Generator().manual_seed(6))
    found = ssim(image, 1 - image)
    assert found is not None
    assert -1 <= found < -0.8


def test_ssim_gradient() -> None:
    # Once inside inference mode first: tensors cached there must still serve autograd.
    with torch.inference_mode():
        ssim_map(torch.rand(6, 8, 3).double(), torch.rand(6, 8, 3).double())
    generator = torch.Generator().manual_seed(1)
    first = torch.rand(6, 8, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    second = torch.rand(6, 8, 3, generator=generator, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: ssim_map(x, second), (first,))


def test_misfits_are_refused() -> None:
    first, second = image_pair()
    with pytest.raises((ShapeError, TypeCheckError)):
        psnr(first, second[:, 1:])
    with pytest.raises((ShapeError, TypeCheckError)):
        ssim(first, second, torch.ones(2, 40, 55, dtype=torch.bool))
    with pytest.raises(ShapeError, match="larger than 5 px, found 7x5"):
        ssim_map(first[:, :5, :7], second[:, :5, :7])
