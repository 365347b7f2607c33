from __future__ import annotations

import os
import stat
import sys
from pathlib import Path
from types import FrameType

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from extrags.array_files import load_npz, load_ply_vertices, load_safetensors, save_npy, save_safetensors


def test_tensors_of_any_layout_come_back(tmp_path: Path) -> None:
    values = torch.arange(6.0).reshape(2, 3)
    save_safetensors(tmp_path / "new" / "x.safetensors", {"turned": values.T, "half": values.half()})
    found = load_safetensors(tmp_path / "new" / "x.safetensors")
    assert torch.equal(found["turned"], values.T)
    assert found["half"].dtype == torch.float16


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_is_said_as_the_system_says_it(tmp_path: Path) -> None:
    (tmp_path / "depth.npy").symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left on device"):
        save_npy(tmp_path / "depth.npy", np.zeros((128, 160)))


@pytest.mark.parametrize("umask", [0o022, 0o007])
def test_others_may_read_it_as_the_umask_says(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        save_safetensors(tmp_path / "x.safetensors", {"a": torch.ones(3)})
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "x.safetensors").stat().st_mode) == 0o666 & ~umask


def test_a_write_that_fails_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "x.safetensors"
    save_safetensors(file, {"a": torch.ones(3)})

    def full(tensors: dict[str, torch.Tensor], name: str, metadata: dict[str, str] | None) -> None:
        Path(name).write_bytes(b"half of it")
        raise OSError("no space left on device")

    monkeypatch.setattr("safetensors.torch.save_file", full)
    with pytest.raises(OSError, match="no space left"):
        save_safetensors(file, {"a": torch.zeros(3)})
    assert torch.equal(load_safetensors(file)["a"], torch.ones(3))


def test_vertices_are_not_read_number_by_number(tmp_path: Path) -> None:
    """A file of a million Gaussians has sixty million."""
    rows = np.zeros(2000, dtype=[(name, "f4") for name in "xyz"])
    rows["y"] = np.arange(len(rows))
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "a.ply"))
    calls = 0

    def count(frame: FrameType, event: str, argument: object) -> None:
        nonlocal calls
        calls += event == "call"

    before = sys.getprofile()
    sys.setprofile(count)
    try:
        found = load_ply_vertices(tmp_path / "a.ply")
    finally:
        sys.setprofile(before)
    assert calls < len(rows)
    # Of its own: the file may change or go.
    assert found.flags.owndata
    assert np.array_equal(found["y"], rows["y"])


def test_a_ply_whose_negative_count_hides_a_large_one(tmp_path: Path) -> None:
    head = "element vertex 3000000000\nproperty float x\nelement face -2999999999\nproperty float y\n"
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\n{head}end_header\n0\n")
    with pytest.raises(ValueError, match=r"^-2999999999 elements announced"):
        load_ply_vertices(tmp_path / "a.ply")


def test_an_archive_that_would_fill_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "a.npz"
    np.savez_compressed(file, a=np.zeros((1000, 1000)))
    assert load_npz(file)["a"].shape == (1000, 1000)
    monkeypatch.setattr("extrags.array_files._MOST_UNPACKED_BYTES", 1 << 20)
    with pytest.raises(ValueError, match=r"\d+ bytes that unpack to 8000128: made to fill the memory"):
        load_npz(file)
    # Numbers that say something are never packed as densely.
    np.savez_compressed(file, a=np.arange(1e6).reshape(1000, 1000))
    assert load_npz(file)["a"][-1, -1] == 999_999
