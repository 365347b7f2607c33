"""What `extrags export` writes of a finished run: Gaussians, mesh, points, camera paths, video; its poses."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from extrags.errors import ConfigError, ExtragsError, StoreError, reason_of
from extrags.user_paths import expanded
from flows.commands.common import finished_run, is_terminal, run_config, set_up_logging, showing
from flows.commands.outputs import made_folder

if TYPE_CHECKING:
    from extrags.cameras import Cameras
    from extrags.config import PipelineConfig
    from extrags.export import CameraPath
    from extrags.gaussians import Gaussians
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence
    from extrags.stages import StageName
    from flows.wiring import SequenceRun

__all__ = ["ALONG", "export_scene", "posed_sequence"]

logger = logging.getLogger(__name__)

ALONG = ("training", "held-out", "virtual")
"""Cameras of a run to fly through; anything else that `--along` names is the file of a camera path."""


def export_scene(given: argparse.Namespace) -> int:
    """All of `extrags export` but sequences; the options were checked before.

    Raises:
        ConfigError: for a method without Gaussians, or a trajectory that is not there.
        StoreError: when the run is not in the store, or the file cannot be written.
    """
    set_up_logging(debug=given.debug, terminal=is_terminal(), quiet=given.quiet)
    config = run_config(given)
    if config.uc_nerf.enabled and given.to != "camera-path":
        raise ConfigError(f"the method {given.method} makes no Gaussians to write as {given.to}")
    target = Path(given.output)
    write = {"camera-path": _camera_path, "video": _video, "mesh": _mesh, "points": _points}
    with _progress(given):
        try:
            with made_folder(target.parent):
                said = write.get(given.to, _gaussians)(given, target)
        except ExtragsError:
            # Some are errors of files as well, and say themselves which one and why.
            raise
        except OSError as error:
            raise StoreError(f"{target} cannot be written: {reason_of(error)}") from error
    print(f"{target}: {said}")
    return 0


@contextmanager
def _progress(given: argparse.Namespace) -> Iterator[None]:
    from flows.progress_display import progress_display
    from tasks.progress import reporting

    with progress_display(showing(given)), reporting(given.sequence, "export"):
        yield


@dataclass(frozen=True)
class _Finished:
    """The scenes of a finished run and the cameras they were made with."""

    run: SequenceRun
    config: PipelineConfig

    @property
    def fine_tuned(self) -> bool:
        return "finetune" in self.run.refs

    def scene(self, which: str) -> Scene:
        """`coarse` or `final`; where fine-tuning was left out, the coarse scene is the final one."""
        from extrags.scene import Scene

        part = self.run.refs["coarse"]
        return self.run.store.load(Scene, self.run.refs.get("finetune", part) if which == "final" else part)

    def frames(self) -> EndoscopicSequence:
        """All frames, with the poses that the scene was made with."""
        from extrags.sequence import EndoscopicSequence

        return self.run.store.load(EndoscopicSequence, self.run.refs["sequence"])

    def virtual(self) -> list[Cameras]:
        """The views of each virtual trajectory; none where nothing was explored."""
        from extrags.exploration import Exploration

        if "explore" not in self.run.refs:
            return []
        return self.run.store.load(Exploration, self.run.refs["explore"]).trajectories


def _finished(given: argparse.Namespace, until: StageName, coarse_by: str = "") -> _Finished:
    from tasks.progress import observed

    # Looking up stages is no progress.
    with observed(lambda _: None):
        run = finished_run(given, until, coarse_by=coarse_by)
    return _Finished(run, run_config(given))


def _chosen(given: argparse.Namespace) -> tuple[_Finished, Scene]:
    which = given.scene or "final"
    finished = _finished(given, "coarse" if which == "coarse" else "finetune", "--scene coarse")
    return finished, finished.scene(which)


def _baked(given: argparse.Namespace, finished: _Finished, scene: Scene) -> Gaussians:
    from extrags.splat_files import bake_light, bake_recorded_light

    exposure = 1.0 if given.exposure is None else given.exposure
    if given.light == "frontal" or scene.light is None:
        return bake_light(scene, distance=given.distance, exposure=exposure)
    frames = finished.frames()
    return bake_recorded_light(scene, frames.training_cameras, exposure=exposure, masks=frames.training_masks)


def _gaussians(given: argparse.Namespace, target: Path) -> str:
    from extrags.scene import Scene
    from extrags.splat_files import write_compressed_ply, write_ply_scene, write_sog, write_spz

    finished, scene = _chosen(given)
    if given.light == "kept":
        write_ply_scene(scene, target)
        light = "without light" if scene.light is None else "albedo, the light is in the header"
    else:
        gaussians = _baked(given, finished, scene)
        if given.to == "ply":
            write_ply_scene(Scene(gaussians), target)
        else:
            write = {"compressed-ply": write_compressed_ply, "spz": write_spz, "sog": write_sog}
            write[given.to](gaussians, target)
        light = "without light" if scene.light is None else f"light baked, {given.light or 'recorded'}"
    return f"{len(scene.gaussians)} Gaussians, {light}, {_megabytes(target)}"


def _mesh(given: argparse.Namespace, target: Path) -> str:
    import numpy as np

    from extrags.cameras import Cameras
    from extrags.export import colored_mesh, write_mesh
    from extrags.radial_lens import WIDE_FIELD_DEG
    from extrags.scene import Scene
    from extrags.shown_pixels import shown_pixels
    from extrags.surface import fuse_surface

    finished, scene = _chosen(given)
    frames = finished.frames()
    train = frames.training_cameras
    # Virtual views show what they have added to the final scene; there is nothing of it in the coarse one.
    flights = finished.virtual() if (given.scene or "final") == "final" and finished.fine_tuned else []
    virtual = Cameras.concatenated(flights) if flights else None
    # Virtual views are pinholes, frames may have a lens; the surface is fused from pinholes.
    pinholes = train.as_pinholes(WIDE_FIELD_DEG)
    views = Cameras.concatenated([pinholes, *flights])
    # Virtual views fill their images.
    masks = [*shown_pixels(frames.training_masks, train, pinholes)]
    masks += [np.ones((views.height, views.width), dtype=bool)] * (len(views) - len(masks))
    mesh = fuse_surface(scene, views, finished.config.surface, masks=masks)
    baked = Scene(_baked(given, finished, scene))
    # PLY has no texture that viewers agree on.
    texture = given.texture is not False and target.suffix.lower() != ".ply"
    colored = colored_mesh(mesh, baked, train, virtual, masks=frames.training_masks, texture=texture)
    written = write_mesh(colored, target, metric=frames.metric)
    beside = f", beside it {' and '.join(file.name for file in written[1:])}" if written[1:] else ""
    return (
        f"{len(mesh.vertices)} vertices, {len(mesh.triangles)} triangles, "
        f"{100 * float((colored.invented > 0).mean()):.1f} % of the vertices invented, "
        f"{_megabytes(*written)}{beside}"
    )


def _points(given: argparse.Namespace, target: Path) -> str:
    from extrags.export import write_points

    finished, scene = _chosen(given)
    opacity = 0.5 if given.min_opacity is None else given.min_opacity
    count = write_points(_baked(given, finished, scene), target, min_opacity=opacity)
    return f"{count} of {len(scene.gaussians)} Gaussians as points, {_megabytes(target)}"


def _camera_path(given: argparse.Namespace, target: Path) -> str:
    from extrags.export import write_camera_path

    path = _flight(given)
    write_camera_path(path, target)
    return f"{len(path.cameras)} cameras, {len(path.cameras) / path.fps:.1f} s"


def _video(given: argparse.Namespace, target: Path) -> str:
    from extrags.export import fly_through, write_video

    finished = _finished(given, _shown_until(given), "--panels coarse")
    path = _flight(given)
    if given.panels is None:
        panels = ["coarse", "final", "uncertainty"] if finished.fine_tuned else ["final", "uncertainty"]
    else:
        panels = given.panels.split(",")
    shown = [which for which in panels if which != "uncertainty"]
    # What is not known is that of the last scene shown, of the final one where none is.
    scenes = [finished.scene(which) for which in shown or ["final"]]
    frames = finished.frames() if "uncertainty" in panels else None
    train, masks = (None, None) if frames is None else (frames.training_cameras, frames.training_masks)
    exposure = 1.0 if given.exposure is None else given.exposure
    pictures = fly_through(
        scenes, path.cameras, exposure=exposure, train=train, masks=masks, colors=bool(shown)
    )
    count = write_video(pictures, target, fps=path.fps)
    names = [*shown, *(["uncertainty"] if train is not None else [])]
    return f"{count} frames of {', '.join(names)}, {count / path.fps:.1f} s, {_megabytes(target)}"


def _shown_until(given: argparse.Namespace) -> StageName:
    """The stage that makes the last scene of a video; `uncertainty` alone is that of the final scene."""
    panels = [] if given.panels is None else given.panels.split(",")
    return "coarse" if "coarse" in panels and "final" not in panels else "finetune"


def _flight(given: argparse.Namespace) -> CameraPath:
    """The cameras of `--along`, with the steps in between, at the size asked for."""
    from extrags.export import CameraPath, read_camera_path

    along, steps = given.along or "training", given.between or 1
    if along in ALONG:
        path = CameraPath(_cameras(given, along, steps), given.fps or 24.0)
    else:
        if given.between is not None:
            raise ConfigError("--between adds nothing to a camera path from a file: it is taken as it is")
        read = read_camera_path(expanded(along))
        path = CameraPath(read.cameras, given.fps or read.fps)
    if given.width is None:
        return path
    height = max(1, round(path.cameras.height * given.width / path.cameras.width))
    return CameraPath(path.cameras.resized(given.width, height), path.fps)


def _cameras(given: argparse.Namespace, along: str, steps: int) -> Cameras:
    import numpy as np

    from extrags.export import flight_through

    if along == "virtual":
        flights = _finished(given, "explore").virtual()
        if not flights:
            raise ConfigError(f"--along virtual: the run of {given.sequence} has no virtual trajectories")
        return flight_through(flights, steps)
    frames = posed_sequence(given)
    chosen = np.sort(frames.train if along == "training" else frames.test)
    if not len(chosen):
        raise ConfigError(f"--along {along}: {given.sequence} has no such frames")
    # Between recordings of one scene there is no way.
    recording = np.zeros(len(chosen)) if frames.recording is None else frames.recording[chosen]
    return flight_through(
        [frames.cameras.as_pinholes()[chosen[recording == index]] for index in np.unique(recording)], steps
    )


def _megabytes(*files: Path) -> str:
    return f"{sum(file.stat().st_size for file in files) / 1e6:.2f} MB"


def posed_sequence(given: argparse.Namespace) -> EndoscopicSequence:
    """The frames with the poses and intrinsics that the scene of a run with these settings is made with.

    Where no stage changes those of the source, no run is needed. Nor is it where the coarse stage only tries
    to correct them (`coarse.refine_poses=auto`): without a run they are those of the source.

    Raises:
        StoreError: when a stage changes them and has not run.
    """
    from data_catalog.catalog import read
    from extrags.sequence import EndoscopicSequence
    from extrags.training.reconstruction import refines_poses

    config = run_config(given)
    source = read(given.sequence, config.ingest)
    estimated = source.world_from_camera is None or config.poses.replace_given
    made_elsewhere = config.imported.scene is not None or config.uc_nerf.enabled
    refined = not made_elsewhere and refines_poses(source, config.coarse)
    if not estimated and not refined:
        return source
    try:
        run = finished_run(given, "coarse" if refined else "poses")
    except StoreError as error:
        if not refined or config.coarse.refine_poses != "auto":
            raise
        if estimated:
            run = finished_run(given, "poses")
        else:
            logger.warning("%s; poses are those of the source, which a run might correct", error)
            return source
    return run.store.load(EndoscopicSequence, run.refs["sequence"])
