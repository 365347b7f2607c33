"""FLIP against figures of the authors' own program (flip-evaluator 1.7), and its known behaviour."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
import torch

from extrags.errors import ConfigError, ShapeError
from extrags.metrics.flip import PIXELS_PER_DEGREE, flip, flip_map


def reference_image() -> np.ndarray:
    y, x = np.mgrid[:48, :64].astype(np.float64)
    return np.stack(
        [0.5 + 0.4 * np.sin(x / 7 + y / 11), 0.5 + 0.4 * np.cos(x / 5), 0.5 + 0.4 * np.sin(y / 9)], axis=-1
    )


def changed_image(change: str) -> np.ndarray:
    image = reference_image()
    x = np.arange(64)[None, :, None]
    return {
        "shift": np.roll(image, 3, 1),
        "gain": np.clip(image * 1.3, 0, 1),
        "ripple": np.clip(image + 0.05 * np.sin(2.5 * x), 0, 1),
        "swap": image[..., ::-1].copy(),
    }[change]


def as_tensor(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image.astype(np.float32))


# Mean, and the pixels (0, 0), (20, 31), (47, 63), as flip-evaluator 1.7 printed them.
EXPECTED = [
    ("shift", PIXELS_PER_DEGREE, 0.618114, (0.50272, 0.57218, 0.60560)),
    ("shift", 30.0, 0.603230, (0.52256, 0.55800, 0.58517)),
    ("gain", PIXELS_PER_DEGREE, 0.616235, (0.38801, 0.47672, 0.66674)),
    ("gain", 30.0, 0.602346, (0.37434, 0.51554, 0.64026)),
    ("ripple", PIXELS_PER_DEGREE, 0.026297, (0.04941, 0.02521, 0.13655)),
    ("ripple", 30.0, 0.143649, (0.04570, 0.17072, 0.15530)),
    ("swap", PIXELS_PER_DEGREE, 0.569481, (0.27507, 0.77107, 0.94531)),
    ("swap", 30.0, 0.566194, (0.15171, 0.83666, 0.95843)),
]


@pytest.mark.parametrize(("change", "resolution", "mean", "pixels"), EXPECTED)
def test_matches_the_authors_program(
    change: str, resolution: float, mean: float, pixels: tuple[float, ...]
) -> None:
    error = flip_map(
        as_tensor(changed_image(change)), as_tensor(reference_image()), pixels_per_degree=resolution
    )
    assert float(error.mean()) == pytest.approx(mean, abs=5e-5)
    assert [float(error[0, 0]), float(error[20, 31]), float(error[47, 63])] == pytest.approx(pixels, abs=2e-4)


def test_default_viewer_sees_67_pixels_per_degree() -> None:
    assert pytest.approx(67.0206, abs=1e-4) == PIXELS_PER_DEGREE


def test_green_against_blue_is_the_largest_difference() -> None:
    green = torch.zeros(24, 24, 3)
    green[..., 1] = 1
    blue = torch.zeros(24, 24, 3)
    blue[..., 2] = 1
    assert flip(green, blue) == pytest.approx(1, abs=1e-4)
    assert flip(green, green) == 0


def test_symmetric_bounded_and_blind_to_batching() -> None:
    generator = torch.Generator().manual_seed(0)
    first, second = torch.rand(2, 3, 20, 30, 3, generator=generator)
    forth, back = flip_map(first, second), flip_map(second, first)
    torch.testing.assert_close(forth, back, atol=1e-5, rtol=0)
    assert float(forth.min()) >= 0
    assert float(forth.max()) <= 1
    torch.testing.assert_close(flip_map(first[1], second[1]), forth[1], atol=1e-5, rtol=0)


def test_a_finer_pattern_is_seen_less_from_afar() -> None:
    clean, rippled = as_tensor(reference_image()), as_tensor(changed_image("ripple"))
    near = flip(rippled, clean, pixels_per_degree=20.0)
    far = flip(rippled, clean, pixels_per_degree=120.0)
    assert near is not None
    assert far is not None
    assert far < 0.5 * near


def test_mask_and_bad_resolution() -> None:
    clean, other = as_tensor(reference_image()), as_tensor(changed_image("gain"))
    mask = torch.zeros(48, 64, dtype=torch.bool)
    assert flip(clean, other, mask) is None
    mask[:, :10] = True
    assert flip(clean, other, mask) == pytest.approx(float(flip_map(clean, other)[:, :10].mean()), abs=1e-6)
    with pytest.raises(ConfigError, match="positive"):
        flip_map(clean, other, pixels_per_degree=0.0)


@pytest.mark.parametrize(("first", "second"), [((8, 9, 3), (9, 8, 3)), ((8, 9, 4), (8, 9, 4))])
def test_images_of_other_shapes_are_refused(first: tuple[int, ...], second: tuple[int, ...]) -> None:
    # Users have no checks of shapes around it, as these tests do.
    plain = inspect.unwrap(flip_map)
    with pytest.raises(ShapeError, match="FLIP compares images"):
        plain(torch.zeros(first), torch.zeros(second))
