"""Good files of each kind that a reader takes, small; `tests.fuzzing` spoils them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import data_catalog
from data_catalog.calibration_files import read_calibration
from data_catalog.readers.colmap_model import write_colmap
from data_catalog.readers.transforms_json import write_transforms
from extrags.config import IngestConfig
from extrags.depth.weights import load_completion
from extrags.export import CameraPath, read_camera_path, write_camera_path
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.metrics.lpips_weights import array_names, read_weights
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, Split
from extrags.splat_files import read_splat_file, write_ply_scene, write_spz
from extrags.store import Store
from tests.data_catalog.footage_fixture import write_dicom, write_video
from tests.data_catalog.layouts import write_endonerf
from tests.data_catalog.test_calibration_files import OCAMCALIB, kalibr_file, opencv_file
from tests.data_catalog.test_content import moving_scene
from tests.data_catalog.tum_fixture import write_tum
from tests.fuzzing import Case

CONFIG = IngestConfig(max_frames=3)


@cache
def sequence() -> EndoscopicSequence:
    """Three frames before a plane."""
    generator = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = np.arange(3)
    return EndoscopicSequence(
        name="small",
        rgb=np.repeat(generator.integers(40, 200, (1, 32, 40, 3), dtype=np.uint8), 3, axis=0),
        K=np.tile(np.array([[30.0, 0, 20], [0, 30, 16], [0, 0, 1]]), (3, 1, 1)),
        mask=np.ones((3, 32, 40), dtype=bool),
        split=Split("all", np.arange(1, 3), np.arange(1)),
        world_from_camera=poses,
        depth_mm=np.full((3, 32, 40), 30, np.float32),
        points=generator.normal((0, 0, 30), 1, (6, 3)),
        points_rgb=np.full((6, 3), 90, np.uint8),
        frame_names=("0", "1", "2"),
    )


def posed(kind: str) -> Callable[[Path], Path]:
    """Our own layout, with depth of a kind."""

    def make(folder: Path) -> Path:
        shown = sequence()
        assert shown.depth_mm is not None
        for name in ("rgb", "depth", "mask"):
            (folder / name).mkdir()
        frames = []
        for k in range(3):
            Image.fromarray(shown.rgb[k]).save(folder / "rgb" / f"{k}.png")
            Image.fromarray(np.full((32, 40), 255, np.uint8)).save(folder / "mask" / f"{k}.png")
            depth = folder / "depth" / f"{k}.{kind}"
            if kind == "npy":
                np.save(depth, shown.depth_mm[k])
            else:
                values = shown.depth_mm[k] if kind == "tiff" else shown.depth_mm[k].astype(np.uint16)
                Image.fromarray(values).save(depth)
            pose = shown.cameras.world_from_camera[k].tolist()
            frames.append(
                {"file": f"rgb/{k}.png", "world_from_camera": pose, "split": "train" if k else "test"}
            )
        content = {"length_unit": "mm", "K": shown.K[0].tolist(), "frames": frames}
        (folder / "poses.json").write_text(json.dumps(content))
        return folder

    return make


def transforms(folder: Path) -> Path:
    """nerfstudio's layout."""
    write_transforms(sequence(), folder)
    return folder


def transforms_ascii(folder: Path) -> Path:
    """The same with points in text."""
    write_transforms(sequence(), folder)
    rows = "".join(f"{x} {y} {z} 9 9 9\n" for x, y, z in np.asarray(sequence().points).tolist())
    columns = "".join(f"property double {axis}\n" for axis in "xyz")
    columns += "".join(f"property uchar {color}\n" for color in ("red", "green", "blue"))
    (folder / "points.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex 6\n{columns}end_header\n{rows}"
    )
    return folder


def transforms_of_splits(folder: Path) -> Path:
    """A file for each split, as synthetic scenes have them."""
    write_transforms(sequence(), folder)
    content = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").unlink()
    of_all = {key: value for key, value in content.items() if not key.endswith("_filenames")}
    for name, frames_of_split in (("train", content["frames"][1:]), ("test", content["frames"][:1])):
        text = json.dumps({**of_all, "frames": frames_of_split})
        (folder / f"transforms_{name}.json").write_text(text)
    return folder


def colmap(*, binary: bool) -> Callable[[Path], Path]:
    """COLMAP's workspace."""

    def make(folder: Path) -> Path:
        write_colmap(sequence(), folder, binary=binary)
        return folder

    return make


def endonerf(folder: Path) -> Path:
    """LLFF poses."""
    write_endonerf(sequence(), folder)
    return folder


def tum(folder: Path) -> Path:
    """Lists and a trajectory by time."""
    write_tum(sequence(), folder)
    return folder


def frames(folder: Path) -> Path:
    """Plain images."""
    for k in range(3):
        Image.fromarray(np.roll(sequence().rgb[k], k, axis=1)).save(folder / f"{k}.jpg")
    (folder / "intrinsics.json").write_text(json.dumps({"K": sequence().K[0].tolist()}))
    Image.fromarray(np.full((32, 40), 255, np.uint8)).save(folder / "mask.png")
    return folder


@cache
def scene() -> np.ndarray:
    """A moving picture."""
    return np.asarray(moving_scene(8, 64, 48, speed=4))


def video(name: str, code: str) -> Callable[[Path], Path]:
    """A video file."""
    return lambda folder: write_video(folder / name, scene(), code)


def dicom(folder: Path) -> Path:
    """Raw frames."""
    return write_dicom(folder / "a.dcm", scene(), FrameTime=40)


def dicom_jpeg(folder: Path) -> Path:
    """Frames of JPEG."""
    return write_dicom(folder / "a.dcm", scene(), colors="YBR_FULL_422", jpeg=True, FrameTime=40)


def dicom_video(folder: Path) -> Path:
    """A stream."""
    stream = write_video(folder / "a.mp4", scene(), "mp4v")
    made = write_dicom(folder / "a.dcm", scene(), colors="YBR_PARTIAL_420", stream=stream.read_bytes())
    stream.unlink()
    return made


def ocamcalib(folder: Path) -> Path:
    """Scaramuzza's text."""
    (folder / "calib_results.txt").write_text(OCAMCALIB)
    return folder / "calib_results.txt"


def stored(folder: Path) -> Path:
    """An artefact with a sequence."""
    with Store(folder).slot(stage="toy", version=1, key="toy-v1-0", config={"a": 1}) as slot:
        slot.save(sequence())
    return folder


def read_stored(folder: Path) -> object:
    """Find, open, load, verify."""
    store = Store(folder)
    store.ls()
    ref = store.find("toy-v1-0")
    return None if ref is None else store.load(EndoscopicSequence, ref)


def resealed(folder: Path) -> object:
    """Arrays without a manifest that vouches for them."""
    return EndoscopicSequence.load(folder / "artefacts" / "toy-v1-0" / EndoscopicSequence.stored_as)


def lpips_arrays() -> dict[str, np.ndarray]:
    """Named as LPIPS's, far smaller."""
    shapes = {name: (3, 3, 1, 1) if name.endswith(".weight") else (3,) for name in array_names("alex")}
    return {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}


def lpips(folder: Path) -> Path:
    """As numpy saves them."""
    np.savez(folder / "w.npz", **lpips_arrays())
    return folder / "w.npz"


def state(folder: Path) -> Path:
    """What torch saves."""
    arrays = {name: torch.from_numpy(value) for name, value in lpips_arrays().items()}
    torch.save(arrays, folder / "w.pth")
    return folder / "w.pth"


def tensors(folder: Path) -> Path:
    """The package's completion network."""
    from extrags.depth.weights import find_completion

    found = find_completion("bundled")
    assert found is not None
    (folder / "w.safetensors").write_bytes(found.read_bytes())
    return folder / "w.safetensors"


@cache
def _restorer() -> EmbeddedEnhancer:
    from extrags.restoration.diffusion.weights import COLONS, starting_weights

    whole = EmbeddedEnhancer.load(starting_weights(COLONS))
    return replace(whole, record={})


def restorer(folder: Path) -> Path:
    """The package's restorer."""
    _restorer().save(folder)
    return folder


def _three_gaussians() -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    quats = torch.zeros(3, 4)
    quats[:, 0] = 1
    return Gaussians(
        means=torch.randn(3, 3, generator=generator),
        quats=quats,
        scales=torch.zeros(3, 3),
        opacities=torch.zeros(3),
        sh0=torch.zeros(3, 1, 3),
        shN=torch.zeros(3, 3, 3),
    )


def gaussians(folder: Path) -> Path:
    """A scene of three."""
    _three_gaussians().write_ply(folder / "a.ply")
    return folder / "a.ply"


def lit_gaussians(folder: Path) -> Path:
    """The same, with a light in the header."""
    light = NearFieldLight(torch.tensor(-2.0), torch.tensor(0.1), torch.zeros(2), 20.0)
    write_ply_scene(Scene(_three_gaussians(), light), folder / "a.ply")
    return folder / "a.ply"


def spz(folder: Path) -> Path:
    """The same, packed."""
    write_spz(_three_gaussians(), folder / "a.spz")
    return folder / "a.spz"


def camera_path(folder: Path) -> Path:
    """Three cameras."""
    write_camera_path(CameraPath(sequence().cameras), folder / "a.json")
    return folder / "a.json"


def source(place: Path) -> object:
    """As a user would: fingerprint, then read."""
    data_catalog.source_fingerprint(str(place))
    return data_catalog.read(str(place), CONFIG)


def calibration(file: Path) -> object:
    """For images of its size."""
    return read_calibration(file, 160, 128)


_MODEL = "sparse/0/"

CASES: dict[str, Case] = {
    "poses.json": Case(posed("npy"), "poses.json", source),
    "png": Case(posed("npy"), "rgb/1.png", source),
    "mask": Case(posed("npy"), "mask/1.png", source),
    "depth.npy": Case(posed("npy"), "depth/1.npy", source),
    "depth.png": Case(posed("png"), "depth/1.png", source),
    "depth.tiff": Case(posed("tiff"), "depth/1.tiff", source),
    "transforms.json": Case(transforms, "transforms.json", source),
    "transforms_test.json": Case(transforms_of_splits, "transforms_test.json", source),
    "points.ply": Case(transforms, "points.ply", source),
    "points-ascii.ply": Case(transforms_ascii, "points.ply", source),
    "cameras.bin": Case(colmap(binary=True), f"{_MODEL}cameras.bin", source),
    "images.bin": Case(colmap(binary=True), f"{_MODEL}images.bin", source),
    "points3D.bin": Case(colmap(binary=True), f"{_MODEL}points3D.bin", source),
    "cameras.txt": Case(colmap(binary=False), f"{_MODEL}cameras.txt", source),
    "images.txt": Case(colmap(binary=False), f"{_MODEL}images.txt", source),
    "points3D.txt": Case(colmap(binary=False), f"{_MODEL}points3D.txt", source),
    "depth.bin": Case(colmap(binary=True), "stereo/depth_maps/1.png.geometric.bin", source),
    "split.txt": Case(colmap(binary=True), "test_list.txt", source),
    "poses_bounds.npy": Case(endonerf, "poses_bounds.npy", source),
    "tum-rgb.txt": Case(tum, "rgb.txt", source),
    "groundtruth.txt": Case(tum, "groundtruth.txt", source),
    "frames.jpg": Case(frames, "1.jpg", source),
    "intrinsics.json": Case(frames, "intrinsics.json", source),
    "video.mp4": Case(video("a.mp4", "mp4v"), "a.mp4", source),
    "video.avi": Case(video("a.avi", "MJPG"), "a.avi", source),
    "video.mkv": Case(video("a.mkv", "FFV1"), "a.mkv", source),
    "dicom": Case(dicom, "a.dcm", source),
    "dicom-jpeg": Case(dicom_jpeg, "a.dcm", source),
    "dicom-video": Case(dicom_video, "a.dcm", source),
    "opencv.yaml": Case(
        lambda folder: opencv_file(folder / "c.yaml", [0.1, 0.0, 0.0, 0.0]), "c.yaml", calibration
    ),
    "opencv.xml": Case(lambda folder: opencv_file(folder / "c.xml", [0.1, 0, 0, 0]), "c.xml", calibration),
    "kalibr.yaml": Case(
        lambda folder: kalibr_file(folder / "c.yaml", "radtan", [0.1, 0, 0, 0]), "c.yaml", calibration
    ),
    "ocamcalib.txt": Case(ocamcalib, "calib_results.txt", calibration),
    "manifest.json": Case(stored, "artefacts/toy-v1-0/manifest.json", read_stored),
    "sequence.zarr.zip": Case(stored, "artefacts/toy-v1-0/sequence.zarr.zip", read_stored),
    "foreign.zarr.zip": Case(stored, "artefacts/toy-v1-0/sequence.zarr.zip", resealed),
    "lpips.npz": Case(lpips, "w.npz", lambda file: read_weights((file,), "alex")),
    "torch.pth": Case(state, "w.pth", lambda file: read_weights((file, file), "alex")),
    "completion.safetensors": Case(tensors, "w.safetensors", lambda file: load_completion(str(file))),
    "restorer.safetensors": Case(restorer, "restorer.safetensors", EmbeddedEnhancer.load),
    "restorer.json": Case(restorer, "restorer.json", EmbeddedEnhancer.load),
    "gaussians.ply": Case(gaussians, "a.ply", Gaussians.read_ply),
    "lit-gaussians.ply": Case(lit_gaussians, "a.ply", read_splat_file),
    "gaussians.spz": Case(spz, "a.spz", read_splat_file),
    "camera_path.json": Case(camera_path, "a.json", read_camera_path),
}
