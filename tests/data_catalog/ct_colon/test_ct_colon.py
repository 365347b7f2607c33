"""Stretches of a real colon, through the catalogue."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_catalog import describe, list_sequences, read, resolve, source_fingerprint
from data_catalog.caverns.recording import MIN_CLEARANCE_MM, recording_cameras
from data_catalog.cavities.real_textures import FOLDER as FRAMES_FOLDER
from data_catalog.cavities.real_textures import judging_files, texture_files
from data_catalog.ct_colon.config import CtColonConfig
from data_catalog.ct_colon.model import FOLDER, PATH_FILE, ColonModel
from data_catalog.ct_colon.stretch import STRETCH_MM, build_stretch
from data_catalog.ray_casting import RayCaster
from data_catalog.true_surface import true_surface
from extrags.config import IngestConfig
from extrags.errors import SourceError, SourceNotFoundError, UnknownSequenceError
from extrags.sequence import EndoscopicSequence
from tests.data_catalog.two_recordings import check_the_same_again, off_the_surface_mm

TINY = IngestConfig(width=32, max_frames=6)
RADIUS_MM, LENGTH_MM = 12.0, 320.0


@pytest.fixture(scope="module")
def real(shared_data: Path) -> Path:
    for folder in (FOLDER, FRAMES_FOLDER):
        if not (shared_data / folder).is_dir():
            pytest.skip(f"no {folder} among the shared data")
    return shared_data


@pytest.fixture(scope="module")
def sequence(real: Path) -> EndoscopicSequence:
    return read("ct_colon/1@distanced", TINY)


def _write_tube(folder: Path, length_mm: float = LENGTH_MM) -> Path:
    """A closed tube along x as the model has a colon on disk."""
    around, along = 24, 41
    angle = np.arange(around) / around * 2 * np.pi
    ring = RADIUS_MM * np.stack([np.zeros(around), np.cos(angle), np.sin(angle)], axis=1)
    places = np.linspace(0, length_mm, along)
    ends = [[0.0, 0, 0], [length_mm, 0, 0]]
    vertices = np.concatenate([*(ring + np.array([x, 0, 0]) for x in places), ends])
    k = np.arange(around)
    after = (k + 1) % around
    faces = []
    for row in range(along - 1):
        a, b = row * around + k, row * around + after
        faces += [np.stack([a, b, a + around], 1), np.stack([b, b + around, a + around], 1)]
    first, last = len(vertices) - 2, len(vertices) - 1
    faces.append(np.stack([np.full(around, first), after, k], 1))
    faces.append(np.stack([np.full(around, last), (along - 1) * around + k, (along - 1) * around + after], 1))
    triangles = np.concatenate(faces)
    lines = [
        "# vtk DataFile Version 1.0",
        "a tube",
        "ASCII",
        "DATASET POLYDATA",
        f"POINTS {len(vertices)} float",
    ]
    lines += [" ".join(map(str, vertex)) for vertex in vertices]
    lines.append(f"POLYGONS {len(triangles)} {4 * len(triangles)}")
    lines += [" ".join(map(str, (3, *triangle))) for triangle in triangles]
    (folder / "Surfaces").mkdir(parents=True)
    (folder / "Surfaces" / "large_intestine_100k.vtk").write_text("\n".join(lines) + "\n")
    (folder / "Paths").mkdir()
    points = [[float(x), 0.0, 0.0] for x in np.arange(0, length_mm, 1.0)]
    (folder / PATH_FILE).write_text(json.dumps({"n": len(points), "points": points}))
    return folder


def test_names_are_in_the_catalogue() -> None:
    assert "ct_colon/0@sparse" in {descriptor.name for descriptor in list_sequences()}
    about = describe("ct_colon/7@distanced")
    assert (about.frames, about.format, about.has_depth) == (48, "ct_colon", True)
    assert "CC BY 4.0" in about.licence
    with pytest.raises(UnknownSequenceError, match="ct_colon has no setting 'far'"):
        describe("ct_colon/3@far")


def test_without_its_files_it_is_listed_and_not_available(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("EXTRAGS_DATA", "XDG_DATA_HOME", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    assert not describe("ct_colon/0@sparse").available
    with pytest.raises(
        SourceNotFoundError, match="ct_colon/0@sparse is not on this machine: no folder colon_ct"
    ):
        resolve("ct_colon/0@sparse")
    _write_tube(tmp_path / FOLDER)
    with pytest.raises(SourceNotFoundError, match=f"no folder {FRAMES_FOLDER}"):
        resolve("ct_colon/0@sparse")
    (tmp_path / FRAMES_FOLDER).mkdir()
    assert describe("ct_colon/0@sparse").available
    assert len(resolve("ct_colon/0").paths) == 2


def test_the_key_depends_on_settings_and_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EXTRAGS_DATA", str(tmp_path))
    folder, frames = _write_tube(tmp_path / FOLDER), tmp_path / FRAMES_FOLDER
    frames.mkdir()
    for k in range(4):
        (frames / f"{k}.jpg").write_bytes(bytes([k]))
    plain = source_fingerprint("ct_colon/3@sparse")
    assert source_fingerprint("ct_colon/3") == plain
    for other in ("ct_colon/4@sparse", "ct_colon/3@distanced"):
        assert source_fingerprint(other) != plain
    # What training may take is not drawn here.
    (frames / "0.jpg").write_bytes(b"other")
    assert source_fingerprint("ct_colon/3") == plain
    (frames / "1.jpg").write_bytes(b"other")
    another = source_fingerprint("ct_colon/3")
    assert another != plain
    (folder / PATH_FILE).write_text(json.dumps({"points": [[0, 0, 0], [1, 0, 0]]}))
    assert source_fingerprint("ct_colon/3") not in (plain, another)
    (folder / PATH_FILE).unlink()
    with pytest.raises(SourceNotFoundError, match=r"large_intestine_path\.jsn: no such file"):
        source_fingerprint("ct_colon/3")


def test_frames_for_judging_are_those_that_training_does_not_take(tmp_path: Path) -> None:
    for k in range(5):
        (tmp_path / f"{k}.jpg").write_bytes(b"")
    judging, training = judging_files(tmp_path), texture_files(tmp_path)
    assert [file.name for file in judging] == ["1.jpg", "3.jpg"]
    assert {*judging, *training} == set(tmp_path.iterdir())
    assert not {*judging} & {*training}


def test_a_stretch_is_part_of_the_wall_with_normals_inwards(tmp_path: Path) -> None:
    passage = build_stretch(3, _write_tube(tmp_path / "model"))
    wall = passage.wall
    length = np.linalg.norm(np.diff(passage.middle, axis=0), axis=1)
    assert length.sum() == pytest.approx(STRETCH_MM, abs=5)
    assert length.max() < 0.51
    np.testing.assert_allclose(passage.middle[:, 1:], 0, atol=1e-12)
    inside = (wall.vertices[:, 0] > 20) & (wall.vertices[:, 0] < LENGTH_MM - 20)
    radial = wall.vertices[inside, 1:] / np.linalg.norm(wall.vertices[inside, 1:], axis=1, keepdims=True)
    # Towards the line; a tube of 24 sides turns by 15 degrees from side to side.
    assert (-(radial * wall.normals[inside, 1:]).sum(axis=1)).min() > np.cos(np.radians(8))
    radius = np.linalg.norm(wall.vertices[inside, 1:], axis=1)
    assert radius.min() > 0.96 * RADIUS_MM
    assert radius.max() < 1.02 * RADIUS_MM
    corner = wall.vertices[wall.triangles].astype(np.float64)
    facing = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    assert ((facing * wall.normals[wall.triangles].mean(axis=1)).sum(axis=1) > 0).mean() > 0.999


def test_a_colon_that_is_too_short_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="the line is 119 mm long; a stretch takes 110"):
        build_stretch(0, _write_tube(tmp_path / "model", 120.0))


def test_a_line_of_another_colon_is_refused(tmp_path: Path) -> None:
    folder = _write_tube(tmp_path / "model")
    # The ends of the line alone are near the wall.
    aside = [[float(x), 1000.0 if 1 < x < LENGTH_MM - 1 else 0.0, 0.0] for x in range(int(LENGTH_MM) + 1)]
    (folder / PATH_FILE).write_text(json.dumps({"points": aside}))
    with pytest.raises(SourceError, match="no wall lies around the line"):
        build_stretch(0, folder)


def _without_points(text: str) -> str:
    return text.replace("POINTS", "DOTS")


def _cut_short(text: str) -> str:
    return text[: text.index("POLYGONS") + 200]


def _of_quadrangles(text: str) -> str:
    return text[: text.index("POLYGONS")] + "POLYGONS 2 10\n4 0 1 2 3 4 1 2 3 4\n"


def _beyond_the_points(text: str) -> str:
    return text[: text.index("POLYGONS")] + "POLYGONS 1 4\n3 0 1 99999\n"


def _infinite(text: str) -> str:
    return text.replace("12.0", "inf", 1)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_without_points, "POINTS: not readable as legacy VTK"),
        (_cut_short, "POLYGONS: expected .* finite numbers"),
        (_of_quadrangles, "POLYGONS: expected triangles"),
        (_beyond_the_points, "POLYGONS: expected triangles"),
        (_infinite, "POINTS: expected .* finite numbers"),
    ],
)
def test_a_damaged_surface_is_named(tmp_path: Path, damage: Callable[[str], str], message: str) -> None:
    folder = _write_tube(tmp_path / "model")
    file = folder / "Surfaces" / "large_intestine_100k.vtk"
    file.write_text(damage(file.read_text()))
    with pytest.raises(SourceError, match=rf"large_intestine_100k\.vtk.*{message}"):
        ColonModel.read(folder)


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", '{"points": [[1, 2]]}', '{"points": [[1, 2, NaN], [1, 2, 3]]}']
)
def test_a_damaged_line_is_named(tmp_path: Path, text: str) -> None:
    folder = _write_tube(tmp_path / "model")
    (folder / PATH_FILE).write_text(text)
    with pytest.raises(SourceError, match=r"large_intestine_path\.jsn.*points: expected"):
        ColonModel.read(folder)
    (folder / PATH_FILE).unlink()
    with pytest.raises(SourceError, match=r"large_intestine_path\.jsn: cannot be read"):
        ColonModel.read(folder)


def test_it_is_the_same_each_time_and_has_its_truth(sequence: EndoscopicSequence) -> None:
    check_the_same_again(sequence, TINY, (26, 32, 3))
    # Red, as tissue is, and exposed to be seen.
    red, green, blue = sequence.rgb.mean(axis=(0, 1, 2))
    assert red > 1.2 * max(green, blue)
    assert 40 < sequence.rgb.mean() < 160


def test_depth_lies_on_the_true_surface(sequence: EndoscopicSequence, real: Path) -> None:
    truth = true_surface(sequence)
    assert truth is not None
    assert truth.kind == "mesh"
    wall = build_stretch(1, real / FOLDER).wall
    np.testing.assert_array_equal(truth.mesh.vertices, wall.vertices)
    rays = RayCaster(wall.vertices, wall.triangles)
    assert off_the_surface_mm(sequence, 4, rays).max() < 1e-2


def test_no_other_surface_takes_the_place_of_one_that_is_gone(
    sequence: EndoscopicSequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("EXTRAGS_DATA", "XDG_DATA_HOME", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    # An object of its own: who asked for that of the same one has it already.
    with pytest.raises(SourceNotFoundError, match="the surface of ct_colon/1@distanced is not"):
        true_surface(replace(sequence))
    estimated = replace(sequence, truth={**sequence.truth, "world": "estimated"})
    fused = true_surface(estimated)
    assert fused is not None
    assert fused.kind == "depth"


@pytest.mark.parametrize("scene", [0, 2])
def test_no_camera_touches_the_wall(real: Path, scene: int) -> None:
    passage = build_stretch(scene, real / FOLDER)
    rays = RayCaster(passage.wall.vertices, passage.wall.triangles)
    for setting in ("sparse", "distanced"):
        for letter in ("a", "b"):
            config = CtColonConfig(scene=scene, setting=setting)
            cameras = recording_cameras(config, passage, rays, letter, np.linspace(0, 1, 15))
            assert rays.clearance_mm(cameras.centers).min() > 0.8 * MIN_CLEARANCE_MM
