"""Which way Gaussians face, and views in which what is seen from behind stands behind everything else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import Float

from extrags.cameras import Cameras
from extrags.config import CoarseConfig, FinetuneConfig
from extrags.errors import ShapeError
from extrags.evaluation import render
from extrags.facing import one_sided_rendering, with_facing
from extrags.gaussians import Gaussians
from extrags.raster.light import shortest_axes
from extrags.scene import Scene
from extrags.training import finetune, reconstruct
from flows.methods import method_config
from tests.extrags.lit_tube import Tube

HALF_TURNS = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""Rotations that leave a Gaussian as it is: none, and by half a turn about each of its axes."""


def _wall(z: float, x: tuple[float, float], color: tuple[float, float, float]) -> Gaussians:
    """Flat Gaussians across the z axis, 0.1 apart, from `x[0]` to `x[1]`."""
    across, down = np.meshgrid(np.arange(*x, 0.1), np.arange(-1.5, 1.5, 0.1))
    points = np.stack([across.ravel(), down.ravel(), np.full(across.size, z)], axis=1)
    normals = np.tile([0.0, 0, 1], (len(points), 1))
    radius = np.full(len(points), 0.08)
    return Gaussians.from_points(
        points, np.tile(color, (len(points), 1)), radius, opacity=0.9, normals=normals, thickness=0.1
    )


def _camera(z: float, *, turned: bool = False) -> Cameras:
    """A camera on the z axis, looking along it, or the other way."""
    pose = np.eye(4)
    if turned:
        pose[:3, :3] = np.diag([-1.0, 1, -1])
    pose[2, 3] = z
    return Cameras(np.array([[[40.0, 0, 24], [0, 40, 20], [0, 0, 1]]]), pose[None], 48, 40)


def _product(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Hamilton's product of quaternions (w, x, y, z)."""
    a, b, c, d = first.unbind(-1)
    e, f, g, h = second.unbind(-1)
    return torch.stack(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ],
        dim=-1,
    )


def _faces(scene: Scene) -> Float[torch.Tensor, "n 3"]:
    """Directions in which the Gaussians face; zero where they have no sides."""
    assert scene.facing is not None
    axes = shortest_axes(scene.gaussians.quats, scene.gaussians.scales.exp())
    return scene.facing[:, None] * axes


@pytest.fixture
def seen_from_beyond() -> Scene:
    """A guess at z = 3, seen from z = 6 alone, before a wall at z = 8, seen from the same place.

    The guess covers the left half of a view from z = 0, and reaches farther down than the wall does.
    """
    guess, wall = _wall(3, (-1.5, 0), (0.2, 0.8, 0.2)), _wall(8, (-2, 2), (0.8, 0.2, 0.2))
    return with_facing(Scene(Gaussians.concatenated(guess, wall)), [_camera(6, turned=True), _camera(6)])


class TestSides:
    @pytest.mark.parametrize("turned", [False, True])
    def test_a_wall_faces_the_camera_that_saw_it(self, turned: bool) -> None:
        """However the rotations of its Gaussians are written: half turns leave them as they are."""
        wall = _wall(3, (-1, 1), (0.5, 0.5, 0.5))
        generator = torch.Generator().manual_seed(0)
        turns = HALF_TURNS[torch.randint(4, (len(wall),), generator=generator)]
        wall = replace(wall, quats=_product(wall.quats, turns))
        faces = _faces(with_facing(Scene(wall), [_camera(6, turned=True) if turned else _camera(0)]))
        seen = faces.abs().sum(dim=1) > 0
        assert float(seen.float().mean()) > 0.9
        # The camera looks along z from z = 0, or back from z = 6.
        assert bool(((faces[seen, 2] > 0.99) if turned else (faces[seen, 2] < -0.99)).all())

    def test_most_views_decide(self) -> None:
        wall = Scene(_wall(3, (-1, 1), (0.5, 0.5, 0.5)))
        before, beyond = _camera(0), _camera(6, turned=True)
        assert bool((_faces(with_facing(wall, [beyond, beyond, beyond, before]))[:, 2] >= 0).all())
        assert bool((_faces(with_facing(wall, [before, beyond])) == 0).all())

    def test_what_nobody_saw_and_what_is_round_has_no_sides(self) -> None:
        flat = _wall(3, (-1, 1), (0.5, 0.5, 0.5))
        round_ones = replace(flat, scales=flat.scales.max(dim=1, keepdim=True).values.expand(-1, 3).clone())
        assert bool((_faces(with_facing(Scene(round_ones), [_camera(0)])) == 0).all())
        hidden = Gaussians.concatenated(flat, _wall(-5, (-1, 1), (0.5, 0.5, 0.5)))
        faces = _faces(with_facing(Scene(hidden), [_camera(0)]))
        assert bool((faces[len(flat) :] == 0).all())
        assert bool((faces[: len(flat)].abs().sum(dim=1) > 0).any())

    def test_needles_have_no_sides(self) -> None:
        """Two of their axes are short: around the long one no direction is that of a surface."""
        needles = _wall(3, (-1, 1), (0.5, 0.5, 0.5))
        short = needles.scales.min(dim=1, keepdim=True).values
        scales = torch.cat([short, short + 0.1, short + 2], dim=1)
        assert bool((_faces(with_facing(Scene(replace(needles, scales=scales)), [_camera(0)])) == 0).all())

    def test_a_view_counts_by_how_well_it_sees(self) -> None:
        """Two views through a veil say less than one that sees all."""
        wall, veil = _wall(3, (-1, 1), (0.5, 0.5, 0.5)), _wall(4.5, (-1.5, 1.5), (0.5, 0.5, 0.5))
        veil = replace(veil, opacities=torch.full_like(veil.opacities, 0.4).logit())
        beyond = _camera(6, turned=True)
        alone = _faces(with_facing(Scene(Gaussians.concatenated(wall, veil)), [beyond]))
        faces = _faces(with_facing(Scene(Gaussians.concatenated(wall, veil)), [beyond, beyond, _camera(0)]))
        middle = (wall.means[:, :2].abs() < 0.5).all(dim=1)
        assert bool((alone[: len(wall)][middle, 2] > 0.99).all())
        assert bool((faces[: len(wall)][middle, 2] < -0.99).all())


class TestRendering:
    def test_what_is_seen_from_behind_hides_nothing_and_fills_what_is_empty(
        self, seen_from_beyond: Scene
    ) -> None:
        view = _camera(0)
        red, green, both = ((1, 0), (0, 1), (0, 1))
        found = one_sided_rendering(seen_from_beyond, view).rgb[0]
        plain = seen_from_beyond.render(view).rgb[0]
        # Left of the middle the guess stands before the wall; far to the lower left there is no wall.
        assert [int(plain[20, 16, k] > 0.5) for k in both] == list(green)
        assert [int(found[20, 16, k] > 0.5) for k in both] == list(red)
        torch.testing.assert_close(found[38, 16], plain[38, 16], atol=0.02, rtol=0)
        assert float(found[38, 16, 1]) > 0.5

    def test_it_is_the_rendering_of_a_scene_whose_guess_stands_behind(self, seen_from_beyond: Scene) -> None:
        """A similarity about the camera changes no image but the order of depth, and depth itself."""
        view = _camera(0)
        gaussians = seen_from_beyond.gaussians
        guess = gaussians.means[:, 2] < 5
        assert seen_from_beyond.facing is not None
        # What is seen at no side stays where it is.
        guess &= seen_from_beyond.facing != 0
        factor = torch.where(guess, 10.0, 1.0)
        moved = replace(
            gaussians,
            means=gaussians.means * factor[:, None],
            scales=gaussians.scales + factor.log()[:, None],
        )
        found, expected = one_sided_rendering(seen_from_beyond, view), Scene(moved).render(view)
        # Compositing stops before a transmittance of 1e-4, by Gaussians of alpha 0.9 at less than 1e-3, in
        # each part of its own; rounding may put a Gaussian on the other side of the least alpha, 1/255.
        for one, other in ((found.rgb, expected.rgb), (found.alpha, expected.alpha)):
            difference = (one - other).abs()
            assert float(difference.max()) < 1 / 255
            assert float((difference > 1e-3).float().mean()) < 0.01
        wall_alone = Scene(gaussians.subset(~guess)).render(view)
        solid = wall_alone.alpha > 0.99
        torch.testing.assert_close(found.depth[solid], wall_alone.depth[solid], atol=0.06, rtol=0)
        nothing_else = (wall_alone.alpha < 1e-3) & (found.alpha > 0.9)
        assert int(nothing_else.sum()) > 20
        torch.testing.assert_close(
            found.depth[nothing_else], expected.depth[nothing_else] / 10, atol=0.03, rtol=0
        )

    def test_from_before_it_is_the_plain_rendering(self, seen_from_beyond: Scene) -> None:
        """Bit by bit, as where nobody knows of sides."""
        for scene, view in (
            (seen_from_beyond, _camera(6)),
            (replace(seen_from_beyond, facing=None), _camera(0)),
            (
                replace(seen_from_beyond, facing=torch.zeros(len(seen_from_beyond.gaussians)).char()),
                _camera(0),
            ),
        ):
            found, expected = one_sided_rendering(scene, view), scene.render(view)
            assert torch.equal(found.rgb, expected.rgb)
            assert torch.equal(found.depth, expected.depth)

    def test_the_gain_is_that_of_the_view_before_and_behind(self, seen_from_beyond: Scene) -> None:
        """Half the gain is half the colour, of what stands before as of what fills the gaps behind it."""
        view = _camera(0)
        assert seen_from_beyond.facing is not None
        full, half = (
            one_sided_rendering(seen_from_beyond, view, exposure=torch.tensor([gain])) for gain in (1.0, 0.5)
        )
        torch.testing.assert_close(half.rgb, 0.5 * full.rgb)
        torch.testing.assert_close(half.alpha, full.alpha)
        assert float(full.rgb[0, 38, 16, 1]) > 0.5

    def test_nothing_but_backs(self, seen_from_beyond: Scene) -> None:
        """Where all of a scene is seen from behind, all of it is shown."""
        guess = seen_from_beyond.gaussians.means[:, 2] < 5
        assert seen_from_beyond.facing is not None
        alone = Scene(seen_from_beyond.gaussians.subset(guess), None, seen_from_beyond.facing[guess])
        found, expected = one_sided_rendering(alone, _camera(0)), alone.render(_camera(0))
        torch.testing.assert_close(found.rgb, expected.rgb, atol=2e-4, rtol=0)
        torch.testing.assert_close(found.depth, expected.depth, atol=2e-3, rtol=2e-3)

    def test_held_out_views_are_rendered_so(self, tube: Tube) -> None:
        light = tube.scene.light
        scene = with_facing(tube.scene, [tube.sequence.cameras[tube.sequence.train]])
        assert scene.facing is not None
        inside_out = Scene(scene.gaussians, light, -scene.facing)
        found = render(inside_out, tube.sequence)
        frame = int(tube.sequence.test[0])
        assert light is not None
        gain = light.interpolated_exposures(
            tube.sequence.test[:1], tube.sequence.train, tube.sequence.recording
        )
        expected = one_sided_rendering(inside_out, tube.sequence.cameras[frame], exposure=gain)
        np.testing.assert_array_equal(found.rgb[0], expected.rgb[0].numpy())
        assert np.abs(found.rgb - render(tube.scene, tube.sequence).rgb).max() > 0.01


class TestScenes:
    def test_sides_are_kept_in_files_and_copies(self, seen_from_beyond: Scene, tmp_path: Path) -> None:
        expected = seen_from_beyond.facing
        assert expected is not None
        assert set(expected.tolist()) == {-1, 0, 1}
        seen_from_beyond.save(tmp_path)
        for scene in (Scene.load(tmp_path), seen_from_beyond.detached(), seen_from_beyond.to("cpu")):
            assert scene.facing is not None
            assert torch.equal(scene.facing, expected)

    def test_sides_of_other_gaussians_are_refused(self, seen_from_beyond: Scene) -> None:
        with pytest.raises(ShapeError, match=r"facing has shape \(3,\), expected"):
            replace(seen_from_beyond, facing=torch.zeros(3, dtype=torch.int8))

    def test_trained_scenes_know_their_sides(self, tube: Tube) -> None:
        """Unless the settings say otherwise, as those of published methods do."""
        config = CoarseConfig(iterations=2)
        tuned = FinetuneConfig(iterations=2)
        for one_sided in (True, False):
            settings = config.model_copy(update={"one_sided": one_sided})
            coarse = reconstruct(tube.sequence, settings).scene
            final = finetune(coarse, tube.sequence, None, tuned, settings).scene
            assert (coarse.facing is not None) == (final.facing is not None) == one_sided
        assert coarse.facing is None
        for name in ("3dgs", "paper", "exploregs", "gaussian-pancakes"):
            assert not method_config(name, "quick").coarse.one_sided
