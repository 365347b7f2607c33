"""The page of a run of several sequences, from the outcomes of its runs."""

from __future__ import annotations

from pathlib import Path

from flows.outcome import SequenceOutcome
from flows.pages import dataset_page
from flows.runners import DirectRunner
from tests.extrags.report.pages import Page


def test_several_seeds_have_a_table_of_their_spread(tmp_path: Path) -> None:
    outcomes = [
        SequenceOutcome("phantom/0@sparse", variant=f"{method}, seed {seed}", seed=seed)
        for method in ("3dgs", "extrags")
        for seed in (0, 1)
    ]
    page = Page(Path(dataset_page(outcomes, "seeds", "quick", DirectRunner(str(tmp_path)))).read_text())
    assert "phantom/0@sparse, seed 1 [3dgs]" in page.text
    spread = page.text.split("Spread over seeds")[1]
    assert "phantom/0@sparse [3dgs] 2" in spread
    assert "phantom/0@sparse [extrags] 2" in spread
