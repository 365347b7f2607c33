from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from extrags.errors import ShapeError
from extrags.gaussians import SH_C0, Gaussians
from extrags.scene import Scene
from extrags.view_synthesis.conditioning import observe_views
from extrags.view_synthesis.gather import gather_references
from extrags.view_synthesis.references import ReferenceViews
from extrags.view_synthesis.shrinkage import NEIGHBOURS, PRIOR_PX, color_support, shrunk_sh0

from ..lit_tube import Tube, build_tube

GREY = 0.5


def sheet(n: int = 400) -> Scene:
    """Grey Gaussians on a plane."""
    generator = np.random.default_rng(7)
    points = np.concatenate([generator.uniform(-10, 10, (n, 2)), np.full((n, 1), 20.0)], axis=1)
    return Scene(Gaussians.from_points(points, np.full((n, 3), GREY), np.full(n, 0.7), opacity=0.5))


def colors(sh0: Tensor) -> Tensor:
    return sh0[:, 0] * SH_C0 + 0.5


def with_red(scene: Scene, index: int) -> Scene:
    sh0 = scene.gaussians.sh0.clone()
    sh0[index, 0] = torch.tensor([0.4, -0.4, -0.4]) / SH_C0
    return Scene(replace(scene.gaussians, sh0=sh0), scene.light)


class TestShrunkColours:
    def test_a_colour_moves_by_what_its_neighbours_are_worth(self):
        scene = with_red(sheet(), 3)
        own = colors(scene.gaussians.sh0)[3]
        for pixels in (0.0, PRIOR_PX, 9 * PRIOR_PX):
            support = torch.full((400,), 50.0)
            support[3] = pixels
            found = colors(shrunk_sh0(scene, support))[3]
            share = PRIOR_PX / (pixels + PRIOR_PX)
            torch.testing.assert_close(found, own + share * (GREY - own), atol=1e-6, rtol=1e-5)

    def test_it_is_the_formula(self):
        """Against sums in float64 over neighbours that are looked for one by one."""
        scene, generator = sheet(60), torch.Generator().manual_seed(1)
        gaussians = replace(
            scene.gaussians,
            sh0=torch.randn(60, 1, 3, generator=generator),
            opacities=torch.randn(60, generator=generator),
        )
        support = 30 * torch.rand(60, generator=generator)
        found = shrunk_sh0(Scene(gaussians), support)
        means, own = gaussians.means.double(), gaussians.sh0[:, 0].double()
        weight = support.double() * gaussians.opacities.double().sigmoid()
        for index in range(60):
            distance = (means - means[index]).norm(dim=1)
            near = distance.argsort()[1 : NEIGHBOURS + 1]
            mean = (own[near] * weight[near, None]).sum(0) / weight[near].sum()
            pixels = float(support[index])
            expected = (pixels * own[index] + PRIOR_PX * mean) / (pixels + PRIOR_PX)
            torch.testing.assert_close(found[index, 0].double(), expected, atol=2e-6, rtol=2e-6)

    def test_one_colour_stays(self):
        scene = sheet()
        torch.testing.assert_close(
            shrunk_sh0(scene, torch.rand(400)), scene.gaussians.sh0, atol=1e-6, rtol=1e-6
        )

    def test_where_no_neighbour_was_seen_colours_stay(self):
        scene = with_red(sheet(), 3)
        assert torch.equal(shrunk_sh0(scene, torch.zeros(400)), scene.gaussians.sh0)

    def test_one_gaussian_has_no_neighbour(self):
        scene = with_red(sheet(1), 0)
        assert torch.equal(shrunk_sh0(scene, torch.ones(1)), scene.gaussians.sh0)

    def test_two_gaussians_are_neighbours_of_each_other(self):
        scene = with_red(sheet(2), 1)
        own = scene.gaussians.sh0
        found = shrunk_sh0(scene, torch.full((2,), PRIOR_PX))
        torch.testing.assert_close(found, own.mean(dim=0, keepdim=True).expand_as(own))

    @pytest.mark.parametrize("copies", [2, NEIGHBOURS, 3 * NEIGHBOURS])
    def test_none_is_a_neighbour_of_itself_where_several_share_a_place(self, copies: int):
        """The only red one of them, without support, takes the others' colour: its own is not in the mean."""
        scene = sheet()
        means = scene.gaussians.means.clone()
        means[:copies] = means[0]
        alone = replace(scene.gaussians, means=means)
        for index in (0, copies - 1):
            red = with_red(Scene(alone), index)
            support = torch.full((400,), 1e6)
            support[index] = 0
            found = colors(shrunk_sh0(red, support))[index]
            torch.testing.assert_close(found, torch.full((3,), GREY), atol=1e-4, rtol=0)
            support[index] = 1e6
            others = colors(shrunk_sh0(red, support))
            torch.testing.assert_close(others[index], colors(red.gaussians.sh0)[index], atol=1e-4, rtol=0)

    def test_support_of_other_gaussians_is_refused(self):
        with pytest.raises(ShapeError, match="support of"):
            shrunk_sh0(sheet(5), torch.ones(4))


class TestSupport:
    def test_it_is_the_visibility_times_the_light(self):
        tube = build_tube()
        camera = tube.sequence.cameras[0]
        rendering = tube.scene.render(camera, visibility=True)
        plain = color_support(Scene(tube.scene.gaussians), camera, rendering)
        torch.testing.assert_close(plain.sum(), rendering.alpha.sum(), rtol=1e-4, atol=0)
        light = tube.scene.light
        assert light is not None
        lit = color_support(tube.scene, camera, rendering)
        seen = plain > 0
        distance = np.linalg.norm(tube.scene.gaussians.means.numpy() - camera.centers[0], axis=1)
        near, far = (seen & torch.from_numpy(chosen) for chosen in (distance < 25, distance > 45))
        assert (lit[near] / plain[near]).median() > 1.5 * (lit[far] / plain[far]).median()

    def test_pixels_outside_of_masks_do_not_count(self):
        """What only they show has no support: where a neighbour has some, its colour alone is taken."""
        tube = build_tube()
        left = tube.sequence.mask.copy()
        left[:, :, left.shape[2] // 2 :] = False
        masked = replace(tube.sequence, mask=left)
        whole, part = (
            gather_references(tube.scene, frames, frames.train, exposure=torch.ones(10))
            for frames in (tube.sequence, masked)
        )
        assert whole.sh0 is not None
        assert part.sh0 is not None
        own = tube.scene.gaussians.sh0
        lost = whole.seen.any(dim=0) & ~part.seen.any(dim=0) & (part.sh0 != own).any(dim=2)[:, 0]
        assert lost.sum() > 50
        assert (part.sh0 - own)[lost].abs().mean() > 1.2 * (whole.sh0 - own)[lost].abs().mean()

    def test_without_a_light(self):
        tube = build_tube()
        dark = Scene(tube.scene.gaussians)
        references = gather_references(dark, tube.sequence, tube.sequence.train)
        camera = tube.sequence.cameras[tube.sequence.test[0]]
        layers = observe_views(dark, references, camera, count=2).layers
        with torch.no_grad():
            shown = references.shown(dark).render(camera).rgb.permute(0, 3, 1, 2).clamp(0, 1)
        assert references.sh0 is not None
        assert torch.equal(layers.get("rendered"), shown)

    def test_a_rendering_without_visibility_is_refused(self):
        tube = build_tube()
        camera = tube.sequence.cameras[0]
        with pytest.raises(ShapeError, match="visibility=True"):
            color_support(tube.scene, camera, tube.scene.render(camera))


def gathered(tube: Tube, scene: Scene) -> ReferenceViews:
    return gather_references(scene, tube.sequence, tube.sequence.train, exposure=torch.ones(10))


class TestViews:
    def test_they_are_shown_in_shrunk_colours_and_the_scene_keeps_its_own(self):
        tube = build_tube()
        wall = tube.scene.gaussians
        index = int(((wall.means[:, 2] - 30).abs() + wall.means[:, 0].abs()).argmin())
        scene = with_red(tube.scene, index)
        camera = tube.sequence.cameras[tube.sequence.test[0]]
        references = gathered(tube, scene)
        assert references.sh0 is not None
        shown = observe_views(scene, references, camera, count=2).layers.get("rendered")
        own = observe_views(scene, replace(references, sh0=None), camera, count=2).layers.get("rendered")
        with torch.no_grad():
            as_it_is = scene.render(camera).rgb.permute(0, 3, 1, 2).clamp(0, 1)
            drawn = references.shown(scene).render(camera).rgb.permute(0, 3, 1, 2).clamp(0, 1)
        assert torch.equal(own, as_it_is)
        assert torch.equal(shown, drawn)
        assert not torch.equal(shown, own)
        # The scene itself keeps its colours.
        assert not torch.equal(references.sh0, scene.gaussians.sh0)

    def test_other_gaussians_are_told_anew(self):
        tube = build_tube()
        references = gathered(tube, tube.scene)
        fewer = Scene(
            tube.scene.gaussians.subset(torch.arange(len(tube.scene.gaussians)) % 2 == 0), tube.scene.light
        )
        again = references.of_scene(fewer)
        assert again.sh0 is not None
        assert len(again.sh0) == len(fewer.gaussians)
        torch.testing.assert_close(
            again.sh0,
            gather_references(fewer, tube.sequence, tube.sequence.train, exposure=torch.ones(10)).sh0,
        )

    def test_references_of_another_scene_are_refused(self):
        tube = build_tube()
        references = gathered(tube, tube.scene)
        with pytest.raises(ShapeError, match="references of a scene of"):
            references.shown(sheet())
