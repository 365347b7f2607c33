"""File names and keys from outside never lead out of their folder."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import data_catalog
from data_catalog.inside import inside
from data_catalog.readers.colmap_files import read_model, write_model
from data_catalog.readers.colmap_model import write_colmap
from data_catalog.readers.transforms_json import write_transforms
from extrags.errors import DamagedArtefactError, ExtragsError, SourceError, StoreError
from extrags.sequence import EndoscopicSequence, Split
from extrags.store import Ref, Store
from extrags.store.manifest import Manifest, manifest_text

ESCAPES = ("../secret.png", "images/../../secret.png", "/etc/passwd", "a/\0b.png", "", "x" * 5000, "x" * 300)


def small_sequence(names: tuple[str, ...] = ("0", "1", "2")) -> EndoscopicSequence:
    count = len(names)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count)
    rgb = np.random.default_rng(0).integers(40, 200, (count, 32, 40, 3), dtype=np.uint8)
    return EndoscopicSequence(
        name="small",
        rgb=rgb,
        K=np.tile(np.array([[30.0, 0, 20], [0, 30, 16], [0, 0, 1]]), (count, 1, 1)),
        mask=np.ones((count, 32, 40), dtype=bool),
        split=Split("all", np.arange(1, count), np.arange(1)),
        world_from_camera=poses,
        frame_names=names,
    )


def write_posed(folder: Path) -> None:
    sequence = small_sequence()
    (folder / "rgb").mkdir(parents=True)
    frames = []
    for k in range(len(sequence)):
        Image.fromarray(sequence.rgb[k]).save(folder / "rgb" / f"{k}.png")
        frames.append({"file": f"rgb/{k}.png", "world_from_camera": np.eye(4).tolist()})
    (folder / "poses.json").write_text(json.dumps({"K": sequence.K[0].tolist(), "frames": frames}))


def edit(file: Path, change: Callable[[dict[str, Any]], None]) -> None:
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def spoil_posed(folder: Path, name: str) -> None:
    write_posed(folder)
    edit(folder / "poses.json", lambda content: content["frames"][1].update(file=name))


def spoil_transforms(key: str) -> Callable[[Path, str], None]:
    def spoil(folder: Path, name: str) -> None:
        write_transforms(small_sequence(), folder)
        edit(folder / "transforms.json", lambda content: content["frames"][1].update({key: name}))
        # The split names frames, too.
        lists: dict[str, list[str]] = {f"{part}_filenames": [] for part in ("train", "test", "val")}
        edit(folder / "transforms.json", lambda content: content.update(lists))

    return spoil


def spoil_points(folder: Path, name: str) -> None:
    write_transforms(small_sequence(), folder)
    edit(folder / "transforms.json", lambda content: content.update(ply_file_path=name))


def spoil_colmap(*, binary: bool) -> Callable[[Path, str], None]:
    def spoil(folder: Path, name: str) -> None:
        write_colmap(small_sequence(), folder)
        place = folder / "sparse" / "0"
        model = read_model(place)
        images = [model.images[0], replace(model.images[1], name=name.replace("\0", "")), model.images[2]]
        shutil.rmtree(place)
        write_model(replace(model, images=images), place, binary=binary)

    return spoil


SPOILT = {
    "poses.json": spoil_posed,
    "file_path": spoil_transforms("file_path"),
    "mask_path": spoil_transforms("mask_path"),
    "depth_file_path": spoil_transforms("depth_file_path"),
    "ply_file_path": spoil_points,
    "images.bin": spoil_colmap(binary=True),
    "images.txt": spoil_colmap(binary=False),
}


@pytest.mark.parametrize("layout", SPOILT)
@pytest.mark.parametrize("name", ESCAPES, ids=range(len(ESCAPES)))
def test_a_name_that_leads_out_is_refused(layout: str, name: str, tmp_path: Path) -> None:
    if "\0" in name and layout.startswith("images."):
        pytest.skip("COLMAP's formats cannot hold such a name")
    folder = tmp_path / "source"
    SPOILT[layout](folder, name)
    Image.fromarray(np.full((32, 40, 3), 90, np.uint8)).save(tmp_path / "secret.png")
    with pytest.raises(SourceError) as refused:
        data_catalog.read(str(folder))
    if name.startswith(("..", "images/..", "/")):
        assert "leads out of the folder" in str(refused.value)


@pytest.mark.parametrize("layout", ["poses.json", "file_path"])
def test_a_name_that_stays_inside_is_taken_and_counts(layout: str, tmp_path: Path) -> None:
    folder = tmp_path / "source"
    SPOILT[layout](folder, str(folder / "elsewhere" / ".." / "other" / "1.png"))
    (folder / "elsewhere").mkdir()
    (folder / "other").mkdir()
    for old in folder.glob("*/1.png"):
        old.rename(folder / "other" / "1.png")
    assert len(data_catalog.read(str(folder))) == 3
    before = data_catalog.source_fingerprint(str(folder))
    Image.fromarray(np.full((32, 40, 3), 90, np.uint8)).save(folder / "other" / "1.png")
    assert data_catalog.source_fingerprint(str(folder)) != before


def test_links_are_followed_and_count_by_their_content(tmp_path: Path) -> None:
    folder = tmp_path / "source"
    write_posed(folder)
    (folder / "rgb").rename(tmp_path / "images")
    before = data_catalog.source_fingerprint(str(shutil.copytree(tmp_path / "images", folder / "rgb").parent))
    shutil.rmtree(folder / "rgb")
    (folder / "rgb").symlink_to(tmp_path / "images")
    assert len(data_catalog.read(str(folder))) == 3
    assert data_catalog.source_fingerprint(str(folder)) == before


def test_inside_gives_the_file(tmp_path: Path) -> None:
    assert inside(tmp_path, "a/b.png", file=tmp_path) == tmp_path / "a" / "b.png"
    assert inside(tmp_path, "a/../b.png", file=tmp_path) == tmp_path / "b.png"


@pytest.mark.parametrize("write", [write_colmap, write_transforms])
@pytest.mark.parametrize("name", ["../../escaped", "/tmp/escaped", "a/../../../escaped"])
def test_exporting_never_writes_outside(write: Callable[..., None], name: str, tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b" / "export"
    with pytest.raises(SourceError, match="leads out of the folder"):
        write(small_sequence(("0", name, "2")), folder)
    assert not list(tmp_path.rglob("*escaped*"))
    assert not Path("/tmp/escaped.png").exists()


@pytest.mark.parametrize("key", ["../other", "a/b", "..", ".", "", "a\0b", "/etc"])
def test_keys_are_names(key: str, tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    with pytest.raises(StoreError, match="keys are names"):
        store.find(key)
    with pytest.raises(StoreError, match="keys are names"), store.slot(stage="x", version=1, key=key):
        raise AssertionError("the slot is open")


def test_a_ref_leads_nowhere_else(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="keys are names"):
        Store(tmp_path / "store").open(Ref(uri="/somewhere/..", digest="x"))


@pytest.mark.parametrize("root", ["{}", "memory://outside-paths"])
@pytest.mark.parametrize("field", ["key", "data"])
def test_a_manifest_leads_nowhere_else(root: str, field: str, tmp_path: Path) -> None:
    store = Store(root.format(tmp_path / "store"), cache=tmp_path / "cache")
    with store.slot(stage="toy", version=1, key="toy-v1-0") as slot:
        slot.save_json("value.json", 1)
    manifest = store.manifest(slot.ref).model_copy(update={field: "../../elsewhere"})
    if root == "{}":
        (tmp_path / "store" / "artefacts" / "toy-v1-0" / "manifest.json").write_bytes(manifest_text(manifest))
    else:
        store.backend.fs.pipe_file("/outside-paths/toy-v1-0/manifest.json", manifest_text(manifest))
    with pytest.raises(DamagedArtefactError, match="no name, but a path"):
        store.find("toy-v1-0")


def test_objects_with_paths_in_their_names_are_not_downloaded(tmp_path: Path) -> None:
    store = Store("memory://outside-objects", cache=tmp_path / "cache")
    with store.slot(stage="toy", version=1, key="toy-v1-0") as slot:
        slot.save_json("value.json", 1)
    manifest: Manifest = store.manifest(slot.ref)
    source = f"/outside-objects/toy-v1-0/{manifest.data}"
    found = {f"{source}/../../../../escaped": {"size": 1}}
    patched = pytest.MonkeyPatch()
    patched.setattr(store.backend.fs, "find", lambda place, detail=False: found if detail else list(found))
    try:
        with pytest.raises(ExtragsError):
            store.open(slot.ref)
    finally:
        patched.undo()
    assert not list(tmp_path.rglob("escaped"))


def test_links_in_artefacts_are_damage(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    with store.slot(stage="toy", version=1, key="toy-v1-0") as slot:
        slot.save_json("value.json", 1)
    (tmp_path / "other.json").write_text("2")
    file = tmp_path / "store" / "artefacts" / "toy-v1-0" / "value.json"
    file.unlink()
    file.symlink_to(tmp_path / "other.json")
    with pytest.raises(DamagedArtefactError):
        store.find("toy-v1-0")
