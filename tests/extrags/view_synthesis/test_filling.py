from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import TypeCheckError

from extrags.errors import ShapeError
from extrags.view_synthesis.filling import completed_depth, push_pull


@given(height=st.integers(1, 37), width=st.integers(1, 37), seed=st.integers(0, 999))
@settings(max_examples=30, deadline=None)
def test_fills_every_gap_within_the_known_range(height: int, width: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    values = torch.rand(1, 2, height, width, generator=generator) + 1
    weight = (torch.rand(1, 1, height, width, generator=generator) < 0.2).float()
    weight[0, 0, 0, 0] = 1
    filled = push_pull(torch.where(weight > 0, values, torch.full((), -50.0)), weight)
    assert (filled >= 1 - 1e-4).all()
    assert (filled <= 2 + 1e-4).all()
    assert torch.equal(filled[weight.expand_as(filled) == 1], values[weight.expand_as(filled) == 1])


def test_smooth_images_are_filled_closely() -> None:
    x = torch.linspace(0, 1, 64)[None, :].expand(48, 64)[None, None]
    weight = torch.ones_like(x)
    weight[..., 20:28, 30:38] = 0
    filled = push_pull(x * weight, weight)
    assert (filled - x).abs().max() < 0.05


def test_sizes_must_fit() -> None:
    with pytest.raises((ShapeError, TypeCheckError)):
        push_pull(torch.zeros(1, 3, 8, 8), torch.zeros(1, 1, 8, 9))


def test_depth_of_an_empty_image_is_the_fallback() -> None:
    empty = torch.zeros(1, 1, 9, 7)
    assert torch.equal(completed_depth(empty, empty, 12.0), torch.full((1, 1, 9, 7), 12.0))


def test_depth_stays_where_it_is_known() -> None:
    depth = torch.full((1, 1, 8, 8), 5.0)
    depth[..., 3, 3] = 0
    complete = completed_depth(depth, torch.ones_like(depth), 20.0)
    torch.testing.assert_close(complete, torch.full_like(depth, 5.0))


@pytest.mark.parametrize("weight", [1.0, 1e-6, 1e-13, 1e-20])
def test_what_is_known_faintly_keeps_its_value(weight: float) -> None:
    known = torch.zeros(1, 1, 16, 16)
    known[..., 3, 5] = weight
    filled = push_pull(torch.full((1, 3, 16, 16), 0.6), known)
    torch.testing.assert_close(filled, torch.full((1, 3, 16, 16), 0.6))


def test_half_precision_has_no_gaps_either() -> None:
    values, known = torch.full((1, 3, 9, 14), 0.5), torch.zeros(1, 1, 9, 14)
    known[..., 2, 2] = 1
    for dtype in (torch.float16, torch.bfloat16):
        assert torch.equal(push_pull(values.to(dtype), known.to(dtype)), values.to(dtype))
