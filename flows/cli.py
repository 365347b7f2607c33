"""The `extrags` command.

This module imports nothing heavy, so that `extrags --help` answers at once; each verb imports what it
needs in `flows.commands`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Any

__all__ = ["main", "parser"]

OK, FAILED, USAGE = 0, 1, 2

EXAMPLES = """examples:
  extrags run phantom/0@sparse --profile quick
  extrags run phantom/0@sparse phantom/0@distanced --seed 1 --json results.json
  extrags run frames/ --set coarse.iterations=500 --set enhance.backend=classical
  extrags plan phantom/0@sparse
  extrags cache rm 'explore*'

A sequence is DATASET/SEQUENCE[@SETTING] (see `extrags data list`) or the path of a folder.
Exit codes: 0 all well, 1 a sequence failed, 2 wrong usage."""


def parser() -> argparse.ArgumentParser:
    """The whole command line."""
    root = argparse.ArgumentParser(
        prog="extrags",
        description="Reconstruct an endoscopic sequence as 3D Gaussians, explore what it did not see, "
        "restore, fine-tune, and measure it off the trajectory.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    root.add_argument("--version", action="store_true", help="print the version and exit")
    verbs = root.add_subparsers(dest="verb", metavar="VERB", title="verbs")
    _add_run(verbs)
    _add_plan(verbs)
    _add_report(verbs)
    _add_export(verbs)
    _add_data(verbs)
    _add_cache(verbs)
    _add_bench(verbs)
    return root


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code.

    Errors of the user's are one sentence on standard error; `--debug` shows the traceback.
    """
    root = parser()
    given = root.parse_args(arguments)
    if given.version:
        from extrags import __version__

        print(__version__)
        return OK
    if given.verb is None:
        root.print_help()
        return USAGE
    try:
        return int(_command(given.command)(given))
    except KeyboardInterrupt:
        print("extrags: interrupted; what is finished stays in the store", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # `extrags cache ls | head`: nothing is wrong.
        sys.stderr.close()
        return OK
    except Exception as error:
        from extrags.errors import ConfigError, ExtragsError, UnknownSequenceError

        if given.debug or not isinstance(error, ExtragsError):
            raise
        print(f"extrags: {error}", file=sys.stderr)
        return USAGE if isinstance(error, ConfigError | UnknownSequenceError) else FAILED


def _command(name: str) -> Callable[[argparse.Namespace], int]:
    """`module.function` below `flows.commands`."""
    from importlib import import_module

    module, function = name.split(".")
    found: Callable[[argparse.Namespace], int] = getattr(import_module(f"flows.commands.{module}"), function)
    return found


def _verb(verbs: Any, name: str, command: str, summary: str, **more: Any) -> argparse.ArgumentParser:
    made: argparse.ArgumentParser = verbs.add_parser(
        name, help=summary, description=more.pop("description", summary), **more
    )
    made.set_defaults(command=command)
    made.add_argument("--debug", action="store_true", help="show tracebacks and the log")
    return made


def _add_store(made: argparse.ArgumentParser) -> None:
    made.add_argument(
        "--store",
        metavar="DIR|URL",
        help="where artefacts are kept (default: $EXTRAGS_STORE, else .extrags)",
    )


def _add_settings(made: argparse.ArgumentParser) -> None:
    made.add_argument(
        "--profile",
        choices=("quick", "balanced", "paper"),
        default="balanced",
        help="named settings: a look in minutes, the default, or the paper's counts",
    )
    made.add_argument(
        "--set",
        dest="settings",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        help="override one setting, e.g. coarse.iterations=500; repeatable",
    )
    made.add_argument("--seed", type=int, metavar="N", help="seed of all stages (default: each stage's own)")
    _add_store(made)


def _add_json(made: argparse.ArgumentParser) -> None:
    made.add_argument(
        "--json", metavar="FILE|-", help="write the results as JSON to a file or to standard output"
    )


def _add_runner(made: argparse.ArgumentParser) -> None:
    made.add_argument(
        "--runner",
        default="threads",
        metavar="threads|dask[:ADDRESS]",
        help="where tasks run; an address is that of a Dask scheduler that is already up",
    )


def _add_run(verbs: Any) -> None:
    made = _verb(
        verbs,
        "run",
        "run.run",
        "take sequences through all stages",
        description="Take each sequence through all stages. What is in the store already is not made "
        "again; a failure of one sequence does not stop the others.",
    )
    made.add_argument("sequences", nargs="+", metavar="SEQUENCE")
    _add_settings(made)
    _add_runner(made)
    _add_json(made)
    made.add_argument("--until", default="report", metavar="STAGE", help="stop after this stage")
    made.add_argument(
        "--refresh", action="store_true", help="run every stage although its artefact is in the store"
    )
    made.add_argument(
        "--at-once", type=int, default=1, metavar="N", help="sequences in work at the same time (default: 1)"
    )
    made.add_argument(
        "--always-flow",
        action="store_true",
        help="start a flow run even if everything is in the store already",
    )


def _add_plan(verbs: Any) -> None:
    made = _verb(verbs, "plan", "run.plan", "measure a scene and say which stages it needs, and why")
    made.add_argument("sequence", metavar="SEQUENCE")
    _add_settings(made)
    _add_runner(made)
    _add_json(made)


def _add_report(verbs: Any) -> None:
    made = _verb(verbs, "report", "run.report", "build the page of a finished run again, from the store")
    made.add_argument("sequence", metavar="SEQUENCE")
    _add_settings(made)
    made.add_argument("-o", "--output", metavar="FILE", help="also write the page to this file")


def _add_export(verbs: Any) -> None:
    made = _verb(verbs, "export", "export.export", "write a reconstructed scene as PLY")
    made.add_argument("sequence", metavar="SEQUENCE")
    _add_settings(made)
    made.add_argument(
        "--scene", choices=("final", "coarse"), default="final", help="which scene (default: final)"
    )
    made.add_argument("-o", "--output", required=True, metavar="FILE.ply", help="file to write")


def _add_data(verbs: Any) -> None:
    data = verbs.add_parser("data", help="what sequences there are", description="What sequences there are.")
    inner = data.add_subparsers(dest="what", metavar="list|show", required=True)
    made = _verb(inner, "list", "data.list_all", "all named sequences")
    _add_json(made)
    made = _verb(inner, "show", "data.show", "what is known about one sequence")
    made.add_argument("sequence", metavar="SEQUENCE")
    _add_json(made)


def _add_cache(verbs: Any) -> None:
    cache = verbs.add_parser(
        "cache", help="what is in the store", description="Look into the artefact store and clean it."
    )
    inner = cache.add_subparsers(dest="what", metavar="ls|rm|gc", required=True)
    made = _verb(inner, "ls", "cache.ls", "list artefacts")
    made.add_argument("pattern", nargs="?", default="*", help="shell pattern over key, stage or sequence")
    made.add_argument("--verify", action="store_true", help="read every file and compare digests")
    _add_store(made)
    _add_json(made)
    made = _verb(inner, "rm", "cache.rm", "remove artefacts")
    made.add_argument(
        "patterns", nargs="+", metavar="PATTERN", help="shell pattern over key, stage or sequence"
    )
    _add_store(made)
    made = _verb(
        inner,
        "gc",
        "cache.gc",
        "remove what can never be used again",
        description="Remove what killed runs left, debugging files of failures, and artefacts of former "
        "versions of their stage.",
    )
    _add_store(made)


def _add_bench(verbs: Any) -> None:
    bench = verbs.add_parser(
        "bench", help="benchmarks", description="Measure speed and error of the parts or of the whole."
    )
    inner = bench.add_subparsers(dest="what", metavar="raster|train|pipeline", required=True)
    for name, summary in (
        ("raster", "time and error of the rasteriser's backends"),
        ("train", "time of one training iteration"),
    ):
        made = _verb(inner, name, f"bench.{name}", summary)
        made.add_argument("--quick", action="store_true", help="the smallest size only")
        made.add_argument(
            "--threads", nargs="+", type=int, default=[1, 2], metavar="N", help="threads of the kernels"
        )
        _add_json(made)
    made = _verb(
        inner,
        "pipeline",
        "bench.pipeline",
        "run time against error of whole runs",
        description="Run the whole job over methods, profiles and seeds; what is in the store already is "
        "taken from there with the time it took when it was made.",
    )
    made.add_argument("sequences", nargs="+", metavar="SEQUENCE")
    made.add_argument("--profiles", nargs="+", default=["quick"], choices=("quick", "balanced", "paper"))
    made.add_argument(
        "--methods",
        nargs="+",
        default=["coarse", "extrags"],
        help="coarse, extrags, classical, real-only (default: coarse extrags)",
    )
    made.add_argument("--seeds", nargs="+", type=int, default=[0], metavar="N")
    made.add_argument("--set", dest="settings", metavar="NAME=VALUE", action="append", default=[])
    _add_store(made)
    _add_runner(made)
    _add_json(made)


if __name__ == "__main__":
    sys.exit(main())
