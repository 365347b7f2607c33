"""The weight-free perceptual difference: bounds, order, and agreement with LPIPS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import TypeCheckError

from extrags.errors import ShapeError
from extrags.metrics.lpips import Lpips
from extrags.metrics.perceptual import perceptual_map


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), height=st.integers(12, 50), width=st.integers(12, 50))
def test_bounded_symmetric_and_zero_for_equal_images(seed: int, height: int, width: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    first, second = torch.rand(2, height, width, 3, generator=generator)
    error = perceptual_map(first, second)
    assert error.shape == (height, width)
    assert float(error.min()) >= 0
    assert float(error.max()) <= 1
    torch.testing.assert_close(perceptual_map(second, first), error, atol=1e-5, rtol=0)
    assert float(perceptual_map(first, first).max()) < 1e-5


def test_grows_with_the_change() -> None:
    generator = torch.Generator().manual_seed(0)
    image = F.avg_pool2d(torch.rand(3, 96, 128, generator=generator), 5, 1, 2).movedim(0, -1)
    noise = torch.randn(96, 128, 3, generator=generator)
    errors = [float(perceptual_map(image, image + level * noise).mean()) for level in (0.01, 0.03, 0.1, 0.3)]
    assert errors == sorted(errors)
    assert errors[0] < 0.3 * errors[-1]


def test_points_at_the_change() -> None:
    image = torch.full((64, 64, 3), 0.5)
    changed = image.clone()
    changed[20:40, 20:40] = torch.tensor([0.9, 0.1, 0.1])
    error = perceptual_map(image, changed)
    assert float(error[24:36, 24:36].mean()) > 0.7
    assert float(error[:4, :4].max()) < 0.01


def test_misfits_are_refused() -> None:
    with pytest.raises((ShapeError, TypeCheckError), match=r"expected two images|Type-check"):
        perceptual_map(torch.zeros(14, 30, 3), torch.zeros(14, 31, 3))


def test_a_change_of_exposure_weighs_less_than_a_hole() -> None:
    image = 0.3 + 0.4 * torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(4))
    holed = image.clone()
    holed[16:48, 16:48] = 0
    assert float(perceptual_map(image, 0.9 * image).mean()) < 0.2 * float(perceptual_map(image, holed).mean())


def degraded(image: torch.Tensor, kind: str, level: float, generator: torch.Generator) -> torch.Tensor:
    if kind == "noise":
        return (image + 0.1 * level * torch.randn(image.shape, generator=generator)).clamp(0, 1)
    if kind == "blur":
        small = F.interpolate(image.movedim(-1, 0)[None], scale_factor=1 / (1 + 3 * level), mode="area")
        return F.interpolate(small, image.shape[:2], mode="bilinear")[0].movedim(0, -1)
    if kind == "hole":
        holed = image.clone()
        size = int(60 * level)
        holed[20 : 20 + size, 30 : 30 + size] = 0
        return holed
    return (image * (1 - 0.4 * level)).clamp(0, 1)


def test_orders_degraded_tissue_much_as_lpips_does(shared_data: Path) -> None:
    from PIL import Image
    from scipy.stats import spearmanr

    metric = Lpips.load(shared_data / "lpips_weights")
    files = sorted((shared_data / "laparoscopy_frames_40").rglob("*.[jp][pn]g"))[::10]
    assert files
    generator = torch.Generator().manual_seed(0)
    ours, theirs = [], []
    for file in files:
        with Image.open(file) as opened:
            image = torch.from_numpy(
                np.asarray(opened.convert("RGB").resize((160, 96)), dtype=np.float32) / 255
            )
        for kind in ("noise", "blur", "hole", "dim"):
            for level in (0.25, 0.5, 1.0):
                changed = degraded(image, kind, level, generator)
                ours.append(float(perceptual_map(image, changed).mean()))
                theirs.append(float(metric.distance(image, changed)))
    correlation = float(spearmanr(ours, theirs).statistic)
    assert correlation > 0.7
