"""COLMAP's part of triangulation: `python -m extrags.poses.colmap_triangulation FOLDER`.

A process of its own, for the reasons given in `extrags.poses.colmap`; progress likewise.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from extrags.errors import ShapeError
from extrags.poses.features import (
    EXTRACTED_STEPS,
    Told,
    extract,
    image_name,
    match,
    nothing,
    opened,
    read_model,
    write_images,
)
from extrags.poses.job import PoseJob, PoseJobResult, end_with_parent, reserve_stdout
from extrags.poses.pairs import Pair, neighbouring_pairs, training_pairs

__all__ = ["run_triangulation"]

MAX_EPIPOLAR_ERROR_PX = 2.0
"""Sampson distance above which a match contradicts the known poses."""
MIN_MATCHES = 4
"""Fewer matches that agree with the poses are chance."""
TRIANGULATED_STEPS = 2
"""Steps of the progress, of which a matched pair is one, for triangulating the points of a frame."""
MIN_TRI_ANGLE_DEG = 1.0
"""Rays nearer to parallel say little about depth."""


def run_triangulation(folder: Path, job: PoseJob) -> PoseJobResult:
    """Features and matches of the training frames, and points from them with all cameras held fixed.

    Matches are held against the epipolar geometry of the known poses, which is stricter than one found by
    RANSAC and does without a smallest number of inliers.

    Args:
        folder: scratch folder.
        job: the frames, with poses.

    Returns:
        The poses as given, and the points; none where nothing could be triangulated.
    """
    # Pillow first: see `extrags.poses.colmap`.
    from PIL import Image  # noqa: F401, I001
    import pycolmap

    poses = job.world_from_camera
    if poses is None:
        raise ShapeError("a job of triangulation needs poses")
    pycolmap.logging.minloglevel = int(pycolmap.logging.WARNING)
    seed = int(job.settings["seed"])
    pycolmap.set_random_seed(seed)
    pairs = _pairs(job, poses)
    told = Told(total=EXTRACTED_STEPS * len(job.train) + len(pairs) + TRIANGULATED_STEPS * len(job.train))
    database_path = folder / "database.db"
    write_images(folder, job)
    with opened(pycolmap, database_path):
        pass  # opening creates it, which importing images expects
    extract(pycolmap, folder, job, job.train, told)
    match(pycolmap, folder, pairs, seed, told, verify=False)
    report: dict[str, Any] = {"pairs": len(pairs)}
    with opened(pycolmap, database_path) as database:
        report |= _hold_against_poses(pycolmap, database, job, poses, pairs)
        model = _known_model(pycolmap, database, job, poses)
    if report["matches_kept"] == 0:
        told.reach(told.total)
        return nothing(poses.copy(), report)
    model = pycolmap.triangulate_points(
        model, database_path, folder / "images", folder, options=_options(pycolmap, seed)
    )
    # Bundle adjustment holds the cameras fixed; what comes back is their rounding at most.
    result = replace(read_model(model, poses.copy(), report), world_from_camera=poses.copy())
    told.reach(told.total, points=float(len(result.points)))
    return result


def _pairs(job: PoseJob, poses: np.ndarray) -> list[Pair]:
    schedule = {key: job.settings[key] for key in ("exhaustive_below", "sequential_overlap")}
    found = set(training_pairs(job.train, job.recording, **schedule))
    found |= set(neighbouring_pairs(job.train, poses, neighbours=job.settings["sequential_overlap"]))
    return sorted(found)


def _hold_against_poses(
    pycolmap: Any, database: Any, job: PoseJob, poses: np.ndarray, pairs: list[Pair]
) -> dict[str, Any]:
    """Write the two-view geometry of each pair, with the matches that agree with it."""
    ids = {int(frame): database.read_image_with_name(image_name(int(frame))).image_id for frame in job.train}
    keypoints = {
        frame: database.read_keypoints(number)[:, :2].astype(np.float64) for frame, number in ids.items()
    }
    found = kept = 0
    for i, j in pairs:
        if not database.exists_matches(ids[i], ids[j]):
            continue
        matches = database.read_matches(ids[i], ids[j])
        found += len(matches)
        F = _fundamental(job.K[i], job.K[j], np.linalg.inv(poses[j]) @ poses[i])
        error = _sampson_px(F, keypoints[i][matches[:, 0]], keypoints[j][matches[:, 1]])
        agree = matches[error < MAX_EPIPOLAR_ERROR_PX]
        if len(agree) < MIN_MATCHES:
            continue
        kept += len(agree)
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        geometry.F = F
        geometry.inlier_matches = agree
        database.write_two_view_geometry(ids[i], ids[j], geometry)
    features = [len(points) for points in keypoints.values()]
    return {
        "features_median": float(np.median(features)) if features else 0.0,
        "matches": found,
        "matches_kept": kept,
    }


def _fundamental(K_i: np.ndarray, K_j: np.ndarray, j_from_i: np.ndarray) -> np.ndarray:
    """F with x_j^T F x_i = 0; all zeros for two frames in one place, where no match contradicts it."""
    x, y, z = j_from_i[:3, 3]
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    F = np.linalg.inv(K_j).T @ across @ j_from_i[:3, :3] @ np.linalg.inv(K_i)
    return np.asarray(F / max(float(np.linalg.norm(F)), 1e-300))


def _sampson_px(F: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """First-order distance of matches from epipolar geometry (Hartley & Zisserman, 2nd ed., eq. 11.9)."""
    one = np.concatenate([first, np.ones((len(first), 1))], axis=1)
    two = np.concatenate([second, np.ones((len(second), 1))], axis=1)
    lines_two, lines_one = one @ F.T, two @ F
    residual = (two * lines_two).sum(-1)
    slope = (lines_two[:, :2] ** 2).sum(-1) + (lines_one[:, :2] ** 2).sum(-1)
    return np.asarray(np.abs(residual) / np.sqrt(np.maximum(slope, 1e-300)))


def _known_model(pycolmap: Any, database: Any, job: PoseJob, poses: np.ndarray) -> Any:
    """A reconstruction of cameras alone, numbered as in the database."""
    model = pycolmap.Reconstruction()
    for camera in database.read_all_cameras():
        model.add_camera(camera)
    for rig in database.read_all_rigs():
        model.add_rig(rig)
    images = {image.image_id: image for image in database.read_all_images()}
    frame_of = {image_name(int(frame)): int(frame) for frame in job.train}
    for frame in database.read_all_frames():
        (data,) = frame.data_ids
        name = images[data.id].name
        camera_from_world = np.linalg.inv(poses[frame_of[name]])
        frame.rig_from_world = pycolmap.Rigid3d(camera_from_world[:3])
        model.add_frame(frame)
    for image in images.values():
        model.add_image(image)
    for number in sorted(frame.frame_id for frame in database.read_all_frames()):
        model.register_frame(number)
    return model


def _options(pycolmap: Any, seed: int) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    # One thread: sums of residuals in another order would give other bits.
    options.num_threads = options.mapper.num_threads = 1
    for part in (options, options.mapper, options.triangulation):
        part.random_seed = seed
    options.ba_refine_focal_length = False
    options.ba_refine_principal_point = False
    options.ba_refine_extra_params = False
    options.fix_existing_frames = options.mapper.fix_existing_frames = True
    # With known cameras two views make a point: the epipolar geometry has been checked.
    options.triangulation.ignore_two_view_tracks = False
    options.triangulation.min_angle = MIN_TRI_ANGLE_DEG
    options.mapper.filter_min_tri_angle = MIN_TRI_ANGLE_DEG
    return options


def _main() -> None:
    end_with_parent()
    reserve_stdout()
    folder = Path(sys.argv[1])
    run_triangulation(folder, PoseJob.load(folder)).save(folder)


if __name__ == "__main__":
    _main()
