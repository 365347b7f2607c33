"""Highlights painted into images without any, and real images that have some."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from PIL import Image

from data_catalog.catalog import read
from data_catalog.specular import specular_mask, specular_masks, with_specular
from extrags.config import IngestConfig
from extrags.sequence import saturated_mask


def mucosa(width: int = 320, height: int = 256) -> np.ndarray:
    """Red, smooth, with vessels, a fold and a dark lumen: nothing that shines."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:height, :width] / width
    light = 0.9 - 0.5 * np.hypot(x - 0.3, y - 0.3)
    vessels = 1 - 0.2 * (np.abs(np.sin(18 * x + 4 * np.sin(9 * y))) < 0.12)
    lumen = np.where(np.hypot(x - 0.7, y - 0.5) < 0.15, 0.15, 1.0)
    color = np.array([215, 120, 95])
    image = (light * vessels * lumen)[..., None] * color + rng.normal(0, 2, (height, width, 3))
    return np.clip(image, 0, 255).astype(np.uint8)


def shining(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The image with blurred white spots of several sizes, and where they are bright."""
    height, width = image.shape[:2]
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:height, :width]
    extra = np.zeros((height, width))
    for radius in np.array([2, 3, 4, 6, 8]) * width / 320:
        for _ in range(3):
            u, v = rng.uniform(20, width * 0.5), rng.uniform(20, height - 20)
            extra = np.maximum(extra, 150 * np.exp(-((((x - u) ** 2 + (y - v) ** 2) / radius**2) ** 2)))
    return np.clip(image + extra[..., None], 0, 255).astype(np.uint8), extra > 75


@pytest.mark.parametrize("size", [(320, 256), (640, 512)])
def test_painted_highlights_are_found_and_little_else(size) -> None:
    plain = mucosa(*size)
    assert specular_mask(plain).mean() < 0.001
    image, truth = shining(plain)
    found = specular_mask(image)
    assert found[truth].mean() > 0.95
    assert (found & ~truth).sum() < 2.0 * truth.sum()


def test_the_lit_side_of_a_fold_is_no_highlight() -> None:
    image = mucosa()
    image[:, 160:] //= 4
    assert specular_mask(image).mean() < 0.002


def test_outside_the_mask_nothing_counts() -> None:
    image, truth = shining(mucosa())
    mask = np.ones(truth.shape, bool)
    mask[:, :40] = False
    image[:, :40] = 255
    found = specular_mask(image, mask)
    assert not found[:, :40].any()
    assert found[truth & mask].mean() > 0.9
    assert found[:, 200:].mean() < 0.001
    assert not specular_mask(image, np.zeros_like(mask)).any()


def test_saturation_is_told_apart() -> None:
    image = mucosa()
    image[50:150, 20:120, 0] = 255
    assert saturated_mask(image).sum() >= 10_000
    assert not specular_mask(image)[70:130, 40:100].any()


def test_a_sequence_gets_its_highlights_and_keeps_them(clip, tmp_path) -> None:
    marked = with_specular(clip)
    np.testing.assert_array_equal(marked.specular, specular_masks(clip.rgb, clip.mask))
    marked.save(tmp_path / "sequence")
    np.testing.assert_array_equal(type(clip).load(tmp_path / "sequence").specular, marked.specular)
    # The evaluation's mask is not touched.
    np.testing.assert_array_equal(marked.mask, clip.mask)


class TestRealImages:
    def test_sinus_shows_one_bright_reflex(self, shared_data) -> None:
        sequence = read(shared_data / "sinus_hopkins", IngestConfig(size="thumbnail"))
        found = specular_masks(sequence.rgb, sequence.mask)
        share = found[sequence.mask].mean()
        assert 0.001 < share < 0.02
        # Near-white pixels within red surroundings: the reflex on the turbinate.
        weakest = sequence.rgb[0].min(axis=-1)
        assert found[0, 115:140, 95:130].any()
        assert weakest[found[0]].mean() > 1.3 * weakest[sequence.mask[0] & ~found[0]].mean()

    def test_laparoscopy_shows_some_on_every_frame(self, shared_data) -> None:
        files = sorted((shared_data / "laparoscopy_frames_40").glob("*.jpg"))[::5]
        for file in files:
            image = np.array(Image.open(file).resize((640, 360), Image.Resampling.BOX))
            inside = image.max(axis=-1) > 20
            found = specular_mask(image, inside)
            assert 0.002 < found.mean() < 0.09
            weakest = image.min(axis=-1)
            beside = (cv2.dilate(found.astype(np.uint8), np.ones((15, 15))) > 0) & inside & ~found
            assert weakest[found].mean() > weakest[beside].mean() + 20
