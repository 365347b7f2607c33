"""The page of a sequence: complete, self-contained, honest about what is missing."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from extrags.config import ReportConfig, profile_config
from extrags.errors import NonFiniteError, ShapeError
from extrags.metrics.registry import Metric, register_metric, unregister_metric
from extrags.report import ReportInputs, build_report
from extrags.report.numbers import regions
from extrags.sequence import Split
from tests.drawn_once import drawn_anew

from .conftest import Renders, result_of
from .pages import Page, decoded

CONFIG = ReportConfig(held_out_views=3, virtual_views=4)


@pytest.fixture(scope="module")
def html(inputs: ReportInputs) -> str:
    return build_report(inputs, CONFIG)


@pytest.fixture(scope="module")
def page(html: str) -> Page:
    return Page(html)


def test_page_loads_nothing_from_outside(page: Page, html: str) -> None:
    assert page.loads, "a page without images is not a report"
    assert all(load.startswith("data:image/") for load in page.loads)
    places = [link for link in page.links if not link.startswith("data:text/csv;")]
    assert all(link.startswith("#") and link[1:] in page.ids for link in places)
    assert "url(" not in html
    assert "@import" not in html
    for image in page.images:
        if str(image["src"]).startswith("data:image/svg"):
            svg = str(decoded(str(image["src"])))
            assert 'href="http' not in svg


def test_same_inputs_give_the_same_bytes(
    inputs: ReportInputs, html: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn_anew(monkeypatch)
    assert build_report(inputs, CONFIG) == html


def test_page_is_small(html: str) -> None:
    assert len(html.encode()) < 6_000_000


def test_every_image_shows_something_and_says_what(page: Page) -> None:
    for image in page.images:
        assert image["alt"], "an image without words"
        content = decoded(str(image["src"]))
        if isinstance(content, str):
            assert content.count("<path") > 10
        else:
            pixels = np.asarray(content.convert("RGB"))
            assert (pixels != pixels[0, 0]).any()
    alts = [str(image["alt"]) for image in page.images]
    assert sum(alt.startswith("Frame b_") and "render, mean" in alt for alt in alts) == 2 * 3
    assert sum(alt.startswith("Uncertainty of virtual view") for alt in alts) == 4
    assert sum(alt.startswith("Expected error of virtual view") for alt in alts) == 4
    assert sum(alt.startswith("The scene ") for alt in alts) == 3
    assert sum(alt.startswith("Slice of the occupancy grid") for alt in alts) == 3


def test_ids_are_unique(page: Page) -> None:
    assert len(page.ids) == len(set(page.ids))


def test_numbers_and_changes_are_on_the_page(page: Page) -> None:
    assert (
        "On 5 held-out views the final scene reaches 22.50 dB PSNR, 2.50 dB above the coarse reconstruction. "
        "On surface that no training frame saw it reaches 18.50 dB, 2.50 dB above the coarse one."
    ) in page.text
    assert "+2.50 better from 20.00" in page.text
    assert "\N{MINUS SIGN}0.062 better" in page.text  # LPIPS falls, which is good
    assert "20.0 % of the pixels" in page.text
    assert "1 min 05 s in all: 1 ran, 1 came from the cache, 1 skipped." in page.text
    assert "The cache spared 5.0 s" in page.text
    assert "the source has poses" in page.text
    assert "iterations 777 profile quick: 1500" in page.text
    assert "on the network AlexNet" in page.text


@pytest.mark.parametrize(
    ("profile", "differs"),
    [
        ("quick", None),
        ("quick, method 3dgs", None),
        ("balanced", "profile balanced: 5000"),
        ("", "default: 3000"),
        ("mine", "default: 3000"),
    ],
)
def test_settings_are_held_against_the_profile_of_the_run(
    inputs: ReportInputs, profile: str, differs: str | None
) -> None:
    quick = replace(inputs, config=profile_config("quick"), profile=profile)
    text = Page(build_report(quick, CONFIG)).text.split("Settings and environment")[1]
    assert ("profile quick:" in text or "default:" in text or "profile balanced:" in text) == bool(differs)
    assert differs is None or f"iterations 1500 {differs}" in text


def test_a_loss_is_called_a_loss(inputs: ReportInputs) -> None:
    worse = replace(inputs, coarse_metrics=inputs.final_metrics, final_metrics=inputs.coarse_metrics)
    text = Page(build_report(worse, CONFIG)).text
    assert "20.00 dB PSNR, 2.50 dB below the coarse reconstruction" in text
    assert "\N{MINUS SIGN}2.50 worse from 22.50" in text


def test_error_that_trajectories_take_away_is_told(inputs: ReportInputs) -> None:
    paths = [
        {**path, "value": value}
        for path, value in zip(inputs.exploration["trajectories"], (0.02, 0.004), strict=False)
    ]
    by_error = {
        **inputs.exploration,
        "trajectories": paths,
        "score": "error",
        "removable_error": 0.04,
        "removed_error": 0.024,
    }
    text = Page(build_report(replace(inputs, exploration=by_error), CONFIG)).text
    assert "4.00 %" in text
    assert "60 % of it" in text
    assert "50.00 %" in text
    assert "10.00 %" in text


def test_how_the_restorer_was_judged_is_told(inputs: ReportInputs, html: str) -> None:
    assert "reaches 26.04 dB, blending and filling 25.10 dB. Its error there is 1.24 times" in html
    assert "as in scenes like those it has learned from" in html
    assert inputs.pseudo is not None
    judged = {"restored_db": 20.0, "filled_db": 26.0, "error_over_expected": 2.5}
    for provenance, words in (
        ({"backend": "embedded", "judged": judged}, "is unlike those it has learned from"),
        (
            {"backend": "classical", "judged": judged},
            "The network was left out: on left-out frames of this scene it reaches 20.00 dB, 6.00 dB less",
        ),
        ({"backend": "classical"}, "Restored by classical."),
        (
            {"backend": "embedded", "judged": judged, "trained_on": "colons"},
            "Restored by embedded, weights for colons. On left-out",
        ),
        ({"backend": "classical", "reason": "why"}, "Restored by blending and filling: why."),
        (
            {"backend": "embedded", "judged": {**judged, "plain_db": 19.0}, "seamless": True},
            "cloned seamlessly into what is known, which keeps its colours. On left-out frames of this scene "
            "the network reaches 20.00 dB, without cloning 19.00 dB, blending and filling 26.00 dB.",
        ),
    ):
        pseudo = replace(inputs.pseudo, provenance=provenance)
        html = build_report(replace(inputs, pseudo=pseudo), ReportConfig())
        assert words in html
        assert ("it has learned from" in html) == (provenance["backend"] == "embedded")


@pytest.mark.parametrize(("score", "words"), [(0.7, "are like those"), (2.4, "are unlike those")])
def test_how_far_the_scene_is_from_the_training_data_is_told(
    inputs: ReportInputs, score: float, words: str
) -> None:
    assert inputs.pseudo is not None
    pseudo = replace(inputs.pseudo, provenance={**inputs.pseudo.provenance, "domain_score": score})
    text = Page(build_report(replace(inputs, pseudo=pseudo), ReportConfig())).text
    assert f"Domain score {score:.2f}: frames of this scene {words}" in text


def test_what_the_plan_left_out_is_named_with_its_reason(inputs: ReportInputs) -> None:
    plan = {
        "measurements": {"hole_share": 0.0004},
        "decisions": [
            {**line, "run": False, "reason": f"no need for {line['stage']}"}
            for line in inputs.plan["decisions"]
        ],
    }
    lean = replace(
        inputs, plan=plan, final=None, final_metrics=None, pseudo=None, trajectories=(), exploration=None,
        mesh=None, grid=None,
    )  # fmt: skip
    page = Page(build_report(lean, CONFIG))
    for stage in ("surface", "freespace", "explore", "enhance", "finetune"):
        assert f"The scene plan leaves out {stage}: no need for {stage}." in page.text
    assert "There is no fine-tuned scene to compare with." in page.text
    assert not any("final render" in str(image["alt"]) for image in page.images)


def test_measurements_of_the_plan_have_words_and_units(inputs: ReportInputs) -> None:
    measured = {"hole_share": 0.124, "gaussians": 14012.0, "depth_unit_mm": 1.688, "further_one": 0.5}
    plan = {**inputs.plan, "measurements": measured}
    text = Page(build_report(replace(inputs, plan=plan), CONFIG)).text
    assert "Holes in nearby views 12.40 %" in text
    assert "Median depth of the training views 1.688 mm" in text
    assert "further one 0.5" in text
    scaleless = replace(inputs, plan=plan, sequence=replace(inputs.sequence, metric=False))
    assert "training views 1.688 units of the scene" in Page(build_report(scaleless, CONFIG)).text


def test_bare_inputs_name_every_absent_part(inputs: ReportInputs) -> None:
    page = Page(build_report(ReportInputs(name="bare", sequence=inputs.sequence), CONFIG))
    for stage in ("evaluate", "enhance", "explore", "freespace", "surface", "coarse", "assess"):
        assert f"Nothing from the stage {stage} was handed to this report." in page.text
    assert "No settings were handed to this report." in page.text


def test_reasons_come_from_stages_and_caller_too(inputs: ReportInputs) -> None:
    bare = ReportInputs(
        name="bare",
        sequence=replace(inputs.sequence, world_from_camera=None, depth_mm=None),
        stages=[{"stage": "enhance", "state": "failed", "seconds": 1.0, "reason": "loss is NaN"}],
        absent={"poses": "COLMAP registered 2 of 30 frames"},
    )
    text = Page(build_report(bare, CONFIG)).text
    assert "The stage enhance failed: loss is NaN." in text
    assert "COLMAP registered 2 of 30 frames." in text


def test_lpips_without_weights_says_why(inputs: ReportInputs) -> None:
    result = result_of(20.0, 10)
    result["reasons"] = {"lpips_alex": "no LPIPS weights were given"}
    for tree in (result["metrics"], *result["per_view"]):
        for part in (tree, tree["aligned"], tree["observed"], tree["unobserved"]):
            part["lpips_alex"] = None
    text = Page(build_report(replace(inputs, coarse_metrics=result, final_metrics=result), CONFIG)).text
    assert "LPIPS (AlexNet): not available, no LPIPS weights were given." in text
    assert "Not measured here; the reason stands below the table of numbers." in text


def test_what_there_is_not_is_called_what_it_is(inputs: ReportInputs) -> None:
    result = result_of(20.0, 10)
    result["reasons"] = {
        "n_gaussians": "the renders are not of Gaussians",
        "unobserved": "no view has any",
    }
    text = Page(build_report(replace(inputs, coarse_metrics=result, final_metrics=result), CONFIG)).text
    assert "Number of Gaussians: not available, the renders are not of Gaussians." in text
    assert "Unobserved pixels: not available, no view has any." in text


def test_the_surface_has_a_table_where_there_are_figures_of_it(inputs: ReportInputs) -> None:
    def told(psnr: float, accuracy_mm: float | None, coverage: float) -> dict[str, object]:
        result = result_of(psnr, 1000)
        unobserved = {"accuracy_mm": psnr, "completeness_mm": None, "fscore": 0.1, "recall": coverage}
        result["metrics"]["surface"] = {
            "accuracy_mm": accuracy_mm,
            "completeness_mm": 0.8,
            "fscore": 0.7,
            "coverage": coverage,
            "unobserved": unobserved,
        }
        return result

    both = replace(inputs, coarse_metrics=told(20.0, 0.9, 0.6), final_metrics=told(22.0, 0.7, 0.65))
    text = Page(build_report(both, CONFIG)).text
    assert "Observed by training 0.90 → 0.70 −0.20 better 0.80 → 0.80 ±0.00" in text  # noqa: RUF001
    # Where there was next to no surface, what there was lay near the true one.
    assert "Never observed 20.00 → 22.00 +2.00 over more of the surface" in text
    assert "All that a camera sees 0.600 → 0.650 +0.050 better" in text
    assert "fused into a mesh in the same way for every method" in text

    lacking = told(22.0, None, 0.65)
    lacking["reasons"] = {"surface.accuracy_mm": "the scene has no surface"}
    text = Page(build_report(replace(both, final_metrics=lacking), CONFIG)).text
    assert "Surface accuracy: not available, the scene has no surface." in text


def test_a_page_without_figures_of_the_surface_does_not_speak_of_it(inputs: ReportInputs) -> None:
    result = result_of(20.0, 10)
    result["reasons"] = {"surface": "the sequence has no true depth"}
    text = Page(build_report(replace(inputs, coarse_metrics=result, final_metrics=result), CONFIG)).text
    assert "The surface" not in text
    assert "no true depth" not in text
    assert "fused into a mesh" not in text


def test_a_metric_of_colours_is_aligned_whatever_it_is_called(inputs: ReportInputs) -> None:
    register_metric(Metric("depth_of_colour", "Depth of colour", True, measure=lambda *_: {}))
    try:
        result = result_of(20.0, 10)
        result["metrics"]["aligned"]["depth_of_colour"] = 0.5
        _, aligned = regions(replace(inputs, coarse_metrics=result, final_metrics=result))[:2]
    finally:
        unregister_metric("depth_of_colour")
    shown = aligned["cells"][-1]
    assert shown is not None
    assert shown.final == "0.500"


def test_one_camera_and_nothing_held_out(inputs: ReportInputs) -> None:
    none = np.zeros(0, dtype=np.int64)
    alone = replace(inputs.sequence, split=Split("all", np.array([2]), none))
    page = Page(build_report(ReportInputs(name="alone", sequence=alone), CONFIG))
    assert sum(str(image["alt"]).startswith("The scene ") for image in page.images) == 3
    assert "1 training and 0 held-out cameras" in str(page.images[0]["alt"])


def test_frames_that_left_for_want_of_a_pose_are_told(inputs: ReportInputs, page: Page) -> None:
    held_out = len(inputs.frames)
    told = Page(build_report(replace(inputs, without_pose=(0, 3)), CONFIG))
    assert f"Held-out frames {held_out} of {held_out + 3}, the others without a pose" in told.text
    assert "the 3 without a pose are not among them" in told.text
    assert f"Training frames {len(inputs.sequence.train)} Held-out" in told.text
    assert "without a pose" not in page.text


def test_counts_of_virtual_views_agree(inputs: ReportInputs, page: Page) -> None:
    # Two trajectories of seven poses, of which the first is a real one.
    assert "Virtual views 12 Coverage before" in page.text
    assert "b_000 6 " in page.text
    assert "b_003 6 " in page.text
    assert "enhance.max_views" not in page.text
    more = {**inputs.exploration, "virtual_views": 14}
    text = Page(build_report(replace(inputs, exploration=more), CONFIG)).text
    assert "The exploration found 14 views; 12 of them were restored" in text


def test_charts_say_what_they_draw(inputs: ReportInputs, page: Page) -> None:
    def said(page: Page) -> str:
        return next(str(image["alt"]) for image in page.images if "PSNR of every" in str(image["alt"]))

    scenes = "PSNR of every held-out view in the coarse and the final scene"
    assert said(page) == f"{scenes}, and the gain against the share of pixels that training never saw"
    alone = replace(inputs, final=None, final_metrics=None)
    assert said(Page(build_report(alone, CONFIG))) == "PSNR of every held-out view in the coarse scene"
    views = [{**view, "unobserved": {}} for view in inputs.coarse_metrics["per_view"]]
    blind = {**inputs.coarse_metrics, "per_view": views}
    told = build_report(replace(inputs, coarse_metrics=blind, final_metrics=blind), CONFIG)
    assert said(Page(told)) == scenes


def test_holes_of_the_depth_are_explained(inputs: ReportInputs, page: Page) -> None:
    explained = "Light grey is where a scene has a hole"
    assert explained not in page.text
    alpha = inputs.coarse.alpha.copy()
    alpha[:, :5] = 0
    holes = replace(inputs.coarse, alpha=alpha)
    assert explained in Page(build_report(replace(inputs, coarse=holes), CONFIG)).text


def test_names_are_escaped(inputs: ReportInputs) -> None:
    html = build_report(replace(inputs, name='<script>alert("x")</script>'), CONFIG)
    assert "<script>alert" not in html


def test_masked_sequences_grey_out_what_does_not_count(inputs: ReportInputs) -> None:
    mask = inputs.sequence.mask.copy()
    mask[:, :, :10] = False
    masked = replace(inputs, sequence=replace(inputs.sequence, mask=mask))
    page = Page(build_report(masked, CONFIG))
    assert "Light grey lies outside the validity mask." in page.text
    truth = next(image for image in page.images if str(image["alt"]).endswith("as recorded"))
    pixels = np.asarray(decoded(str(truth["src"])).convert("RGB"))
    assert (pixels[:, :10] == (228, 231, 235)).all()


def test_many_large_views_stay_below_the_bound(inputs: ReportInputs) -> None:
    random = np.random.default_rng(1)
    sequence = inputs.sequence
    big = replace(
        sequence,
        rgb=random.integers(0, 256, (11, 400, 480, 3), dtype=np.uint8),
        mask=np.ones((11, 400, 480), dtype=bool),
        depth_mm=None,
        observed=None,
    )
    noise = random.integers(0, 256, (5, 400, 480, 3), dtype=np.uint8)
    renders = Renders(noise, np.ones((5, 400, 480)), np.ones((5, 400, 480)))
    html = build_report(replace(inputs, sequence=big, coarse=renders, final=renders), ReportConfig())
    assert len(html.encode()) < 6_000_000


def test_renders_that_do_not_fit_are_refused(inputs: ReportInputs) -> None:
    short = Renders(inputs.final.rgb[:2], inputs.final.alpha[:2], inputs.final.depth_mm[:2])
    with pytest.raises(ShapeError, match="final renders have shape"):
        replace(inputs, final=short)
    with pytest.raises(ShapeError, match="coarse metrics hold 1 views, expected 5"):
        replace(inputs, coarse_metrics={"metrics": {}, "per_view": [{}]})


def test_nan_in_a_shown_image_is_refused(inputs: ReportInputs) -> None:
    rgb = inputs.final.rgb.copy()
    rgb[2, 5, 5] = np.nan
    broken = Renders(rgb, inputs.final.alpha, inputs.final.depth_mm)
    with pytest.raises(NonFiniteError):
        build_report(replace(inputs, final=broken), CONFIG)


def test_protocol_words_agree_with_the_metrics(page: Page) -> None:
    from extrags.metrics.flip import PIXELS_PER_DEGREE
    from extrags.metrics.image import SSIM_SIGMA_PX, SSIM_WINDOW_PX
    from extrags.metrics.protocol import MIN_REGION_SHARE, PROTOCOL_VERSION, SURFACE_ALPHA

    assert f"{PIXELS_PER_DEGREE:.0f} pixels per degree" in page.text
    window = rf"{SSIM_WINDOW_PX} . {SSIM_WINDOW_PX} Gaussian window, . = {SSIM_SIGMA_PX} px"
    assert re.search(window, page.text)
    assert f"smaller than {100 * MIN_REGION_SHARE:.1f} % of the image" in page.text.replace(
        "\N{NO-BREAK SPACE}", " "
    )
    assert SURFACE_ALPHA == 0.5
    assert f"Evaluation protocol {PROTOCOL_VERSION}" in page.text


def test_real_types_fit_the_protocols() -> None:
    from extrags.exploration import Exploration
    from extrags.freespace import FreeSpace
    from extrags.metrics.protocol import RenderedViews
    from extrags.pseudo_views import PseudoViews
    from extrags.surface import Mesh

    fields = {
        RenderedViews: ("rgb", "alpha", "depth_mm"),
        FreeSpace: ("occupancy", "origin_mm", "axes", "voxel_mm"),
        Mesh: ("vertices", "triangles"),
        PseudoViews: (
            "rendered", "restored", "target", "uncertainty", "expected_error", "image_confidence",
            "reference", "clip",
        ),
    }  # fmt: skip
    for kind, names in fields.items():
        assert set(names) <= set(kind.__dataclass_fields__), kind
    assert callable(Exploration.summary)


def test_networks_of_lpips_that_were_asked_for_have_columns(inputs: ReportInputs) -> None:
    first = "LPIPS (VGG16)"
    assert first not in Page(build_report(inputs, CONFIG)).text
    result = result_of(20.0, 10)
    result["reasons"] = {"lpips_vgg": "no file of VGG"}
    for tree in (result["metrics"], *result["per_view"]):
        for part in (tree, tree["aligned"], tree["observed"], tree["unobserved"]):
            part["lpips_vgg"] = None
    text = Page(build_report(replace(inputs, coarse_metrics=result, final_metrics=result), CONFIG)).text
    assert f"{first}: not available, no file of VGG." in text
    assert "LPIPS (AlexNet)" in text
    for tree in (result["metrics"], *result["per_view"]):
        for part in (tree, tree["aligned"], tree["observed"], tree["unobserved"]):
            part["lpips_vgg"] = 0.4321
    text = Page(build_report(replace(inputs, coarse_metrics=result, final_metrics=result), CONFIG)).text
    assert "0.432" in text
    assert "on the network AlexNet and VGG16" in text


@pytest.mark.parametrize(
    ("intrinsics", "std", "said"),
    [
        ("estimated", 1.25, "30.0 px ± 1.2 (field of view "),
        ("guessed", None, "guessed: 30.0 px ("),
    ],
)
def test_intrinsics_that_nobody_stated_are_told(
    inputs: ReportInputs, html: str, intrinsics: str, std: float | None, said: str
) -> None:
    sequence = replace(inputs.sequence, intrinsics=intrinsics, focal_std_px=std)
    told = build_report(replace(inputs, sequence=sequence), CONFIG)
    assert said in told
    assert ("degrees), not determined" in told) == (intrinsics == "guessed")
    assert "Focal length" not in html


def test_coverage_of_the_depth_stands_beside_its_error(inputs: ReportInputs) -> None:
    def told(result: dict[str, object], error: float, coverage: float) -> dict[str, object]:
        depth = {"depth_absrel": error, "depth_coverage": coverage}
        return {**result, "metrics": {**result["metrics"], **depth}}  # type: ignore[dict-item]

    fuller = replace(
        inputs,
        coarse_metrics=told(result_of(20.0, 1000), 0.03, 0.49),
        final_metrics=told(result_of(22.5, 1500), 0.05, 1.0),
    )
    text = Page(build_report(fuller, CONFIG)).text
    assert "+0.020 from 0.030 over more pixels: coverage 49 % → 100 %" in text
    assert "+0.020 worse" not in text
