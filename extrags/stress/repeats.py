"""Rows of whole stages that must give the same bits on repeat and on any number of threads.

Scenes are small, but of so many Gaussians that torch divides its work on them between threads.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import torch

from extrags.assessment import assess
from extrags.config import (
    AssessConfig,
    CoarseConfig,
    DensifyConfig,
    DepthConfig,
    EnhanceConfig,
    ExploreConfig,
    FinetuneConfig,
    FreespaceConfig,
    JudgeConfig,
    PipelineConfig,
    PosesConfig,
    SurfaceConfig,
)
from extrags.depth.estimate import estimate_depth
from extrags.evaluation import evaluate, render
from extrags.exploration import explore
from extrags.finetuning_judge import judge_finetuning
from extrags.freespace import carve
from extrags.in_memory_pipeline import run_pipeline
from extrags.lens import Lens, Undistortion
from extrags.metrics.pose import absolute_trajectory_error, relative_pose_error
from extrags.poses import estimate_poses
from extrags.restoration.backends import train_enhancer
from extrags.restoration.clips import render_clips
from extrags.restoration.protocol import restore_clips
from extrags.restoration.trajectories import restore
from extrags.stress.inputs import image
from extrags.stress.rows import EXACT, Effort, Row, Trial, same_on_threads
from extrags.stress.tube import Tube, tube
from extrags.surface import fuse_surface
from extrags.threads import in_threads
from extrags.training import finetune, reconstruct
from extrags.view_synthesis.filling import completed_depth, push_pull
from extrags.view_synthesis.gather import gather_references
from extrags.view_synthesis.warp import warp_references

__all__ = ["COARSE", "EXPLORE", "FINETUNE", "FREESPACE", "ROWS"]

ONCE = (2,)
"""Threads of the long rows: the result on one thread is made a first time, and again on two."""
COARSE = CoarseConfig(iterations=20, max_points=300, densify=DensifyConfig(max_gaussians=2000))
FREESPACE = FreespaceConfig(grid_size=24, render_width=48)
EXPLORE = ExploreConfig(trajectories=2, length=4, render_width=32, max_expansions=6, probe_views=24)
ENHANCE = EnhanceConfig(folds=1, fold_iterations=20, references=4, max_views=6, judge=False)
FINETUNE = FinetuneConfig(
    iterations=20, judge=JudgeConfig(iterations_share=1.0, views=4, leave_out_every=3, max_width=96)
)
PIPELINE = PipelineConfig(
    coarse=CoarseConfig(
        iterations=10, max_points=40_001, pixels_per_point=2, densify=DensifyConfig(enabled=False)
    ),
    assess=AssessConfig(probe_views=24, force=True),
    surface=SurfaceConfig(min_cluster_triangles=1),
    freespace=FREESPACE,
    explore=EXPLORE,
    enhance=ENHANCE,
    finetune=FINETUNE,
)


@cache
def _fine() -> Tube:
    """A tube of more Gaussians than torch leaves to one thread, and of no round number of them."""
    fine = tube(frames=8, held_out=2, size=(96, 80), count=187)
    # Where opacities are near one half, sigmoids differ most often by how torch divides its work.
    fine.scene.gaussians.opacities.sub_(2.0)
    return fine


@cache
def _small() -> Tube:
    return tube(frames=8, held_out=2, size=(96, 80))


def _densification(effort: Effort) -> Iterator[Trial]:
    frames = _small().sequence.training_part()
    for strategy in ("default", "mcmc"):
        densify = DensifyConfig.model_validate(
            {"strategy": strategy, "every": 10, "stop_share": 0.9, "gradient_threshold": 1e-6}
        )
        config = COARSE.model_copy(update={"iterations": 60, "densify": densify})

        def grown(config: CoarseConfig = config) -> dict[str, torch.Tensor]:
            return reconstruct(frames, config).scene.gaussians.parameters()

        yield from same_on_threads(grown, place=strategy)


def _rendering(effort: Effort) -> Iterator[Trial]:
    fine = _fine()
    shown = partial(fine.scene.render, fine.sequence.cameras, visibility=True, median_depth=True)
    yield from same_on_threads(shown, place="Scene.render")
    yield from same_on_threads(partial(render, fine.scene, fine.sequence), place="extrags.render")


def _evaluation(effort: Effort) -> Iterator[Trial]:
    fine = _fine()
    yield from same_on_threads(lambda: evaluate(fine.scene, fine.sequence).to_json())


def _warp(effort: Effort) -> Iterator[Trial]:
    fine = _fine()
    frames = fine.sequence.test
    known = torch.from_numpy(np.asarray(fine.sequence.depth_mm)[frames][:, None])
    depth = torch.where(known > 0, known, 3.0)

    def warped() -> Any:
        references = gather_references(fine.scene, fine.sequence, fine.sequence.train)
        # As `observe_views` runs it.
        return in_threads(
            lambda view: warp_references(
                references, fine.sequence.cameras[int(frames[view])], depth[[view]], count=3
            ),
            range(len(frames)),
        )

    yield from same_on_threads(warped)


def _filling(effort: Effort) -> Iterator[Trial]:
    values, weight = image("noise", 2, 3, 120, 160), (image("noise", 2, 1, 120, 160, seed=1) - 0.7).clamp(0)

    def filled(view: int) -> list[torch.Tensor]:
        depth = torch.where(weight[[view]] > 0, 1 + values[[view], :1], torch.zeros(()))
        return [push_pull(values[[view]], weight[[view]]), completed_depth(depth, weight[[view]], 2.0)]

    # As `observe_views` runs it.
    yield from same_on_threads(lambda: in_threads(filled, range(len(values))))


def _poses(effort: Effort) -> Iterator[Trial]:
    recording = replace(_small().sequence, world_from_camera=None)
    aligned = partial(estimate_poses, recording, PosesConfig(fallback="rgbd", rgbd_width=64))
    yield from same_on_threads(lambda: aligned().world_from_camera, ONCE, "from colour and depth")
    truth = _small().sequence.cameras.world_from_camera
    found = truth.copy()
    found[:, :3, 3] += 0.01 * np.random.default_rng(0).normal(size=(len(truth), 3))
    for measure in (absolute_trajectory_error, relative_pose_error):
        yield from same_on_threads(partial(measure, found, truth), place=measure.__name__)


def _lens(effort: Effort) -> Iterator[Trial]:
    lens = Lens("OPENCV", (110.0, 110.0, 80.0, 60.0, -0.2, 0.05, 0.001, -0.001), 160, 120)
    pixels = (255 * image("noise", 120, 160, 3)).to(torch.uint8).numpy()
    depth = 1 + image("noise", 120, 160).numpy()

    def resampled() -> list[np.ndarray]:
        plan = Undistortion.planned(lens)
        return [plan.K, plan.valid, plan.color(pixels), plan.depth(depth)]

    yield from same_on_threads(resampled)


def _depth(effort: Effort) -> Iterator[Trial]:
    small = _small()
    points = small.scene.gaussians.means.double().numpy()
    recording = replace(
        small.sequence, depth_mm=None, points=points, points_rgb=np.zeros(points.shape, np.uint8)
    )
    config = DepthConfig(hypotheses=24, sources=3)
    yield from same_on_threads(partial(estimate_depth, recording.training_part(), config), ONCE)


def _restorer(effort: Effort) -> Iterator[Trial]:
    small = _small()
    references = gather_references(small.scene, small.sequence, small.sequence.train)
    clips = render_clips(small.scene, references, [way[1:] for way in small.trajectories], count=4)
    for precision in ("float32", "bfloat16"):
        config = ENHANCE.model_copy(update={"precision": precision})
        enhancer = train_enhancer(small.scene, small.sequence, config, COARSE)
        yield from same_on_threads(partial(restore_clips, enhancer, clips), place=precision)


def _restored_views(effort: Effort) -> Iterator[Trial]:
    for precision in ("float32", "bfloat16"):
        config = ENHANCE.model_copy(update={"precision": precision})
        fine = _fine()
        restored = partial(restore, fine.scene, fine.sequence, fine.trajectories, config, COARSE)
        yield from same_on_threads(restored, ONCE, precision)


def _exploration(effort: Effort) -> Iterator[Trial]:
    fine = _fine()
    space = carve(fine.scene, fine.mesh, fine.cameras, FREESPACE)
    yield from same_on_threads(partial(explore, fine.scene, fine.sequence, EXPLORE, freespace=space), ONCE)


def _assessment(effort: Effort) -> Iterator[Trial]:
    fine = _fine()
    yield from same_on_threads(lambda: assess(fine.scene, fine.sequence, PIPELINE).measurements)


def _surface(effort: Effort) -> Iterator[Trial]:
    fine = _fine()

    def fused() -> list[np.ndarray]:
        mesh = fuse_surface(fine.scene, fine.cameras, PIPELINE.surface)
        return [mesh.vertices, mesh.triangles]

    yield from same_on_threads(fused)


def _finetuning(effort: Effort) -> Iterator[Trial]:
    fine = _fine()
    views = restore(fine.scene, fine.sequence, fine.trajectories, ENHANCE, COARSE)
    config = COARSE.model_copy(update={"densify": DensifyConfig(max_gaussians=20_000)})

    def tuned() -> dict[str, torch.Tensor]:
        return finetune(fine.scene, fine.sequence, views, FINETUNE, config).scene.gaussians.parameters()

    yield from same_on_threads(tuned)
    judged = partial(judge_finetuning, fine.scene, fine.sequence, (), None, FINETUNE, ENHANCE, COARSE)
    yield from same_on_threads(judged, ONCE, "judge")


def _pipeline(effort: Effort) -> Iterator[Trial]:
    # Torch divides the work on its many starting points.
    recording = tube(frames=8, held_out=2, size=(128, 96)).sequence

    def run() -> list[Any]:
        found = run_pipeline(recording, PIPELINE)
        evaluations = {name: result.to_json() for name, result in found.evaluations.items()}
        return [
            found.coarse.gaussians.parameters(),
            found.scene.gaussians.parameters(),
            found.exploration,
            found.pseudo_views,
            found.judgement,
            found.renders,
            evaluations,
        ]

    yield from same_on_threads(run, ONCE)


def _rows() -> Iterator[Row]:
    case = "repeat and threads"
    for part, trials in {
        "densification": _densification,
        "rendering": _rendering,
        "poses": _poses,
        "lens": _lens,
        "assessment": _assessment,
        "exploration": _exploration,
        "warp": _warp,
        "filling": _filling,
        "restorer": _restorer,
        "restored views": _restored_views,
        "fine-tuning": _finetuning,
        "evaluation": _evaluation,
        "pipeline": _pipeline,
    }.items():
        yield Row(part, case, "results that differ", EXACT, trials)
    yield Row("TSDF", f"{case}, of a scene", "results that differ", EXACT, _surface)
    yield Row("depth", f"{case}, of all cues", "results that differ", EXACT, _depth)


ROWS = tuple(_rows())
