"""The page of a run of several sequences, from the outcomes of its runs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from extrags.store import Ref, Store
from extrags.store.retention import Policy, planned_removals
from flows.outcome import SequenceOutcome
from flows.pages import dataset_page
from flows.runners import DirectRunner
from tasks.report import PAGE
from tests.extrags.report.pages import Page


def page_of(
    outcomes: list[SequenceOutcome],
    store: Store,
    settings: list[dict[str, Any]] | None = None,
    name: str = "dataset",
) -> Page:
    given = settings or [{} for _ in outcomes]
    place = dataset_page(outcomes, given, name, "quick", store, DirectRunner(store.root))
    return Page(Path(place).read_text())


def test_several_seeds_have_a_table_of_their_spread(tmp_path: Path) -> None:
    outcomes = [
        SequenceOutcome("phantom/0@sparse", variant=f"{method}, seed {seed}", seed=seed)
        for method in ("3dgs", "extrags")
        for seed in (0, 1)
    ]
    page = page_of(outcomes, Store(tmp_path), name="seeds")
    assert "phantom/0@sparse, seed 1 [3dgs]" in page.text
    spread = page.text.split("Spread over seeds")[1]
    assert "phantom/0@sparse [3dgs] 2" in spread
    assert "phantom/0@sparse [extrags] 2" in spread


def test_it_links_the_pages_of_this_run_and_keeps_them(tmp_path: Path) -> None:
    store = Store(tmp_path)

    def outcome(views: str) -> SequenceOutcome:
        ref = report(store, views)
        return SequenceOutcome("phantom/0@sparse", refs={"report": ref}, report=f"{ref.uri}/{PAGE}")

    first, second = (
        Path(dataset_page([outcome(views)], [{}], "dataset", "quick", store, DirectRunner(store.root)))
        for views in ("one", "three")
    )
    assert first != second
    for page, key in ((first, "report-v12-one"), (second, "report-v12-three")):
        assert f'href="../{key}/{PAGE}"' in page.read_text()
        assert (page.parent / ".." / key / PAGE).exists()
    for place in (first.parent, first.parent.with_name("report-v12-one")):
        os.utime(place, (1e9, 1e9))
    former, old = Policy(keep_last=1, unreachable=True), Policy(older_than_s=86400.0)
    for policy in (former, old):
        gone = planned_removals(store, policy).removed
        assert {item.key for item in gone} == {"report-v12-one", first.parent.name}
    # A page that is kept keeps what it links to, however old.
    os.utime(first.parent)
    assert planned_removals(store, old).removed == []


def report(store: Store, views: str) -> Ref:
    """A sequence's page, made with so many views."""
    with store.slot(stage="report", version=12, key=f"report-v12-{views}", label="phantom/0@sparse") as slot:
        (slot.path / PAGE).write_text(views)
    return slot.ref


def test_settings_that_were_given_are_told_and_are_in_the_manifest(tmp_path: Path) -> None:
    outcomes = [SequenceOutcome(f"phantom/{number}@sparse") for number in (0, 1)]
    store = Store(tmp_path)
    shared = {"coarse.iterations": 300, "ingest.width": 80}
    text = page_of(outcomes, store, [shared, shared]).text
    assert "Settings given coarse.iterations = 300, ingest.width = 80" in text
    (manifest,) = store.ls("dataset-report")
    assert manifest.config["settings"] == [shared, shared]

    text = page_of(outcomes, store, [shared, {}]).text
    assert "phantom/0@sparse: coarse.iterations = 300, ingest.width = 80" in text
    assert "phantom/1@sparse: none beside the profile" in text
