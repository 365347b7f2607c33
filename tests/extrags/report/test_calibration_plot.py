from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from extrags.errors import ConfigError
from extrags.report.calibration_plot import calibration_chart, write_calibration_plot
from extrags.restoration.uncertainty.reliability_diagram import calibration


def curve(bias: float) -> dict[str, object]:
    error = np.random.default_rng(2).random((1, 64, 64)) * np.linspace(0.02, 0.3, 64)
    return calibration(bias * error, error[..., None], np.ones(error.shape, bool))


def test_a_picture_of_one_and_of_several(tmp_path: Path) -> None:
    for name, curves in (("one.png", {"a": curve(1)}), ("sub/two.png", {"a": curve(1), "b": curve(0.5)})):
        write_calibration_plot(curves, tmp_path / name)
        with Image.open(tmp_path / name) as picture:
            assert picture.size == (720, 690)
            shades = np.asarray(picture.convert("RGB")).reshape(-1, 3)
        # Paper, ink, and a colour for every curve.
        assert len(np.unique(shades, axis=0)) > 50


def test_the_chart_of_a_page_is_the_same_every_time() -> None:
    first, second = (calibration_chart({"a": curve(2), "b": curve(1)}) for _ in range(2))
    assert first == second
    assert first.uri.startswith("data:image/svg+xml")


def test_a_bad_prediction_without_ranks_is_drawn_too(tmp_path: Path) -> None:
    flat = calibration(np.zeros((1, 16, 16)), np.zeros((1, 16, 16, 3)), np.ones((1, 16, 16), bool))
    assert flat["rank_correlation"] is None
    write_calibration_plot({"flat": flat}, tmp_path / "flat.svg")
    assert (tmp_path / "flat.svg").read_text().startswith("<?xml")


def test_what_cannot_be_drawn(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="predicts its error"):
        write_calibration_plot({}, tmp_path / "none.png")
    with pytest.raises(ConfigError, match="cannot be written"):
        write_calibration_plot({"a": curve(1)}, tmp_path / "plot.unknown")
