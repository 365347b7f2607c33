"""Frames that show nothing, or stand where they cannot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import extrags
from data_catalog.readers.colmap_model import write_colmap
from data_catalog.readers.transforms_json import write_transforms
from extrags.carried_depth import CarriedDepth
from extrags.config import CoarseConfig, IngestConfig
from extrags.evaluation import render
from extrags.observed_surface import observed_by_depth
from extrags.sequence import EndoscopicSequence, Split
from extrags.training import reconstruct
from extrags.unusable_frames import of_split, shows_nothing, without_blank_frames
from extrags.unusable_frames import without_misplaced_frames as without_misplaced
from tests.extrags.depth.withheld import recorded
from tests.extrags.test_measured_depth import displaced

SIZE = (40, 50)


def without_misplaced_frames(sequence: EndoscopicSequence) -> EndoscopicSequence:
    return without_misplaced(sequence, CarriedDepth.of(sequence))


@pytest.fixture(scope="module")
def exact() -> EndoscopicSequence:
    return recorded(10, 96, 72)


def picture(kind: str) -> np.ndarray:
    generator = np.random.default_rng(0)
    rgb = np.zeros((*SIZE, 3))
    if kind == "noise in the dark":
        rgb += generator.uniform(0, 12, rgb.shape)
    if kind == "red":
        rgb += np.array([180, 40, 30]) + generator.normal(size=rgb.shape)
    if kind == "a clock":
        rgb[:3, :5] = 255
    if kind == "a dim wall":
        rgb += np.linspace(5, 60, SIZE[1])[None, :, None]
    if kind == "a lit rim":
        rgb[:, :4] = 90
    return rgb.clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("kind", "nothing"),
    [
        ("black", True),
        ("noise in the dark", True),
        ("red", True),
        ("a clock", True),
        ("a dim wall", False),
        ("a lit rim", False),
    ],
)
def test_pictures_that_show_nothing(kind: str, nothing: bool) -> None:
    assert shows_nothing(picture(kind), np.ones(SIZE, bool)) == nothing


def test_only_what_is_inside_the_mask_counts() -> None:
    mask = np.zeros(SIZE, bool)
    mask[:, 10:] = True
    assert shows_nothing(picture("a lit rim"), mask)
    assert shows_nothing(picture("a lit rim"), np.zeros(SIZE, bool))


def blank(sequence: EndoscopicSequence, frames: list[int]) -> EndoscopicSequence:
    rgb = np.array(sequence.rgb)
    rgb[frames] = 3
    return replace(sequence, rgb=rgb)


def test_blank_frames_leave_the_split(exact: EndoscopicSequence, caplog: pytest.LogCaptureFixture) -> None:
    assert without_blank_frames(exact) is exact
    found = without_blank_frames(blank(exact, [2, 7, 10]))
    assert found.train.tolist() == [0, 1, 3, 4, 5, 6, 8, 9]
    assert found.test.tolist() == []
    assert "3 of 11 frames, 0002 first, are black, or of one colour: they are left out" in caplog.text
    assert len(found.training_part()) == 8


def test_where_many_are_blank_it_is_the_scene(exact: EndoscopicSequence) -> None:
    given = blank(exact, [0, 2, 4, 6])
    assert without_blank_frames(given) is given


def test_what_blank_frames_saw_does_not_count_as_observed(exact: EndoscopicSequence) -> None:
    given = blank(exact, [9])
    seen = observed_by_depth(given.cameras, given.mask, given.depth_mm, given.split)
    found = without_blank_frames(replace(given, observed=seen)).observed
    left = Split("left", np.arange(9), given.test)
    assert found is not None
    assert seen is not None
    assert np.array_equal(found, observed_by_depth(given.cameras, given.mask, given.depth_mm, left))
    assert found.sum() < seen.sum()


def test_the_oracle_is_trained_on_no_blank_frame(exact: EndoscopicSequence) -> None:
    given = without_blank_frames(blank(exact, [2]))
    config = CoarseConfig(train_on="all", iterations=1, max_points=500, inconsistent_frames="ignore")
    scene = reconstruct(given, config).scene
    assert scene.light is not None
    assert len(scene.light.log_exposure) == 10
    assert len(render(scene, given, train_on="all")) == 1


@pytest.mark.parametrize("write", [write_colmap, write_transforms])
def test_blank_frames_are_not_handed_to_other_programs(
    exact: EndoscopicSequence, write: Callable[[EndoscopicSequence, Path], None], tmp_path: Path
) -> None:
    write(without_blank_frames(blank(exact, [2])), tmp_path)
    assert not list(tmp_path.rglob("*0002.*"))
    read = extrags.read(tmp_path, IngestConfig())
    assert [read.frame_name(k) for k in range(len(read))] == [f"{k:04d}" for k in range(11) if k != 2]
    assert read.test.tolist() == [9]
    assert np.array_equal(read.rgb, np.delete(exact.rgb, 2, axis=0))


def test_a_sequence_without_frames_that_left_is_the_same(exact: EndoscopicSequence) -> None:
    assert of_split(exact) is exact


@pytest.mark.parametrize("which", [0, 4])
def test_a_frame_in_a_wrong_place_leaves_the_split(
    exact: EndoscopicSequence, which: int, caplog: pytest.LogCaptureFixture
) -> None:
    assert without_misplaced_frames(exact) is exact
    poses = exact.cameras.world_from_camera.copy()
    poses[which] = displaced(exact, 5.0, 5.0).cameras.world_from_camera[which]
    found = without_misplaced_frames(replace(exact, world_from_camera=poses))
    assert found.train.tolist() == [k for k in range(10) if k != which]
    assert f"{exact.frame_name(which)} first, are at a place that the depth" in caplog.text


def test_poses_that_are_all_off_a_little_stay(exact: EndoscopicSequence) -> None:
    for factor in (1.0, 3.0):
        given = displaced(exact, 0.5 * factor, 0.3 * factor)
        assert without_misplaced_frames(given) is given


def test_arrays_in_memory_are_treated_alike(exact: EndoscopicSequence) -> None:
    given = blank(exact, [2])
    found = extrags.sequence_from_arrays(
        given.rgb, K=given.K, world_from_camera=given.world_from_camera, depth_mm=given.depth_mm
    )
    assert 2 not in {*found.train.tolist(), *found.test.tolist()}
