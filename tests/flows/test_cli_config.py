"""`--config FILE`: settings of a file, below those of the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from extrags.config import PROFILES
from extrags.errors import ConfigError
from flows.cli import main, parser
from flows.commands.common import run_config
from tests.flows.tiny import SEQUENCE

NESTED = """
coarse:
  iterations: 500
  light:
    exponent: 5e-1
    # From a group to a dotted name.
  densify.max_gaussians: 900
device: cpu
ingest.width: none
evaluate:
  lpips_nets: [alex, vgg]
surface:
"""
SET = {
    "coarse.iterations": 500,
    "coarse.light.exponent": 0.5,
    "coarse.densify.max_gaussians": 900,
    "device": "cpu",
    "ingest.width": None,
    "evaluate.lpips_nets": ("alex", "vgg"),
}


def parsed(*arguments: str, verb: str = "run") -> dict[str, Any]:
    return dict(parser(verb).parse_args([verb, SEQUENCE, *arguments]).settings)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    made = tmp_path / "settings.yaml"
    made.write_text(NESTED)
    return made


class TestWhatIsTaken:
    def test_groups_and_dotted_names(self, file: Path) -> None:
        assert parsed("--config", str(file)) == SET

    def test_json(self, tmp_path: Path) -> None:
        made = tmp_path / "settings.json"
        made.write_text(json.dumps(SET))
        assert parsed("--config", str(made)) == SET

    def test_whole_groups_as_models_write_them(self, tmp_path: Path) -> None:
        groups = {"ingest", "explore", "enhance", "finetune"}
        made = tmp_path / "settings.json"
        made.write_text(PROFILES["paper"].model_dump_json(include=groups))
        arguments = ["run", SEQUENCE, "--profile", "quick", "--config", str(made)]
        found = run_config(parser("run").parse_args(arguments))
        assert {name for name, value in found if value == getattr(PROFILES["paper"], name)} >= groups

    @pytest.mark.parametrize("content", ["", "coarse:", "{}"])
    def test_nothing(self, content: str, tmp_path: Path) -> None:
        made = tmp_path / "settings.yml"
        made.write_text(content)
        assert parsed("--config", str(made)) == {}

    @pytest.mark.parametrize(
        "verb", ["run", "plan", "report", "export", "evaluate", "benchmark", "view", "devices"]
    )
    def test_every_verb_with_settings_takes_it(self, verb: str, file: Path) -> None:
        more = ["-o", "x.ply"] if verb == "export" else []
        arguments = [verb, *([] if verb == "devices" else [SEQUENCE]), *more, "--config", str(file)]
        assert parser(verb).parse_args(arguments).settings == SET

    def test_what_reads_data_takes_what_reading_takes(
        self, file: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        file.write_text("{ingest: {width: 48, max_frames: 4}, coarse.iterations: 9}")
        assert main(["data", "show", SEQUENCE, "--config", str(file), "--json", "-"]) == 0
        assert json.loads(capsys.readouterr().out)["measured"]["width"] == 48

    def test_yaml_may_override_what_it_merges(self, file: Path) -> None:
        file.write_text("coarse: &c {<<: {iterations: 5, max_points: 600}, iterations: 7}\nfinetune: {}")
        assert parsed("--config", str(file)) == {"coarse.iterations": 7, "coarse.max_points": 600}

    def test_true_where_it_is_a_value(self, file: Path) -> None:
        file.write_text("coarse.light.enabled: yes")
        assert parsed("--config", str(file)) == {"coarse.light.enabled": True}


class TestOrder:
    def test_the_command_line_counts_wherever_it_stands(self, file: Path) -> None:
        flag, assignment = ["--coarse.iterations", "7"], ["--set", "ingest.width=64"]
        said = {"coarse.iterations": 7, "ingest.width": 64}
        for arguments in (
            [*flag, *assignment, "--config", str(file)],
            ["--config", str(file), *flag, *assignment],
            [*flag, "--config", str(file), *assignment],
        ):
            assert parsed(*arguments) == {**SET, **said}

    def test_of_several_files_the_last(self, file: Path, tmp_path: Path) -> None:
        second = tmp_path / "second.yaml"
        second.write_text("coarse.iterations: 8\ncoarse.max_points: 500")
        files = ["--config", str(file), "--config", str(second)]
        expected = {**SET, "coarse.iterations": 8, "coarse.max_points": 500}
        assert parsed(*files) == expected
        assert parsed("--coarse.iterations", "6", *files) == {**expected, "coarse.iterations": 6}

    def test_above_profile_and_seed(self, file: Path) -> None:
        file.write_text("coarse.seed: 5")
        given = parser("run").parse_args(["run", SEQUENCE, "--config", str(file), "--seed", "3"])
        config = run_config(given)
        assert (config.coarse.seed, config.finetune.seed) == (5, 3)

    def test_one_command_line_leaves_nothing_to_the_next(self, file: Path) -> None:
        assert parsed("--config", str(file)) == SET
        assert parsed() == {}


class TestWrongFiles:
    @pytest.mark.parametrize(
        ("content", "message"),
        [
            ("coarse: {iteration: 5}", "no setting coarse.iteration; did you mean coarse.iterations?"),
            ("coarse.iteration: 5", "no setting coarse.iteration; did you mean coarse.iterations?"),
            ("coarser: {iterations: 5}", "no setting coarser"),
            ("coarse: 5", "coarse is a group of settings; name one of iterations"),
            ("coarse.iterations: many", "setting coarse.iterations is many; expected a whole number of at"),
            ("{coarse.iterations: 5, coarse: {iterations: 6}}", "coarse.iterations is given twice"),
            ("coarse: {3: 4}", "coarse.3: expected the name of a setting or a group"),
            ("- coarse", "expected settings by name, e.g. coarse.iterations: 500"),
            ("coarse: [", "is no YAML: "),
            ("profile: quick", "no setting profile; settings begin with"),
            (
                "coarse.iterations: 500\ncoarse.iterations: 700",
                "coarse.iterations is given twice, again in line 2",
            ),
            ("coarse:\n  iterations: 5\n  'iterations': 5", "iterations is given twice, again in line 3"),
            ("coarse: {iterations: 5}\ncoarse: {max_points: 9}", "coarse is given twice, again in line 2"),
            ("coarse.iterations: true", "setting coarse.iterations is true; expected a whole number of at"),
            ("coarse: {iterations: yes}", "setting coarse.iterations is true; expected a whole number of at"),
            ("coarse.light.exponent: off", "setting coarse.light.exponent is false; expected a number"),
            ("ingest.width: true", "setting ingest.width is true; expected a whole number"),
            ("coarse: {iterations: [1]}", "setting coarse.iterations is [1]; expected a whole number of at"),
            ("coarse.iterations: {a: 1}", "setting coarse.iterations is {'a': 1}; expected a whole number"),
            ("coarse.iterations: 1.5", "setting coarse.iterations is 1.5; expected a whole number"),
            ("coarse.iterations: -5", "setting coarse.iterations is -5; expected a whole number of at"),
            ("coarse.iterations:", "setting coarse.iterations is none; expected a whole number of at"),
            ("device: 3", "setting device is 3; expected auto, cpu or cuda"),
            ("evaluate.lpips_nets: [alex, 3]", "setting evaluate.lpips_nets is ['alex', 3]; expected one or"),
            ("seed: 3", "--seed is an option of the command line"),
        ],
    )
    def test_what_is_wrong_is_said_with_the_file(self, content: str, message: str, file: Path) -> None:
        file.write_text(content)
        with pytest.raises(ConfigError) as caught:
            parsed("--config", str(file))
        assert str(caught.value).startswith(f"--config {file}")
        assert message in str(caught.value)
        assert "\n" not in str(caught.value)

    def test_no_json(self, tmp_path: Path) -> None:
        made = tmp_path / "settings.json"
        made.write_text("coarse.iterations: 5")
        with pytest.raises(ConfigError, match=r"settings\.json is no JSON"):
            parsed("--config", str(made))

    @pytest.mark.parametrize(
        "content",
        [
            '{"coarse.iterations": 500, "coarse.iterations": 700}',
            '{"coarse": {"coarse.iterations": 500, "coarse.iterations": 500}}',
        ],
    )
    def test_a_key_twice_in_json(self, content: str, tmp_path: Path) -> None:
        made = tmp_path / "settings.json"
        made.write_text(content)
        with pytest.raises(ConfigError) as caught:
            parsed("--config", str(made))
        assert str(caught.value) == f"--config {made}: coarse.iterations is given twice"

    def test_true_among_numbers(self, file: Path) -> None:
        file.write_text("enhance.channels: [true, 8, 8]")
        message = r"settings\.yaml: setting enhance\.channels is \[True, 8, 8\]; expected"
        with pytest.raises(ConfigError, match=message):
            parsed("--config", str(file))

    def test_no_file(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["run", SEQUENCE, "--config", str(tmp_path / "no.yaml")]) == 2
        assert "no.yaml cannot be read: No such file or directory" in capsys.readouterr().err

    def test_what_a_method_sets_itself(self, file: Path, tmp_path: Path) -> None:
        file.write_text("coarse.sh_degree: 1")
        arguments = ["run", SEQUENCE, "--method", "3dgs", "--config", str(file)]
        with pytest.raises(ConfigError, match=r"sets coarse\.sh_degree itself"):
            run_config(parser("run").parse_args(arguments))
