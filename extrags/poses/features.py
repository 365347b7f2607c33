"""What COLMAP's processes share: features and matches in a database, models read back, progress told.

Nothing here imports pycolmap: it is handed in by the process that has it (see `extrags.poses.colmap`).
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from extrags.cores import usable_cores
from extrags.poses.job import PoseJob, PoseJobResult
from extrags.poses.matching import mutual_matches
from extrags.poses.pairs import Pair

__all__ = [
    "EXTRACTED_STEPS",
    "PAIRS_PER_CALL",
    "Told",
    "extract",
    "frame_number",
    "image_name",
    "match",
    "nothing",
    "opened",
    "read_adjusted",
    "read_model",
    "world_from_camera",
    "write_images",
]

MASK_EROSION_SHARE = 0.01
"""Features this near (in image widths) to masked-out pixels belong to the edge, which moves along."""
LENIENT_PAIR_INLIERS = 12
"""Matches that verify a pair at the second attempt; COLMAP asks for 15."""

PAIRS_PER_CALL = 100
EXTRACTED_STEPS = 8
"""Steps of the progress that finding the features of a frame counts, where matching a pair is one: so many
times as long it takes, in frames of 160 and 320 pixels (11 and 7)."""
_IMAGES_PER_CALL = 16


@dataclass
class Told:
    """Counts steps and reports them to the parent process.

    A step is about as long as matching a pair of frames: time left is told by the steps that are left.
    """

    total: int
    done: int = 0
    values: dict[str, float] = field(default_factory=dict)

    def step(self, count: int = 1, **values: float) -> None:
        """So many steps more."""
        self.reach(self.done + count, **values)

    def reach(self, done: int, **values: float) -> None:
        """So many steps in all; never more than there are."""
        self.done = min(done, self.total)
        self.values |= values
        sys.stdout.write(json.dumps({"done": self.done, "total": self.total, "values": self.values}) + "\n")
        sys.stdout.flush()


def write_images(folder: Path, job: PoseJob) -> None:
    """Images and masks of all frames as files, by `image_name`; masks eroded by `MASK_EROSION_SHARE`."""
    from PIL import Image
    from scipy.ndimage import binary_erosion

    radius = max(2, round(MASK_EROSION_SHARE * job.rgb.shape[2]))
    for name in ("images", "masks"):
        (folder / name).mkdir()
    for index, (rgb, mask) in enumerate(zip(job.rgb, job.mask, strict=True)):
        Image.fromarray(rgb).save(folder / "images" / image_name(index), compress_level=1)
        # The image's own border is no edge of the mask.
        kept = binary_erosion(mask, iterations=radius, border_value=1)
        Image.fromarray((kept * 255).astype(np.uint8)).save(folder / "masks" / f"{image_name(index)}.png")


def extract(pycolmap: Any, folder: Path, job: PoseJob, frames: np.ndarray, told: Told) -> None:
    """Cameras, images and SIFT features of frames, into `database.db`; one camera for each distinct K."""
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
        members = [image_name(int(frame)) for frame in frames[group == number]]
        reader.camera_params = ",".join(repr(float(value)) for value in parameters)
        reader.existing_camera_id = -1
        shared = {"camera_mode": pycolmap.CameraMode.SINGLE}
        # Numbered here, in order: extraction would number the images as its threads finish, and the
        # numbers decide ties in the mapping.
        pycolmap.import_images(
            folder / "database.db", folder / "images", image_names=members, options=reader, **shared
        )
        with opened(pycolmap, folder / "database.db") as database:
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
            told.step(EXTRACTED_STEPS * len(part))


def match(
    pycolmap: Any,
    folder: Path,
    pairs: list[Pair],
    seed: int,
    told: Told,
    *,
    verify: bool = True,
    lenient: bool = False,
) -> None:
    """Matches of pairs of frames, and with `verify` the two-view geometry that RANSAC finds in them.

    With `lenient` features are matched once more along the epipolar lines of the geometry that was found, and
    fewer of them verify a pair.
    """
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.guided_matching = lenient
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    if lenient:
        verification.min_num_inliers = LENIENT_PAIR_INLIERS
    pairing = pycolmap.ImportedPairingOptions()
    listed = folder / "pairs.txt"
    for start in range(0, len(pairs), PAIRS_PER_CALL):
        part = pairs[start : start + PAIRS_PER_CALL]
        _write_matches(pycolmap, folder, part)
        if verify:
            # Of pairs that have matches COLMAP finds the geometry.
            listed.write_text("".join(f"{image_name(i)} {image_name(j)}\n" for i, j in part))
            pairing.match_list_path = listed
            pycolmap.match_image_pairs(
                folder / "database.db",
                matching_options=matching,
                pairing_options=pairing,
                verification_options=verification,
                device=pycolmap.Device.cpu,
            )
        told.step(len(part))


def _write_matches(pycolmap: Any, folder: Path, pairs: list[Pair]) -> None:
    """Mutual nearest neighbours of pairs of frames, into `database.db`."""
    with opened(pycolmap, folder / "database.db") as database:
        frames = sorted({frame for pair in pairs for frame in pair})
        ids = {frame: database.read_image_with_name(image_name(frame)).image_id for frame in frames}
        features = {frame: database.read_descriptors(number).data for frame, number in ids.items()}
        with ThreadPoolExecutor(usable_cores()) as threads:
            found = threads.map(lambda pair: mutual_matches(features[pair[0]], features[pair[1]]), pairs)
            for (i, j), matches in zip(pairs, found, strict=True):
                database.write_matches(ids[i], ids[j], matches.astype(np.uint32))


def read_model(model: Any, poses: np.ndarray, report: dict[str, Any]) -> PoseJobResult:
    """Points of a model with their observations; its poses are written into `poses`."""
    _write_poses(model, poses)
    point_ids = sorted(model.point3D_ids())
    images = {number: model.image(number) for number in model.reg_image_ids()}
    frame_of = {number: frame_number(image.name) for number, image in images.items()}
    frames, points, pixels = [], [], []
    for index, point_id in enumerate(point_ids):
        for element in model.point3D(point_id).track.elements:
            frames.append(frame_of[element.image_id])
            points.append(index)
            pixels.append(images[element.image_id].point2D(element.point2D_idx).xy)
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


def read_adjusted(model: Any, before: PoseJobResult) -> PoseJobResult:
    """A model after a bundle adjustment, with the observations that it had before: points and poses moved.

    Args:
        model: with the points and observations of `before`.
        before: from `read_model`; its report is left out.
    """
    poses = before.world_from_camera.copy()
    _write_poses(model, poses)
    points = np.array([model.point3D(number).xyz for number in sorted(model.point3D_ids())]).reshape(-1, 3)
    return replace(before, world_from_camera=poses, points=points, report={})


def _write_poses(model: Any, poses: np.ndarray) -> None:
    for number in sorted(model.reg_image_ids()):
        image = model.image(number)
        poses[frame_number(image.name)] = world_from_camera(image.cam_from_world())


def world_from_camera(cam_from_world: Any) -> np.ndarray:
    """A pose of pycolmap's as a matrix, inverted."""
    pose = np.eye(4)
    pose[:3] = cam_from_world.inverse().matrix()
    return pose


def nothing(poses: np.ndarray, report: dict[str, Any]) -> PoseJobResult:
    """A result without points."""
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
def opened(pycolmap: Any, path: Path) -> Iterator[Any]:
    """A database that is closed at the end; opening makes it where there is none."""
    database = pycolmap.Database.open(path)
    try:
        yield database
    finally:
        database.close()


def image_name(frame: int) -> str:
    """File of a frame's image."""
    return f"{frame:06d}.png"


def frame_number(name: str) -> int:
    """The frame an image's file belongs to."""
    return int(Path(name).stem)
