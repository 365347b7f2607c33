"""COLMAP's part of pose estimation; runs as a process of its own: `python -m extrags.poses.colmap FOLDER`.

A process of its own, because pycolmap and Pillow link two zlibs that clash when pycolmap comes first,
because COLMAP aborts the process on some inputs, and because workers of task runners may not fork.
Progress goes to stdout, one JSON object a line; COLMAP's own log goes to stderr.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from extrags.lens import Lens
from extrags.poses.features import (
    EXTRACTED_STEPS,
    PAIRS_PER_CALL,
    Told,
    extract,
    frame_number,
    image_name,
    match,
    nothing,
    opened,
    read_model,
    world_from_camera,
    write_images,
)
from extrags.poses.job import PoseJob, PoseJobResult, end_with_parent, reserve_stdout
from extrags.poses.pairs import Pair, registration_pairs, training_pairs
from extrags.poses.self_calibration import largest_model, map_with_unknown_lens, model_sizes

__all__ = ["run_colmap"]

MIN_POSE_INLIERS = 12
POSE_INLIER_SHARE = 0.25
POSE_MAX_ERROR_PX = 8.0

MAPPED_STEPS = 10
"""Steps of the progress for a frame that is mapped: so many pairs could be matched meanwhile (10 in frames of
320 pixels, more in smaller ones)."""
FITTED_STEPS = 2
"""The same for each mapped frame while a lens model is fitted."""
USUAL_FITS = 5
"""Lens models that are fitted where the lens turns out to be a pinhole."""

ADJUSTED_TOLERANCE = 1e-5
"""Relative decrease of the cost below which a bundle adjustment of the mapping ends. COLMAP's 0 goes on while
there is any, for fifty iterations at most, although the next frame moves the map again."""

LENIENT_POSE_INLIERS = 12
LENIENT_POSE_SHARE = 0.12
LENIENT_FIRST_PAIR_INLIERS = 50
LENIENT_MATCHES = 8
"""Of the second attempt; COLMAP's 30, 0.25, 100 and 15 are made for photographs of many megapixels. Frames of
two hundred pixels with folds in each other's way may have forty matches in the median."""


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
    # Held-out frames are matched against those that got a pose: against no more than there are.
    held_out_pairs = registration_pairs(job.test, job.train, job.recording, **schedule)
    map_steps = len(job.train) * (MAPPED_STEPS + job.unknown_lens * USUAL_FITS * FITTED_STEPS)
    told = Told(total=EXTRACTED_STEPS * frames + len(pairs) + map_steps + len(held_out_pairs) + len(job.test))
    database_path = folder / "database.db"
    images = folder / "images"
    write_images(folder, job)
    with opened(pycolmap, database_path):
        pass  # opening creates it, which importing images expects
    report: dict[str, Any] = {"n_train": len(job.train), "n_test": len(job.test), "pairs": len(pairs)}

    extract(pycolmap, folder, job, job.train, told)
    match(pycolmap, folder, pairs, seed, told, lenient=job.lenient)
    with opened(pycolmap, database_path) as database:
        report |= _match_report(pycolmap, database, job.train, pairs)

    # The first pair of a model counts once, and further models count images again: told steps are
    # held below what the map is given, and set to it at its end.
    map_made = told.done + map_steps

    def mapped() -> None:
        told.reach(min(told.done + MAPPED_STEPS, map_made))

    def fitted() -> None:
        told.reach(min(told.done + FITTED_STEPS * len(job.train), map_made))

    def make_map(database: Path, options: Any) -> dict[int, Any]:
        models: dict[int, Any] = pycolmap.incremental_mapping(
            database, images, folder, options=options, next_image_callback=mapped
        )
        return models

    def options() -> Any:
        return _mapping_options(pycolmap, job.settings, lenient=job.lenient)

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
            lambda model: read_model(model, np.full((frames, 4, 4), np.nan), {}),
            fitted,
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
        return nothing(poses, report | {"registrations": {}})
    result = read_model(best, poses, report)
    _register_held_out(pycolmap, folder, job, best, result, schedule, told, lens)
    told.reach(told.total, registered=float(np.isfinite(poses).all((1, 2)).sum()))
    return result


def _guessed_lens(job: PoseJob) -> Lens:
    """The pinhole that all frames were guessed to have."""
    K = job.K[0]
    focal = float(np.sqrt(K[0, 0] * K[1, 1]))
    height, width = job.rgb.shape[1:3]
    return Lens("SIMPLE_PINHOLE", (focal, float(K[0, 2]), float(K[1, 2])), width, height)


def _match_report(pycolmap: Any, database: Any, frames: np.ndarray, pairs: list[Pair]) -> dict[str, Any]:
    ids = {int(frame): database.read_image_with_name(image_name(int(frame))).image_id for frame in frames}
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
    angles, turn_only = _parallax(pycolmap, database, ids, verified[:PAIRS_PER_CALL])
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
        images = [database.read_image_with_name(image_name(frame)) for frame in pair]
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


def _mapping_options(pycolmap: Any, settings: dict[str, Any], *, lenient: bool) -> Any:
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
    options.ba_local_function_tolerance = options.ba_global_function_tolerance = ADJUSTED_TOLERANCE
    options.min_model_size = 3
    options.max_num_models = 5
    if lenient:
        options.min_num_matches = LENIENT_MATCHES
        options.mapper.abs_pose_min_num_inliers = LENIENT_POSE_INLIERS
        options.mapper.abs_pose_min_inlier_ratio = LENIENT_POSE_SHARE
        options.mapper.init_min_num_inliers = LENIENT_FIRST_PAIR_INLIERS
    return options


def _register_held_out(
    pycolmap: Any,
    folder: Path,
    job: PoseJob,
    model: Any,
    result: PoseJobResult,
    schedule: dict[str, int],
    told: Told,
    lens: Lens | None,
) -> None:
    """Pose of each held-out frame from its matches to triangulated points; the map stays as it is.

    `lens` is the one that all frames were found to have; None takes the camera that each frame came with.
    """
    images = {frame_number(model.image(number).name): model.image(number) for number in model.reg_image_ids()}
    mapped = np.array(sorted(images), dtype=np.int64)
    registrations: dict[str, dict[str, int]] = {}
    result.report["registrations"] = registrations
    if len(job.test) == 0:
        return
    extract(pycolmap, folder, job, job.test, told)
    pairs = registration_pairs(job.test, mapped, job.recording, **schedule)
    match(pycolmap, folder, pairs, int(job.settings["seed"]), told, lenient=job.lenient)
    with opened(pycolmap, folder / "database.db") as database:
        for frame in job.test.tolist():
            own = database.read_image_with_name(image_name(frame))
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
    return world_from_camera(answer["cam_from_world"]), inliers


def _camera(pycolmap: Any, lens: Lens) -> Any:
    return pycolmap.Camera(
        model=lens.model, width=lens.width, height=lens.height, params=list(lens.parameters)
    )


def _main() -> None:
    end_with_parent()
    reserve_stdout()
    folder = Path(sys.argv[1])
    run_colmap(folder, PoseJob.load(folder)).save(folder)


if __name__ == "__main__":
    _main()
