"""Faults put into stages are found by their rows, and what the rows are given is what it says it is."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from extrags.scene import Scene
from extrags.stress import ROWS, faulty_recordings, later_stages, run_rows
from extrags.stress.faulty_recordings import displaced, faulty_poses
from extrags.stress.inputs import TURN, plane_recording
from extrags.stress.rows import same_on_threads
from extrags.stress.tube import tube
from extrags.surface import Mesh, fuse_depth


def failed(*names: str) -> list[str]:
    return [f"{row['part']}/{row['case']}" for row in run_rows(ROWS, names) if not row["passed"]]


def test_a_rendering_that_torch_divides_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    true = Scene.render

    def divided(self: Scene, *arguments: Any, **options: Any) -> Any:
        found = true(self, *arguments, **options)
        return replace(found, rgb=found.rgb + 1e-6 * torch.get_num_threads())

    names = ("rendering/repeat and threads",)
    assert failed(*names) == []
    monkeypatch.setattr(Scene, "render", divided)
    assert failed(*names) == list(names)


@pytest.mark.parametrize("fault", ["axis", "unit"])
def test_an_assessment_that_knows_the_world_is_found(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    true = later_stages.assess

    def wrong(scene: Scene, *arguments: Any) -> Any:
        found = true(scene, *arguments)
        size = scene.gaussians.means[:, 0].std() / (scene.gaussians.means.std() if fault == "axis" else 1)
        measured = {**found.measurements, "hole_share": float(size)}
        return replace(found, measurements=measured)

    names = ("assessment/scale 1e-3 to 1e4, offset to 1e5, rotation",)
    assert failed(*names) == []
    monkeypatch.setattr(later_stages, "assess", wrong)
    assert failed(*names) == list(names)


def test_a_fusion_of_nan_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def careless(cameras: Any, depth: np.ndarray, config: Any) -> Mesh:
        poses = np.nan_to_num(cameras.world_from_camera, posinf=0)
        return fuse_depth(replace(cameras, world_from_camera=poses), depth, config)

    monkeypatch.setattr(faulty_recordings, "fuse_depth", careless)
    assert failed("TSDF/poses repeated*") == ["TSDF/poses repeated, parallel, wrong"]


@pytest.mark.parametrize(
    ("compute", "value"),
    [
        (lambda: np.ones(2), 0),
        (lambda: np.full(2, torch.get_num_threads()), 1),
        # A result that holds no array would be equal to any other.
        (lambda: "done", math.inf),
    ],
)
def test_same_on_threads(compute: Callable[[], Any], value: float) -> None:
    assert list(same_on_threads(compute, (2,), "here")) == [("here, 2 threads", value)]


def test_the_tube_is_the_same_in_another_world() -> None:
    here, there = tube(), tube(unit=4.0, offset_mm=8.0, turn=TURN)
    assert np.abs(here.sequence.rgb.astype(int) - there.sequence.rgb).max() <= 1
    np.testing.assert_allclose(there.sequence.depth_mm, 4 * np.asarray(here.sequence.depth_mm), rtol=1e-4)
    np.testing.assert_allclose(there.mesh.vertices, 4 * here.mesh.vertices @ TURN.T + 8, atol=1e-4)
    assert here.sequence.rgb.std() > 20


def test_exposures_of_the_tube_are_those_of_its_frames() -> None:
    usual, dim = tube(), tube(gains=np.array([1.0, 0.25, 1.0, 1.0, 1.0, 1.0]))
    ratio = dim.sequence.rgb.mean(axis=(1, 2, 3)) / usual.sequence.rgb.mean(axis=(1, 2, 3))
    # Somewhat more than a quarter: the camera's response has a shoulder.
    assert 0.25 < ratio[1] / ratio[0] < 0.35
    assert dim.scene.light is not None
    np.testing.assert_allclose(dim.scene.light.exposures()[1] / dim.scene.light.exposures()[0], 0.25)


def test_the_painting_turns_with_its_plane() -> None:
    here, there = plane_recording(2), plane_recording(2, turn=TURN)
    assert np.abs(here.rgb.astype(int) - there.rgb).max() <= 1
    np.testing.assert_allclose(here.depth_mm, there.depth_mm, rtol=1e-6)


def test_poses_are_off_by_what_is_said() -> None:
    poses = tube().sequence.cameras.world_from_camera
    off = displaced(poses, 0.1, 2.0)
    np.testing.assert_allclose(np.linalg.norm(off[:, :3, 3] - poses[:, :3, 3], axis=1), 0.2)
    turned = np.einsum("fji,fjk->fik", poses[:, :3, :3], off[:, :3, :3])
    np.testing.assert_allclose(np.arccos((np.trace(turned, axis1=1, axis2=2) - 1) / 2), 0.1)
    for said in faulty_poses(poses, 1.0).values():
        assert said.shape == poses.shape
        np.testing.assert_allclose(np.linalg.det(said[:, :3, :3]), 1)
