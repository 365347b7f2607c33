"""`extrags export` of a finished run, read back by other programs' readers."""

from __future__ import annotations

import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pycolmap
import pytest
import torch
import trimesh
from plyfile import PlyData

from extrags.cameras import Cameras
from extrags.export import CameraPath, read_camera_path, write_camera_path
from extrags.radial_lens import RadialLens
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.splat_files import read_ply_scene
from extrags.store import Store
from flows.cases import SequenceCase, record_outcome
from flows.cli import main
from flows.commands import export_scene
from flows.outcome import SequenceOutcome
from flows.runners import DirectRunner
from flows.wiring import run_sequence
from tests.extrags.splat_files import decoders
from tests.flows.tiny import SEQUENCE, TINY, tiny_config

pytestmark = pytest.mark.usefixtures("untouched_environment")

Finished = tuple[str, SequenceOutcome]
SETTINGS = [part for name, value in TINY.items() for part in ("--set", f"{name}={json.dumps(value)}")]


def export(finished: Finished, *arguments: str) -> int:
    return main(["export", SEQUENCE, "--profile", "quick", "--store", finished[0], *SETTINGS, *arguments])


def frames(finished: Finished) -> EndoscopicSequence:
    store, outcome = finished
    return Store(store).load(EndoscopicSequence, outcome.refs["sequence"])


def test_settings_of_a_finished_run_are_named_where_others_were_given(
    finished: Finished, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store, outcome = finished
    shutil.copytree(Path(store) / "artefacts", tmp_path / "artefacts")
    case = SequenceCase(SEQUENCE, profile="quick", settings=TINY)
    record_outcome(Store(tmp_path), case, outcome, "report", case.config())
    given = ["export", SEQUENCE, "--to", "ply", "--output", str(tmp_path / "a.ply"), "--store", str(tmp_path)]
    assert main(given) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "run it first" in said
    assert "Finished runs of it had --profile quick: give the same, and the same further settings" in said
    options = said.split("the last one had ")[1].removesuffix(" (--debug shows more)")
    # As they stand there, they find the run.
    assert main([*given, *shlex.split(options)]) == 0


def final_scene(finished: Finished) -> Scene:
    store, outcome = finished
    return Store(store).load(Scene, outcome.refs["finetune"])


def psnr(first: Scene, second: Scene, sequence: EndoscopicSequence) -> float:
    with torch.no_grad():
        shown, other = (scene.render(sequence.training_cameras).rgb.clamp(0, 1) for scene in (first, second))
    return float(-10 * torch.log10(((shown - other) ** 2).mean().clamp_min(1e-20)))


class TestGaussians:
    def test_all_formats_show_the_same_baked_scene(
        self, finished: Finished, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        sequence = frames(finished)
        assert export(finished, "-o", str(tmp_path / "a.ply")) == 0
        assert "light baked, recorded" in capsys.readouterr().out
        plain = Scene(decoders.ply(tmp_path / "a.ply"))
        # Without --to, the name says what is written.
        assert export(finished, "-o", str(tmp_path / "a.spz")) == 0
        assert psnr(Scene(decoders.spz(tmp_path / "a.spz")), plain, sequence) > 35
        # As bright as the recording on average, which the albedo is not.
        lit = final_scene(finished)
        assert psnr(plain, lit, sequence) > psnr(Scene(lit.gaussians), lit, sequence) + 2

    def test_light_that_is_kept(self, finished: Finished, tmp_path: Path) -> None:
        assert export(finished, "--light", "kept", "-o", str(tmp_path / "a.ply")) == 0
        assert psnr(read_ply_scene(tmp_path / "a.ply"), final_scene(finished), frames(finished)) > 80

    def test_frontal_light_falls_off_with_the_distance(self, finished: Finished, tmp_path: Path) -> None:
        brightness = []
        for distance in ("10", "30"):
            target = tmp_path / f"{distance}.ply"
            assert export(finished, "--light", "frontal", "--distance", distance, "-o", str(target)) == 0
            brightness.append(float(decoders.ply(target).sh0.mean()))
        assert brightness[0] > brightness[1]


class TestSurface:
    def test_mesh(self, finished: Finished, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        target = tmp_path / "a.ply"
        assert export(finished, "--to", "mesh", "-o", str(target)) == 0
        mesh = trimesh.load(target, process=False)
        said = capsys.readouterr().out
        assert f"{len(mesh.faces)} triangles" in said
        invented = PlyData.read(str(target))["vertex"]["invented"]
        assert f"{100 * (invented > 0).mean():.1f} % of the vertices invented" in said
        # Virtual views have shown more than training views have, but not all.
        assert 0 < invented.mean() < 0.9

    def test_mesh_of_frames_with_a_lens(
        self,
        finished: Finished,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        """Virtual views have none."""
        lens = RadialLens((-0.05, 0.002, 0.0, 0.0), float(np.radians(60)))
        given = replace(frames(finished), lens=lens)
        monkeypatch.setattr(export_scene._Finished, "frames", lambda _: given)
        target = tmp_path / "a.ply"
        assert export(finished, "--to", "mesh", "-o", str(target)) == 0
        assert "% of the vertices invented" in capsys.readouterr().out
        assert 0 < PlyData.read(str(target))["vertex"]["invented"].mean() < 0.9

    def test_files_beside_an_obj_are_named(
        self, finished: Finished, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (tmp_path / "a.png").write_text("mine")
        arguments = ["--to", "mesh", "--scene", "coarse", "-o", str(tmp_path / "a.obj")]
        assert export(finished, *arguments) == 0
        assert ", beside it a_texture.mtl and a_texture.png" in capsys.readouterr().out
        assert (tmp_path / "a.png").read_text() == "mine"

    def test_points(self, finished: Finished, tmp_path: Path) -> None:
        assert export(finished, "--to", "points", "--min-opacity", "0", "-o", str(tmp_path / "a.ply")) == 0
        assert len(trimesh.load(tmp_path / "a.ply").vertices) == len(final_scene(finished).gaussians)


class TestFlights:
    def test_a_path_and_the_video_along_it(
        self, finished: Finished, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        path, video = tmp_path / "path.json", tmp_path / "a.mp4"
        flight = ["--along", "held-out", "--between", "2", "--fps", "10"]
        assert export(finished, "--to", "camera-path", *flight, "-o", str(path)) == 0
        written = read_camera_path(path)
        held_out = frames(finished)
        poses = held_out.cameras[np.sort(held_out.test)].world_from_camera
        np.testing.assert_allclose(written.cameras.world_from_camera[0], poses[0], atol=1e-9)
        assert export(finished, "--to", "video", "--along", str(path), "--width", "64", "-o", str(video)) == 0
        assert "frames of coarse, final, uncertainty" in capsys.readouterr().out
        with av.open(str(video)) as container:
            pictures = [picture.to_ndarray(format="rgb24") for picture in container.decode(video=0)]
            assert float(container.streams.video[0].average_rate or 0) == 10
        assert len(pictures) == len(written.cameras)
        assert pictures[0].shape == (54, 3 * 64, 3)
        with torch.no_grad():
            expected = final_scene(finished).render(written.cameras[0].resized(64, 53)).rgb[0].clamp(0, 1)
        error = (pictures[0][:53, 64:128] / 255 - expected.numpy()) ** 2
        assert -10 * np.log10(error.mean()) > 28

    def test_virtual_trajectories(self, finished: Finished, tmp_path: Path) -> None:
        from extrags.exploration import Exploration

        target = tmp_path / "path.json"
        assert export(finished, "--to", "camera-path", "--along", "virtual", "-o", str(target)) == 0
        store, outcome = finished
        explored = Store(store).load(Exploration, outcome.refs["explore"])
        assert len(read_camera_path(target).cameras) == len(explored.cameras)

    def test_of_a_run_that_ended_after_the_coarse_scene(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        store = str(tmp_path / "store")
        outcome = run_sequence(
            SEQUENCE, tiny_config(), store, DirectRunner(store), profile="quick", until="coarse"
        )
        ended = store, outcome
        for panels, width in (("coarse", 48), ("coarse,uncertainty", 96)):
            target = tmp_path / f"{width}.mp4"
            assert export(ended, "--to", "video", "--panels", panels, "-o", str(target)) == 0
            with av.open(str(target)) as container:
                assert container.streams.video[0].width == width
        capsys.readouterr()
        # Nothing but the coarse scene is there: what takes it is named.
        assert export(ended, "-o", str(tmp_path / "a.ply")) == 1
        assert "or take its coarse scene, which is there, with --scene coarse" in capsys.readouterr().err
        assert export(ended, "--scene", "coarse", "-o", str(tmp_path / "a.ply")) == 0
        assert export(ended, "--to", "video", "-o", str(tmp_path / "a.mp4")) == 1
        assert "with --panels coarse" in capsys.readouterr().err
        for panels in ("final", "coarse,final", "uncertainty"):
            target = tmp_path / "new" / "folder" / "a.mp4"
            assert export(ended, "--to", "video", "--panels", panels, "-o", str(target)) == 1
            assert "is not finished" in capsys.readouterr().err
            assert not (tmp_path / "new").exists()

    def test_uncertainty_alone(self, finished: Finished, tmp_path: Path) -> None:
        target = tmp_path / "a.mp4"
        assert export(finished, "--to", "video", "--panels", "uncertainty", "-o", str(target)) == 0
        with av.open(str(target)) as container:
            assert container.streams.video[0].width == 48


def test_a_camera_path_in_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    K = np.array([[[40.0, 0, 24], [0, 40.0, 20], [0, 0, 1]]])
    write_camera_path(CameraPath(Cameras(K, np.eye(4)[None], 48, 40)), tmp_path / "path.json")
    target = tmp_path / "copy.json"
    assert main(["export", SEQUENCE, "--along", "~/path.json", "--to", "camera-path", "-o", str(target)]) == 0
    assert len(read_camera_path(target).cameras) == 1


class TestCameras:
    def test_pycolmap_projects_as_we_do(self, finished: Finished, tmp_path: Path) -> None:
        assert export(finished, "--to", "colmap", "-o", str(tmp_path / "scene")) == 0
        given = frames(finished)
        model = pycolmap.Reconstruction(str(tmp_path / "scene" / "sparse" / "0"))
        assert len(model.images) == len(given)
        assert len(model.points3D) > 100
        point = given.cameras.centers.mean(axis=0) + 10 * given.cameras.forward.mean(axis=0)
        ours = given.cameras.project(point[None])[0][:, 0]
        found = 0
        for image in model.images.values():
            theirs = image.project_point(point)
            if theirs is not None:
                nearest = np.nanmin(np.abs(ours - theirs).max(axis=1))
                assert nearest < 1e-6
                found += 1
        assert found > 3

    def test_transforms(self, finished: Finished, tmp_path: Path) -> None:
        assert export(finished, "--to", "transforms", "-o", str(tmp_path / "new" / "scene")) == 0
        (tmp_path / "new" / "scene").rename(tmp_path / "scene")
        given = frames(finished)
        content = json.loads((tmp_path / "scene" / "transforms.json").read_text())
        centers = np.array([np.array(frame["transform_matrix"])[:3, 3] for frame in content["frames"]])
        apart = np.linalg.norm(centers[:, None] - given.cameras.centers[None], axis=-1)
        assert len(centers) == len(given)
        assert float(apart.min(axis=1).max()) < 1e-6


class TestUsage:
    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["--to", "spz", "-o", "a.ply"], "must end in .spz"),
            (["--to", "ply", "-o", "a.glb"], "must end in .ply (--to ply)"),
            (["-o", "a.stl"], "must end in one of .ply, .spz, .sog, .glb, .obj, .json, .mp4; a folder needs"),
            (["-o", "a"], "a folder needs one of --to colmap, colmap-text, transforms"),
            (
                ["--to", "transforms", "-o", "/dev/null/a"],
                "cannot be written: nothing can be made in /dev/null",
            ),
            (["--to", "mesh", "-o", "a.stl"], "must end in .glb or .obj or .ply"),
            (["--to", "video", "-o", "a.avi"], "must end in .mp4"),
            (["--to", "spz", "--between", "3", "-o", "a.spz"], "--between does not apply to --to spz"),
            (["--to", "points", "--no-texture", "-o", "a.ply"], "--no-texture does not apply"),
            (["--to", "colmap", "--light", "kept", "-o", "a"], "--light does not apply to --to colmap"),
            (["--to", "sog", "--light", "kept", "-o", "a.sog"], "no place for a light"),
            (["--light", "kept", "--exposure", "2", "-o", "a.ply"], "bakes nothing"),
            (["--distance", "3", "-o", "a.ply"], "--light frontal"),
            (["--light", "frontal", "--distance", "0", "-o", "a.ply"], "--distance is 0"),
            (["--exposure", "nan", "-o", "a.ply"], "--exposure is nan"),
            (["--to", "points", "--min-opacity", "1", "-o", "a.ply"], "--min-opacity is 1"),
            (["--to", "video", "--panels", "fine", "-o", "a.mp4"], "no panel 'fine'"),
            (["--to", "video", "--panels", "final,coarse,final", "-o", "a.mp4"], "final is named twice"),
            (["--to", "video", "--fps", "0", "-o", "a.mp4"], "--fps is 0"),
            (["--to", "video", "--width", "3", "-o", "a.mp4"], "--width is 3"),
            (["--to", "video", "--between", "0", "-o", "a.mp4"], "--between is 0"),
            (["--method", "uc-nerf", "-o", "a.ply"], "makes no Gaussians"),
            (["-o", "."], "is a folder"),
        ],
    )
    def test_wrong_usage_is_said_at_once(
        self, arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["export", SEQUENCE, "--store", str(tmp_path / "store"), *arguments]) == 2
        said = capsys.readouterr().err
        assert message in said
        assert said.count("\n") == 1

    @pytest.mark.parametrize(
        ("along", "message"),
        [
            ("sideways", "expected training, held-out, virtual or a FILE.json"),
            ("no.json", "--along no.json: there is no such file; expected training"),
        ],
    )
    def test_a_trajectory_that_is_not_there(
        self,
        along: str,
        message: str,
        finished: Finished,
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        target = tmp_path / "a.json"
        assert export(finished, "--to", "camera-path", "--along", along, "-o", str(target)) == 2
        assert message in capsys.readouterr().err
        assert not target.exists()

    def test_folders_are_made_for_what_is_written_alone(
        self, finished: Finished, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        target = tmp_path / "there" / "new" / "a.json"
        target.parents[1].mkdir()
        arguments = ["--to", "camera-path", "-o", str(target)]
        path = tmp_path / "path.json"
        path.write_text("{")
        assert export(finished, *arguments, "--along", str(path)) == 1
        # It is said of the file that is wrong, not of the one that was to be written.
        said = capsys.readouterr().err
        assert "path.json" in said
        assert "cannot be written" not in said
        assert target.parents[1].is_dir()
        assert not target.parent.exists()
        assert export(finished, *arguments) == 0
        assert target.is_file()

    def test_a_sequence_that_is_interrupted_leaves_nothing(
        self, finished: Finished, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        from data_catalog.readers import transforms_json

        def interrupted(file: Path, *_: object) -> None:
            assert file.parent.is_dir()
            raise KeyboardInterrupt

        monkeypatch.setattr(transforms_json, "write_ply_points", interrupted)
        with pytest.raises(KeyboardInterrupt):
            export(finished, "--to", "transforms", "-o", str(tmp_path / "new" / "scene"))
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize(
        ("name", "what"), [("a.glb", "mesh"), ("b.OBJ", "mesh"), ("c.json", "camera-path")]
    )
    def test_the_name_says_what_is_written(
        self, name: str, what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        asked = []
        monkeypatch.setattr(export_scene, "export_scene", lambda given: asked.append(given.to) or 0)
        assert main(["export", SEQUENCE, "--store", str(tmp_path), "-o", str(tmp_path / name)]) == 0
        assert asked == [what]

    def test_a_folder_that_cannot_be_written(
        self, finished: Finished, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (tmp_path / "file").write_text("x")
        assert export(finished, "--to", "points", "-o", str(tmp_path / "file" / "a.ply")) == 2
        assert "cannot be written" in capsys.readouterr().err
