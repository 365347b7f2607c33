"""Numbers that are taken out of a page: what stands in the files."""

from __future__ import annotations

import base64
import csv
import io

import numpy as np
import pytest

from extrags.config import ReportConfig
from extrags.report import ReportInputs
from extrags.report.build import build_report
from extrags.report.charts import gain_chart, history_chart, methods_chart, sequences_chart, views_chart
from extrags.report.downloads import Chart, csv_text, file_name
from extrags.report.numbers import numbers_csv, per_view_csv
from tests.extrags.report.pages import Page


def lines(uri: str) -> list[dict[str, str]]:
    head, _, content = uri.partition(",")
    assert head == "data:text/csv;charset=utf-8;base64"
    return list(csv.DictReader(io.StringIO(base64.b64decode(content).decode("utf-8"), newline="")))


def test_csv_is_quoted_and_what_is_missing_is_empty() -> None:
    text = csv_text(["name", "value"], [['a "b", c', float("nan")], ["d", 1 / 3], ["e", None], ["f", 12]])
    assert text == 'name,value\r\n"a ""b"", c",\r\nd,0.333333333\r\ne,\r\nf,12\r\n'


def test_names_of_others_are_no_formulas() -> None:
    rows = [["=1+1", -0.5], ["@a", -3], ["-0.5", "+x"], ["\ta", "a=b"]]
    assert csv_text(["=run", "value"], rows) == (
        "'=run,value\r\n'=1+1,-0.5\r\n'@a,-3\r\n-0.5,'+x\r\n'\ta,a=b\r\n"
    )


def test_file_names_are_plain() -> None:
    assert file_name("PSNR, never observed (dB)") == "psnr_never_observed_db"


class TestCharts:
    def test_views(self) -> None:
        coarse, final = np.array([20.0, np.nan]), np.array([21.5, 22.0])
        rows = lines(views_chart(coarse, final, np.array([0.25, 0.0]), ["a_0001", "a_0002"]).csv)
        assert rows == [
            {
                "view": "a_0001",
                "coarse_psnr_db": "20",
                "final_psnr_db": "21.5",
                "unobserved_share": "0.25",
            },
            {"view": "a_0002", "coarse_psnr_db": "", "final_psnr_db": "22", "unobserved_share": "0"},
        ]

    def test_training(self) -> None:
        entries = [{"iteration": 0, "loss": 0.5, "psnr": 12.0}, {"iteration": 50, "loss": 0.25, "psnr": 15.0}]
        rows = lines(history_chart({"coarse": entries, "finetune": entries[:1]}).csv)
        assert [row["stage"] for row in rows] == ["coarse", "coarse", "finetune"]
        assert rows[1] == {"stage": "coarse", "iteration": "50", "loss": "0.25", "psnr": "15"}

    def test_trajectories(self) -> None:
        chart = gain_chart([3.5, 1.25], ["#000000", "#111111"], title="what each adds")
        assert [row["adds_percent"] for row in lines(chart.csv)] == ["3.5", "1.25"]
        assert chart.name == "trajectories"

    def test_sequences_and_methods(self) -> None:
        one = np.array([20.0])
        assert lines(sequences_chart(["p/0"], one, one + 1, one).csv)[0]["final_psnr_db"] == "21"
        values = {"a": {"p/0": [20.0, 21.0]}, "b": {"p/0": [22.0]}}
        seconds = {"a": {"p/0": [1.0, 2.0]}, "b": {"p/0": [3.0]}}
        chart = methods_chart(["p/0"], values, seconds, {"a": "#000", "b": "#111"}, "PSNR (dB)")
        found = [(row["method"], row["PSNR (dB)"], row["seconds"]) for row in lines(chart.csv)]
        assert found == [("a", "20", "1"), ("a", "21", "2"), ("b", "22", "3")]

    def test_a_chart_without_numbers_offers_none(self) -> None:
        assert Chart("data:image/svg+xml;base64,").csv == ""


class TestNumbers:
    def test_means_are_those_of_the_metrics(self, inputs: ReportInputs) -> None:
        assert inputs.coarse_metrics is not None
        assert inputs.final_metrics is not None
        found = {(row["pixels"], row["exposure"], row["metric"]): row for row in lines(numbers_csv(inputs))}
        plain = found["All valid pixels", "plain", "psnr"]
        assert float(plain["coarse"]) == pytest.approx(inputs.coarse_metrics["metrics"]["psnr"])
        assert float(plain["final"]) == pytest.approx(inputs.final_metrics["metrics"]["psnr"])
        assert plain["unit"] == "dB"
        assert plain["better"] == "higher"

    def test_every_view_of_both_scenes(self, inputs: ReportInputs) -> None:
        rows = lines(per_view_csv(inputs))
        assert len(rows) == 2 * len(inputs.frames)
        assert {row["scene"] for row in rows} == {"coarse", "final"}
        assert inputs.final_metrics is not None
        expected = inputs.final_metrics["per_view"][0]["psnr"]
        first = next(row for row in rows if row["scene"] == "final")
        assert float(first["psnr"]) == pytest.approx(expected)

    def test_every_column_has_a_name_of_its_own(self, inputs: ReportInputs) -> None:
        content = base64.b64decode(per_view_csv(inputs).partition(",")[2]).decode("utf-8")
        header, *rows = csv.reader(io.StringIO(content, newline=""))
        assert len(set(header)) == len(header)
        assert header[:2] == ["frame", "scene"]
        assert rows[0][0] == inputs.sequence.frame_name(int(inputs.frames[0]))


def test_every_chart_of_a_page_can_be_saved(inputs: ReportInputs) -> None:
    html = build_report(inputs, ReportConfig(held_out_views=1, virtual_views=1, viewer_mb=0))
    page = Page(html)
    charts = html.count('class="chart"')
    assert charts >= 3
    assert html.count("data-save=") == charts
    files = [link for link in page.links if link.startswith("data:text/csv;")]
    assert len(files) == charts + 2
    assert all(lines(link) for link in files)
