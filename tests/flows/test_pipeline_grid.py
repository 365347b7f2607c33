"""The grid of methods by budgets: what is charged, what is shared, going on after an interruption."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from extrags.config import PipelineConfig, profile_config
from extrags.errors import ConfigError
from extrags.metrics.registry import PROTOCOL_VERSION
from extrags.restoration.diffusion.weights import COLONS, starting_weights
from flows.budgets import Budget, budgets_of, parsed_vary
from flows.cli import main
from flows.commands.bench_pipeline import grid_markdown
from flows.pipeline_grid import DIED, Cell, cells_of, run_cell, run_grid
from flows.selection import Chosen
from tests.documented_json import undocumented
from tests.flows.tiny import SEQUENCE, TINY

SMALL = {**TINY, "ingest.max_frames": 8}
BUDGETS = [Budget("few", {"coarse.iterations": 10}), Budget("more", {"coarse.iterations": 20})]


def of(budgets: list[Budget]) -> Callable[[PipelineConfig], list[Budget]]:
    """The same budgets, whatever the settings of a run."""
    return lambda _: budgets


def cells(repeats: int = 1, **settings: Any) -> list[Cell]:
    return cells_of(
        [Chosen("phantom/0@sparse")], ["coarse"], ["quick"], of(BUDGETS), [0], repeats, {**SMALL, **settings}
    )


class TestCells:
    def test_budgets_that_do_not_reach_a_method_are_one_cell(self) -> None:
        budgets = [Budget("a", {"finetune.iterations": 5}), Budget("b", {"finetune.iterations": 6})]
        found = cells_of([Chosen(SEQUENCE)], ["coarse", "extrags"], ["quick"], of(budgets), [0], 1, {})
        assert [(cell.method, cell.budget) for cell in found] == [
            ("coarse", "profile"),
            ("extrags", "finetune.iterations=5"),
            ("extrags", "finetune.iterations=6"),
        ]

    def test_a_preset_multiplies_what_the_run_would_have(self) -> None:
        chosen = [Chosen(SEQUENCE), Chosen("phantom/1@sparse", {"coarse.iterations": 400})]
        settings = {"coarse.iterations": 3000, "finetune.iterations": 600}
        found = cells_of(
            chosen,
            ["extrags"],
            ["quick"],
            lambda config: budgets_of(config, ["iterations"], []),
            [0],
            1,
            settings,
        )
        counts = [(cell.config().coarse.iterations, cell.config().finetune.iterations) for cell in found]
        assert counts[:4] == [(750, 150), (1500, 300), (3000, 600), (6000, 1200)]
        assert counts[4:] == [(100, 150), (200, 300), (400, 600), (800, 1200)]

    def test_runs_of_equal_settings_are_one_cell(self) -> None:
        own = profile_config("quick").coarse.iterations
        vary = [parsed_vary(f"coarse.iterations={own},3000")]

        def budgets(*presets: str) -> list[str]:
            found = cells_of(
                [Chosen(SEQUENCE)], ["coarse"], ["quick"], lambda c: budgets_of(c, presets, vary), [0], 1, {}
            )
            return [cell.budget for cell in found]

        assert budgets() == [f"coarse.iterations={own}", "coarse.iterations=3000"]
        # The profile's is there already, as that of the preset.
        assert budgets("views") == ["profile", "coarse.iterations=3000"]

    def test_settings_of_a_manifest_hold_for_their_sequence(self) -> None:
        chosen = [Chosen(SEQUENCE, {"coarse.iterations": 77}), Chosen("phantom/1@sparse")]
        found = cells_of(chosen, ["coarse"], ["quick"], of([Budget()]), [0], 1, {"coarse.max_points": 900})
        assert [cell.settings for cell in found] == [
            {"coarse.max_points": 900, "coarse.iterations": 77},
            {"coarse.max_points": 900},
        ]

    def test_wrong_settings_are_found_before_anything_runs(self) -> None:
        with pytest.raises(ConfigError):
            cells_of(
                [Chosen(SEQUENCE)],
                ["coarse"],
                ["quick"],
                of([Budget("x", {"coarse.iterations": -1})]),
                [0],
                1,
                {},
            )
        with pytest.raises(ConfigError, match="no method 'magic'"):
            cells_of([Chosen(SEQUENCE)], ["magic"], ["quick"], of([Budget()]), [0], 1, {})


class TestGrid:
    def test_shared_stages_are_charged_with_what_they_took_here(self, tmp_path: Path) -> None:
        found = run_grid(cells(), tmp_path, run=run_cell)
        first, second = found["cases"]
        assert first["error"] == second["error"] == ""
        ingest = [next(row for row in case["stages"] if row["stage"] == "ingest") for case in (first, second)]
        assert ingest[0]["seconds"] == ingest[1]["seconds"] > 0
        assert [row["shared_seconds"] for row in ingest] == [0, ingest[1]["seconds"]]
        assert first["shared_seconds"] == 0
        assert second["shared_seconds"] == pytest.approx(ingest[1]["seconds"], abs=1e-3)
        counted = [row for row in second["stages"] if row["stage"] != "evaluate"]
        assert second["seconds"] == pytest.approx(sum(row["seconds"] for row in counted), abs=1e-2)
        assert second["processor_seconds"] > 0
        assert second["peak_mib"] > 0
        assert (first["width"], first["height"], first["frames"]) == (48, 40, 8)
        assert found["machine"]["versions"]["extrags"]
        assert found["protocol"] == PROTOCOL_VERSION
        assert {entry["figure"] for entry in found["fronts"]} >= {"psnr", "ssim"}
        # What is finished is not run again.
        again = run_grid(cells(), tmp_path, run=_never)
        assert again["cases"] == found["cases"]

    def test_repeats_begin_with_an_empty_store(self, tmp_path: Path) -> None:
        stores = []

        def run(cell: Cell, store: str) -> dict[str, Any]:
            stores.append(Path(store).name)
            return _case(cell)

        run_grid(cells(repeats=2), tmp_path / "shared", run=run)
        assert stores == ["repeat-0", "repeat-0", "repeat-1", "repeat-1"]
        stores.clear()
        run_grid(cells(), tmp_path / "separate", separate=True, run=run)
        assert len(set(stores)) == 2

    def test_memory_is_compared_where_nothing_is_shared(self, tmp_path: Path) -> None:
        """The cell that makes what others share carries it on, whichever cell comes first."""
        grids = {
            separate: run_grid(
                cells(), tmp_path / str(separate), separate=separate, run=lambda cell, _: _case(cell)
            )
            for separate in (False, True)
        }
        costs = {separate: {entry["cost"] for entry in found["fronts"]} for separate, found in grids.items()}
        assert costs[False] == {"seconds", "processor_seconds"}
        assert costs[True] == {"seconds", "processor_seconds", "peak_mib"}
        assert "| MiB* |" in grid_markdown(grids[False])
        assert "comparable with --separate alone" in grid_markdown(grids[False])
        assert "| MiB |" in grid_markdown(grids[True])
        assert "--separate" not in grid_markdown(grids[True])

    def test_failed_cells_are_tried_again(self, tmp_path: Path) -> None:
        run_grid(
            cells(), tmp_path, run=lambda cell, _: {**_case(cell), "error": "coarse: no", "metrics": None}
        )
        tried = []
        run_grid(cells(), tmp_path, run=lambda cell, _: tried.append(cell) or _case(cell))
        assert len(tried) == 2

    def test_a_cell_whose_process_dies_has_failed_and_the_others_go_on(self, tmp_path: Path) -> None:
        def run(cell: Cell, store: str) -> dict[str, Any]:
            if cell.changed == {"coarse.iterations": 10}:
                with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                    pool.submit(os._exit, 9).result()
            return _case(cell)

        found = run_grid(cells(), tmp_path, run=run)
        assert [case["error"] for case in found["cases"]] == [DIED, ""]
        assert [cell["runs"] for cell in found["cells"]] == [0, 1]
        table = grid_markdown(found)
        assert f"coarse, quick, coarse.iterations=10, seed 0 failed: {DIED}\n" in table
        assert not undocumented(found["cases"][0], "a-case-of-a-grid")
        # It is tried again by the same command.
        tried: list[Cell] = []
        run_grid(cells(), tmp_path, run=lambda cell, _: tried.append(cell) or _case(cell))
        assert [cell.changed for cell in tried] == [{"coarse.iterations": 10}]

    def test_what_reads_changed_files_is_measured_anew(self, tmp_path: Path) -> None:
        source, scene = tmp_path / "source", tmp_path / "theirs.ply"
        (source / "rgb").mkdir(parents=True)
        posed_frame(source, grey=90)
        scene.write_bytes(b"content")
        ran: list[str] = []

        def run(cell: Cell, store: str) -> dict[str, Any]:
            ran.append(cell.sequence)
            return _case(cell)

        def measured(sequence: str, **settings: Any) -> int:
            ran.clear()
            given = {name.replace("__", "."): value for name, value in settings.items()}
            found = cells_of([Chosen(sequence)], ["coarse"], ["quick"], of([Budget()]), [0], 1, given)
            run_grid(found, tmp_path / "grid", run=run)
            return len(ran)

        assert [measured(str(source)) for _ in range(2)] == [1, 0]
        posed_frame(source, grey=91)
        assert [measured(str(source)) for _ in range(2)] == [1, 0]
        # What it was before is measured already.
        posed_frame(source, grey=90)
        assert measured(str(source)) == 0
        imported = {"imported__scene": str(scene)}
        assert [measured(SEQUENCE, **imported) for _ in range(2)] == [1, 0]
        scene.write_bytes(b"cOntent")
        assert [measured(SEQUENCE, **imported) for _ in range(2)] == [1, 0]
        weights = tmp_path / "weights"
        shutil.copytree(starting_weights(COLONS).parent, weights)
        own = {"enhance__pretrained_weights": str(weights)}
        assert [measured(SEQUENCE, **own) for _ in range(2)] == [1, 0]
        record = weights / "restorer.json"
        record.write_text(record.read_text() + "\n")
        assert [measured(SEQUENCE, **own) for _ in range(2)] == [1, 0]

    def test_results_say_what_was_run(self, tmp_path: Path) -> None:
        chosen = [Chosen(str(tmp_path), {"coarse.max_points": 900})]
        budgets = of([Budget("few", {"coarse.iterations": 10})])
        found = cells_of(chosen, ["coarse"], ["quick"], budgets, [0], 1, SMALL)
        result = run_grid(found, tmp_path / "grid", settings=SMALL, run=run_cell)
        (case,) = result["cases"]
        assert result["settings"] == SMALL
        assert case["changed"] == {"coarse.iterations": 10}
        assert case["settings"]["ingest.max_frames"] == 8
        assert case["settings"]["coarse.max_points"] == 900

    def test_a_source_that_cannot_be_read_is_a_cell_that_fails(self, tmp_path: Path) -> None:
        (tmp_path / "empty").mkdir()
        found = cells_of(
            [Chosen(str(tmp_path / "empty"))], ["coarse"], ["quick"], of([Budget()]), [0], 1, SMALL
        )
        (case,) = run_grid(found, tmp_path / "grid", run=run_cell)["cases"]
        assert "the folder is empty" in case["error"]

    def test_refined_poses_keep_the_size(self, tmp_path: Path) -> None:
        """The sequence is then that of the poses, whose counts have no pixels."""
        found = cells(**{"coarse.refine_poses": True})
        (case,) = run_grid(found[:1], tmp_path / "grid", run=run_cell)["cases"]
        assert case["error"] == ""
        assert (case["width"], case["height"], case["frames"]) == (48, 40, 8)

    def test_another_machine_needs_another_folder(self, tmp_path: Path) -> None:
        run_grid(cells(), tmp_path, run=lambda cell, _: _case(cell))
        claim = json.loads((tmp_path / "grid.json").read_text())
        (tmp_path / "grid.json").write_text(json.dumps({**claim, "processor": "another"}))
        with pytest.raises(ConfigError, match="processor was another"):
            run_grid(cells(), tmp_path, run=_never)


def test_the_verbs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = [
        f"--set={name}={json.dumps(value)}" for name, value in SMALL.items() if name != "coarse.iterations"
    ]
    given = [
        "bench",
        "pipeline",
        SEQUENCE,
        "--methods",
        "coarse",
        "--vary",
        "coarse.iterations=5",
        *settings,
    ]
    assert main([*given, "--output", str(tmp_path)]) == 0
    assert "on the front" in capsys.readouterr().out
    assert (tmp_path / "fronts.png").stat().st_size > 1000
    result = tmp_path / "results.json"
    assert not undocumented(json.loads(result.read_text()), "bench-pipeline")
    (case,) = json.loads(result.read_text())["cases"]
    assert case["changed"] == {"coarse.iterations": 5}
    assert case["settings"] == json.loads(result.read_text())["settings"]
    assert case["settings"]["ingest.max_frames"] == 8
    compared = tmp_path / "compared.json"
    assert main(["bench", "compare", str(result), str(result), "--json", str(compared)]) == 0
    assert json.loads(compared.read_text())["rows"]
    assert not undocumented(json.loads(compared.read_text()), "bench-compare")
    worse = json.loads(result.read_text())
    for case in worse["cases"]:
        case["error"] = "coarse: it diverged"
    (tmp_path / "worse.json").write_text(json.dumps(worse))
    assert main(["bench", "compare", str(result), str(tmp_path / "worse.json")]) == 1
    assert "it diverged" in capsys.readouterr().out
    assert main(["bench", "compare", str(result), str(tmp_path / "none.json")]) == 2


def test_the_table_says_what_failed(tmp_path: Path) -> None:
    unread = {"width": None, "height": None, "metrics": None, "error": "ingest: no such file"}
    costs = dict.fromkeys(("seconds", "processor_seconds", "peak_mib"))
    found = run_grid(cells(), tmp_path, run=lambda cell, _: {**_case(cell), **unread, **costs})
    table = grid_markdown(found)
    assert "| phantom/0@sparse | - | coarse | quick |" in table
    assert "0 (1 failed)" in table
    assert "* phantom/0@sparse, coarse, quick, " in table
    assert table.count("seed 0 failed: ingest: no such file\n") == 2
    fine = run_grid(cells(), tmp_path / "fine", run=lambda cell, _: _case(cell))
    assert "failed" not in grid_markdown(fine)


@pytest.mark.usefixtures("untouched_environment")
def test_the_table_is_printed_line_by_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    failed = {"metrics": None, "error": "ingest: no such file"}
    monkeypatch.setattr("flows.pipeline_grid.in_own_process", lambda cell, _: {**_case(cell), **failed})
    assert main(["bench", "pipeline", SEQUENCE, "--methods", "coarse", "--output", str(tmp_path)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[:-1] == (tmp_path / "grid.md").read_text().splitlines()


def posed_frame(folder: Path, *, grey: int) -> None:
    """A folder with one posed frame of one colour."""
    Image.fromarray(np.full((40, 48, 3), grey, np.uint8)).save(folder / "rgb" / "0.png")
    frame = {"file": "rgb/0.png", "world_from_camera": np.eye(4).tolist()}
    content = {"K": [[40, 0, 24], [0, 40, 20], [0, 0, 1]], "frames": [frame]}
    (folder / "poses.json").write_text(json.dumps(content))


def _never(cell: Cell, store: str) -> dict[str, Any]:
    raise AssertionError(f"{cell} is not to be run in {store}")


def _case(cell: Cell) -> dict[str, Any]:
    return {
        **{name: getattr(cell, name) for name in ("method", "profile", "budget", "seed", "repeat")},
        "sequence": "phantom/0",
        "setting": "sparse",
        "width": 48,
        "height": 40,
        "seconds": 1.0,
        "processor_seconds": 1.0,
        "peak_mib": 1.0,
        "metrics": {"psnr": 20.0},
        "error": "",
    }
