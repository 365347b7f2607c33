"""The pieces a page is put together from."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from extrags.errors import ConfigError, NonFiniteError, ShapeError
from extrags.metrics.registry import metric_named
from extrags.report import DatasetRow, ReportInputs, build_dataset_report
from extrags.report.charts import drawing_style, history_chart, views_chart
from extrags.report.encode import as_uint8, color_mapped, fitted_image, outlined, png_image
from extrags.report.image_table import evenly_spaced
from extrags.report.space import occupancy_slices, scene_views, trajectory_colors
from extrags.report.views import virtual_rows
from extrags.report.wording import compare, duration, number

from .conftest import metrics_of
from .pages import Page, decoded


def test_colours_become_bytes_by_rounding() -> None:
    image = np.array([[[-1.0, 0.5, 2.0]]])
    assert as_uint8(image).tolist() == [[[0, 128, 255]]]
    with pytest.raises(NonFiniteError):
        as_uint8(np.full((2, 2, 3), np.nan))
    with pytest.raises(ShapeError):
        as_uint8(np.zeros((2, 2, 3), dtype=np.int64))


def test_images_survive_encoding() -> None:
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    assert np.array_equal(np.asarray(decoded(png_image(image).uri)), image)
    fitted = fitted_image(image, 10_000)
    assert (fitted.width, fitted.height) == (30, 20)
    assert np.array_equal(np.asarray(decoded(fitted.uri)), image)


@pytest.mark.parametrize("largest_bytes", [60_000, 20_000, 5_000])
def test_fitted_images_keep_to_their_bound(largest_bytes: int) -> None:
    image = np.random.default_rng(0).integers(0, 256, (300, 600, 3), dtype=np.uint8)
    fitted = fitted_image(image, largest_bytes)
    assert len(fitted.uri) <= largest_bytes
    assert fitted.width / fitted.height == pytest.approx(2, rel=0.05)


def test_a_bound_below_a_thumbnail_is_refused() -> None:
    with pytest.raises(ConfigError, match="held_out_views"):
        fitted_image(np.random.default_rng(0).integers(0, 256, (300, 600, 3), dtype=np.uint8), 300)


def test_color_map_ends_and_gaps() -> None:
    values = np.array([[-1.0, 0.0, 0.5, 1.0, 9.0, np.nan]])
    shown = color_mapped(values, 0, 1, colormap="gray")[0]
    assert shown[:, 0].tolist() == [0, 0, 128, 255, 255, 228]


def test_outline_is_the_inner_edge() -> None:
    region = np.zeros((7, 7), dtype=bool)
    region[2:5, 2:5] = True
    drawn = outlined(np.zeros((7, 7, 3), dtype=np.uint8), region, (9, 9, 9))[..., 0] == 9
    assert drawn.sum() == 8
    assert not drawn[3, 3]


def test_views_are_spread_evenly_and_never_repeat() -> None:
    assert evenly_spaced(12, 3).tolist() == [2, 6, 10]
    assert evenly_spaced(3, 9).tolist() == [0, 1, 2]
    assert evenly_spaced(0, 4).tolist() == []


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.04, "0.0 s"), (9.97, "10 s"), (59.6, "1 min 00 s"), (125, "2 min 05 s"), (7440, "2 h 04 min")],
)
def test_durations(seconds: float, words: str) -> None:
    assert duration(seconds) == words


def test_numbers_have_a_real_minus_and_no_minus_zero() -> None:
    assert number(-1.234, 2) == "\N{MINUS SIGN}1.23"
    assert number(-0.001, 2) == "0.00"
    assert number(0.001, 2, signed=True) == "±0.00"
    assert number(None, 2) == number(float("nan"), 2) == "\N{EN DASH}"


def test_better_depends_on_the_metric() -> None:
    psnr, lpips = metric_named("psnr"), metric_named("lpips_alex")
    assert compare(psnr, 20, 21).verdict == "better"
    assert compare(lpips, 0.3, 0.4).verdict == "worse"
    assert compare(psnr, 20, 20.001).verdict == "equal"
    assert compare(psnr, 20, None).verdict == ""


def test_charts_cope_with_gaps_and_leave_matplotlib_alone() -> None:
    import matplotlib

    before = dict(matplotlib.rcParams)
    gap = np.array([20.0, np.nan, 22.0])
    chart = str(decoded(views_chart(gap, gap + 1, np.array([0.1, np.nan, 0.3])).uri))
    assert "nan" not in chart
    entries = [{"iteration": 0.0, "loss": 0.5, "psnr": 12.0, "n_gaussians": 10.0}]
    assert "<svg" in str(decoded(history_chart({"coarse": entries, "finetune": []}).uri))
    assert dict(matplotlib.rcParams) == before


def test_charts_are_drawn_in_turns() -> None:
    from concurrent.futures import ThreadPoolExecutor

    values = np.linspace(20, 25, 8)
    with ThreadPoolExecutor(4) as pool:
        charts = list(pool.map(lambda _: views_chart(values, values + 1, None).uri, range(8)))
    assert len(set(charts)) == 1
    with drawing_style():
        pass  # the lock is free again


def test_scene_views_show_what_they_are_given(inputs: ReportInputs) -> None:
    cameras = inputs.sequence.cameras
    train, held_out = cameras[inputs.sequence.train], cameras[inputs.sequence.test]

    def colors(*args: object) -> list[np.ndarray]:
        figures = scene_views(train, held_out, *args, unit="mm")
        return [np.asarray(decoded(figure.image.uri).convert("RGB")).reshape(-1, 3) for figure in figures]

    def tissue(image: np.ndarray) -> float:
        red, _, blue = image.astype(int).T
        return float((red - blue > 15).mean())

    bare, mesh, voxels = colors((), None, None), colors((), inputs.mesh, None), colors((), None, inputs.grid)
    assert max(map(tissue, bare)) < 0.01
    assert min(map(tissue, mesh)) > 0.1
    assert min(map(tissue, voxels)) > 0.1
    violet = np.array([int(trajectory_colors(2)[0][i : i + 2], 16) for i in (1, 3, 5)])
    with_paths = colors(inputs.trajectories, inputs.mesh, None)
    assert all((np.abs(image - violet).max(1) < 3).any() for image in with_paths)
    assert not any((np.abs(image - violet).max(1) < 3).any() for image in mesh)


def test_slices_show_states_and_cameras(inputs: ReportInputs) -> None:
    train = inputs.sequence.cameras[inputs.sequence.train]
    figures = occupancy_slices(inputs.grid, train, inputs.trajectories)
    across = np.asarray(decoded(figures[0].image.uri))  # a disc: the tube cut across
    middle = across.shape[0] // 2
    assert across[0, 0].tolist() == [226, 230, 235]
    assert (across.reshape(-1, 3) == [178, 134, 120]).all(1).any()
    assert across[middle - 20, middle].tolist() == [255, 255, 255]
    along = np.asarray(decoded(figures[1].image.uri)).reshape(-1, 3)
    assert (along == [29, 39, 51]).all(1).any()  # training cameras
    assert "free" in figures[0].alt


def row(name: str, gain: float, **more: object) -> DatasetRow:
    return DatasetRow(name, "completed", 60.0, metrics_of(20.0), metrics_of(20.0 + gain), **more)


def test_dataset_page_compares_and_names_failures() -> None:
    rows = [
        row("phantom/0", 1.0, link="phantom-0.html", seed=0),
        row("phantom/0", 3.0, seed=1),
        row("phantom/1", -1.0),
        DatasetRow("phantom/2", "failed", 2.0, error="frame 0003: zero focal length"),
    ]
    html = build_dataset_report(rows, name="phantom")
    page = Page(html)
    assert html == build_dataset_report(rows, name="phantom")
    assert "3 of 4 runs completed." in page.text
    assert "Sequences 3 Runs 4" in page.text
    # Of the sequences' means, 2 and -1.
    assert "changes by +0.50 dB on average; 2 of 3 gain" in page.text
    assert "Mean of 2, ± between them" in page.text
    assert "frame 0003: zero focal length" in page.text
    assert "+2.00 better ± 1.41" in page.text  # two seeds: 1 and 3
    assert "+0.50 better ± 2.12" in page.text  # two sequences: 2, -1
    assert [link for link in page.links[1:] if not link.startswith("data:")] == ["phantom-0.html"]
    assert all(load.startswith("data:image/") for load in page.loads)


def test_dataset_page_of_one_run_a_sequence_speaks_of_sequences() -> None:
    page = Page(build_dataset_report([row("phantom/0", 1.0), row("phantom/1", 2.0)]))
    assert "2 of 2 sequences completed." in page.text
    assert "Runs" not in page.text


def test_stages_that_rows_share_took_their_time_once() -> None:
    def made(stage: str, seconds: float, *keys: str) -> dict[str, Any]:
        return {"stage": stage, "state": "ran", "made_seconds": seconds, "artefacts": list(keys)}

    shared, first, second = (
        made(*told) for told in (("coarse", 40.0, "a"), ("evaluate", 30.0, "b"), ("evaluate", 5.0, "c"))
    )
    rows = [
        replace(row("phantom/0", 1.0), seconds=70.0, stages=[shared, first]),
        # And 2 s of a stage that nothing is known of.
        replace(row("phantom/1", 1.0), seconds=47.0, stages=[shared, second]),
    ]
    assert "Time to make all 1 min 17 s" in Page(build_dataset_report(rows)).text


def test_dataset_page_names_variants() -> None:
    page = Page(build_dataset_report([row("phantom/0", gain, variant=f"seed {gain:.0f}") for gain in (1, 2)]))
    assert "2 of 2 runs completed." in page.text
    assert "Sequences 1 Runs 2" in page.text
    assert "phantom/0 [seed 2]" in page.text


def test_dataset_page_does_not_mix_variants_of_several_seeds() -> None:
    rows = [
        row("phantom/0", gain + 2 * seed, variant=variant, seed=seed)
        for variant, gain in (("3dgs", 1.0), ("coarse", 5.0))
        for seed in (0, 1)
    ]
    spread = Page(build_dataset_report(rows)).text.split("Spread over seeds")[1]
    # Two seeds each, 2 dB apart.
    assert "phantom/0 [3dgs] 2" in spread
    assert "+2.00 better ± 1.41" in spread
    assert "phantom/0 [coarse] 2" in spread
    assert "+6.00 better ± 1.41" in spread


def test_dataset_page_of_nothing_but_failures() -> None:
    page = Page(build_dataset_report([DatasetRow("a", "failed", 1.0, error="no frames")]))
    assert "None of them has both a coarse and a final figure to compare." in page.text
    assert Page(build_dataset_report([])).text.count("The run held no sequences.") == 1


def test_errors_over_different_pixels_are_not_judged() -> None:
    absrel = metric_named("depth_absrel")
    filled = compare(absrel, 0.030, 0.041, coverage=(0.94, 1.0))
    assert filled.verdict == "other pixels"
    assert filled.change == "+0.011"
    thin = "\N{NARROW NO-BREAK SPACE}"
    assert filled.coverage == f"over more pixels: coverage 94{thin}% → 100{thin}%"
    assert compare(absrel, 0.03, 0.02, coverage=(1.0, 0.9)).coverage.startswith("over fewer pixels")
    alike = compare(absrel, 0.030, 0.041, coverage=(0.991, 0.9999))
    assert alike.verdict == "worse"
    assert alike.coverage == f"coverage 99{thin}% → 100{thin}%"
    assert compare(absrel, 0.030, 0.041).coverage == ""


def test_dataset_page_does_not_judge_depth_over_different_pixels() -> None:
    def covered(name: str, before: float, after: float) -> DatasetRow:
        coarse, final = metrics_of(20.0), metrics_of(21.0)
        coarse |= {"depth_absrel": 0.030, "depth_coverage": before}
        final |= {"depth_absrel": 0.041, "depth_coverage": after}
        return DatasetRow(name, "completed", 60.0, coarse, final)

    text = Page(build_dataset_report([covered("a", 0.9, 1.0), covered("b", 0.8, 1.0)])).text
    assert "+0.011 worse" not in text
    assert "over more pixels: coverage 90" in text
    assert "+0.011 worse" in Page(build_dataset_report([covered("a", 1.0, 1.0)])).text
    means = text.split("± between them")[1]
    assert "over more pixels: coverage 85" in means


def test_a_mean_says_of_how_many_it_is() -> None:
    """Depth is known of one of three; opposite coverages of two do not cancel."""
    known, plain = metrics_of(20.0) | {"depth_absrel": 0.05}, metrics_of(21.0)
    blind = [metrics_of(psnr) | {"depth_absrel": None} for psnr in (20.0, 21.0)]
    rows = [
        DatasetRow("phantom/0", "completed", 60.0, known, plain | {"depth_absrel": 0.04}),
        *(DatasetRow(name, "completed", 60.0, *blind) for name in ("sinus/0", "sinus/1")),
    ]
    means = Page(build_dataset_report(rows)).text.split("of 3, ± between them")[1]
    assert "0.050 → 0.040 −0.010 better of 1" in means  # noqa: RUF001

    def covered(name: str, before: float, after: float) -> DatasetRow:
        coarse = metrics_of(20.0) | {"depth_absrel": 0.05, "depth_coverage": before}
        return DatasetRow(
            name, "completed", 60.0, coarse, plain | {"depth_absrel": 0.03, "depth_coverage": after}
        )

    text = Page(build_dataset_report([covered("a", 0.8, 1.0), covered("b", 1.0, 0.8)])).text
    assert "−0.020 better" not in text  # noqa: RUF001


def test_what_is_written_beside_the_picture_is_on_no_page(inputs: ReportInputs) -> None:
    """Reference frames were shown as recorded, with the name of the patient in their dark surround."""
    assert inputs.pseudo is not None
    rgb, mask = inputs.sequence.rgb.copy(), inputs.sequence.mask.copy()
    rgb[:, :8], mask[:, :8] = 255, False
    table = virtual_rows(inputs.pseudo, replace(inputs.sequence, rgb=rgb, mask=mask), 2, 10**6)
    shown = decoded(table.rows[1].cells[0].image.uri)
    assert not isinstance(shown, str)
    assert np.ptp(np.asarray(shown.convert("RGB"))[:6].reshape(-1, 3).astype(int), axis=0).max() < 4
    assert np.asarray(shown)[:6].max() < 250
    assert table.masked
    assert not virtual_rows(inputs.pseudo, inputs.sequence, 2, 10**6).masked
