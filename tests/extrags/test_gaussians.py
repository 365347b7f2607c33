from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData

from extrags.errors import CaptureError, NonFiniteError, ShapeError, SourceError, SourceNotFoundError
from extrags.gaussians import SH_C0, Gaussians


def random_gaussians(n: int, degree: int, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        normal(n, 3), normal(n, 4), normal(n, 3), normal(n), normal(n, 1, 3),
        normal(n, (degree + 1) ** 2 - 1, 3),
    )  # fmt: skip


def assert_equal(first: Gaussians, second: Gaussians) -> None:
    for name, value in first.parameters().items():
        assert torch.equal(value, second.parameters()[name]), name


class TestGaussians:
    @settings(max_examples=20, deadline=None)
    @given(n=st.integers(1, 40), degree=st.integers(0, 3), seed=st.integers(0, 1000))
    def test_ply_round_trip_is_exact(
        self, tmp_path_factory: pytest.TempPathFactory, n: int, degree: int, seed: int
    ) -> None:
        path = tmp_path_factory.mktemp("ply") / "scene.ply"
        gaussians = random_gaussians(n, degree, seed)
        gaussians.write_ply(path)
        assert_equal(Gaussians.read_ply(path), gaussians)

    def test_ply_has_the_standard_fields_in_the_standard_order(self, tmp_path: Path) -> None:
        random_gaussians(3, 3).write_ply(tmp_path / "scene.ply")
        names = PlyData.read(str(tmp_path / "scene.ply"))["vertex"].data.dtype.names
        assert names == (
            "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2",
            *(f"f_rest_{i}" for i in range(45)), "opacity", "scale_0", "scale_1", "scale_2",
            "rot_0", "rot_1", "rot_2", "rot_3",
        )  # fmt: skip

    def test_ply_keeps_colours_of_a_coefficient_apart(self, tmp_path: Path) -> None:
        gaussians = random_gaussians(2, 1)
        gaussians.write_ply(tmp_path / "scene.ply")
        vertex = PlyData.read(str(tmp_path / "scene.ply"))["vertex"].data
        # 3DGS writes all coefficients of red, then green, then blue.
        assert vertex["f_rest_1"][0] == pytest.approx(float(gaussians.shN[0, 1, 0]))
        assert vertex["f_rest_3"][0] == pytest.approx(float(gaussians.shN[0, 0, 1]))

    def test_zarr_round_trip(self, tmp_path: Path) -> None:
        for degree in (0, 2):
            gaussians = random_gaussians(7, degree)
            gaussians.save(tmp_path / str(degree))
            loaded = Gaussians.load(tmp_path / str(degree))
            assert_equal(loaded, gaussians)
            assert loaded.sh_degree == degree

    def test_from_points_shows_the_colours(self) -> None:
        rgb = np.array([[0.2, 0.5, 0.9]])
        gaussians = Gaussians.from_points(np.zeros((1, 3)), rgb, np.array([2.0]), opacity=0.25)
        shown = SH_C0 * gaussians.sh0[0, 0] + 0.5
        torch.testing.assert_close(shown, torch.tensor(rgb[0], dtype=torch.float32))
        torch.testing.assert_close(gaussians.scales.exp(), torch.full((1, 3), 2.0))
        assert float(gaussians.opacities.sigmoid()) == pytest.approx(0.25)

    def test_subset_and_concatenated(self) -> None:
        gaussians = random_gaussians(6, 1)
        keep = torch.tensor([True, False, True, True, False, False])
        joined = Gaussians.concatenated(gaussians.subset(keep), gaussians.subset(~keep))
        assert len(joined) == 6
        assert torch.equal(joined.means[:3], gaussians.means[keep])

    @pytest.mark.usefixtures("unchecked")
    def test_wrong_shapes_are_refused(self) -> None:
        good = random_gaussians(3, 1).parameters()
        with pytest.raises(ShapeError, match="quats"):
            Gaussians(**{**good, "quats": good["quats"][:2]})

    @pytest.mark.parametrize("count", [1, 2, 4, 24])
    def test_coefficients_of_no_degree_are_refused(self, count: int) -> None:
        good = random_gaussians(3, 0).parameters()
        with pytest.raises(ShapeError, match=f"shN has {count} coefficients per colour"):
            Gaussians(**{**good, "shN": torch.zeros(3, count, 3)})

    def test_a_ply_without_gaussians_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(CaptureError, match=r"no Gaussians to write into .*a\.ply"):
            random_gaussians(0, 1).write_ply(tmp_path / "a.ply")
        assert not (tmp_path / "a.ply").exists()

    @pytest.mark.parametrize("value", [float("nan"), float("-inf")])
    @pytest.mark.parametrize("name", ["means", "opacities", "shN"])
    def test_numbers_that_readers_refuse_are_not_written(
        self, name: str, value: float, tmp_path: Path
    ) -> None:
        gaussians = random_gaussians(5, 1)
        gaussians.parameters()[name][2:4] = value
        with pytest.raises(NonFiniteError, match=rf"{name} of 2 of 5 Gaussians hold NaN .*a\.ply is not"):
            gaussians.write_ply(tmp_path / "a.ply")
        assert not (tmp_path / "a.ply").exists()

    def test_ply_of_gaussians_elsewhere(self, tmp_path: Path, elsewhere: torch.device) -> None:
        gaussians = random_gaussians(5, 2)
        gaussians.to(elsewhere).write_ply(tmp_path / "a.ply")
        assert_equal(Gaussians.read_ply(tmp_path / "a.ply"), gaussians)

    def test_ply_errors(self, tmp_path: Path) -> None:
        with pytest.raises(SourceNotFoundError):
            Gaussians.read_ply(tmp_path / "none.ply")
        with pytest.raises(SourceError, match=r"cannot be read: Is a directory$"):
            Gaussians.read_ply(tmp_path)
        (tmp_path / "points.ply").write_text(
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
            "property float z\nend_header\n0 0 0\n"
        )
        with pytest.raises(SourceError, match="field opacity"):
            Gaussians.read_ply(tmp_path / "points.ply")
