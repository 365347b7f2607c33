"""What is called without settings takes those of the default profile, as a whole run does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import extrags
from extrags.config import DEFAULT_PROFILE, PROFILES, PipelineConfig
from extrags.metrics.lpips import available_lpips
from extrags.restoration.classical import ClassicalEnhancer
from tests.extrags.lit_tube import Tube, tube_cameras

SETTINGS: dict[str, Any] = {
    "ingest.width": 48,
    "ingest.max_frames": 3,
    "coarse.iterations": 3,
    "coarse.max_points": 150,
    "surface.max_width": 40,
    "freespace.grid_size": 12,
    "freespace.render_width": 32,
    "explore.trajectories": 1,
    "explore.starts": 1,
    "explore.length": 2,
    "explore.max_expansions": 1,
    "explore.render_width": 32,
    "explore.min_view_gain": 0.0,
    "explore.wave_kept_share": 0.0,
    "enhance.max_views": 1,
    "finetune.iterations": 3,
    "evaluate.lpips_nets": ("vgg",),
}
"""None of them is a field's default, with which every function here gives something else."""


@pytest.fixture
def config(monkeypatch: pytest.MonkeyPatch) -> PipelineConfig:
    """Small settings, in the place of the default profile."""
    found = PROFILES["quick"].with_overrides(SETTINGS)
    monkeypatch.setitem(PROFILES, DEFAULT_PROFILE, found)
    return found


@pytest.mark.usefixtures("config")
def test_read(tmp_path: Path) -> None:
    pictures = np.random.default_rng(0).integers(0, 255, (5, 80, 96, 3), dtype=np.uint8)
    for index, picture in enumerate(pictures):
        Image.fromarray(picture).save(tmp_path / f"{index:02d}.png")
    sequence = extrags.read(tmp_path)
    assert (sequence.width, len(sequence)) == (48, 3)


def test_reconstruct(tube: Tube, config: PipelineConfig) -> None:
    alone = extrags.reconstruct(tube.sequence).scene.gaussians
    given = extrags.reconstruct(tube.sequence, config.coarse).scene.gaussians
    assert len(alone) <= 150
    np.testing.assert_array_equal(alone.means, given.means)


def test_fuse_surface_carve_and_explore(tube: Tube, config: PipelineConfig) -> None:
    cameras = tube.sequence.training_cameras
    mesh = extrags.fuse_surface(tube.scene, cameras)
    np.testing.assert_array_equal(
        mesh.vertices, extrags.fuse_surface(tube.scene, cameras, config.surface).vertices
    )
    space = extrags.carve(tube.scene, mesh, cameras)
    assert space.occupancy.shape == (12, 12, 12)
    alone = extrags.explore(tube.scene, tube.sequence)
    given = extrags.explore(tube.scene, tube.sequence, config.explore, freespace=space)
    assert [len(path) for path in alone.trajectories] == [len(path) for path in given.trajectories]
    assert alone.n_virtual == given.n_virtual <= 2


def test_restore(tube: Tube, config: PipelineConfig) -> None:
    found = extrags.restore(
        tube.scene, tube.sequence, [tube_cameras(3, offset_mm=3.0)], enhancer=ClassicalEnhancer()
    )
    assert len(found.cameras) == config.enhance.max_views == 1


def test_finetune(tube: Tube, config: PipelineConfig) -> None:
    alone = extrags.finetune(tube.scene, tube.sequence, None).scene.gaussians
    given = extrags.finetune(tube.scene, tube.sequence, None, config.finetune, config.coarse)
    np.testing.assert_array_equal(alone.means, given.scene.gaussians.means)


@pytest.mark.usefixtures("config")
def test_metrics() -> None:
    assert set(available_lpips()) == {"vgg"}
