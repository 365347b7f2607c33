"""Restorers side by side on held-out views: cases, recipes, and what cannot be compared."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from extrags.config import CoarseConfig, EnhanceConfig, PipelineConfig
from extrags.config.backends import BACKENDS
from extrags.errors import CaptureError, ConfigError
from extrags.metrics.registry import figures
from extrags.restoration.benchmark import comparison as bench
from extrags.restoration.benchmark.comparison import bench_enhance, check_methods, compare_methods, prepared
from extrags.restoration.benchmark.variants import WithoutReferences
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.network import build_network
from extrags.view_synthesis.conditioning import CONDITION_CHANNELS
from extrags.view_synthesis.gamut import Gamut
from tests.extrags.lit_tube import Tube


class TestBench:
    CONFIG = PipelineConfig(enhance=EnhanceConfig(references=4, seed=3))

    def test_cases(self, tube: Tube) -> None:
        methods = [
            "none",
            "classical",
            "classical/no-references",
            "classical/textured",
            "classical/refined",
            "classical/keyframes",
        ]
        cases = compare_methods(tube.scene, tube.sequence, self.CONFIG, methods, None)
        assert [case["method"] for case in cases] == methods
        for case in cases:
            assert case["sequence"] == "test/tube"
            assert case["seed"] == 3
            assert case["steps"] is None
            assert case["views"] == 2
            assert case["seconds_per_frame"] > 0
            measured = {figure.key for figure in figures("restoration")}
            assert {"psnr", "ssim"} <= set(case["well"]) <= measured
            assert not any(key.startswith("lpips") for key in case["well"]), "nobody asked for it"
        # The gap in the wall is filled; exact references are worth something on top.
        none, classical, alone, _, _, _ = (case["psnr"] for case in cases)
        assert none + 10 < alone < classical - 0.5
        assert [case["keyframes"] > 0 for case in cases] == [False] * 5 + [True]
        # The tube's wall is plain: no texture to lay down, so that nothing gets worse by it.
        assert cases[3]["psnr"] == pytest.approx(classical, abs=0.3)
        json.dumps(cases, allow_nan=False)

    def test_views_have_the_working_width(self, tube: Tube, monkeypatch: pytest.MonkeyPatch) -> None:
        widths = []
        clips = bench.held_out_clips
        monkeypatch.setattr(
            bench,
            "held_out_clips",
            lambda scene, references, sequence, *given, **settings: (
                widths.append((references.packed.shape[-1], sequence.width))
                or clips(scene, references, sequence, *given, **settings)
            ),
        )
        assert tube.sequence.width > 32
        compare_methods(tube.scene, tube.sequence, self.CONFIG, ["none"], None)
        narrow = PipelineConfig(enhance=EnhanceConfig(references=4, max_width=32))
        compare_methods(tube.scene, tube.sequence, narrow, ["none"], None)
        assert widths == [(tube.sequence.width, tube.sequence.width), (32, 32)]

    def test_equal_recipes_are_followed_once(self, tube: Tube, monkeypatch: pytest.MonkeyPatch) -> None:
        network = build_network(CONDITION_CHANNELS, (8, 8, 16), torch.Generator()).eval()
        gamut = Gamut.of_images(torch.rand(1, 3, 32, 32), torch.ones(1, 1, 32, 32))
        made = []

        def recipe(*_given: object) -> EmbeddedEnhancer:
            made.append(EmbeddedEnhancer(network, 2, 1, 0, False, gamut, {}))
            return made[-1]

        monkeypatch.setitem(bench.RECIPES, "embedded", recipe)
        names = ["embedded", "embedded-1", "embedded-4/no-references"]
        found = list(
            prepared(names, tube.scene, tube.sequence, EnhanceConfig(), CoarseConfig())  # type: ignore[arg-type]
        )
        assert len(made) == 1
        assert [name for name, _, _ in found] == names
        first, one, four = (enhancer for _, enhancer, _ in found)
        assert first is made[0]
        assert isinstance(one, EmbeddedEnhancer)
        assert one.steps == 1
        assert isinstance(four, WithoutReferences)
        assert isinstance(four.enhancer, EmbeddedEnhancer)
        assert four.enhancer.steps == 4

    def test_every_method_has_its_recipe(self) -> None:
        assert {method.recipe for method in bench.METHODS.values()} <= set(bench.RECIPES)
        assert not set(bench.METHODS) & set(BACKENDS)
        assert check_methods(["none", "none", "scratch/no-references"]) == ["none", "scratch/no-references"]

    @pytest.mark.parametrize("names", [["telea"], ["none", "embedded/without"], []])
    def test_unknown_methods(self, names: list[str]) -> None:
        with pytest.raises(ConfigError, match=r"expected none, embedded-1.* embedded, classical"):
            check_methods(names)

    def test_what_cannot_be_judged(self, tube: Tube) -> None:
        unposed = replace(tube.sequence, world_from_camera=None)
        with pytest.raises(CaptureError, match="no poses"):
            bench_enhance([unposed], self.CONFIG)
        with pytest.raises(CaptureError, match="no held-out frames"):
            bench_enhance([tube.sequence.training_part()], self.CONFIG)
        with pytest.raises(ConfigError, match="unknown methods"):
            bench_enhance([], self.CONFIG, methods=["magic"])
