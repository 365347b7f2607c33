"""The plot of run time against error."""

from __future__ import annotations

from pathlib import Path

import pytest

from extrags.errors import ConfigError
from extrags.metrics.fronts import fronts, means_by_cell
from extrags.report.fronts_plot import write_fronts_plot
from tests.extrags.metrics.test_fronts import case


def test_the_same_numbers_are_the_same_file(tmp_path: Path) -> None:
    cells = means_by_cell([case("a", 10, 20), case("b", 20, 25), case("b", 20, 19, width=80)])
    document = {"cells": cells, "fronts": fronts(cells)}
    for name in ("one.svg", "two.svg"):
        write_fronts_plot(document, tmp_path / name)
    text = (tmp_path / "one.svg").read_text()
    assert text == (tmp_path / "two.svg").read_text()
    assert "80x128" in text


def test_nothing_to_draw(tmp_path: Path) -> None:
    cells = means_by_cell([case("a", 10, None)])
    with pytest.raises(ConfigError, match="nothing to draw"):
        write_fronts_plot({"cells": cells, "fronts": []}, tmp_path / "none.svg")
