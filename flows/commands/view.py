"""`view`: a scene in the browser, rendered here, live."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from extrags.config import DEFAULT_PROFILE
from extrags.errors import ConfigError, installed_with
from extrags.user_paths import expanded
from flows.commands.common import DEFAULT_METHOD, finished_run, run_config, set_up_logging
from flows.commands.options import Parser, add_method
from flows.interruption import until_told_to_stop
from flows.printable import in_one_line

if TYPE_CHECKING:
    import numpy as np

    from extrags.cameras import Cameras
    from extrags.scene import Scene
    from extrags.stages import StageName

__all__ = ["add_arguments", "view"]

FILES = (".ply", ".spz", ".sog")
"""SOG is not read: the reader says so, and what is."""


def add_arguments(parser: Parser) -> None:
    """The options of `extrags view`."""
    parser.description = (
        "Show a finished run's scene, or a file of Gaussians, in the browser: rendered on this machine, half "
        "resolution while the camera moves and full resolution once it rests, with light, layers and camera "
        "paths to record. Needs the extra `view`."
    )
    parser.set_defaults(command=view)
    parser.add_argument(
        "sequence",
        metavar="SEQUENCE|FILE",
        help="a sequence whose run with these settings is in the store, or a 3DGS PLY or SPZ",
    )
    # Of the picture; the run's own is `--set device=...`.
    parser.add_argument(
        "--device",
        choices=("auto", "cpu", "cuda"),
        default="auto",
        help="auto: CUDA where there is a device and gsplat, else the processor (default: auto)",
    )
    add_method(parser)
    parser.add_argument(
        "--scene", choices=("final", "coarse"), help="which scene of the run (default: final)"
    )
    parser.add_argument(
        "--width",
        type=int,
        default=640,
        metavar="PX",
        help="width of a picture at full resolution, or its height in a window that is taller than wide "
        "(default: %(default)s); the window gives its shape",
    )
    parser.add_argument(
        "--port", type=int, default=8080, metavar="N", help="0 takes a free one (default: %(default)s)"
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="where to listen; anything but the default lets others look who can reach it, without a "
        "password (default: %(default)s)",
    )


def view(given: argparse.Namespace) -> int:
    """`extrags view`; serves until it is interrupted.

    Raises:
        ConfigError: for an option that makes no sense, an address that is not of this machine, or a method
            without Gaussians.
        MissingDependencyError: without viser.
        SourceError: when the file is damaged.
        StoreError: when the run is not in the store, or the port is taken.
    """
    _check(given)
    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    from flows.view_server import ViewServer, check_installed

    # Before the scene is looked up, which takes a while.
    check_installed()
    device = _device(given.device)
    shown = _from_file(given) if _is_file(given) else _from_store(given)
    from extrags.raster import native_isa
    from extrags.view import SceneRenderer

    renderer = SceneRenderer(shown.scene, train=shown.train, masks=shown.masks, device=device)
    server = ViewServer(
        renderer, title=f"{shown.name} (extrags)", host=given.host, port=given.port, width=given.width
    )
    where = "gsplat on CUDA" if device == "cuda" else f"native kernels ({native_isa()})"
    print(
        f"{server.url}: {in_one_line(shown.name)}, {len(shown.scene.gaussians)} Gaussians, {where}; "
        "Ctrl-C ends",
        flush=True,
    )
    try:
        until_told_to_stop()
    finally:
        server.stop()
    return 0


class _Shown(NamedTuple):
    name: str
    scene: Scene
    train: Cameras | None
    masks: list[np.ndarray] | None = None
    """Pixels of the training views that show tissue."""


def _is_file(given: argparse.Namespace) -> bool:
    return Path(given.sequence).suffix.lower() in FILES


def _check(given: argparse.Namespace) -> None:
    if not 16 <= given.width <= 8192:
        raise ConfigError(f"--width is {given.width}; expected 16 to 8192")
    if not 0 <= given.port <= 65535:
        raise ConfigError(f"--port is {given.port}; expected 0 to 65535")
    if _is_file(given):
        usual = {"method": DEFAULT_METHOD, "profile": DEFAULT_PROFILE}
        for name in ("scene", "seed", "method", "profile", "store", "settings"):
            if getattr(given, name) not in (None, {}, usual.get(name)):
                flag = f"--{name}" if name != "settings" else ", ".join(f"--{key}" for key in given.settings)
                raise ConfigError(f"{flag} does not apply to a file of Gaussians; it is for a SEQUENCE")


def _device(asked: str) -> str:
    from extrags.devices import chosen_device
    from extrags.raster import available_backends

    if asked == "auto":
        return "cuda" if "gsplat" in available_backends() else "cpu"
    device = chosen_device(asked, "--device").type
    if device == "cuda" and "gsplat" not in available_backends():
        raise ConfigError(f"--device=cuda needs gsplat: {installed_with('cuda')}")
    return device


def _from_file(given: argparse.Namespace) -> _Shown:
    from extrags.splat_files import read_splat_file

    path = expanded(given.sequence)
    return _Shown(path.name, read_splat_file(path), None)


def _from_store(given: argparse.Namespace) -> _Shown:
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence
    from extrags.shown_pixels import shown_pixels
    from tasks.progress import observed

    if run_config(given).uc_nerf.enabled:
        raise ConfigError(f"the method {given.method} makes no Gaussians to look at")
    which = given.scene or "final"
    # Looking up stages is no progress.
    with observed(lambda _: None):
        until: StageName = "coarse" if which == "coarse" else "finetune"
        run = finished_run(given, until, coarse_by="--scene coarse")
    coarse = run.refs["coarse"]
    # Where fine-tuning was left out, the coarse scene is the final one.
    scene = run.store.load(Scene, run.refs.get("finetune", coarse) if which == "final" else coarse)
    frames = run.store.load(EndoscopicSequence, run.refs["sequence"])
    train = frames.training_cameras
    pinholes = train.as_pinholes()
    masks = list(shown_pixels(frames.training_masks, train, pinholes))
    return _Shown(f"{given.sequence}, {which} scene", scene, pinholes, masks)
