"""`--set NAME=VALUE` means what the setting's own flag means."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from extrags.config import PipelineConfig
from flows.cli import main
from flows.commands.options import Parser, add_settings


def settings(*arguments: str) -> dict[str, Any]:
    parser = Parser(prog="extrags")
    add_settings(parser)
    found: dict[str, Any] = parser.parse_args(arguments).settings
    return found


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("evaluate.lpips_nets", "alex"),
        ("evaluate.lpips_nets", "alex,vgg"),
        ("ingest.width", "none"),
        ("enhance.pretrained_weights", "none"),
        ("device", "cpu"),
        ("coarse.iterations", "700"),
        ("coarse.light.enabled", "false"),
    ],
)
def test_a_value_by_either_way(name: str, text: str) -> None:
    by_flag, by_set = settings(f"--{name}", text), settings("--set", f"{name}={text}")
    assert by_set == by_flag
    assert PipelineConfig().with_overrides(by_set) == PipelineConfig().with_overrides(by_flag)


def test_a_list_in_json() -> None:
    found = settings("--set", 'evaluate.lpips_nets=["alex","vgg"]')
    assert PipelineConfig().with_overrides(found).evaluate.lpips_nets == ("alex", "vgg")


@pytest.mark.parametrize("verb", [["data", "list"], ["bench", "raster"]])
def test_where_no_json_can_be_written_is_said_before_anything_runs(
    verb: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    for target, problem in ((tmp_path, "is a folder"), (tmp_path / "file" / "x.json", "cannot be written")):
        assert main([*verb, "--json", str(target)]) == 2
        assert problem in capsys.readouterr().err
