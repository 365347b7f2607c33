"""`extrags evaluate` and `extrags benchmark` on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from extrags.errors import ConfigError
from extrags.metrics.protocol import RenderedViews
from extrags.poses import PoseEstimate
from extrags.sequence import EndoscopicSequence
from flows.cli import main
from flows.commands.benchmark import parsed_seeds, parsed_variants
from flows.commands.common import items
from flows.outcome import SequenceOutcome
from flows.runners import DirectRunner
from flows.wiring import run_sequence
from tests.documented_json import undocumented
from tests.flows.tiny import SEQUENCE, TINY, tiny_config

pytestmark = pytest.mark.usefixtures("untouched_environment")

SETTINGS = [part for name, value in TINY.items() for part in ("--set", f"{name}={json.dumps(value)}")]


@pytest.fixture(scope="module")
def folders(finished: tuple[str, SequenceOutcome], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The final scene's own renders, as somebody else's would come: PNGs and depth files."""
    _, outcome = finished
    root = tmp_path_factory.mktemp("elsewhere")
    views = RenderedViews.load(Path(outcome.artefacts["renders_final"]) / "renders")
    sequence = EndoscopicSequence.load(Path(outcome.artefacts["sequence"]) / "sequence")
    for name in ("renders", "depth"):
        (root / name).mkdir()
    for index, frame in enumerate(sequence.test):
        name = sequence.frame_name(int(frame))
        levels = np.rint(np.clip(views.rgb[index], 0, 1) * 255).astype(np.uint8)
        Image.fromarray(levels).save(root / "renders" / f"{name}.png")
        depth = np.where(views.alpha[index] >= 0.5, views.depth_mm[index], 0)
        np.save(root / "depth" / f"{name}.npy", depth)
    return root


def without_first_held_out(sequence: EndoscopicSequence, config: object) -> PoseEstimate:
    """The poses of the source, of all frames but the first three held-out ones."""
    assert sequence.world_from_camera is not None
    registered = ~np.isin(np.arange(len(sequence)), sequence.test[:3])
    found = np.where(registered[:, None, None], sequence.world_from_camera, np.nan)
    names = ("registered_train", "n_train", "registered_test", "n_test")
    counts = {**dict.fromkeys(names, 1), "triangulation_angle_deg": 10}
    no_points = np.zeros((0, 3), np.float32)
    return PoseEstimate(
        "colmap", found, registered, no_points, no_points.astype(np.uint8), None, True, counts
    )


def settled(store: str) -> list[str]:
    return ["--profile", "quick", "--store", store, *SETTINGS]


class TestEvaluate:
    def test_a_folder_of_our_own_renders_has_our_own_figures(
        self, finished: tuple[str, SequenceOutcome], folders: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        store, outcome = finished
        more = ["--renders", str(folders / "renders"), "--depth", str(folders / "depth"), "--json", "-"]
        assert main(["evaluate", SEQUENCE, *settled(store), *more]) == 0
        found = json.loads(capsys.readouterr().out)
        assert not undocumented(found, "evaluate")
        ours = outcome.metrics["final"]
        for name in set(ours) - {"n_gaussians", "surface"}:
            assert found["metrics"][name] == ours[name], name
        assert found["metrics"]["n_gaussians"] is None
        assert found["reasons"]["surface"] == "a folder of renders holds no surface"
        assert len(found["per_view"]) == found["n_views"] > 1

    def test_renders_beside_a_method_that_leaves_stages_out(
        self, finished: tuple[str, SequenceOutcome], folders: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        store, _ = finished
        more = ["--renders", str(folders / "renders"), "--method", "oracle", "--json", "-"]
        assert main(["evaluate", SEQUENCE, *settled(store), *more]) == 0
        assert json.loads(capsys.readouterr().out)["n_views"] == 14

    @pytest.mark.parametrize("also", [False, True], ids=["without them", "with them"])
    def test_renders_where_frames_got_no_pose(
        self,
        also: bool,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        monkeypatch.setattr("extrags.poses.estimate_poses", without_first_held_out)
        store = str(tmp_path / "store")
        config = tiny_config(poses__replace_given=True)
        outcome = run_sequence(SEQUENCE, config, store, DirectRunner(store), until="poses")
        read, posed = (
            EndoscopicSequence.load(Path(outcome.artefacts[name]) / "sequence")
            for name in ("ingest", "sequence")
        )
        assert len(posed.test) == len(read.test) - 3
        folder = tmp_path / "renders"
        folder.mkdir()
        for frame in read.test if also else read.test[3:]:
            Image.fromarray(read.rgb[frame]).save(folder / f"{read.frame_name(int(frame))}.png")
        more = ["--set", "poses.replace_given=true", "--renders", str(folder), "--json", "-"]
        assert main(["evaluate", SEQUENCE, *settled(store), *more]) == 0
        assert json.loads(capsys.readouterr().out)["n_views"] == len(posed.test)
        first, last = (read.frame_name(int(read.test[place])) for place in (0, 2))
        assert f"3 of {len(read.test)} held-out frames have no estimated pose" in caplog.text
        assert f"not measured: {first} to {last}\n" in caplog.text

    def test_a_finished_run(
        self, finished: tuple[str, SequenceOutcome], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        store, outcome = finished
        target = tmp_path / "found.json"
        assert main(["evaluate", SEQUENCE, *settled(store), "--json", str(target)]) == 0
        assert json.loads(target.read_text())["metrics"] == outcome.metrics["final"]
        said = capsys.readouterr().out
        assert "unobserved" in said
        assert "surface: " in said

    def test_what_is_wrong_is_said(
        self,
        finished: tuple[str, SequenceOutcome],
        folders: Path,
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        store, _ = finished
        monkeypatch.setenv("HOME", str(tmp_path))
        for arguments, code, message in (
            (["--renders", str(tmp_path / "none")], 1, "no such folder"),
            (["--renders", "~/none"], 1, f"{tmp_path}/none: there is no such folder of images"),
            (
                ["--renders", str(folders / "renders"), "--depth", "~/none"],
                1,
                f"{tmp_path}/none: there is no such folder of depth maps",
            ),
            (["--depth", str(folders / "depth")], 2, "--depth goes with --renders"),
            (["--renders", str(folders / "renders"), "--depth-step", "0.1"], 2, "--depth-step goes with"),
            (["--depth-step", "0.1"], 2, "--depth-step goes with --depth"),
            (["--seed", "77"], 1, "run it first"),
            (["--method", "3dgs"], 2, "3dgs sets coarse.sh_degree itself"),
        ):
            assert main(["evaluate", SEQUENCE, *settled(store), *arguments]) == code
            assert message in capsys.readouterr().err

    def test_another_size_names_the_file(
        self, finished: tuple[str, SequenceOutcome], folders: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        store, _ = finished
        larger = [
            "--set",
            "ingest.width=64",
            "--set",
            "ingest.height=48",
            "--renders",
            str(folders / "renders"),
        ]
        assert main(["evaluate", SEQUENCE, *settled(store), *larger]) == 1
        assert "48 x 40 pixels, but the held-out frames are 64 x 48" in capsys.readouterr().err


@pytest.mark.usefixtures("prefect_server")
class TestBenchmark:
    def test_from_the_command_line(
        self, finished: tuple[str, SequenceOutcome], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        store, outcome = finished
        target = tmp_path / "found.json"
        arguments = ["--methods", "coarse,extrags", "--seeds", "0", "--store", store, *SETTINGS]
        assert main(["benchmark", SEQUENCE, *arguments, "--json", str(target)]) == 0
        found = json.loads(target.read_text())
        assert not undocumented(found, "benchmark")
        assert [case["metrics"] for case in found["cases"]] == [
            outcome.metrics["coarse"],
            outcome.metrics["final"],
        ]
        said = capsys.readouterr().out
        assert "differences to coarse" in said
        assert found["report"] in said

    def test_run_takes_a_method(
        self, finished: tuple[str, SequenceOutcome], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        store, _ = finished
        settings = [
            part
            for name, value in {**TINY, "coarse.iterations": 60}.items()
            if name != "coarse.sh_degree"
            for part in ("--set", f"{name}={json.dumps(value)}")
        ]
        target = tmp_path / "found.json"
        more = [
            "--profile",
            "quick",
            "--store",
            store,
            "--method",
            "3dgs",
            "--seed",
            "0",
            "--json",
            str(target),
        ]
        for expected in ({"ran", "cached", "skipped"}, {"cached", "skipped"}):
            assert main(["run", SEQUENCE, *settings, *more]) == 0
            (sequence,) = json.loads(target.read_text())["sequences"]
            states = {stage["stage"]: stage["state"] for stage in sequence["stages"]}
            assert set(states.values()) <= expected
            assert states["finetune"] == states["explore"] == "skipped"
            assert sequence["metrics"]["final"] == sequence["metrics"]["coarse"] is not None
        assert "plain 3DGS has no such stage" in Path(sequence["report"]).read_text()

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["--methods", "nerf"], "no method 'nerf'"),
            (["--profiles", "fast"], "no profile 'fast'"),
            (["--seeds", "0,x"], "--seeds x"),
            (["--seeds", "0,0"], "different seeds"),
            (["--baseline", "3dgs"], "not among the methods"),
            (["--variant", "a", "coarse"], "expected NAME"),
        ],
    )
    def test_wrong_usage(
        self, arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["benchmark", SEQUENCE, *arguments, "--store", str(tmp_path / "store")]) == 2
        assert message in capsys.readouterr().err


def test_lists_and_variants() -> None:
    assert items(["a,b", "c"]) == ["a", "b", "c"]
    assert parsed_seeds(["0,1", "2"]) == [0, 1, 2]
    assert parsed_variants([["dim", "3dgs", "coarse.iterations=5"], ["x", "coarse.light.enabled=false"]]) == {
        "dim": {"method": "3dgs", "coarse.iterations": 5},
        "x": {"coarse.light.enabled": False},
    }
    words = ["enhance.max_width=none", "evaluate.lpips_nets=alex"]
    assert parsed_variants([["whole", "extrags", *words]])["whole"] == {
        "method": "extrags",
        "enhance.max_width": None,
        "evaluate.lpips_nets": ("alex",),
    }
    for wrong in ([["a", "b", "c", "x.y=1"]], [["a=1"]], [["a", "x.y=1"], ["a", "x.y=2"]]):
        with pytest.raises(ConfigError, match="--variant a"):
            parsed_variants(wrong)
