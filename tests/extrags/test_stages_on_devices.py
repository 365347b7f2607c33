"""What renders and measures a scene does so where it is, or says why on the processor."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from extrags import assessment, in_memory_pipeline, placement
from extrags.assessment import measure
from extrags.config import (
    AssessConfig,
    CoarseConfig,
    DensifyConfig,
    EnhanceConfig,
    ExploreConfig,
    FinetuneConfig,
    LpipsNet,
    PipelineConfig,
    SurfaceConfig,
)
from extrags.config.finetuning import JudgeConfig
from extrags.evaluation import evaluate_renders, render
from extrags.exploration.coverage import training_coverage
from extrags.finetuning_judge import judge_finetuning
from extrags.metrics.lpips import Lpips
from extrags.metrics.protocol import figures_per_view
from extrags.restoration.training_data.pairs import fold_pairs
from extrags.scene import Scene
from extrags.surface import rendered_depth
from extrags.threads import kernel_threads
from extrags.training.optimise import TrainingResult
from extrags.training.starting import starting_gaussians
from extrags.view_synthesis.conditioning import observe_views
from extrags.view_synthesis.gather import gather_references
from tests.extrags.lit_tube import Tube
from tests.extrags.random_lpips import random_weights
from tests.second_device import DEVICE

COARSE = CoarseConfig(iterations=5, max_points=60, densify=DensifyConfig(enabled=False))
RELATIVE = 1e-4
"""Of rendered values and their means between a processor and a GPU."""


@pytest.fixture
def few(tube: Tube) -> Tube:
    """The tube at a size that plain torch renders in no time."""
    sequence = tube.sequence.at_most_width(44)
    gaussians = starting_gaussians(sequence, sequence.train, 150, light=tube.scene.light)
    return replace(tube, scene=Scene(gaussians, tube.scene.light), sequence=sequence)


def close(found: np.ndarray, expected: np.ndarray, device: torch.device) -> None:
    if device == DEVICE:
        np.testing.assert_array_equal(found, expected)
    else:
        np.testing.assert_allclose(found, expected, rtol=RELATIVE, atol=RELATIVE)


@pytest.mark.usefixtures("without_kernels")
def test_held_out_views(few: Tube, elsewhere: torch.device) -> None:
    expected, found = (render(few.scene.to(device), few.sequence) for device in ("cpu", elsewhere))
    for name in ("rgb", "alpha", "depth_mm"):
        close(getattr(found, name), getattr(expected, name), elsewhere)


@pytest.mark.usefixtures("without_kernels")
def test_metrics(few: Tube, elsewhere: torch.device) -> None:
    """PSNR, SSIM, FLIP, LPIPS: all photometric metrics of the protocol."""
    lpips: dict[LpipsNet, Lpips | str] = {"alex": Lpips("alex", random_weights("alex"))}
    renders = render(few.scene, few.sequence)
    found = [
        figures_per_view([renders], few.sequence, few.sequence.test, lpips, device=device)[0]
        for device in ("cpu", elsewhere)
    ]
    keys = {"psnr", "ssim", "flip", "lpips_alex"}
    for expected, there in zip(*found, strict=True):
        for group in (lambda view: view, lambda view: view["aligned"]):
            assert keys <= set(group(there))
            for key in keys:
                assert group(there)[key] == pytest.approx(group(expected)[key], rel=RELATIVE)
    whole = [
        evaluate_renders(renders, few.sequence, lpips=lpips, device=device).metrics
        for device in ("cpu", elsewhere)
    ]
    assert whole[1]["psnr"] == pytest.approx(whole[0]["psnr"], rel=RELATIVE)


@pytest.mark.usefixtures("without_kernels")
def test_assessment(few: Tube, elsewhere: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    settings, coverage = AssessConfig(probe_views=2), ExploreConfig(render_width=24).coverage
    covered_on = []

    def coverage_of(scene: Scene, *given: Any, **more: Any) -> np.ndarray:
        covered_on.append(scene.device.type)
        return training_coverage(scene, *given, **more)

    monkeypatch.setattr(assessment, "training_coverage", coverage_of)
    expected, found = (
        measure(few.scene.to(device), few.sequence, settings, coverage) for device in ("cpu", elsewhere)
    )
    assert covered_on == ["cpu", "cpu"]
    assert found == pytest.approx(expected, rel=RELATIVE)


@pytest.mark.usefixtures("without_kernels")
def test_the_judge(few: Tube, elsewhere: torch.device) -> None:
    config = FinetuneConfig(
        iterations=2, judge=JudgeConfig(iterations_share=1.0, leave_out_every=3, max_width=24)
    )
    expected, found = (
        judge_finetuning(few.scene.to(device), few.sequence, (), None, config, EnhanceConfig(), COARSE)
        for device in ("cpu", elsewhere)
    )
    for one, other in zip(found.trials, expected.trials, strict=True):
        assert one.final_psnr_db == pytest.approx(other.final_psnr_db, abs=1e-2)


@pytest.mark.usefixtures("without_kernels")
def test_pairs_of_a_fold(few: Tube, elsewhere: torch.device) -> None:
    config = EnhanceConfig(folds=2, fold_iterations=2, synthetic_views=1)
    expected, found = (
        fold_pairs(few.scene.to(device), few.sequence, config, COARSE, 0) for device in ("cpu", elsewhere)
    )
    assert found.layers.data.device.type == "cpu"
    close(found.target.numpy(), expected.target.numpy(), elsewhere)
    close(found.layers.data.numpy(), expected.layers.data.numpy(), elsewhere)


def test_what_needs_the_native_kernels_comes_to_the_processor(few: Tube, elsewhere: torch.device) -> None:
    cameras = few.sequence.training_cameras
    found = []
    for scene in (few.scene, few.scene.to(elsewhere)):
        _, depth = rendered_depth(scene, cameras, SurfaceConfig())
        references = gather_references(scene, few.sequence, few.sequence.train)
        seen = observe_views(scene, references, cameras[:2], count=2)
        found.append((depth, seen.layers.data.numpy()))
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_pipeline_in_memory(few: Tube, elsewhere: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each stage gets the scene where it works; results are on the processor."""
    optimised_on: list[str] = []

    def told(result: TrainingResult) -> TrainingResult:
        optimised_on.append(result.scene.device.type)
        return result

    monkeypatch.setattr(placement, "run_device", lambda _: str(elsewhere))
    monkeypatch.setattr(placement, "check_device", lambda _: None)
    import extrags.training

    for name in ("reconstruct", "finetune"):
        before = getattr(extrags.training, name)
        monkeypatch.setattr(extrags.training, name, lambda *a, _f=before, **k: told(_f(*a, **k)))
    config = PipelineConfig(coarse=COARSE, finetune=FinetuneConfig(iterations=3)).with_overrides(
        {"finetune.judge.enabled": False, "evaluate.restored": "none"}
    )
    with kernel_threads(1):
        result = in_memory_pipeline.run_pipeline(
            few.sequence,
            config,
            leave_out=dict.fromkeys(("assess", "surface", "freespace", "explore", "enhance"), "not here"),
        )
    assert optimised_on == [elsewhere.type, elsewhere.type]
    assert result.coarse.device.type == result.scene.device.type == "cpu"
    assert result.evaluations["final"].metrics["psnr"] > 5
