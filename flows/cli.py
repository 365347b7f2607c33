"""The `extrags` command: its verbs, and the reporting of errors.

A verb is a module of `flows.commands` with `add_arguments`, which gives the parser its options and, as
`command`, the function that does the work. Only the module of the verb that is used is imported, so that
`extrags --help` answers at once.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module

from flows.commands.options import Parser
from flows.interruption import interruptible
from flows.printable import in_one_line
from flows.process_end import ProcessEnd
from flows.standard_streams import output_refusal, set_up_streams, write_out

__all__ = ["main", "parser"]

OK, FAILED, USAGE = 0, 1, 2

VERBS = {
    "run": "take sequences through all stages",
    "status": "show every sequence by every stage, from the store alone",
    "serve": "run the deployments on this machine, on demand and on schedule",
    "plan": "measure a scene and say which stages it needs, and why",
    "report": "build the page of a finished run again, from the store",
    "compare": "compare finished runs of one sequence side by side, on a page",
    "leaderboard": "sequences by methods, from the store's records, on a page that sorts and filters",
    "gallery": "pictures of finished runs with their figures, as a Markdown page",
    "view": "look at a scene in the browser, live: light, layers, camera paths to record",
    "export": "write a reconstructed scene as Gaussians, mesh or video, or a sequence for COLMAP",
    "import": "take a scene that another program has made through the later stages",
    "data": "list, inspect and validate input sequences",
    "cache": "list, verify and clean the artefact store",
    "reconcile": "mark runs left Running by a power loss as Crashed",
    "devices": "what a run would do on the processor and what on a GPU, and why",
    "weights": "which weights of networks are on this machine, and their download",
    "evaluate": "measure renders made elsewhere, or show the figures of a finished run",
    "benchmark": "compare methods over sequences and seeds",
    "bench": "measure speed and error of the parts or of the whole",
    "pretrain": "train the restorer's weights from the beginning, on procedural scenes",
    "completion": "a script that completes commands, options, settings and sequences in a shell",
}
"""Each verb with what it does, in the order of the help."""

MODULES = {"import": "import_scene"}
"""Modules of verbs that are words of Python."""

EXAMPLES = """examples:
  extrags run phantom/0@sparse --profile quick
  extrags run phantom/0@sparse phantom/0@distanced --seed 1 --json results.json
  extrags run frames/ --coarse.iterations 500 --enhance.backend classical
  extrags run 'phantom/[0-3]@sparse' --methods 3dgs,extrags --seeds 0,1 --only failed
  extrags run --help-settings coarse.light
  extrags status 'phantom/*'
  extrags devices --device cuda
  extrags plan phantom/0@sparse
  extrags evaluate phantom/0@sparse --renders my_renders/ --json -
  extrags benchmark phantom/0@sparse phantom/1@sparse --methods 3dgs,coarse --seeds 0,1,2
  extrags compare phantom/0@sparse --methods 3dgs extrags
  extrags data check my_video.mp4 my_colmap_scene/
  extrags view phantom/0@sparse --scene coarse
  extrags export phantom/0@sparse --to spz --output scene.spz
  extrags import theirs.ply --sequence their_colmap_folder/ --profile quick
  extrags export phantom/0@sparse --to colmap --output scene/
  extrags cache rm 'explore*'

A sequence is DATASET/SEQUENCE[@SETTING] (see `extrags data list`) or the path of a folder or a video.
Exit codes: 0 all well, 1 a sequence failed, 2 wrong usage, 3 too few seeds to judge (bench compare), 130
interrupted, 143 terminated."""


def parser(verb: str | None = None) -> Parser:
    """The argument parser; only the verb that is named gets its options."""
    root = Parser(
        prog="extrags",
        description="Reconstruct an endoscopic sequence as 3D Gaussians, explore what it did not see, "
        "restore, fine-tune, and measure it off the trajectory.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    root.add_argument("--version", action="store_true", help="print the version and exit")
    verbs = root.add_subparsers(dest="verb", metavar="VERB", title="verbs", parser_class=Parser)
    for name, summary in VERBS.items():
        made = verbs.add_parser(name, help=summary, description=f"{summary[0].upper()}{summary[1:]}.")
        if name == verb:
            import_module(f"flows.commands.{MODULES.get(name, name)}").add_arguments(made)
    return root


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code.

    Expected errors (`ExtragsError`) are printed to standard error as their message, with a hint if there is
    one, other errors with their type and message. `--debug` shows tracebacks.

    Args:
        arguments: those of the process by default; Ctrl-C and SIGTERM then end it with one sentence
            (`flows.interruption`).
    """
    if arguments is None:
        # Signals, streams and the end belong to the process: they are handled where the command is all of it.
        set_up_streams()
        if "--debug" not in sys.argv and not sys.warnoptions:
            # What libraries warn their callers of, names of their files with it, tells a user nothing, breaks
            # the display of a run, and is no error that `--quiet` leaves.
            warnings.simplefilter("ignore")
        end = ProcessEnd()
        with interruptible():
            end.code = code = main(sys.argv[1:])
        return code
    try:
        code = _answered(arguments)
    except SystemExit as ended:
        # Of the parser, which has printed a help.
        write_out()
        if ended.code or output_refusal() is None:
            raise
        code = FAILED
    except BaseException:
        write_out()
        raise
    write_out()
    refusal = output_refusal()
    if refusal is None:
        return code
    _say(f"standard output cannot be written: {refusal.strerror}")
    return code or FAILED


def _answered(arguments: Sequence[str]) -> int:
    """The exit code of a command; what made it fail is said."""
    try:
        return _run(arguments)
    except BrokenPipeError:
        # `extrags cache ls | head`: nothing is wrong.
        return OK
    except Exception as error:
        if error is output_refusal():
            return FAILED
        if "--debug" in arguments:
            raise
        from extrags.data_directories import check_home
        from extrags.errors import ConfigError, UnknownSequenceError
        from extrags.redaction import without_credentials
        from flows.failures import describe_error

        shown = error
        if isinstance(error, RuntimeError) and "home directory" in str(error):
            # Packages look for it while they are imported.
            try:
                check_home()
            except ConfigError as unknown:
                shown = unknown
        for line in describe_error(shown):
            _say(without_credentials(line))
        return USAGE if isinstance(shown, ConfigError | UnknownSequenceError) else FAILED


def _say(line: str) -> None:
    """Tell on standard error; where that cannot be written, the exit code alone tells."""
    with suppress(OSError):
        print(f"extrags: {in_one_line(line)}", file=sys.stderr)
    write_out()


def _run(arguments: Sequence[str]) -> int:
    root = parser(next((word for word in arguments if not word.startswith("-")), None))
    given = root.parse_args(arguments, argparse.Namespace(debug=False, quiet=False))
    if given.version:
        from extrags import __version__

        print(__version__)
        return OK
    if given.verb is None:
        root.print_help()
        return USAGE
    return int(given.command(given))


if __name__ == "__main__":
    sys.exit(main())
