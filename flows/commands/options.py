"""What the parsers of several verbs share: the parser itself, and options that mean the same everywhere.

Nothing heavy is imported here: the settings are loaded for the verbs that have some.
"""

from __future__ import annotations

import argparse
import math
import shlex
import shutil
import textwrap
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from extrags.errors import ConfigError, did_you_mean
from flows.commands.common import items, parsed_settings
from flows.commands.outputs import file_or_standard_output

if TYPE_CHECKING:
    from extrags.config.settings import Setting

__all__ = [
    "DEFAULT_METHOD",
    "MISSING",
    "Parser",
    "add_json",
    "add_method",
    "add_methods",
    "add_output",
    "add_profile",
    "add_runner",
    "add_sequence",
    "add_sequences",
    "add_settings",
    "add_stages",
    "add_store",
    "add_verb",
    "number_above_zero",
    "whole_number",
    "words_taken_by",
]

DEFAULT_PROFILE = "balanced"
"""That of `extrags.config`, which takes long to load."""
DEFAULT_METHOD = "extrags"
MISSING = "the following arguments are required: "
"""How argparse begins to say so."""

SHORT_NAMES = {"--scale": "ingest.scale_mm_per_unit"}
"""Settings with a flag of their own beside that of their name."""


class Parser(argparse.ArgumentParser):
    """A parser that raises `ConfigError` for wrong usage, with the option that was perhaps meant."""

    def __init__(self, **more: Any) -> None:
        super().__init__(allow_abbrev=False, **more)
        self.listing = ""
        """What `--help` ends with."""
        self._words: list[str] = []
        """Of the command line, those that this parser was given."""
        # On every parser: it may stand behind any verb. SUPPRESS, lest the inner one reset the outer one.
        self.add_argument(
            "--debug", action="store_true", default=argparse.SUPPRESS, help="show tracebacks and the log"
        )
        self.add_argument(
            "-q",
            "--quiet",
            action="store_true",
            default=argparse.SUPPRESS,
            help="print only errors, and what was asked for on standard output",
        )

    def format_help(self) -> str:
        """The help of argparse, and the listing behind it."""
        return "\n".join(part for part in (super().format_help(), self.listing) if part)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse here what is not known: the parser of the verb knows what is near."""
        self._words = [str(word) for word in args or ()]
        given, unknown = super().parse_known_args(args, namespace)
        if unknown:
            name = unknown[0].partition("=")[0]
            options = [option for action in self._actions for option in action.option_strings]
            inside = [option for option in options if option.startswith(f"{name}.")]
            if inside:
                self.error(f"{name} is a group of settings; name one of {', '.join(inside)}")
            self.error(f"unknown argument {name}{did_you_mean(name, options)}")
        return given, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Behind all verbs, or values of an option, that there are: the one that was perhaps meant."""
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            error.message += did_you_mean(str(value), [str(choice) for choice in action.choices or ()])
            raise

    def error(self, message: str) -> NoReturn:
        """Raise instead of leaving: `flows.cli.main` says it."""
        lists = {
            option
            for action in self._actions
            if action.nargs in ("+", "*")
            for option in action.option_strings
        }
        last = next((word for word in reversed(self._words) if word in lists), None)
        if message.startswith(MISSING) and last is not None:
            message += words_taken_by(last)
        raise ConfigError(f"{message} (see {self.prog} --help)")


def words_taken_by(option: str) -> str:
    """What to say of an option with several values where a word that is needed is missing."""
    return f"; {option} takes all words behind it: other words stand before it, or behind --"


def add_verb(
    verbs: Any, name: str, command: Callable[[argparse.Namespace], int], summary: str, **more: Any
) -> Parser:
    """A verb below another one.

    Args:
        verbs: what `add_subparsers` returned.
        name: of the verb.
        command: what it does, given its arguments; returns the exit code.
        summary: what it does, in words.
        more: for the parser, e.g. a longer `description`.
    """
    made: Parser = verbs.add_parser(name, help=summary, **{"description": summary, **more})
    made.set_defaults(command=command)
    return made


def add_sequence(parser: Parser) -> None:
    """One sequence, by name or path."""
    parser.add_argument(
        "sequence",
        metavar="SEQUENCE",
        help="a name in the catalogue (`extrags data list`), or the path of a folder, video or DICOM file",
    )


def add_sequences(parser: Parser, *, chosen: bool, nargs: str = "+") -> None:
    """Several sequences.

    Args:
        parser: of a verb.
        chosen: whether patterns and manifests are understood (`flows.selection.chosen_sequences`).
        nargs: how many there may be.
    """
    parser.add_argument(
        "sequences",
        nargs=nargs,
        metavar="SEQUENCE",
        help="names, paths, patterns over the catalogue's names ('c3vdv2/*@sparse'), or @FILE for a manifest"
        if chosen
        else "names in the catalogue (`extrags data list`), or paths of folders, videos or DICOM files",
    )


def add_methods(parser: Parser) -> None:
    """Several methods, `coarse` and `extrags` by default."""
    from flows.methods import METHODS

    parser.add_argument(
        "--methods",
        nargs="+",
        default=["coarse", "extrags"],
        metavar="METHOD",
        help=f"of {', '.join(METHODS)} (default: coarse extrags)",
    )


def add_output(parser: Parser, metavar: str, kind: Callable[[str], str], **more: Any) -> None:
    """`-o` and `--output`; `--out`, which some verbs once called it, is understood and not shown.

    Args:
        parser: of a verb.
        metavar: what is written, e.g. `FILE`.
        kind: of `flows.commands.outputs`: `output_file`, `output_folder`, or `output_place` for either.
        more: for `add_argument`: at least `help`.
    """
    made = parser.add_argument("-o", "--output", metavar=metavar, type=kind, **more)
    # Not a name of the action: help and completion list those, and two options could not both be required.
    parser._option_string_actions["--out"] = made


def _named_place(text: str) -> str:
    """What `--store` names; an empty name, as of a variable that is not set, is not the default store.

    Raises:
        ArgumentTypeError: for an empty name.
    """
    if not text.strip():
        raise argparse.ArgumentTypeError("expected a folder or a URL")
    return text


def add_store(parser: Parser) -> None:
    """`--store`."""
    parser.add_argument(
        "--store",
        metavar="DIR|URL",
        type=_named_place,
        help="where artefacts are kept (default: $EXTRAGS_STORE, else .extrags)",
    )


def add_json(parser: Parser) -> None:
    """`--json`."""
    parser.add_argument(
        "--json",
        metavar="FILE|-",
        type=file_or_standard_output,
        help="write the results as JSON to a file or to standard output",
    )


def whole_number(least: int, most: int) -> Callable[[str], int]:
    """A parser of whole numbers in a range, as argparse takes one for `type`."""

    def parsed(text: str) -> int:
        with suppress(ValueError):
            if least <= int(text) <= most:
                return int(text)
        raise argparse.ArgumentTypeError(f"{text}; expected a whole number from {least} to {most}")

    return parsed


def number_above_zero(text: str) -> float:
    """A finite number above 0; `type` of an option."""
    with suppress(ValueError):
        if 0 < float(text) < math.inf:
            return float(text)
    raise argparse.ArgumentTypeError(f"{text}; expected a finite number above 0")


def _runner(name: str) -> str:
    """A task runner by name: what is wrong with it is said before anything is planned."""
    from flows.settings import check_runner

    try:
        check_runner(name)
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return name


def add_runner(parser: Parser) -> None:
    """`--runner`, `--retries` and `--stage-time-limit`."""
    parser.add_argument(
        "--runner",
        default="threads",
        type=_runner,
        metavar="threads|dask[:ADDRESS]",
        help="where tasks run; an address is that of a Dask scheduler that is already up",
    )
    parser.add_argument(
        "--retries",
        type=whole_number(0, 10),
        default=2,
        metavar="N",
        help="further tries of a stage after an error that can pass: store, network, lost worker, I/O "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--stage-time-limit",
        type=number_above_zero,
        metavar="SECONDS",
        help="a stage that takes longer fails at its next progress event, each of its tasks for itself "
        "(default: no limit)",
    )


def add_stages(parser: Parser) -> None:
    """`--until` and `--refresh`."""
    from extrags.stages import STAGES

    parser.add_argument(
        "--until", choices=STAGES, default="report", metavar="STAGE", help="stop after this stage"
    )
    parser.add_argument(
        "--refresh", action="store_true", help="run every stage although its artefact is in the store"
    )


def add_profile(parser: Parser, usual: str = DEFAULT_PROFILE) -> None:
    """`--profile`."""
    from extrags.config import PROFILES

    parser.add_argument(
        "--profile",
        choices=tuple(PROFILES),
        default=usual,
        help="preset: quick (preview), balanced (default) or paper (the paper's iteration counts)"
        if usual == DEFAULT_PROFILE
        else f"preset: quick (preview), balanced or paper (the paper's iteration counts) (default: {usual})",
    )


def add_method(parser: Parser) -> None:
    """`--profile`, `--seed`, `--method`, `--store` and all settings: what a run is made of."""
    from flows.methods import METHODS

    add_profile(parser)
    parser.add_argument(
        "--seed", type=int, metavar="N", help="seed of all stages (default: each stage's own)"
    )
    parser.add_argument(
        "--method",
        action=_Say,
        choices=tuple(METHODS),
        metavar="METHOD",
        default=DEFAULT_METHOD,
        help=f"what is run (default: {DEFAULT_METHOD}): "
        + "; ".join(f"{name} ({method.summary})" for name, method in METHODS.items()).replace("%", "%%"),
    )
    add_store(parser)
    add_settings(parser)


def add_settings(parser: Parser, group: str = "") -> None:
    """`--config`, `--set`, a flag for every setting, and `--help-settings`.

    All of them end up in `settings`, by dotted name; what stands last on the command line counts, and what a
    file sets where the command line sets nothing else.

    Args:
        parser: of a verb.
        group: settings of this group only; of a file with others, they are passed over.
    """
    known = _settings(group)
    parser.add_argument(
        "--config",
        dest="settings",
        metavar="FILE",
        action=_TakeFile,
        const=group,
        default=argparse.SUPPRESS,
        help="take settings from a YAML or JSON file, by dotted name or in groups, where neither --set nor a "
        "flag gives them; repeatable: the last file counts",
    )
    parser.add_argument(
        "--set",
        dest="settings",
        metavar="NAME=VALUE",
        action=_Assign,
        default={},
        help="override one setting; the same as --NAME VALUE, with a value in JSON or YAML; repeatable",
    )
    for name in known:
        if f"--{name}" in parser._option_string_actions:
            # The verb has one of its own by that name: the setting is `--set`'s alone.
            continue
        parser.add_argument(
            f"--{name}", dest="settings", action=_Assign, default=argparse.SUPPRESS, help=argparse.SUPPRESS
        )
    for flag, name in SHORT_NAMES.items():
        if name in known:
            parser.add_argument(
                flag,
                dest="settings",
                metavar="MM",
                action=_Assign,
                default=argparse.SUPPRESS,
                help=f"the same as --{name}: millimetres in one unit of the sequence's poses, where their "
                "unit is arbitrary",
            )
    parser.add_argument(
        "--help-settings",
        metavar="GROUP",
        nargs="?",
        const=group,
        action=_HelpSettings,
        default=argparse.SUPPRESS,
        help="explain the settings of a group, or of all: values they take, and defaults of the profile",
    )
    parser.listing = _listing(known)


class _Say(argparse.Action):
    """Takes a value, as argparse does by itself, and keeps that it was given: it may be the default."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        setattr(namespace, self.dest, values)
        setattr(namespace, f"said_{self.dest}", True)


class _Assign(argparse.Action):
    """`--set NAME=VALUE` and `--NAME VALUE` to an entry of `settings`."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        if option_string == "--set":
            from extrags.config.settings import parsed_words

            changed = parsed_words(parsed_settings([values]), _settings())
        else:
            name = SHORT_NAMES.get(str(option_string), str(option_string).removeprefix("--"))
            changed = {name: _settings()[name].parse(values)}
        # Not in place: what is there first is the parser's default.
        namespace.said_settings = {**getattr(namespace, "said_settings", {}), **changed}
        setattr(namespace, self.dest, _all_settings(namespace))


class _TakeFile(argparse.Action):
    """`--config FILE` to entries of `settings`, wherever on the command line it stands."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        from flows.commands.settings_file import settings_of_file

        of_file = settings_of_file(Path(values))
        taken = {name: of_file[name] for name in _settings(str(self.const)) if name in of_file}
        namespace.file_settings = {**getattr(namespace, "file_settings", {}), **taken}
        setattr(namespace, self.dest, _all_settings(namespace))


def _all_settings(namespace: argparse.Namespace) -> dict[str, Any]:
    """Settings of files, and over them those of the command line itself."""
    return {**getattr(namespace, "file_settings", {}), **getattr(namespace, "said_settings", {})}


class _HelpSettings(argparse.Action):
    """`--help-settings`: take the place of the verb, whose arguments need not be there."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        namespace.help_settings = values
        namespace.command = _explain
        for action in parser._actions:
            action.required = False


def _settings(group: str = "") -> dict[str, Setting]:
    from extrags.config import PipelineConfig
    from extrags.config.settings import settings_of

    known = settings_of(PipelineConfig)
    return {name: known[name] for name in known if not group or f"{name}.".startswith(f"{group}.")}


def _listing(known: dict[str, Setting]) -> str:
    """Names of all settings by group, for `--help`."""
    groups: dict[str, list[str]] = {}
    for setting in known.values():
        groups.setdefault(setting.group, []).append(setting.name.rpartition(".")[2])
    lines = ["settings (--GROUP.NAME VALUE; --help-settings [GROUP] explains them):"]
    for group, names in groups.items():
        lines += textwrap.wrap(
            " ".join(names) if group else " --".join(names),
            _columns(),
            initial_indent=f"  --{group}.*: " if group else "  --",
            subsequent_indent=" " * 8,
            break_on_hyphens=False,
        )
    return "\n".join(lines) + "\n"


def _explain(given: argparse.Namespace) -> int:
    """`--help-settings`: description, values and default of each setting of a group."""
    from extrags.config import PipelineConfig, profile_config
    from extrags.config.settings import groups_of, unknown_setting

    group = given.help_settings
    chosen = _settings(group)
    if not chosen:
        raise unknown_setting(group, _settings())
    profile = given.profile if "profile" in given else items(getattr(given, "profiles", [DEFAULT_PROFILE]))[0]
    tree = profile_config(profile).model_dump()
    about = groups_of(PipelineConfig)
    shown: str | None = None
    for setting in chosen.values():
        if setting.group != shown:
            shown = setting.group
            print(f"\n{shown}: {about[shown]}" if shown else f"\n{about[shown]}")
        default = tree
        for part in setting.name.split("."):
            default = default[part]
        print(f"  --{setting.name} {shlex.quote(setting.text(default))}")
        text = f"{setting.description} ({setting.expected})"
        indent = " " * 6
        # Names like sd-inpaint are not broken: they are there to be copied.
        print(
            textwrap.fill(
                text, _columns(), initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False
            )
        )
    print(f"\nThe values shown are those of the profile {profile}.")
    return 0


def _columns() -> int:
    return shutil.get_terminal_size().columns - 2
