from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import isotonic_regression

from extrags.restoration.uncertainty.calibration import Calibration, cell_means, non_decreasing
from extrags.restoration.uncertainty.error_model import MIN_CONTRAST, MIN_ERROR, ErrorModel, error_features
from extrags.restoration.uncertainty.reliability_diagram import calibration
from extrags.view_synthesis.conditioning import LAYER_CHANNELS, Layers


def test_it_turns_expected_errors_into_true_ones_and_keeps_their_order() -> None:
    generator = np.random.default_rng(1)
    expected = generator.uniform(0.01, 0.2, 20_000)
    true = 0.5 * expected**1.5 * generator.exponential(1, expected.size)
    calibration = Calibration.fitted(expected, true)
    tested = np.linspace(0.02, 0.19, 50)
    assert calibration.applied(tested) == pytest.approx(0.5 * tested**1.5, rel=0.12)
    assert (np.diff(calibration.applied(np.linspace(0, 0.5, 400))) >= 0).all()


def test_beyond_the_knots_errors_go_on_in_proportion() -> None:
    calibration = Calibration((0.1, 0.2), (0.2, 0.3))
    assert calibration.applied(np.array([0.4])) == pytest.approx(np.array([0.6]))
    assert calibration.applied(np.array([0.05])) == pytest.approx(np.array([0.1]))


def test_too_few_cells_give_no_curve() -> None:
    calibration = Calibration.fitted(np.linspace(0.1, 0.2, 20), np.zeros(20))
    values = np.array([0.1, 0.4])
    assert calibration.applied(values) is values


def test_the_fit_is_the_isotonic_regression_bit_by_bit() -> None:
    generator = np.random.default_rng(0)
    for _ in range(500):
        values = np.sort(generator.random(17)) + generator.normal(scale=generator.random(), size=17)
        assert np.array_equal(non_decreasing(values), isotonic_regression(values).x)
    assert np.array_equal(non_decreasing(np.array([3.0, 2.0, 1.0])), [2.0, 2.0, 2.0])


def test_cell_means_leave_out_what_has_no_weight() -> None:
    values = torch.ones(1, 1, 16, 8)
    values[..., :4] = 100
    weight = torch.ones(1, 1, 16, 8)
    weight[..., :4] = 0
    weight[:, :, 8:] = 0
    mean, share = cell_means(values, weight)
    assert mean[0] == pytest.approx(1)
    assert share.tolist() == pytest.approx([0.5, 0])


@pytest.mark.parametrize(("height", "width"), [(7, 40), (40, 7)])
def test_images_smaller_than_a_cell_have_none(height: int, width: int) -> None:
    predicted = np.full((2, height, width), 0.1, np.float32)
    error = np.full((2, height, width, 3), 0.05, np.float32)
    found = calibration(predicted, error, np.ones(predicted.shape, dtype=bool))
    assert found["cells"] == 0
    assert found["bins"] == []
    assert found["rank_correlation"] is None
    assert found["calibration_error"] is None
    assert found["coverage"] == {"50": 1.0, "90": 1.0}


class TestErrorModel:
    def _features(self, count: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(2)
        layers = Layers(torch.rand(count, LAYER_CHANNELS, 16, 16, generator=generator))
        rgb = torch.rand(count, 3, 16, 16, generator=generator)
        error = 0.02 + 0.1 * torch.rand(count, 1, 16, 16, generator=generator)
        return error_features(layers, rgb, error)

    def test_at_first_they_are_those_of_the_network(self) -> None:
        features = self._features(2)
        torch.testing.assert_close(ErrorModel().applied(features), features[:, :1].exp())

    def test_the_line_is_found_again(self) -> None:
        features = self._features(40)
        true = ErrorModel((0.6, 0.2, 0.5, -0.1, -0.3, 0.15), -0.4)
        error = true.applied(features)
        flat = features.permute(0, 2, 3, 1).reshape(-1, 6).numpy()
        fitted = ErrorModel.fitted(flat, error.flatten().numpy() - MIN_ERROR)
        torch.testing.assert_close(fitted.applied(features), error, rtol=1e-3, atol=1e-5)

    def test_an_image_without_contrast_has_the_least(self) -> None:
        layers = Layers(torch.rand(1, LAYER_CHANNELS, 16, 16, generator=torch.Generator().manual_seed(1)))
        flat = torch.full((1, 3, 16, 16), 0.4)
        contrast = error_features(layers, flat, torch.full((1, 1, 16, 16), 0.1))[:, 1].exp()
        torch.testing.assert_close(contrast, torch.full_like(contrast, MIN_CONTRAST), rtol=1e-3, atol=0)
