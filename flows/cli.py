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
METHOD_NAMES = ("extrags", "coarse", "3dgs", "classical", "real-only")
"""Those of `flows.methods`, written down again: importing it would load pydantic. A test compares them."""

EXAMPLES = """examples:
  extrags run phantom/0@sparse --profile quick
  extrags run phantom/0@sparse phantom/0@distanced --seed 1 --json results.json
  extrags run frames/ --set coarse.iterations=500 --set enhance.backend=classical
  extrags plan phantom/0@sparse
  extrags evaluate phantom/0@sparse --renders my_renders/ --json -
  extrags benchmark phantom/0@sparse phantom/1@sparse --methods 3dgs,coarse --seeds 0,1,2
  extrags data check my_video.mp4 my_colmap_scene/
  extrags export phantom/0@sparse --to colmap --out scene/
  extrags cache rm 'explore*'

A sequence is DATASET/SEQUENCE[@SETTING] (see `extrags data list`) or the path of a folder or a video.
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
    _add_evaluate(verbs)
    _add_benchmark(verbs)
    _add_bench(verbs)
    _add_pretrain(verbs)
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
    _add_profile(made, "balanced", "coarse.iterations=500")
    made.add_argument("--seed", type=int, metavar="N", help="seed of all stages (default: each stage's own)")
    made.add_argument(
        "--method",
        choices=METHOD_NAMES,
        default="extrags",
        help="the whole pipeline (default), the coarse scene alone, plain 3DGS, ...",
    )
    _add_store(made)


def _add_profile(made: argparse.ArgumentParser, usual: str, example: str) -> None:
    made.add_argument(
        "--profile",
        choices=("quick", "balanced", "paper"),
        default=usual,
        help=f"named settings: a look, a good result, or the paper's counts (default: {usual})",
    )
    made.add_argument(
        "--set",
        dest="settings",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        help=f"override one setting, e.g. {example}; repeatable",
    )


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
    made = _verb(
        verbs,
        "export",
        "export.export",
        "write a reconstructed scene as PLY, or a sequence as COLMAP model or transforms.json",
        description="Write a finished run's scene as PLY, or a sequence with its poses, images, masks, depth "
        "and points for COLMAP or nerfstudio. Poses that a run has estimated are taken from its store.",
    )
    made.add_argument("sequence", metavar="SEQUENCE")
    _add_settings(made)
    made.add_argument(
        "--to",
        choices=("ply", "colmap", "colmap-text", "transforms"),
        default="ply",
        help="ply: the scene; the others: the sequence (default: ply)",
    )
    made.add_argument(
        "--scene", choices=("final", "coarse"), default="final", help="which scene, for ply (default: final)"
    )
    made.add_argument(
        "-o", "--output", "--out", required=True, metavar="FILE.ply|DIR", help="file, or folder to write into"
    )


def _add_data(verbs: Any) -> None:
    data = verbs.add_parser(
        "data",
        help="what sequences there are, and whether a source is right",
        description="What sequences there are, what is in one, and what is wrong with one.",
    )
    inner = data.add_subparsers(dest="what", metavar="list|show|check", required=True)
    made = _verb(inner, "list", "data.list_all", "all named sequences, and whether they can be read here")
    made.add_argument("pattern", nargs="?", default="*", help="shell pattern or beginning of a name")
    made.add_argument("--here", action="store_true", help="only those whose data are on this machine")
    _add_json(made)
    made = _verb(inner, "show", "data.show", "what is known about one sequence, and what its frames hold")
    made.add_argument("sequence", metavar="SEQUENCE")
    _add_ingest(made)
    made.add_argument(
        "--picture",
        metavar="FILE.png",
        help="write a contact sheet: masks blue, highlights green, held-out framed",
    )
    _add_json(made)
    made = _verb(
        inner,
        "check",
        "data.check",
        "say what is wrong with a source",
        description="Read a source and say what is wrong with it: axes, pose direction, depth scale, mask "
        "polarity, intrinsics, exposure, parallax, names. Exit code 1 when anything is.",
    )
    made.add_argument("sources", nargs="+", metavar="PATH|SEQUENCE")
    _add_ingest(made)
    _add_json(made)


def _add_ingest(made: argparse.ArgumentParser) -> None:
    made.add_argument(
        "--set",
        dest="settings",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        help="override one setting of ingest, e.g. ingest.downscale=2; repeatable",
    )


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


def _add_evaluate(verbs: Any) -> None:
    made = _verb(
        verbs,
        "evaluate",
        "evaluate.evaluate",
        "measure renders made elsewhere, or show the figures of a finished run",
        description="Measure a folder of renders of the held-out frames by the protocol of "
        "extrags/metrics/PROTOCOL.md; without --renders, show the figures of a run that is in the store.",
    )
    made.add_argument("sequence", metavar="SEQUENCE")
    made.add_argument(
        "--renders",
        metavar="FOLDER",
        help="8-bit images of the sequence's size, named after the held-out frames or numbered in order",
    )
    made.add_argument(
        "--depth", metavar="FOLDER", help="z-depth of the same frames: .npy, or 16-bit PNG or TIFF; 0: none"
    )
    made.add_argument(
        "--depth-step", type=float, metavar="MM", help="what one level of an integer depth image stands for"
    )
    _add_settings(made)
    _add_json(made)


def _add_benchmark(verbs: Any) -> None:
    made = _verb(
        verbs,
        "benchmark",
        "benchmark.benchmark",
        "compare methods over sequences and seeds",
        description="Run every method on every sequence with every seed, and compare them pair by pair. What "
        "is in the store already is taken from there with the time it took when it was made.",
    )
    _add_benchmark_runs(made)


def _add_benchmark_runs(made: argparse.ArgumentParser) -> None:
    many: dict[str, Any] = {"nargs": "+"}
    made.add_argument("sequences", nargs="+", metavar="SEQUENCE")
    made.add_argument(
        "--methods",
        **many,
        default=["coarse", "extrags"],
        metavar="METHOD",
        help=f"of {', '.join(METHOD_NAMES)} (default: coarse extrags)",
    )
    made.add_argument(
        "--variant",
        dest="variants",
        nargs="+",
        action="append",
        default=[],
        metavar=("NAME", "METHOD|SETTING=VALUE"),
        help="a further method: coarse, or METHOD, with other settings; repeatable",
    )
    made.add_argument(
        "--baseline", metavar="METHOD", help="what the others are compared with (default: 3dgs)"
    )
    made.add_argument("--seeds", **many, default=["0"], metavar="N", help="e.g. 0,1,2 (default: 0)")
    made.add_argument(
        "--profiles", **many, default=["quick"], metavar="PROFILE", help="named settings (default: quick)"
    )
    made.add_argument(
        "--set",
        dest="settings",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        help="override one setting of all runs; repeatable",
    )
    made.add_argument("--name", default="benchmark", help="title of the page")
    _add_store(made)
    _add_runner(made)
    _add_json(made)


_KERNELS: dict[str, Any] = {
    "formatter_class": argparse.RawDescriptionHelpFormatter,
    "epilog": """examples:
  --size 160x128 --gaussians 10000
  --size 160x128,320x256 --gaussians 10000,30000 --threads 1 2 --json -
  --quick --peers torch,reference

peers: direct (the kernels as training uses them, without autograd; train only), torch (batched tiles,
float32), reference (the specification, float64), gsplat (CUDA).
A size goes with the number of Gaussians at the same place in the list.""",
}


def _add_kernel_cases(made: argparse.ArgumentParser, *, with_error: bool) -> None:
    many: dict[str, Any] = {"nargs": "+", "action": "extend"}
    made.add_argument(
        "--size",
        metavar="WxH",
        **many,
        help="image sizes (default: 160x128 320x256 640x512, with 10000 30000 100000 Gaussians)",
    )
    made.add_argument("--gaussians", metavar="N", **many, help="numbers of Gaussians, one per size")
    made.add_argument("--quick", action="store_true", help="the smallest standard size only")
    made.add_argument(
        "--peers",
        metavar="PEER",
        **many,
        help="what to run beside the native kernels (default: torch, and direct for train; native: nothing)",
    )
    made.add_argument("--threads", metavar="N", **many, help="numbers of threads to measure (default: 1 2)")
    made.add_argument("--rounds", type=int, default=20, metavar="N", help="timed rounds (default: 20)")
    made.add_argument(
        "--error",
        action=argparse.BooleanOptionalAction,
        default=with_error,
        help=f"compare image and gradients with float64 (default: {'yes' if with_error else 'no'})",
    )


def _add_pretrain(verbs: Any) -> None:
    made = _verb(
        verbs,
        "pretrain",
        "pretrain.pretrain",
        "make the restorer's weights anew from procedural scenes",
        description="Make pretraining scenes (colons that are never evaluated), reconstruct them, and train "
        "the restorer on views far off their paths. This is how the weights of the package were made; hours "
        "on two cores. Pretraining scenes that are in the folder already are taken from there.",
    )
    made.add_argument("--out", required=True, metavar="FOLDER", help="where the weights go")
    made.add_argument(
        "--scenes-folder",
        default=".extrags/pretraining",
        metavar="FOLDER",
        help="where pretraining scenes are kept, 40 MB each (default: %(default)s)",
    )
    made.add_argument("--scenes", type=int, metavar="N", help="pretraining scenes (default: 86)")
    made.add_argument(
        "--validation-scenes", type=int, metavar="N", help="how many of them only judge (default: 6)"
    )
    made.add_argument("--iterations", type=int, metavar="N", help="optimisation steps (default: 13500)")
    made.add_argument("--batch", type=int, metavar="N", help="crops per step (default: 4)")
    made.add_argument("--start", metavar="FOLDER", help="go on from these weights instead of from nothing")
    made.add_argument("--learning-rate", type=float, metavar="X", help="the peak (default: 8e-4)")
    made.add_argument(
        "--perceptual-weight", type=float, metavar="X", help="of the perceptual distance (default: 0.15)"
    )
    made.add_argument(
        "--error-weight", type=float, metavar="X", help="of the expected error's likelihood (default: 0.02)"
    )
    made.add_argument("--seed", type=int, metavar="N", help="of the training (default: 0)")
    made.add_argument("--threads", type=int, metavar="N", help="threads of the training (default: all)")
    made.add_argument(
        "--workers", type=int, default=1, metavar="N", help="scenes made at once (default: %(default)s)"
    )
    made.add_argument(
        "--without-perceptual",
        action="store_true",
        help="train without the perceptual distance, whose weights (LPIPS, SqueezeNet) must be had",
    )
    made.add_argument(
        "--deterministic", action="store_true", help="a plain regression: the baseline of the diffusion"
    )


def _add_bench(verbs: Any) -> None:
    bench = verbs.add_parser(
        "bench", help="benchmarks", description="Measure speed and error of the parts or of the whole."
    )
    inner = bench.add_subparsers(
        dest="what", metavar="raster|train|stability|enhance|pipeline", required=True
    )
    for name, summary, with_error in (
        ("raster", "time and error of the rasteriser, forward and backward", True),
        ("train", "time of a whole training iteration: render, loss, backward, Adam", False),
    ):
        made = _verb(inner, name, f"bench.{name}", summary, **_KERNELS)
        _add_kernel_cases(made, with_error=with_error)
        _add_json(made)
    made = _verb(
        inner,
        "stability",
        "bench.stability",
        "numbers at the edges of what the rasteriser can be given",
        description="Render and differentiate scenes at the edges of what float32 holds, and say what is not "
        "finite or not what the float64 specification gives. Exit code 1 if a case fails.",
    )
    made.add_argument("--axis", nargs="+", metavar="NAME", help="these axes only (default: all)")
    made.add_argument(
        "--threads", type=int, default=1, metavar="N", help="threads of the kernels (default: 1)"
    )
    _add_json(made)
    _add_bench_enhance(inner)
    made = _verb(
        inner,
        "pipeline",
        "benchmark.benchmark",
        "run time against error of whole runs: the same as `extrags benchmark`",
        description="Run the whole job over methods, profiles and seeds; what is in the store already is "
        "taken from there with the time it took when it was made.",
    )
    _add_benchmark_runs(made)


def _add_bench_enhance(inner: Any) -> None:
    made = _verb(
        inner,
        "enhance",
        "bench.enhance",
        "restorers beside each other on held-out views of sequences",
        description="Reconstruct each sequence, restore its held-out views with every method, and compare "
        "with what they really look like: whole, well seen, holes, observed and unobserved.",
    )
    made.add_argument("sequences", nargs="+", metavar="SEQUENCE")
    made.add_argument(
        "--methods",
        nargs="+",
        default=["none", "classical", "embedded"],
        metavar="METHOD",
        help="none, classical, embedded (as the settings say), embedded-1, embedded-4 (steps), zero-shot "
        "(pretrained weights alone), scene-trained (trained further on the scene), scratch (trained on the "
        "scene alone), deterministic (the same as a plain regression), each also with /no-references behind "
        "it (default: none classical embedded)",
    )
    _add_profile(made, "quick", "enhance.samples=4")
    made.add_argument("--seed", type=int, default=0, metavar="N", help="seed of all stages (default: 0)")
    made.add_argument(
        "--figure", metavar="FILE.png", help="draw predicted against true error (the calibration)"
    )
    _add_json(made)


if __name__ == "__main__":
    sys.exit(main())
