"""Both forms of a separable filter are the convolution they stand for."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from extrags.metrics.filters import (
    LARGEST_MATRIX_PX,
    BorderRule,
    filter_figures,
    filter_separable,
    gaussian_weights,
)


@pytest.mark.parametrize("size", [(14, 19), (14, LARGEST_MATRIX_PX + 19), (LARGEST_MATRIX_PX + 14, 19)])
@pytest.mark.parametrize("border", ["reflect", "replicate"])
def test_equals_padding_and_convolution(border: BorderRule, size: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(3)
    maps = torch.rand(2, *size, generator=generator, dtype=torch.float64)
    along_x = tuple(torch.randn(7, generator=generator, dtype=torch.float64).tolist())
    along_y = tuple(torch.randn(5, generator=generator, dtype=torch.float64).tolist())
    padded = F.pad(maps[:, None], (3, 3, 2, 2), mode=border)
    kernel = torch.outer(*(torch.tensor(weights, dtype=torch.float64) for weights in (along_y, along_x)))
    expected = F.conv2d(padded, kernel[None, None])[:, 0]
    for form in (filter_separable, filter_figures):
        torch.testing.assert_close(form(maps, along_x, along_y, border), expected, atol=1e-12, rtol=0)


def test_large_maps_of_single_precision_differ_by_its_rounding() -> None:
    maps = torch.rand(2, 3, 40, LARGEST_MATRIX_PX + 1, generator=torch.Generator().manual_seed(4))
    window = gaussian_weights(1.5, 5)
    found = filter_figures(maps, window, window)
    assert found.dtype == torch.float32
    exact = filter_separable(maps.double(), window, window)
    # Two sums of eleven terms, the weights rounded too.
    torch.testing.assert_close(found.double(), exact, atol=24 * 2**-24, rtol=0)


def test_large_maps_have_gradients_and_may_be_views() -> None:
    generator = torch.Generator().manual_seed(5)
    maps = torch.rand(40, 2, LARGEST_MATRIX_PX + 1, generator=generator, dtype=torch.float64).transpose(0, 1)
    window = gaussian_weights(1.5, 5)
    without = filter_figures(maps, window, window)
    maps.requires_grad_()
    found = filter_figures(maps, window, window)
    torch.testing.assert_close(found.detach(), without, atol=1e-12, rtol=0)
    found.sum().backward()
    # Weights sum to one, and mirrored borders give back what they take but for the border pixel itself.
    assert maps.grad is not None
    torch.testing.assert_close(maps.grad[:, 12:-12, 12:-12], torch.ones_like(maps)[:, 12:-12, 12:-12])


@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_images_smaller_than_the_window_keep_their_mean_level(size: int) -> None:
    window = gaussian_weights(2.0, 6)
    flat = torch.full((size, size), 0.7, dtype=torch.float64)
    torch.testing.assert_close(filter_separable(flat, window, window), flat, atol=1e-12, rtol=0)


def test_what_stages_compute_is_one_way_whatever_the_size() -> None:
    """Figures alone may have other last bits where images are large."""
    maps = torch.rand(1, 40, LARGEST_MATRIX_PX + 1, generator=torch.Generator().manual_seed(6))
    window = gaussian_weights(1.5, 5)
    # Columns that lie apart from both borders see the same neighbours in a narrower map.
    narrow = maps[..., :300]
    whole = filter_separable(maps, window, window)
    torch.testing.assert_close(whole[..., 20:280], filter_separable(narrow, window, window)[..., 20:280])
    assert not torch.equal(whole, filter_figures(maps, window, window))
    assert torch.equal(filter_separable(narrow, window, window), filter_figures(narrow, window, window))


def test_half_precision_stays_with_the_matrices() -> None:
    maps = torch.rand(1, 40, LARGEST_MATRIX_PX + 1, generator=torch.Generator().manual_seed(7)).bfloat16()
    window = gaussian_weights(1.5, 5)
    assert torch.equal(filter_figures(maps, window, window), filter_separable(maps, window, window))


@pytest.mark.parametrize("size", [1, 2, 3, 5, 20])
def test_a_line_fitted_at_the_border_keeps_slopes(size: int) -> None:
    window = gaussian_weights(1.5, 4)
    down, across = torch.meshgrid(torch.arange(size), torch.arange(size + 1), indexing="ij")
    slanted = 0.3 + 2.0 * down.double() - 0.7 * across.double()
    torch.testing.assert_close(
        filter_separable(slanted, window, window, "linear"), slanted, atol=1e-12, rtol=0
    )


def test_a_line_fitted_is_the_filter_itself_inside() -> None:
    window = gaussian_weights(1.5, 4)
    maps = torch.rand(2, 14, 19, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    inside = (..., slice(4, -4), slice(4, -4))
    plain = filter_separable(maps, window, window)
    fitted = filter_separable(maps, window, window, "linear")
    torch.testing.assert_close(fitted[inside], plain[inside], atol=1e-14, rtol=0)
