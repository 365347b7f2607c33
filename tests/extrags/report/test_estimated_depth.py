"""The section on estimated depth: what it shows, and that it says what the depth is."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from extrags.config import PROFILES, PipelineConfig, ReportConfig
from extrags.errors import ShapeError
from extrags.measured_depth import with_depth_error
from extrags.report import ReportInputs, build_report
from extrags.report.estimated_depth import estimated_depth
from extrags.sequence import EndoscopicSequence

from .pages import Page

CONFIG = ReportConfig(held_out_views=3, virtual_views=1)


@dataclass(frozen=True)
class Estimate:
    depth: np.ndarray
    expected_error: np.ndarray
    report: dict[str, Any] = field(default_factory=dict)


@pytest.fixture(scope="module")
def estimate(sequence: EndoscopicSequence) -> Estimate:
    """Five percent too far everywhere."""
    depth = 1.05 * sequence.depth_mm[sequence.train]
    return Estimate(
        depth,
        np.where(depth > 20, 0.3, 0.06).astype(np.float32),
        {
            "n_points": 1234,
            "points_from": "triangulation with the given poses",
            "median_expected_error": 0.062,
            "agreeing_share": 0.7,
            "shading": [{"slope": 0.48, "scatter": 0.2, "spread": 0.5, "pixels": 900}],
            "completion": "bundled",
        },
    )


def test_depth_and_what_it_rests_on(sequence: EndoscopicSequence, estimate: Estimate) -> None:
    withheld = sequence.without_training_depth()
    page = Page(build_report(ReportInputs(name="tube", sequence=withheld, depth=estimate), CONFIG))
    assert "estimated-depth" in page.ids
    assert "#estimated-depth" in page.links
    assert "estimated from the images of the training frames, not measured" in page.text
    assert "a network trained on procedural scenes" in page.text
    for words in (
        "234, from triangulation with the given poses",
        "Median expected error 6.2 %",
        "Pixels confirmed by other frames 70 %",
        "to the power \N{MINUS SIGN}0.48, scatter 0.20 of log-distances that spread by 0.50",
        "Mean relative error 5.0 %",
        "Lengths are in mm. 3 of 6 training frames",
    ):
        assert words in page.text
    alts = [str(image["alt"]) for image in page.images]
    for end in ("", ", estimated depth", ", true depth, withheld"):
        assert f"Training frame b_001{end}" in alts
    assert "Training frame b_001, expected relative error of the estimated depth" in alts


def test_an_arbitrary_scale_is_said(sequence: EndoscopicSequence, estimate: Estimate) -> None:
    bare = replace(sequence, depth_mm=None, metric=False)
    found = estimated_depth(bare, estimate, 2, 10_000)
    assert ("Scale", "arbitrary scale") in found.facts
    assert found.unit == "units of the scene"
    assert found.table.scales[0].label == "z-depth in units of the scene"
    # Without truth there is nothing to compare with.
    assert [cell.label for cell in found.table.rows[0].cells] == [
        "Frame",
        "Estimated depth",
        "Expected error",
    ]
    assert "Mean relative error" not in dict(found.facts)


def test_no_relation_of_brightness_and_no_network(sequence: EndoscopicSequence, estimate: Estimate) -> None:
    flat = {"slope": 0.0, "scatter": 9.0, "spread": 9.0, "pixels": 0}
    plain = replace(estimate, report={**estimate.report, "shading": [flat, flat], "completion": "none"})
    inputs = ReportInputs(name="tube", sequence=replace(sequence, depth_mm=None), depth=plain)
    text = Page(build_report(inputs, CONFIG)).text
    assert "Shading, recording 2 no relation of brightness and distance" in text
    assert "a network trained" not in text


def test_gross_doubts_of_the_poses_are_on_the_page(sequence: EndoscopicSequence, estimate: Estimate) -> None:
    """They were in the log alone, and the page had nothing but poor figures."""

    def text(config: PipelineConfig | None = None, **told: Any) -> str:
        found = replace(estimate, report={**estimate.report, **told})
        inputs = ReportInputs(name="tube", sequence=sequence, depth=found, config=config)
        return Page(build_report(inputs, CONFIG)).text

    assert "Warning:" not in text(combined_with_measured=True, median_measured_error=0.04)
    told = "the poses explain 34 % of 900 feature matches"
    assert "Warning: The poses explain 34 % of 900 feature matches." in text(contradiction=told)
    off = {"combined_with_measured": True, "median_measured_error": 0.2}
    said = "Warning: Training frames disagree about their depth, as if each were off by 20.0 % in its own way"
    assert f"{said}, or as if poses were wrong" in text(**off)
    given = PROFILES["quick"].with_overrides({"ingest.depth_error": 0.2})
    assert "Warning:" not in text(given, **off)


def test_a_monocular_network_is_told(sequence: EndoscopicSequence, estimate: Estimate) -> None:
    fits = [
        {"scatter": 0.12, "frames_aligned": 4, "pixels": 900},
        {"scatter": 9.0, "frames_aligned": 0, "pixels": 0},
    ]
    told = replace(estimate, report={**estimate.report, "monocular": fits})
    text = Page(
        build_report(
            ReportInputs(name="tube", sequence=sequence.without_training_depth(), depth=told), CONFIG
        )
    ).text
    assert "recording 1 4 frames aligned, scatter 0.12 of log-distances" in text
    assert "recording 2 could not be aligned with stereo" in text


def test_measured_depth_has_no_section(inputs: ReportInputs) -> None:
    assert "estimated-depth" not in Page(build_report(inputs, CONFIG)).ids


def test_another_number_of_frames_is_refused(sequence: EndoscopicSequence, estimate: Estimate) -> None:
    with pytest.raises(ShapeError, match=r"estimated depth has shape \(5, 40, 48\), expected \(6, 40, 48\)"):
        ReportInputs(name="tube", sequence=sequence, depth=replace(estimate, depth=estimate.depth[1:]))


def test_measured_depth_that_was_corrected_stands_beside_it(
    sequence: EndoscopicSequence, estimate: Estimate
) -> None:
    told = {**estimate.report, "combined_with_measured": True, "median_measured_error": 0.045}
    given = with_depth_error(sequence, None, 0.045)
    inputs = ReportInputs(name="tube", sequence=given, depth=replace(estimate, report=told))
    page = Page(build_report(inputs, CONFIG))
    for words in (
        "Error of the measured depth 4.5 %",
        "Mean difference from the measured depth 5.0 %",
        "disagree about the depth that the source brings",
    ):
        assert words in page.text
    assert "Training frame b_001, depth as measured" in [str(image["alt"]) for image in page.images]
