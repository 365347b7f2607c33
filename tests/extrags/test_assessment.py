from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from extrags.assessment import assess, measure, probe_views
from extrags.cameras import rotation_angle_deg
from extrags.config import (
    PROFILES,
    AssessConfig,
    EnhanceConfig,
    ExploreConfig,
    FinetuneConfig,
    PipelineConfig,
)
from extrags.errors import CaptureError, ConfigError
from extrags.run_costs import Workload, packaged_model
from extrags.scene import Scene
from extrags.scene_plan import ScenePlan, decide
from extrags.stages import modelled_tasks

from .exploration.tube import Tube, make_ball, make_tube, small_tube

STAGES = ("surface", "freespace", "explore", "enhance", "finetune")


def config(**assess_settings: object) -> PipelineConfig:
    return PipelineConfig(
        assess=AssessConfig.model_validate({"probe_views": 8} | assess_settings),
        explore=ExploreConfig(render_width=32),
    )


@cache
def ball_plan(force: bool = False) -> ScenePlan:
    ball = make_ball()
    return assess(ball.scene, ball.sequence, config(force=force))


@cache
def tube_plan() -> ScenePlan:
    return assess(small_tube().scene, small_tube().sequence, config())


def with_gap(tube: Tube) -> Scene:
    """The same tube with a third of its wall cut out."""
    means = tube.scene.gaussians.means
    keep = torch.atan2(means[:, 2], torch.hypot(means[:, 0], means[:, 1]) - 60) < 1.0
    return Scene(tube.scene.gaussians.subset(keep), tube.scene.light)


class TestAssess:
    def test_a_scene_seen_from_all_sides_needs_nothing(self):
        plan = ball_plan()
        assert plan.measurements["hole_share"] == 0
        assert plan.measurements["lacking_share"] <= 0.005
        assert [line.stage for line in plan.decisions] == list(STAGES)
        for line in plan.decisions:
            assert line.run == (line.stage == "finetune")
            assert line.value == plan.measurements["lacking_share"]
            assert line.threshold == 0.015
            assert "no more than 1.50 %" in line.reason
            assert line.budget == ({"judge.enabled": False} if line.run else {})
        assert "on real views alone" in plan.decision("finetune").reason
        assert not plan.applied_to(config()).finetune.judge.enabled

    def test_without_settings_it_is_the_default_profile(self):
        scene, sequence = with_gap(small_tube()), small_tube().sequence
        balanced = PROFILES["balanced"]
        plan = assess(scene, sequence)
        assert plan == decide(measure(scene, sequence, balanced.assess, balanced.explore.coverage), balanced)
        assert plan.decision("enhance").run

    def test_what_a_decision_saves_is_what_the_stage_would_cost(self):
        plan, settings = ball_plan(), config()
        sequence = make_ball().sequence
        frames, pixels = len(sequence.train), sequence.width * sequence.height
        assert (plan.measurements["pixels"], plan.measurements["width"]) == (pixels, sequence.width)
        gaussians = plan.measurements["gaussians"]
        work = Workload(pixels, frames, frames, 0, settings, width=sequence.width, coarse_gaussians=gaussians)
        model = packaged_model()
        for line in plan.decisions:
            tasks = ("finetune-judge",) if line.stage == "finetune" else modelled_tasks(line.stage)
            whole = sum(model.predict(task, work).seconds for task in tasks)
            assert line.saves_s == pytest.approx(whole, abs=0.051)
            assert line.saves_s > 0
        # With the whole of the budgets nothing is saved.
        assert [line.saves_s for line in ball_plan(force=True).decisions] == [0, 0, 0, 0, 0]
        # Without the size of frames nothing is known of it.
        assert decide({"lacking_share": 0.0}, settings).decision("explore").saves_s is None

    def test_a_scene_that_is_kept_is_not_fine_tuned_without_virtual_views(self):
        settings = PipelineConfig(finetune=FinetuneConfig(keep_scene=True))
        line = decide({"lacking_share": 0.0}, settings).decision("finetune")
        assert not line.run
        assert line.budget == {}
        assert decide({"lacking_share": 1.0}, settings).decision("finetune").run

    def test_force_runs_all_the_same(self):
        plan = ball_plan(force=True)
        assert plan.measurements == ball_plan().measurements
        assert all(line.run for line in plan.decisions)
        assert "assess.force is set" in plan.decision("explore").reason
        assert plan.decision("explore").budget == {"trajectories": 20}

    def test_a_tube_seen_along_its_axis_is_explored(self):
        plan = tube_plan()
        assert plan.measurements["unresolved_share"] > 0.05
        assert plan.measurements["hole_share"] < 0.05
        assert all(line.run for line in plan.decisions)
        assert re.search(
            r"^holes and unresolved surface are [\d.]+ % of nearby views, more than 1.50 %",
            plan.decision("explore").reason,
        )

    def test_a_gap_in_the_wall_shows_as_holes(self):
        tube = small_tube()
        holes = assess(with_gap(tube), tube.sequence, config()).measurements
        whole = tube_plan().measurements
        assert holes["hole_share"] > whole["hole_share"] + 0.1
        assert holes["training_hole_share"] > whole["training_hole_share"] + 0.1

    def test_what_lies_outside_the_masks_was_not_seen(self):
        tube = small_tube()
        mask = np.zeros_like(tube.sequence.mask)
        mask[:, :, : mask.shape[2] // 2] = True
        half = assess(tube.scene, replace(tube.sequence, mask=mask), config()).measurements
        whole = tube_plan().measurements
        assert half["gaussians_unseen_share"] > whole["gaussians_unseen_share"] + 0.05
        assert half["directions_mean"] < whole["directions_mean"]

    def test_holes_outside_the_masks_of_training_views_do_not_count(self):
        tube = small_tube()
        scene = with_gap(tube)
        found = assess(scene, tube.sequence, config()).measurements
        with torch.no_grad():
            alpha = scene.render(tube.sequence.cameras).alpha.numpy()
        seen = replace(tube.sequence, mask=alpha >= AssessConfig().hole_alpha)
        assert found["training_hole_share"] > 0.1
        assert assess(scene, seen, config()).measurements["training_hole_share"] < 0.02

    def test_speckled_masks_are_no_empty_views(self):
        """At half the size every pixel has a part that does not count."""
        tube = small_tube()
        speckled = np.ones_like(tube.sequence.mask)
        speckled[:, ::2, ::2] = False
        small = config().with_overrides({"explore.render_width": tube.sequence.width // 2})
        found = assess(tube.scene, replace(tube.sequence, mask=speckled), small).measurements
        whole = assess(tube.scene, tube.sequence, small).measurements
        assert found["lacking_share"] == pytest.approx(whole["lacking_share"], abs=0.02)

    def test_a_pixel_that_is_partly_outside_the_mask_saw_nothing(self):
        tube = small_tube()
        small = config().with_overrides({"explore.render_width": tube.sequence.width // 2})

        def found(columns: int) -> dict[str, float]:
            mask = np.zeros_like(tube.sequence.mask)
            mask[:, :, :columns] = True
            return assess(tube.scene, replace(tube.sequence, mask=mask), small).measurements

        # A column more is half a pixel of the small views, and two more are a whole one.
        assert found(25) == found(24) != found(26)

    def test_surface_is_resolved_by_as_many_pixels_as_are_asked_for(self):
        tube = small_tube()
        shares = [
            assess(tube.scene, tube.sequence, config(sufficient_resolution=enough)).measurements
            for enough in (1e-6, 0.4, 1e6)
        ]
        none, usual, all_of_it = (found["unresolved_share"] for found in shares)
        assert none < 0.5 * usual
        assert all_of_it == pytest.approx(1 - shares[2]["hole_share"], abs=0.05)
        assert len({found["hole_share"] for found in shares}) == 1

    def test_what_is_unresolved_counts_by_its_weight(self):
        tube = small_tube()
        found = assess(tube.scene, tube.sequence, config(unresolved_weight=0.25)).measurements
        expected = found["hole_share"] + 0.25 * found["unresolved_share"]
        assert found["lacking_share"] == pytest.approx(expected)
        holes = assess(tube.scene, tube.sequence, config(unresolved_weight=0)).measurements
        assert holes["lacking_share"] == holes["hole_share"]
        assert holes["worst_probe_lacking_share"] >= holes["hole_share"]

    def test_how_many_gaussians_a_surface_is_made_of_makes_little_difference(self):
        tube = small_tube()
        gaussians = tube.scene.gaussians
        # Two in one place let as much through as one.
        half = 1 - (1 - gaussians.opacities.sigmoid()).sqrt()
        twice = gaussians.subset(torch.arange(2 * len(gaussians)) // 2)
        twice = replace(twice, opacities=half.logit().repeat_interleave(2))
        found = assess(Scene(twice, tube.scene.light), tube.sequence, config()).measurements
        once = tube_plan().measurements
        assert found["gaussians"] == 2 * once["gaussians"]
        assert found["hole_share"] == pytest.approx(once["hole_share"], abs=1e-3)
        # Of surface that is half transparent, and of edges, other views show another half.
        assert found["unresolved_share"] == pytest.approx(once["unresolved_share"], rel=0.2)

    def test_what_is_faint_in_holes_is_no_unresolved_surface_as_well(self):
        tube = small_tube()
        settings = config(sufficient_resolution=1e6, hole_alpha=0.99, unresolved_weight=1)
        found = assess(with_gap(tube), tube.sequence, settings).measurements
        assert found["hole_share"] > 0.3
        assert found["worst_probe_lacking_share"] <= 1

    def test_masks_that_leave_nothing_out_change_nothing(self):
        whole = replace(small_tube().sequence, mask=np.ones_like(small_tube().sequence.mask))
        assert assess(small_tube().scene, whole, config()) == tube_plan()

    def test_the_budget_follows_the_need(self):
        tube = small_tube()
        lacking = tube_plan().measurements["lacking_share"]
        for full, expected in ((min(1.0, 2 * lacking), 0.5), (lacking / 2, 1.0)):
            plan = assess(tube.scene, tube.sequence, config(full_budget_share=full))
            share = lacking / full if expected < 1 else 1.0
            assert plan.decision("explore").budget["trajectories"] == int(np.ceil(share * 20))

    def test_a_part_of_a_trajectory_is_a_whole_one(self):
        settings = config(full_budget_share=0.5)
        plan = decide({"lacking_share": 0.255}, settings)
        assert plan.decision("explore").budget == {"trajectories": 11}

    def test_the_start_of_a_trajectory_is_no_virtual_view(self):
        settings = config(full_budget_share=0.5).with_overrides({"explore.length": 5})
        plan = decide({"lacking_share": 0.05}, settings)
        assert plan.decision("explore").budget == {"trajectories": 2}
        assert plan.decision("enhance").budget == {"max_views": 8}

    def test_no_more_trajectories_than_views_that_are_restored(self):
        # With more, restoration would have to leave some without a view, after all of them were searched.
        settings = PipelineConfig(enhance=EnhanceConfig(max_views=2))
        plan = decide({"lacking_share": 1.0}, settings)
        assert plan.decision("explore").budget == {"trajectories": 2}
        assert plan.decision("enhance").budget == {"max_views": 2}
        assert "2 of 20 trajectories" in plan.decision("explore").reason
        assert "enhance.max_views=2 allows no more" in plan.decision("explore").reason

    @pytest.mark.parametrize(
        ("settings", "said"),
        [
            ({}, "embedded network in as many steps as its weights say, or by blending and filling where"),
            ({"enhance.judge": False, "enhance.steps": 4}, "restored by the embedded network in 4 steps$"),
            ({"enhance.train_iterations": 100}, "in as many steps as validation pairs of the scene decide"),
            ({"enhance.backend": "classical"}, "restored by blending and filling, without a network$"),
            ({"enhance.backend": "ltx", "enhance.steps": 1}, "restored by ltx in 1 step$"),
            ({"enhance.backend": "ltx"}, "restored by ltx$"),
        ],
    )
    def test_it_says_what_will_restore_the_virtual_views(self, settings: dict[str, object], said: str):
        plan = decide({"lacking_share": 0.5}, PipelineConfig().with_overrides(settings))
        assert re.search(said, plan.decision("enhance").reason)

    def test_every_number_is_finite_and_every_share_a_share(self):
        for plan in (tube_plan(), ball_plan()):
            for name, value in plan.measurements.items():
                assert np.isfinite(value), name
                if name.endswith("_share"):
                    assert 0 <= value <= 1, name

    def test_more_training_views_leave_less_to_explore(self):
        tube = make_tube(n_gaussians=800, n_views=12, width=32, height=24, view_arc=(0.1, 1.6))
        few = replace(tube.sequence, split=replace(tube.sequence.split, train=np.array([5])))
        settings = config()
        assert (
            assess(tube.scene, few, settings).measurements["unresolved_share"]
            > assess(tube.scene, tube.sequence, settings).measurements["unresolved_share"]
        )

    def test_is_deterministic(self):
        assert assess(small_tube().scene, small_tube().sequence, config()) == tube_plan()

    def test_one_training_view_works(self):
        tube = small_tube()
        one = replace(tube.sequence, split=replace(tube.sequence.split, train=np.array([3])))
        assert assess(tube.scene, one, config()).measurements["training_views"] == 1

    def test_nothing_to_assess_is_refused(self):
        tube = small_tube()
        empty = Scene(tube.scene.gaussians.subset(torch.zeros(len(tube.scene.gaussians), dtype=torch.bool)))
        with pytest.raises(CaptureError, match="nothing to assess with 0 Gaussians"):
            assess(empty, tube.sequence, config())

    def test_views_of_nothing_are_refused(self):
        tube = small_tube()
        away = replace(tube.scene.gaussians, means=tube.scene.gaussians.means + 1e5)
        with pytest.raises(CaptureError, match="none of the 8 training views sees a surface"):
            assess(Scene(away), tube.sequence, config())


class TestScenePlan:
    def test_json_round_trip(self):
        plan = tube_plan()
        assert ScenePlan.model_validate_json(plan.model_dump_json()) == plan

    def test_budgets_go_into_the_settings(self):
        settings = config()
        planned = tube_plan().applied_to(settings)
        budget = tube_plan().decision("explore").budget
        assert planned.explore.trajectories == budget["trajectories"]
        assert planned.explore.length == settings.explore.length
        assert planned.coarse == settings.coarse

    def test_an_unknown_stage_is_refused(self):
        with pytest.raises(ConfigError, match="no line for 'coarse'"):
            tube_plan().decision("coarse")


class TestProbeViews:
    def test_stand_beside_the_training_views(self):
        tube = small_tube()
        settings = AssessConfig(probe_views=16)
        probes = probe_views(tube.scene, tube.cameras, 26.0, settings)
        assert len(probes) == 16
        apart = np.linalg.norm(probes.centers[:, None] - tube.cameras.centers[None], axis=-1).min(axis=1)
        assert apart.max() <= 0.35 * 26.0 + 1e-9
        assert (tube.distance_from_wall(probes.centers) > 2).all()
        rotation = probes.world_from_camera[:, :3, :3]
        np.testing.assert_allclose(np.linalg.det(rotation), 1)

    def test_turn_to_both_sides(self):
        tube = small_tube()
        settings = AssessConfig(probe_views=8)
        probes = probe_views(tube.scene, tube.cameras, 26.0, settings)
        turned = [
            rotation_angle_deg(
                tube.cameras.world_from_camera[:, :3, :3], np.broadcast_to(pose[:3, :3], (8, 3, 3))
            )
            for pose in probes.world_from_camera
        ]
        # Each is turned by 35 degrees from its own training view.
        assert np.allclose(np.abs(np.stack(turned) - 35.0).min(axis=1), 0, atol=1e-6)

    def test_turn_in_turns_towards_the_shift_and_away_from_it(self):
        tube = make_tube(n_gaussians=800, n_views=1, width=32, height=24)
        probes = probe_views(tube.scene, tube.cameras, 26.0, AssessConfig(probe_views=6))
        start = tube.cameras.world_from_camera[0]
        shifts = (probes.centers - start[:3, 3]) @ start[:3, :3]
        axes = probes.world_from_camera[:, :3, 2] @ start[:3, :3]
        assert (np.linalg.norm(shifts, axis=1) > 1).all()
        np.testing.assert_array_equal(np.sign((shifts * axes).sum(axis=1)), [1, -1] * 3)

    def test_do_not_enter_the_tissue(self):
        # A camera 3 mm from the wall: shifts towards it are cut short.
        tube = make_tube(n_gaussians=1500, n_views=1, width=32, height=24)
        pose = tube.cameras.world_from_camera.copy()
        outward = pose[0, :3, 3] / np.linalg.norm(pose[0, :3, 3])
        pose[0, :3, 3] += 17 * outward
        near = replace(tube.cameras, world_from_camera=pose)
        probes = probe_views(tube.scene, near, 26.0, AssessConfig(probe_views=12))
        assert (tube.distance_from_wall(probes.centers) > 1.5).all()
