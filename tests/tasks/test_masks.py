"""Beyond the edge of a scope's picture nothing was seen, for surface, free space and exploration either."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from extrags.config import PROFILES, PipelineConfig
from extrags.exploration import SceneMeasurements, explore
from extrags.freespace import FreeSpace, carve
from extrags.in_memory_pipeline import InMemoryPipeline
from extrags.sequence import EndoscopicSequence
from extrags.store import Slot, Store
from extrags.surface import Mesh, fuse_surface
from extrags.training import TrainingResult
from tasks.explore import start
from tasks.freespace import freespace
from tasks.stage import stage
from tasks.surface import surface
from tests.extrags.exploration.tube import small_tube

CONFIG: PipelineConfig = PROFILES["quick"].with_overrides(
    {
        "freespace.grid_size": 24,
        "freespace.render_width": 40,
        "surface.max_width": 64,
        "surface.voxel_share": 0.03,
        "explore.trajectories": 2,
        "explore.length": 3,
        "explore.probe_views": 24,
        "explore.max_expansions": 6,
    }
)


@cache
def round_picture() -> EndoscopicSequence:
    sequence = small_tube().sequence
    y, x = np.mgrid[: sequence.height, : sequence.width] + 0.5
    disc = np.hypot(y - sequence.height / 2, x - sequence.width / 2) < 0.4 * sequence.height
    return replace(sequence, mask=np.broadcast_to(disc, sequence.mask.shape).copy())


def free_mm3(space: FreeSpace) -> float:
    return float(space.free_share * (space.grid_size * space.voxel_mm) ** 3)


@stage("test-round-picture", version=1)
def frames(slot: Slot) -> None:
    slot.save(round_picture())


@stage("test-tube", version=1)
def tube(slot: Slot) -> None:
    slot.save(small_tube().scene)


def test_tasks_and_runs_in_memory_look_at_the_masks(tmp_path: Path) -> None:
    sequence, scene = round_picture(), small_tube().scene
    cameras, masks = sequence.training_cameras, sequence.training_masks
    assert masks is not None
    mesh = fuse_surface(scene, cameras, CONFIG.surface, masks=masks)
    space = carve(scene, mesh, cameras, CONFIG.freespace, masks=masks)

    given = {"store": str(tmp_path), "scene": tube.fn(store=str(tmp_path))}
    given["sequence"] = frames.fn(store=str(tmp_path))
    surface_ref = surface.fn(**given, config=CONFIG.surface)
    space_ref = freespace.fn(**given, surface=surface_ref, config=CONFIG.freespace)
    measured_ref = start.fn(**given, freespace=space_ref, config=CONFIG.explore)
    store = Store(str(tmp_path))
    np.testing.assert_array_equal(store.load(Mesh, surface_ref).vertices, mesh.vertices)
    np.testing.assert_array_equal(store.load(FreeSpace, space_ref).occupancy, space.occupancy)

    pipeline = InMemoryPipeline(sequence, CONFIG)
    pipeline.result.reconstruction = TrainingResult(scene, [])
    pipeline.surface()
    pipeline.freespace()
    pipeline.explore()
    made = pipeline.result
    assert made.mesh is not None
    assert made.freespace is not None
    assert made.exploration is not None
    np.testing.assert_array_equal(made.mesh.vertices, mesh.vertices)
    np.testing.assert_array_equal(made.freespace.occupancy, space.occupancy)
    found = explore(scene, sequence, CONFIG.explore, freespace=space)
    np.testing.assert_array_equal(made.exploration.cameras.world_from_camera, found.cameras.world_from_camera)
    measured = store.load(SceneMeasurements, measured_ref)
    assert found.removable_error == measured.removable_error

    # All of this would be otherwise without masks.
    everything = replace(sequence, mask=np.ones_like(sequence.mask))
    assert everything.training_masks is None
    whole = fuse_surface(scene, cameras, CONFIG.surface)
    assert len(mesh.vertices) < 0.95 * len(whole.vertices)
    assert free_mm3(space) < 0.97 * free_mm3(carve(scene, whole, cameras, CONFIG.freespace))
    seen = explore(scene, everything, CONFIG.explore, freespace=space)
    assert measured.removable_error > 1.05 * seen.removable_error
