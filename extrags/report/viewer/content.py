"""What the viewer of a page gets: scenes, cameras, paths, surface, its shaders and its program."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
from jaxtyping import Float, Int8
from markupsafe import Markup
from torch import Tensor

from extrags.config import ReportConfig
from extrags.facing import BEHIND_COSINE
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.raster.rendering import ALPHA_MIN, DILATION_PX2
from extrags.report.inputs import MeshLike, ReportInputs
from extrags.report.space import HELD_OUT_COLOR, clustered, trajectory_colors
from extrags.report.viewer.encoding import BLOCK, EncodedScene, Quantity, encoded_scene, faint_gaussians
from extrags.report.viewer.free_space import encoded_free_space
from extrags.report.viewer.quantities import scene_quantities
from extrags.report.wording import count as in_words
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence

__all__ = ["ViewerContent", "encoded_within", "script_text", "viewer_content", "viewer_section"]

SCRIPTS = (
    "camera.js", "decode.js", "renderer.js", "free_space.js", "viewer.js", "controls.js", "compare.js",
    "start.js",
)  # fmt: skip
SHADERS = ("splat.vert", "splat.frag", "screen.vert", "screen.frag", "shape.vert", "shape.frag", "slice.frag")
SORTER = "sort.worker.js"
TRAIN_COLOR = "#e9eef2"
BASE64_SHARE = 4 / 3


@dataclass(frozen=True)
class ViewerContent:
    """The viewer's part of a page; texts are safe inside `<script>`.

    Args:
        data: header of the scenes, cameras, paths and surface, JSON.
        shaders: GLSL by file name, JSON.
        sorter: the program of the worker.
        bodies: encoded scenes by element, base64.
        scenes: `{name, title, count, said}` of each, for the words round the canvas.
        left_out: how many Gaussians are left out for showing in no picture, in words; empty for none.
        has_mesh: whether a surface is among the overlays.
        has_virtual: whether there are virtual trajectories.
        has_free_space: whether the free space of the run is among the overlays.
        has_light: whether a scene has a light.
        has_sides: whether a scene knows from which side its Gaussians were seen.
        unit: of lengths.
        width: of the run's images in pixels.
        height: the same for the height.
    """

    data: Markup
    shaders: Markup
    sorter: Markup
    bodies: Mapping[str, Markup]
    scenes: Sequence[Mapping[str, Any]]
    left_out: str
    has_mesh: bool
    has_virtual: bool
    has_free_space: bool
    has_light: bool
    has_sides: bool
    unit: str
    width: int
    height: int


def script_text(*names: str) -> Markup:
    """Files of the viewer one after the other, as the content of a `<script>`."""
    folder = files("extrags.report.viewer") / "static"
    return Markup("\n".join((folder / name).read_text(encoding="utf-8") for name in names))


def viewer_content(inputs: ReportInputs, largest_bytes: int) -> ViewerContent | None:
    """The viewer of a run; None when it has no scene or no cameras, or nothing may be spent on it.

    Args:
        inputs: what the stages made.
        largest_bytes: bound on the encoded scenes together, as they stand in the page.
    """
    pairs = (("coarse", inputs.coarse_scene), ("final", inputs.final_scene))
    scenes = {name: scene for name, scene in pairs if scene is not None}
    sequence = inputs.sequence
    if largest_bytes <= 0 or sequence.world_from_camera is None or not len(sequence.train):
        return None
    if not any(len(scene.gaussians) for scene in scenes.values()):
        return None
    total = sum(len(scene.gaussians) for scene in scenes.values())
    headers, bodies, words = [], {}, []
    for name, scene in scenes.items():
        share = int(largest_bytes / BASE64_SHARE * len(scene.gaussians) / total)
        quantities = scene_quantities(
            scene,
            sequence.training_cameras,
            inputs.virtual_cameras,
            None if inputs.pseudo is None else inputs.pseudo.uncertainty,
            None if inputs.pseudo is None else inputs.pseudo.expected_error,
            masks=sequence.training_masks,
        )
        encoded, said = encoded_within(scene.gaussians, quantities, share, facing=scene.facing)
        element = f"viewer-{name}"
        bodies[element] = Markup(base64.b64encode(encoded.body).decode("ascii"))
        headers.append(_header(name, element, scene, encoded, quantities))
        words.append({"name": name, "title": name.capitalize(), "count": encoded.count, "said": said})
    groups, paths = _cameras(inputs, scenes)
    distance = next(
        (scene.light.reference_distance for scene in scenes.values() if scene.light is not None),
        _typical_distance(inputs, scenes),
    )
    unit = "mm" if sequence.metric else "units"
    data = {
        "scenes": headers,
        "groups": groups,
        "paths": paths,
        "mesh": None if inputs.mesh is None else _surface(inputs.mesh),
        "free": None if inputs.grid is None else encoded_free_space(inputs.grid, unit),
        "width": sequence.width,
        "height": sequence.height,
        "near": min(scene.near for scene in scenes.values()),
        "dilation": DILATION_PX2,
        "behind": BEHIND_COSINE,
        "distance": float(distance),
    }
    shaders = {name: str(script_text(name)) for name in SHADERS}
    return ViewerContent(
        data=_json(data),
        shaders=_json(shaders),
        sorter=script_text(SORTER),
        bodies=bodies,
        scenes=words,
        left_out=_left_out(scenes),
        has_mesh=data["mesh"] is not None,
        has_virtual=bool(inputs.trajectories),
        has_free_space=data["free"] is not None,
        has_light=any(scene.light is not None for scene in scenes.values()),
        has_sides=any(scene.facing is not None for scene in scenes.values()),
        unit=unit,
        width=sequence.width,
        height=sequence.height,
    )


def viewer_section(inputs: ReportInputs, config: ReportConfig) -> dict[str, Any]:
    """What the template needs: the viewer, or the reason why there is none, and the scripts of the page."""
    content = viewer_content(inputs, round(config.viewer_mb * 1e6))
    if config.viewer_mb == 0:
        absent = "The settings leave the viewer out (report.viewer_mb is 0)."
    elif inputs.sequence.world_from_camera is None:
        absent = inputs.why_absent("poses", "poses")
    elif inputs.config is not None and inputs.config.uc_nerf.enabled:
        absent = "The scene is a radiance field, and the viewer draws Gaussians."
    else:
        absent = inputs.why_absent("coarse_scene", "coarse")
    return {"viewer": content, "viewer_absent": absent, "viewer_script": script_text(*SCRIPTS)}


def _left_out(scenes: Mapping[str, Scene]) -> str:
    """How many Gaussians of each scene show in no picture."""
    found = [
        f"{in_words(faint)} of {in_words(len(scene.gaussians))} in the {name} scene"
        for name, scene in scenes.items()
        if (faint := faint_gaussians(scene.gaussians))
    ]
    if not found:
        return ""
    return f"Gaussians too transparent to show in any picture (below 1/255) are left out: {', '.join(found)}."


def encoded_within(
    gaussians: Gaussians,
    quantities: Mapping[str, Quantity],
    largest_bytes: int,
    *,
    facing: Int8[Tensor, "n"] | None = None,
) -> tuple[EncodedScene, str]:
    """A scene in at most so many bytes, and in words what was left out for it.

    First the harmonics are cut, degree by degree, then the Gaussians that show least: by opacity times the
    area of their two longer axes.
    """
    for degree in range(gaussians.sh_degree, -1, -1):
        encoded = encoded_scene(gaussians, quantities, facing=facing, degree=degree)
        if len(encoded.body) <= largest_bytes:
            cut = degree < gaussians.sh_degree
            return encoded, f"harmonics up to degree {degree} of {gaussians.sh_degree}" if cut else ""
    longer = np.sort(gaussians.scales.detach().numpy(), axis=1)[:, 1:].sum(1)
    shows = np.log(np.maximum(gaussians.opacities.detach().sigmoid().numpy(), ALPHA_MIN)) + longer
    order = np.argsort(-shows, kind="stable")
    count = len(gaussians)
    while len(encoded.body) > largest_bytes and count > 1:
        count = max(1, min(count - 1, int(0.97 * count * largest_bytes / len(encoded.body))))
        kept = np.sort(order[:count])
        picked = {
            name: Quantity(item.values[kept], item.low, item.high, item.title, item.ends)
            for name, item in quantities.items()
        }
        index = _index(kept)
        sides = None if facing is None else facing[index]
        encoded = encoded_scene(gaussians.detached().subset(index), picked, facing=sides, degree=0)
    return encoded, f"{count} of {len(gaussians)} Gaussians, without harmonics"


def _index(kept: np.ndarray) -> Any:
    import torch

    return torch.from_numpy(kept)


def _header(
    name: str, element: str, scene: Scene, encoded: EncodedScene, quantities: Mapping[str, Quantity]
) -> dict[str, Any]:
    light = None
    if scene.light is not None:
        row = scene.light.detached().camera_light(scene.light.exposure(None)[None]).packed()[0].tolist()
        names = ("softening", "exponent", "spread", "cosine")
        light = dict(zip(names, row[3:7], strict=True))
        light |= dict(zip(("shoulder", "specular", "roughness"), row[10:13], strict=True))
        light |= {"offset": row[7:10], "glare": row[13:16], "reference": row[16]}
    return {
        "name": name,
        "element": element,
        "count": encoded.count,
        "degree": encoded.degree,
        "sided": encoded.sided,
        "block": BLOCK,
        "quantities": list(encoded.quantities),
        "quantities_shown": [
            {"name": key, "title": item.title, "ends": item.ends} for key, item in quantities.items()
        ],
        "light": light,
    }


def _cameras(inputs: ReportInputs, scenes: Mapping[str, Scene]) -> tuple[list[Any], list[Any]]:
    """Cameras by group, with the exposures each scene is drawn at, and the paths one can fly along."""
    sequence = inputs.sequence
    # The page draws pinholes.
    cameras = sequence.cameras.as_pinholes()
    groups = []
    named = (
        ("train", "Training", TRAIN_COLOR, np.sort(sequence.train)),
        ("held_out", "Held out", HELD_OUT_COLOR, inputs.frames),
    )
    for kind, title, color, frames in named:
        if not len(frames):
            continue
        gains = {
            name: _exposures(scene.light, frames, sequence)
            for name, scene in scenes.items()
            if scene.light is not None
        }
        shown = [
            {
                "name": sequence.frame_name(int(frame)),
                "pose": _pose(cameras.world_from_camera[frame]),
                "K": _intrinsics(cameras.K[frame]),
                "exposure": {name: round(values[place], 6) for name, values in gains.items()},
            }
            for place, frame in enumerate(frames)
        ]
        groups.append({"name": kind, "kind": kind, "title": title, "color": _rgb(color), "cameras": shown})
    paths = [
        {"title": title, "poses": [_pose(cameras.world_from_camera[frame]) for frame in frames]}
        for title, frames in _recordings(inputs)
    ]
    colors = trajectory_colors(len(inputs.trajectories))
    K = _intrinsics(cameras.K[sequence.train[0]])
    for index, (poses, color) in enumerate(zip(inputs.trajectories, colors, strict=True), start=1):
        title = f"Virtual trajectory {index}"
        shown = [
            {"name": f"view {place}", "pose": _pose(pose), "K": K, "exposure": {}}
            for place, pose in enumerate(poses, start=1)
        ]
        group = {"name": f"virtual-{index}", "kind": "virtual", "title": title}
        groups.append({**group, "color": _rgb(color), "cameras": shown})
        paths.append({"title": title, "poses": [_pose(pose) for pose in poses]})
    return groups, paths


def _exposures(light: NearFieldLight, frames: np.ndarray, sequence: EndoscopicSequence) -> list[float]:
    """As `extrags.evaluation` has them; the oracle has learned those of all frames."""
    count = len(light.log_exposure)
    trained = sequence.train if count == len(sequence.train) else np.arange(count)
    return [float(gain) for gain in light.interpolated_exposures(frames, trained, sequence.recording)]


def _recordings(inputs: ReportInputs) -> list[tuple[str, np.ndarray]]:
    """Training frames in order, those of each recording apart."""
    train, recording = np.sort(inputs.sequence.train), inputs.sequence.recording
    if recording is None or len(np.unique(recording[train])) == 1:
        return [("Training trajectory", train)]
    return [
        (f"Training trajectory, recording {number}", train[recording[train] == which])
        for number, which in enumerate(np.unique(recording[train]), start=1)
    ]


def _typical_distance(inputs: ReportInputs, scenes: Mapping[str, Scene]) -> float:
    """Median distance of the first scene's Gaussians from the middle training camera."""
    centers = inputs.sequence.cameras[inputs.sequence.train].centers
    scene = next(iter(scenes.values()))
    means = scene.gaussians.means.detach().numpy()
    return float(np.median(np.linalg.norm(means - centers[len(centers) // 2], axis=1)))


def _surface(mesh: MeshLike) -> dict[str, Any] | None:
    """Triangle corners in 16 bits each over the extent of the surface."""
    if not len(mesh.triangles):
        return None
    corners = clustered(mesh.vertices.astype(np.float64), mesh.triangles).reshape(-1, 3)
    low, high = corners.min(0), corners.max(0)
    step = np.maximum(high - low, 1e-12) / 65535
    levels = np.rint((corners - low) / step).astype("<u2")
    return {
        "low": low.tolist(),
        "step": step.tolist(),
        "corners": base64.b64encode(levels.tobytes()).decode("ascii"),
    }


def _pose(pose: Float[np.ndarray, "4 4"]) -> list[float]:
    return [float(f"{value:.8g}") for value in pose[:3].reshape(-1)]


def _intrinsics(K: Float[np.ndarray, "3 3"]) -> list[float]:
    return [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]


def _rgb(color: str) -> list[float]:
    return [round(int(color[at : at + 2], 16) / 255, 4) for at in (1, 3, 5)]


def _json(value: Any) -> Markup:
    """JSON that no name in it can end the script element of."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))
