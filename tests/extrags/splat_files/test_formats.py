"""What other programs make of the files: decoded from the formats' definitions, and rendered."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from extrags.cameras import Cameras
from extrags.errors import CaptureError, SourceError
from extrags.gaussians import SH_C0, Gaussians
from extrags.scene import Scene
from extrags.splat_files import (
    bake_light,
    read_splat_file,
    sog,
    write_compressed_ply,
    write_ply_scene,
    write_sog,
    write_spz,
)
from tests.extrags.splat_files import decoders
from tests.extrags.splat_files.conftest import psnr

Writer = Callable[[Gaussians, Path], None]


def write_ply(gaussians: Gaussians, path: Path) -> None:
    write_ply_scene(Scene(gaussians), path)


FORMATS = [
    # Lossless, except that files hold float32 as we do.
    pytest.param(write_ply, decoders.ply, "scene.ply", 120.0, id="ply"),
    pytest.param(
        write_compressed_ply, decoders.compressed_ply, "scene.compressed.ply", 40.0, id="compressed"
    ),
    # Harmonics above degree 1 have steps of 1/8, here beside noise of 1/20.
    pytest.param(write_spz, decoders.spz, "scene.spz", 38.0, id="spz"),
    # Its palette has half as many entries as there are Gaussians, and here harmonics are noise.
    pytest.param(write_sog, decoders.sog, "scene.sog", 40.0, id="sog"),
]
"""Writer, reader, name, and how well renderings agree at least, in dB."""


@pytest.fixture(scope="module")
def baked(lit: Scene) -> Gaussians:
    return bake_light(lit)


@pytest.mark.parametrize(("write", "read", "name", "least_db"), FORMATS)
def test_another_reader_renders_the_same_picture(
    write: Writer,
    read: Callable[[Path], Gaussians],
    name: str,
    least_db: float,
    baked: Gaussians,
    views: Cameras,
    tmp_path: Path,
) -> None:
    write(baked, tmp_path / name)
    back = read(tmp_path / name)
    assert len(back) == len(baked)
    assert back.sh_degree == baked.sh_degree
    assert psnr(Scene(back), Scene(baked), views) > least_db


@pytest.mark.parametrize(("write", "read", "name", "least_db"), FORMATS)
def test_the_same_scene_gives_the_same_file(
    write: Writer, read: object, name: str, least_db: float, baked: Gaussians, tmp_path: Path
) -> None:
    few = baked.subset(torch.arange(400))
    write(few, tmp_path / name)
    first = (tmp_path / name).read_bytes()
    write(few, tmp_path / name)
    assert (tmp_path / name).read_bytes() == first


@pytest.mark.parametrize(("write", "read", "name", "least_db"), FORMATS)
@pytest.mark.parametrize("count", [1, 2, 257])
def test_few_gaussians(
    write: Writer,
    read: Callable[[Path], Gaussians],
    name: str,
    least_db: float,
    count: int,
    baked: Gaussians,
    tmp_path: Path,
) -> None:
    """One chunk and a bit, one row of an image, bounds of no extent."""
    few = baked.subset(torch.arange(count))
    write(few, tmp_path / name)
    back = read(tmp_path / name)
    assert len(back) == count
    # Some formats reorder.
    distance, nearest = torch.cdist(back.means, few.means).min(dim=1)
    assert float(distance.max()) < 0.05
    assert len(set(nearest.tolist())) == count
    assert torch.allclose(back.scales, few.scales[nearest], atol=0.05)


@pytest.mark.parametrize(("write", "read", "name", "least_db"), FORMATS)
def test_a_rotation_of_length_zero_is_none(
    write: Writer,
    read: Callable[[Path], Gaussians],
    name: str,
    least_db: float,
    baked: Gaussians,
    tmp_path: Path,
) -> None:
    one = baked.subset(torch.arange(1))
    write(replace(one, quats=torch.zeros(1, 4)), tmp_path / name)
    assert read(tmp_path / name).quats[0].abs().tolist() == pytest.approx([1, 0, 0, 0], abs=0.01)


@pytest.mark.parametrize(("write", "read", "name", "least_db"), FORMATS)
def test_no_gaussians(
    write: Writer, read: object, name: str, least_db: float, baked: Gaussians, tmp_path: Path
) -> None:
    with pytest.raises(CaptureError, match="there are no Gaussians to write"):
        write(baked.subset(torch.arange(0)), tmp_path / name)
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize(("write", "read", "name", "least_db"), FORMATS)
def test_gaussians_elsewhere(
    write: Writer,
    read: object,
    name: str,
    least_db: float,
    baked: Gaussians,
    elsewhere: torch.device,
    tmp_path: Path,
) -> None:
    few = baked.subset(torch.arange(400))
    here, there = tmp_path / name, tmp_path / f"there_{name}"
    write(few, here)
    write(few.to(elsewhere), there)
    assert here.read_bytes() == there.read_bytes()


@pytest.mark.parametrize(("factor", "kind"), [(1e5, "larger"), (1e-6, "smaller")])
def test_spz_refuses_sizes_that_it_has_not(
    factor: float, kind: str, baked: Gaussians, tmp_path: Path
) -> None:
    values = baked.parameters()
    values["scales"] = values["scales"] + math.log(factor)
    with pytest.raises(SourceError, match=f"100 % of the Gaussians are {kind} than SPZ can hold"):
        write_spz(Gaussians(**values), tmp_path / "a.spz")
    # One alone does no harm, and the thinnest axis may be thinner.
    values = baked.parameters()
    values["scales"] = values["scales"].clone()
    values["scales"][0] = values["scales"][0] + math.log(factor)
    values["scales"].scatter_(1, values["scales"].argmin(dim=1, keepdim=True), -14.0)
    write_spz(Gaussians(**values), tmp_path / "a.spz")


def test_what_spz_holds(baked: Gaussians, tmp_path: Path) -> None:
    """The bounds and steps that docs/export.md names."""
    many = torch.linspace(-5, 5, 400)
    values = baked.subset(torch.arange(400)).parameters()
    values["sh0"] = many[:, None, None].expand(-1, 1, 3)
    values["shN"] = many[:, None, None].expand(-1, 8, 3) / 3
    write_spz(Gaussians(**values), tmp_path / "a.spz")
    back = decoders.spz(tmp_path / "a.spz")
    colors = 0.5 + SH_C0 * back.sh0
    assert (float(colors.min()), float(colors.max())) == pytest.approx((-0.44, 1.44), abs=0.005)
    # Two that the half turn between the format's axes and ours leaves as they are.
    for coefficient, step in ((2, 1 / 16), (4, 1 / 8)):
        levels = back.shN[:, coefficient].unique()
        assert (float(levels[0]), float(levels[-1])) == (-1, 127 / 128)
        # The last step is cut off by the bound.
        assert levels.diff()[:-1].unique().tolist() == [step]


def _traced_share(write: Callable[[], None], gaussians: Gaussians) -> float:
    """Most memory of arrays that writing takes, relative to that of the scene."""
    write()
    tracemalloc.start()
    try:
        write()
        return tracemalloc.get_traced_memory()[1] / sum(v.nbytes for v in gaussians.parameters().values())
    finally:
        tracemalloc.stop()


def test_memory_of_writing(lit: Scene, tmp_path: Path) -> None:
    """Harmonics are most of a scene; in double precision they take several times as much as all of it."""
    values = lit.gaussians.subset(torch.arange(400).repeat(50)).parameters()
    values["shN"] = torch.cat([values["shN"], values["shN"][:, :7]], dim=1)
    many = Gaussians(**values)
    assert _traced_share(lambda: write_spz(many, tmp_path / "a.spz"), many) < 5
    plain = _traced_share(lambda: write_ply_scene(Scene(many), tmp_path / "a.ply"), many)
    kept = _traced_share(lambda: write_ply_scene(Scene(many, lit.light), tmp_path / "a.ply"), many)
    assert kept < 1.05 * plain


def test_a_palette_of_many_entries_is_not_compared_with_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor is it much worse for that: here than with every vector's nearest entry."""
    generator = torch.Generator().manual_seed(5)
    mixing = torch.randn(6, 45, generator=generator)
    vectors = torch.randn(6000, 6, generator=generator) @ mixing
    vectors = (vectors + 0.3 * torch.randn(6000, 45, generator=generator)).numpy()
    compared = 0
    original = sog._nearest_of_all

    def counted(rows: np.ndarray, centers: np.ndarray) -> np.ndarray:
        nonlocal compared
        compared += len(rows) * len(centers)
        return original(rows, centers)

    monkeypatch.setattr(sog, "_nearest_of_all", counted)
    palette, labels = sog._palette(vectors)
    assert len(palette) == 3000
    assert compared < 0.5 * 5 * len(vectors) * len(palette)
    error = np.sqrt(((vectors - palette[labels]) ** 2).mean())
    least = np.sqrt((cKDTree(palette).query(vectors)[0] ** 2).mean() / 45)
    assert error < 1.05 * least


@pytest.mark.slow
@pytest.mark.parametrize(("write", "read", "name", "least_db"), FORMATS)
def test_splat_transform_renders_the_same_picture(
    write: Writer,
    read: object,
    name: str,
    least_db: float,
    baked: Gaussians,
    views: Cameras,
    tmp_path: Path,
) -> None:
    """PlayCanvas's own converter reads the file and writes a plain PLY."""
    command = os.environ.get("EXTRAGS_SPLAT_TRANSFORM") or shutil.which("splat-transform")
    if command is None or shutil.which("node") is None:
        pytest.skip(
            "node and splat-transform are not there (npm install -g @playcanvas/splat-transform@1.10.1, or "
            "its cli.mjs in EXTRAGS_SPLAT_TRANSFORM)"
        )
    write(baked, tmp_path / name)
    back = tmp_path / "back.ply"
    said = subprocess.run(
        ["node", command, "-w", "-q", str(tmp_path / name), str(back)], capture_output=True, text=True
    )
    assert said.returncode == 0, said.stderr
    read_back = decoders.ply(back)
    if name.endswith(".spz"):
        # It keeps the axes of SPZ, right, up, back; the picture is compared in ours.
        read_back = _turned(read_back)
    assert psnr(Scene(read_back), Scene(baked), views) > least_db


def _turned(gaussians: Gaussians) -> Gaussians:
    """Half a turn about x; harmonics change their sign as their polynomials in y and z do."""
    odd = torch.tensor([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1.0])
    values = gaussians.parameters()
    values["means"] = values["means"] * torch.tensor([1.0, -1, -1])
    values["quats"] = values["quats"] * torch.tensor([1.0, 1, -1, -1])
    values["shN"] = values["shN"] * odd[: values["shN"].shape[1], None]
    return Gaussians(**values)


@pytest.mark.parametrize(("write", "name"), [(write_ply, "scene.ply"), (write_spz, "scene.spz")])
def test_what_is_written_is_read_by_its_content(
    write: Writer, name: str, baked: Gaussians, views: Cameras, tmp_path: Path
) -> None:
    """The name of a file says nothing: downloads are often renamed."""
    write(baked, tmp_path / "download")
    assert psnr(read_splat_file(tmp_path / "download"), Scene(baked), views) > 38
