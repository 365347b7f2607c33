"""LPIPS with several backbones: keys of the figures, tables, and `extrags weights`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from extrags.config import EvaluateConfig, profile_config
from extrags.errors import WeightsError
from extrags.metrics import lpips_weights as search
from extrags.metrics.lpips_weights import WEIGHTS_VARIABLE
from flows.cli import main
from flows.outcome import SequenceOutcome
from flows.runners import DirectRunner
from flows.tables import benchmark_markdown, difference_figures, sequence_markdown, table_figures
from flows.wiring import run_sequence
from tasks.weights import lpips_weights
from tests.documented_json import undocumented_items
from tests.flows.tiny import SEQUENCE, tiny_config

pytestmark = pytest.mark.usefixtures("untouched_environment")


def test_profiles() -> None:
    nets = {name: profile_config(name).evaluate.lpips_nets for name in ("quick", "balanced", "paper")}
    assert nets == {"quick": ("alex",), "balanced": ("alex", "vgg"), "paper": ("alex", "vgg")}
    with pytest.raises(ValueError, match="twice"):
        EvaluateConfig(lpips_nets=("vgg", "vgg"))


def test_figures_are_measured_anew_with_other_backbones_or_weights(
    finished: tuple[str, SequenceOutcome], tmp_path: Path, shared_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, before = finished

    def evaluated(nets: tuple[str, ...]) -> SequenceOutcome:
        config = tiny_config(evaluate__lpips_nets=nets)
        return run_sequence(SEQUENCE, config, store, DirectRunner(store), until="evaluate")

    both = evaluated(("alex", "squeeze"))
    final = both.metrics["final"]
    assert final is not None
    assert final["lpips_squeeze"] > 0
    assert final["lpips_alex"] == (before.metrics["final"] or {})["lpips_alex"]
    assert both.artefacts["renders_final"] == before.artefacts["renders_final"]
    assert both.artefacts["enhance"] == before.artefacts["enhance"]
    assert both.artefacts["metrics_final"] != before.artefacts["metrics_final"]
    assert "lpips_squeeze" not in (before.metrics["final"] or {})
    again = evaluated(("alex", "squeeze"))
    assert again.artefacts["metrics_final"] == both.artefacts["metrics_final"]
    # The same AlexNet, another SqueezeNet, which is quicker here than VGG16.
    for net in ("alex", "squeeze"):
        with np.load(shared_data / "lpips_weights" / f"lpips_{net}_v0.1.npz") as archive:
            arrays = {name: archive[name] for name in archive.files}
        if net == "squeeze":
            arrays["lin0"] = 2 * arrays["lin0"]
        np.savez(tmp_path / f"lpips_{net}_v0.1.npz", **arrays)
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path))
    other = evaluated(("alex", "squeeze"))
    assert other.artefacts["metrics_final"] != both.artefacts["metrics_final"]
    assert (other.metrics["final"] or {})["lpips_squeeze"] > final["lpips_squeeze"]


def test_the_weights_of_each_backbone_have_a_digest_of_their_own(shared_data: Path) -> None:
    found = lpips_weights(EvaluateConfig(lpips_nets=("alex", "vgg")))
    assert [item.net for item in found] == ["alex", "vgg"]
    assert len({item.digest for item in found} - {None}) == 2


@pytest.mark.parametrize("then", ["others", "gone"])
def test_weights_that_changed_since_the_key_was_made_are_refused(
    shared_data: Path, tmp_path: Path, then: str
) -> None:
    """Also those that a worker on another machine finds in the same place."""
    file = tmp_path / "lpips_alex_v0.1.npz"
    shutil.copy(shared_data / "lpips_weights" / file.name, file)
    (weights,) = lpips_weights(EvaluateConfig(lpips_nets=("alex",), lpips_weights=str(file)))
    assert weights.lpips() is not None
    if then == "gone":
        file.unlink()
    else:
        with np.load(file) as archive:
            arrays = {name: archive[name] for name in archive.files}
        np.savez(file, **{**arrays, "lin0": 2 * arrays["lin0"]})
    with pytest.raises(WeightsError, match=r"LPIPS with alex .* not those this run began with"):
        weights.perceptual_difference()


def test_tables_have_the_backbones_that_were_asked_for() -> None:
    tree: dict[str, Any] = {"psnr": 20.0, "ssim": 0.5, "lpips_alex": 0.25, "flip": 0.1}
    assert "lpips_alex" in table_figures(tree)
    assert not {"lpips_vgg", "lpips_squeeze"} & {*table_figures(tree, None), *difference_figures(tree)}
    both = {**tree, "lpips_vgg": 0.4567}
    assert {"lpips_alex", "lpips_vgg"} <= {*table_figures(tree, both)} & {*difference_figures(tree, both)}
    assert "lpips_vgg" in table_figures({**tree, "lpips_vgg": None})
    outcome = SequenceOutcome("made/up", metrics={"coarse": tree, "final": both})
    assert "0.4567" in sequence_markdown(outcome)
    for count, text in ((None, "–"), (1234, "1234")):  # noqa: RUF001
        counted = SequenceOutcome("made/up", metrics={"coarse": {**tree, "n_gaussians": count}})
        assert f"| {text} |\n\n" in sequence_markdown(counted)
    assert "lpips_vgg" not in sequence_markdown(SequenceOutcome("made/up", metrics={"coarse": tree}))
    case = {
        "dataset": "made",
        "sequence": "made/up",
        "setting": None,
        "profile": "quick",
        "seed": 0,
        "seconds": 1.0,
        "peak_mib": None,
        "error": "",
        "held_out_trained_on": False,
    }
    runs = [{**case, "method": "3dgs", "metrics": both}, {**case, "method": "coarse", "metrics": both}]
    assert "| lpips_vgg |" in benchmark_markdown(runs, "3dgs")
    assert "0.4567" in benchmark_markdown(runs, "3dgs")


class TestCommand:
    def test_says_where_they_are(
        self, shared_data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.setenv(WEIGHTS_VARIABLE, str(shared_data / "lpips_weights"))
        assert main(["weights", "lpips", "--json", "-"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert undocumented_items(found, "a-network") == []
        assert [case["net"] for case in found] == ["alex", "vgg"]
        assert [Path(*case["files"]).name for case in found] == ["lpips_alex_v0.1.npz", "lpips_vgg_v0.1.npz"]

    def test_says_what_is_damaged(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """A file of 1000 bytes was listed like a whole one."""
        damaged = tmp_path / "lpips_alex_v0.1.npz"
        damaged.write_bytes(b"PK" + bytes(998))
        monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path))
        assert main(["weights", "lpips", "--nets", "alex", "--json", "-"]) == 1
        (found,) = json.loads(capsys.readouterr().out)
        assert undocumented_items([found], "a-network") == []
        assert found["files"] == []
        assert found["missing"].startswith(f"damaged: {damaged}: not a readable npz file")

    def test_downloads_only_when_told_to(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        asked: list[str] = []

        def download(net: str) -> Path:
            asked.append(net)
            raise search.WeightsError("no network here")

        monkeypatch.setattr(search, "download_backbone", download)
        monkeypatch.setattr(search, "find_heads", lambda net: tmp_path / f"{net}.pth")
        for variable in ("TORCH_HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME"):
            monkeypatch.setenv(variable, str(tmp_path / variable))
        monkeypatch.delenv(WEIGHTS_VARIABLE, raising=False)
        assert main(["weights", "lpips", "--nets", "vgg"]) == 1
        assert "extrags weights lpips --download" in capsys.readouterr().out.replace("\n", " ")
        assert asked == []
        assert main(["weights", "lpips", "--nets", "vgg", "--download"]) != 0
        assert asked == ["vgg"]
        # Where the variable names a folder, nothing else is searched: a download would not help.
        monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path))
        assert main(["weights", "lpips", "--nets", "vgg", "--download"]) == 1
        assert asked == ["vgg"]
