"""What the light model is worth: `python tests/benchmarks/bench_light.py ablation|distance|uniform|cost`.

* `ablation`: the coarse model with one part left out at a time, on held-out views of another recording.
* `distance`: brightness of the same surface from half and from double the distance it was trained at, and the
  recovered light beside the true one. Needs the phantom, whose generator photographs any pose.
* `uniform`: matt objects under uniform light, seen from outside; what the model costs where there is no such
  light.
* `cost`: a training iteration with and without the light, in turns in one process, processor time of one
  thread.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from data_catalog.catalog import read, resolve
from data_catalog.phantom.config import PhantomConfig
from data_catalog.phantom.imaging import recording_sensor
from data_catalog.phantom.recording import Phantom
from extrags.cameras import Cameras, look_at, pixel_rays
from extrags.config import CoarseConfig, IngestConfig, profile_config
from extrags.illumination import NearFieldLight
from extrags.metrics.exposure import align_exposure
from extrags.metrics.image import mean_of_known, psnr, ssim
from extrags.raster import SelectiveAdam, l1_ssim_loss, rasterize, set_num_threads
from extrags.raster.bench import STANDARD_SIZES, bench_scene, machine
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, Split
from extrags.training import reconstruct

VARIANTS: dict[str, dict[str, Any]] = {
    "full": {},
    "no exposure": {"light": {"exposure": False}},
    "no fall-off": {"light": {"falloff": False}},
    "no spread": {"light": {"spread": False}},
    "no cosine": {"light": {"cosine": False}},
    "no response": {"light": {"response": False}},
    "no highlights": {"light": {"specular": False}},
    "no glare": {"light": {"glare": False}},
    "lamp in the lens": {"light": {"offset": False}},
    "fall-off only": {
        "light": {"spread": False, "cosine": False, "response": False, "specular": False, "glare": False}
    },
    "no light": {"light": {"enabled": False}},
    "round start": {"thickness": 1.0},
    "no depth": {"depth_weight": 0.0},
    "mcmc": {"densify": {"strategy": "mcmc"}},
    "degree 0": {"sh_degree": 0},
    "degree 3": {"sh_degree": 3},
    "plain 3dgs": {"light": {"enabled": False}, "thickness": 1.0, "depth_weight": 0.0, "sh_degree": 3},
}


def settings(profile: str, changes: dict[str, Any], seed: int) -> CoarseConfig:
    tree = profile_config(profile).coarse.model_dump()
    for name, value in changes.items():
        tree[name] = {**tree[name], **value} if isinstance(value, dict) else value
    return CoarseConfig.model_validate({**tree, "seed": seed})


def rendered(
    scene: Scene, sequence: EndoscopicSequence, frames: np.ndarray
) -> tuple[torch.Tensor, torch.Tensor]:
    exposure = None
    if scene.light is not None:
        exposure = scene.light.interpolated_exposures(frames, sequence.train, sequence.recording)
    with torch.no_grad():
        shown = scene.render(sequence.cameras[frames], exposure=exposure)
    return shown.rgb.clamp(0, 1).double(), shown.depth


def figures(scene: Scene, sequence: EndoscopicSequence) -> dict[str, float]:
    """Of held-out views, observed pixels: PSNR plain and aligned, SSIM, AbsRel; PSNR of training views."""
    result: dict[str, list[float | None]] = {}

    def note(name: str, value: float | None) -> None:
        result.setdefault(name, []).append(value)

    images, depths = rendered(scene, sequence, sequence.test)
    for index, frame in enumerate(sequence.test):
        target = torch.from_numpy(sequence.rgb[frame] / 255.0)
        mask = torch.from_numpy(sequence.mask[frame])
        seen = mask if sequence.observed is None else mask & torch.from_numpy(sequence.observed[frame])
        aligned = align_exposure(images[index], target, seen)
        note("observed", psnr(images[index], target, seen))
        note("aligned", psnr(aligned, target, seen))
        note("ssim", ssim(images[index], target, seen))
        if sequence.depth_mm is not None:
            true = torch.from_numpy(sequence.depth_mm[frame])
            valid = seen & (true > 0)
            note(
                "absrel", float(((depths[index] - true).abs() / true)[valid].mean()) if valid.any() else None
            )
    images, _ = rendered(scene, sequence, sequence.train)
    for index, frame in enumerate(sequence.train):
        target = torch.from_numpy(sequence.rgb[frame] / 255.0)
        note("train", psnr(images[index], target, torch.from_numpy(sequence.mask[frame])))
    means = {name: mean_of_known(values) for name, values in result.items()}
    return {name: value for name, value in means.items() if value is not None}


def recovered(scene: Scene) -> dict[str, float]:
    if scene.light is None:
        return {}
    light = scene.light
    return {
        "softening": float(light.log_softening.exp()),
        "exponent": float(light.log_exponent.exp()),
        "spread": float(light.spread),
        "cosine": float(light.cosine),
        "shoulder": float(light.log_shoulder.exp()),
        "specular": float(light.log_specular.exp()),
        "roughness": float(light.log_roughness.exp()),
    }


def ablation(names: list[str], variants: list[str], profile: str, seeds: list[int]) -> list[dict[str, Any]]:
    cases = []
    loaded = {name: read(resolve(name), IngestConfig()) for name in names}
    for seed in seeds:
        for variant in variants:
            trained: dict[str, Scene] = {}
            for name, sequence in loaded.items():
                # Two settings of a scene train on the same frames.
                key = name.split("@")[0] if name.startswith("phantom/") else name
                started = time.process_time()
                if key not in trained:
                    trained[key] = reconstruct(sequence, settings(profile, VARIANTS[variant], seed)).scene
                case = {"variant": variant, "sequence": name, "seed": seed, "profile": profile}
                case |= figures(trained[key], sequence) | {"light": recovered(trained[key])}
                cases.append({**case, "cpu_seconds": time.process_time() - started})
                sys.stderr.write(json.dumps(cases[-1]) + "\n")
    return cases


def photographed(phantom: Phantom, camera: Cameras, config: PhantomConfig) -> np.ndarray:
    """A photograph by the training recording's sensor, without noise and drift of exposure."""
    sensor = recording_sensor(config, 1, phantom.scene_gain())
    images = [phantom.photograph(camera, sensor, 1, 10_000 + k)[0] for k in range(3)]
    return np.asarray(np.mean(images, axis=0) / 255.0)


def distance(names: list[str], profile: str, seeds: list[int]) -> list[dict[str, Any]]:
    cases = []
    for name in names:
        sequence = read(resolve(name), IngestConfig())
        depths = sequence.depth_mm
        if depths is None:
            raise SystemExit(f"{name} has no depth")
        config = PhantomConfig.model_validate(sequence.truth["phantom"])
        phantom = Phantom(config)
        path = phantom.cameras("b", np.linspace(0, 1, 120))
        for seed in seeds:
            for variant in ("plain 3dgs", "full"):
                scene = reconstruct(sequence, settings(profile, VARIANTS[variant], seed)).scene
                errors: dict[str, list[float]] = {"half": [], "same": [], "double": []}
                for frame in sequence.train:
                    camera = sequence.cameras[int(frame)]
                    depth = float(depths[frame][sequence.height // 2, sequence.width // 2])
                    if depth <= 0:
                        continue
                    ray = pixel_rays(camera)[0][sequence.height // 2, sequence.width // 2]
                    point = camera.centers[0] + depth * ray
                    far = np.linalg.norm(point - camera.centers[0])
                    away = np.linalg.norm(path.centers - point, axis=1)
                    behind = int(np.argmin(np.abs(away - 2 * far)))
                    places = {"half": (camera.centers[0] + point) / 2, "same": camera.centers[0]}
                    if abs(away[behind] / far - 2) < 0.1:
                        places["double"] = path.centers[behind]
                    for label, center in places.items():
                        error = brightness_error(phantom, config, scene, camera, center, point)
                        if error is not None:
                            errors[label].append(error)
                cases.append(
                    {
                        "variant": variant,
                        "sequence": name,
                        "seed": seed,
                        "brightness_error_percent": {k: float(np.median(v)) for k, v in errors.items() if v},
                        "places": {k: len(v) for k, v in errors.items()},
                        "light": recovered(scene),
                        "true_light": sequence.truth["light"],
                    }
                )
                sys.stderr.write(json.dumps(cases[-1]) + "\n")
    return cases


def brightness_error(
    phantom: Phantom,
    config: PhantomConfig,
    scene: Scene,
    camera: Cameras,
    center: np.ndarray,
    point: np.ndarray,
) -> float | None:
    """Percent by which the rendered patch round a wall point is brighter or darker; None if it is hidden."""
    pose = look_at(center, point, -camera.world_from_camera[0, :3, 1])
    view = Cameras(camera.K, pose[None], camera.width, camera.height)
    seen = phantom.z_depth(view)[camera.height // 2, camera.width // 2]
    if not abs(seen - np.linalg.norm(point - center)) < 0.5:
        return None
    middle = np.s_[
        camera.height // 2 - 8 : camera.height // 2 + 8, camera.width // 2 - 8 : camera.width // 2 + 8
    ]
    with torch.no_grad():
        image = scene.render(view).rgb[0].clamp(0, 1).numpy()[middle].mean()
    truth = photographed(phantom, view, config)[middle].mean()
    return float(100 * abs(image / truth - 1))


def uniform(profile: str, seeds: list[int]) -> list[dict[str, Any]]:
    sequence = block_world()
    cases = []
    for seed in seeds:
        for variant in ("no light", "full"):
            scene = reconstruct(sequence, settings(profile, VARIANTS[variant], seed)).scene
            cases.append(
                {"variant": variant, "seed": seed, **figures(scene, sequence), "light": recovered(scene)}
            )
            sys.stderr.write(json.dumps(cases[-1]) + "\n")
    return cases


def cost(rounds: int = 40) -> list[dict[str, Any]]:
    cases = []
    for size in STANDARD_SIZES:
        scene = bench_scene(size)
        target = scene.pop("target")
        leaves = {k: v.requires_grad_() for k, v in scene.items() if k not in ("viewmats", "Ks")}
        adam = SelectiveAdam(leaves, dict.fromkeys(leaves, 1e-9))
        light = NearFieldLight.initial(1, 2.0)
        spent: dict[str, list[float]] = {"with": [], "without": []}
        for _ in range(rounds):
            for label, times in spent.items():
                carried = None
                started = time.process_time()
                if label == "with":
                    learned = {k: v.requires_grad_() for k, v in light.detached().parameters().items()}
                    carried = NearFieldLight(**learned, reference_distance=2.0).camera_light(torch.ones(1))
                shown = rasterize(
                    leaves["means"],
                    leaves["quats"],
                    leaves["scales"],
                    leaves["opacities"],
                    leaves["sh"],
                    scene["viewmats"],
                    scene["Ks"],
                    size.width,
                    size.height,
                    light=carried,
                )
                l1_ssim_loss(shown.rgb, target).backward()
                adam.step(visible=shown.visible[0])
                adam.zero_grad()
                times.append(1e3 * (time.process_time() - started))
        medians = {label: float(np.median(times[3:])) for label, times in spent.items()}
        cases.append(
            {
                "width": size.width,
                "height": size.height,
                "n_gaussians": size.n_gaussians,
                "cpu_ms": medians,
                "share": medians["with"] / medians["without"] - 1,
            }
        )
    return cases


def block_world(*, width: int = 160, height: int = 128, views: int = 48) -> EndoscopicSequence:
    """Painted blocks on a plate under uniform light, photographed from a dome; every 8th view is held out."""
    import open3d as o3d

    generator = np.random.default_rng(5)
    scene = o3d.t.geometry.RaycastingScene()
    boxes = [((-40.0, -40.0, -3.0), (40.0, 40.0, 0.0))]
    for _ in range(24):
        size = generator.uniform(6, 16, 3)
        corner = np.append(generator.uniform(-34, 22, 2), 0.0)
        boxes.append((tuple(corner), tuple(corner + size)))
    paint = generator.uniform(0.15, 0.95, (len(boxes), 2, 3))
    for low, high in boxes:
        extent = np.subtract(high, low)
        box = o3d.t.geometry.TriangleMesh.create_box(*extent)
        scene.add_triangles(box.translate(o3d.core.Tensor.from_numpy(np.array(low, np.float32))))
    angle, lift = 2.4 * np.arange(views), np.linspace(0.35, 1.2, views)
    centers = 95 * np.stack([np.cos(angle) * np.cos(lift), np.sin(angle) * np.cos(lift), np.sin(lift)], 1)
    centers *= np.linspace(0.8, 1.2, views)[generator.permutation(views), None]
    poses = np.stack([look_at(c, np.array([0.0, 0.0, 5.0]), np.array([0.0, 0.0, 1.0])) for c in centers])
    K = np.array([[1.1 * width, 0, width / 2], [0, 1.1 * width, height / 2], [0, 0, 1]])
    cameras = Cameras(np.repeat(K[None], views, 0), poses, width, height)
    fine = cameras.resized(2 * width, 2 * height)
    rgb: list[np.ndarray] = []
    depth: list[np.ndarray] = []
    for k in range(views):
        for camera, wanted in ((fine[k], rgb), (cameras[k], depth)):
            rays = pixel_rays(camera)[0].astype(np.float32)
            origin = np.broadcast_to(camera.centers[0].astype(np.float32), rays.shape)
            hits = scene.cast_rays(o3d.core.Tensor.from_numpy(np.concatenate([origin, rays], -1)))
            z = hits["t_hit"].numpy()
            if wanted is depth:
                depth.append(np.where(np.isfinite(z), z, 0))
                continue
            points = origin + np.where(np.isfinite(z), z, 0)[..., None] * rays
            owner = np.where(np.isfinite(z), hits["geometry_ids"].numpy(), 0).astype(int) % len(boxes)
            checks = np.floor(points / 4 + 1e-3).astype(int).sum(-1) % 2
            image = np.where(np.isfinite(z)[..., None], paint[owner, checks], 0.0)
            rgb.append(image.reshape(height, 2, width, 2, 3).mean((1, 3)))
    held = np.arange(views) % 8 == 4
    return EndoscopicSequence(
        name="blocks",
        rgb=(np.stack(rgb) * 255).round().astype(np.uint8),
        K=cameras.K,
        mask=np.ones((views, height, width), bool),
        split=Split("every8", np.flatnonzero(~held), np.flatnonzero(held)),
        world_from_camera=poses,
        depth_mm=np.stack(depth).astype(np.float32),
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("what", choices=("ablation", "distance", "uniform", "cost"))
    parser.add_argument("--sequences", nargs="+", default=[f"phantom/{k}@sparse" for k in range(5)])
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--profile", default="quick")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--json", default="-")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    set_num_threads(1)
    if chosen.what == "ablation":
        cases = ablation(chosen.sequences, chosen.variants, chosen.profile, chosen.seeds)
    elif chosen.what == "distance":
        cases = distance(chosen.sequences, chosen.profile, chosen.seeds)
    elif chosen.what == "uniform":
        cases = uniform(chosen.profile, chosen.seeds)
    else:
        cases = cost()
    text = json.dumps({"machine": machine(), "cases": cases}, indent=1)
    if chosen.json == "-":
        sys.stdout.write(text + "\n")
    else:
        Path(chosen.json).write_text(text + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
