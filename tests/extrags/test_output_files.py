"""Files that are there whole, or as they were before, whatever happens while they are written."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from extrags.array_files import save_safetensors
from extrags.cameras import Cameras
from extrags.export import CameraPath, ColoredMesh, write_camera_path, write_mesh, write_points, write_video
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.output_files import remove_unfinished, whole_file, whole_folder, write_file
from extrags.report.calibration_plot import write_calibration_plot
from extrags.restoration.uncertainty.reliability_diagram import calibration
from extrags.scene import Scene
from extrags.splat_files import write_compressed_ply, write_ply_scene, write_sog, write_spz
from extrags.surface import Mesh
from tests.extrags.lit_tube import tube_cameras

MESH = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], dtype=np.int32))
COLORED = ColoredMesh(
    MESH,
    np.zeros((3, 3), dtype=np.uint8),
    np.zeros(3, dtype=np.float32),
    np.zeros((4, 4, 3), dtype=np.uint8),
    np.zeros((1, 3, 2)),
)
FLAT = calibration(np.zeros((1, 4, 4)), np.zeros((1, 4, 4, 3)), np.ones((1, 4, 4), bool))


def few() -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    return Gaussians(
        means=torch.randn(5, 3, generator=generator),
        quats=torch.eye(4)[:1].repeat(5, 1),
        scales=torch.zeros(5, 3),
        opacities=torch.full((5,), 3.0),
        sh0=torch.zeros(5, 1, 3),
        shN=torch.zeros(5, 0, 3),
    )


def pictures() -> Iterator[np.ndarray]:
    for index in range(3):
        yield np.full((16, 16, 3), 20 * index, dtype=np.uint8)


def camera_path() -> CameraPath:
    cameras: Cameras = tube_cameras(2)
    return CameraPath(cameras, 24.0)


WRITERS: dict[str, Callable[[Path], object]] = {
    "plain.ply": lambda path: few().write_ply(path),
    "scene.ply": lambda path: write_ply_scene(Scene(few()), path),
    "lit.ply": lambda path: write_ply_scene(Scene(few(), NearFieldLight.initial(1, 20.0)), path),
    "compressed.ply": lambda path: write_compressed_ply(few(), path),
    "scene.spz": lambda path: write_spz(few(), path),
    "scene.sog": lambda path: write_sog(few(), path),
    "points.ply": lambda path: write_points(few(), path),
    "surface.ply": MESH.write_ply,
    "mesh.ply": lambda path: write_mesh(COLORED, path),
    "mesh.obj": lambda path: write_mesh(COLORED, path),
    "mesh.glb": lambda path: write_mesh(COLORED, path),
    "path.json": lambda path: write_camera_path(camera_path(), path),
    "flight.mp4": lambda path: write_video(pictures(), path),
    "plot.svg": lambda path: write_calibration_plot({"flat": FLAT}, path),
    "tensors.safetensors": lambda path: save_safetensors(path, {"a": torch.zeros(2)}),
}


@pytest.mark.parametrize("name", WRITERS)
def test_what_is_interrupted_leaves_the_older_file_alone(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / name
    file.write_text("older")

    def interrupted(path: Path, target: Path) -> Path:
        # The last moment: all is written.
        assert path.stat().st_size > 0
        assert path.suffix == target.suffix
        raise KeyboardInterrupt

    with monkeypatch.context() as changed:
        changed.setattr(Path, "replace", interrupted)
        with pytest.raises(KeyboardInterrupt):
            WRITERS[name](file)
    assert file.read_text() == "older"
    assert os.listdir(tmp_path) == [name]
    WRITERS[name](file)
    assert file.read_bytes() != b"older"
    assert not list(tmp_path.glob(".*"))


def test_a_video_whose_frames_end_in_the_middle_is_none(tmp_path: Path) -> None:
    def ending() -> Iterator[np.ndarray]:
        random = np.random.default_rng(0)
        # So many that the encoder has written some: what is there of the file plays.
        for _ in range(60):
            yield random.integers(0, 255, (32, 32, 3), dtype=np.uint8)
        raise KeyboardInterrupt

    file = tmp_path / "flight.mp4"
    for before in (None, b"older"):
        if before is not None:
            file.write_bytes(before)
        with pytest.raises(KeyboardInterrupt):
            write_video(ending(), file)
        assert (file.read_bytes() if file.exists() else None) == before
        assert len(os.listdir(tmp_path)) == (before is not None)


class TestWholeFile:
    def test_its_permissions_stay(self, tmp_path: Path) -> None:
        file = tmp_path / "a.txt"
        write_file(file, "new")
        usual = tmp_path / "usual"
        usual.touch()
        assert file.stat().st_mode == usual.stat().st_mode
        file.chmod(0o640)
        write_file(file, "newer")
        assert file.stat().st_mode & 0o777 == 0o640
        assert file.read_text() == "newer"

    def test_a_link_stays_one(self, tmp_path: Path) -> None:
        (tmp_path / "elsewhere").mkdir()
        (tmp_path / "elsewhere" / "a.txt").write_text("older")
        link = tmp_path / "link.txt"
        link.symlink_to(tmp_path / "elsewhere" / "a.txt")
        write_file(link, "new")
        assert link.is_symlink()
        assert (tmp_path / "elsewhere" / "a.txt").read_text() == "new"

    def test_what_is_no_file_is_written_itself(self) -> None:
        write_file(Path(os.devnull), "x")
        assert not Path(os.devnull).is_file()

    def test_a_file_that_may_not_be_written(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        file = tmp_path / "a.txt"
        file.write_text("older")
        # Whoever runs the tests may write everything.
        monkeypatch.setattr(os, "access", lambda *_: False)
        with pytest.raises(PermissionError, match=str(file)):
            write_file(file, "new")
        assert file.read_text() == "older"

    def test_errors_name_the_file_that_was_asked_for(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError) as found:
            write_file(tmp_path / "none" / "a.txt", "x")
        assert found.value.filename == str(tmp_path / "none" / "a.txt")
        with pytest.raises(IsADirectoryError):
            write_file(tmp_path, "x")

    def test_the_end_of_a_process(self, tmp_path: Path) -> None:
        """Where nothing unwinds any more."""
        with whole_file(tmp_path / "a.txt") as partial, whole_folder(tmp_path / "b") as folder:
            partial.write_text("x")
            (folder / "c").write_text("x")
            remove_unfinished()
            assert os.listdir(tmp_path) == []
            partial.write_text("x")
            folder.mkdir()
        assert sorted(os.listdir(tmp_path)) == ["a.txt", "b"]


class TestWholeFolder:
    def test_a_new_one(self, tmp_path: Path) -> None:
        target = tmp_path / "scene"
        with whole_folder(target) as folder:
            (folder / "sub").mkdir()
            (folder / "sub" / "a.txt").write_text("x")
            assert not target.exists()
        assert (target / "sub" / "a.txt").read_text() == "x"
        assert os.listdir(tmp_path) == ["scene"]

    def test_an_empty_one_stays_the_same(self, tmp_path: Path) -> None:
        before = tmp_path.stat().st_ino
        with whole_folder(tmp_path) as folder:
            (folder / "a.txt").write_text("x")
            (folder / "sub").mkdir()
        assert tmp_path.stat().st_ino == before
        assert sorted(os.listdir(tmp_path)) == ["a.txt", "sub"]

    @pytest.mark.parametrize("there", [False, True])
    def test_nothing_is_left_of_half_a_one(self, there: bool, tmp_path: Path) -> None:
        target = tmp_path / "scene"
        if there:
            target.mkdir()

        def half() -> None:
            with whole_folder(target) as folder:
                (folder / "a.txt").write_text("x")
                (folder / "none" / "b.txt").write_text("x")

        with pytest.raises(FileNotFoundError) as found:
            half()
        assert found.value.filename == str(target / "none" / "b.txt")
        assert (os.listdir(target) if there else os.listdir(tmp_path)) == []
