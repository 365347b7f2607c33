"""`--set NAME=VALUE` means what the setting's own flag means."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from extrags.config import DEFAULT_PROFILE, PipelineConfig
from flows.cli import VERBS, main, parser
from flows.commands import options
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


def parsers_of(made: argparse.ArgumentParser, name: str) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """A parser, and those of the verbs below it."""
    yield name, made
    for action in made._actions:
        if isinstance(action, argparse._SubParsersAction):
            for verb, below in action.choices.items():
                yield from parsers_of(below, f"{name} {verb}")


@pytest.mark.parametrize("verb", VERBS)
def test_every_argument_is_explained(verb: str) -> None:
    (verbs,) = (action for action in parser(verb)._actions if isinstance(action.choices, dict))
    assert isinstance(verbs.choices, dict)
    for name, made in parsers_of(verbs.choices[verb], verb):
        silent = [
            action.option_strings or action.dest
            for action in made._actions
            if not action.help and not isinstance(action, argparse._SubParsersAction)
        ]
        assert not silent, name


def test_the_output_has_one_spelling_that_is_shown_and_another_that_is_understood() -> None:
    found = []
    for verb in VERBS:
        (verbs,) = (action for action in parser(verb)._actions if isinstance(action.choices, dict))
        assert isinstance(verbs.choices, dict)
        for name, made in parsers_of(verbs.choices[verb], verb):
            known = made._option_string_actions
            if "--out" not in known and "--output" not in known:
                continue
            found.append(name)
            assert known["--out"] is known["--output"] is known["-o"]
            assert "--output" in made.format_help()
            assert "--out " not in made.format_help()
    assert found == ["report", "compare", "leaderboard", "gallery", "export", "bench pipeline", "pretrain"]
    (verbs,) = (action for action in parser("export")._actions if isinstance(action.choices, dict))
    assert isinstance(verbs.choices, dict)
    for option in ("-o", "--output", "--out"):
        assert verbs.choices["export"].parse_args(["phantom/0@sparse", option, "x.ply"]).output == "x.ply"


def test_the_default_profile_is_that_of_the_library() -> None:
    assert options.DEFAULT_PROFILE == DEFAULT_PROFILE


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (["run", "--seeds", "0,1", "phantom/0"], "--seeds"),
        (["run", "--methods", "3dgs", "phantom/0", "--quiet"], "--methods"),
        (["benchmark", "--methods", "coarse", "3dgs", "phantom/0"], "--methods"),
    ],
)
@pytest.mark.usefixtures("untouched_environment")
def test_an_option_that_has_taken_the_sequences_is_named(
    arguments: list[str], option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert "arguments are required: SEQUENCE" in said
    assert f"; {option} takes all words behind it: other words stand before it, or behind --" in said


@pytest.mark.usefixtures("untouched_environment")
def test_nothing_is_said_of_options_that_have_taken_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "--name", "weekly"]) == 2
    assert "takes all words" not in capsys.readouterr().err
