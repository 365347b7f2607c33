"""Training where the scene is: everything on one device, and the same scene as on the processor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from extrags.config import CoarseConfig, FinetuneConfig
from extrags.pseudo_views import PseudoViews
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training.density import DefaultStrategy, DensityRound
from extrags.training.finetuning import finetune
from extrags.training.leave_out import partial_scene
from extrags.training.optimise import TrainingResult
from extrags.training.reconstruction import reconstruct
from extrags.training.relocation import MCMCStrategy
from tests.second_device import DEVICE

COARSE: dict[str, Any] = {
    "iterations": 9,
    "max_points": 80,
    "sh_every": 3,
    "refine_poses": True,
    "normal_weight": 0.1,
    "normal_start_share": 0.0,
    "depth_weight": 0.1,
    "densify": {"every": 3, "start_share": 0.0, "stop_share": 1.0, "max_gaussians": 110},
}

RELATIVE = 1e-3
"""Of losses between a processor and a GPU, whose sums are in another order: Adam's first steps have the size
of the learning rate whatever the gradient's, so that a rounded sign moves a parameter by that."""


def densifying(strategy: str, **more: Any) -> dict[str, Any]:
    # Some of the Gaussians, which begin at 0.5, are soon faint enough to be removed, or moved.
    return {**COARSE["densify"], "strategy": strategy, "prune_opacity": 0.49, **more}


@pytest.fixture
def small(tube_sequence: EndoscopicSequence) -> EndoscopicSequence:
    return tube_sequence.at_most_width(24)


def check_same(found: TrainingResult, expected: TrainingResult, device: torch.device) -> None:
    """On another device, and the bits of the processor where both do the same arithmetic."""
    light = found.scene.light
    there = {**found.scene.gaussians.parameters(), **({} if light is None else light.parameters())}
    assert {value.device for value in there.values()} == {device}
    light = expected.scene.light
    here = {**expected.scene.gaussians.parameters(), **({} if light is None else light.parameters())}
    losses = [[entry["loss"] for entry in result.history] for result in (found, expected)]
    if device == DEVICE:
        assert losses[0] == losses[1]
        for name, value in here.items():
            assert torch.equal(there[name].cpu(), value), name
    else:
        assert losses[0] == pytest.approx(losses[1], rel=RELATIVE)


@pytest.mark.usefixtures("without_kernels")
class TestCoarse:
    @pytest.mark.parametrize(
        ("strategy", "lit"),
        [
            pytest.param("default", True, id="default-lit"),
            pytest.param("mcmc", False, id="mcmc-unlit"),
            pytest.param("default", False, id="default-unlit", marks=pytest.mark.slow),
            pytest.param("mcmc", True, id="mcmc-lit", marks=pytest.mark.slow),
        ],
    )
    def test_all_of_it_is_on_the_device(
        self,
        small: EndoscopicSequence,
        elsewhere: torch.device,
        strategy: str,
        lit: bool,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        changed: list[bool] = []
        monkeypatch.setattr(DensityRound, "apply", watched(DensityRound.apply, changed))
        config = CoarseConfig.model_validate(
            {**COARSE, "light": {"enabled": lit}, "densify": densifying(strategy, gradient_threshold=1e-7)}
        )
        found = reconstruct(small, config, device=elsewhere)
        assert any(changed)
        check_same(found, reconstruct(small, config), elsewhere)
        assert found.refined is not None
        assert found.refined.mean_turn_deg > 0

    def test_absolute_gradients_and_huber_depth(
        self, small: EndoscopicSequence, elsewhere: torch.device
    ) -> None:
        densify = densifying(
            "default", prune_opacity=0.2, absgrad=True, reset_every=4, refine_scale2d_stop_share=1.0
        )
        config = CoarseConfig.model_validate({**COARSE, "depth_loss": "huber", "densify": densify})
        check_same(reconstruct(small, config, device=elsewhere), reconstruct(small, config), elsewhere)

    def test_estimated_depth_and_blurred_frames(
        self, small: EndoscopicSequence, elsewhere: torch.device
    ) -> None:
        assert small.depth_mm is not None
        error = np.full_like(small.depth_mm, 0.1)
        unsure = replace(small, depth_error=error)
        config = CoarseConfig.model_validate({**COARSE, "inconsistent_frames": "weight"})
        check_same(reconstruct(unsure, config, device=elsewhere), reconstruct(unsure, config), elsewhere)

    def test_a_leave_out_reconstruction_is_where_the_scene_is(
        self, small: EndoscopicSequence, elsewhere: torch.device
    ) -> None:
        config = CoarseConfig.model_validate(COARSE)
        coarse = reconstruct(small, config).scene
        found, expected = (
            TrainingResult(
                partial_scene(
                    scene, small, config, small.train[:3], iterations=4, seed=1, stage="enhance-pairs"
                ),
                [],
            )
            for scene in (coarse.to(elsewhere), coarse)
        )
        check_same(found, expected, elsewhere)


def watched(apply: Any, changed: list[bool]) -> Any:
    def told(self: DensityRound, adam: Any) -> None:
        changed.append(self.changed)
        apply(self, adam)

    return told


@pytest.mark.usefixtures("without_kernels")
class TestFinetuning:
    @pytest.mark.parametrize(
        "settings",
        [
            {"loss": "weighted_mean"},
            pytest.param({"loss": "weighted_sum", "pseudo_depth": True}, marks=pytest.mark.slow),
            pytest.param({"loss": "paper"}, marks=pytest.mark.slow),
            {"keep_scene": True, "seed_holes": True},
        ],
        ids=["mean", "sum", "paper", "filling"],
    )
    def test_confidences_are_where_the_scene_is(
        self,
        scene: Scene,
        sequence: EndoscopicSequence,
        pseudo: PseudoViews,
        settings: dict[str, Any],
        elsewhere: torch.device,
    ) -> None:
        config = FinetuneConfig.model_validate({"iterations": 4, **settings})
        coarse = CoarseConfig.model_validate({**COARSE, "densify": densifying("default")})
        if config.keep_scene:
            pseudo = replace(pseudo, alpha=np.zeros_like(pseudo.alpha))
        first = of_first(scene, 120)
        found, expected = (
            finetune(start, sequence, pseudo, config, coarse) for start in (first.to(elsewhere), first)
        )
        assert found.history
        check_same(found, expected, elsewhere)


def of_first(scene: Scene, count: int) -> Scene:
    return Scene(scene.gaussians.subset(torch.arange(count)), scene.light)


@pytest.mark.parametrize("strategy", [DefaultStrategy, MCMCStrategy])
def test_draws_are_those_of_the_processor(scene: Scene, elsewhere: torch.device, strategy: type) -> None:
    """The same seed places the same Gaussians, whatever the device."""
    densify = densifying("default", max_gaussians=400)
    config = CoarseConfig.model_validate({"densify": densify}).densify
    found = []
    for device in (torch.device("cpu"), elsewhere):
        parameters = scene.to(device).gaussians.parameters()
        if strategy is DefaultStrategy:
            made = DefaultStrategy(config, 20.0, 10, len(scene.gaussians), seed=4, device=device)
            chosen = torch.ones(len(scene.gaussians), dtype=torch.bool, device=device)
            means = made.children(parameters, chosen)["means"]
        else:
            means = MCMCStrategy(config, 20.0, 10, seed=4).grow(parameters).new_gaussians["means"]
        assert means.device == device
        found.append(means.cpu())
    torch.testing.assert_close(found[1], found[0], rtol=1e-5, atol=1e-5)


def test_a_scene_is_saved_from_any_device(scene: Scene, elsewhere: torch.device, tmp_path: Path) -> None:
    there = scene.to(elsewhere)
    assert there.device == elsewhere
    assert there.to(elsewhere) is there
    assert scene.to("cpu") is scene
    there.save(tmp_path / "scene")
    found = Scene.load(tmp_path / "scene")
    assert found.device == torch.device("cpu")
    assert found.light is not None
    assert scene.light is not None
    for name, value in {**scene.gaussians.parameters(), **scene.light.parameters()}.items():
        read = {**found.gaussians.parameters(), **found.light.parameters()}[name]
        assert torch.equal(read, value)
