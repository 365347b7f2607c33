"""Rounds of the fine-tuning: what each begins with, and what its virtual views show."""

from __future__ import annotations

import gc
import inspect
import weakref
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from extrags.config import PROFILES, DensifyConfig, FinetuneConfig
from extrags.events import Event, Progress, subscribed
from extrags.pseudo_views import PseudoViews
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training import TrainingResult, finetuning
from extrags.training.finetuning import finetune
from extrags.training.schedule import Schedule
from extrags.training.views import View
from extrags.training.virtual_views import shown_again, virtual_steps
from tests.extrags.training.plain_finetuning import COARSE, N_GAUSSIANS, Run, config_of, virtual_index

STEP = 1 / 255


@pytest.fixture
def rounds(monkeypatch: pytest.MonkeyPatch) -> list[Run]:
    """What each round would optimise; every one leaves the scene brighter."""
    runs: list[Run] = []

    def taken(start: Scene, draw: Callable[[int], View], schedule: Schedule, **_: Any) -> TrainingResult:
        runs.append(Run(start, draw, schedule))
        return TrainingResult(brighter(start), [{"iteration": schedule.iterations - 1.0, "loss": 0.0}])

    monkeypatch.setattr(finetuning, "optimise", taken)
    return runs


def brighter(scene: Scene) -> Scene:
    return Scene(replace(scene.gaussians, sh0=scene.gaussians.sh0 + 0.1), scene.light)


class TestShownAgain:
    @pytest.mark.parametrize(("known", "invented"), [(0.6, 0.6), (0.0, 0.7), (1.0, 1.0)])
    def test_is_what_was_restored_and_the_scene_as_far_as_it_has_a_surface(
        self, scene: Scene, pseudo: PseudoViews, known: float, invented: float
    ) -> None:
        config = FinetuneConfig(known_share=known, invented_share=invented)
        changed = brighter(scene)
        found, alpha = shown_again(pseudo, changed, config)
        with torch.no_grad():
            rendering = changed.render(pseudo.cameras)
        np.testing.assert_allclose(alpha, rendering.alpha.numpy(), rtol=0, atol=1e-6)
        shown = rendering.rgb.double().numpy()
        opacity = rendering.alpha.double().numpy()
        u = pseudo.uncertainty.astype(np.float64)
        of_scene = opacity * ((1 - known) * (1 - u) + (1 - invented) * u)
        expected = pseudo.restored + of_scene[..., None] * (shown - pseudo.restored)
        assert np.abs(found.target - expected.clip(0, 1)).max() <= STEP / 2 + 1e-5
        assert np.array_equal(found.restored, found.target)
        # As they are stored, so that one step's worth of memory holds them.
        assert np.array_equal(found.target, np.rint(found.target * 255).astype(np.float32) / np.float32(255))

    def test_the_surface_is_the_scenes_where_it_has_one(self, scene: Scene, pseudo: PseudoViews) -> None:
        thin = Scene(replace(scene.gaussians, opacities=scene.gaussians.opacities - 3), scene.light)
        found, alpha = shown_again(pseudo, thin, FinetuneConfig())
        with torch.no_grad():
            depth_mm = thin.render(pseudo.cameras).depth.numpy()
        solid = alpha > 0.5
        assert 0.1 < solid.mean() < 0.9
        np.testing.assert_allclose(found.depth_mm[solid], depth_mm[solid], rtol=1e-5)
        assert np.array_equal(found.depth_mm[~solid], pseudo.depth_mm[~solid])

    def test_all_else_stays(self, scene: Scene, pseudo: PseudoViews) -> None:
        found, _ = shown_again(pseudo, scene, FinetuneConfig())
        for name in ("rendered", "alpha", "uncertainty", "pixel_confidence", "image_confidence", "cameras"):
            assert getattr(found, name) is getattr(pseudo, name), name


class TestRounds:
    def test_progress_counts_all_of_them(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews
    ) -> None:
        seen: list[Event] = []
        with subscribed(seen.append):
            finetune(scene, sequence, pseudo, config_of("weighted_mean", iterations=5, rounds=2), COARSE)
        told = [(event.done, event.total) for event in seen if isinstance(event, Progress)]
        assert told == [(1, 5), (2, 5), (3, 5), (5, 5)]

    def test_each_goes_on_from_the_one_before(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews, rounds: list[Run]
    ) -> None:
        config = config_of("weighted_mean", iterations=50, rounds=3)
        result = finetune(scene, sequence, pseudo, config, COARSE)
        assert [run.schedule.iterations for run in rounds] == [17, 16, 17]
        assert [entry["iteration"] for entry in result.history] == [16, 32, 49]
        for number, run in enumerate(rounds):
            brightness = run.start.gaussians.sh0 - scene.gaussians.sh0
            torch.testing.assert_close(brightness, torch.full_like(brightness, 0.1 * number))
        assert torch.equal(result.scene.gaussians.sh0, brighter(rounds[-1].start).gaussians.sh0)

    def test_in_each_the_share_of_virtual_views_falls_to_its_end(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews, rounds: list[Run]
    ) -> None:
        config = config_of("paper", iterations=100, rounds=2, pseudo_share=0.8, pseudo_share_final=0.0)
        finetune(scene, sequence, pseudo, config, COARSE)
        alone = FinetuneConfig(iterations=50, pseudo_share=0.8, pseudo_share_final=0.0)
        for run in rounds:
            assert [run.draw(step).frame is None for step in range(50)] == virtual_steps(alone).tolist()

    def test_virtual_views_of_later_rounds_show_what_the_scene_has_become(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews, rounds: list[Run]
    ) -> None:
        config = config_of("weighted_mean", iterations=40, rounds=2)
        finetune(scene, sequence, pseudo, config, COARSE)
        again, _ = shown_again(pseudo, brighter(scene), config)
        for run, expected in zip(rounds, (pseudo.target, again.target), strict=True):
            drawn = [run.draw(step) for step in range(20)]
            virtual = [view for view in drawn if view.frame is None]
            assert virtual
            for view in virtual:
                np.testing.assert_allclose(
                    view.colors.numpy(), expected[virtual_index(view, pseudo)], rtol=0, atol=1e-6
                )

    def test_what_is_still_a_hole_gets_gaussians(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """With the opacity of the scene as it is by then; what shields other views is what was restored."""
        asked: list[tuple[PseudoViews, np.ndarray | None, int]] = []

        def recorded(scene: Scene, _: object, views: PseudoViews, room: int, **options: Any) -> None:
            asked.append((views, options["alpha"], room))

        monkeypatch.setattr(finetuning, "hole_gaussians", recorded)
        monkeypatch.setattr(
            finetuning, "optimise", lambda start, *_, **__: TrainingResult(brighter(start), [])
        )
        config = config_of("weighted_mean", rounds=2, growth=2.0, seed_holes=True)
        coarse = COARSE.model_copy(update={"densify": DensifyConfig(max_gaussians=N_GAUSSIANS)})
        finetune(scene, sequence, pseudo, config, coarse)
        (first, none, less), (second, alpha, room) = asked
        assert first is second is pseudo
        assert none is None
        assert alpha is not None
        with torch.no_grad():
            np.testing.assert_allclose(alpha, scene.render(pseudo.cameras).alpha.numpy(), rtol=0, atol=1e-6)
        # The last round has room left.
        assert (less, room) == (round(0.6 * N_GAUSSIANS), N_GAUSSIANS)

    def test_real_views_alone_have_one(
        self, scene: Scene, sequence: EndoscopicSequence, rounds: list[Run]
    ) -> None:
        config = config_of("weighted_mean", iterations=40, rounds=2, growth=2.0)
        coarse = COARSE.model_copy(update={"densify": DensifyConfig(max_gaussians=N_GAUSSIANS)})
        finetune(scene, sequence, None, config, coarse)
        (run,) = rounds
        assert run.schedule.iterations == 40
        assert run.schedule.densify.max_gaussians == 2 * N_GAUSSIANS

    def test_virtual_views_are_loaded_once_a_round_and_dropped(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        made: list[weakref.ref[PseudoViews]] = []
        alive: list[list[bool]] = []

        def stored() -> PseudoViews:
            views = pseudo.quantised()
            made.append(weakref.ref(views))
            return views

        def optimised(start: Scene, *_: object, **__: object) -> TrainingResult:
            gc.collect()
            alive.append([views() is not None for views in made])
            return TrainingResult(start, [])

        monkeypatch.setattr(finetuning, "optimise", optimised)
        inspect.unwrap(finetune)(scene, sequence, stored, FinetuneConfig(iterations=2, rounds=2), COARSE)
        assert alive == [[False], [False, False]]

    def test_a_kept_scene_stays_in_all_of_them(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews
    ) -> None:
        holes = replace(pseudo, alpha=np.zeros_like(pseudo.alpha))
        config = config_of("paper", growth=2.0, seed_holes=True, keep_scene=True, rounds=2)
        found = finetune(scene, sequence, holes, config, COARSE).scene.gaussians
        assert len(found) > N_GAUSSIANS
        for name, values in scene.detached().gaussians.parameters().items():
            assert torch.equal(found.parameters()[name][:N_GAUSSIANS], values), name


def assert_same_scene(one: Scene, other: Scene) -> None:
    for name, values in one.detached().gaussians.parameters().items():
        assert torch.equal(other.detached().gaussians.parameters()[name], values), name
    assert one.light is not None
    assert other.light is not None
    for name, values in one.light.detached().parameters().items():
        assert torch.equal(other.light.detached().parameters()[name], values), name


class TestHolesOnly:
    """Real views train the scene alone, and virtual ones fill its holes."""

    def test_is_one_after_the_other(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews
    ) -> None:
        holes = replace(pseudo, alpha=np.zeros_like(pseudo.alpha))
        config = config_of("paper", growth=2.0, seed_holes=True, holes_only=True, rounds=2, iterations=6)
        whole = finetune(scene, sequence, holes, config, COARSE)
        alone = finetune(scene, sequence, None, config, COARSE)
        plain = config.model_copy(update={"holes_only": False})
        assert_same_scene(alone.scene, finetune(scene, sequence, None, plain, COARSE).scene)
        filling = plain.model_copy(update={"keep_scene": True, "rounds": 1, "iterations": 3})
        filled = finetune(alone.scene, sequence, holes, filling, COARSE)
        assert len(filled.scene.gaussians) > len(alone.scene.gaussians)
        assert_same_scene(whole.scene, filled.scene)
        later = [{**entry, "iteration": entry["iteration"] + 6} for entry in filled.history]
        assert whole.history == [*alone.history, *later]

    def test_progress_is_of_both(
        self, scene: Scene, sequence: EndoscopicSequence, pseudo: PseudoViews, rounds: list[Run]
    ) -> None:
        holes = replace(pseudo, alpha=np.zeros_like(pseudo.alpha))
        config = config_of("paper", growth=2.0, seed_holes=True, holes_only=True, iterations=6)
        finetune(scene, sequence, holes, config, COARSE)
        asked = [run.schedule for run in rounds]
        spans = [(each.iterations_before, each.iterations, each.iterations_after) for each in asked]
        assert spans == [(0, 6, 3), (6, 3, 0)]
        # The light comes to rest on real views, and stays.
        assert [each.light_cooldown_share for each in asked] == [config.light_cooldown_share, 0]
        assert [each.light.falloff for each in asked] == [COARSE.light.falloff, False]


class TestFirstRound:
    @pytest.mark.parametrize("profile", ["quick", "balanced"])
    def test_has_its_steps_and_its_room(self, profile: str) -> None:
        config = PROFILES[profile].finetune
        alone = config.first_round
        assert (alone.rounds, alone.iterations) == (1, config.iterations // config.rounds)
        assert alone.growth == pytest.approx(0.8 * config.growth)

    def test_of_one_is_all(self) -> None:
        config = PROFILES["paper"].finetune
        assert config.first_round == config

    def test_every_round_has_a_step(self) -> None:
        with pytest.raises(ValidationError, match="3 rounds of 2 iterations"):
            FinetuneConfig(iterations=2, rounds=3)
