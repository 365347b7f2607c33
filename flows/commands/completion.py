"""`completion`: a script that completes commands, options, settings and names of sequences in a shell."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from importlib import import_module
from typing import TYPE_CHECKING, Any, get_args

from flows.commands.completion_scripts import SCRIPTS
from flows.commands.options import Parser

if TYPE_CHECKING:
    from extrags.config.settings import Setting

__all__ = ["add_arguments", "completion", "table"]

_OF_SETTINGS = "--help-settings"
"""An option that parsers have which take the settings of a run, and no others."""
_PLACES = ("FILE", "DIR", "FOLDER", "PATH")
_NAMES = ("SEQUENCE", "PATTERN", "RUN")
_UNQUOTED = ("'", "\\", "\n", "\t")
"""What cannot stand between single quotes in every shell, or in a field of the table."""


def add_arguments(parser: Parser) -> None:
    """The options of `extrags completion`."""
    parser.description = (
        "Print a script that completes verbs, options, settings with their values, and names of sequences. "
        "It holds all of them as they are now, and starts no Python: print it again after an update. It goes "
        "into ~/.local/share/bash-completion/completions/extrags for bash, into a file _extrags in a folder "
        "of $fpath for zsh, and into ~/.config/fish/completions/extrags.fish for fish."
    )
    parser.set_defaults(command=completion)
    parser.add_argument("shell", choices=tuple(SCRIPTS), help="whose script to print")


def completion(given: argparse.Namespace) -> int:
    """`extrags completion`."""
    print(SCRIPTS[given.shell].replace("@TABLE@", "\n".join(table())), end="")
    return 0


def table() -> list[str]:
    """All commands, options, settings and sequences, as `flows.commands.completion_scripts` reads them."""
    # By its name: the command line imports this package, and nothing may import in a circle.
    command_line = import_module("flows.cli")
    from data_catalog import list_sequences
    from extrags.config import PipelineConfig
    from extrags.config.settings import settings_of

    known = settings_of(PipelineConfig)
    rows: list[tuple[str, ...]] = [
        ("T", name, " ".join(_values_of_setting(setting))) for name, setting in known.items()
    ]
    rows += [("Q", item.name) for item in list_sequences()]
    rows += _rows_of(command_line.parser(), "", known)
    for verb in command_line.VERBS:
        rows += _rows_of(_verbs_of(command_line.parser(verb))[verb], verb, known)
    return ["\t".join(field for field in row) for row in rows if not _is_unusable(row)]


def _is_unusable(row: tuple[str, ...]) -> bool:
    return any(mark in field for field in row for mark in _UNQUOTED)


def _verbs_of(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The parsers of the verbs below one; none where there are none."""
    for action in parser._actions:
        if isinstance(action.choices, dict):
            return action.choices
    return {}


def _rows_of(
    parser: argparse.ArgumentParser, path: str, known: dict[str, Setting]
) -> Iterator[tuple[str, ...]]:
    """Rows of a command, and of those below it; of the command line itself, its verbs come one by one."""
    if path:
        yield "C", path
    options = [option for action in parser._actions for option in action.option_strings]
    takes_settings = _OF_SETTINGS in options
    if takes_settings:
        yield "S", path, _shared_prefix([option[2:] for option in options if option[2:] in known])
    operands: list[str] = []
    for action in parser._actions:
        for option in action.option_strings:
            # Settings have rows of their own, once for all commands.
            if not (takes_settings and option[2:] in known and action.help == argparse.SUPPRESS):
                yield "O", path, option, _number(action), " ".join(_values(action, known))
        if not action.option_strings and not isinstance(action.choices, dict):
            operands += _values(action, known)
    yield "P", path, " ".join(dict.fromkeys(operands))
    if path:
        for name, below in _verbs_of(parser).items():
            yield from _rows_of(below, f"{path} {name}", known)


def _shared_prefix(names: list[str]) -> str:
    """The group of settings, with its dot, that all names are of; empty where they are of several."""
    groups = {name.partition(".")[0] for name in names}
    return f"{groups.pop()}." if len(groups) == 1 else ""


def _number(action: argparse.Action) -> str:
    if action.nargs == 0:
        return "0"
    return "+" if action.nargs in ("+", "*") else "1"


def _values(action: argparse.Action, known: dict[str, Setting]) -> list[str]:
    """What the words of an option or an operand may be, from its choices or from what its help calls them."""
    if action.choices is not None:
        return [str(choice) for choice in action.choices]
    called = action.metavar or ("" if action.option_strings else action.dest.upper())
    metavars = called if isinstance(called, tuple) else (called,)
    found: list[str] = []
    for part in "|".join(metavars).split("|"):
        found += _values_called(part.partition("[")[0], known)
    return list(dict.fromkeys(found))


def _values_called(name: str, known: dict[str, Setting]) -> list[str]:
    if name in _PLACES or re.fullmatch(r"[A-Z]+\.[a-z]+", name):
        return ["@files"]
    if name in _NAMES:
        return ["@sequences", "@files"]
    if name.startswith(("NAME=", "SETTING=")):
        return ["@settings"]
    if name.startswith("METHOD"):
        from flows.methods import METHODS

        return list(METHODS)
    if name.startswith("PROFILE"):
        from extrags.config import PROFILES

        return list(PROFILES)
    if name == "GROUP":
        groups = [setting.group for setting in known.values() if setting.group]
        return list(dict.fromkeys(groups))
    # What is written in small letters is meant as it stands: `threads|dask[:ADDRESS]`.
    return [name] if re.fullmatch(r"[a-z][a-z0-9-]*", name) else []


def _values_of_setting(setting: Setting) -> list[str]:
    kinds: tuple[Any, ...] = (setting.annotation, *get_args(setting.annotation))
    values = [*setting.choices, *(["true", "false"] if bool in kinds else [])]
    if str in kinds and not values:
        values = ["@files"]
    return [*values, *(["none"] if type(None) in kinds else [])]
