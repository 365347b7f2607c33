"""COLMAP's part of pose estimation; runs as a process of its own: `python -m extrags.poses.colmap FOLDER`.

A process of its own, because pycolmap and Pillow link two zlibs that clash when pycolmap comes first,
because COLMAP aborts the process on some inputs, and because workers of task runners may not fork.
Progress goes to stdout, one JSON object a line; COLMAP's own log goes to stderr.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from extrags.lens import Lens
from extrags.poses.job import PoseJob, PoseJobResult
from extrags.poses.pairs import Pair, registration_pairs, training_pairs
from extrags.poses.self_calibration import largest_model, map_with_unknown_lens, model_sizes

__all__ = ["run_colmap"]

MASK_EROSION_SHARE = 0.01
"""Features this near (in image widths) to masked-out pixels belong to the edge, which moves along."""
MIN_POSE_INLIERS = 12
POSE_INLIER_SHARE = 0.25
POSE_MAX_ERROR_PX = 8.0
_PAIRS_PER_CALL = 100
_IMAGES_PER_CALL = 16


@dataclass
class _Told:
    """Counts steps and reports them to the parent process."""

    total: int
    done: int = 0
    values: dict[str, float] = field(default_factory=dict)

    def step(self, count: int = 1, **values: float) -> None:
        self.reach(self.done + count, **values)

    def reach(self, done: int, **values: float) -> None:
        self.done = min(done, self.total)
        self.values |= values
        sys.stdout.write(json.dumps({"done": self.done, "total": self.total, "values": self.values}) + "\n")
        sys.stdout.flush()


def run_colmap(folder: Path, job: PoseJob) -> PoseJobResult:
    """Features, matches, map and registrations of one job.

    Only training frames are in the database while the map is made; held-out frames are matched against
    it afterwards, one by one, and never move it.

    Args:
        folder: scratch folder.
        job: the frames.

    Returns:
        Poses and points of the largest model; no poses at all when there is none.
    """
    # Pillow first: see the module's comment.
    from PIL import Image  # noqa: F401, I001
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.WARNING)
    seed = int(job.settings["seed"])
    pycolmap.set_random_seed(seed)
    frames = len(job.rgb)
    schedule = {key: job.settings[key] for key in ("exhaustive_below", "sequential_overlap")}
    pairs = training_pairs(job.train, job.recording, **schedule)
    told = _Told(total=frames + len(pairs) + len(job.train) + len(job.test))
    database_path = folder / "database.db"
    images = folder / "images"
    _write_images(folder, job)
    with _opened(pycolmap, database_path):
        pass  # opening creates it, which importing images expects
    report: dict[str, Any] = {"n_train": len(job.train), "n_test": len(job.test), "pairs": len(pairs)}

    _extract(pycolmap, folder, job, job.train, told)
    _match(pycolmap, folder, pairs, seed, told)
    with _opened(pycolmap, database_path) as database:
        report |= _match_report(pycolmap, database, job.train, pairs)

    # The first pair of a model counts once, and further models count images again: told steps are
    # held below what the map is given, and set to it at its end.
    map_made = told.done + len(job.train)

    def mapped() -> None:
        told.reach(min(told.done + 1, map_made))

    def make_map(database: Path, options: Any) -> dict[int, Any]:
        models: dict[int, Any] = pycolmap.incremental_mapping(
            database, images, folder, options=options, next_image_callback=mapped
        )
        return models

    def options() -> Any:
        return _mapping_options(pycolmap, job.settings)

    lens: Lens | None = None
    if job.unknown_lens:
        found = map_with_unknown_lens(
            pycolmap,
            database_path,
            _guessed_lens(job),
            job.settings,
            len(job.train),
            make_map,
            options,
            lambda model: _read_model(model, np.full((frames, 4, 4), np.nan), {}),
        )
        best, lens = found.model, found.calibration.lens
        report["calibration"] = found.calibration.to_json()
        report["model_sizes"] = found.model_sizes
    else:
        models = make_map(database_path, options())
        best = largest_model(models)
        report["model_sizes"] = model_sizes(models)
    told.reach(map_made)
    poses = np.full((frames, 4, 4), np.nan)
    if best is None:
        told.reach(told.total)
        return _nothing(poses, report | {"registrations": {}})
    result = _read_model(best, poses, report)
    _register_held_out(pycolmap, folder, job, best, result, schedule, told, lens)
    told.reach(told.total, registered=float(np.isfinite(poses).all((1, 2)).sum()))
    return result


def _guessed_lens(job: PoseJob) -> Lens:
    """The pinhole that all frames were guessed to have."""
    K = job.K[0]
    focal = float(np.sqrt(K[0, 0] * K[1, 1]))
    height, width = job.rgb.shape[1:3]
    return Lens("SIMPLE_PINHOLE", (focal, float(K[0, 2]), float(K[1, 2])), width, height)


def _write_images(folder: Path, job: PoseJob) -> None:
    from PIL import Image
    from scipy.ndimage import binary_erosion

    radius = max(2, round(MASK_EROSION_SHARE * job.rgb.shape[2]))
    for name in ("images", "masks"):
        (folder / name).mkdir()
    for index, (rgb, mask) in enumerate(zip(job.rgb, job.mask, strict=True)):
        Image.fromarray(rgb).save(folder / "images" / _name(index), compress_level=1)
        # The image's own border is no edge of the mask.
        kept = binary_erosion(mask, iterations=radius, border_value=1)
        Image.fromarray((kept * 255).astype(np.uint8)).save(folder / "masks" / f"{_name(index)}.png")


def _extract(pycolmap: Any, folder: Path, job: PoseJob, frames: np.ndarray, told: _Told) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.sift.max_num_features = job.settings["n_features"]
    options.sift.peak_threshold = job.settings["peak_threshold"]
    options.sift.edge_threshold = job.settings["edge_threshold"]
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    reader.mask_path = folder / "masks"
    intrinsics = job.K[frames][:, [0, 1, 0, 1], [0, 1, 2, 2]]
    distinct, group = np.unique(intrinsics, axis=0, return_inverse=True)
    for number, parameters in enumerate(distinct):
        members = [_name(int(frame)) for frame in frames[group == number]]
        reader.camera_params = ",".join(repr(float(value)) for value in parameters)
        reader.existing_camera_id = -1
        shared = {"camera_mode": pycolmap.CameraMode.SINGLE}
        # Numbered here, in order: extraction would number the images as its threads finish, and the
        # numbers decide ties in the mapping.
        pycolmap.import_images(
            folder / "database.db", folder / "images", image_names=members, options=reader, **shared
        )
        with _opened(pycolmap, folder / "database.db") as database:
            reader.existing_camera_id = database.read_image_with_name(members[0]).camera_id
            if job.unknown_lens:
                # Pairs are then verified by fundamental matrices, which hold for any focal length.
                camera = database.read_camera(reader.existing_camera_id)
                camera.has_prior_focal_length = False
                database.update_camera(camera)
        for start in range(0, len(members), _IMAGES_PER_CALL):
            part = members[start : start + _IMAGES_PER_CALL]
            pycolmap.extract_features(
                folder / "database.db",
                folder / "images",
                image_names=part,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
                **shared,
            )
            told.step(len(part))


def _match(pycolmap: Any, folder: Path, pairs: list[Pair], seed: int, told: _Told | None) -> None:
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pairing = pycolmap.ImportedPairingOptions()
    listed = folder / "pairs.txt"
    for start in range(0, len(pairs), _PAIRS_PER_CALL):
        part = pairs[start : start + _PAIRS_PER_CALL]
        listed.write_text("".join(f"{_name(i)} {_name(j)}\n" for i, j in part))
        pairing.match_list_path = listed
        pycolmap.match_image_pairs(
            folder / "database.db",
            matching_options=matching,
            pairing_options=pairing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
        if told is not None:
            told.step(len(part))


def _match_report(pycolmap: Any, database: Any, frames: np.ndarray, pairs: list[Pair]) -> dict[str, Any]:
    ids = {int(frame): database.read_image_with_name(_name(int(frame))).image_id for frame in frames}
    features = {frame: int(database.num_keypoints_for_image(number)) for frame, number in ids.items()}
    inliers = {
        (i, j): len(database.read_two_view_geometry(ids[i], ids[j]).inlier_matches)
        if database.exists_two_view_geometry(ids[i], ids[j])
        else 0
        for i, j in pairs
    }
    verified = sorted((pair for pair, count in inliers.items() if count > 0), key=lambda p: (-inliers[p], p))
    best, partners = dict.fromkeys(ids, 0), dict.fromkeys(ids, 0)
    for (i, j), count in inliers.items():
        best[i], best[j] = max(best[i], count), max(best[j], count)
        partners[i] += int(count > 0)
        partners[j] += int(count > 0)
    angles, turn_only = _parallax(pycolmap, database, ids, verified[:_PAIRS_PER_CALL])
    return {
        "features_median": float(np.median(list(features.values()))),
        "features_fewest": min(features.values()),
        "pairs_verified": len(verified),
        "inliers_median": float(np.median([inliers[pair] for pair in verified])) if verified else 0.0,
        "pairs_examined": len(angles),
        "pair_angle_deg": float(np.median(angles)) if angles else 0.0,
        "pairs_turn_only": turn_only,
        "frames": {
            str(frame): {
                "features": features[frame],
                "best_pair_inliers": best[frame],
                "verified_pairs": partners[frame],
            }
            for frame in ids
        },
    }


def _parallax(
    pycolmap: Any, database: Any, ids: dict[int, int], pairs: list[Pair]
) -> tuple[list[float], int]:
    """Angle between the rays of the matched points of each pair, and how many pairs only turn."""
    angles, turn_only = [], 0
    kinds = pycolmap.TwoViewGeometryConfiguration
    for pair in pairs:
        images = [database.read_image_with_name(_name(frame)) for frame in pair]
        cameras = [database.read_camera(image.camera_id) for image in images]
        keypoints = [database.read_keypoints(image.image_id)[:, :2].astype(np.float64) for image in images]
        geometry = database.read_two_view_geometry(ids[pair[0]], ids[pair[1]])
        found = pycolmap.estimate_two_view_geometry_pose(
            cameras[0], keypoints[0], cameras[1], keypoints[1], geometry
        )
        turns = geometry.config in (kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC)
        turn_only += int(turns)
        angles.append(float(np.degrees(geometry.tri_angle)) if found and not turns else 0.0)
    return angles, turn_only


def _mapping_options(pycolmap: Any, settings: dict[str, Any]) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    # One thread: sums of residuals in another order would give other bits.
    options.num_threads = options.mapper.num_threads = 1
    for part in (options, options.mapper, options.triangulation):
        part.random_seed = int(settings["seed"])
    options.ba_refine_focal_length = False
    options.ba_refine_principal_point = False
    options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    options.mapper.init_min_tri_angle = settings["min_tri_angle_deg"]
    options.min_model_size = 3
    options.max_num_models = 5
    return options


def _read_model(model: Any, poses: np.ndarray, report: dict[str, Any]) -> PoseJobResult:
    for number in sorted(model.reg_image_ids()):
        image = model.image(number)
        poses[_frame(image.name)] = _world_from_camera(image.cam_from_world())
    point_ids = sorted(model.point3D_ids())
    frames, points, pixels = [], [], []
    for index, point_id in enumerate(point_ids):
        for element in model.point3D(point_id).track.elements:
            image = model.image(element.image_id)
            frames.append(_frame(image.name))
            points.append(index)
            pixels.append(image.point2D(element.point2D_idx).xy)
    report["n_points"] = len(point_ids)
    report["mean_track_length"] = float(model.compute_mean_track_length())
    report["mean_reprojection_px"] = float(model.compute_mean_reprojection_error())
    return PoseJobResult(
        world_from_camera=poses,
        points=np.array([model.point3D(number).xyz for number in point_ids]).reshape(-1, 3),
        points_rgb=np.array([model.point3D(number).color for number in point_ids], dtype=np.uint8).reshape(
            -1, 3
        ),
        observed_frame=np.array(frames, dtype=np.int64),
        observed_point=np.array(points, dtype=np.int64),
        observed_px=np.array(pixels, dtype=np.float64).reshape(-1, 2),
        report=report,
    )


def _register_held_out(
    pycolmap: Any,
    folder: Path,
    job: PoseJob,
    model: Any,
    result: PoseJobResult,
    schedule: dict[str, int],
    told: _Told,
    lens: Lens | None,
) -> None:
    """Pose of each held-out frame from its matches to triangulated points; the map stays as it is.

    `lens` is the one that all frames were found to have; None takes the camera that each frame came with.
    """
    images = {_frame(model.image(number).name): model.image(number) for number in model.reg_image_ids()}
    mapped = np.array(sorted(images), dtype=np.int64)
    registrations: dict[str, dict[str, int]] = {}
    result.report["registrations"] = registrations
    if len(job.test) == 0:
        return
    _extract(pycolmap, folder, job, job.test, told)
    pairs = registration_pairs(job.test, mapped, job.recording, **schedule)
    _match(pycolmap, folder, pairs, int(job.settings["seed"]), None)
    with _opened(pycolmap, folder / "database.db") as database:
        for frame in job.test.tolist():
            own = database.read_image_with_name(_name(frame))
            keypoints = database.read_keypoints(own.image_id)[:, :2]
            found: set[tuple[int, int]] = set()
            for other in (j for i, j in pairs if i == frame):
                image = images[other]
                if not database.exists_two_view_geometry(own.image_id, image.image_id):
                    continue
                for mine, theirs in database.read_two_view_geometry(
                    own.image_id, image.image_id
                ).inlier_matches.tolist():
                    if image.point2D(theirs).has_point3D():
                        found.add((mine, image.point2D(theirs).point3D_id))
            matches = sorted(found)
            pose, inliers = _absolute_pose(
                pycolmap,
                np.array([keypoints[mine] for mine, _ in matches], dtype=np.float64).reshape(-1, 2),
                np.array([model.point3D(point).xyz for _, point in matches]).reshape(-1, 3),
                database.read_camera(own.camera_id) if lens is None else _camera(pycolmap, lens),
                int(job.settings["seed"]),
            )
            registrations[str(frame)] = {"matches": len(matches), "inliers": inliers}
            if pose is not None:
                result.world_from_camera[frame] = pose
            told.step(1)


def _absolute_pose(
    pycolmap: Any, pixels: np.ndarray, points: np.ndarray, camera: Any, seed: int
) -> tuple[np.ndarray | None, int]:
    if len(pixels) < MIN_POSE_INLIERS:
        return None, 0
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = POSE_MAX_ERROR_PX
    options.ransac.random_seed = seed
    answer = pycolmap.estimate_and_refine_absolute_pose(pixels, points, camera, options)
    if answer is None:
        return None, 0
    inliers = int(answer["num_inliers"])
    if inliers < max(MIN_POSE_INLIERS, POSE_INLIER_SHARE * len(pixels)):
        return None, inliers
    return _world_from_camera(answer["cam_from_world"]), inliers


def _camera(pycolmap: Any, lens: Lens) -> Any:
    return pycolmap.Camera(
        model=lens.model, width=lens.width, height=lens.height, params=list(lens.parameters)
    )


def _world_from_camera(cam_from_world: Any) -> np.ndarray:
    pose = np.eye(4)
    pose[:3] = cam_from_world.inverse().matrix()
    return pose


def _nothing(poses: np.ndarray, report: dict[str, Any]) -> PoseJobResult:
    empty = np.zeros(0, dtype=np.int64)
    return PoseJobResult(
        world_from_camera=poses,
        points=np.zeros((0, 3)),
        points_rgb=np.zeros((0, 3), dtype=np.uint8),
        observed_frame=empty,
        observed_point=empty,
        observed_px=np.zeros((0, 2)),
        report=report,
    )


@contextmanager
def _opened(pycolmap: Any, path: Path) -> Iterator[Any]:
    database = pycolmap.Database.open(path)
    try:
        yield database
    finally:
        database.close()


def _name(frame: int) -> str:
    return f"{frame:06d}.png"


def _frame(name: str) -> int:
    return int(Path(name).stem)


def _main() -> None:
    folder = Path(sys.argv[1])
    run_colmap(folder, PoseJob.load(folder)).save(folder)


if __name__ == "__main__":
    _main()
