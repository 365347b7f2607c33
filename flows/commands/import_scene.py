"""`import`: a scene that another program has made goes through the later stages."""

from __future__ import annotations

import argparse
from shlex import quote

from extrags.errors import ConfigError, SourceNotFoundError
from extrags.user_paths import absolute
from flows.commands.options import Parser, add_json, add_method, add_runner, add_stages

__all__ = ["add_arguments", "import_scene"]


def add_arguments(parser: Parser) -> None:
    """The options of `extrags import`."""
    parser.description = (
        "Take a scene that another program has made, as 3DGS PLY or SPZ, through exploration, restoration, "
        "fine-tuning and evaluation, with the cameras and frames of the sequence it belongs to: it takes the "
        "place of the coarse scene. Scene and cameras must share one world: a COLMAP folder, or "
        "transforms.json, that the scene was trained from is such a sequence. The same as `extrags run "
        "SEQUENCE --imported.scene FILE --imported.scale UNITS`; other verbs find the run by these settings."
    )
    parser.set_defaults(command=import_scene)
    parser.add_argument("file", metavar="FILE", help="3DGS PLY or SPZ")
    parser.add_argument(
        "--sequence", required=True, metavar="SEQUENCE", help="its frames and cameras: a name or a path"
    )
    parser.add_argument(
        "--scene-scale",
        "--units",
        dest="units",
        type=float,
        metavar="UNITS",
        help="the same as --imported.scale: units of the sequence's poses, mostly millimetres, in one unit "
        "of the imported file (default: 1). It scales the file alone; --scale scales the sequence's poses",
    )
    add_method(parser)
    add_runner(parser)
    add_json(parser)
    add_stages(parser)


def import_scene(given: argparse.Namespace) -> int:
    """`extrags import`.

    Raises:
        SourceNotFoundError: when there is no such file.
        ConfigError: when file and sequence are reversed, or a setting is given twice.
    """
    from flows.commands.run import run

    if _is_splat_file(given.sequence) and not _is_splat_file(given.file):
        right = f"extrags import {quote(given.sequence)} --sequence {quote(given.file)}"
        raise ConfigError(f"the scene and the sequence it belongs to are reversed; expected {right}")
    file = absolute(given.file)
    if not file.is_file():
        raise SourceNotFoundError("no such file", file=file)
    for name in ("imported.scene", "imported.scale"):
        if name in given.settings and (name == "imported.scene" or given.units is not None):
            raise ConfigError(f"{name} is set twice: by FILE or --scene-scale, and by --{name}")
    # No default of the parser: it is shared by all that it parses.
    given.settings = {**given.settings, "imported.scene": str(file)}
    if given.units is not None:
        given.settings["imported.scale"] = given.units
    several = {"manifest": [], "at_once": 1, "only": None, "methods": [], "seeds": [], "matrix": []}
    return run(argparse.Namespace(**vars(given), **several, sequences=[given.sequence], always_flow=False))


def _is_splat_file(path: str) -> bool:
    return path.lower().endswith((".ply", ".spz")) and not absolute(path).is_dir()
