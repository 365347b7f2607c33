"""A PLY that keeps the light in its header."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import open3d
import pytest
import torch
from plyfile import PlyData

from extrags.cameras import Cameras
from extrags.errors import SourceError, SourceNotFoundError
from extrags.scene import Scene
from extrags.splat_files import read_ply_scene, read_splat_file, write_ply_scene
from tests.extrags.splat_files.conftest import psnr


@pytest.fixture(scope="module")
def lit(lit: Scene) -> Scene:
    """A few Gaussians are enough."""
    return Scene(lit.gaussians.subset(torch.arange(0, 5000, 25).clamp_max(len(lit.gaussians) - 1)), lit.light)


def changed(path: Path, **values: object) -> None:
    """Other numbers in the light of a file; None takes one away."""
    mark = b"comment extrags_light "
    head, *parts = path.read_bytes().split(mark)
    last, end, body = parts.pop().partition(b"\n")
    light = {**json.loads(b"".join([*(part.rstrip(b"\n") for part in parts), last])), **values}
    light = {name: value for name, value in light.items() if value is not None}
    # In one line, as files had it before.
    path.write_bytes(head + mark + json.dumps(light).encode() + end + body)


class TestLight:
    def test_it_comes_back(self, lit: Scene, views: Cameras, tmp_path: Path) -> None:
        write_ply_scene(lit, tmp_path / "a.ply")
        back = read_ply_scene(tmp_path / "a.ply")
        assert lit.light is not None
        assert back.light is not None
        for name, value in lit.light.parameters().items():
            assert torch.allclose(back.light.parameters()[name], value, rtol=1e-6), name
        assert back.light.reference_distance == lit.light.reference_distance
        assert psnr(back, lit, views) > 100

    def test_lines_of_the_header_are_short_however_many_frames_there_are(
        self, lit: Scene, tmp_path: Path
    ) -> None:
        """Readers keep a line in a buffer of about a thousand bytes."""
        assert lit.light is not None
        exposures = torch.linspace(-1, 1, 500)
        write_ply_scene(Scene(lit.gaussians, replace(lit.light, log_exposure=exposures)), tmp_path / "a.ply")
        header = (tmp_path / "a.ply").read_bytes().partition(b"end_header")[0]
        assert max(len(line) for line in header.splitlines()) < 256
        back = read_ply_scene(tmp_path / "a.ply").light
        assert back is not None
        torch.testing.assert_close(back.log_exposure, exposures)
        cloud = open3d.io.read_point_cloud(str(tmp_path / "a.ply"))
        assert len(cloud.points) == len(lit.gaussians)

    def test_a_file_with_all_of_it_in_one_line_is_read(self, lit: Scene, tmp_path: Path) -> None:
        write_ply_scene(lit, tmp_path / "a.ply")
        changed(tmp_path / "a.ply")
        assert (tmp_path / "a.ply").read_bytes().count(b"extrags_light") == 1
        assert read_ply_scene(tmp_path / "a.ply").light is not None

    def test_other_programs_pass_over_it(self, lit: Scene, tmp_path: Path) -> None:
        write_ply_scene(lit, tmp_path / "a.ply")
        vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
        assert torch.equal(torch.from_numpy(vertex["f_dc_1"].copy()), lit.gaussians.sh0[:, 0, 1])

    @pytest.mark.parametrize("name", ["log_shoulder", "log_exponent", "log_specular", "log_glare"])
    def test_what_is_zero_has_no_logarithm_that_json_can_say(
        self, name: str, lit: Scene, tmp_path: Path
    ) -> None:
        """A linear response, a light without fall-off, a surface without highlights, a clean lens."""
        assert lit.light is not None
        none = torch.full_like(lit.light.parameters()[name], -torch.inf)
        without = replace(lit.light, **{name: none})
        write_ply_scene(Scene(lit.gaussians, without), tmp_path / "a.ply")
        back = read_ply_scene(tmp_path / "a.ply")
        assert back.light is not None
        assert torch.equal(back.light.parameters()[name], none)

    def test_the_logarithm_of_the_exponent_in_files_of_before_is_read(
        self, lit: Scene, tmp_path: Path
    ) -> None:
        write_ply_scene(lit, tmp_path / "a.ply")
        changed(tmp_path / "a.ply", exponent=None, log_exponent=-0.5)
        back = read_ply_scene(tmp_path / "a.ply").light
        assert back is not None
        assert float(back.log_exponent) == pytest.approx(-0.5, rel=1e-6)

    def test_highlights(self, lit: Scene, tmp_path: Path) -> None:
        assert lit.light is not None
        shiny = replace(lit.light, log_specular=torch.tensor(-1.5), log_roughness=torch.tensor(-2.0))
        write_ply_scene(Scene(lit.gaussians, shiny), tmp_path / "a.ply")
        back = read_ply_scene(tmp_path / "a.ply").light
        assert back is not None
        assert float(back.log_specular) == pytest.approx(-1.5, rel=1e-6)
        assert float(back.log_roughness) == -2.0

    def test_glare(self, lit: Scene, tmp_path: Path) -> None:
        assert lit.light is not None
        glare = torch.tensor([-2.5, -3.0, -torch.inf])
        write_ply_scene(Scene(lit.gaussians, replace(lit.light, log_glare=glare)), tmp_path / "a.ply")
        back = read_ply_scene(tmp_path / "a.ply").light
        assert back is not None
        torch.testing.assert_close(back.log_glare, glare)

    def test_files_of_before_there_were_highlights_or_glare_have_none(
        self, lit: Scene, tmp_path: Path
    ) -> None:
        write_ply_scene(lit, tmp_path / "a.ply")
        changed(tmp_path / "a.ply", specular=None, log_roughness=None, glare=None)
        assert b"specular" not in (tmp_path / "a.ply").read_bytes()
        back = read_ply_scene(tmp_path / "a.ply").light
        assert back is not None
        assert float(back.log_specular) == -torch.inf
        assert bool((back.log_glare == -torch.inf).all())

    def test_without_light_the_header_says_nothing(self, lit: Scene, tmp_path: Path) -> None:
        write_ply_scene(Scene(lit.gaussians), tmp_path / "a.ply")
        assert b"extrags_light" not in (tmp_path / "a.ply").read_bytes()
        assert read_ply_scene(tmp_path / "a.ply").light is None

    @pytest.mark.parametrize(
        ("name", "value", "message"),
        [
            ("offset", [1.0, 2.0], "extrags_light.offset"),
            ("log_softening", [1.0], "extrags_light.log_softening"),
            ("log_exponent", 1e400, "extrags_light"),
            ("reference_distance", 0.0, "reference_distance"),
            ("reference_distance", "far", "extrags_light"),
            ("colour", 1.0, "extrags_light"),
            ("specular", float("inf"), "extrags_light.specular"),
            ("specular", -0.1, "extrags_light.specular"),
            ("glare", 0.1, "extrags_light.glare"),
            ("glare", [0.1, 0.0, -0.1], "extrags_light.glare"),
            ("glare", [0.1, 0.0, 1.5], "extrags_light.glare"),
        ],
    )
    def test_a_wrong_light_is_refused(
        self, name: str, value: object, message: str, lit: Scene, tmp_path: Path
    ) -> None:
        write_ply_scene(lit, tmp_path / "a.ply")
        changed(tmp_path / "a.ply", **{name: value})
        with pytest.raises(SourceError, match=message):
            read_ply_scene(tmp_path / "a.ply")

    def test_a_header_that_is_no_json(self, lit: Scene, tmp_path: Path) -> None:
        write_ply_scene(lit, tmp_path / "a.ply")
        whole = (tmp_path / "a.ply").read_bytes()
        (tmp_path / "a.ply").write_bytes(whole.replace(b"extrags_light {", b"extrags_light [", 1))
        with pytest.raises(SourceError, match="cannot be read"):
            read_ply_scene(tmp_path / "a.ply")

    def test_a_rotation_of_length_zero_is_written_as_none(
        self, lit: Scene, views: Cameras, tmp_path: Path
    ) -> None:
        quats = lit.gaussians.quats.clone()
        quats[3] = 0
        for light in (lit.light, None):
            given = Scene(replace(lit.gaussians, quats=quats), light)
            write_ply_scene(given, tmp_path / "a.ply")
            back = read_splat_file(tmp_path / "a.ply")
            assert back.gaussians.quats[3].tolist() == [1, 0, 0, 0]
            assert torch.equal(back.gaussians.quats[4:], quats[4:])
            assert psnr(back, given, views) > 100

    def test_no_file(self, tmp_path: Path) -> None:
        with pytest.raises(SourceNotFoundError):
            read_ply_scene(tmp_path / "none.ply")
