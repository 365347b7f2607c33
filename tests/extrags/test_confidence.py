from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import TypeCheckError

from extrags.confidence import PerceptualDifference, gaussian_iou, image_confidence, pixel_confidence
from extrags.config import EvaluateConfig
from extrags.errors import ShapeError, WeightsError


class TestImageConfidence:
    def test_by_hand(self) -> None:
        virtual = torch.tensor([[1, 1, 0, 0, 1], [0, 0, 0, 0, 0], [1, 1, 1, 1, 1]]).bool()
        reference = torch.tensor([[1, 1, 1, 1, 0], [1, 0, 0, 0, 0], [1, 0, 1, 0, 0]]).bool()
        assert gaussian_iou(virtual, reference).tolist() == [0.5, 0, 1]
        assert image_confidence(virtual, reference).tolist() == [0.5, 1, 0]

    def test_over_the_union_by_hand(self) -> None:
        virtual = torch.tensor([[1, 1, 0, 0, 1], [0, 0, 0, 0, 0], [1, 1, 1, 1, 1]]).bool()
        reference = torch.tensor([[1, 1, 1, 1, 0], [1, 0, 0, 0, 0], [1, 0, 1, 0, 0]]).bool()
        np.testing.assert_allclose(gaussian_iou(virtual, reference, "union"), [0.4, 0, 0.4])
        np.testing.assert_allclose(image_confidence(virtual, reference, "union"), [0.6, 1, 0.6])

    def test_a_blind_reference_gives_full_weight(self) -> None:
        nothing = torch.zeros(1, 4, dtype=torch.bool)
        assert image_confidence(~nothing, nothing).tolist() == [1]

    def test_a_single_gaussian_that_both_see_is_all_there_is(self) -> None:
        one = torch.tensor([[0, 1, 0]]).bool()
        assert gaussian_iou(one, one).tolist() == gaussian_iou(one, one, "union").tolist() == [1]

    @given(seed=st.integers(0, 999), n=st.integers(1, 60))
    def test_bounds(self, seed: int, n: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        virtual, reference = (torch.rand(2, 3, n, generator=generator) < 0.5).unbind(0)
        confidence = image_confidence(virtual, reference)
        assert (confidence >= 0).all()
        assert (confidence <= 1).all()

    def test_shapes(self) -> None:
        with pytest.raises((ShapeError, TypeCheckError)):
            gaussian_iou(torch.zeros(1, 3).bool(), torch.zeros(1, 4).bool())


class TestPixelConfidence:
    def _images(self) -> tuple[np.ndarray, np.ndarray]:
        v, u = np.mgrid[0:128, 0:320].astype(np.float32)
        stripes = 0.5 + 0.2 * np.sin(u / 5) * np.cos(v / 7)
        rendered = np.repeat(np.stack([stripes, 0.8 * stripes])[..., None], 3, axis=-1)
        restored = rendered.copy()
        restored[:, 32:96, 224:288] = 0.2 + 0.6 * (((u // 4 + v // 4) % 2)[32:96, 224:288, None])
        return rendered, restored

    def _check(self, measure: PerceptualDifference) -> None:
        rendered, restored = self._images()
        confidence = pixel_confidence(rendered, restored, measure)
        assert confidence.shape == (2, 128, 320)
        assert confidence.min() >= 0
        assert confidence.max() <= 1
        assert confidence[:, 48:80, 240:272].mean() > 3 * confidence[:, :, :80].mean()
        assert pixel_confidence(rendered, rendered, measure).max() < 1e-3

    def test_weight_free_map(self) -> None:
        measure = PerceptualDifference(None, "no weights")
        assert measure.name == "perceptual_map"
        self._check(measure)

    def test_lpips(self, shared_data: Path) -> None:
        weights = next((shared_data / "lpips_weights").glob("*alex*.npz"))
        measure = PerceptualDifference.available(EvaluateConfig(lpips_weights=str(weights)))
        assert measure.name == "lpips_alex"
        self._check(measure)

    def test_raw_lpips_is_the_map_itself(self, shared_data: Path) -> None:
        weights = next((shared_data / "lpips_weights").glob("*alex*.npz"))
        bounded = PerceptualDifference.available(EvaluateConfig(lpips_weights=str(weights)))
        raw = replace(bounded, raw=True)
        assert raw.name == "raw_lpips_alex"
        assert bounded.lpips is not None
        rendered, restored = self._images()
        confidence = pixel_confidence(rendered, restored, raw)
        images = torch.from_numpy(rendered), torch.from_numpy(restored)
        with torch.no_grad():
            expected = bounded.lpips.distance_map(*images).numpy()
        assert np.array_equal(confidence, expected)
        mapped = pixel_confidence(rendered, restored, bounded)
        np.testing.assert_allclose(1 - np.exp(-confidence / 0.25), mapped, rtol=1e-5, atol=1e-6)

    def test_every_view_is_compared_with_its_own_restored_image(self) -> None:
        """Views are compared a few at a time."""
        rendered, restored = (np.concatenate([images, images[:, ::-1]] * 2) for images in self._images())
        restored[5] = rendered[5]
        measure = PerceptualDifference(None)
        together = pixel_confidence(rendered, restored, measure)
        for view in range(len(rendered)):
            alone = pixel_confidence(rendered[view : view + 1], restored[view : view + 1], measure)
            np.testing.assert_allclose(together[view], alone[0], atol=1e-6)

    def test_raw_lpips_without_weights_is_refused(self) -> None:
        with pytest.raises(WeightsError, match=r"pixel_confidence=raw is LPIPS itself: no weights"):
            PerceptualDifference(None, "no weights", raw=True)

    def test_images_too_small_for_lpips_are_compared_by_the_map(self, shared_data: Path) -> None:
        weights = next((shared_data / "lpips_weights").glob("*alex*.npz"))
        measure = PerceptualDifference.available(EvaluateConfig(lpips_weights=str(weights)))
        assert measure.for_images(32, 40) is measure
        small = measure.for_images(40, 31)
        assert (small.name, small.lpips) == ("perceptual_map", None)
        assert "at least 32 px a side, these have 40 x 31" in small.reason
        with pytest.raises(ShapeError, match="pixel_confidence=raw is LPIPS itself"):
            replace(measure, raw=True).for_images(31, 40)

    def test_a_named_file_must_work(self, tmp_path: Path) -> None:
        with pytest.raises(WeightsError):
            PerceptualDifference.available(EvaluateConfig(lpips_weights=str(tmp_path / "none.npz")))

    def test_without_weights_it_says_why(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(*_: object) -> None:
            raise WeightsError("get them there")

        monkeypatch.setattr("extrags.confidence.Lpips.load", refuse)
        measure = PerceptualDifference.available()
        assert measure.lpips is None
        assert "get them there" in measure.reason

    def test_shapes(self) -> None:
        with pytest.raises((ShapeError, TypeCheckError)):
            pixel_confidence(
                np.zeros((1, 32, 32, 3), np.float32),
                np.zeros((1, 32, 33, 3), np.float32),
                PerceptualDifference(None),
            )

    def test_no_views(self) -> None:
        none = np.zeros((0, 32, 32, 3), np.float32)
        assert pixel_confidence(none, none, PerceptualDifference(None)).shape == (0, 32, 32)
