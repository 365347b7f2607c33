"""`export`: a reconstructed scene as Gaussians, mesh, points or video; a sequence with its cameras."""

from __future__ import annotations

import argparse
from pathlib import Path

from extrags.errors import ConfigError, StoreError, reason_of
from extrags.output_files import whole_folder
from extrags.user_paths import expanded
from flows.commands.common import counted, set_up_logging
from flows.commands.export_scene import ALONG
from flows.commands.options import Parser, add_method, add_output, add_sequence
from flows.commands.outputs import made_folder, output_place
from flows.interruption import say_when_interrupted

__all__ = ["add_arguments", "export"]

GAUSSIANS = ("ply", "compressed-ply", "spz", "sog")
COLORED = (*GAUSSIANS, "mesh", "points")
FLOWN = ("camera-path", "video")
SEQUENCES = ("colmap", "colmap-text", "transforms")

SUFFIXES = {
    "ply": (".ply",),
    "compressed-ply": (".ply",),
    "spz": (".spz",),
    "sog": (".sog",),
    "mesh": (".glb", ".obj", ".ply"),
    "points": (".ply",),
    "camera-path": (".json",),
    "video": (".mp4",),
}
"""How the file's name must end: programs choose their reader by it. Without `--to`, the first that fits."""

APPLIES = {
    "scene": COLORED,
    "light": COLORED,
    "distance": COLORED,
    "exposure": (*COLORED, "video"),
    "texture": ("mesh",),
    "min_opacity": ("points",),
    "along": FLOWN,
    "between": FLOWN,
    "fps": FLOWN,
    "width": FLOWN,
    "panels": ("video",),
}
"""Options, and what they say something about."""

INTERRUPTED = "the export was interrupted; nothing was written, and what was there before is as it was"

PANELS = ("coarse", "final", "uncertainty")


def add_arguments(parser: Parser) -> None:
    """The options of `extrags export`."""
    parser.description = (
        "Write a finished run's scene as Gaussians, mesh, points or video, or a sequence with its poses, "
        "images, masks, depth and points for COLMAP or nerfstudio. Poses that the run estimates or refines "
        "are taken from its store; without a run, those of the source."
    )
    parser.set_defaults(command=export)
    add_sequence(parser)
    add_method(parser)
    parser.add_argument(
        "--to",
        choices=(*COLORED, *FLOWN, *SEQUENCES),
        help="ply, compressed-ply, spz, sog: Gaussians, from the largest to the smallest file; mesh: surface "
        "with texture, of the kind that FILE ends with (.glb, .ply, .obj: then NAME_texture.mtl and "
        "NAME_texture.png are written beside NAME.obj); points: centres of the Gaussians; "
        "camera-path: JSON of nerfstudio's viewer; video: H.264; colmap, colmap-text, transforms: the "
        "sequence (default: by the ending of FILE; .ply: ply)",
    )
    add_output(
        parser, "FILE|DIR", output_place, required=True, help="file, or folder of a sequence, to write"
    )
    parser.add_argument(
        "--scene",
        choices=("final", "coarse"),
        help="which scene, for Gaussians, mesh and points (default: final)",
    )
    light = parser.add_argument_group("light: other programs know no lamp on the camera")
    light.add_argument(
        "--light",
        choices=("recorded", "frontal", "kept"),
        help="recorded: colours as bright as the training views saw them on average (default); frontal: as "
        "if all surfaces faced the lamp at --distance; kept: albedo, with the light in the header of a PLY, "
        "which `extrags import` reads",
    )
    light.add_argument(
        "--distance",
        type=float,
        metavar="D",
        help="of --light frontal, in world units (mostly mm; default: the light's reference distance)",
    )
    light.add_argument(
        "--exposure",
        type=float,
        metavar="GAIN",
        help="gain of the camera; 1 is the mean of the training frames (default: 1)",
    )
    surface = parser.add_argument_group("mesh and points")
    surface.add_argument(
        "--no-texture",
        dest="texture",
        action="store_false",
        default=None,
        help="a mesh with colours of vertices alone",
    )
    surface.add_argument(
        "--min-opacity",
        type=float,
        metavar="SHARE",
        help="fainter Gaussians are no points (default: 0.5)",
    )
    flight = parser.add_argument_group("camera-path and video")
    flight.add_argument(
        "--along",
        metavar="training|held-out|virtual|FILE.json",
        help="the cameras to fly through: of training or held-out frames, of the exploration's trajectories, "
        "or of a camera path (default: training)",
    )
    flight.add_argument(
        "--between",
        type=int,
        metavar="N",
        help="steps from each camera to the next; a camera path from a file is taken as it is (default: 1, "
        "the cameras themselves)",
    )
    flight.add_argument("--fps", type=float, metavar="RATE", help="frames per second (default: 24)")
    flight.add_argument(
        "--width", type=int, metavar="PX", help="width of one picture (default: that of the frames)"
    )
    flight.add_argument(
        "--panels",
        metavar="PANEL,...",
        help="pictures of a video side by side: coarse, final, uncertainty (default: all, without coarse "
        "where nothing was fine-tuned); uncertainty comes last",
    )


def export(given: argparse.Namespace) -> int:
    """`extrags export`."""
    say_when_interrupted(INTERRUPTED)
    given.to = given.to or _by_ending(given.output)
    _check(given)
    if given.to in SEQUENCES:
        set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
        return _sequence(given)
    from flows.commands.export_scene import export_scene

    return export_scene(given)


def _by_ending(output: str) -> str:
    """What is to be written where only the file's name says it.

    Raises:
        ConfigError: when it does not.
    """
    suffix = Path(output).suffix.lower()
    for name, suffixes in SUFFIXES.items():
        if suffix in suffixes:
            return name
    sequences = ", ".join(SEQUENCES)
    if Path(output).is_dir():
        raise ConfigError(f"--output {output} is a folder; expected a file, or one of --to {sequences}")
    known = ", ".join(dict.fromkeys(suffix for suffixes in SUFFIXES.values() for suffix in suffixes))
    raise ConfigError(
        f"--output {output}: the name must end in one of {known}; a folder needs one of --to {sequences}"
    )


def _check(given: argparse.Namespace) -> None:
    """Refuse what makes no sense before anything is looked up.

    Raises:
        ConfigError: for an option of another target, a value out of range, or a wrong name of the file.
    """
    for name, targets in APPLIES.items():
        if getattr(given, name) is not None and given.to not in targets:
            flag = "--no-texture" if name == "texture" else f"--{name.replace('_', '-')}"
            raise ConfigError(f"{flag} does not apply to --to {given.to}; it is for {', '.join(targets)}")
    if given.light == "kept" and given.to != "ply":
        raise ConfigError(f"--light kept is for --to ply; {given.to} has no place for a light")
    if given.light == "kept" and given.exposure is not None:
        raise ConfigError("--exposure is baked into colours, and --light kept bakes nothing")
    if given.distance is not None and given.light != "frontal":
        raise ConfigError("--distance is that of --light frontal")
    for name in ("distance", "exposure"):
        value = getattr(given, name)
        if value is not None and not 0 < value < float("inf"):
            raise ConfigError(f"--{name} is {value:g}; expected a number above 0")
    if given.min_opacity is not None and not 0 <= given.min_opacity < 1:
        raise ConfigError(f"--min-opacity is {given.min_opacity:g}; expected a number from 0 to below 1")
    if given.between is not None and not 1 <= given.between <= 1000:
        raise ConfigError(f"--between is {given.between}; expected 1 to 1000")
    if given.fps is not None and not 0.1 <= given.fps <= 1000:
        raise ConfigError(f"--fps is {given.fps:g}; expected 0.1 to 1000")
    if given.width is not None and not 16 <= given.width <= 8192:
        raise ConfigError(f"--width is {given.width}; expected 16 to 8192")
    panels = [] if given.panels is None else given.panels.split(",")
    for panel in panels:
        if panel not in PANELS:
            raise ConfigError(f"--panels: no panel {panel!r}; known: {', '.join(PANELS)}")
        if panels.count(panel) > 1:
            raise ConfigError(f"--panels: {panel} is named twice")
    if given.along not in (None, *ALONG) and not expanded(given.along).is_file():
        wanted = f"expected {', '.join(ALONG)} or a FILE.json"
        raise ConfigError(f"--along {given.along}: there is no such file; {wanted}")
    suffixes = SUFFIXES.get(given.to)
    if suffixes and Path(given.output).suffix.lower() not in suffixes:
        ending = " or ".join(suffixes)
        raise ConfigError(f"--output {given.output}: the name must end in {ending} (--to {given.to})")
    if given.to not in SEQUENCES and Path(given.output).is_dir():
        raise ConfigError(f"--output {given.output} is a folder; --to {given.to} writes a file")


def _sequence(given: argparse.Namespace) -> int:
    from data_catalog.readers.colmap_model import points_of, write_colmap
    from data_catalog.readers.transforms_json import write_transforms
    from flows.commands.export_scene import posed_sequence

    target = Path(given.output)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise ConfigError(f"{target} exists and is not an empty folder; nothing is written over it")
    sequence = posed_sequence(given)
    found = points_of(sequence)
    points, points_rgb = found if found is not None else (None, None)
    try:
        with made_folder(target.parent), whole_folder(target) as folder:
            if given.to == "transforms":
                write_transforms(sequence, folder, points=points, points_rgb=points_rgb)
            else:
                binary = given.to == "colmap"
                write_colmap(sequence, folder, binary=binary, points=points, points_rgb=points_rgb)
    except OSError as error:
        raise StoreError(f"{target} cannot be written: {reason_of(error)}") from error
    count = 0 if points is None else len(points)
    frames = counted(len(sequence.split.frames), "frame")
    masked = "" if sequence.mask.all() else "; images are black outside the masks"
    print(f"{target}: {frames} with poses, {counted(count, 'point')}{masked}")
    return 0
