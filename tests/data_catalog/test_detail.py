"""The size that keeps the detail of frames."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from data_catalog import read
from data_catalog.catalog import measured_detail
from data_catalog.detail import DIVISORS, DetailSize, detail_size, kept_psnr_db
from extrags.config import IngestConfig
from extrags.sequence import EndoscopicSequence, Split

LIMIT_DB = 45.0
WIDTH, HEIGHT, FRAMES = 640, 480, 4


def texture(width: int, height: int, seed: int) -> np.ndarray:
    """Detail down to the pixel: blurred noise whose finest waves are a few pixels long."""
    noise = np.random.default_rng(seed).normal(128, 60, (height, width, 3))
    return np.clip(cv2.GaussianBlur(noise, (0, 0), 0.8), 0, 255).astype(np.uint8)


def sequence_of(frames: np.ndarray, mask: np.ndarray | None = None) -> EndoscopicSequence:
    count, height, width = frames.shape[:3]
    return EndoscopicSequence(
        name="frames",
        rgb=frames,
        K=np.tile(np.array([[300, 0, width / 2], [0, 300, height / 2], [0, 0, 1.0]]), (count, 1, 1)),
        mask=np.ones((count, height, width), bool) if mask is None else mask,
        split=Split("all", np.arange(count), np.arange(0)),
    )


def enlarged(divisor: float) -> np.ndarray:
    """Frames that were taken at a smaller size and enlarged."""
    small = [texture(round(WIDTH / divisor), round(HEIGHT / divisor), seed) for seed in range(FRAMES)]
    return np.stack([cv2.resize(frame, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC) for frame in small])


def test_frames_with_detail_down_to_the_pixel_keep_their_size() -> None:
    frames = np.stack([texture(WIDTH, HEIGHT, seed) for seed in range(FRAMES)])
    found = detail_size(sequence_of(frames), LIMIT_DB)
    assert (found.divisor, found.reduced_width, found.reduced_height) == (1, WIDTH, HEIGHT)
    assert found.next_psnr_db is not None
    assert found.next_psnr_db < LIMIT_DB
    assert "all 640 x 480" in str(found)


def test_enlarged_frames_shrink_and_no_further_than_their_detail() -> None:
    found = {factor: detail_size(sequence_of(enlarged(factor)), 38.0) for factor in (2.0, 4.0)}
    assert 1 < found[2.0].divisor <= 2
    assert found[2.0].divisor < found[4.0].divisor <= 4
    for item in found.values():
        assert item.kept_psnr_db >= 38
        assert f"{item.reduced_width} x {item.reduced_height}" in str(item)


def test_more_is_kept_of_a_higher_limit() -> None:
    frames = sequence_of(enlarged(4.0))
    divisors = [detail_size(frames, limit).divisor for limit in (30.0, 38.0, 46.0, 80.0)]
    assert divisors == sorted(divisors, reverse=True)
    assert divisors[0] > divisors[-1]


def test_frames_without_any_detail_stay_wide_enough_to_be_reconstructed() -> None:
    flat = np.full((2, HEIGHT, WIDTH, 3), 90, np.uint8)
    assert detail_size(sequence_of(flat), LIMIT_DB).reduced_width == WIDTH / DIVISORS[-1]
    narrow = np.full((2, 150, 200, 3), 90, np.uint8)
    assert detail_size(sequence_of(narrow), LIMIT_DB).reduced_width == 160
    tiny = np.full((2, 90, 120, 3), 90, np.uint8)
    assert detail_size(sequence_of(tiny), LIMIT_DB).divisor == 1


def test_what_lies_outside_the_mask_does_not_count() -> None:
    frames = np.full((2, HEIGHT, WIDTH, 3), 90, np.uint8)
    mask = np.ones((2, HEIGHT, WIDTH), bool)
    frames[:, :, 400:], mask[:, :, 400:] = texture(240, HEIGHT, 0), False
    assert detail_size(sequence_of(frames, mask), LIMIT_DB).divisor == DIVISORS[-1]
    assert detail_size(sequence_of(frames), LIMIT_DB).divisor == 1


def test_a_frame_without_a_valid_pixel_says_nothing() -> None:
    frame = texture(WIDTH, HEIGHT, 0)
    assert kept_psnr_db(frame, np.zeros((HEIGHT, WIDTH), bool), 2.0) == 99.0


def test_one_blurred_frame_does_not_decide() -> None:
    frames = np.stack([texture(WIDTH, HEIGHT, seed) for seed in range(3)])
    frames[1] = 90
    assert detail_size(sequence_of(frames), LIMIT_DB).divisor == 1


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames in a folder that nobody writes into."""
    images = tmp_path_factory.mktemp("detail") / "soft" / "images"
    images.mkdir(parents=True)
    for index in range(12):
        small = cv2.GaussianBlur(texture(WIDTH, HEIGHT, index), (0, 0), 6)
        Image.fromarray(small).save(images / f"{index:03d}.png", compress_level=1)
    return images.parent


def test_a_source_is_read_at_the_size_of_its_detail(folder: Path) -> None:
    config = IngestConfig(size="detail", detail_psnr_db=LIMIT_DB)
    found = measured_detail(str(folder), config)
    assert found is not None
    assert found.divisor > 1
    sequence, whole = read(folder, config), read(folder, IngestConfig(size="source"))
    assert (sequence.width, sequence.height) == (found.reduced_width, found.reduced_height)
    assert len(sequence) == len(whole) == 12
    # The field of view stays, and what is read is what the width given by hand gives.
    np.testing.assert_allclose(sequence.K[:, 0, 0] / sequence.width, whole.K[:, 0, 0] / whole.width)
    by_hand = read(folder, IngestConfig(width=found.reduced_width))
    np.testing.assert_array_equal(sequence.rgb, by_hand.rgb)


@pytest.mark.parametrize("given", [{"width": 320}, {"downscale": 2}])
def test_a_size_that_is_given_decides(folder: Path, given: dict[str, int]) -> None:
    config = IngestConfig.model_validate({"size": "detail", **given})
    assert measured_detail(str(folder), config) is None
    assert read(folder, config).width == 320


def test_a_limit_that_nothing_keeps_leaves_the_source_as_it_is() -> None:
    whole = DetailSize(640, 480, 1.0, float("inf"), 41.0)
    assert whole.applied_to(IngestConfig(size="detail")) == IngestConfig(size="source")
